"""Models of one joint as a search leaves them: fits, candidates that were tried, what is concluded."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vd.gap.coordinates import Coordinate
from vd.gap.result import Verdict
from vd.gap.statistics import OWN_ERROR, half_width, rmse
from vd.kernels.servo.effects import EFFECTS

RIDGE = 0.01
"""Pull towards the start, as information in units of the noise floor: holds directions that the
data leave free (the torque scale of a bare servo), moves no others. Not tuned."""


@dataclass(frozen=True, eq=False)
class JointFit:
    """A fitted model of one joint; S trajectories, P parameters.

    Attributes:
        effects: Names of the effects in the model.
        coordinates: What was fitted.
        x: Fitted coordinates [P].
        rows: Parameter rows of the chain's joints, shape [n, PARAMETER_COLUMNS].
        sse: Sum of squared errors of each trajectory [S] [rad^2].
        held_out: The same, each trajectory predicted by a fit without its group [S].
        count: Samples of each trajectory [S].
        gram: J^T J [P, P].
        refits: Coordinates of the fits without each fold [F, P].
        held_out_abs: Sum of absolute errors of held-out trajectories [S] [rad]; None where not
            taken.
        extents: 95 % intervals by key, of parameters for which the refits do not give them.
        step_error: What the time step of the rollouts leaves open in ``x`` [P]; None where not
            estimated.
    """

    effects: tuple[str, ...]
    coordinates: tuple[Coordinate, ...]
    x: np.ndarray
    rows: np.ndarray
    sse: np.ndarray
    held_out: np.ndarray
    count: np.ndarray
    gram: np.ndarray
    refits: np.ndarray
    held_out_abs: np.ndarray | None = None
    step_error: np.ndarray | None = None
    extents: Mapping[str, tuple[float, float]] | None = None

    @property
    def values(self) -> dict[str, float]:
        """Parameter values by key."""
        return {c.key: float(c.value(x)) for c, x in zip(self.coordinates, self.x, strict=True)}

    @property
    def rmse(self) -> float:
        """RMSE on what was fitted [rad]."""
        return float(rmse(self.sse, self.count))

    @property
    def held_out_rmse(self) -> float:
        """RMSE on held-out trajectories [rad]."""
        return float(rmse(self.held_out, self.count))


@dataclass(frozen=True, eq=False)
class SampleWeighting:
    """The mean and the spread that random delays, or errors of the clock, add to N samples.

    A sample counts by how surely it is known: a residual, less the mean of what delays do, is
    divided by the growth of its standard deviation. What a right model leaves is the noise floor
    again.

    Attributes:
        shift: Mean change of the position [N] [rad].
        growth: Standard deviation with them, in that of the noise alone [N].
    """

    shift: np.ndarray
    growth: np.ndarray


@dataclass(frozen=True)
class Telemetry:
    """What the recorded voltage and duty cycle of a joint say.

    Attributes:
        fall: How far the voltage falls at full pull, and its value idle [V]; None where too little
            is recorded.
        follows: Share of the duty cycle that follows the plain error; 0 where none is recorded.
        late: Delay [s] with which it is followed best, and the share that this leaves, if the
            command is late (``command_delay``) or the reading (``read_delay``).
        sample_s: Time between two samples [s].
    """

    fall: tuple[float, float] | None
    follows: float
    late: Mapping[str, tuple[float, float]]
    sample_s: float


@dataclass(frozen=True)
class TriedEffect:
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


@dataclass(frozen=True)
class Explanation:
    """What one joint lacks."""

    baseline: JointFit
    final: JointFit
    verdict: Verdict
    reason: str
    accepted: tuple[Accepted, ...] = ()
    trials: tuple[TriedEffect, ...] = ()


def intervals(fit: JointFit, floor: float) -> dict[str, tuple[float, float]]:
    """95 % intervals by key.

    Of the jackknife over folds, or of white noise at the floor if that is wider.

    To these come the error of the time step and the model's own, which all motions share.
    """
    folds = len(fit.refits)
    ridge = RIDGE * floor**2 * np.eye(len(fit.x))
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
