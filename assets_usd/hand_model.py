"""Read a hand back from USD: everything that simulator, training and deployment know about it.

The layout is that of docs/reference/hand.md; a hand of anyone reads the same as those of the
package.

Units are SI and radians, quaternions are xyzw. Frames: the base frame is that of link ``base``; a
pose is a row ``(x, y, z, qx, qy, qz, qw)``.
"""

import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from trimesh.util import append_faces

from vd.assets_usd.hand_data import (
    MOTOR_ATTRIBUTES,
    CameraModel,
    CollisionShape,
    HandError,
    HandModel,
    MotorModel,
    Workspace,
    compose,
    motor_attribute,
    pose_at,
)
from vd.assets_usd.hand_layer import add_layer, read_servo
from vd.assets_usd.objects.geometry import Surface
from vd.assets_usd.objects.usd_mesh import mesh_triangles
from vd.assets_usd.usd_prims import numpy_quaternion
from vd.kernels.servo.actuators import MAX_JOINTS

__all__ = [
    "CameraModel",
    "CollisionShape",
    "HandError",
    "HandModel",
    "open_stage",
    "read_hand",
    "read_surfaces",
]

OPTICAL_FROM_USD = Rotation.from_euler("x", 180, degrees=True)
"""A USD camera looks along -z with +y up; the optical frame along +z with +y down."""

ORTHONORMAL_TOLERANCE = 1e-5
"""Allowed scale or shear in the transform of a link, above the rounding of single precision."""

ROUNDING_RAD = 1e-5
"""How far a start may be beyond a limit: limits are degrees in single precision."""


def open_stage(path: Path, fingertip: str = "rigid", layer: Path | None = None) -> Usd.Stage:
    """The stage of a hand with a kind of fingertip, and a layer on top, in the session layer.

    Pass the stage itself, not the path, to ``newton.ModelBuilder.add_usd``: neither is in the file.

    Args:
        path: The hand's file.
        fingertip: Kind of fingertip, a variant of the file.
        layer: Layer over the hand (:func:`vd.assets_usd.hand_layer.write_layer`).

    Raises:
        HandError: A file is missing or no USD, the hand lacks the fingertip, or the layer is of
            another hand.
    """
    path = Path(path)
    if not path.is_file():
        raise HandError(f"{path}: no such file; name a hand of the package, or a USD file")
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise HandError(f"{path}: not a USD file ({error}); export it again") from error
    stage.Reload()  # a layer that is still open elsewhere would else be shown as it was
    root = stage.GetDefaultPrim()
    if not root:
        raise HandError(f"{path}: the stage has no default prim; set it to the hand's root prim")
    variants = root.GetVariantSet("fingertip")
    kinds = variants.GetVariantNames()
    if fingertip not in (kinds or ["rigid"]):
        raise HandError(
            f"{path}: {root.GetPath()} has no variant {fingertip!r} in its set 'fingertip': "
            f"choose one of {', '.join(kinds) or 'none (add the variant)'}"
        )
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        if kinds:
            variants.SetVariantSelection(fingertip)
    if layer is not None:
        add_layer(stage, layer)
    return stage


def read_hand(path: Path, *, fingertip: str = "rigid", layer: Path | None = None) -> HandModel:
    """Read a hand from USD.

    Args:
        path: File in the layout of docs/reference/hand.md.
        fingertip: Kind of fingertip, a variant of the file (``rigid`` or ``soft``).
        layer: Layer over the hand with an identified servo model.

    Raises:
        HandError: The file is not a hand, or the layer not one of it; names the prim and the
            attribute.
    """
    return _Reader(Path(path), fingertip, layer).read()


def read_surfaces(hand: HandModel) -> dict[int, Surface]:
    """What is drawn of each link, by its index; in its frame [m], float32 and int32.

    Raises:
        ValueError: A mesh is damaged, or nothing is drawn at all.
    """
    reader = _Reader(hand.path, hand.fingertip, hand.layer)
    surfaces: dict[int, Surface] = {}
    for link, name in enumerate(hand.link_names):
        body = reader.prim(name)
        meshes = []
        for prim in Usd.PrimRange(body):
            drawn = UsdGeom.Imageable(prim).ComputePurpose() != "guide"
            if drawn and prim.IsA(UsdGeom.Mesh):
                meshes.append(mesh_triangles(prim, reader.matrix(prim, body)))
        if meshes:
            vertices, faces = append_faces(*zip(*meshes, strict=True))
            surfaces[link] = Surface(vertices.astype(np.float32), faces.astype(np.int32))
    if not surfaces:
        raise HandError(f"{hand.path}: no link has a mesh to draw; give the links meshes")
    return surfaces


def _columns(rows: Sequence[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Each entry of rows as an array; names are fields of :class:`HandModel`."""
    columns = {}
    for name in rows[0]:
        columns[name] = np.array([row[name] for row in rows])
    return columns


class _Reader:
    """One reading of one file; every method raises :class:`HandError`."""

    def __init__(self, path: Path, fingertip: str, layer: Path | None):
        self.path = path
        self.fingertip = fingertip
        self.layer = layer
        self.stage = open_stage(path, fingertip, layer)
        self.root = self.stage.GetDefaultPrim()
        self.cache = UsdGeom.XformCache()

    def fail(self, where: Any, what: str, remedy: str) -> HandError:
        """The error to raise for a prim or a path."""
        prim = where.GetPath() if isinstance(where, Usd.Prim) else where
        file = f"{self.path} with the layer {self.layer}" if self.layer else str(self.path)
        return HandError(f"{file}: {prim}: {what}; {remedy}")

    def prim(self, relative: str) -> Usd.Prim:
        """The prim at a path below the root."""
        path = self.root.GetPath().AppendPath(relative)
        prim = self.stage.GetPrimAtPath(path)
        if not prim:
            raise self.fail(path, "the prim is missing", "add it, or export the hand again")
        return prim

    def value(self, prim: Usd.Prim, attribute: str) -> Any:
        """The value of an attribute, which must have been authored."""
        authored = prim.GetAttribute(attribute)
        if not authored or not authored.HasAuthoredValue():
            raise self.fail(prim, f"'{attribute}' is not authored", "give it a value")
        return authored.Get()

    def number(self, prim: Usd.Prim, attribute: str, *, positive: bool = False) -> float:
        """The value of a scalar attribute: finite, and above zero where that is asked for."""
        number = float(self.value(prim, attribute))
        if not math.isfinite(number) or (positive and number <= 0.0):
            wanted = "positive" if positive else "finite"
            raise self.fail(prim, f"'{attribute}' is {number}", f"it must be {wanted}")
        return number

    def vector(self, prim: Usd.Prim, attribute: str, size: int = 3) -> np.ndarray:
        """The value of an attribute of so many numbers, finite [size]."""
        vector = np.array(self.value(prim, attribute), dtype=float)
        if vector.shape != (size,) or not np.isfinite(vector).all():
            raise self.fail(prim, f"'{attribute}' is {vector}", f"{size} finite numbers")
        return vector

    def read(self) -> HandModel:
        """The whole hand."""
        self._check_units()
        if not self.root.HasAPI(UsdPhysics.ArticulationRootAPI):
            raise self.fail(
                self.root, "PhysicsArticulationRootAPI is missing", "apply it to the root prim"
            )
        links = ["base"]
        fingers = []
        joints: list[Usd.Prim] = []
        tips = []
        for finger, count in enumerate(self._finger_lengths()):
            fingers.append(slice(len(joints), len(joints) + count))
            links += [f"f{finger}_l{i + 1}" for i in range(count)]
            joints += [self.prim(f"f{finger}_j{i + 1}") for i in range(count)]
            tips.append(self.prim(f"{links[-1]}/f{finger}_tip"))
        bodies = list(map(self.prim, links))
        index = {body.GetPath(): i for i, body in enumerate(bodies)}
        columns = _columns(list(map(self._link, bodies)))
        columns |= _columns([self._joint(joint, joints, index) for joint in joints])
        self._check_mimic(joints, columns["mimic"])
        drive = {name: columns[name] for name in ("kp", "kd", "velocity_limit")}
        drive["inertia"] = columns["armature"]
        servo, servo_interval = read_servo(joints, drive, self.layer or self.path)
        tip_link = [index[tip.GetParent().GetPath()] for tip in tips]
        shapes: list[CollisionShape] = []
        for link, body in enumerate(bodies):
            shapes += self._shapes(body, link, needed=link in tip_link)
        camera = self.stage.GetPrimAtPath(self.root.GetPath().AppendPath("base/camera"))
        point_link, link_points = self._points(links)
        return HandModel(
            name=self.root.GetName(),
            fingertip=self.fingertip,
            path=self.path,
            layer=self.layer,
            fingers=tuple(fingers),
            mount=self._pose(self.root, "vd:mount:position", "vd:mount:orientation"),
            palm=self._palm(),
            workspace=self._workspace(),
            link_names=tuple(links),
            joint_names=tuple(joint.GetName() for joint in joints),
            **columns,
            motors=self._motors(joints),
            servo=servo,
            servo_interval=servo_interval,
            tip_link=np.array(tip_link),
            tip_frame=np.array([self._relative(tip, tip.GetParent()) for tip in tips]),
            mounted_camera=self._camera(camera, bodies[0]) if camera else None,
            point_link=point_link,
            link_points=link_points,
            shapes=tuple(shapes),
        )

    def _check_units(self) -> None:
        if UsdGeom.GetStageUpAxis(self.stage) != UsdGeom.Tokens.z:
            raise self.fail("/", "'upAxis' is not Z", "author the hand with z up")
        units = {
            "metersPerUnit": UsdGeom.GetStageMetersPerUnit(self.stage),
            "kilogramsPerUnit": UsdPhysics.GetStageKilogramsPerUnit(self.stage),
        }
        for name, unit in units.items():
            if unit != 1.0:
                remedy = "author the hand in metres and kilograms"
                raise self.fail("/", f"'{name}' is {unit}", remedy)

    def _finger_lengths(self) -> list[int]:
        """Joints of each finger, by the names of its links, which have no gaps."""
        names = {child.GetName() for child in self.root.GetChildren()}
        links = {name for name in names if re.fullmatch(r"f\d+_l\d+", name)}
        number_of = Counter(name.partition("_")[0] for name in links)
        lengths = [number_of[f"f{finger}"] for finger in range(len(number_of))]
        known = {"base"}
        for finger, count in enumerate(lengths):
            if count > MAX_JOINTS:
                what = f"finger {finger} has {count} joints"
                raise self.fail(self.root, what, f"weld joints until it has {MAX_JOINTS} at most")
            for i in range(count):
                known |= {f"f{finger}_l{i + 1}", f"f{finger}_j{i + 1}"}
        if not lengths or links - known:
            raise self.fail(
                self.root,
                f"has the links {', '.join(sorted(links)) or 'of no finger'}",
                "name links f0_l1, f0_l2 and so on from the palm, f1_l1 ..., without gaps",
            )
        self._refuse_unknown(known)
        return lengths

    def _refuse_unknown(self, known: set[str]) -> None:
        """Refuse links and joints that the model would leave out."""
        for prim in Usd.PrimRange(self.root):
            is_joint = prim.IsA(UsdPhysics.Joint)
            if not is_joint and not prim.HasAPI(UsdPhysics.RigidBodyAPI):
                continue
            if prim.IsA(UsdPhysics.FixedJoint) and not (_bodies(prim, 0) and _bodies(prim, 1)):
                continue  # it fixes the hand to the world
            if prim.GetParent() != self.root or prim.GetName() not in known:
                raise self.fail(
                    prim,
                    "is a link or joint besides those of the fingers, f0_l1 and f0_j1 and so on",
                    "rename it if it is a finger's, weld it to its link if it is fixed, or remove "
                    "it",
                )

    def _relative(self, prim: Usd.Prim, ancestor: Usd.Prim) -> np.ndarray:
        """Pose [7] of a prim in the frame of an ancestor; a scale is dropped, shear is refused."""
        matrix = self.matrix(prim, ancestor)
        # USD transforms row vectors.
        turn = (matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=1, keepdims=True)).T
        shear = np.abs(turn @ turn.T - np.eye(3)).max()
        if shear > ORTHONORMAL_TOLERANCE or np.linalg.det(turn) < 0.0:
            raise self.fail(
                prim, "its transform shears or mirrors", "use translation, rotation and scale only"
            )
        return np.concatenate([matrix[3, :3], Rotation.from_matrix(turn).as_quat()])

    def matrix(self, prim: Usd.Prim, ancestor: Usd.Prim) -> np.ndarray:
        """Transform of row vectors from a prim to an ancestor [4, 4]."""
        return np.array(self.cache.ComputeRelativeTransform(prim, ancestor)[0])

    def _palm(self) -> np.ndarray:
        """Where the palm looks, a unit vector [3]."""
        palm = self.vector(self.root, "vd:palm")
        if not np.linalg.norm(palm) > 0.0:
            raise self.fail(self.root, f"'vd:palm' is {palm}", "give it a direction")
        return np.asarray(palm / np.linalg.norm(palm))

    def _workspace(self) -> Workspace:
        low, high = self.vector(self.root, "vd:workspace:size", 2)
        if not 0.0 < low <= high:
            raise self.fail(
                self.root, f"'vd:workspace:size' is ({low}, {high})", "smallest first, above 0"
            )
        return Workspace(
            drop_m=tuple(self.vector(self.root, "vd:workspace:drop").tolist()),
            goal_m=tuple(self.vector(self.root, "vd:workspace:goal").tolist()),
            fall_m=self.number(self.root, "vd:workspace:fall", positive=True),
            size_m=(float(low), float(high)),
        )

    def _link(self, body: Usd.Prim) -> dict[str, Any]:
        if not body.HasAPI(UsdPhysics.RigidBodyAPI):
            raise self.fail(body, "PhysicsRigidBodyAPI is missing", "apply it to every link")
        moments = self.vector(body, "physics:diagonalInertia")
        most = moments.sum() * (1.0 + ORTHONORMAL_TOLERANCE) / 2.0
        if moments.min() <= 0.0 or moments.max() > most:
            raise self.fail(
                body,
                f"'physics:diagonalInertia' is {moments}",
                "three positive moments, none above the sum of two",
            )
        axes = Rotation.from_quat(
            numpy_quaternion(self.value(body, "physics:principalAxes"))
        ).as_matrix()
        return {
            "link_mass": self.number(body, "physics:mass", positive=True),
            "link_com": self.vector(body, "physics:centerOfMass"),
            "link_inertia": axes @ np.diag(moments) @ axes.T,
        }

    def _joint(
        self, joint: Usd.Prim, joints: list[Usd.Prim], index: dict[Sdf.Path, int]
    ) -> dict[str, Any]:
        """A joint; its gains have to be positive only if it follows no other."""
        if not joint.IsA(UsdPhysics.RevoluteJoint):
            kind = joint.GetTypeName() or "typeless prim"
            raise self.fail(joint, f"is a {kind}", "make it a PhysicsRevoluteJoint")
        parent, child = self._joined_links(joint, index)
        lower = self.number(joint, "physics:lowerLimit")
        upper = self.number(joint, "physics:upperLimit")
        if lower >= upper:
            what = f"'physics:lowerLimit' {lower} is not below 'physics:upperLimit' {upper}"
            raise self.fail(joint, what, "swap")
        start = self.number(joint, "vd:start")
        low = math.radians(lower)
        high = math.radians(upper)
        if not low - ROUNDING_RAD <= start <= high + ROUNDING_RAD:
            within = f"choose one within its limits, {low:.3f} and {high:.3f} rad"
            raise self.fail(joint, f"'vd:start' is {start:g} rad", within)
        leader, factor, offset = self._mimic(joint, joints)
        drive = "drive:angular:physics"
        driven = leader < 0
        return dict(
            joint_parent=parent,
            joint_child=child,
            joint_axis=np.eye(3)["XYZ".index(self.value(joint, "physics:axis"))],
            joint_parent_frame=self._pose(joint, "physics:localPos0", "physics:localRot0"),
            joint_child_frame=self._pose(joint, "physics:localPos1", "physics:localRot1"),
            lower=low,
            upper=high,
            # Gains are authored per degree.
            kp=math.degrees(self.number(joint, f"{drive}:stiffness", positive=driven)),
            kd=math.degrees(self.number(joint, f"{drive}:damping", positive=driven)),
            effort=self.number(joint, f"{drive}:maxForce", positive=True),
            velocity_limit=math.radians(self.number(joint, "newton:velocityLimit", positive=True)),
            armature=self.number(joint, "newton:armature"),
            start=start,
            mimic=leader,
            mimic_factor=factor,
            mimic_offset=offset,
        )

    def _pose(self, prim: Usd.Prim, position: str, rotation: str) -> np.ndarray:
        """A pose in two attributes [7]."""
        return np.concatenate(
            [self.vector(prim, position), numpy_quaternion(self.value(prim, rotation))]
        )

    def _joined_links(self, joint: Usd.Prim, index: dict[Sdf.Path, int]) -> tuple[int, int]:
        """Parent and child of a joint, which its name says."""
        finger, number = re.findall(r"\d+", joint.GetName())
        before = "base" if number == "1" else f"f{finger}_l{int(number) - 1}"
        parent = self.root.GetPath().AppendChild(before)
        child = self.root.GetPath().AppendChild(f"f{finger}_l{number}")
        if [*_bodies(joint, 0), *_bodies(joint, 1)] != [parent, child]:
            raise self.fail(
                joint,
                "joins other links than its name says",
                f"point 'physics:body0' at one link, {parent}, and 'physics:body1' at {child}",
            )
        return index[parent], index[child]

    def _mimic(self, joint: Usd.Prim, joints: list[Usd.Prim]) -> tuple[int, float, float]:
        """The joint that a joint follows, or -1, with factor and offset [rad]."""
        targets = joint.GetRelationship("newton:mimicJoint").GetTargets()
        if not targets:
            return -1, 1.0, 0.0
        paths = [other.GetPath() for other in joints]
        if len(targets) != 1 or targets[0] not in paths:
            what = f"'newton:mimicJoint' is {list(map(str, targets))}"
            raise self.fail(joint, what, "point it at one joint of the hand")
        factor = self.number(joint, "newton:mimicCoef1")
        offset = math.radians(self.number(joint, "newton:mimicCoef0"))
        return paths.index(targets[0]), factor, offset

    def _check_mimic(self, joints: list[Usd.Prim], leaders: np.ndarray) -> None:
        """Refuse a joint that follows one which follows another."""
        for joint, leader in zip(joints, leaders, strict=True):
            if leader >= 0 and leaders[leader] >= 0:
                name = joints[leader].GetName()
                raise self.fail(joint, f"follows {name}, which follows another", "follow that one")

    def _motors(self, joints: list[Usd.Prim]) -> tuple[MotorModel | None, ...]:
        """The motor of each joint that says which it has; no two have one ID."""
        motors: list[MotorModel | None] = []
        ids: set[int] = set()
        for joint in joints:
            if not joint.GetAuthoredPropertiesInNamespace("vd:motor"):
                motors.append(None)
                continue
            values: dict[str, Any] = {}
            for name, kind in MOTOR_ATTRIBUTES.items():
                attribute = motor_attribute(name)
                optional = hasattr(MotorModel, name)
                if optional and not joint.GetAttribute(attribute).HasAuthoredValue():
                    continue
                read = self.value if kind is str else self.number
                values[name] = kind(read(joint, attribute))
            motor = MotorModel(**values)
            if abs(motor.sign) != 1.0:
                raise self.fail(joint, f"'vd:motor:sign' is {motor.sign:g}", "it is 1, or -1")
            if not motor.gear > 0.0:
                raise self.fail(joint, f"'vd:motor:gear' is {motor.gear:g}", "it is positive")
            if motor.id in ids:
                what = f"'vd:motor:id' {motor.id} is another joint's too"
                raise self.fail(joint, what, "change one")
            ids.add(motor.id)
            motors.append(motor)
        return tuple(motors)

    def _camera(self, prim: Usd.Prim, base: Usd.Prim) -> CameraModel:
        if not prim.IsA(UsdGeom.Camera):
            kind = prim.GetTypeName() or "typeless prim"
            raise self.fail(prim, f"is a {kind}", "make it a Camera")
        width, height = map(int, self.value(prim, "vd:resolution"))
        if min(width, height) < 1:
            what = f"'vd:resolution' is {width} x {height}"
            raise self.fail(prim, what, "give the image size in pixels")
        focal = self.number(prim, "focalLength", positive=True)
        across = self.number(prim, "horizontalAperture", positive=True)
        down = self.number(prim, "verticalAperture", positive=True)
        near, far = self.value(prim, "clippingRange")
        pose = self._relative(prim, base)
        # A window shifted to the right moves the principal point to the left in the image; up,
        # down.
        return CameraModel(
            width=width,
            height=height,
            fx=focal / across * width,
            fy=focal / down * height,
            cx=(0.5 - self.number(prim, "horizontalApertureOffset") / across) * width,
            cy=(0.5 + self.number(prim, "verticalApertureOffset") / down) * height,
            near=float(near),
            far=float(far),
            position=pose[:3],
            quaternion=(Rotation.from_quat(pose[3:]) * OPTICAL_FROM_USD).as_quat(),
        )

    def _points(self, links: list[str]) -> tuple[np.ndarray, np.ndarray]:
        """Link [P] and surface samples [P, S, 3] of each set, as far as links have them."""
        places = [("base/points", 0)]
        for link, name in enumerate(links[1:], 1):
            if name.endswith("_l1"):
                places.append((f"base/{name.replace('_l1', '_motor')}_points", 0))
            places.append((f"{name}/points", link))
        numbers: list[int] = []
        sets: list[np.ndarray] = []
        for place, link in places:
            prim = self.stage.GetPrimAtPath(self.root.GetPath().AppendPath(place))
            if not prim:
                continue
            samples = np.array(self.value(prim, "points"), dtype=np.float32)
            sets.append(samples)
            numbers.append(link)
            if samples.shape != sets[0].shape or not samples.size or not np.isfinite(samples).all():
                raise self.fail(
                    prim,
                    f"'points' has shape {samples.shape}",
                    f"{len(sets[0])} finite points, as many on each link",
                )
        return np.array(numbers), np.stack(sets) if sets else np.zeros((0, 0, 3), np.float32)

    def _shapes(self, body: Usd.Prim, link: int, *, needed: bool) -> list[CollisionShape]:
        """Colliders of a link; only those with fingertips need one."""
        prims = [prim for prim in Usd.PrimRange(body) if prim.HasAPI(UsdPhysics.CollisionAPI)]
        if needed and not prims:
            raise self.fail(
                body, "has no collider", "apply PhysicsCollisionAPI to a primitive below it"
            )
        return [self._shape(prim, body, link) for prim in prims]

    def _shape(self, prim: Usd.Prim, body: Usd.Prim, link: int) -> CollisionShape:
        frame = self._relative(prim, body)
        scale = np.linalg.norm(self.matrix(prim, body)[:3, :3], axis=1)
        usd_kind = str(prim.GetTypeName())
        kind = usd_kind.lower()
        vertices = np.zeros((0, 3))
        size: tuple[float, ...]
        if usd_kind == "Cube":
            kind = "box"
            half = self.number(prim, "size", positive=True) / 2.0
            size = tuple((half * scale).tolist())
        elif usd_kind == "Mesh":
            kind = "hull"
            corners = self._hull_corners(prim) * scale
            low = corners.min(axis=0)
            high = corners.max(axis=0)
            frame = compose(frame, pose_at((low + high) / 2.0))
            vertices = corners - (low + high) / 2.0
            size = tuple(((high - low) / 2.0).tolist())
        elif usd_kind in ("Sphere", "Capsule", "Cylinder"):
            if np.abs(scale - 1.0).max() > ORTHONORMAL_TOLERANCE:
                what = f"is scaled by {scale}"
                raise self.fail(prim, what, "put the size into its radius and height")
            size = (self.number(prim, "radius", positive=True),)
            if usd_kind != "Sphere":
                size += (self.number(prim, "height", positive=True) / 2.0,)
                upright = np.roll(np.eye(3), "XYZ".index(self.value(prim, "axis")) - 2, axis=1)
                turn = Rotation.from_quat(frame[3:]) * Rotation.from_matrix(upright)
                frame[3:] = turn.as_quat()
        else:
            remedy = "collide with a Cube, Sphere, Capsule, Cylinder or convex Mesh"
            raise self.fail(prim, f"is a {usd_kind}", remedy)
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
        if not material:
            raise self.fail(prim, "no physics material is bound", "bind one with friction")
        surface = material.GetPrim()
        return CollisionShape(
            path=str(prim.GetPath()),
            link=link,
            kind=kind,
            size=size,
            frame=frame,
            vertices=vertices,
            friction=self.number(surface, "physics:dynamicFriction"),
            fingertip=surface.GetName() == "fingertip_surface",
        )

    def _hull_corners(self, prim: Usd.Prim) -> np.ndarray:
        """Corners of the convex hull of a mesh that collides [V, 3]."""
        if prim.GetAttribute("physics:approximation").Get() != UsdPhysics.Tokens.convexHull:
            raise self.fail(
                prim,
                "'physics:approximation' is not convexHull",
                "split the mesh into convex parts and give each PhysicsMeshCollisionAPI with it",
            )
        points = np.array(self.value(prim, "points"), dtype=float)
        return points[ConvexHull(points).vertices]


def _bodies(joint: Usd.Prim, side: int) -> list[Sdf.Path]:
    """What a joint joins on its first (0) or second side."""
    return list(joint.GetRelationship(f"physics:body{side}").GetTargets())
