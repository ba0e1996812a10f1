"""What the twin tells beside its motors: the object's true pose and depth images; and who places the object.

Nothing on a real hand answers to this: it stands for eyes and a helping hand.
"""

import time
from multiprocessing.connection import Connection
from typing import Any

from vd.assets_usd.hand_data import CameraModel
from vd.deploy.twin.newton_hand import NewtonHand
from vd.sensors.cfg import DepthCameraCfg, DepthSensorCfg


class TwinSide:
    """The twin's end of the pipe to the program that started it; its requests are words.

    Args:
        pipe: The pipe.
        hand: The simulated hand; None, or one without an object: nothing to tell.
        camera: Its depth camera; its pose is that in the hand's base.
        sensor: Errors of the camera; none by default.
        seed: Of those errors.
    """

    def __init__(
        self,
        pipe: Connection,
        hand: NewtonHand | None = None,
        camera: CameraModel | None = None,
        *,
        sensor: DepthSensorCfg | None = None,
        seed: int = 0,
    ):
        self.pipe, self._hand = pipe, hand
        if hand is None or hand.scene is None:
            return
        from vd.sensors.depth_camera import DepthCamera

        cfg = DepthCameraCfg(points=0, sensor=sensor or DepthSensorCfg())
        self._camera = DepthCamera.of_scene(hand.scene, hand.body_q, cfg, camera, seed=seed)
        self._camera.capture()  # loads kernels

    def serve(self) -> bool:
        """Answer a request; False once whoever asks is gone."""
        try:
            self.pipe.send(self._answer(self.pipe.recv()))
        except (EOFError, OSError):
            return False
        return True

    def _answer(self, request: str) -> Any:
        assert self._hand is not None, "a hand with an object"
        match request:
            case "pose":
                return self._hand.joint_q[-7:]
            case "depth":
                self._camera.capture()
                return self._camera.depth.numpy()[0].copy(), time.monotonic()
            case "place":
                self._hand.place_object((0.0, 0.0, 0.0, 1.0))
        return None
