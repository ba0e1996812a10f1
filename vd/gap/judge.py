"""Rules of evidence: what earns an effect its place in a model, and when two models are equals.

Everything is judged on trajectories that the fit has not seen, and resampled by whole trajectories with
the choice inside the resampling. :mod:`vd.gap.verdict` has the last word on the model that is found.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vd.gap.joint_fit import JointFit
from vd.gap.statistics import interval, rmse

NESTED = {
    "stribeck_friction": ("coulomb_friction",),
    "asymmetric_friction": ("coulomb_friction",),
    "torque_speed_limit": ("torque_limit",),
    "elastic_transmission": ("payload_inertia",),
}
"""Effects that contain a simpler one; in a tie the simpler one is meant."""

NO_GAP = 1.15
"""A baseline within this factor of the noise floor leaves nothing to explain."""
MIN_GAIN = 0.05
"""Share of the held-out RMSE that an effect must remove."""
MIN_GAIN_FLOORS = 0.7
"""Gap that an effect must close, as sqrt(before^2 - after^2), in noise floors."""
JITTER_GAIN_FLOORS = 0.3
"""The same beside random delays: an effect of six floors leaves half of one there."""
MEMORY = 8.0
"""Samples in a row that say the same beside them: what a late command does lasts that long."""
PENALTY = 0.01
"""Relative RMSE that a further parameter must earn to be preferred."""
TIE_TAIL = 0.05
"""Share of the resamples in which the other of two candidates is better that makes them a tie: half of
what a name may lose."""
EXPLAINED = 1.1
"""A winner within this factor of the noise floor leaves white residuals ..."""
EXCESS_FLOORS = 0.07
"""... so that an alternative that leaves this much more, in noise floors, is worse: thousands of samples
carry that difference."""
CONTAINED_FLOORS = 0.15
"""The same for one that the winner contains: with more parameters it imitates what the integrator misses."""
RECOVERED = 0.5
"""Share of the squared gap that the named effects must recover; less is an unknown cause."""
REPEATABLE = 2.0
"""Final error, in noise floors, up to which residuals are held against noise alone. A real machine that is
farther from it does not repeat its motions that well; how well is not known from one recording of each."""
JITTER = "command_jitter"
"""The effect that no single prediction shows (:mod:`vd.gap.jitter`): tried last, on what is left."""


@dataclass(kw_only=True)
class Judge:
    """Compares fits of one joint.

    Attributes:
        floor: Noise floor [rad].
        weights: Bootstrap weights of the trajectories [R, S].
        moves: Whether the joint's command changes, of each trajectory [S]; None: in all.
        behind_jitter: Whether samples are weighted by what random delays do (:mod:`vd.gap.sample_weighting`).
    """

    floor: float
    weights: np.ndarray
    moves: np.ndarray | None = None
    behind_jitter: bool = False

    def white(self, fit: JointFit) -> bool:
        """Whether samples tell how good a fit is: it leaves no more than noise, or jitter, on all of them."""
        return self.behind_jitter or fit.rmse < EXPLAINED * self.floor

    def no_gap(self, fit: JointFit) -> bool:
        """Whether a fit predicts as well as noise lets it; beside jitter that is not known as exactly."""
        return not self.behind_jitter and fit.held_out_rmse < NO_GAP * self.floor

    def scores(
        self, fits: Sequence[JointFit], weights: np.ndarray | None = None, fitted: bool = False
    ) -> np.ndarray:
        """Log of held-out (or fitted) RMSE plus the price of parameters, shape [C] or [C, R]."""
        loss = np.stack([fit.sse if fitted else fit.held_out for fit in fits])
        error = np.log(np.maximum(rmse(loss, fits[0].count, weights), 1e-12))
        price = PENALTY * np.array([len(fit.x) for fit in fits], float)
        return error + (price if weights is None else price[:, None])

    def best(self, fits: Sequence[JointFit]) -> JointFit:
        """The fit with the best held-out score; with the best fitted one of those with white residuals.

        Of these, samples tell more than the luck of a held-out motion.
        """
        at_floor = [fit for fit in fits if self.white(fit)]
        found = at_floor or fits
        return found[int(np.argmin(self.scores(found, fitted=bool(at_floor))))]

    def winner(self, fits: Sequence[JointFit]) -> JointFit:
        """The candidate with the best held-out score; the simpler one that it contains if that is as good.

        One with a parameter at its bound wins only if all have.
        """
        inside = [fit for fit in fits if not fit.at_bound] or list(fits)
        best = self.best(inside)
        simpler = [f for f in inside if f.effects[-1] in NESTED.get(best.effects[-1], ())]
        return next((fit for fit in simpler if self.tied(best, fit, loose=True)[0]), best)

    def gain(self, before: JointFit, after: JointFit) -> tuple[float, tuple[float, float]]:
        """Share of the held-out RMSE removed, with its interval over trajectories."""
        old, new = (rmse(fit.held_out, fit.count, self.weights) for fit in (before, after))
        return 1.0 - after.held_out_rmse / before.held_out_rmse, interval(1.0 - new / old)

    def better(self, before: JointFit, after: JointFit, tail: float = 0.025) -> tuple[bool, str]:
        """Whether the step from one model to the larger is earned, and if not why.

        Motions that no fit has seen decide; but a larger model that leaves white residuals is judged on
        all samples: that a parameter is not known well enough without one motion to predict it, as that of a
        profile that cannot follow, says nothing against it. Nor does luck with such a motion speak for
        a larger model if the smaller one leaves white residuals already.

        Args:
            before: The smaller model.
            after: The larger.
            tail: Share of the resamples that may see no gain.
        """
        white = (self.white(before) or self.white(after)) and JITTER not in before.effects
        if white:
            before, after = (replace(fit, held_out=fit.sse) for fit in (before, after))
        old, new = (rmse(fit.held_out, fit.count, self.weights) for fit in (before, after))
        gain = 1.0 - after.held_out_rmse / before.held_out_rmse
        sampled = 1.0 - new / old
        if JITTER in after.effects:
            # Its errors are not held out: what it is compared with must not gain by being so either.
            fitted = replace(before, held_out=before.sse)
            sampled = _likelihood_gain(fitted, after, self.weights)
            # The share by which the widths shrink, as the likelihood has it: on the geometric mean.
            own, count = self._own_widths(before, after)
            gain = 1.0 - float(np.exp(-own.sum() / max(count.sum(), 1.0)))
        low = float(np.quantile(sampled, tail))
        closed = before.held_out_rmse * np.sqrt(max(1.0 - (1.0 - gain) ** 2, 0.0))
        if gain < MIN_GAIN:
            return False, f"removes {100.0 * gain:.1f} % of the error, less than {100.0 * MIN_GAIN:.0f} %"
        if low <= 0.0:
            return False, "its gain over trajectories is not distinguishable from 0"
        if closed < (JITTER_GAIN_FLOORS if self.behind_jitter else MIN_GAIN_FLOORS) * self.floor:
            return False, "what it removes is below the noise floor"
        return True, ""

    def likelier(self, before: JointFit, after: JointFit) -> bool:
        """Whether random delays are likelier than a model of as many effects without them.

        What they add to a model has to be worth another effect; a fixed delay, whose mean they have as well,
        they only replace. A width of its own for every motion, which the other model has here as there, is a
        parameter, and costs it what one costs (half the log of its samples).

        Args:
            before: The model without them.
            after: The model with them.
        """
        sampled = _likelihood_gain(replace(before, held_out=before.sse), after, self.weights)
        own, count = self._own_widths(before, after)
        price = 0.5 * np.log(np.maximum(count, 1.0))
        return float(np.quantile(sampled, 0.025)) > 0.0 and float((own + price).sum()) > 0.0

    def sure(self, alone: JointFit, beside: JointFit) -> bool:
        """Whether the motions are sure of what a model has beside random delays."""
        return float(np.quantile(_likelihood_gain(alone, beside, self.weights), 0.025)) > 0.0

    def _own_widths(self, before: JointFit, after: JointFit) -> tuple[np.ndarray, np.ndarray]:
        """Log-likelihood gained by random delays over a model with a width for each motion, and samples; [S].

        The other model has a width of its own for every motion, lest jitter be credited with what any excuse
        for some of them would gain. It is no less than the floor, nor does a motion count whose command stays
        as it is: nothing can be late there.
        """
        power = before.sse / after.count / self.floor**2
        widths = self.floor**2 * np.where(power < 1.0, np.exp(np.minimum(power, 1.0) - 1.0), power)
        count = after.count if self.moves is None else after.count * self.moves
        ratio = np.maximum(widths * after.count, 1e-30) / np.maximum(after.sse, 1e-30)
        return 0.5 * count * np.log(ratio), count

    def tied(
        self, winner: JointFit, other: JointFit, loose: bool = False
    ) -> tuple[bool, tuple[float, float]]:
        """Whether the recording does not tell two fits apart, and the interval of their difference [rad].

        A winner at the noise floor leaves white residuals, so that samples count: what the other leaves
        in excess of it is then decisive, even if few motions show it.

        Args:
            winner: The better fit.
            other: The other.
            loose: Whether the winner can be better by imitating what the integrator of the true one misses.
        """
        best, error = (rmse(fit.held_out, fit.count, self.weights) for fit in (winner, other))
        low, high = interval(error - best)
        if self.white(winner):
            excess = (other.rmse**2 - winner.rmse**2) / self.floor**2
            if excess > 0.0:  # what needs more parameters to do worse is no equal
                more = max(len(other.x) - len(winner.x), 0)
                excess += 2.0 * PENALTY * more * (winner.rmse / self.floor) ** 2
            excess /= MEMORY if self.behind_jitter else 1.0
            return excess < (CONTAINED_FLOORS if loose else EXCESS_FLOORS) ** 2, (low, high)
        return float(np.quantile(error - best, TIE_TAIL)) <= 0.0, (low, high)


def _likelihood_gain(before: JointFit, after: JointFit, weights: np.ndarray) -> np.ndarray:
    """Gain in log-likelihood of a model with random delays over one without, per resample.

    What they move is in few motions, whose squared errors would decide all; their likelihood, of a
    width that follows the motion, weighs every sample by how surely it is known.
    """
    count = before.count
    square = before.held_out.sum() / count.sum()
    old = 0.5 * (count * np.log(square) + before.held_out / square)
    if JITTER in before.effects:
        old = 0.5 * count * (np.log(before.held_out / count) + 1.0)
    spread = 0.5 * count * (np.log(after.held_out / count) + 1.0)
    return weights @ (old - spread)
