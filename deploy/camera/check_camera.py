"""The depth camera's part of the preflight.

Images come, in time, with depth, and the object is in view.
"""

import math
from collections.abc import Iterator

import numpy as np

from vd.assets_usd.hand_data import CameraModel
from vd.deploy.camera.camera import Camera, CameraError
from vd.deploy.clock import MONOTONIC, Clock
from vd.deploy.finding import Finding, finding

FIRST_S = 5.0
"""Longest wait for the first image: a camera that starts tunes its exposure first."""
LOOK_S = 2.0
"""How long images are taken."""
WAIT_S = 0.5
"""Longest wait for each of them."""
RATE_SHARE = 0.8
"""Share of the rate that was asked for: a camera that sends fewer is on USB 2, or has no light."""
AGE_S = 0.1
"""An image as old as this when it comes is about one control period late before anything is done
with it.
"""
AROUND_M = 0.06
"""Half a side of the square around the object's place in which depth is counted: hand and object
fill it.
"""
DEPTH_SHARE = 0.5
"""Share of its pixels that must have depth: rendered with the errors of a D415, 78 to 85 % do."""


def camera_findings(
    camera: Camera, place: CameraModel, around: np.ndarray, *, fps: float, clock: Clock = MONOTONIC
) -> Iterator[Finding]:
    """Look at a camera.

    What could not be looked at because of what came before is not in the findings.

    Args:
        camera: The camera, started.
        place: Where it is taken to be, and its range.
        around: Where objects are handled, in the base frame [m] [3].
        fps: Images a second that it was asked for.
        clock: Time.
    """
    try:
        frames = [camera.read(FIRST_S)]
        begin = clock.now()
        ages = [begin - frames[0].time_s]
        while clock.now() < begin + LOOK_S:
            frames.append(camera.read(WAIT_S))
            ages.append(clock.now() - frames[-1].time_s)
    except CameraError as error:
        yield Finding("camera streams", False, str(error))
        return
    height, width = frames[-1].image.shape
    yield Finding("camera streams", True, f"{len(frames)} images of {width} x {height}")
    yield _rate(np.array([frame.time_s for frame in frames]), float(np.median(ages)), fps)
    seen = camera.intrinsics.seen_from(place)
    spot = seen.project(around)
    yield _lens(seen, spot)
    yield _depth(np.stack([frame.image for frame in frames]), seen, spot)


def _rate(times: np.ndarray, age: float, fps: float) -> Finding:
    gaps = np.diff(times)
    rate = 1.0 / float(gaps.mean())
    wrong = []
    if rate < RATE_SHARE * fps:
        wrong.append(
            f"{rate:.1f} images a second, not {fps:g}: use a USB 3 cable and port, and more light"
        )
    if age > AGE_S:
        wrong.append(
            f"images come {1e3 * age:.0f} ms old, more than {1e3 * AGE_S:.0f}: use a USB 3 port"
        )
    right = (
        f"{rate:.1f} images a second, longest gap {1e3 * gaps.max():.0f} ms, {1e3 * age:.0f} ms old"
    )
    return finding("camera rate", wrong, right)


def _lens(seen: CameraModel, spot: np.ndarray) -> Finding:
    wide = 2.0 * math.degrees(math.atan2(0.5 * seen.width, seen.fx))
    lens = f"{seen.width} x {seen.height}, f {seen.fx:.1f} {seen.fy:.1f} px, {wide:.0f} deg wide"
    column, row, depth = spot
    if depth > 0.0 and 0.0 <= column < seen.width and 0.0 <= row < seen.height:
        where = f"the object's place is at {column:.0f}, {row:.0f}, {depth:.2f} m away"
        return Finding("camera lens", True, f"{lens}; {where}")
    remedy = "the object's place is not in view: mount it as in training, or find it by calibrate"
    return Finding("camera lens", False, f"{lens}; {remedy}")


def _depth(images: np.ndarray, seen: CameraModel, spot: np.ndarray) -> Finding:
    """Share of the pixels [N, H, W] with depth, in all and where the object is handled."""
    valid = (images >= seen.near) & (images <= seen.far)
    column, row, depth = spot
    half = AROUND_M * np.array([seen.fx, seen.fy]) / abs(depth)
    first = np.maximum(np.round(np.array([column, row]) - half), 0).astype(int)
    last = np.maximum(np.round(np.array([column, row]) + half), 0).astype(int)
    around = valid[:, first[1] : last[1], first[0] : last[0]]
    share = float(around.mean()) if around.size else 0.0
    found = f"{100 * valid.mean():.0f} % of the pixels have it, {100 * share:.0f} % around the object's place"
    if share < DEPTH_SHARE:
        remedy = "clean the lens, keep it off by what its range asks for, switch the emitter on"
        return Finding("camera depth", False, f"{found}, not {100 * DEPTH_SHARE:.0f}: {remedy}")
    return Finding("camera depth", True, found)
