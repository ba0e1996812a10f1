"""What the search for what a joint lacks has found: the evidence, effects with intervals, the verdict."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

import vd.kernels.servo.actuators as servo
from vd.gap.fit import RIDGE
from vd.gap.joint_fit import JointFit, SampleWeighting
from vd.gap.result import Verdict
from vd.gap.statistics import covariance, half_width
from vd.kernels.servo.effects import EFFECTS

NAMED = 0.9
"""Share of the resamples that must choose an effect for it to be named."""


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

    @property
    def named(self) -> bool:
        """Whether it is the answer rather than one of a set."""
        return not self.tied and not self.at_bound and self.shown and self.confidence >= NAMED

    @property
    def shown(self) -> bool:
        """Whether the interval of its size is sure of some of it; several sizes stand in for each other."""
        parameters = {p.name: p for p in EFFECTS[self.name].parameters if p.column != servo.GRAVITY_PHASE}
        if any(p.lower > 0.0 == p.neutral for p in parameters.values()):
            return True  # its absence is no value of it
        sizes = [v for key, v in self.estimates.items() if key in parameters and parameters[key].lower == 0.0]
        return len(sizes) != 1 or not sizes[0][1] <= 0.0 <= sizes[0][2]


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
    weighting: SampleWeighting | None = None
    """How the samples were weighted; errors of the fits are in what it weighs them by."""
    warms: bool = False
    """Whether a friction of the final model changes over the recording, as none of the table does."""


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


def estimates(
    final: JointFit, name: str, spread: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float, float]]:
    """Parameters of an effect with their intervals."""
    return {
        p.name: (final.values[f"{name}.{p.name}"], *spread[f"{name}.{p.name}"])
        for p in EFFECTS[name].parameters
        if f"{name}.{p.name}" in final.values
    }


def polished(explanation: Explanation, fit: JointFit, floor: float) -> Explanation:
    """The explanation with its final model fitted anew."""
    spread = intervals(fit, floor)
    accepted = tuple(replace(a, estimates=estimates(fit, a.name, spread)) for a in explanation.accepted)
    return replace(explanation, final=fit, accepted=accepted)
