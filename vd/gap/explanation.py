"""What the search for what a joint lacks has found.

The evidence, effects with intervals, the verdict.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

import vd.kernels.servo.actuators as servo
from vd.gap.fit import RIDGE
from vd.gap.joint_fit import JointFit
from vd.gap.result import Verdict
from vd.gap.statistics import OWN_ERROR, half_width
from vd.kernels.servo.effects import EFFECTS

CLOSE = 0.1
"""Two values within this share of each other are one: of an effect on two joints, as what a model
lacks moves them by more than their intervals tell; of a load and an offset that cancel, which by
luck few in a hundred machines do; of a supply idle and under load. Not tuned."""
NAMED = 0.9
"""Share of the resamples that must choose an effect for it to be named. Not tuned."""


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
        """Whether the interval of its size leaves out its absence.

        Several sizes stand in for each other.

        Absence is 0, but infinity of a limit or a stiffness: its inverse is more than 0 for sure if
            half
        the interval of its logarithm is less than 1, to first order.
        """
        known = {
            p.name: p for p in EFFECTS[self.name].parameters if p.column != servo.GRAVITY_PHASE
        }
        told = [(known[key], *estimate) for key, estimate in self.estimates.items() if key in known]
        limits = [high < np.e * value for p, value, _, high in told if p.lower > 0.0 == p.neutral]
        sizes = limits or [not low <= 0.0 <= high for p, _, low, high in told if p.lower == 0.0]
        return len(sizes) != 1 or sizes[0]


@dataclass(frozen=True)
class Explanation:
    """What one joint lacks."""

    baseline: JointFit
    final: JointFit
    verdict: Verdict
    reason: str
    accepted: tuple[Accepted, ...] = ()
    trials: tuple[Trial, ...] = ()


def intervals(fit: JointFit, floor: float) -> dict[str, tuple[float, float]]:
    """95 % intervals by key.

    Of the jackknife over folds, or of white noise at the floor if that is wider.

    To these come the error of the time step and the model's own, which all motions share.
    """
    folds, ridge = len(fit.refits), RIDGE * floor**2 * np.eye(len(fit.x))
    white = floor**2 * np.diag(np.linalg.inv(fit.gram + ridge))
    width = half_width(np.maximum((folds - 1) * fit.refits.var(axis=0), white), folds)
    sizes = np.array([1.0 if c.log else x for c, x in zip(fit.coordinates, fit.x, strict=True)])
    width = np.hypot(width, half_width((OWN_ERROR * sizes) ** 2, np.inf))
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
