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
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import HandError, compose, pose_at
from vd.assets_usd.objects.geometry import Solid, mesh_volume
from vd.command.warp_quiet import quiet_warp

IDENTITY = pose_at(np.zeros(3))
UNLIMITED = 1e4
"""Angles and efforts from which a parser means that there is no limit."""
SIZE_NUMBERS = {"box": 3, "ellipsoid": 3, "sphere": 1, "mesh": 0}
"""Numbers in the size of a shape; of other kinds there are two."""
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
    collides: bool = True
    vertices: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    faces: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int32))
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

    @property
    def colliders(self) -> list[Shape]:
        """What collides."""
        return [shape for shape in self.shapes if shape.collides]

    def take(self, body: Solid) -> None:
        """Take mass, centre and inertia of a body in the axes of the link [kg]."""
        self.mass, self.com, self.inertia = body


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
    links: list[Link] = field(default_factory=list)
    joints: list[Joint] = field(default_factory=list)
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
    with warnings.catch_warnings(record=True) as caught:
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
    for warning in caught:
        _note_warning(source, " ".join(str(warning.message).split()), warning.category)
    source.notes = list(dict.fromkeys(source.notes))
    source.problems = list(dict.fromkeys(source.problems))
    return source


def _note_warning(source: Source, text: str, kind: type[Warning]) -> None:
    """Take what a parser warns of as a problem, unless it matters to looks alone."""
    if issubclass(kind, DeprecationWarning) or any(word in text for word in HARMLESS):
        source.notes.append(f"the parser says: {text}")
    elif "package" in text:
        short = text.partition(" For robust")[0]
        name = source.path.name
        source.problems.append(f"{short} Name a folder above {name} so, or write relative paths")
    else:
        missing = "exist" in text or "found" in text
        remedy = "; put the file there" if missing else ""
        source.problems.append(f"the parser says: {text}{remedy}")


def _read_urdf(path: Path) -> Source:
    import newton

    builder = newton.ModelBuilder()
    builder.default_shape_cfg.density = 0.0  # masses are those of the file
    builder.add_urdf(str(path))
    label = "".join(builder.articulation_label[:1])
    source = Source(path, label or path.stem)
    for i, name in enumerate(builder.body_label):
        com = np.array(builder.body_com[i], dtype=float)
        inertia = np.array(builder.body_inertia[i], dtype=float).reshape(3, 3)
        mass = float(builder.body_mass[i])
        source.links.append(Link(name.removeprefix(f"{label}/"), mass, com, inertia))
    for i, body in enumerate(builder.shape_body):
        source.links[body].shapes.append(_urdf_shape(builder, i))
    _check_urdf_names(source)
    names = [name.removeprefix(f"{label}/") for name in builder.joint_label]
    friction: dict[str, float] = {}
    for i, name in enumerate(names):
        if builder.joint_parent[i] < 0:
            continue  # what fixes it to the world
        joint = _urdf_joint(builder, i, name, source)
        source.joints.append(joint)
        if joint.kind == "revolute":
            friction[name] = builder.joint_friction[builder.joint_qd_start[i]]
        leader = builder.joint_mimic_joint[i]
        if leader >= 0:
            offset, factor = builder.joint_mimic_coeffs[i]
            joint.mimic = names[leader], float(factor), float(offset)
    _leave_out(source, "dry friction", friction)
    return source


def _urdf_shape(builder: Any, number: int) -> Shape:
    import newton

    kind = newton.GeoType(builder.shape_type[number]).name.lower().removeprefix("convex_")
    scale = tuple(map(float, builder.shape_scale[number]))
    flags = builder.shape_flags[number]
    shape = Shape(
        kind,
        scale[: SIZE_NUMBERS.get(kind, 2)],
        np.array(builder.shape_transform[number], dtype=float),
        bool(flags & newton.ShapeFlags.COLLIDE_SHAPES),
        colour=tuple(map(float, builder.shape_color[number])),
    )
    if kind == "mesh":
        mesh = builder.shape_source[number]
        shape.vertices = np.array(mesh.vertices, dtype=float) * scale
        shape.faces = np.array(mesh.indices, dtype=np.int32).reshape(-1, 3)
        if mesh_volume(shape.vertices, shape.faces) < 0.0:
            shape.faces = shape.faces[:, ::-1]  # a scale that mirrors, as of left hands
    return shape


def _urdf_joint(builder: Any, number: int, name: str, source: Source) -> Joint:
    import newton

    kind = newton.JointType(builder.joint_type[number]).name.lower()
    joint = Joint(name, kind, builder.joint_parent[number], builder.joint_child[number])
    joint.parent_frame = np.array(builder.joint_X_p[number], dtype=float)
    joint.child_frame = np.array(builder.joint_X_c[number], dtype=float)
    if kind != "revolute":
        return joint
    dof = builder.joint_qd_start[number]
    axis = np.array(builder.joint_axis[dof], dtype=float)
    if not axis.any():
        source.problems.append(f"{name} has no axis but 0 0 0; give it one")
        return joint
    joint.axis = axis / np.linalg.norm(axis)
    joint.lower = _bounded(builder.joint_limit_lower[dof])
    joint.upper = _bounded(builder.joint_limit_upper[dof])
    joint.effort = _bounded(builder.joint_effort_limit[dof]) or math.nan
    joint.velocity = _bounded(builder.joint_velocity_limit[dof]) or math.nan
    joint.damping = float(builder.joint_damping[dof])
    return joint


def _check_urdf_names(source: Source) -> None:
    """Names that stand for two, and links that no joint joins."""
    root = ElementTree.parse(source.path).getroot()
    for kind in ("link", "joint"):
        counts = Counter(str(element.get("name")) for element in root.findall(kind))
        for name, count in counts.items():
            if count > 1:
                source.problems.append(f"{name} is the name of more than one {kind}; rename them")
    joined = {link.name for link in source.links}
    for element in root.findall("link"):
        name = str(element.get("name"))
        if name not in joined:
            source.notes.append(f"{name} is joined to nothing and is left out")


def _leave_out(source: Source, what: str, values: dict[str, float]) -> None:
    """Say what of joints or links a hand has no place for."""
    names = ", ".join(name for name, value in values.items() if value)
    if names:
        source.notes.append(f"{what} is left out: of {names}")


def _bounded(value: float) -> float:
    """A limit; NaN where a parser put a number that is none."""
    return float(value) if abs(value) < UNLIMITED else math.nan


def _read_mjcf(path: Path) -> Source:
    model: Any = mujoco.MjModel.from_xml_path(str(path))
    source = Source(path, model.names.split(b"\0")[0].decode() or path.stem)
    lifted: dict[str, float] = {}
    for i in range(1, model.nbody):
        body = model.body(i)
        turn = Rotation.from_quat(body.iquat, scalar_first=True).as_matrix()
        name = body.name or f"body {i}"
        inertia = turn @ np.diag(body.inertia) @ turn.T
        source.links.append(Link(name, float(body.mass[0]), body.ipos.copy(), inertia))
        lifted[name] = float(model.body_gravcomp[i])
        _mjcf_joints(model, body, source)
    for i in range(model.ngeom):
        body = model.geom_bodyid[i]
        if body > 0:
            source.links[body - 1].shapes.append(_mjcf_shape(model, i))
    for i in range(model.nsite):
        site = model.site(i)
        if site.bodyid > 0:
            source.links[site.bodyid[0] - 1].sites[site.name] = _pose(site)
    for signature in model.exclude_signature:
        first = signature >> 16
        second = signature & 0xFFFF
        if min(first, second) > 0:
            source.apart.append((source.links[first - 1].name, source.links[second - 1].name))
    _mjcf_equalities(model, source)
    _mjcf_actuators(model, source)
    friction: dict[str, float] = {}
    springs: dict[str, float] = {}
    for i in range(model.njnt):
        joint = model.joint(i)
        name = _joint_name(model, i)
        friction[name] = float(joint.frictionloss[0])
        springs[name] = float(joint.stiffness[0])
    _leave_out(source, "dry friction", friction)
    _leave_out(source, "the spring", springs)
    _leave_out(source, "compensation of gravity", lifted)
    return source


def _pose(item: Any) -> np.ndarray:
    """Of a body, geom or site in its parent [7]."""
    return np.concatenate([item.pos, item.quat[[1, 2, 3, 0]]])


def _joint_name(model: Any, number: int) -> str:
    """Its name, or one that says whose it is."""
    joint = model.joint(number)
    body = model.body(joint.bodyid[0])
    return str(joint.name or f"the joint of {body.name or f'body {body.id}'}")


def _mjcf_joints(model: Any, body: Any, source: Source) -> None:
    """The joint of a body: none is a fixed one, more than one are none that a hand has."""
    child = body.id - 1
    parent = int(body.parentid[0]) - 1
    link = source.links[child].name
    first = int(body.jntadr[0])
    numbers = range(first, first + int(body.jntnum[0]))
    names = ", ".join(_joint_name(model, i) for i in numbers)
    if parent < 0:
        if names:
            source.notes.append(f"{link} is free to move in the file, by {names}; here it is fixed")
        return
    if not names:
        weld = Joint(f"weld of {link}", "fixed", parent, child, parent_frame=_pose(body))
        source.joints.append(weld)
        return
    if len(numbers) > 1:
        count = len(numbers)
        source.problems.append(f"{link} has {count} joints, {names}; put a body between them")
    said = model.joint(first)
    kind = mujoco.mjtJoint(said.type[0]).name.removeprefix("mjJNT_").lower()
    joint = Joint(_joint_name(model, first), kind, parent, child)
    joint.child_frame = pose_at(said.pos)
    joint.parent_frame = compose(_pose(body), joint.child_frame)
    source.joints.append(joint)
    if kind != "hinge":
        return
    joint.kind = "revolute"
    joint.axis = said.axis.copy()
    zero = float(said.qpos0[0])
    if zero:
        source.notes.append(f"{joint.name} counts from {zero:g} rad in the file (ref); here from 0")
    if said.limited:
        joint.lower, joint.upper = (said.range - zero).tolist()
    joint.armature = float(said.armature[0]) or math.nan
    joint.damping = float(said.damping[0])
    if model.jnt_actfrclimited[first]:
        joint.effort = float(np.abs(model.jnt_actfrcrange[first]).max())


def _mjcf_shape(model: Any, number: int) -> Shape:
    geom = model.geom(number)
    kind = mujoco.mjtGeom(geom.type[0]).name.removeprefix("mjGEOM_").lower()
    size = tuple(geom.size[: SIZE_NUMBERS.get(kind, 2)].tolist())
    shape = Shape(kind, size, _pose(geom), bool(geom.contype[0] or geom.conaffinity[0]))
    shape.colour = tuple(geom.rgba[:3].tolist())
    if kind == "mesh":
        mesh = geom.dataid[0]
        first = model.mesh_vertadr[mesh]
        vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        shape.vertices = vertices.astype(float)
        first = model.mesh_faceadr[mesh]
        shape.faces = model.mesh_face[first : first + model.mesh_facenum[mesh]].copy()
    return shape


def _mjcf_equalities(model: Any, source: Source) -> None:
    """Couplings of two joints by a line are joints that follow; all others are problems."""
    joints = {joint.name: joint for joint in source.joints}
    for i in range(model.neq):
        equality = model.equality(i)
        if not equality.active0:
            continue
        kind = mujoco.mjtEq(equality.type[0])
        offset, factor, *curved = equality.data[:5].tolist()
        if kind != mujoco.mjtEq.mjEQ_JOINT or equality.obj2id < 0 or any(curved):
            name = equality.name or f"equality {i}"
            text = kind.name.removeprefix("mjEQ_").lower()
            source.problems.append(
                f"{name} ({text}) couples more than a line; remove it and use hold or mimic"
            )
            continue
        follower = _joint_name(model, equality.obj1id[0])
        if follower in joints:
            leader = _joint_name(model, equality.obj2id[0])
            joints[follower].mimic = leader, factor, offset


def _mjcf_actuators(model: Any, source: Source) -> None:
    """What turns joints, by themselves or by a tendon of several: gains and limits of force."""
    pulled = set()
    for i in range(model.nu):
        said = model.actuator(i)
        name = said.name or f"actuator {i}"
        if said.gaintype == mujoco.mjtGain.mjGAIN_MUSCLE:
            source.problems.append(f"{name} is a muscle, which only pulls; make it a motor")
        ratios = _moved(model, said)
        if not ratios:
            source.problems.append(
                f"{name} pulls at no joint but over sites; give its joints motors of their own"
            )
        if said.trntype == mujoco.mjtTrn.mjTRN_TENDON:
            name = model.tendon(said.trnid[0]).name
            pulled.add(name)
        gear = float(said.gear[0]) or 1.0
        actuator = Actuator(name, {joint: gear * ratio for joint, ratio in ratios.items()})
        if said.forcelimited:
            actuator.effort = float(np.abs(said.forcerange).max())
        elif said.ctrllimited and said.biastype == mujoco.mjtBias.mjBIAS_NONE:
            actuator.effort = float(np.abs(said.gainprm[0] * said.ctrlrange).max())
        if said.biastype == mujoco.mjtBias.mjBIAS_AFFINE:
            actuator.kp = -float(said.biasprm[1])
            actuator.kd = -float(said.biasprm[2])
        source.actuators.append(actuator)
    tendons = [model.tendon(i).name for i in range(model.ntendon)]
    idle = ", ".join(name for name in tendons if name not in pulled)
    if idle:
        source.notes.append(f"tendons without a motor are left out: {idle}")


def _moved(model: Any, actuator: Any) -> dict[str, float]:
    """Joints that an actuator moves, and the coefficient of each; none where it pulls over sites."""
    target = actuator.trnid[0]
    if actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT:
        return {_joint_name(model, target): 1.0}
    if actuator.trntype != mujoco.mjtTrn.mjTRN_TENDON:
        return {}
    first = model.tendon_adr[target]
    ratios = {}
    for wrap in range(first, first + model.tendon_num[target]):
        if model.wrap_type[wrap] != mujoco.mjtWrap.mjWRAP_JOINT:
            return {}
        ratios[_joint_name(model, model.wrap_objid[wrap])] = float(model.wrap_prm[wrap])
    return ratios
