"""Rules of evidence: what earns an effect its place, when two models are equals, and the verdict on the last.

Everything is judged on trajectories that the fit has not seen, and resampled by whole trajectories
with the choice inside the resampling.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

import vd.kernels.servo.actuators as servo
from vd.gap.explanation import CLOSE, NAMED, Accepted, Explanation, Trial, estimates, intervals
from vd.gap.joint_fit import DRY, ONE_SIDED, JointFit
from vd.gap.statistics import OWN_ERROR, REPEATABLE, interval, rmse
from vd.kernels.servo.effects import BESIDE, TOGETHER

NESTED = {
    "stribeck_friction": ("coulomb_friction",),
    "asymmetric_friction": ("coulomb_friction",),
    "torque_speed_limit": ("torque_limit",),
    "elastic_transmission": ("payload_inertia",),
}
"""Effects that contain a simpler one; in a tie the simpler one is meant."""

# Half and twice: what they turn of the decisions in the XL330 and eight recordings of the battery.
NO_GAP = 1.15
"""A model within this factor of the noise floor leaves white residuals, and nothing to explain.
With half of what it leaves above 1 none of 40 is decided otherwise, with twice two are."""
MIN_GAIN = 0.05
"""Share of the held-out RMSE that an effect must remove. Half passes two more of 46, twice none
less.
"""
JITTER_GAIN_FLOORS = 0.3
"""Gap that an effect must close beside random delays, as sqrt(before^2 - after^2), in noise floors:
one of six floors leaves half of one there. Without delays it is what :data:`NO_GAP` takes for none.
Half and twice turn none of 7."""
MEMORY = 8
"""Samples in a row that say the same beside random delays: what a late command does lasts that
long. Half and twice turn none of 38."""
PENALTY = 0.01
"""Relative RMSE that a further parameter must earn to be preferred. Half and twice turn none of
166.
"""
EXCESS_FLOORS = 0.07
"""What an alternative to a winner that leaves white residuals must leave more, in noise floors, to
be worse: thousands of samples carry that difference. Half and twice turn none of 164."""
CONTAINED_FLOORS = 0.15
"""The same for one that the winner contains: with more parameters it imitates what the integrator
misses. Of two, half and twice turn none."""
RECOVERED = 0.5
"""Share of the squared gap that the named effects must recover. Half turns none of 12, half more
one.
"""
JITTER = "command_jitter"
"""The effect that no single prediction shows (:mod:`vd.gap.jitter`): tried last, on what is
left.
"""
CANCELLING = ("gravity_load", "encoder_bias")
"""Effects that hold a joint off its command at rest. Where they cancel there, they are no two
causes but one that pulls with the travel from there, a spring, which the table has not."""
DETERMINED = ("kp", "kd", "inertia")
"""Baseline parameters that every useful excitation determines."""


@dataclass(kw_only=True)
class Evidence:
    """Compares fits of one joint, and judges the last.

    Attributes:
        noise: Noise floor of the recording [rad].
        weights: Bootstrap weights of the trajectories [R, S].
        whole: Held-out RMSE of the plain model [rad].
        moves: Whether the joint's command changes, of each trajectory [S]; None: in all.
        behind_jitter: Whether samples are weighted by what random delays do
            (:mod:`vd.gap.joint_fit`).
        equivalent: Effects that one stands for, since the recording cannot tell them apart.
        joint: Index of the joint in its chain.
    """

    noise: float
    weights: np.ndarray
    whole: float = 0.0
    moves: np.ndarray | None = None
    behind_jitter: bool = False
    equivalent: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    joint: int = 0

    @property
    def floor(self) -> float:
        """The least error that a right model can have [rad].

        Noise, and what it misses of a large effect.
        """
        return float(np.hypot(self.noise, OWN_ERROR * self.whole))

    def white(self, fit: JointFit) -> bool:
        """Whether samples tell how good a fit is.

        It leaves no more than noise, or jitter, on all of them.
        """
        return self.behind_jitter or fit.rmse < NO_GAP * self.floor

    def no_gap(self, fit: JointFit) -> bool:
        """Whether a fit predicts as well as noise lets it.

        Beside jitter that is not known as exactly.
        """
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
        """The fit with the best held-out score.

        With the best fitted one of those with white residuals.

        Of these, samples tell more than the luck of a held-out motion.
        """
        at_floor = [fit for fit in fits if self.white(fit)]
        found = at_floor or fits
        return found[int(np.argmin(self.scores(found, fitted=bool(at_floor))))]

    def winner(self, fits: Sequence[JointFit]) -> JointFit:
        """The candidate with the best held-out score.

        The simpler one that it contains if that is as good.

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

    def better(
        self, before: JointFit, after: JointFit, tentative: bool = False
    ) -> tuple[bool, str]:
        """Whether the step from one model to the larger is earned, and if not why.

        Motions that no fit has seen decide; but a larger model that leaves white residuals is
        judged on
        all samples: that a parameter is not known well enough without one motion to predict it, as
            that of a
        profile that cannot follow, says nothing against it. Nor does luck with such a motion speak
        for a larger model if the smaller one leaves white residuals already.

        Args:
            before: The smaller model.
            after: The larger.
            tentative: Whether the gain may be that of a few motions: one of two causes alone can
                make some worse.
        """
        white = self.white(before) or self.white(after)
        if white:
            before, after = (replace(fit, held_out=fit.sse) for fit in (before, after))
        old, new = (rmse(fit.held_out, fit.count, self.weights) for fit in (before, after))
        gain = 1.0 - after.held_out_rmse / before.held_out_rmse
        closed = before.held_out_rmse * np.sqrt(max(1.0 - (1.0 - gain) ** 2, 0.0))
        if gain < MIN_GAIN:
            return (
                False,
                f"removes {100.0 * gain:.1f} % of the error, less than {100.0 * MIN_GAIN:.0f} %",
            )
        if not tentative and interval(1.0 - new / old)[0] <= 0.0:
            return False, "its gain over trajectories is not distinguishable from 0"
        if (
            closed
            < (JITTER_GAIN_FLOORS if self.behind_jitter else np.sqrt(NO_GAP**2 - 1.0)) * self.floor
        ):
            return False, "what it removes is below the noise floor"
        return True, ""

    def likelier(self, before: JointFit, after: JointFit) -> tuple[bool, str]:
        """Whether random delays are likelier than a model without them, and if not why.

        The other model has a width of its own for every motion, no less than the floor, lest jitter
        be credited with what any excuse for some of them would gain; a width is a parameter, and
        costs what one costs (half the log of its samples). A motion whose command stays as it is
        does not count: nothing can be late there. What random delays add to a model has to be worth
            another effect.

        Args:
            before: The model without them.
            after: The model with them.
        """
        power = before.sse / after.count / self.noise**2
        widths = self.noise**2 * np.where(power < 1.0, np.exp(np.minimum(power, 1.0) - 1.0), power)
        count = after.count if self.moves is None else after.count * self.moves
        ratio = np.maximum(widths * after.count, 1e-30) / np.maximum(after.sse, 1e-30)
        gained = 0.5 * count * np.log(ratio)
        share = 1.0 - float(np.exp(-gained.sum() / max(count.sum(), 1.0)))
        if len(after.effects) > len(before.effects) and share < MIN_GAIN:
            return (
                False,
                f"narrows what is left by {100.0 * share:.1f} %, less than {100.0 * MIN_GAIN:.0f} "
                f"%",
            )
        price = 0.5 * np.log(np.maximum(count, 1.0))
        if interval(self.weights @ (gained + price))[0] <= 0.0:
            return False, "not likelier than a width of its own for every motion"
        return True, ""

    def tied(
        self, winner: JointFit, other: JointFit, loose: bool = False
    ) -> tuple[bool, tuple[float, float]]:
        """Whether the recording does not tell two fits apart, and the interval of their difference [rad].

        A winner at the noise floor leaves white residuals, so that samples count: what the other
        leaves in excess of it is then decisive, even if few motions show it.

        Args:
            winner: The better fit.
            other: The other.
            loose: Whether the winner can be better by imitating what the integrator of the true one
                misses.
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
        return low <= 0.0, (low, high)

    def undetermined(self, fit: JointFit) -> str:
        """Which parameter of the baseline the motions leave open, in words; empty if none."""
        for key, (low, high) in intervals(fit, self.floor).items():
            if key in DETERMINED and high > np.e**2 * low:  # as of a limit that is not shown
                return f"{key} can lie anywhere between {low:.2g} and {high:.2g}: the motions do not show it"
        return ""

    def settle(self, trials: Sequence[Trial], final: JointFit) -> list[Trial]:
        """The evidence with the steps that did not last marked as such."""
        text = "helped at first, not needed or not earned in the end"
        return [
            replace(t, decision="rejected", reason=text)
            if t.decision == "named" and t.name not in final.effects
            else t
            for t in trials
        ]

    def conclude(
        self,
        baseline: JointFit,
        final: JointFit,
        rivals: Mapping[str, list[JointFit]],
        trials: Sequence[Trial],
        loose: str,
        refined: JointFit | None = None,
        known: Sequence[Accepted] = (),
    ) -> Explanation:
        """Confidence, sets and verdict of the final model.

        Args:
            baseline: The model without effects.
            final: The model chosen.
            rivals: Fits with others in the place of each effect.
            trials: The evidence.
            loose: What of the baseline the motions leave open.
            refined: The final model at finer time steps, whose values are reported.
            known: Effects that are judged already.
        """
        told = final if refined is None else refined
        spread = intervals(told, self.floor)
        accepted = [*known]
        for name in [n for n in final.effects if n not in {one.name for one in known}]:
            fits = rivals.get(name, [final])
            accepted.append(self.accept(final, name, fits, spread, told))
        explanation = Explanation(baseline, told, "unknown", "", tuple(accepted), tuple(trials))
        if not accepted:
            return self.nothing_earned(explanation, loose)
        # One motion can be all that shows a parameter: that no fit without it predicts it says
        # nothing then.
        fitted = self.white(final) and not self.behind_jitter
        before, after = ((f.rmse if fitted else f.held_out_rmse) ** 2 for f in (baseline, final))
        share = (before - after) / max(before - self.floor**2, 1e-30)
        # What jitter does to each sample stays, however well its size is known.
        if share < RECOVERED and JITTER not in final.effects:
            text = f"the best candidate recovers {100.0 * share:.0f} % of the squared gap, less than half"
            return replace(explanation, reason=text)
        return _by_names(explanation)

    def nothing_earned(self, explanation: Explanation, loose: str) -> Explanation:
        """The verdict where no effect earned its place."""
        tried = [t for t in explanation.trials if np.isfinite(t.gain)]
        why = tried[0].reason if tried else "there is no candidate"
        if explanation.baseline.held_out_rmse > REPEATABLE * self.floor:
            return replace(explanation, reason=f"a gap that no candidate explains: the best {why}")
        if loose:
            return replace(explanation, verdict="under_excited", reason=loose)
        return replace(
            explanation, verdict="no_gap", reason=f"no effect is significant: the best {why}"
        )

    def accept(
        self,
        final: JointFit,
        name: str,
        rivals: Sequence[JointFit],
        spread: Mapping[str, tuple[float, float]],
        told: JointFit,
    ) -> Accepted:
        """Confidence and set of one effect of the final model, with the values ``told``."""
        own = next((fit for fit in rivals if fit.effects and fit.effects[-1] == name), None)
        mine = final if own is None or any(fit is final for fit in rivals) else own
        means = (*self.equivalent.get(name, ()), *self.same_beside(final, name))
        others = [
            fit for fit in rivals if fit is not mine and fit.effects[-1] not in (name, *means)
        ]
        alone = not {*DRY, *TOGETHER.get(name, ())} & {*final.effects}
        white = self.white(mine)
        choice = np.argmin(self.scores([mine, *others], self.weights, fitted=white), axis=0)
        simple = {i + 1 for i, fit in enumerate(others) if name in NESTED.get(fit.effects[-1], ())}
        share = float(np.mean([c == 0 or c in simple for c in choice]))
        alternatives, tied = [], []
        for fit in sorted(others, key=lambda other: other.held_out_rmse):
            other = fit.effects[-1]
            same, ci = self.tied(mine, fit)
            alternatives.append((other, fit.held_out_rmse, ci))
            if same:
                tied.append(other)
        # In a tie the simpler one is meant: none beside an effect that it contains.
        tied = [o for o in tied if not {name, *tied} & set(NESTED.get(o, ()))]
        if share < NAMED and not tied:
            rival = int(np.argmax(np.bincount(choice, minlength=len(others) + 1)[1:]))
            tied.append(others[rival].effects[-1])
        return Accepted(
            name=name,
            confidence=share,
            estimates=estimates(told, name, spread),
            equivalent=(*means, *TOGETHER.get(name, ())) if alone else means,
            alternatives=tuple(alternatives),
            tied=tuple(tied),
            at_bound=any(key.startswith(f"{name}.") for key in final.at_bound),
        )

    def same_beside(self, final: JointFit, name: str) -> tuple[str, ...]:
        """Effects that move the joint as one does beside the others of a model (:data:`BESIDE`)."""
        same = [other for one in final.effects for other in BESIDE.get(one, {}).get(name, ())]
        if ONE_SIDED in same:
            # A side of friction cannot push: it is at most what is dry in all.
            level = final.values.get("stribeck_friction.tau_c_nm", 0.0)
            pull = abs(final.values["encoder_bias.bias_rad"]) * float(
                final.rows[self.joint, servo.KP]
            )
            same = [other for other in same if other != ONE_SIDED or pull <= level]
        return tuple(same)


def _by_names(explanation: Explanation) -> Explanation:
    """The verdict by what of a model that fits is named, or a set, or neither."""
    accepted = explanation.accepted
    named = [a.name for a in accepted if a.named]
    if named:
        return replace(explanation, verdict="effects", reason=explains(named))
    if all(a.at_bound for a in accepted):
        return replace(
            explanation, reason=f"{accepted[0].name} fits only with a parameter at its bound"
        )
    sets = [" or ".join((a.name, *a.tied)) for a in accepted if a.tied and not a.at_bound]
    if not sets:
        absent = [a.name for a in accepted if not a.shown]
        text = f"{absent[0]} can be nothing at all" if absent else "nothing is chosen often enough"
        return replace(explanation, reason=text)
    return replace(explanation, verdict="ambiguous", reason=f"{'; '.join(sets)}: not told apart")


def explains(names: Sequence[str]) -> str:
    """The reason of a verdict that names effects."""
    return f"{' and '.join(names)} {'explains' if len(names) == 1 else 'explain'} it"


def cancelled(fit: JointFit, joint: int, rest: float) -> str:
    """What two effects of a model are instead if they cancel at rest, in words.

    Empty if they do not.

    Args:
        fit: The model.
        joint: Index of its joint in the chain.
        rest: Where the joint rests before it moves [rad].
    """
    if not {*CANCELLING} <= {*fit.effects}:
        return ""
    values, kp = fit.values, float(fit.rows[joint, servo.KP])
    load = values["gravity_load.tau_g_nm"] * np.sin(rest + values["gravity_load.phase_rad"])
    offset = kp * values["encoder_bias.bias_rad"]
    if abs(offset - load) > CLOSE * min(abs(load), abs(offset)):
        return ""
    return (
        "gravity_load and encoder_bias cancel where the joint rests: a spring about that place "
        "would look "
        "the same, and is not among the candidates"
    )
