"""Rules of evidence: what earns an effect its place, its name, or a place in a set of equals.

Everything is judged on trajectories that the fit has not seen, and resampled by whole trajectories with
the choice inside the resampling.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

import vd.kernels.actuators as servo
from vd.gap.fit import RIDGE
from vd.gap.joint_fit import JointFit
from vd.gap.result import Verdict
from vd.gap.statistics import covariance, half_width, interval, rmse
from vd.kernels.effects import EFFECTS, EQUIVALENT

NESTED = {
    "stribeck_friction": ("coulomb_friction",),
    "asymmetric_friction": ("coulomb_friction",),
    "torque_speed_limit": ("torque_limit",),
    "elastic_transmission": ("payload_inertia",),
}
"""Effects that contain a simpler one; in a tie the simpler one is meant."""

NO_GAP = 1.15
"""A baseline within this factor of the noise floor leaves nothing to explain."""
UNEXPLAINED = 1.5
"""A baseline beyond this factor of the noise floor has a gap, whether or not an effect explains it."""
MIN_GAIN = 0.05
"""Share of the held-out RMSE that an effect must remove."""
MIN_GAIN_FLOORS = 0.7
"""Gap that an effect must close, as sqrt(before^2 - after^2), in noise floors."""
MIN_SHARE = 0.02
"""The same in whole gaps: no fit of a large effect is better than that. With half of it, an acceleration
limit of 300 noise floors, whose optimum is sharp, comes with a second effect that is not there."""
NAMED = 0.9
"""Share of the resamples that must choose an effect for it to be named."""
PENALTY = 0.01
"""Relative RMSE that a further parameter must earn to be preferred."""
TIE_TAIL = 0.05
"""Share of the resamples in which the other of two candidates is better that makes them a tie: half of
what a name may lose."""
EXPLAINED = 1.1
"""A winner within this factor of the noise floor leaves white residuals ..."""
EXCESS_FLOORS = 0.15
"""... so that an alternative that leaves this much more, in noise floors, is worse: thousands of samples
carry that difference."""
SMALL_EXCESS_FLOORS = 0.07
"""The same for one that leaves more on nearly every choice of motions. Of 130 hidden effects the right one
was never worse than a wrong one by more than 0.02."""
RECOVERED = 0.5
"""Share of the squared gap that the named effects must recover; less is an unknown cause."""
STRUCTURE = 0.09
"""Mean product of successive residuals in motion, in squared noise floors, from which a model lacks
something: the right ones leave 0.05 at most (the noise of the first sample, which starts a rollout)."""
STRUCTURE_SURE = 0.02
"""The same for the low end of its interval over trajectories."""
AT_FLOOR = 1.3
"""Final error, in noise floors, which no other optimum of the same model can improve much: one that another
search ends in above it is that search's failure."""
REPEATABLE = 2.0
"""Final error, in noise floors, up to which residuals are held against noise alone. A real machine that is
farther from it does not repeat its motions that well; how well is not known from one recording of each."""
FORMS = {"torque_limit", "torque_speed_limit", "torque_saturation", "supply_sag"}
"""Forms of one loss, of torque where much is asked."""
OF_THE_MACHINE = {"command_delay", "read_delay", "command_jitter", "supply_sag", "gravity_load"}
"""What all joints of a machine have or have not: its bus, its supply, gravity."""
CANCELLING = ("gravity_load", "encoder_bias")
"""Effects that hold a joint off its command at rest. Where they cancel there, they are no two causes but one
that pulls with the travel from there, a spring, which the table has not."""
CANCELLED = 0.1
"""Share of either that is left where they cancel; by chance they do so in a few of a hundred machines."""
RANDOM = "command_jitter"
"""The effect that no single prediction shows (:mod:`vd.gap.jitter`): tried last, on what is left."""
DETERMINED = ("kp", "kd", "inertia")
"""Baseline parameters that every useful excitation determines."""
WIDE = 10.0
"""Ratio of the ends of an interval from which a parameter counts as open."""


Polish = Callable[[JointFit], JointFit]
"""Fits a model to the end."""


@dataclass(frozen=True)
class Trial:
    """A candidate in one round of the selection."""

    round: int
    name: str
    fit: JointFit
    gain: float
    gain_ci: tuple[float, float]
    decision: str = "rejected"
    reason: str = ""
    placebo: bool = False


@dataclass(frozen=True)
class Accepted:
    """An effect of the final model."""

    name: str
    confidence: float
    estimates: dict[str, tuple[float, float, float]]
    """Parameter -> (value, low, high)."""
    alternatives: tuple[tuple[str, float, tuple[float, float]], ...]
    """(name, held-out RMSE, interval of the difference to this effect's), best first."""
    tied: tuple[str, ...]
    """Alternatives that this recording does not tell from it."""
    at_bound: bool
    equivalent: tuple[str, ...] = ()
    """Effects that leave the same positions whatever the motion; the name stands for them too."""
    doubt: str = ""
    """Why it is no name in spite of all."""

    @property
    def named(self) -> bool:
        """Whether it is the answer rather than one of a set."""
        return not self.tied and not self.at_bound and not self.doubt and self.confidence >= NAMED


@dataclass(frozen=True)
class Explanation:
    """What one joint lacks."""

    baseline: JointFit
    final: JointFit
    verdict: Verdict
    reason: str
    accepted: tuple[Accepted, ...] = ()
    trials: tuple[Trial, ...] = ()
    rivals: Mapping[str, Sequence[JointFit]] = field(default_factory=dict)
    """Fits with others in the place of each effect."""


@dataclass(kw_only=True)
class Judge:
    """Compares fits of one joint.

    Attributes:
        floor: Noise floor [rad].
        weights: Bootstrap weights of the trajectories [R, S].
        whole: Held-out RMSE of the baseline [rad]; what is small beside it is the model's own error.
        equivalent: Effects that one stands for, since the recording cannot tell them apart.
        without: Held-out RMSE of the present model without each of its effects [rad].
        apart: Fits with several effects in the place of one that they are together, by its name.
    """

    floor: float
    weights: np.ndarray
    whole: float = 0.0
    equivalent: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    without: dict[str, float] = field(default_factory=dict)
    apart: dict[str, JointFit] = field(default_factory=dict)

    def scores(
        self, fits: Sequence[JointFit], weights: np.ndarray | None = None, fitted: bool = False
    ) -> np.ndarray:
        """Log of held-out (or fitted) RMSE plus the price of parameters, shape [C] or [C, R]."""
        loss = np.stack([fit.sse if fitted else fit.held_out for fit in fits])
        error = np.log(np.maximum(rmse(loss, fits[0].count, weights), 1e-12))
        price = PENALTY * np.array([len(fit.x) for fit in fits], float)
        return error + (price if weights is None else price[:, None])

    def winner(self, fits: Sequence[JointFit]) -> JointFit:
        """The candidate with the best held-out score; the simpler one that it contains if that is as good.

        One with a parameter at its bound wins only if all have.
        """
        inside = [fit for fit in fits if not fit.at_bound] or list(fits)
        best = inside[int(np.argmin(self.scores(inside)))]
        at_floor = [fit for fit in inside if fit.rmse < EXPLAINED * self.floor]
        if best in at_floor:
            # Their residuals are white: samples tell more than the luck of a held-out motion.
            best = at_floor[int(np.argmin(self.scores(at_floor, fitted=True)))]
        simpler = [f for f in inside if f.effects[-1] in NESTED.get(best.effects[-1], ())]
        loose = best.effects[-1] not in FORMS
        return next((fit for fit in simpler if self.tied(best, fit, loose)[0]), best)

    def gain(self, before: JointFit, after: JointFit) -> tuple[float, tuple[float, float]]:
        """Share of the held-out RMSE removed, with its interval over trajectories."""
        old, new = (rmse(fit.held_out, fit.count, self.weights) for fit in (before, after))
        return 1.0 - after.held_out_rmse / before.held_out_rmse, interval(1.0 - new / old)

    def better(self, before: JointFit, after: JointFit, tail: float = 0.025) -> tuple[bool, str]:
        """Whether the step from one model to the larger is earned, and if not why.

        Args:
            before: The smaller model.
            after: The larger.
            tail: Share of the resamples that may see no gain.
        """
        old, new = (rmse(fit.held_out, fit.count, self.weights) for fit in (before, after))
        gain = 1.0 - after.held_out_rmse / before.held_out_rmse
        sampled = 1.0 - new / old
        if RANDOM in after.effects:
            # Its errors are not held out: what it is compared with must not gain by being so either.
            fitted = replace(before, held_out=before.sse)
            sampled = _likelihood_gain(fitted, after, self.weights)
            # The share by which the widths shrink, as the likelihood has it: on the geometric mean. The other
            # model has a width of its own for every motion here, lest chance be credited with what any excuse
            # for some of them would gain.
            own = 0.5 * after.count * np.log(np.maximum(before.sse, 1e-30) / np.maximum(after.sse, 1e-30))
            gain = 1.0 - float(np.exp(-own.sum() / after.count.sum()))
        low = float(np.quantile(sampled, tail))
        closed = before.held_out_rmse * np.sqrt(max(1.0 - (1.0 - gain) ** 2, 0.0))
        if gain < MIN_GAIN:
            return False, f"removes {100.0 * gain:.1f} % of the error, less than {100.0 * MIN_GAIN:.0f} %"
        if low <= 0.0:
            return False, "its gain over trajectories is not distinguishable from 0"
        if closed < MIN_SHARE * self.whole:
            return False, "what it removes is small beside the whole gap"
        if closed < MIN_GAIN_FLOORS * self.floor:
            return False, "what it removes is below the noise floor"
        return True, ""

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
        if winner.rmse < EXPLAINED * self.floor:
            excess = (other.rmse**2 - winner.rmse**2) / self.floor**2
            if excess > 0.0:  # what needs more parameters to do worse is no equal
                more = max(len(other.x) - len(winner.x), 0)
                excess += 2.0 * PENALTY * more * (winner.rmse / self.floor) ** 2
            if loose or excess < SMALL_EXCESS_FLOORS**2 or excess >= EXCESS_FLOORS**2:
                return excess < (EXCESS_FLOORS if loose else SMALL_EXCESS_FLOORS) ** 2, (low, high)
            return float(np.quantile(self.weights @ (other.sse - winner.sse), TIE_TAIL)) <= 0.0, (low, high)
        return float(np.quantile(error - best, TIE_TAIL)) <= 0.0, (low, high)

    def same_loss(self, name: str, mine: JointFit, fit: JointFit) -> bool:
        """Whether another form of a loss does most of what this one does in a model far from the floor.

        What such a model lacks elsewhere is more than the forms differ by, and would decide between them.
        """
        if not {name, fit.effects[-1]} <= FORMS or name not in self.without:
            return False
        gap = self.without[name] ** 2
        done, needed = gap - fit.held_out_rmse**2, gap - mine.held_out_rmse**2
        return mine.held_out_rmse > REPEATABLE * self.floor and done > RECOVERED * needed > 0.0

    def undetermined(self, fit: JointFit) -> str:
        """Which parameter of the baseline the motions leave open, in words; empty if none."""
        for key, (low, high) in intervals(fit, self.floor).items():
            if key in DETERMINED and high > WIDE * low:
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
        again: JointFit | None = None,
    ) -> Explanation:
        """Confidence, sets and verdict of the final model.

        Args:
            baseline: The model without effects.
            final: The model chosen.
            rivals: Fits with others in the place of each effect.
            trials: The evidence.
            loose: What of the baseline the motions leave open.
            refined: The final model at finer time steps, whose values are reported.
            again: The final model as another search finds it.
        """
        told = final if refined is None else refined
        spread = intervals(told, self.floor)
        accepted = []
        for name in final.effects:
            fits = rivals.get(name, [final])
            one = self.accept(final, name, fits, spread, told)
            if not one.tied:
                one = replace(one, doubt=self.disagreement(baseline, final, name, fits, again))
            accepted.append(one)
        explanation = Explanation(baseline, told, "unknown", "", tuple(accepted), tuple(trials), rivals)
        if not accepted:
            tried = [t for t in trials if not t.placebo and np.isfinite(t.gain)]
            why = tried[0].reason if tried else "there is no candidate"
            if baseline.held_out_rmse > UNEXPLAINED * self.floor:
                return replace(explanation, reason=f"a gap that no candidate explains: the best {why}")
            if loose:
                return replace(explanation, verdict="under_excited", reason=loose)
            return replace(explanation, verdict="no_gap", reason=f"no effect is significant: the best {why}")
        gap = baseline.held_out_rmse**2 - self.floor**2
        share = (baseline.held_out_rmse**2 - final.held_out_rmse**2) / max(gap, 1e-30)
        # What chance does to each sample stays, however well its size is known.
        if share < RECOVERED and RANDOM not in final.effects:
            text = f"the best candidate recovers {100.0 * share:.0f} % of the squared gap, less than half"
            return replace(explanation, reason=text)
        lack = self.lack_of_fit(told)
        if lack:
            names = " and ".join(a.name for a in accepted)
            return replace(explanation, reason=f"{names} come nearest, but {lack}: the cause is another")
        named = [a.name for a in accepted if a.named]
        if named:
            return replace(explanation, verdict="effects", reason=_explain(named))
        if all(a.at_bound for a in accepted):
            return replace(explanation, reason=f"{accepted[0].name} fits only with a parameter at its bound")
        sets = [" or ".join((a.name, *a.tied)) for a in accepted if a.tied and not a.at_bound]
        if not sets:
            doubts = [a.doubt for a in accepted if a.doubt]
            return replace(explanation, reason=(doubts or ["nothing is chosen often enough"])[0])
        return replace(explanation, verdict="ambiguous", reason=f"{'; '.join(sets)}: not told apart")

    def lack_of_fit(self, fit: JointFit) -> str:
        """Why residuals near the noise floor are more than noise, in words; empty if they are not.

        A wrong model that is flexible enough comes near the floor, and what it leaves is a function of
        the motion: successive residuals agree, where noise has no memory.
        """
        if fit.structure is None or fit.rmse > REPEATABLE * self.floor:
            return ""
        products, count = fit.structure / np.array([[self.floor**2], [1.0]])
        if count.sum() <= 0.0:
            return ""
        mean = float(products.sum() / count.sum())
        drawn = (self.weights @ products) / np.maximum(self.weights @ count, 1.0)
        sure = float(np.quantile(drawn, 0.025))
        small = mean < (MIN_SHARE * self.whole / self.floor) ** 2
        if mean < STRUCTURE or sure < STRUCTURE_SURE or small:
            return ""
        return f"what is left has structure ({np.sqrt(mean):.2f} noise floors that are not noise)"

    def disagreement(
        self,
        baseline: JointFit,
        final: JointFit,
        name: str,
        rivals: Sequence[JointFit],
        again: JointFit | None,
    ) -> str:
        """Why two searches for the final model contradict each other about an effect, or nothing.

        Its gain is what it leaves less than the next best that is no form of it.
        """
        if again is None or final.rmse < AT_FLOOR * self.floor:
            return ""
        same = {name, *NESTED.get(name, ()), *(k for k, simpler in NESTED.items() if name in simpler)}
        without = [fit.rmse for fit in rivals if fit is not final and not same & set(fit.effects[-1:])]
        gain = min([baseline.rmse, *without]) - final.rmse
        apart = abs(again.rmse - final.rmse)
        if apart <= max(gain, 0.0) or gain <= 0.0:
            return ""
        return (
            f"two searches for {name} end {1e3 * apart:.2f} mrad apart, more than the {1e3 * gain:.2f} mrad "
            "that it gains"
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
        others = [fit for fit in rivals if fit is not mine and fit.effects[-1] != name]
        white = mine.rmse < EXPLAINED * self.floor
        choice = np.argmin(self.scores([mine, *others], self.weights, fitted=white), axis=0)
        simple = {i + 1 for i, fit in enumerate(others) if name in NESTED.get(fit.effects[-1], ())}
        share = float(np.mean([c == 0 or c in simple for c in choice]))
        alternatives, tied = [], []
        for fit in sorted(others, key=lambda other: other.held_out_rmse):
            other = fit.effects[-1]
            same, ci = self.tied(mine, fit)
            alternatives.append((other, fit.held_out_rmse, ci))
            if same or self.same_loss(name, mine, fit):
                tied.append(other)
        # In a tie the simpler one is meant: none beside an effect that it contains.
        # A fuller form of a loss stays in the set if it is better, by too little to be the name.
        fuller = {
            fit.effects[-1]
            for fit in others
            if {name, fit.effects[-1]} <= FORMS
            and mine.rmse**2 - fit.rmse**2 > (SMALL_EXCESS_FLOORS * self.floor) ** 2
        }
        tied = [o for o in tied if o in fuller or not {name, *tied} & set(NESTED.get(o, ()))]
        if share < NAMED and not tied:
            rival = int(np.argmax(np.bincount(choice, minlength=len(others) + 1)[1:]))
            tied.append(others[rival].effects[-1])
        split, means = self.apart.get(name), tuple(self.equivalent.get(name, ()))
        if split is not None and {*split.effects} > {*final.effects} - {name}:
            same, _ = self.tied(mine, split, loose=True)
            means += tuple(other for other in split.effects if same and other not in final.effects)
        return Accepted(
            name=name,
            confidence=share,
            estimates=_estimates(told, name, spread),
            equivalent=means,
            alternatives=tuple(alternatives),
            tied=tuple(tied),
            at_bound=any(key.startswith(f"{name}.") for key in final.at_bound),
        )


def _explain(names: Sequence[str]) -> str:
    return f"{' and '.join(names)} {'explains' if len(names) == 1 else 'explain'} it"


def _likelihood_gain(before: JointFit, after: JointFit, weights: np.ndarray) -> np.ndarray:
    """Gain in log-likelihood of a model with chance in it over one without, per resample.

    What chance moves is in few motions, whose squared errors would decide all; their likelihood, of a
    width that follows the motion, weighs every sample by how surely it is known.
    """
    count = before.count
    square = before.held_out.sum() / count.sum()
    old = 0.5 * (count * np.log(square) + before.held_out / square)
    if RANDOM in before.effects:
        old = 0.5 * count * (np.log(before.held_out / count) + 1.0)
    spread = 0.5 * count * (np.log(after.held_out / count) + 1.0)
    return weights @ (old - spread)


def alike(names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The candidates that stand for others of the candidates, and for which."""
    return {
        name: inside
        for name, others in EQUIVALENT.items()
        if name in names and (inside := tuple(other for other in others if other in names))
    }


def stood_for(equivalent: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Candidates that another stands for, with the reason why they are not tried."""
    return {
        other: f"leaves the same positions as {name}, which stands for both"
        for name, others in equivalent.items()
        for other in others
    }


def intervals(fit: JointFit, floor: float) -> dict[str, tuple[float, float]]:
    """95 % intervals by key: the spread over trajectories, and the error of the time step."""
    matrix = covariance(fit.gram, fit.gradient, np.full(len(fit.x), RIDGE * floor**2), floor)
    width = half_width(np.diag(matrix), len(fit.gram))
    if fit.step_error is not None:
        width = np.hypot(width, fit.step_error)
    result = {}
    for c, x, w in zip(fit.coordinates, fit.x, width, strict=True):
        low, high = max(x - w, c.lower), min(x + w, c.upper)
        result[c.key] = float(c.value(low)), float(c.value(high))
    return {**result, **(fit.extents or {})}


def share(
    explanations: Sequence[Explanation],
    floors: Sequence[float],
    groups: Sequence[int] | None = None,
    polish: Sequence[Polish] | None = None,
) -> list[Explanation]:
    """Name on a joint that member of a set which another joint names, or which all such sets share.

    The joints of a finger are built alike: one cause on all of them is simpler than another on each. Joints
    that have nothing in common but the machine share its bus, its supply, and that it stands in gravity, but
    not the friction or the play of one gear.

    Args:
        explanations: Of the joints.
        floors: Their noise floors [rad].
        groups: Number of the finger of each joint; one for all if None.
        polish: Of each joint: fits a member of a set to the end, which the search for the best one did not.
    """
    fingers = [0] * len(explanations) if groups is None else groups
    result = []
    finish = [_as_it_is] * len(explanations) if polish is None else polish
    for explanation, floor, finger, end in zip(explanations, floors, fingers, finish, strict=True):
        alike = [e for e, other in zip(explanations, fingers, strict=True) if other == finger]
        named = _named(alike) | (_named(explanations) & OF_THE_MACHINE)
        result.append(_adopt(explanation, named, floor, end))
    return result


def _as_it_is(fit: JointFit) -> JointFit:
    return fit


def _named(explanations: Sequence[Explanation]) -> set[str]:
    """What some joint names, and the only effect that is in the set of every joint that has one set."""
    named = {a.name for e in explanations for a in e.accepted if a.named}
    open_sets = [[{a.name, *a.tied} for a in e.accepted if a.tied and not a.at_bound] for e in explanations]
    sets = [of_joint[0] for of_joint in open_sets if len(of_joint) == 1]
    if len(sets) > 1:
        common = set.intersection(*sets)
        named |= common if len(common) == 1 else set()
    return named


def _adopt(explanation: Explanation, named: set[str], floor: float, polish: Polish) -> Explanation:
    """One joint's explanation with what the other joints name in the place of its sets.

    A set stays where that model is worse by as much as an effect must gain.
    """
    final, accepted = explanation.final, list(explanation.accepted)
    for i, own in enumerate(accepted):
        others = [name for name in own.tied if name in named]
        if not own.tied or own.at_bound or (own.name not in named and len(others) != 1):
            continue
        if own.name not in named:
            fits = explanation.rivals.get(own.name, ())
            fit = next((fit for fit in fits if fit.effects[-1] == others[0]), None)
            if fit is None or set(fit.effects) != {*final.effects, others[0]} - {own.name}:
                continue
            fit = polish(fit)
            if fit.held_out_rmse * (1.0 - MIN_GAIN) > final.held_out_rmse:
                continue
            final = fit
            own = replace(own, name=others[0])
        accepted[i] = replace(own, tied=(), confidence=max(own.confidence, NAMED))
    if final is not explanation.final:
        spread = intervals(final, floor)
        accepted = [replace(a, estimates=_estimates(final, a.name, spread)) for a in accepted]
    verdict, reason = explanation.verdict, explanation.reason
    names = [a.name for a in accepted if a.named]
    if verdict == "ambiguous" and names:
        verdict, reason = "effects", f"{_explain(names)}, as on the other joints"
    return replace(explanation, final=final, accepted=tuple(accepted), verdict=verdict, reason=reason)


def cancelled(fit: JointFit, joint: int, rest: float) -> str:
    """What two effects of a model are instead if they cancel at rest, in words; empty if they do not.

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
    if abs(offset - load) > CANCELLED * min(abs(load), abs(offset)):
        return ""
    return (
        "gravity_load and encoder_bias cancel where the joint rests: a spring about that place would look "
        "the same, and is not among the candidates"
    )


def polished(explanation: Explanation, fit: JointFit, floor: float) -> Explanation:
    """The explanation with its final model fitted anew."""
    spread = intervals(fit, floor)
    accepted = tuple(replace(a, estimates=_estimates(fit, a.name, spread)) for a in explanation.accepted)
    return replace(explanation, final=fit, accepted=accepted)


def _estimates(
    final: JointFit, name: str, spread: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float, float]]:
    """Parameters of an effect with their intervals."""
    return {
        p.name: (final.values[f"{name}.{p.name}"], *spread[f"{name}.{p.name}"])
        for p in EFFECTS[name].parameters
        if f"{name}.{p.name}" in final.values
    }
