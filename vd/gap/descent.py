"""Least squares from several starts, by scipy's trust-region method."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from vd.gap.coordinates import Coordinate

SHORT = 4
"""Trials after which the worse half of several starts ends, and of a refit near its start. Not
tuned.
"""
WIDEN = -3.0
"""Factor on the finite-difference steps of a second descent: dry friction and limits make the
squared error rugged at the scale of the first one's. Less than 0: to the other side. Without the
second descent a limit of 10 comes out as 10.19; other factors were not tried."""
TOLERANCE = 1e-4
"""Relative improvement of the squared error at which a fit has converged. Not tuned."""

Residuals = Callable[[np.ndarray, np.ndarray | None], np.ndarray]
"""Residuals [C, N] of coordinates [C, P], those of trajectories that a mask [S] leaves out being
0.
"""


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """A squared error to be made small.

    Attributes:
        coordinates: The P coordinates.
        residuals: Simulates.
        ridge: Pull of the coordinates to their start [rad^2].
        slopes: Simulates for Jacobians, which may come from a coarser simulation.
    """

    coordinates: Sequence[Coordinate]
    residuals: Residuals
    ridge: float
    slopes: Residuals

    def jacobian(
        self, x: np.ndarray, keep: np.ndarray | None = None, widen: float = 1.0
    ) -> np.ndarray:
        """d(predicted)/dx [P, N] at coordinates [P] by one-sided differences, their steps times a factor."""
        steps = np.array([c.step(v, widen) for c, v in zip(self.coordinates, x, strict=True)])
        moved = np.vstack([x, x + np.diag(steps)])
        answers = self.slopes(moved, keep)
        return (answers[0] - answers[1:]) / steps[:, None]

    def descend(
        self,
        start: np.ndarray,
        iterations: int,
        keep: np.ndarray | None = None,
        slopes: np.ndarray | None = None,
        widen: float = 1.0,
    ) -> np.ndarray:
        """Coordinates [P] of a local minimum.

        Args:
            start: Where to start [P].
            iterations: Trials at most.
            keep: Trajectories that count [S]; all by default.
            slopes: A Jacobian [P, N] to keep.
            widen: Factor on finite-difference steps.
        """
        pull = np.sqrt(self.ridge)

        def residuals(moved: np.ndarray) -> np.ndarray:
            return np.concatenate([self.residuals((start + moved)[None], keep)[0], pull * moved])

        def jacobian(moved: np.ndarray) -> np.ndarray:
            own = self.jacobian(start + moved, keep, widen) if slopes is None else slopes
            return np.vstack([-own.T, pull * np.eye(len(start))])

        lower = np.array([c.lower for c in self.coordinates]) - start
        upper = np.array([c.upper for c in self.coordinates]) - start
        found = least_squares(
            residuals,
            np.zeros(len(start)),
            jacobian,
            bounds=(lower, upper),
            x_scale="jac",
            ftol=TOLERANCE,
            gtol=None,
            max_nfev=iterations,
        )
        return np.clip(start + found.x, start + lower, start + upper)

    def best(self, starts: np.ndarray, iterations: int) -> np.ndarray:
        """Coordinates [P] of the least minimum from several starts [B, P].

        The worse half ends early.
        """
        x = list(starts)
        while len(x) > 1:
            x = [self.descend(one, SHORT) for one in x]
            costs = [float(np.sum(self.residuals(one[None], None) ** 2)) for one in x]
            x = [x[i] for i in np.argsort(costs)[: (len(x) + 1) // 2]]
        return self.descend(self.descend(x[0], iterations), iterations, widen=WIDEN)
