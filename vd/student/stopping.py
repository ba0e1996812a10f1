"""When the student stops: its own predicted distance is small, and so is its action (Methods, stopping)."""

from dataclasses import dataclass

import numpy as np
import torch

from vd.paper import PAPER


@dataclass(frozen=True)
class StoppingRule:
    """Stop at the first step at which the predicted distance and the norm of the action are below bounds.

    Both are of the same moment: the prediction from what is seen, and the smoothed action that led there.
    Before the first action there is none, and nothing to stop.
    """

    distance_rad: float = PAPER.success.rotation_rad
    """Bound of the predicted rotation distance, theta-bar [rad]."""
    action_norm: float = PAPER.success.action_norm
    """Bound of the norm of the smoothed action, a-bar."""

    def stops(self, predicted: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Where to stop: predicted distances [...] [rad], smoothed actions [..., D] give booleans [...]."""
        return (predicted < self.distance_rad) & (action.norm(dim=-1) < self.action_norm)


@dataclass(frozen=True)
class Calibration:
    """A rule, and what it gave on the episodes it was chosen on."""

    rule: StoppingRule
    tolerance_rad: float
    """Largest true distance that counts as right [rad]."""
    success: float
    """Share of episodes that stop within the tolerance."""
    wrong: float
    """Share of episodes that stop outside of it."""
    reachable: float
    """Share of episodes in which some step would have been right to stop at by the true distance."""
    episodes: int
    """Number of episodes."""


def calibrate(
    predicted: np.ndarray,
    action_norm: np.ndarray,
    true: np.ndarray,
    alive: np.ndarray,
    *,
    tolerance_rad: float = PAPER.success.rotation_rad,
    candidates: int = 24,
) -> Calibration:
    """Choose both bounds so that most episodes stop within the tolerance.

    Bounds are tried on a grid: distances up to twice the tolerance, and quantiles of the action norms while
    the object is within it. Among equal success the rule that stops wrongly less often wins, then the
    stricter one.

    Args:
        predicted: Predicted distances [rad], shape [T, M] for T steps of M episodes.
        action_norm: Norms of the smoothed action, shape [T, M].
        true: True distances [rad], shape [T, M].
        alive: Whether the episode still runs at each step, shape [T, M].
        tolerance_rad: Largest true distance that counts as right [rad].
        candidates: Values tried of each bound.

    Raises:
        ValueError: There is no step to choose from, or no episode that any rule stops within the tolerance.
    """
    if not alive.any():
        raise ValueError("no episode has a step to calibrate the stopping rule on; give more episodes")
    right = (true <= tolerance_rad) & alive
    norms = action_norm[right] if right.any() else action_norm[alive]
    limits = np.unique(np.quantile(norms, np.linspace(1.0 / candidates, 1.0, candidates)))
    distances = 2.0 * tolerance_rad * np.arange(1, candidates + 1) / candidates
    best: tuple[float, ...] | None = None
    for distance in distances:
        for limit in limits:
            stop = (predicted < distance) & (action_norm < limit) & alive
            ends = stop.any(axis=0)
            first = stop.argmax(axis=0)
            error = true[first, np.arange(true.shape[1])]
            success = float(np.mean(ends & (error <= tolerance_rad)))
            wrong = float(np.mean(ends & (error > tolerance_rad)))
            score = (success, -wrong, -float(distance), -float(limit))
            if best is None or score > best:
                best = score
    assert best is not None
    if best[0] == 0.0:
        near = int(right.any(axis=0).sum())
        raise ValueError(
            f"no rule stops any of {true.shape[1]} episodes within {tolerance_rad:g} rad ({near} came near); "
            "train longer, or calibrate on more episodes"
        )
    return Calibration(
        rule=StoppingRule(distance_rad=-best[2], action_norm=-best[3]),
        tolerance_rad=tolerance_rad,
        success=best[0],
        wrong=-best[1],
        reachable=float(np.mean(right.any(axis=0))),
        episodes=true.shape[1],
    )
