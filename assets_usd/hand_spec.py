"""The two D'Claw hands as data: the one place where hand numbers are written down.

Everything downstream (simulator, training, deployment) reads the USD that
:mod:`vd.assets_usd.hand_author` writes from this description, never this description itself. Units
and frames are those of :mod:`vd.assets_usd.hand_schema`. For both hands +q1 (about +x of the finger
frame) moves the tip clockwise about base +z, +q2 and +q3 (about +y) move it outward.

Tags: [U] four-finger URDF of a public fork of the released code, [R] ROBEL D'Claw, [C] released
code, [P] paper, [D] derived here (the derivation is given), [A] our assumption, no source known.
"""

from collections.abc import Mapping
from math import cos, pi, radians, sin
from types import MappingProxyType

from vd.assets_usd.hand_schema import (
    Axis,
    Box,
    CameraSpec,
    Capsule,
    Collider,
    Cylinder,
    FingertipSpec,
    HandSpec,
    JointSpec,
    LinkSpec,
    Pose,
    Quat,
    Solid,
    SurfaceSpec,
    Taper,
    Vec3,
    Visual,
)

# --- Finger, common to both hands ([U] via task facts 2.1; L is the distance along the finger) ---

JOINT_SPACING = 0.0685  # [U] J1-J2 and J2-J3
TIP_DISTANCE = 0.075  # [U] J3 to the k_tip frame
TIP_RADIUS = 0.0101  # [U] fingertip cylinder and hemisphere
TIP_CENTRE = 0.0737  # [U] L of the centre of the hemisphere

MOTOR_SIZE = (0.0285, 0.0340, 0.0465)  # [R] servo across, along its horn axis, long side (maker's drawing)
MOTOR_END = 0.0804  # [U] L of the far end of the motor on k1 and k2
PLASTIC_BEVEL = 0.0015  # [A] rounding of the servo's edges, drawing only
HORN_RADIUS, HORN_HEIGHT = 0.009, 0.0025  # [U] 39 mm over both horns; [A] radius, drawing only
PLATE_BEVEL = 0.0005  # [A] drawing only

ACRYLIC, PLASTIC, METAL, PRINT, TIP = "plate", "servo", "bracket", "printed", "fingertip"
COLORS: Mapping[str, Vec3] = MappingProxyType(  # [A] after photographs of the hand
    {
        ACRYLIC: (0.62, 0.64, 0.66),
        PLASTIC: (0.03, 0.03, 0.035),
        METAL: (0.42, 0.43, 0.45),
        PRINT: (0.09, 0.10, 0.12),
    }
)


def _box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], bevel: float = 0.0) -> Box:
    """The box that fills three intervals [m]."""
    size = (x[1] - x[0], y[1] - y[0], z[1] - z[0])
    centre = ((x[0] + x[1]) / 2, (y[0] + y[1]) / 2, (z[0] + z[1]) / 2)
    return Box(size, Pose(centre), bevel)


def _bracket(
    axis: Axis, inner: float, outer: float, z: tuple[float, float], half_width: float
) -> tuple[Visual, ...]:
    """A U-shaped bracket: two plates at +-[inner, outer] on the joint axis, and a floor at the far end."""
    floor_thickness = outer - inner
    width = (-half_width, half_width)
    plates = []
    for low, high in ((inner, outer), (-outer, -inner)):
        x, y = ((low, high), width) if axis == "X" else (width, (low, high))
        plates.append(Visual(_box(x, y, z, PLATE_BEVEL), METAL))
    across = (-outer, outer)
    x, y = (across, width) if axis == "X" else (width, across)
    return (*plates, Visual(_box(x, y, (z[1] - floor_thickness, z[1]), PLATE_BEVEL), METAL))


def _servo(centre: Vec3, horn: Vec3, axis: Axis, size: Vec3) -> tuple[Visual, ...]:
    """A servo of full extents ``size`` with a horn disc on each side along ``axis``."""
    index = "XYZ".index(axis)
    discs = []
    for sign in (-1.0, 1.0):
        position = list(horn)
        position[index] += sign * (size[index] + HORN_HEIGHT) / 2
        disc = Cylinder(HORN_RADIUS, HORN_HEIGHT, Pose((position[0], position[1], position[2])), axis)
        discs.append(Visual(disc, METAL))
    return (Visual(Box(size, Pose(centre), PLASTIC_BEVEL), PLASTIC), *discs)


def _middle_link(name: str, joint_axis: Axis, inertia: Vec3) -> LinkSpec:
    """k1 or k2: a bracket on its own joint, a clamp, and the servo of the next joint (axis y)."""
    across, along_axis, long_side = MOTOR_SIZE
    servo = _servo(
        (0.0, 0.0, MOTOR_END - long_side / 2),
        (0.0, 0.0, JOINT_SPACING),
        "Y",
        (across, along_axis, long_side),
    )
    # [U] plates +-(15.4..21.2) mm x L -3.2..28.2, half-width 13.0; drawn as the 1.6 mm outside the servo.
    bracket = _bracket(joint_axis, 0.0196, 0.0212, (-0.0032, 0.0282), 0.0130)
    # [R] the clamp of the STL
    clamp = Visual(_box((-0.0120, 0.0120), (-0.0205, 0.0205), (0.0265, 0.0342), PLATE_BEVEL), METAL)
    # [U] motor body 30.0 x 57.4 x 39.2 mm, L 23.0-80.4. The bracket has no collider: it stands out of the
    # previous servo's box by 1.6 mm and can touch nothing that this box or that one does not touch first.
    body = _box((-0.0150, 0.0150), (-0.0196, 0.0196), (0.0230, MOTOR_END))
    return LinkSpec(
        name=name,
        mass=0.093,  # [U]
        com=(0.0, 0.0, 0.0505),  # [U]
        inertia=inertia,
        colliders=(Collider("motor", body),),
        visuals=(*bracket, clamp, *servo),
    )


# [U] gives inertias in URDF axes (lateral, along, third). "Lateral" is read as the joint axis of k2 and k3:
# the servo is 39 mm long there and 28.5 mm across, so the smaller of the two is about that axis [D].
LINK_1 = _middle_link("l1", "X", (1.336e-5, 1.345e-5, 1.001e-5))  # [U]
LINK_2 = _middle_link("l2", "Y", (1.505e-5, 1.176e-5, 1.001e-5))  # [U]

COLLAR_TOP = 0.0347  # [U]
COLLAR = _box((-0.0133, 0.0133), (-0.0242, 0.0242), (0.0277, COLLAR_TOP))  # [U]
NECK_TOP = 0.0440  # [U] the round fingertip begins here
NECK = ((-0.0132, 0.0132), (-0.0119, 0.0119))  # [U] across the joint axis, and along it
_NECK_TAPER = Taper(
    (NECK[0][1] - NECK[0][0], NECK[1][1] - NECK[1][0]),
    TIP_RADIUS,
    NECK_TOP - COLLAR_TOP,
    Pose((0.0, 0.0, COLLAR_TOP)),
)


def _upright_capsule(start: float) -> Capsule:
    """The fingertip, with the centre of its lower hemisphere at L = ``start`` [m]."""
    return Capsule(TIP_RADIUS, TIP_CENTRE - start, Pose((0.0, 0.0, (TIP_CENTRE + start) / 2)))


LINK_3 = LinkSpec(
    name="l3",
    mass=0.025,  # [U]; the 0.1 g that the URDF gives its tip frame is dropped
    com=(0.0, 0.0, 0.0409),  # [U]
    inertia=(1.034e-5, 7.84e-6, 5.03e-6),  # [U]
    colliders=(
        Collider("collar", COLLAR),
        # [U] cylinder L 44-73.7 and hemisphere. The lower end is drawn down to the collar, so that one
        # capsule also covers the neck (+-11.9 x +-13.2 mm) to within 3.1 mm; above L = 44 it is exact.
        Collider("tip", _upright_capsule(COLLAR_TOP), fingertip=True),
    ),
    visuals=(
        *_bracket("Y", 0.0188, 0.0206, (-0.0027, 0.0226), 0.0101),  # [U]
        Visual(_box(*NECK, (0.0226, COLLAR_TOP)), PRINT),  # [U]
        Visual(Box(COLLAR.size, COLLAR.pose, PLASTIC_BEVEL), PRINT),
        Visual(_NECK_TAPER, PRINT),
        Visual(_upright_capsule(NECK_TOP), TIP),
    ),
)

# [U] box 29.5 x 47.2 x 39 mm with the J1 axis (x) 11.6 mm from its near end; 29.5 mm is the height above the
# palm [R: box .024 x .0175 x .015 lying flat]. It extends to +y: J1 turns to 1.35 rad towards -y, where the
# near end leaves room, and only to -0.45 rad towards +y [D].
BASE_MOTOR_SIZE = (0.0390, 0.0472, 0.0295)
BASE_MOTOR_CENTRE = (0.0, 0.0472 / 2 - 0.0116, 0.0)
BASE_MOTOR = LinkSpec(
    name="motor",
    mass=0.093,  # [U]
    com=(0.0, 0.0116, 0.0),  # [U] 11.6 mm from the axis, towards the body of the motor
    inertia=(1.198e-5, 7.01e-6, 1.054e-5),  # [U]
    colliders=(Collider("motor", Box(BASE_MOTOR_SIZE, Pose(BASE_MOTOR_CENTRE))),),
    visuals=_servo(BASE_MOTOR_CENTRE, (0.0, 0.0, 0.0), "X", (MOTOR_SIZE[1], *BASE_MOTOR_SIZE[1:])),
)

EFFORT = 2.6  # [C]
ARMATURE = 0.001  # [R]
SWING_LIMITS = (-0.45, 1.35)  # [U], and [R] MJCF range
BEND_LIMITS = (-2.0, 2.0)  # [U], and [R] MJCF range


def _joints(first_offset: Vec3) -> tuple[JointSpec, JointSpec, JointSpec]:
    """The joints of a finger: gains, effort and velocity from system identification [C]."""
    along = (0.0, 0.0, JOINT_SPACING)
    return (
        JointSpec("j1", "X", first_offset, *SWING_LIMITS, 2.772, 0.2739, EFFORT, 6.552, ARMATURE),
        JointSpec("j2", "Y", along, *BEND_LIMITS, 3.559, 0.3824, EFFORT, 7.759, ARMATURE),
        JointSpec("j3", "Y", along, *BEND_LIMITS, 3.559, 0.3824, EFFORT, 7.759, ARMATURE),
    )


# --- Surfaces and camera ---

FRICTION, RESTITUTION = 0.8, 0.5  # [C] hand, before randomisation
HARD_STIFFNESS, HARD_DAMPING = 2500.0, 100.0  # [A] MuJoCo's default constraint: 20 ms, critically damped
SOFT_STIFFNESS, SOFT_DAMPING = 625.0, 50.0  # [A] 40 ms, critically damped: a quarter of the stiffness
SOFT_FRICTION = 1.2  # [A] the paper says only that the elastomer raises friction and compliance

HARD_SURFACE = SurfaceSpec(FRICTION, RESTITUTION, HARD_STIFFNESS, HARD_DAMPING)
FINGERTIPS: Mapping[str, FingertipSpec] = MappingProxyType(
    {
        "rigid": FingertipSpec(HARD_SURFACE, (0.82, 0.80, 0.74)),  # [P] 3-D printed
        "soft": FingertipSpec(  # [P] elastomer over a rigid skeleton of the same outer shape
            SurfaceSpec(SOFT_FRICTION, RESTITUTION, SOFT_STIFFNESS, SOFT_DAMPING), (0.35, 0.36, 0.38)
        ),
    }
)
CONTACT_GAP = 0.002  # [C] contact_offset

CAMERA = CameraSpec(
    width=320,  # [C]
    height=180,  # [C]
    fx=256.05,  # [D] horizontal field of view of 64 degrees [C]
    fy=256.05,  # [D]
    cx=160.0,  # [D]
    cy=90.0,  # [D]
    near=0.05,  # [A] nearer than anything in the scene, 0.3 m at least
    far=1.5,  # [C] depth is clipped here
    pose=Pose((0.573827, 0.0339394, -0.0351936), (0.371878, -0.382269, -0.601543, 0.594747)),  # [C]
)


# --- The hands ---


def _about_z(angle: float) -> Quat:
    """Rotation by ``angle`` [rad] about z."""
    return (0.0, 0.0, sin(angle / 2), cos(angle / 2))


def _finger_frame(heading: float, offset: Vec3) -> Pose:
    """The frame at ``offset`` [m] of a frame that is turned by ``heading`` [rad] about base z."""
    c, s = cos(heading), sin(heading)
    x, y, z = offset
    return Pose((c * x - s * y, s * x + c * y, z), _about_z(heading))


def _box_inertia(mass: float, size: Vec3) -> Vec3:
    """Diagonal inertia [kg m^2] of a homogeneous box."""
    x, y, z = size
    return (mass * (y * y + z * z) / 12, mass * (x * x + z * z) / 12, mass * (x * x + y * y) / 12)


def _palm(mass: float, collider: Box, drawing: Solid) -> LinkSpec:
    """The bare palm; its inertia is that of its collision box (the palm never moves)."""
    return LinkSpec(
        name="base",
        mass=mass,
        com=collider.pose.position,
        inertia=_box_inertia(mass, collider.size),
        colliders=(Collider("palm", collider),),
        visuals=(Visual(drawing, ACRYLIC),),
    )


def _pairs(fingers: int, *relations: tuple[str, str, int]) -> tuple[tuple[str, str], ...]:
    """Link pairs of all fingers: link ``a`` of finger k with link ``b`` of finger k + ``step``."""
    names = [
        tuple(sorted((f"f{k}_{a}", f"f{(k + step) % fingers}_{b}")))
        for a, b, step in relations
        for k in range(fingers)
    ]
    return tuple(dict.fromkeys((first, second) for first, second in names))


PLATE_SIDE, PLATE_THICKNESS = 0.260, 0.00635  # [U]
_PLATE = _box((-PLATE_SIDE / 2, PLATE_SIDE / 2), (-PLATE_SIDE / 2, PLATE_SIDE / 2), (0.0, PLATE_THICKNESS))
_DCLAW4_HEADINGS = tuple(radians(d) for d in (-105.31, -15.31, 74.69, 164.69))  # [U] one, two, three, four
DCLAW4 = HandSpec(
    name="dclaw4",
    palm=_palm(0.124, _PLATE, Box(_PLATE.size, _PLATE.pose, PLASTIC_BEVEL)),  # [U] mass
    motor=BASE_MOTOR,
    finger_frames=tuple(_finger_frame(h, (0.0878, -0.0375, 0.0206)) for h in _DCLAW4_HEADINGS),  # [U]
    joints=_joints((0.0, 0.0, 0.0)),
    links=(LINK_1, LINK_2, LINK_3),
    tip=(0.0, 0.0, TIP_DISTANCE),
    surface=HARD_SURFACE,
    fingertips=FINGERTIPS,
    contact_gap=CONTACT_GAP,
    colors=COLORS,
    camera=CAMERA,
    # [D] least distance of the colliders over the joint limits, by random search with refinement, in mm
    unreachable=_pairs(
        4,
        ("l1", "l3", 0),  # 7.9
        ("l1", "l1", 1),  # 57
        ("l2", "l1", 1),  # 43: the pinwheel turns a finger away from one of its neighbours
        ("l3", "l1", 1),  # 39
        ("l1", "l1", 2),  # 145
        ("l1", "l2", 2),  # 78
        ("l1", "l3", 2),  # 8.3
        ("l2", "l2", 2),  # 12
    ),
    note="The URDF's residual tilt of 0.54 degrees per finger (rpy 1.5802 for 1.5708) is dropped.",
)

DISC_RADIUS, DISC_THICKNESS = 0.075, 0.008  # [R] base cylinder, centred on the mount plane
# The disc collides as a square of the same area: cylinders are the weak primitive of MuJoCo Warp
# (cylinder-box multi-contact), and the palm is out of reach of all but the largest objects [D].
_DISC_HALF = DISC_RADIUS * pi**0.5 / 2
_DISC = _box((-_DISC_HALF, _DISC_HALF), (-_DISC_HALF, _DISC_HALF), (-DISC_THICKNESS / 2, DISC_THICKNESS / 2))
DCLAW3 = HandSpec(
    name="dclaw3",
    palm=_palm(0.110, _DISC, Cylinder(DISC_RADIUS, DISC_THICKNESS, bevel=PLASTIC_BEVEL)),  # [R] mass
    motor=BASE_MOTOR,
    finger_frames=tuple(
        _finger_frame(radians(azimuth), (0.060, 0.0, 0.01725))  # [R] radius and height of J1
        for azimuth in (-60.0, 60.0, 180.0)  # [R] FF, MF, TH
    ),
    joints=_joints((0.0, 0.0, 0.0)),
    links=(LINK_1, LINK_2, LINK_3),
    tip=(0.0, 0.0, TIP_DISTANCE),
    surface=HARD_SURFACE,
    fingertips=FINGERTIPS,
    contact_gap=CONTACT_GAP,
    colors=COLORS,
    camera=CAMERA,
    unreachable=_pairs(3, ("l1", "l3", 0), ("l1", "l1", 1)),  # [D] 7.9 and 23 mm, as for dclaw4
    note=(
        "The paper's own three-finger model is not public: ROBEL's palm carries the fingers of dclaw4. "
        "Positive J2 and J3 move the tip outward as in dclaw4; ROBEL's own sign is the opposite, and its "
        "links are 67.5 and 68.0 mm long and 0.105, 0.105 and 0.032 kg heavy."
    ),
)

HANDS: Mapping[str, HandSpec] = MappingProxyType({hand.name: hand for hand in (DCLAW3, DCLAW4)})
"""Every hand by name."""
