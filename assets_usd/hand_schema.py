"""The vocabulary in which a hand is described: solids, links, joints, surfaces, camera.

Units are SI and radians, quaternions are xyzw. The **base frame** has its origin on the mount plane
of the palm and +z along the straight fingers. The **finger frame** of a finger sits on its first
joint, z along base z and x along the finger's heading; the frames of its three links coincide with
it in orientation when all joints are zero.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Axis = Literal["X", "Y", "Z"]
Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]

IDENTITY: Quat = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Pose:
    """A rigid transform: position [m] and unit quaternion xyzw."""

    position: Vec3 = (0.0, 0.0, 0.0)
    quaternion: Quat = IDENTITY


@dataclass(frozen=True)
class Box:
    """A box of full extents ``size`` [m]; ``bevel`` [m] cuts its edges (drawing only)."""

    size: Vec3
    pose: Pose = Pose()
    bevel: float = 0.0


@dataclass(frozen=True)
class Sphere:
    """A sphere."""

    radius: float
    pose: Pose = Pose()


@dataclass(frozen=True)
class Capsule:
    """A capsule; ``length`` [m] is the distance between the centres of its hemispheres."""

    radius: float
    length: float
    pose: Pose = Pose()
    axis: Axis = "Z"


@dataclass(frozen=True)
class Cylinder:
    """A cylinder of full height ``length`` [m]; ``bevel`` [m] cuts its rims (drawing only)."""

    radius: float
    length: float
    pose: Pose = Pose()
    axis: Axis = "Z"
    bevel: float = 0.0


@dataclass(frozen=True)
class Taper:
    """A solid between a rectangle (``size`` [m], at z = 0) and a circle (``radius`` at z = ``length``)."""

    size: tuple[float, float]
    radius: float
    length: float
    pose: Pose = Pose()


Primitive = Box | Sphere | Capsule | Cylinder
Solid = Primitive | Taper


@dataclass(frozen=True)
class Collider:
    """A collision primitive in its link's frame; ``fingertip`` marks the part that the variant swaps."""

    name: str
    shape: Primitive
    fingertip: bool = False


@dataclass(frozen=True)
class Visual:
    """A drawn solid in its link's frame, in one of the materials of :attr:`HandSpec.colors`."""

    solid: Solid
    material: str


@dataclass(frozen=True)
class LinkSpec:
    """A rigid link: mass [kg], centre of mass [m] and diagonal inertia about it [kg m^2], link frame."""

    name: str
    mass: float
    com: Vec3
    inertia: Vec3
    colliders: tuple[Collider, ...]
    visuals: tuple[Visual, ...]


@dataclass(frozen=True)
class JointSpec:
    """A revolute joint with a position drive.

    Attributes:
        name: Suffix of the joint's name, e.g. ``j1``.
        axis: Axis of the link frame; positive by the right-hand rule.
        offset: Joint origin in the parent link's frame [m].
        lower: Lower limit [rad].
        upper: Upper limit [rad].
        kp: Drive stiffness [N m/rad].
        kd: Drive damping [N m s/rad].
        effort: Torque limit of the drive [N m].
        velocity: Speed limit [rad/s].
        armature: Inertia of the rotor about the joint axis [kg m^2].
    """

    name: str
    axis: Axis
    offset: Vec3
    lower: float
    upper: float
    kp: float
    kd: float
    effort: float
    velocity: float
    armature: float


@dataclass(frozen=True)
class SurfaceSpec:
    """Contact surface: friction and restitution coefficients, and contact compliance.

    ``stiffness`` and ``damping`` are Newton's contact gains, which SolverMuJoCo turns into the
    constraint's time constant 2/damping [s] and damping ratio damping/(2 sqrt(stiffness)).
    """

    friction: float
    restitution: float
    stiffness: float
    damping: float


@dataclass(frozen=True)
class FingertipSpec:
    """One kind of fingertip: its surface and its display colour (linear RGB)."""

    surface: SurfaceSpec
    color: Vec3


@dataclass(frozen=True)
class CameraSpec:
    """A pinhole camera.

    Attributes:
        width: Image width [px].
        height: Image height [px].
        fx: Horizontal focal length [px].
        fy: Vertical focal length [px].
        cx: Principal point, from the left edge of the image [px].
        cy: Principal point, from the top edge of the image [px].
        near: Nearest depth [m].
        far: Farthest depth [m].
        pose: Optical frame (x right, y down, z forward) in the base frame.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    near: float
    far: float
    pose: Pose


@dataclass(frozen=True)
class HandSpec:
    """A hand of identical three-joint fingers.

    Attributes:
        name: Name of the hand and of its root prim.
        palm: Colliders, drawing and inertia of the bare palm (link ``base``).
        motor: The first motor of a finger, fixed to the palm; in the finger frame.
        finger_frames: First-joint frame of each finger in the base frame.
        joints: The three joints of a finger, from the palm.
        links: The three links of a finger, from the palm.
        tip: Position of the fingertip site in the last link's frame [m].
        surface: Contact surface of everything but the fingertips.
        fingertips: The kinds of fingertip, by name; the first is the default.
        contact_gap: Distance at which contacts are looked for [m].
        colors: Display colour of each drawn material, linear RGB.
        camera: The depth camera.
        unreachable: Pairs of links, by name, that are not neighbours and yet cannot touch within the limits.
        note: What the description deviates in from its sources.
    """

    name: str
    palm: LinkSpec
    motor: LinkSpec
    finger_frames: tuple[Pose, ...]
    joints: tuple[JointSpec, JointSpec, JointSpec]
    links: tuple[LinkSpec, LinkSpec, LinkSpec]
    tip: Vec3
    surface: SurfaceSpec
    fingertips: Mapping[str, FingertipSpec]
    contact_gap: float
    colors: Mapping[str, Vec3]
    camera: CameraSpec
    unreachable: tuple[tuple[str, str], ...]
    note: str
