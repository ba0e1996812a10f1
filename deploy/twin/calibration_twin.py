"""Pictures of a twin's fingertips with markers on them, by a camera that is not quite where it should be.

The pictures go through the SDK's software device, so that everything after the lens is what meets a camera.
"""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import HandModel, Intrinsics, compose, invert
from vd.deploy.camera.calibration_poses import seat
from vd.deploy.camera.camera import GrayFrame
from vd.deploy.camera.markers import draw
from vd.deploy.camera.realsense import RealSenseCfg, RealSenseInfrared
from vd.deploy.twin.camera_twin import CameraTwin

BUMP = np.array([0.012, -0.008, 0.010, *Rotation.from_euler("xyz", (1.5, -1.0, 2.0), degrees=True).as_quat()])
"""From where the camera is said to be to where it is, in its own frame [m]."""
SLIP = np.array(
    [0.002, -0.003, 0.001, *Rotation.from_euler("xyz", (8.0, -5.0, 12.0), degrees=True).as_quat()]
)
"""From where a marker should sit to where somebody has stuck it."""
GROUND, NOISE = 70, 3.0
"""Brightness of what is not marker, and the noise of all, of 255."""


class CalibrationTwin:
    """Pictures of markers on a hand's fingertips."""

    def __init__(
        self,
        hand: HandModel,
        joints: Callable[[], np.ndarray],
        fingers: tuple[int, ...],
        cfg: RealSenseCfg,
        *,
        side_m: float,
        seed: int = 0,
    ):
        """Start the camera.

        Args:
            hand: The hand; its camera is where it is said to be.
            joints: Says where the joints are [rad] [D].
            fingers: Fingers with markers.
            cfg: The camera's settings: size and rate of the pictures.
            side_m: Side of the markers [m].
            seed: Of the noise.

        Raises:
            CameraError: SDK or OpenCV are not installed.
        """
        scale_x, scale_y = cfg.width / hand.camera.width, cfg.height / hand.camera.height
        lens = Intrinsics(
            cfg.width,
            cfg.height,
            hand.camera.fx * scale_x,
            hand.camera.fy * scale_y,
            hand.camera.cx * scale_x,
            hand.camera.cy * scale_y,
        )
        said = np.concatenate([hand.camera.position, hand.camera.quaternion])
        self.camera = compose(said, BUMP)
        """Where the camera is: its optical frame in the hand's base [7]."""
        self._hand, self._joints, self._side_m = hand, joints, side_m
        self._markers = {finger: compose(seat(hand, finger, said), SLIP) for finger in fingers}
        self._random = np.random.default_rng(seed)
        self._twin = CameraTwin(lens, fps=cfg.fps)
        self._source = RealSenseInfrared(self._twin.device, cfg)
        self.intrinsics = self._source.intrinsics
        """Of the pictures."""

    def read(self, timeout_s: float) -> GrayFrame:
        """A picture of the present.

        Raises:
            StaleCamera: The SDK did not hand it on in time.
        """
        lens = self.intrinsics
        tips = self._hand.tip_poses(self._joints())
        image = np.full((lens.height, lens.width), GROUND, dtype=np.uint8)
        for finger, marker in self._markers.items():
            pose = compose(invert(self.camera), compose(tips[finger], marker))
            image = draw(image, finger, pose, lens, self._side_m)
        noisy = image + NOISE * self._random.standard_normal(image.shape, dtype=np.float32)
        self._twin.show_infrared(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
        return self._source.read(timeout_s)

    def close(self) -> None:
        """Stop the camera."""
        self._source.close()
