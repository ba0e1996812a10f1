"""A model of one joint as a fit leaves it, and how samples are weighted in one."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vd.gap.coordinates import Coordinate
from vd.gap.statistics import OWN_ERROR, rmse

ONE_SIDED, DRY = "asymmetric_friction", ("coulomb_friction", "stribeck_friction")
"""The friction that can have a direction without any, and those that fill it up."""


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

    @property
    def at_bound(self) -> tuple[str, ...]:
        """Keys of effect parameters that ended at a bound."""
        pairs = zip(self.coordinates, self.x, strict=True)
        bound = [c.key for c, x in pairs if "." in c.key and c.bound(float(x))]
        if ONE_SIDED in self.effects and not set(DRY) & set(self.effects):
            # No dry friction spares one direction: what does is a load, and a greater one would
            # push.
            sides = {key: value for key, value in self.values.items() if key.startswith(ONE_SIDED)}
            bound += [
                key for key, value in sides.items() if value <= OWN_ERROR * max(sides.values())
            ]
        return tuple(bound)


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
