"""A twin: the hand in Newton, in real time, in place of motors, camera and object."""

import threading
from collections.abc import Sequence

import numpy as np

from vd.assets_usd.hand_data import CameraModel
from vd.assets_usd.objects.model import ObjectModel
from vd.command.warp_quiet import quiet_warp
from vd.deploy.camera.camera import Frame
from vd.deploy.clock import MONOTONIC, Clock
from vd.deploy.hardware.answers import HandState
from vd.deploy.hardware.control_table import RAD_PER_COUNT, RAD_S_PER_COUNT, TICK_MODULUS
from vd.deploy.hardware.joints import JointMotors
from vd.deploy.hardware.motors import FaultlessMotors
from vd.deploy.twin.newton_hand import NewtonHand
from vd.paper import PAPER
from vd.sensors.cfg import DepthCameraCfg
from vd.sensors.depth_camera import DepthCamera
from vd.sim.cfg import SimCfg

WARM_C = 30.0
"""Temperature that its motors tell [deg C]."""


class Twin(FaultlessMotors):
    """A simulated hand as :class:`vd.deploy.hardware.motors.Motors`, over a table.

    It catches up with the clock whenever it is asked or told something. Angles are told in a
    motor's counts. Supply, temperature and packets are not simulated: nothing fails.

    Args:
        joints: Which motor turns which joint.
        item: The object between the fingers, if there is one.
        physics_hz: Rate of the simulation.
        clock: Time.
    """

    def __init__(
        self,
        joints: JointMotors,
        item: ObjectModel | None = None,
        *,
        physics_hz: float = PAPER.scene.physics_hz,
        clock: Clock = MONOTONIC,
    ):
        quiet_warp()
        self.ids = joints.ids
        self.clock = clock
        self.hand = NewtonHand(joints.hand, SimCfg(physics_hz=physics_hz), item)
        """The hand, where it was when it was last asked."""
        self._joints = joints
        self._goals = joints.hand.start
        self._sent = self._goals
        self._on = np.zeros(len(self.ids), dtype=bool)
        self._share = np.ones(len(self.ids))
        self._amperes = joints.gear * np.array([model.torque_nm_per_a for model in joints.models])
        self._current_unit_a = np.array([model.current_unit_a for model in joints.models])
        self._supply_v = np.array([model.supply_v for model in joints.models])
        limited = joints.currents() * self._amperes
        self._effort = np.where(joints.capped, limited, joints.hand.effort)
        self._lock = threading.RLock()
        self._now_s = clock.now()

    def _catch_up(self) -> float:
        """Simulate up to the present [s], which is returned."""
        now_s = self.clock.now()
        self.hand.advance(max(0.0, now_s - self._now_s))
        self._now_s = now_s
        return now_s

    def _arrive(self) -> None:
        """Have the goals that were sent act from now on."""
        self._goals = self._sent
        self._drive()

    def _drive(self) -> None:
        """Have goals, torque and gains act from now on."""
        self.hand.drive(self._goals, self._on * self._share, self._effort)

    def read_state(self, *, retries: int | None = None) -> HandState:
        """The state of the present."""
        with self._lock:
            now_s = self._catch_up()
            self._arrive()
            q, qd, torque = self.hand.read()
        joints = self._joints
        count = len(self.ids)
        return HandState(
            time_s=now_s,
            position=_counted(joints.to_motor(q), RAD_PER_COUNT),
            velocity=_counted(joints.sign * joints.gear * qd, RAD_S_PER_COUNT),
            current=_counted(joints.sign * torque / self._amperes, self._current_unit_a),
            pwm=np.zeros(count),
            voltage=self._supply_v,
            temperature=np.full(count, WARM_C),
            alert=np.zeros(count, dtype=bool),
            tick=np.full(count, 1e3 * now_s % TICK_MODULUS),
        )

    def write_goals(self, goals: np.ndarray, *, with_state: bool = False) -> None:
        """Drive to these angles of the motors [rad] from now on, or from the next state on."""
        with self._lock:
            self._sent = self._joints.to_joint(_counted(goals, RAD_PER_COUNT))
            if not with_state:
                self._catch_up()
                self._arrive()

    def freeze(self) -> None:
        """Hold where the joints are."""
        self.write_goals(self.read_state().position)

    def stiffen(self, share: float, ids: Sequence[int] | None = None) -> None:
        """Hold with a share of the hand's stiffness."""
        with self._lock:
            self._catch_up()
            self._share[self._chosen(ids)] = share
            self._drive()

    def torque(self, on: bool, ids: Sequence[int] | None = None) -> dict[int, str]:
        """Drive joints or let them go; one that is switched on stays where it is."""
        with self._lock:
            self._catch_up()
            begun = self._chosen(ids) & ~self._on if on else np.zeros(len(self.ids), dtype=bool)
            self._sent = np.where(begun, self.hand.read()[0], self._sent)
            self._on[self._chosen(ids)] = on
            self._arrive()
        return {}

    def _chosen(self, ids: Sequence[int] | None) -> np.ndarray:
        """Which motors have one of these IDs, all without any, shape [D] bool."""
        return np.isin(self.ids, list(self.ids if ids is None else ids))

    def read_torque(self) -> np.ndarray:
        """Which joints are driven."""
        return self._on.copy()

    def release(self) -> None:
        """Let all joints go."""
        self.torque(False)

    def object_state(self) -> np.ndarray:
        """The object's true position [m], quaternion xyzw, velocity [m/s] and spin [rad/s] [13]."""
        with self._lock:
            self._catch_up()
            return np.concatenate([self.hand.joint_q[-7:], self.hand.joint_qd[-6:]])

    def poses(self) -> tuple[float, np.ndarray, np.ndarray]:
        """The present [s], joints [rad] [D] and the object's pose [7], or [0] without one."""
        with self._lock:
            now_s = self._catch_up()
            whole = self.hand.joint_q
        joints = self._joints.hand.num_joints
        return now_s, whole[:joints], whole[joints:]

    def place_object(self) -> None:
        """Put the object where an episode starts; it falls from there."""
        with self._lock:
            self._catch_up()
            self.hand.place_object()

    def render(self, camera: DepthCamera) -> Frame:
        """A depth image of the present."""
        with self._lock:
            now_s = self._catch_up()
            camera.capture()
        return Frame(camera.depth.numpy()[0].copy(), now_s)


class TwinCamera:
    """A depth camera before a twin with an object: an image whenever one is wanted.

    Args:
        twin: The twin.
        place: Lens and pose of the camera.
    """

    def __init__(self, twin: Twin, place: CameraModel):
        self.intrinsics = place
        self._twin = twin
        self._camera = DepthCamera.of_scene(
            twin.hand.scene, twin.hand.sim.body_q, DepthCameraCfg(points=0), place
        )

    def read(self, timeout_s: float) -> Frame:
        """An image of the present."""
        return self._twin.render(self._camera)

    def close(self) -> None:
        """Nothing to stop."""


def _counted(values: np.ndarray, unit: float | np.ndarray) -> np.ndarray:
    """Values in whole units."""
    return np.asarray(np.round(values / unit) * unit)
