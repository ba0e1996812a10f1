"""Where a policy is told that its goal is while the object is near it: a little past the goal.

A policy that was rewarded for coming within some angle of its goal has no reason to come nearer, and rests
where it has arrived. What it is told of the goal is then moved on, along the rotation that is left, so that
it goes on turning. The goal itself, and the distance by which an episode is stopped and judged, stay.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class AimCfg:
    """Ours: aim past the goal while it is near (``kernels/aim.py``). Off by default.

    Chosen on training objects: docs/evaluation.md, "Aiming past a near goal".
    """

    enabled: bool = False
    """Whether to."""
    past_rad: float = 0.2
    """How far past the goal [rad]."""
    within_rad: float = 0.3
    """Distance to the goal below which it is near [rad]: who stops within the paper's 0.4 rad has stopped."""

    def validate(self) -> None:
        """Raise ValueError naming the field and the remedy."""
        for name in ("past_rad", "within_rad"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"aim.{name} is {getattr(self, name):g}; it has to be positive")
