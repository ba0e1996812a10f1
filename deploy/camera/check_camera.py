"""What a depth camera has to show: images in time, with depth about the object's place.

The preflight looks at that before a hand moves, and the control loop while it does.
"""

import math
from collections.abc import Iterator

import numpy as np

from vd.assets_usd.hand_data import CameraModel
from vd.deploy.camera.camera import CameraError, ImageSource
from vd.deploy.clock import MONOTONIC, Clock, from_future
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
MOVED_RAD = 0.02
"""A joint that has moved so far is elsewhere in the image."""
BLIND_SHARE = 0.25
"""Half of what the preflight asks for: fingers come near, and things pass by."""
REPLUG = "plug the camera in again"
SEEN_SHARE = 0.25
"""Share of the most that was seen of an object below which it is gone."""
FEWEST_VOXELS, MOST_VOXELS = 16, 256
"""What is seen at least of any object, and what counts as the most. Of 30 objects between fingers
90 or more are seen; where there is none up to 72, in the median 45, at the edges of fingers."""
LOST_IMAGES = 12
"""Images in a row of a second: for less long it may be behind a finger."""
AROUND_M = 0.06
"""Half a side of the square around the object's place in which depth is counted: hand and object
fill it.
"""
SMOOTH_M = 0.01
"""Difference of depth to a neighbour below which the two show one surface: a D415's noise at 0.6 m
is 1 mm, and a pixel 2 mm wide."""
DEPTH_SHARE = 0.5
"""Share of its pixels that must show surfaces: rendered with the errors of a D415, 52 to 94 % do,
with noise of 20 mm 15 to 30 %."""


class ObjectPlace:
    """Where objects are handled, in a camera's images: how much is seen there.

    Args:
        camera: The camera, where it is taken to be.
        around: Where objects are handled, in the base frame [m] [3].
    """

    def __init__(self, camera: CameraModel, around: np.ndarray):
        self.spot = camera.project(around)
        """Its column and row [pixel], and depth [m]."""
        column, row, depth = self.spot
        half = AROUND_M * np.array([camera.fx, camera.fy]) / abs(depth)
        first = np.maximum(np.round(np.array([column, row]) - half), 0).astype(int)
        last = np.maximum(np.round(np.array([column, row]) + half), 0).astype(int)
        self._columns, self._rows = map(slice, first, last)
        self._near = camera.near
        self._far = camera.far

    def seen(self, image: np.ndarray) -> float:
        """Share of the pixels about it that show a surface: depth in range, like its neighbours'.

        Args:
            image: Depth [m], 0 for none [H, W].
        """
        depth = image[self._rows, self._columns]
        if not depth.size:
            return 0.0
        alike = np.zeros(depth.shape, dtype=int)
        beside = np.abs(np.diff(depth, axis=1)) < SMOOTH_M
        alike[:, 1:] += beside
        alike[:, :-1] += beside
        below = np.abs(np.diff(depth, axis=0)) < SMOOTH_M
        alike[1:] += below
        alike[:-1] += below
        surface = (depth >= self._near) & (depth <= self._far) & (alike >= 2)
        return float(surface.mean())


class SightWatch:
    """Whether a camera goes on seeing the object's place, and the object, while the hand moves.

    Arguments are those of :class:`ObjectPlace`.
    """

    def __init__(self, camera: CameraModel, around: np.ndarray):
        self._place = ObjectPlace(camera, around)
        self._image = np.zeros(0)
        self._joint_q = np.zeros(0)
        self._most = 0
        self._without = 0

    def fault(self, image: np.ndarray, joint_q: np.ndarray) -> str:
        """Why an image shows nothing new of the object's place; empty where it does.

        Args:
            image: Depth [m], 0 for none [H, W].
            joint_q: Where the joints are meanwhile [rad] [D].
        """
        if not np.array_equal(image, self._image):
            self._image = image
            self._joint_q = joint_q
        elif np.abs(joint_q - self._joint_q).max() > MOVED_RAD:
            return f"the same image comes again and again, though the hand moves: {REPLUG}"
        share = self._place.seen(image)
        return "" if share >= BLIND_SHARE else _unseen(share, BLIND_SHARE)

    def loses(self, voxels: int) -> bool:
        """Whether the object has been gone for a while.

        Args:
            voxels: How much of it the newest image shows.
        """
        self._most = max(self._most, min(voxels, MOST_VOXELS))
        gone = voxels < max(FEWEST_VOXELS, SEEN_SHARE * self._most)
        self._without = self._without + 1 if gone else 0
        return self._without >= LOST_IMAGES


def _unseen(share: float, wanted: float) -> str:
    """How much shows a surface, and what to do."""
    return (
        f"{100 * share:.0f} % of the pixels around the object's place show a surface, not "
        f"{100 * wanted:.0f}: clean the lens, keep it off by what its range asks for, switch the "
        f"emitter on"
    )


def camera_findings(
    camera: ImageSource,
    place: CameraModel,
    around: np.ndarray,
    *,
    fps: float,
    clock: Clock = MONOTONIC,
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
    lens = camera.intrinsics.seen_from(place)
    place_seen = ObjectPlace(lens, around)
    yield _lens(lens, place_seen.spot)
    images = [frame.image for frame in frames]
    valid = np.mean([(image >= lens.near) & (image <= lens.far) for image in images])
    share = float(np.mean(list(map(place_seen.seen, images))))
    if share < DEPTH_SHARE:
        yield Finding("camera depth", False, _unseen(share, DEPTH_SHARE))
    else:
        around_it = f"{100 * share:.0f} % of those around the object's place show surfaces"
        yield Finding(
            "camera depth", True, f"{100 * valid:.0f} % of the pixels have it, {around_it}"
        )


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
    if ahead := from_future(-age, 0.0):
        wrong.append(f"images are {ahead}")
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
