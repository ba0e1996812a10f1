"""What a source of poses has to show before a hand moves."""

from collections.abc import Iterator

import numpy as np

from vd.assets_usd.hand_data import HandModel, compose
from vd.deploy.camera.camera import CameraError
from vd.deploy.clock import MONOTONIC, Clock, from_future
from vd.deploy.finding import Finding, finding
from vd.deploy.pose.source import PoseSource, PoseSourceError, StampedPose

FIRST_S = 5.0
"""Longest wait for a first pose."""
LOOK_S = 2.0
"""How long poses are counted."""
POLL_S = 0.01
"""How often it is looked for one."""
FEWEST_HZ = 8.0
"""Poses a second at least; policies are trained with 10 to 30."""


def pose_findings(
    source: PoseSource,
    frame: np.ndarray,
    hand: HandModel,
    oldest_s: float,
    *,
    clock: Clock = MONOTONIC,
) -> Iterator[Finding]:
    """Look at a source of poses: that they come, how often and how old, and where the object is.

    Args:
        source: The source.
        frame: Pose of its frame in the world [7].
        hand: The hand.
        oldest_s: Age at which the hand would be stopped [s].
        clock: Time.
    """
    poses: list[StampedPose] = []
    ages_s: list[float] = []
    end_s = clock.now() + FIRST_S
    try:
        while clock.now() < end_s:
            newest = source.read()
            if newest is not None and (not poses or newest.time_s > poses[-1].time_s):
                if not poses:
                    end_s = clock.now() + LOOK_S
                poses.append(newest)
                ages_s.append(clock.now() - newest.time_s)
            clock.sleep(POLL_S)
    except (PoseSourceError, CameraError) as error:
        yield Finding("pose", False, str(error))
        return
    if not poses:
        why = source.trouble or "start the tracker, and show it the object"
        yield Finding("pose", False, f"none from {source.name} within {FIRST_S:g} s: {why}")
        return
    rate_hz = (len(poses) - 1) / LOOK_S
    age_s = float(np.median(ages_s))
    wrong = []
    if rate_hz < FEWEST_HZ:
        wrong.append(f"{rate_hz:.1f} poses a second from {source.name}, not {FEWEST_HZ:g}")
    if age_s > oldest_s:
        wrong.append(f"poses are {age_s:.2f} s old: stamp them by this computer's clock (NTP)")
    if ahead := from_future(-age_s, 0.0):
        wrong.append(f"poses are {ahead}, and stamp them when their image is exposed")
    yield finding(
        "pose", wrong, f"{rate_hz:.0f} a second from {source.name}, {1e3 * age_s:.0f} ms old"
    )
    place = compose(frame, poses[-1].pose)[:3]
    away_m = float(np.linalg.norm(place - np.array(hand.workspace.goal_m)))
    yield Finding(
        "object", True, f"{100 * away_m:.0f} cm from where {hand.name} handles it, {place.round(3)}"
    )
