"""What a twin knows of its object: as poses that come late and with noise, and as a camera's images.

The images show a cube of tags with the hand before it: a stand-in for the camera of a real hand.
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import HandModel, Intrinsics, compose, invert, pose_at
from vd.command.config import require
from vd.deploy.camera.camera import Frame
from vd.deploy.hardware.joints import JointMotors
from vd.deploy.pose.rendered import render_cube
from vd.deploy.pose.source import StampedPose
from vd.deploy.twin.twin import Twin

TWIN_LENS = Intrinsics(640, 360, 460.0, 460.0, 320.0, 180.0)
"""Of a twin's images of tags: those of a D415 by the defaults of --camera."""
BENT_S = 1.0
"""Time in which a finger comes to rest [s]."""
LOOK_S = 0.05
"""How often it is asked meanwhile [s]."""
IMAGES_HZ = 15.0
"""Images a second: drawing and reading them takes the time of other programs, too."""
IMAGE_NOISE = 3.0
"""Standard deviation of each pixel's brightness, of 255; the same in all images."""


@dataclass(frozen=True)
class TruthCfg:
    """Errors of a twin's truth."""

    delay_s: float = 0.0
    """How old poses are when they come, at least [s]."""
    noise_m: float = 0.0
    """Standard deviation of each position in each axis [m]."""
    noise_rad: float = 0.0
    """Standard deviation of each orientation about each axis [rad]."""

    def validate(self) -> None:
        """Raise ValueError naming the setting."""
        require(self, "--pose sim:", "zero or positive", "delay_s noise_m noise_rad")


class TwinPoses:
    """The truth of a twin, in the world frame, taken whenever it is read.

    Args:
        truth: State of the object [13], as :meth:`Twin.object_state` tells it.
        cfg: Its errors.
        now: Time [s].
        seed: Of the noise.
    """

    def __init__(
        self,
        truth: Callable[[], np.ndarray],
        cfg: TruthCfg,
        *,
        now: Callable[[], float] = time.monotonic,
        seed: int = 0,
    ):
        self.name = "sim"
        self.trouble = ""
        self._truth = truth
        self._cfg = cfg
        self._now = now
        self._rng = np.random.default_rng(seed)
        self._coming: deque[StampedPose] = deque()
        self._newest: StampedPose | None = None

    def read(self) -> StampedPose | None:
        """The newest pose that is old enough."""
        now_s = self._now()
        true = self._truth()[:7]
        place = true[:3] + self._cfg.noise_m * self._rng.normal(size=3)
        turn = Rotation.from_rotvec(self._cfg.noise_rad * self._rng.normal(size=3))
        quaternion = (turn * Rotation.from_quat(true[3:])).as_quat()
        self._coming.append(StampedPose(now_s, np.concatenate([place, quaternion])))
        while self._coming and self._coming[0].time_s <= now_s - self._cfg.delay_s:
            self._newest = self._coming.popleft()
        return self._newest

    def close(self) -> None:
        """The twin goes on."""


class TagsOfTwin:
    """A camera's images of a cube of tags in a twin's hand, or on a fingertip of it.

    Args:
        twin: The twin.
        hand: Its hand.
        camera: Pose of the camera's optical frame in the hand's base [7].
        size_m: Side of the cube [m].
        tip: Finger that has the cube on its tip, in place of the object.
        seed: Of the noise of the images.
    """

    def __init__(
        self,
        twin: Twin,
        hand: HandModel,
        camera: np.ndarray,
        size_m: float,
        *,
        tip: int | None = None,
        seed: int = 0,
    ):
        self.intrinsics = TWIN_LENS
        self._twin = twin
        self._hand = hand
        self._camera = camera
        self._size_m = size_m
        self._tip = tip
        self._noise = np.random.default_rng(seed).normal(
            0.0, IMAGE_NOISE, (TWIN_LENS.height, TWIN_LENS.width)
        )
        self._due_s = 0.0

    def read(self, timeout_s: float) -> Frame:
        """The next image: brightness, uint8 [H, W]."""
        time.sleep(max(0.0, self._due_s - time.monotonic()))
        self._due_s = time.monotonic() + 1.0 / IMAGES_HZ
        time_s, joint_q, object_pose = self._twin.poses()
        to_camera = invert(self._camera)
        if self._tip is None:
            in_base = compose(invert(self._hand.mount), object_pose)
        else:
            in_base = compose(self._hand.tip_poses(joint_q)[self._tip], self._seat())
        links = self._hand.forward_kinematics(joint_q)[self._hand.point_link]
        turns = Rotation.from_quat(links[:, 3:]).as_matrix()
        points = np.einsum("pij,pkj->pki", turns, self._hand.link_points) + links[:, None, :3]
        points = Rotation.from_quat(to_camera[3:]).apply(points.reshape(-1, 3)) + to_camera[:3]
        pose = compose(to_camera, in_base)
        image = render_cube(pose, self.intrinsics, self._size_m, before=points)
        noisy = np.clip(image + self._noise, 0, 255).astype(np.uint8)
        return Frame(noisy, time_s)

    def close(self) -> None:
        """The twin goes on."""

    def _seat(self) -> np.ndarray:
        """Pose of the cube in the frame of its fingertip [7]: towards the camera at the start."""
        tip = self._hand.tip_poses(self._hand.start)[self._tip]
        towards = Rotation.from_quat(tip[3:]).inv().apply(self._camera[:3] - tip[:3])
        return pose_at(self._size_m * towards / np.linalg.norm(towards))


class BentFinger:
    """A camera's images of a cube of tags on a finger of a twin, which bends as if by hand.

    It bends before every other image, by its motors: a twin has nobody who does.

    Args:
        twin: The twin.
        joints: Its motors.
        finger: The finger.
        camera: Pose of the camera's optical frame in the hand's base [7].
        size_m: Side of the cube [m].
    """

    def __init__(
        self, twin: Twin, joints: JointMotors, finger: int, camera: np.ndarray, size_m: float
    ):
        self.intrinsics = TWIN_LENS
        self._images = TagsOfTwin(twin, joints.hand, camera, size_m, tip=finger)
        self._twin = twin
        self._joints = joints
        self._finger = joints.hand.fingers[finger]
        self._rng = np.random.default_rng(finger)
        self._rests = True
        twin.torque(True)

    def read(self, timeout_s: float) -> Frame:
        """The next image: brightness, uint8 [H, W]."""
        if self._rests:
            hand = self._joints.hand
            goals = hand.start.copy()
            low, high = hand.lower[self._finger], hand.upper[self._finger]
            goals[self._finger] = self._rng.uniform(low, high)
            self._twin.write_goals(self._joints.to_motor(goals))
            end_s = time.monotonic() + BENT_S
            while time.monotonic() < end_s:
                self._twin.read_state()  # it moves only as far as it is asked
                time.sleep(LOOK_S)
        self._rests = not self._rests
        return self._images.read(timeout_s)

    def close(self) -> None:
        """The twin goes on."""
