"""Pictures of a twin's fingertips with markers on them, by a camera that is not quite where it should be."""

import time
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import HandModel, Intrinsics, compose, invert
from vd.deploy.camera.calibration_poses import seat
from vd.deploy.camera.camera import Frame
from vd.deploy.camera.markers import draw

BUMP = np.array([0.012, -0.008, 0.010, *Rotation.from_euler("xyz", (1.5, -1.0, 2.0), degrees=True).as_quat()])
"""From where the camera is said to be to where it is, in its own frame [m]."""
SLIP = np.array(
    [0.002, -0.003, 0.001, *Rotation.from_euler("xyz", (8.0, -5.0, 12.0), degrees=True).as_quat()]
)
"""From where a marker should sit to where somebody has stuck it."""
GROUND, NOISE = 70, 3.0
"""Brightness of what is not marker, and the noise of all, of 255."""


class CalibrationTwin:
    """Pictures of markers on a hand's fingertips.

    Args:
        hand: The hand; its camera is where it is said to be.
        joints: Says where the joints are [rad] [D].
        fingers: Fingers with markers.
        size: Columns and rows of the pictures.
        side_m: Side of the markers [m].
        seed: Of the noise.

    Attributes:
        camera: Where the camera is: its optical frame in the hand's base [7].
        intrinsics: Of the pictures.
    """

    def __init__(
        self,
        hand: HandModel,
        joints: Callable[[], np.ndarray],
        fingers: tuple[int, ...],
        size: tuple[int, int],
        *,
        side_m: float,
        seed: int = 0,
    ):
        said = np.concatenate([hand.camera.position, hand.camera.quaternion])
        self.camera = compose(said, BUMP)
        lens, (x, y) = hand.camera, np.divide(size, (hand.camera.width, hand.camera.height))
        self.intrinsics = Intrinsics(*size, lens.fx * x, lens.fy * y, lens.cx * x, lens.cy * y)
        self._hand, self._joints, self._side_m = hand, joints, side_m
        self._markers = {finger: compose(seat(hand, finger, said), SLIP) for finger in fingers}
        self._random = np.random.default_rng(seed)

    def read(self, timeout_s: float) -> Frame:
        """A picture of the present."""
        lens, time_s = self.intrinsics, time.monotonic()
        tips = self._hand.tip_poses(self._joints())
        image = np.full((lens.height, lens.width), GROUND, dtype=np.uint8)
        for finger, marker in self._markers.items():
            pose = compose(invert(self.camera), compose(tips[finger], marker))
            image = draw(image, finger, pose, lens, self._side_m)
        noisy = image + NOISE * self._random.standard_normal(image.shape, dtype=np.float32)
        return Frame(np.clip(np.rint(noisy), 0, 255).astype(np.uint8), time_s)

    def close(self) -> None:
        """Nothing to stop."""
