"""The last word on the model that a search ends with: confidence, sets of equals, and the verdict."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

import vd.kernels.servo.actuators as servo
from vd.gap.explanation import NAMED, Accepted, Explanation, Trial, estimates, intervals
from vd.gap.joint_fit import DRY, ONE_SIDED, JointFit
from vd.gap.judge import (
    JITTER,
    NESTED,
    RECOVERED,
    REPEATABLE,
    Judge,
)
from vd.gap.warming import warming
from vd.kernels.servo.effects import BESIDE, TOGETHER

UNEXPLAINED = 1.5
"""A baseline beyond this factor of the noise floor has a gap, whether or not an effect explains it."""
CANCELLING = ("gravity_load", "encoder_bias")
"""Effects that hold a joint off its command at rest. Where they cancel there, they are no two causes but one
that pulls with the travel from there, a spring, which the table has not."""
CANCELLED = 0.1
"""Share of either that is left where they cancel; by luck they do so in a few of a hundred machines."""
DETERMINED = ("kp", "kd", "inertia")
"""Baseline parameters that every useful excitation determines."""
WIDE = 10.0
"""Ratio of the ends of an interval from which a parameter counts as open."""


@dataclass(kw_only=True)
class Verdicts(Judge):
    """Judges the final model of one joint.

    Attributes:
        equivalent: Effects that one stands for, since the recording cannot tell them apart.
        joint: Index of the joint in its chain.
        when: Time of each trajectory [S] [s]; None where it is not known.
    """

    equivalent: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    joint: int = 0
    when: np.ndarray | None = None

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
        explanation = Explanation(baseline, told, "unknown", "", tuple(accepted), tuple(trials), rivals)
        if not accepted:
            return self.nothing_earned(explanation, loose)
        # One motion can be all that shows a parameter: that no fit without it predicts it says nothing then.
        fitted = self.white(final) and not self.behind_jitter
        before, after = ((f.rmse if fitted else f.held_out_rmse) ** 2 for f in (baseline, final))
        share = (before - after) / max(before - self.floor**2, 1e-30)
        # What jitter does to each sample stays, however well its size is known.
        if share < RECOVERED and JITTER not in final.effects:
            text = f"the best candidate recovers {100.0 * share:.0f} % of the squared gap, less than half"
            return replace(explanation, reason=text)
        warms = self.warms(told)
        if warms:
            text = f"{warms}: the cause is a friction that changes, as with temperature"
            return replace(explanation, warms=True, reason=text)
        return _by_names(explanation)

    def nothing_earned(self, explanation: Explanation, loose: str) -> Explanation:
        """The verdict where no effect earned its place."""
        tried = [t for t in explanation.trials if not t.placebo and np.isfinite(t.gain)]
        why = tried[0].reason if tried else "there is no candidate"
        if explanation.baseline.held_out_rmse > UNEXPLAINED * self.floor:
            return replace(explanation, reason=f"a gap that no candidate explains: the best {why}")
        if loose:
            return replace(explanation, verdict="under_excited", reason=loose)
        return replace(explanation, verdict="no_gap", reason=f"no effect is significant: the best {why}")

    def warms(self, fit: JointFit) -> str:
        """Which friction of a model near the floor changes over the recording, in words, or nothing."""
        if self.when is None or self.behind_jitter or fit.rmse > REPEATABLE * self.floor:
            return ""
        return warming(fit, self.when, self.floor)

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
        others = [fit for fit in rivals if fit is not mine and fit.effects[-1] not in (name, *means)]
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
            pull = abs(final.values["encoder_bias.bias_rad"]) * float(final.rows[self.joint, servo.KP])
            same = [other for other in same if other != ONE_SIDED or pull <= level]
        return tuple(same)


def _by_names(explanation: Explanation) -> Explanation:
    """The verdict by what of a model that fits is named, or a set, or neither."""
    accepted = explanation.accepted
    named = [a.name for a in accepted if a.named]
    if named:
        return replace(explanation, verdict="effects", reason=explains(named))
    if all(a.at_bound for a in accepted):
        return replace(explanation, reason=f"{accepted[0].name} fits only with a parameter at its bound")
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
