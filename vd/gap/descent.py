"""Levenberg-Marquardt from several starts in lockstep: a step simulates all of them in two calls."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from vd.gap.coordinates import Coordinate

LAMBDAS = np.array([0.1, 1.0, 10.0])
"""Factors on the damping that are tried in each step; the others only where the first gains less than ..."""
ENOUGH = 0.5
"""... this share of what the linear model promises."""
FIRST_DAMPING = 1e-3
LEAST_DAMPING = 1e-7
WIDEN = -3.0
"""Factor on the finite-difference steps after a step that fails, with the other sign: dry friction makes
the squared error rugged at the scale of the smallest steps."""
FAILURES = 4
"""Failed steps in a row that end a fit; one of which nothing was expected counts twice."""
RACE_EVERY = 2
"""Iterations after which descents that are only there to find the best start are compared."""
RACE_LAG = 1.3
"""Error beyond which, in that of the best, at most half of the descents go on."""
SAME_COST, SAME_PLACE = 1e-3, 0.02
"""Relative difference of cost and largest difference of coordinates of descents that have met."""
LOG_TRUST = 1.5
"""Largest change of a logarithmic coordinate in one step."""
LINEAR_TRUST = 5.0
"""Largest change of a linear coordinate in one step, plus its size."""
TOLERANCE = 1e-4
"""Relative improvement of the squared error at which a fit has converged."""

Residuals = Callable[[np.ndarray, np.ndarray | None], np.ndarray]
"""Residuals [C, N] of coordinates [C, P], those of trajectories that a mask [C, S] leaves out being 0."""


@dataclass(frozen=True, eq=False)
class Descent:
    """Where B descents are; P coordinates, N samples.

    Attributes:
        x: Coordinates [B, P].
        residual: Measured minus predicted [B, N].
        jacobian: d(predicted)/dx at or near ``x``, shape [B, P, N].
    """

    x: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray

    def at(self, index: int, copies: int) -> "Descent":
        """One of them, ``copies`` times."""
        return Descent(*(np.repeat(a[index : index + 1], copies, 0) for a in vars(self).values()))


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """A squared error to be made small.

    Attributes:
        coordinates: The P coordinates.
        residuals: Simulates.
        ridge: Pull of the coordinates to their start [rad^2].
        slopes: Simulates for Jacobians, if they may come from a coarser simulation.
    """

    coordinates: Sequence[Coordinate]
    residuals: Residuals
    ridge: float
    slopes: Residuals | None = None

    def jacobian(
        self,
        x: np.ndarray,
        residual: np.ndarray,
        widened: np.ndarray | None = None,
        keep: np.ndarray | None = None,
    ) -> np.ndarray:
        """d(predicted)/dx by one-sided differences.

        Args:
            x: Coordinates [B, P].
            residual: Residuals there [B, N].
            widened: Factors on the steps [B].
            keep: Trajectories that count [B, S].

        Returns:
            Shape [B, P, N].
        """
        size = x.shape[1]
        factor = np.ones(len(x)) if widened is None else widened
        steps = np.stack([c.step(x[:, i], factor) for i, c in enumerate(self.coordinates)], axis=1)
        moved = np.repeat(x[:, None], size, axis=1)
        moved[:, np.arange(size), np.arange(size)] += steps
        simulate = self.residuals if self.slopes is None else self.slopes
        if self.slopes is not None:
            residual = self.slopes(x, keep)
        answers = simulate(moved.reshape(-1, size), _repeat(keep, size)).reshape(len(x), size, -1)
        np.subtract(residual[:, None], answers, out=answers)
        answers /= steps[:, :, None]
        return answers

    def descend(
        self,
        x: np.ndarray,
        iterations: int,
        *,
        keep: np.ndarray | None = None,
        known: Descent | None = None,
        race: bool = False,
        chord: bool = False,
    ) -> Descent:
        """Descend.

        Args:
            x: Starts [B, P].
            iterations: Steps at most.
            keep: Trajectories that count in each [B, S]; all by default.
            known: Residuals and Jacobians at the starts.
            race: Only the best is wanted: the others end once they meet it or fall behind.
            chord: The end is near: Jacobians are kept until a step falls short of what they promise, and a
                step of which nothing is expected is the last.

        Returns:
            The ends; their Jacobians are those of the last steps.
        """
        lower = np.array([c.lower for c in self.coordinates])
        upper = np.array([c.upper for c in self.coordinates])
        logarithmic = np.array([c.log for c in self.coordinates])
        x, origin = x.copy(), x.copy()
        residual = known.residual if known is not None else self.residuals(x, keep)
        jacobian = np.zeros((*x.shape, residual.shape[1])) if known is None else known.jacobian
        cost = np.einsum("bn,bn->b", residual, residual)
        damping, failures = np.full(len(x), FIRST_DAMPING), np.zeros(len(x), int)
        active, stale = np.arange(len(x)), np.full(len(x), known is None)
        for number in range(iterations):
            here, kept = x[active], None if keep is None else keep[active]
            renewed = active[stale[active]]
            if len(renewed):
                theirs = None if keep is None else keep[renewed]
                widened = WIDEN ** failures[renewed]
                jacobian[renewed] = self.jacobian(x[renewed], residual[renewed], widened, theirs)
            slopes = jacobian[active]
            gram = slopes @ slopes.transpose(0, 2, 1) + self.ridge * np.eye(x.shape[1])
            gradient = np.einsum("bpn,bn->bp", slopes, residual[active])
            gradient -= self.ridge * (here - origin[active])
            free = ~(((here <= lower) & (gradient < 0.0)) | ((here >= upper) & (gradient > 0.0)))
            step = _steps(gram, gradient, free, damping[active, None] * LAMBDAS)
            limit = np.where(logarithmic, LOG_TRUST, LINEAR_TRUST + np.abs(here))[:, None]
            trials = np.clip(here[:, None] + np.clip(step, -limit, limit), lower, upper)
            moved = trials - here[:, None]
            promised = 2.0 * (moved @ gradient[:, :, None])[..., 0]
            promised -= np.einsum("blp,bpq,blq->bl", moved, gram, moved)
            costs, best = np.full(trials.shape[:2], np.inf), np.empty((len(active), residual.shape[1]))
            self._try(trials, origin[active], kept, np.arange(len(active)), slice(0, 1), costs, best)
            flat = promised[:, 0] < TOLERANCE * cost[active]
            short = cost[active] - costs[:, 0] < ENOUGH * promised[:, 0]
            again = np.flatnonzero(short & ~flat if chord else short)
            if len(again):
                self._try(trials, origin[active], kept, again, slice(1, None), costs, best)
            chosen, each = np.argmin(costs, axis=1), np.arange(len(active))
            gain = (cost[active] - costs[each, chosen]) / np.maximum(cost[active], 1e-300)
            better = gain > 0.0
            won, lost = active[better], active[~better]
            x[won], residual[won] = trials[each, chosen][better], best[better]
            cost[won] = costs[each, chosen][better]
            damping[won] = np.maximum(damping[won] * LAMBDAS[chosen[better]] * 0.3, LEAST_DAMPING)
            damping[lost] *= 3.0
            least = FAILURES if chord else 2
            failures[active] = np.where(gain > TOLERANCE, 0, failures[active] + np.where(flat, least, 1))
            stale[active] = short if chord else True
            active = active[failures[active] < FAILURES]
            if race and number % RACE_EVERY == RACE_EVERY - 1:
                active = _leaders(active, x, cost)
            if not len(active):
                break
        return Descent(x, residual, jacobian)

    def _try(
        self,
        trials: np.ndarray,
        origin: np.ndarray,
        keep: np.ndarray | None,
        which: np.ndarray,
        tries: slice,
        costs: np.ndarray,
        best: np.ndarray,
    ) -> None:
        """Simulate some trials of some descents: their costs [B, L], and the residuals of the best so far."""
        given = trials[which, tries]
        size = given.shape[1]
        kept = _repeat(None if keep is None else keep[which], size)
        answers = self.residuals(given.reshape(-1, trials.shape[2]), kept)
        squares = np.einsum("cn,cn->c", answers, answers).reshape(-1, size)
        squares += self.ridge * ((given - origin[which, None]) ** 2).sum(2)
        before = costs[which].min(axis=1)
        costs[which, tries] = squares
        winner = np.argmin(squares, axis=1)
        better = squares[np.arange(len(which)), winner] < before
        best[which[better]] = answers.reshape(len(which), size, -1)[np.arange(len(which)), winner][better]


def _leaders(active: np.ndarray, x: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """The descents that still race: none that has met a better one, nor one of the slower half far behind."""
    order = active[np.argsort(cost[active])]
    kept: list[int] = []
    best = float(cost.min())
    for b in order:
        near = (cost[b] - cost < SAME_COST * cost[b]) & (np.abs(x - x[b]).max(axis=1) < SAME_PLACE)
        met = bool((near & ((cost < cost[b]) | ((cost == cost[b]) & (np.arange(len(cost)) < b)))).any())
        behind = cost[b] > RACE_LAG**2 * best and len(kept) >= (len(order) + 1) // 2
        if not met and not behind:
            kept.append(int(b))
    return np.sort(np.array(kept, int))


def _repeat(keep: np.ndarray | None, times: int) -> np.ndarray | None:
    return None if keep is None else np.repeat(keep, times, axis=0)


def _steps(gram: np.ndarray, gradient: np.ndarray, free: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Damped steps of the free coordinates, 0 of the others.

    Args:
        gram: Normal matrices [B, P, P].
        gradient: Right sides [B, P].
        free: Which coordinates may move [B, P].
        damping: Factors on the diagonal that are added [B, L].

    Returns:
        Shape [B, L, P].
    """
    size = gram.shape[1]
    diagonal = np.einsum("bpp->bp", gram)[:, None] * damping[:, :, None]
    system = gram[:, None] + diagonal[..., None] * np.eye(size)
    both = free[:, None, :, None] & free[:, None, None, :]
    system = np.where(both, system, np.eye(size))
    right = np.where(free, gradient, 0.0)[:, None, :, None]
    return np.linalg.solve(system, np.broadcast_to(right, (*system.shape[:3], 1)))[..., 0]
