"""Slow movements of a hand, outside of any policy."""

import math

import numpy as np

from vd.deploy.safety.safety import SafeHand

MOVE_S = 0.04
"""Time between the goals of a slow movement."""
SETTLE_STEPS = 10
"""Steps at its end."""


def move(safe: SafeHand, goal: np.ndarray, speed: float) -> np.ndarray:
    """Move in a straight line of joint angles and wait for the hand to follow.

    Args:
        safe: An armed hand.
        goal: Angles of the joints [rad], shape [D].
        speed: Of the joint that has farthest to go [rad/s].

    Returns:
        The largest distance of each joint from where it should have been [rad], shape [D].

    Raises:
        StoppedError: A limit was passed.
    """
    start = safe.read().position
    steps = max(1, math.ceil(float(np.abs(goal - start).max()) / (speed * MOVE_S)))
    worst = np.zeros(len(start))
    clock = safe.bus.clock
    begin = clock.now()
    for step in range(1, steps + SETTLE_STEPS + 1):
        target = start + (goal - start) * min(1.0, step / steps)
        safe.command(target)
        clock.sleep(begin + step * MOVE_S - clock.now())
        worst = np.maximum(worst, np.abs(safe.read().position - target))
        safe.beat()
    return worst
