"""A hand as its readers see it: arrays, names and kinematics, without USD.

Units are SI and radians, quaternions are xyzw. Frames: the base frame is that of link ``base``; a
pose is a row ``(x, y, z, qx, qy, qz, qw)``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import get_type_hints

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

RANGE_M = (0.05, 1.5)
"""Nearest and farthest depth of a camera that a hand's file does not describe [m]."""
CAMERA_M = 0.55
"""How far it is from where objects are handled [m]: a D415 sees from 0.45 m on."""
WANDER_SHARE = 0.4
"""How far objects are from there as a share of the way after which they are lost: with the D'Claw
6 cm, as wide as it opens."""


class HandError(ValueError):
    """A USD file that is not a hand, or no layer of it.

    Says which file, prim, attribute, and what to do.
    """


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """A pinhole camera without a place.

    Attributes:
        width: Columns of the image.
        height: Rows of the image.
        fx: Horizontal focal length [px].
        fy: Vertical focal length [px].
        cx: Principal point, from the left edge of the image [px]; the first pixel's centre is at
            0.5.
        cy: Principal point, from the top edge of the image [px].
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def matrix(self) -> np.ndarray:
        """The intrinsic matrix [3, 3] [px]."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def seen_from(self, camera: "CameraModel") -> "CameraModel":
        """The camera with these intrinsics, at the place and with the range of another."""
        return replace(camera, **{f.name: getattr(self, f.name) for f in fields(Intrinsics)})


LENS = Intrinsics(width=320, height=180, fx=256.05, fy=256.05, cx=160.0, cy=90.0)
"""Of such a camera: a D415's, as the D'Claw's is."""


@dataclass(frozen=True, eq=False)
class CameraModel(Intrinsics):
    """A pinhole camera fixed to the base.

    Attributes:
        near: Nearest depth [m].
        far: Farthest depth [m].
        position: Origin of the optical frame in the base frame [3] [m].
        quaternion: Optical frame (x right, y down, z forward) in the base frame, xyzw [4].
    """

    near: float
    far: float
    position: np.ndarray
    quaternion: np.ndarray

    def at(self, place: Sequence[float] | None) -> "CameraModel":
        """The camera at a pose in the base frame, position [m] and quaternion xyzw.

        Where it is by default.

        Raises:
            ValueError: It is no pose.
        """
        if place is None:
            return self
        pose = np.asarray(place, dtype=float)
        if pose.shape != (7,) or not np.linalg.norm(pose[3:]) > 0.0:
            raise ValueError(f"camera = {tuple(place)}; it must be a position and a quaternion")
        return replace(self, position=pose[:3], quaternion=pose[3:] / np.linalg.norm(pose[3:]))

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixel (u, v) and depth [m] of points [.., 3] [m] of the base frame, as [.., 3].

        A point behind the camera has a negative depth, and pixels without a meaning.
        """
        points = np.asarray(points, dtype=float)
        flat = (points - self.position).reshape(-1, 3)
        optical = Rotation.from_quat(self.quaternion).inv().apply(flat)
        image = optical @ self.matrix.T
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = image[:, :2] / image[:, 2:]
        return np.concatenate([pixels, image[:, 2:]], axis=1).reshape(points.shape)


@dataclass(frozen=True, eq=False)
class CollisionShape:
    """A convex collider.

    Attributes:
        path: Prim path, which is also the label of the shape in Newton.
        link: Index of its link.
        kind: ``box``, ``sphere``, ``capsule``, ``cylinder`` or ``hull``.
        size: Half extents of a box, or of the box around a hull; (radius,) of a sphere; (radius,
            half the length without the caps) of a capsule; (radius, half height) of a cylinder [m].
            The last two lie along z of ``frame``.
        frame: Pose in the link frame [7]; of a hull that of the box around it.
        vertices: Corners of a hull in ``frame`` [V, 3] [m]; of other kinds [0, 3].
        friction: Coefficient of (dynamic) friction.
        fingertip: Whether its material is that of the fingertip variant.
    """

    path: str
    link: int
    kind: str
    size: tuple[float, ...]
    frame: np.ndarray
    vertices: np.ndarray
    friction: float
    fingertip: bool


@dataclass(frozen=True)
class Workspace:
    """Where a hand handles objects, and which. World frame: z up, table top at z = 0."""

    drop_m: tuple[float, float, float]
    """Where an object is when an episode starts [m]."""
    goal_m: tuple[float, float, float]
    """Where it is handled; an object that is far from there is lost [m]."""
    fall_m: float
    """Distance from there at which it is [m]."""
    size_m: tuple[float, float]
    """Smallest and largest longest side of an object that fits the hand [m]."""

    @property
    def box_m(self) -> np.ndarray:
        """Lower and upper corner of where the middles of objects are, from goal to drop [m] [2, 3]."""
        ends = np.array([self.goal_m, self.drop_m])
        around = WANDER_SHARE * self.fall_m
        return np.stack([ends.min(axis=0) - around, ends.max(axis=0) + around])


@dataclass(frozen=True)
class MotorModel:
    """The motor of a joint: its angle is ``sign * gear * q + offset_rad``."""

    model: str
    """Name of the maker: ``XM430-W210``."""
    id: int
    """On the bus."""
    sign: float = 1.0
    """1 or -1: which way it turns."""
    offset_rad: float = 0.0
    """Its angle where the joint is at zero [rad], from the middle of its turn."""
    gear: float = 1.0
    """Its turns for one of the joint."""
    p_gain: int = 200
    """Position gain with which it is as stiff as the joint's drive, in its units; by default the
    paper's.
    """
    d_gain: int = 10
    """Its damping likewise."""
    current: float = 0.0
    """Largest current [A] in current-based position control; 0 for plain position control."""


MOTOR_ATTRIBUTES: dict[str, type] = get_type_hints(MotorModel)
"""Fields of a motor, each with its type; a hand's file need not have those with a default."""


def motor_attribute(name: str) -> str:
    """What a field of :class:`MotorModel` is called in USD."""
    return "vd:motor:" + name.removesuffix("_rad")


@dataclass(frozen=True, eq=False)
class HandModel:
    """A hand as read from USD.

    F fingers of 1 to 6 joints, D joints, L = D + 1 links (``base`` is link 0).

    Joints and links are ordered by finger and from the palm: ``f0_j1, f0_j2, ..., f1_j1, ...``.
    Joints are all that move, those included that follow another one and have no motor.

    Attributes:
        name: Name of the hand.
        fingertip: Selected kind of fingertip.
        path: The file it was read from.
        layer: The layer over it with an identified servo model, if any
            (:mod:`vd.assets_usd.hand_layer`).
        fingers: Each finger's joints, as columns [F].
        mount: Pose of the base in the world [7].
        palm: Where the palm looks, a unit vector in the base frame [3].
        workspace: Where it handles objects.
        link_names: Names of the links [L].
        joint_names: Names of the joints [D].
        joint_parent: Index of each joint's parent link [D].
        joint_child: Index of each joint's child link [D].
        joint_axis: Unit axis in both joint frames [D, 3].
        joint_parent_frame: Pose of the joint frame in the parent link [D, 7].
        joint_child_frame: Pose of the joint frame in the child link [D, 7].
        lower: Lower limits [D] [rad].
        upper: Upper limits [D] [rad].
        kp: Drive stiffness [D] [N m/rad].
        kd: Drive damping [D] [N m s/rad].
        effort: Torque limits [D] [N m].
        velocity_limit: Speed limits [D] [rad/s].
        armature: Rotor inertia about each axis [D] [kg m^2].
        start: Angles at the start of an episode [D] [rad].
        mimic: Joint that each follows, or -1, int [D].
        mimic_factor: Its angle is that of the joint it follows times this, [D],
        mimic_offset: plus this [D] [rad].
        motors: Motor of each joint, as far as the file says it [D].
        servo: Servo model of each joint [D, P], P = PARAMETER_COLUMNS of
            :mod:`vd.kernels.servo.actuators`: drive, speed limit, armature, and every effect that
            the USD authors; SI units, radians.
        servo_interval: 95 % interval (low, high) of each number of ``servo`` [D, P, 2], NaN where
            none is known.
        link_mass: Masses [L] [kg].
        link_com: Centres of mass in the link frames [L, 3] [m].
        link_inertia: Inertia about the centre of mass in the link frames [L, 3, 3] [kg m^2].
        tip_link: Index of the link of each site [F].
        tip_frame: Pose of each site in its link [F, 7].
        mounted_camera: The depth camera, if it has one.
        point_link: Link whose frame each set of surface samples is in [P].
        link_points: Surface samples [P, 500, 3] [m]: of every link of the fingers, and of the base
            what the
            file samples: its first motors, not the palm, of D'Claw hands, as in the paper's
                released code.
        shapes: Colliders.
    """

    name: str
    fingertip: str
    path: Path
    layer: Path | None
    fingers: tuple[slice, ...]
    mount: np.ndarray
    palm: np.ndarray
    workspace: Workspace
    link_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    joint_parent: np.ndarray
    joint_child: np.ndarray
    joint_axis: np.ndarray
    joint_parent_frame: np.ndarray
    joint_child_frame: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    kp: np.ndarray
    kd: np.ndarray
    effort: np.ndarray
    velocity_limit: np.ndarray
    armature: np.ndarray
    start: np.ndarray
    mimic: np.ndarray
    mimic_factor: np.ndarray
    mimic_offset: np.ndarray
    motors: tuple[MotorModel | None, ...]
    servo: np.ndarray
    servo_interval: np.ndarray
    link_mass: np.ndarray
    link_com: np.ndarray
    link_inertia: np.ndarray
    tip_link: np.ndarray
    tip_frame: np.ndarray
    mounted_camera: CameraModel | None
    point_link: np.ndarray
    link_points: np.ndarray
    shapes: tuple[CollisionShape, ...]

    @property
    def num_fingers(self) -> int:
        """F."""
        return len(self.fingers)

    @property
    def num_joints(self) -> int:
        """D."""
        return len(self.joint_names)

    @property
    def joint_finger(self) -> np.ndarray:
        """Finger of each joint, int [D]."""
        return np.repeat(np.arange(self.num_fingers), self._finger_lengths)

    @property
    def _finger_lengths(self) -> list[int]:
        return [finger.stop - finger.start for finger in self.fingers]

    @property
    def joints_per_finger(self) -> int:
        """Joints of every finger.

        Raises:
            HandError: Its fingers differ.
        """
        counts = self._finger_lengths
        if len(set(counts)) > 1:
            raise HandError(
                f"{self.path}: the fingers of {self.name} have {counts} joints; what was asked for "
                "needs equal fingers: observe goals in the world frame (observation.view), "
                "without a camera"
            )
        return counts[0]

    @property
    def actuated(self) -> np.ndarray:
        """Joints that have a motor, and an action of the policy, int [A]."""
        return np.flatnonzero(self.mimic < 0)

    @property
    def camera(self) -> CameraModel:
        """The depth camera: the file's, or one that looks at where objects are handled.

        That one is above a palm that looks up, and before one that looks down.
        """
        if self.mounted_camera is not None:
            return self.mounted_camera
        x, _, z = np.eye(3)
        away, up = (z, x) if self.palm_up else (x, z)
        axes = np.column_stack([np.cross(up, away), -up, -away])
        position = self.workspace.goal_m + CAMERA_M * away
        pose = np.concatenate([position, Rotation.from_matrix(axes).as_quat()])
        in_base = compose(invert(self.mount), pose)
        near, far = RANGE_M
        return CameraModel(
            **vars(LENS), near=near, far=far, position=in_base[:3], quaternion=in_base[3:]
        )

    @property
    def goal_in_base(self) -> np.ndarray:
        """Where objects are handled, in the base frame [m] [3]."""
        return placed(invert(self.mount), np.array(self.workspace.goal_m))

    @property
    def down(self) -> np.ndarray:
        """Down, a unit vector in the base frame [3]."""
        return np.asarray(Rotation.from_quat(self.mount[3:]).as_matrix().T @ [0.0, 0.0, -1.0])

    @property
    def palm_up(self) -> bool:
        """Whether objects rest in the hand."""
        return bool(self.palm @ self.down < 0.0)

    def forward_kinematics(self, q: np.ndarray) -> np.ndarray:
        """Poses of all links in the base frame.

        Args:
            q: Joint positions [.., D] [rad].

        Returns:
            Poses [.., L, 7].

        Raises:
            ValueError: The last axis of ``q`` is not D long.
        """
        q = np.asarray(q, dtype=float)
        if q.shape[-1:] != (self.num_joints,):
            raise ValueError(
                f"{self.name}: q has shape {q.shape}; its last axis must be {self.num_joints} "
                f"joints"
            )
        poses = np.empty((*q.shape[:-1], len(self.link_names), 7))
        poses[..., 0, :] = pose_at(np.zeros(3))
        motion = np.zeros((*q.shape, 7))
        turns = Rotation.from_rotvec((q[..., None] * self.joint_axis).reshape(-1, 3))
        motion[..., 3:] = turns.as_quat().reshape(*q.shape, 4)
        for joint, frame in enumerate(self.joint_child_frame):  # parents before their children
            parent = poses[..., self.joint_parent[joint], :]
            pose = compose(compose(parent, self.joint_parent_frame[joint]), motion[..., joint, :])
            poses[..., self.joint_child[joint], :] = compose(pose, invert(frame))
        return poses

    def tip_poses(self, q: np.ndarray) -> np.ndarray:
        """Poses of the fingertip sites in the base frame, [.., F, 7], for ``q`` [.., D] [rad]."""
        return compose(self.forward_kinematics(q)[..., self.tip_link, :], self.tip_frame)


def compose(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Poses ``first * second``; [.., 7] each, broadcast against each other."""
    first, second = np.broadcast_arrays(
        np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    )
    a = first.reshape(-1, 7)
    b = second.reshape(-1, 7)
    turn = Rotation.from_quat(a[:, 3:]) * Rotation.from_quat(b[:, 3:])
    return np.concatenate([placed(a, b[:, :3]), turn.as_quat()], axis=1).reshape(first.shape)


def placed(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points [3] or [N, 3] of the frame of a pose in the outer frame.

    The pose is one [7], or each has its own [N, 7].
    """
    return np.asarray(Rotation.from_quat(pose[..., 3:]).apply(points) + pose[..., :3])


def pose_at(point: npt.ArrayLike) -> np.ndarray:
    """The pose [7] of a frame at a point [3] that is not turned."""
    return np.concatenate([point, [0.0, 0.0, 0.0, 1.0]])


def invert(pose: np.ndarray) -> np.ndarray:
    """The inverse of one pose [7]."""
    turn = Rotation.from_quat(pose[3:]).inv()
    return np.concatenate([-turn.apply(pose[:3]), turn.as_quat()])
