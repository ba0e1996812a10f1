"""A URDF or MJCF as links and joints with their frames, before anything is decided about it.

SI units, radians; poses are position and quaternion xyzw, [7]. What a file does not say is NaN.
"""

import math
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import HandError, compose
from vd.command.warp_quiet import quiet_warp

IDENTITY = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
UNLIMITED = 1e4
"""Angles and efforts from which a parser means that there is no limit."""
HARMLESS = ("texture", "opacity")
"""Words of what a parser says of looks alone; all else that it says has left something out."""


@dataclass
class Shape:
    """A collider or a drawing."""

    kind: str
    """``box``, ``sphere``, ``capsule``, ``cylinder``, ``mesh``, or what else the parser calls
    it.
    """
    size: tuple[float, ...]
    """As in :class:`vd.assets_usd.hand_data.CollisionShape`; empty for a mesh."""
    frame: np.ndarray
    """In its link [7]."""
    collides: bool
    vertices: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    faces: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int32))
    split: bool = False
    """Whether a mesh is cut into convex parts."""
    colour: tuple[float, ...] = (0.6, 0.6, 0.6)


@dataclass
class Link:
    """A rigid body, or a frame without mass."""

    name: str
    mass: float = 0.0
    com: np.ndarray = field(default_factory=lambda: np.zeros(3))
    inertia: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """About the centre of mass, in the axes of the link [3, 3]."""
    shapes: list[Shape] = field(default_factory=list)
    sites: dict[str, np.ndarray] = field(default_factory=dict)
    """Marked frames [7]."""


@dataclass
class Joint:
    """Joins two links; at angle q the child is at ``parent_frame rot(axis, q) child_frame^-1``."""

    name: str
    kind: str
    """``revolute``, ``fixed``, or what it is called."""
    parent: int
    child: int
    axis: np.ndarray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    parent_frame: np.ndarray = field(default_factory=lambda: IDENTITY.copy())
    child_frame: np.ndarray = field(default_factory=lambda: IDENTITY.copy())
    lower: float = math.nan
    upper: float = math.nan
    effort: float = math.nan
    velocity: float = math.nan
    armature: float = math.nan
    kp: float = math.nan
    kd: float = math.nan
    """Of its drive."""
    damping: float = 0.0
    """Of the joint itself, whatever drives it."""
    mimic: tuple[str, float, float] | None = None
    """The joint that it follows, factor and offset."""


@dataclass
class Actuator:
    """What turns one joint, or a tendon's, by the sum of their angles, each times a ratio."""

    name: str
    """Of the tendon, or of the actuator."""
    ratios: dict[str, float]
    """By the joints' names."""
    kp: float = math.nan
    kd: float = math.nan
    effort: float = math.nan


@dataclass
class Source:
    """What a file holds."""

    path: Path
    name: str
    links: list[Link]
    joints: list[Joint]
    notes: list[str] = field(default_factory=list)
    """What is said about the file."""
    problems: list[str] = field(default_factory=list)
    """What stands against it."""
    actuators: list[Actuator] = field(default_factory=list)
    apart: list[tuple[str, str]] = field(default_factory=list)
    """Links whose contact is off."""


def lead(joints: dict[str, Joint], name: str) -> tuple[str, float, float]:
    """The joint that moves another in the end, or that itself; factor and offset [rad]."""
    factor = 1.0
    offset = 0.0
    for _ in joints:  # a joint that follows a follower follows what that does
        if name not in joints or (above := joints[name].mimic) is None:
            break
        offset += factor * above[2]
        factor *= above[1]
        name = above[0]
    return name, factor, offset


def read_source(path: Path) -> Source:
    """Read a URDF or MJCF.

    Raises:
        HandError: It is missing, of another format, or cannot be parsed.
    """
    path = Path(path)
    if not path.is_file():
        raise HandError(f"{path}: no such file; give a URDF, or an MJCF")
    text = path.read_text(errors="replace")
    if "<robot" in text:
        read = _read_urdf
    elif "<mujoco" in text:
        read = _read_mjcf
    else:
        raise HandError(
            f"{path}: neither a URDF nor an MJCF; expand a xacro first, export others to URDF"
        )
    quiet_warp()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            source = read(path)
        except ImportError as error:  # of what reads a mesh
            raise HandError(
                f"{path}: a mesh cannot be read, {error}: COLLADA (.dae) needs it; or convert the "
                f"mesh to OBJ or STL"
            ) from error
        except Exception as error:  # whatever a parser raises: the file is at fault
            xacro = "<xacro:" in text or "${" in str(error)
            remedy = f"; expand it first: xacro {path.name} > hand.urdf" if xacro else ""
            raise HandError(f"{path}: cannot be parsed: {error}{remedy}") from error
    for heard, kind in dict.fromkeys(
        (" ".join(str(one.message).split()), one.category) for one in said
    ):
        if any(word in heard for word in HARMLESS) or issubclass(kind, DeprecationWarning):
            source.notes.append(f"the parser says: {heard}")
        elif "package" in heard:
            heard = heard.partition(" For robust")[0]
            source.problems.append(
                f"{heard} Name a folder above {path.name} so, or write relative paths"
            )
        else:
            file = "; put the file there" if "exist" in heard or "found" in heard else ""
            source.problems.append(f"the parser says: {heard}{file}")
    return source


def _read_urdf(path: Path) -> Source:
    import newton

    builder = newton.ModelBuilder()
    builder.default_shape_cfg.density = 0.0  # masses are those of the file
    builder.add_urdf(str(path))
    kinds = {newton.GeoType.MESH: "mesh", newton.GeoType.CONVEX_MESH: "mesh"}
    label = builder.articulation_label[0] if builder.articulation_label else ""
    short = [body.removeprefix(f"{label}/") for body in builder.body_label]
    links = [
        Link(
            name,
            float(builder.body_mass[i]),
            np.array(builder.body_com[i], dtype=float),
            np.array(builder.body_inertia[i], dtype=float).reshape(3, 3),
        )
        for i, name in enumerate(short)
    ]
    for i, body in enumerate(builder.shape_body):
        kind = newton.GeoType(builder.shape_type[i])
        scale = tuple(float(s) for s in builder.shape_scale[i])
        shape = Shape(
            kinds.get(kind, kind.name.lower()),
            scale[: {"box": 3, "sphere": 1}.get(kind.name.lower(), 2)],
            np.array(builder.shape_transform[i], dtype=float),
            bool(builder.shape_flags[i] & newton.ShapeFlags.COLLIDE_SHAPES),
            colour=tuple(float(c) for c in builder.shape_color[i]),
        )
        if shape.kind == "mesh":
            mesh = builder.shape_source[i]
            shape.vertices = np.array(mesh.vertices, dtype=float) * scale
            shape.faces = np.array(mesh.indices, dtype=np.int32).reshape(-1, 3)
            if trimesh.Trimesh(shape.vertices, shape.faces, process=False).volume < 0.0:
                shape.faces = shape.faces[:, ::-1]  # a scale that mirrors, as of left hands
            shape.size = ()
        links[body].shapes.append(shape)
    names = [joint.removeprefix(f"{label}/") for joint in builder.joint_label]
    joints: list[Joint] = []
    source = Source(path, label or path.stem, links, joints)
    _check_urdf_names(source)
    friction = {}
    for i, name in enumerate(names):
        if builder.joint_parent[i] < 0:
            continue  # what fixes it to the world
        kind = newton.JointType(builder.joint_type[i])
        dof = builder.joint_qd_start[i]
        joint = Joint(name, kind.name.lower(), builder.joint_parent[i], builder.joint_child[i])
        joint.parent_frame = np.array(builder.joint_X_p[i], dtype=float)
        joint.child_frame = np.array(builder.joint_X_c[i], dtype=float)
        joints.append(joint)
        if kind != newton.JointType.REVOLUTE:
            continue
        axis = np.array(builder.joint_axis[dof], dtype=float)
        if not np.linalg.norm(axis) > 0.0:
            source.problems.append(f"{name} has no axis but 0 0 0; give it one")
            continue
        joint.axis = axis / np.linalg.norm(axis)
        joint.lower, joint.upper = (
            _bounded(values[dof])
            for values in (builder.joint_limit_lower, builder.joint_limit_upper)
        )
        joint.effort = _bounded(builder.joint_effort_limit[dof]) or math.nan
        joint.velocity = _bounded(builder.joint_velocity_limit[dof]) or math.nan
        joint.damping = float(builder.joint_damping[dof])
        friction[name] = builder.joint_friction[dof]
        if (leader := builder.joint_mimic_joint[i]) >= 0:
            offset, factor = builder.joint_mimic_coeffs[i]
            joint.mimic = names[leader], float(factor), float(offset)
    _leave_out(source, "dry friction", friction)
    return source


def _check_urdf_names(source: Source) -> None:
    """Names that stand for two, and links that no joint joins."""
    root = ElementTree.parse(source.path).getroot()
    for kind in ("link", "joint"):
        counts = Counter(str(element.get("name")) for element in root.findall(kind))
        twice = [name for name, count in counts.items() if count > 1]
        source.problems += [
            f"{name} is the name of more than one {kind}; rename them" for name in twice
        ]
        if kind == "link":
            alone = counts.keys() - {link.name for link in source.links}
            source.notes += [
                f"{name} is joined to nothing and is left out" for name in sorted(alone)
            ]


def _leave_out(source: Source, what: str, values: dict[str, float]) -> None:
    """Say what of joints or links a hand has no place for."""
    names = [name for name, value in values.items() if value]
    if names:
        source.notes.append(f"{what} is left out: of {', '.join(names)}")


def _bounded(value: float) -> float:
    """A limit; NaN where a parser put a number that is none."""
    return float(value) if abs(value) < UNLIMITED else math.nan


def _read_mjcf(path: Path) -> Source:
    model: Any = mujoco.MjModel.from_xml_path(str(path))
    source = Source(path, model.names.split(b"\0")[0].decode() or path.stem, [], [])
    for i in range(1, model.nbody):
        turn = Rotation.from_quat(model.body_iquat[i][[1, 2, 3, 0]]).as_matrix()
        source.links.append(
            Link(
                model.body(i).name or f"body {i}",
                float(model.body_mass[i]),
                model.body_ipos[i].copy(),
                turn @ np.diag(model.body_inertia[i]) @ turn.T,
            )
        )
        _mjcf_joints(model, i, source)
    for geom in np.flatnonzero(model.geom_bodyid > 0):
        source.links[model.geom_bodyid[geom] - 1].shapes.append(_mjcf_shape(model, int(geom)))
    for site in np.flatnonzero(model.site_bodyid > 0):
        pose = _pose(model.site_pos[site], model.site_quat[site])
        source.links[model.site_bodyid[site] - 1].sites[model.site(site).name] = pose
    for signature in model.exclude_signature:
        bodies = signature >> 16, signature & 0xFFFF
        if min(bodies) > 0:
            first, second = (source.links[body - 1].name for body in bodies)
            source.apart.append((first, second))
    _mjcf_equalities(model, source)
    _mjcf_actuators(model, source)
    joints = {_joint_name(model, i): i for i in range(model.njnt)}
    for what, values, number in (
        ("dry friction", model.dof_frictionloss, model.jnt_dofadr),
        ("the spring", model.jnt_stiffness, np.arange(model.njnt)),
    ):
        _leave_out(source, what, {name: float(values[number[i]]) for name, i in joints.items()})
    lifted = {model.body(i).name: float(model.body_gravcomp[i]) for i in range(1, model.nbody)}
    _leave_out(source, "compensation of gravity", lifted)
    return source


def _pose(position: np.ndarray, wxyz: np.ndarray) -> np.ndarray:
    return np.concatenate([position, wxyz[[1, 2, 3, 0]]])


def _joint_name(model: Any, joint: int) -> str:
    """Its name, or one that says whose it is."""
    body = model.body(model.jnt_bodyid[joint])
    return str(model.joint(joint).name or f"the joint of {body.name or f'body {body.id}'}")


def _mjcf_joints(model: Any, body: int, source: Source) -> None:
    """The joint of a body: none is a fixed one, more than one are none that a hand has."""
    first = model.body_jntadr[body]
    count = model.body_jntnum[body]
    parent = model.body_parentid[body] - 1
    place = _pose(model.body_pos[body], model.body_quat[body])
    link = source.links[body - 1].name
    names = [_joint_name(model, i) for i in range(first, first + count)]
    if parent < 0:
        if count:
            source.notes.append(
                f"{link} is free to move in the file, by {', '.join(names)}; here it is fixed"
            )
        return
    if count == 0:
        source.joints.append(
            Joint(f"weld of {link}", "fixed", parent, body - 1, parent_frame=place)
        )
        return
    if count > 1:
        source.problems.append(
            f"{link} has {count} joints, {', '.join(names)}; put a body between them"
        )
    kind = mujoco.mjtJoint(model.jnt_type[first])
    joint = Joint(names[0], kind.name[6:].lower(), parent, body - 1)
    joint.child_frame = np.concatenate([model.jnt_pos[first], [0.0, 0.0, 0.0, 1.0]])
    joint.parent_frame = compose(place, joint.child_frame)
    source.joints.append(joint)
    if kind != mujoco.mjtJoint.mjJNT_HINGE:
        return
    joint.kind = "revolute"
    joint.axis = model.jnt_axis[first].copy()
    zero = model.qpos0[model.jnt_qposadr[first]]
    dof = model.jnt_dofadr[first]
    if zero:
        source.notes.append(f"{joint.name} counts from {zero:g} rad in the file (ref); here from 0")
    if model.jnt_limited[first]:
        joint.lower, joint.upper = (float(end - zero) for end in model.jnt_range[first])
    joint.armature = float(model.dof_armature[dof]) or math.nan
    joint.damping = float(model.dof_damping[dof])
    if model.jnt_actfrclimited[first]:
        joint.effort = float(np.abs(model.jnt_actfrcrange[first]).max())


def _mjcf_shape(model: Any, geom: int) -> Shape:
    kind = mujoco.mjtGeom(model.geom_type[geom]).name[7:].lower()
    shape = Shape(
        kind,
        tuple(
            model.geom_size[geom][: {"box": 3, "ellipsoid": 3, "sphere": 1}.get(kind, 2)].tolist()
        ),
        _pose(model.geom_pos[geom], model.geom_quat[geom]),
        bool(model.geom_contype[geom] or model.geom_conaffinity[geom]),
        colour=tuple(model.geom_rgba[geom][:3].tolist()),
    )
    if kind == "mesh":
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        count = model.mesh_vertnum[mesh]
        shape.vertices = model.mesh_vert[first : first + count].astype(float)
        first = model.mesh_faceadr[mesh]
        count = model.mesh_facenum[mesh]
        shape.faces = model.mesh_face[first : first + count].copy()
        shape.size = ()
    return shape


def _mjcf_equalities(model: Any, source: Source) -> None:
    """Couplings of two joints by a line are joints that follow; all others are problems."""
    joints = {joint.name: joint for joint in source.joints}
    for i in range(model.neq):
        if not model.eq_active0[i]:
            continue
        kind = mujoco.mjtEq(model.eq_type[i])
        data = model.eq_data[i]
        name = model.eq(i).name or f"equality {i}"
        if kind != mujoco.mjtEq.mjEQ_JOINT or model.eq_obj2id[i] < 0 or np.any(data[2:5]):
            text = kind.name[5:].lower()
            source.problems.append(
                f"{name} ({text}) couples more than a line; remove it and use hold or mimic"
            )
            continue
        one, other = (
            _joint_name(model, number[i]) for number in (model.eq_obj1id, model.eq_obj2id)
        )
        if one in joints:
            joints[one].mimic = other, float(data[1]), float(data[0])


def _mjcf_actuators(model: Any, source: Source) -> None:
    """What turns joints, by themselves or by a tendon of several: gains and limits of force."""
    by_tendon = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)
    idle = sorted(set(range(model.ntendon)) - set(model.actuator_trnid[by_tendon, 0]))
    if idle:
        names = ", ".join(model.tendon(i).name for i in idle)
        source.notes.append(f"tendons without a motor are left out: {names}")
    for i in range(model.nu):
        gear = float(model.actuator_gear[i, 0]) or 1.0
        ratios = {joint: gear * ratio for joint, ratio in _moved(model, i, source).items()}
        actuator = Actuator(_actuator_name(model, i), ratios)
        if model.actuator_forcelimited[i]:
            actuator.effort = float(np.abs(model.actuator_forcerange[i]).max())
        elif (
            model.actuator_ctrllimited[i]
            and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE
        ):
            actuator.effort = float(
                np.abs(model.actuator_gainprm[i, 0] * model.actuator_ctrlrange[i]).max()
            )
        if model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE:
            actuator.kp, actuator.kd = (-float(b) for b in model.actuator_biasprm[i, 1:3])
        source.actuators.append(actuator)


def _actuator_name(model: Any, actuator: int) -> str:
    """The name of the tendon that it pulls, or its own."""
    if model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_TENDON:
        return str(model.tendon(model.actuator_trnid[actuator, 0]).name)
    return str(model.actuator(actuator).name or f"actuator {actuator}")


def _moved(model: Any, actuator: int, source: Source) -> dict[str, float]:
    """Joints that an actuator moves, and the coefficient of each."""
    kind = model.actuator_trntype[actuator]
    target = model.actuator_trnid[actuator, 0]
    name = model.actuator(actuator).name or f"actuator {actuator}"
    if model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_MUSCLE:
        source.problems.append(f"{name} is a muscle, which only pulls; make it a motor")
    if kind == mujoco.mjtTrn.mjTRN_JOINT:
        return {_joint_name(model, target): 1.0}
    wraps = range(0)
    if kind == mujoco.mjtTrn.mjTRN_TENDON:
        wraps = range(model.tendon_adr[target], model.tendon_adr[target] + model.tendon_num[target])
    if not wraps or any(model.wrap_type[w] != mujoco.mjtWrap.mjWRAP_JOINT for w in wraps):
        source.problems.append(
            f"{name} pulls at no joint but over sites; give its joints motors of their own"
        )
        return {}
    return {_joint_name(model, model.wrap_objid[w]): float(model.wrap_prm[w]) for w in wraps}
