"""When a camera policy stops.

The distance that it predicts is small, and so is its action (Methods).
"""

from dataclasses import dataclass, field

import numpy as np

from vd.paper import PAPER

CANDIDATES = 24
"""Values tried of each bound."""


@dataclass(frozen=True)
class StoppingRule:
    """Stop at the first step whose predicted distance and norm of the action are below bounds.

    Both are of the same moment: the prediction from what is seen, and the smoothed action that led
    there. Before the first action there is none, and nothing to stop.
    """

    distance_rad: float = PAPER.success.rotation_rad
    """Bound of the predicted rotation distance, theta-bar [rad]."""
    action_norm: float = PAPER.success.action_norm
    """Bound of the norm of the smoothed action, a-bar."""

    def stops(self, distance: np.ndarray, action_norm: np.ndarray) -> np.ndarray:
        """Where to stop, for predicted distances [rad] and norms of smoothed actions of one shape."""
        return (distance < self.distance_rad) & (action_norm < self.action_norm)


@dataclass(frozen=True, kw_only=True)
class StoppingRules:
    """When a policy stops, by tolerance."""

    stopping: StoppingRule = field(default_factory=StoppingRule)
    """When to stop within ``tolerance_rad``; the paper's bounds until they are calibrated."""
    tolerance_rad: float = PAPER.success.rotation_rad
    """Tolerance that ``stopping`` is for [rad]."""
    precise: StoppingRule | None = None
    """When to stop within the tolerance of the paper's precise variant; None: not calibrated."""
    calibrated_on: str = ""
    """Objects and episodes on which the stopping rules were calibrated; empty if they were not."""

    def rule_for(self, tolerance_rad: float) -> StoppingRule:
        """When to stop within a tolerance [rad].

        The rule for it, else the tolerance itself as bound.
        """
        if tolerance_rad == self.tolerance_rad:
            return self.stopping
        if tolerance_rad == PAPER.success.precise_rad and self.precise is not None:
            return self.precise
        return StoppingRule(tolerance_rad, self.stopping.action_norm)

    def calibrated_for(self, tolerance_rad: float) -> bool:
        """Whether the rule for a tolerance [rad] comes from episodes."""
        precise = tolerance_rad == PAPER.success.precise_rad and self.precise is not None
        return precise or (tolerance_rad == self.tolerance_rad and bool(self.calibrated_on))


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
    """Share of episodes in which some step would have been right to stop at by the true
    distance.
    """
    episodes: int
    """Number of episodes."""


def calibrate(
    predicted: np.ndarray,
    action_norm: np.ndarray,
    true: np.ndarray,
    steps: np.ndarray,
    *,
    tolerance_rad: float = PAPER.success.rotation_rad,
) -> Calibration:
    """Choose the bounds so that most of M recorded episodes stop within the tolerance.

    First that of the distance, with the paper's bound of the action norm, as headline figures have
    it; then one of the norm beside it. Only where nothing near is as still as the paper asks are
    both chosen together. Bounds are tried on a grid: distances up to twice the tolerance, and
    quantiles of the action norms while the object is within it. Among equal success the rule that
    stops wrongly less often wins, then the stricter one.

    Args:
        predicted: Predicted distances after t steps [rad] [M, T + 1].
        action_norm: Norms of the smoothed action that led there [M, T + 1].
        true: True distances [rad] [M, T + 1].
        steps: Steps to the end of each episode [M]; the state after the last of them is not judged.
        tolerance_rad: Largest true distance that counts as right [rad].

    Raises:
        ValueError: There is no step to choose from, or no episode that any rule stops within the
            tolerance.
    """
    after = np.arange(true.shape[1])
    alive = (after > 0) & (after < steps[:, None])
    if not alive.any():
        raise ValueError(
            "no episode has a step to calibrate the stopping rule on; give more episodes"
        )
    right = (true <= tolerance_rad) & alive
    norms = action_norm[right] if right.any() else action_norm[alive]
    limits = np.unique(np.quantile(norms, np.linspace(1.0 / CANDIDATES, 1.0, CANDIDATES)))
    distances = 2.0 * tolerance_rad * np.arange(1, CANDIDATES + 1) / CANDIDATES

    def score(distance: float, limit: float) -> tuple[float, ...]:
        stop = (predicted < distance) & (action_norm < limit) & alive
        ends = stop.any(axis=1)
        error = true[np.arange(len(true)), stop.argmax(axis=1)]
        success = float(np.mean(ends & (error <= tolerance_rad)))
        return (
            success,
            -float(np.mean(ends & (error > tolerance_rad))),
            -float(distance),
            -float(limit),
        )

    best = max(score(distance, PAPER.success.action_norm) for distance in distances)
    if best[0] > 0.0:
        distances = distances[distances == -best[2]]
    best = max(score(distance, limit) for distance in distances for limit in limits)
    if best[0] == 0.0:
        near = int(right.any(axis=1).sum())
        raise ValueError(
            f"no rule stops any of {len(true)} episodes within {tolerance_rad:g} rad ({near} came "
            "near); train longer, or choose on more episodes (--episodes)"
        )
    return Calibration(
        rule=StoppingRule(distance_rad=-best[2], action_norm=-best[3]),
        tolerance_rad=tolerance_rad,
        success=best[0],
        wrong=-best[1],
        reachable=float(np.mean(right.any(axis=1))),
        episodes=len(true),
    )
