"""Read a hand back from USD: everything that simulator, training and deployment know about it.

The layout is that of docs/reference/hand.md; a hand of anyone reads the same as those of the
package.

Units are SI and radians, quaternions are xyzw. Frames: the base frame is that of link ``base``; a
pose is a row ``(x, y, z, qx, qy, qz, qw)``.
"""

import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import newton_usd_schemas  # noqa: F401 - before the first stage, or mimic joints are no schema of it
import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import (
    CameraModel,
    CollisionShape,
    HandError,
    HandModel,
    compose,
)
from vd.assets_usd.hand_description import Described, xyzw
from vd.assets_usd.hand_layer import add_layer, read_servo
from vd.kernels.servo.actuators import MAX_JOINTS

__all__ = ["CameraModel", "CollisionShape", "HandError", "HandModel", "open_stage", "read_hand"]

OPTICAL_FROM_USD = Rotation.from_euler("x", 180, degrees=True)
"""A USD camera looks along -z with +y up; the optical frame along +z with +y down."""

LINK_NAME = re.compile(r"f(\d+)_l(\d+)")
ORTHONORMAL_TOLERANCE = 1e-5
"""Allowed scale or shear in the transform of a link, above the rounding of single precision."""


def open_stage(path: Path, fingertip: str = "rigid", layer: Path | None = None) -> Usd.Stage:
    """The stage of a hand with a kind of fingertip selected, and a layer on top, in the session layer.

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
    if fingertip not in kinds and not (not kinds and fingertip == "rigid"):
        raise HandError(
            f"{path}: {root.GetPath()} has no variant {fingertip!r} in its set 'fingertip': "
            f"choose one of {', '.join(kinds) or 'none (add the variant)'}"
        )
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        if kinds:
            variants.SetVariantSelection(fingertip)
    if layer is not None:
        add_layer(stage, Path(layer))
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
    return _Reader(Path(path), fingertip, None if layer is None else Path(layer)).read()


class _Reader(Described):
    """One reading of one file; every method raises :class:`HandError`."""

    def __init__(self, path: Path, fingertip: str, layer: Path | None):
        super().__init__(path, open_stage(path, fingertip, layer), layer)
        self.fingertip = fingertip
        self.cache = UsdGeom.XformCache()

    def read(self) -> HandModel:
        """The whole hand."""
        self._check_units()
        if not self.root.HasAPI(UsdPhysics.ArticulationRootAPI):
            raise self.fail(
                self.root, "PhysicsArticulationRootAPI is missing", "apply it to the root prim"
            )
        counts = self._fingers()
        self._refuse_unknown(counts)
        order = [(f, i) for f, count in enumerate(counts) for i in range(1, count + 1)]
        links = ("base", *(f"f{f}_l{i}" for f, i in order))
        joints = [self.prim(f"f{f}_j{i}") for f, i in order]
        bodies = [self.prim(name) for name in links]
        index = {body.GetPath(): i for i, body in enumerate(bodies)}
        masses = [self._mass(body) for body in bodies]
        frames = [self._joint_frames(joint, index) for joint in joints]
        mimic = [self.mimic(joint, joints) for joint in joints]
        drives = np.array(
            [
                self._drive(joint, driven=row[0] < 0)
                for joint, row in zip(joints, mimic, strict=True)
            ]
        )
        self.check_mimic(joints, [row[0] for row in mimic])
        baseline = dict(
            zip(("kp", "kd", "velocity_limit", "inertia"), drives.T[[2, 3, 5, 6]], strict=True)
        )
        servo, servo_interval = read_servo(joints, baseline, self.layer or self.path)
        tip_prims = [self.prim(f"f{f}_l{count}/f{f}_tip") for f, count in enumerate(counts)]
        tips = {prim.GetParent().GetPath() for prim in tip_prims}
        points = self._point_prims(links)
        ends = np.cumsum([0, *counts])
        camera = self.stage.GetPrimAtPath(self.root.GetPath().AppendPath("base/camera"))
        return HandModel(
            name=self.root.GetName(),
            fingertip=self.fingertip,
            path=self.path,
            layer=self.layer,
            fingers=tuple(slice(int(a), int(b)) for a, b in pairwise(ends)),
            mount=self.mount(),
            palm=self.direction("vd:palm"),
            workspace=self.workspace(),
            link_names=links,
            joint_names=tuple(joint.GetName() for joint in joints),
            joint_parent=np.array([frame[0] for frame in frames]),
            joint_child=np.array([frame[1] for frame in frames]),
            joint_axis=np.array([self._axis(joint) for joint in joints]),
            joint_parent_frame=np.array([frame[2] for frame in frames]),
            joint_child_frame=np.array([frame[3] for frame in frames]),
            lower=drives[:, 0],
            upper=drives[:, 1],
            kp=drives[:, 2],
            kd=drives[:, 3],
            effort=drives[:, 4],
            velocity_limit=drives[:, 5],
            armature=drives[:, 6],
            start=self.start(joints, drives),
            mimic=np.array([row[0] for row in mimic]),
            mimic_factor=np.array([row[1] for row in mimic]),
            mimic_offset=np.array([row[2] for row in mimic]),
            motors=self.motors(joints),
            servo=servo,
            servo_interval=servo_interval,
            link_mass=np.array([mass for mass, _, _ in masses]),
            link_com=np.array([com for _, com, _ in masses]),
            link_inertia=np.array([inertia for _, _, inertia in masses]),
            tip_link=np.array([index[prim.GetParent().GetPath()] for prim in tip_prims]),
            tip_frame=np.array([self._relative(prim, prim.GetParent()) for prim in tip_prims]),
            mounted_camera=self._camera(camera, bodies[0]) if camera else None,
            point_link=np.array([link for _, link in points]),
            link_points=self._points([prim for prim, _ in points]),
            shapes=tuple(
                shape for i, body in enumerate(bodies) for shape in self._shapes(body, i, tips)
            ),
        )

    def _check_units(self) -> None:
        if UsdGeom.GetStageUpAxis(self.stage) != UsdGeom.Tokens.z:
            raise self.fail("/", "'upAxis' is not Z", "author the hand with z up")
        for name, unit in (
            ("metersPerUnit", UsdGeom.GetStageMetersPerUnit(self.stage)),
            ("kilogramsPerUnit", UsdPhysics.GetStageKilogramsPerUnit(self.stage)),
        ):
            if unit != 1.0:
                raise self.fail(
                    "/", f"'{name}' is {unit}", "author the hand in metres and kilograms"
                )

    def _fingers(self) -> list[int]:
        """Joints of each finger, by the names of its links, which have no gaps."""
        found: dict[int, list[int]] = {}
        for child in self.root.GetChildren():
            if match := LINK_NAME.fullmatch(child.GetName()):
                found.setdefault(int(match[1]), []).append(int(match[2]))
        counts = [len(found.get(finger, ())) for finger in range(len(found))]
        if (
            not counts
            or 0 in counts
            or any(sorted(n) != [*range(1, len(n) + 1)] for n in found.values())
        ):
            names = (
                ", ".join(f"f{f}_l{i}" for f in sorted(found) for i in sorted(found[f]))
                or "no links"
            )
            raise self.fail(
                self.root,
                f"fingers {sorted(found)} found, of {names}",
                "name links f0_l1, f0_l2 and so on from the palm, f1_l1 ..., without gaps",
            )
        if max(counts) > MAX_JOINTS:
            finger = counts.index(max(counts))
            raise self.fail(
                self.root,
                f"finger {finger} has {max(counts)} joints",
                f"weld joints until it has {MAX_JOINTS} at most",
            )
        return counts

    def _refuse_unknown(self, counts: list[int]) -> None:
        """Refuse links and joints that the model would leave out."""
        numbers = [f"{i + 1}" for i in range(MAX_JOINTS)]
        known = {"base"} | {
            f"f{f}_{k}{i}" for f, n in enumerate(counts) for i in numbers[:n] for k in "lj"
        }
        for prim in Usd.PrimRange(self.root):
            if not (prim.HasAPI(UsdPhysics.RigidBodyAPI) or prim.IsA(UsdPhysics.Joint)):
                continue
            if prim.IsA(UsdPhysics.FixedJoint) and not all(
                prim.GetRelationship(f"physics:body{side}").GetTargets() for side in (0, 1)
            ):
                continue  # it fixes the hand to the world
            if prim.GetParent() != self.root or prim.GetName() not in known:
                raise self.fail(
                    prim,
                    "is a link or joint besides those of the fingers, f0_l1 and f0_j1 and so on",
                    "rename it if it is a finger's, weld it to its link if it is fixed, or remove "
                    "it",
                )

    def _point_prims(self, links: tuple[str, ...]) -> list[tuple[Usd.Prim, int]]:
        """Prim and link of the sets of surface samples, as far as links have them."""
        places = [("base/points", 0)]
        for index, link in enumerate(links[1:], 1):
            if link.endswith("_l1"):
                places.append((f"base/{link.replace('_l1', '_motor')}_points", 0))
            places.append((f"{link}/points", index))
        root = self.root.GetPath()
        found = [(self.stage.GetPrimAtPath(root.AppendPath(place)), link) for place, link in places]
        return [(prim, link) for prim, link in found if prim]

    def _relative(self, prim: Usd.Prim, ancestor: Usd.Prim) -> np.ndarray:
        """Pose [7] of a prim in the frame of an ancestor; a scale is dropped, shear is refused."""
        matrix, _ = self.cache.ComputeRelativeTransform(prim, ancestor)
        rows = np.array(matrix)[:3, :3]
        scale = np.linalg.norm(rows, axis=1)
        turn = (rows / scale[:, None]).T  # USD transforms row vectors
        if (
            np.abs(turn @ turn.T - np.eye(3)).max() > ORTHONORMAL_TOLERANCE
            or np.linalg.det(turn) < 0.0
        ):
            raise self.fail(
                prim, "its transform shears or mirrors", "use translation, rotation and scale only"
            )
        return np.concatenate(
            [np.array(matrix.ExtractTranslation()), Rotation.from_matrix(turn).as_quat()]
        )

    def _mass(self, body: Usd.Prim) -> tuple[float, np.ndarray, np.ndarray]:
        if not body.HasAPI(UsdPhysics.RigidBodyAPI):
            raise self.fail(body, "PhysicsRigidBodyAPI is missing", "apply it to every link")
        mass = self.number(body, "physics:mass", positive=True)
        com = np.array(self.value(body, "physics:centerOfMass"), dtype=float)
        moments = np.array(self.value(body, "physics:diagonalInertia"), dtype=float)
        if not np.all(moments > 0.0) or 2.0 * moments.max() > moments.sum() * (
            1.0 + ORTHONORMAL_TOLERANCE
        ):
            raise self.fail(
                body,
                f"'physics:diagonalInertia' is {moments}",
                "three positive moments, none above the sum of two",
            )
        axes = Rotation.from_quat(xyzw(self.value(body, "physics:principalAxes"))).as_matrix()
        return mass, com, axes @ np.diag(moments) @ axes.T

    def _axis(self, joint: Usd.Prim) -> np.ndarray:
        return np.eye(3)["XYZ".index(self.value(joint, "physics:axis"))]

    def _joint_frames(
        self, joint: Usd.Prim, index: dict[Any, int]
    ) -> tuple[int, int, np.ndarray, np.ndarray]:
        """Parent link, child link, and the joint frame in each."""
        if not joint.IsA(UsdPhysics.RevoluteJoint):
            raise self.fail(
                joint,
                f"is a {joint.GetTypeName() or 'typeless prim'}",
                "make it a PhysicsRevoluteJoint",
            )
        links, frames = [], []
        for side in (0, 1):
            targets = joint.GetRelationship(f"physics:body{side}").GetTargets()
            if len(targets) != 1 or targets[0] not in index:
                names = [str(target) for target in targets]
                raise self.fail(
                    joint, f"'physics:body{side}' is {names}", "point it at one link of the hand"
                )
            links.append(index[targets[0]])
            position = np.array(self.value(joint, f"physics:localPos{side}"), dtype=float)
            frames.append(
                np.concatenate([position, xyzw(self.value(joint, f"physics:localRot{side}"))])
            )
        finger, number = re.findall(r"\d+", joint.GetName())
        child = self.root.GetPath().AppendChild(f"f{finger}_l{number}")
        parent = self.root.GetPath().AppendChild(
            "base" if number == "1" else f"f{finger}_l{int(number) - 1}"
        )
        if links != [index[parent], index[child]]:
            raise self.fail(
                joint, "joins other links than its name says", f"join {parent} and {child}"
            )
        return links[0], links[1], frames[0], frames[1]

    def _drive(self, joint: Usd.Prim, *, driven: bool) -> tuple[float, ...]:
        """Limits, kp, kd, effort, velocity limit and armature, in radians.

        Gains only if ``driven``.
        """
        lower = self.number(joint, "physics:lowerLimit")
        upper = self.number(joint, "physics:upperLimit")
        if lower >= upper:
            raise self.fail(
                joint,
                f"'physics:lowerLimit' {lower} is not below 'physics:upperLimit' {upper}",
                "swap",
            )
        stiffness = self.number(joint, "drive:angular:physics:stiffness", positive=driven)
        damping = self.number(joint, "drive:angular:physics:damping", positive=driven)
        return (
            math.radians(lower),
            math.radians(upper),
            math.degrees(stiffness),  # authored per degree
            math.degrees(damping),
            self.number(joint, "drive:angular:physics:maxForce", positive=True),
            math.radians(self.number(joint, "newton:velocityLimit", positive=True)),
            self.number(joint, "newton:armature"),
        )

    def _camera(self, prim: Usd.Prim, base: Usd.Prim) -> CameraModel:
        if not prim.IsA(UsdGeom.Camera):
            raise self.fail(
                prim, f"is a {prim.GetTypeName() or 'typeless prim'}", "make it a Camera"
            )
        width, height = (int(n) for n in self.value(prim, "vd:resolution"))
        if min(width, height) < 1:
            raise self.fail(
                prim, f"'vd:resolution' is {width} x {height}", "give the image size in pixels"
            )
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

    def _points(self, prims: list[Usd.Prim]) -> np.ndarray:
        sets = [np.array(self.value(prim, "points"), dtype=np.float32) for prim in prims]
        for prim, samples in zip(prims, sets, strict=True):
            if samples.shape != sets[0].shape or not np.isfinite(samples).all() or not samples.size:
                raise self.fail(
                    prim,
                    f"'points' has shape {samples.shape}",
                    f"{len(sets[0])} finite points, as many on each link",
                )
        return np.stack(sets) if sets else np.zeros((0, 0, 3), dtype=np.float32)

    def _shapes(self, body: Usd.Prim, link: int, tips: set[Sdf.Path]) -> list[CollisionShape]:
        """Colliders of a link; only those with fingertips need one."""
        prims = [prim for prim in Usd.PrimRange(body) if prim.HasAPI(UsdPhysics.CollisionAPI)]
        if not prims and body.GetPath() in tips:
            raise self.fail(
                body, "has no collider", "apply PhysicsCollisionAPI to a primitive below it"
            )
        return [self._shape(prim, body, link) for prim in prims]

    def _shape(self, prim: Usd.Prim, body: Usd.Prim, link: int) -> CollisionShape:
        frame = self._relative(prim, body)
        matrix, _ = self.cache.ComputeRelativeTransform(prim, body)
        scale = np.linalg.norm(np.array(matrix)[:3, :3], axis=1)
        kind, vertices = str(prim.GetTypeName()), np.zeros((0, 3))
        size: tuple[float, ...]
        if kind == "Cube":
            half = self.number(prim, "size", positive=True) / 2.0
            size = tuple(float(half * s) for s in scale)
        elif kind == "Mesh":
            if prim.GetAttribute("physics:approximation").Get() != UsdPhysics.Tokens.convexHull:
                raise self.fail(
                    prim,
                    "'physics:approximation' is not convexHull",
                    "split the mesh into convex parts and give each PhysicsMeshCollisionAPI with "
                    "it",
                )
            corners = np.array(self.value(prim, "points"), dtype=float) * scale
            vertices = corners[ConvexHull(corners).vertices]
            low, high = vertices.min(axis=0), vertices.max(axis=0)
            frame = compose(frame, np.array([*(low + high) / 2.0, 0.0, 0.0, 0.0, 1.0]))
            vertices, size = vertices - (low + high) / 2.0, tuple(((high - low) / 2.0).tolist())
        elif kind in ("Sphere", "Capsule", "Cylinder"):
            if np.abs(scale - 1.0).max() > ORTHONORMAL_TOLERANCE:
                raise self.fail(
                    prim, f"is scaled by {scale}", "put the size into its radius and height"
                )
            size = (self.number(prim, "radius", positive=True),)
            if kind != "Sphere":
                size += (self.number(prim, "height", positive=True) / 2.0,)
                upright = np.roll(np.eye(3), "XYZ".index(self.value(prim, "axis")) - 2, axis=1)
                frame[3:] = (
                    Rotation.from_quat(frame[3:]) * Rotation.from_matrix(upright)
                ).as_quat()
        else:
            raise self.fail(
                prim,
                f"is a {kind}",
                "collide with a Cube, Sphere, Capsule, Cylinder or convex Mesh",
            )
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
        if not material:
            raise self.fail(prim, "no physics material is bound", "bind one with friction")
        surface = material.GetPrim()
        return CollisionShape(
            path=str(prim.GetPath()),
            link=link,
            kind={"Cube": "box", "Mesh": "hull"}.get(kind, kind.lower()),
            size=size,
            frame=frame,
            vertices=vertices,
            friction=self.number(surface, "physics:dynamicFriction"),
            fingertip=surface.GetName() == "fingertip_surface",
        )
