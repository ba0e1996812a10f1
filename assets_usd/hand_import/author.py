"""A welded hand as USD (docs/reference/hand.md): numbers as text, meshes in a crate beside it."""

from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade
from scipy.spatial.transform import Rotation
from trimesh.util import append_faces

from vd.assets_usd.hand_data import (
    MOTOR_ATTRIBUTES,
    MotorModel,
    compose,
    invert,
    motor_attribute,
    placed,
    pose_at,
)
from vd.assets_usd.hand_import.description import Description
from vd.assets_usd.hand_import.guess import Stance
from vd.assets_usd.hand_import.source import Joint, Link, Shape
from vd.assets_usd.hand_import.tree import Tree, shape_box
from vd.assets_usd.objects.geometry import (
    Surface,
    convex_hull,
    principal_axes,
    simplify_hull,
    surface_points,
)
from vd.assets_usd.usd_prims import add_mesh, define_body, define_root, usd_quaternion

HULL_VERTICES = 32
"""Most corners of a collider: contacts of more take longer and feel the same."""
POINTS = 500
"""Samples of a link's surface, as of the D'Claw's."""
GAP_M = 0.002
SURFACES = {"surface": (2500.0, 100.0), "fingertip_surface": (2500.0, 100.0)}
"""Contact stiffness and damping of each material: MuJoCo's default, 20 ms and critically damped."""
RESTITUTION = 0.5
LIMIT_SOLREF = (0.02, 1.0)
"""Time constant [s] and damping of the ends of ranges, MuJoCo's default. Newton's own, 1e4 N m/rad
and 10 N m s/rad, is stiffer than two steps of 120 Hz resolve: light fingers that rest on an end
rattle at up to 4 rad/s."""


class Author:
    """Writes one hand into a stage of two layers."""

    def __init__(self, tree: Tree, stance: Stance, said: Description, name: str):
        self.tree = tree
        self.stance = stance
        self.said = said
        self.names = ["base"]
        self.joints = []
        for finger, joints in enumerate(tree.fingers):
            self.names += [f"f{finger}_l{i + 1}" for i in range(len(joints))]
            self.joints += [f"f{finger}_j{i + 1}" for i in range(len(joints))]
        self.root = f"/{name}"
        self.layer = Sdf.Layer.CreateAnonymous(".usda")
        self.meshes = Sdf.Layer.CreateAnonymous(".usdc")
        self.layer.subLayerPaths.append(self.meshes.identifier)
        self.stage = stage = Usd.Stage.Open(self.layer)
        root = define_root(stage, name)
        root.SetDocumentation(f"{name}, imported from {self.tree.source}")
        UsdPhysics.ArticulationRootAPI.Apply(root)
        self._describe(root)
        self._materials()
        poses = self.tree.forward_kinematics(np.zeros(len(self.tree.joints)))
        for number, link in enumerate(self.tree.links):
            self._link(number, link, poses[number])
        for number, joint in enumerate(self.tree.joints):
            self._joint(number, joint)
        for finger, joints in enumerate(self.tree.fingers):
            at = f"{self.root}/{self.names[joints.stop]}/f{finger}_tip"
            site = UsdGeom.Sphere.Define(stage, at)
            site.CreateRadiusAttr(0.001)
            site.CreatePurposeAttr(UsdGeom.Tokens.guide)
            _apply(site.GetPrim(), "NewtonSiteAPI")
            _place(site, self.stance.tips[finger])

    def write(self, folder: Path, apart: set[tuple[int, int]]) -> Path:
        """Write ``<name>.usda`` and ``<name>_meshes.usdc``.

        Args:
            folder: Where to; it exists.
            apart: Pairs of links whose contacts are off.
        """
        name = self.root[1:]
        for first, pairs in groupby(sorted(apart), key=itemgetter(0)):
            link = self.stage.GetPrimAtPath(f"{self.root}/{self.names[first]}")
            others = UsdPhysics.FilteredPairsAPI.Apply(link).CreateFilteredPairsRel()
            others.SetTargets([f"{self.root}/{self.names[second]}" for _, second in pairs])
        path = folder / f"{name}.usda"
        self.meshes.Export(str(folder / f"{name}_meshes.usdc"))
        numbers = Sdf.Layer.CreateAnonymous(".usda")
        numbers.TransferContent(self.layer)
        numbers.subLayerPaths = [f"./{name}_meshes.usdc"]
        numbers.Export(str(path))
        return path

    def _describe(self, root: Usd.Prim) -> None:
        stance = self.stance
        place = stance.workspace
        kinds = Sdf.ValueTypeNames
        _custom(root, "vd:mount:position", kinds.Double3, Gf.Vec3d(*stance.mount[:3]))
        _custom(root, "vd:mount:orientation", kinds.Quatd, usd_quaternion(stance.mount[3:]))
        _custom(root, "vd:palm", kinds.Double3, Gf.Vec3d(*stance.palm))
        _custom(root, "vd:workspace:drop", kinds.Double3, Gf.Vec3d(*place.drop_m))
        _custom(root, "vd:workspace:goal", kinds.Double3, Gf.Vec3d(*place.goal_m))
        _custom(root, "vd:workspace:fall", kinds.Double, place.fall_m)
        _custom(root, "vd:workspace:size", kinds.Double2, Gf.Vec2d(*place.size_m))

    def _materials(self) -> None:
        for name, (stiffness, damping) in SURFACES.items():
            material = UsdShade.Material.Define(
                self.stage, f"{self.root}/materials/{name}"
            ).GetPrim()
            api = UsdPhysics.MaterialAPI.Apply(material)
            api.CreateDynamicFrictionAttr(self.said.friction)
            api.CreateStaticFrictionAttr(self.said.friction)
            api.CreateRestitutionAttr(RESTITUTION)
            _apply(material, "NewtonMaterialAPI")
            _float(material, "newton:contactStiffness", stiffness)
            _float(material, "newton:contactDamping", damping)

    def _link(self, number: int, link: Link, pose: np.ndarray) -> None:
        path = f"{self.root}/{self.names[number]}"
        xform = UsdGeom.Xform.Define(self.stage, path)
        _place(xform, pose)
        prim = xform.GetPrim()
        _custom(prim, "vd:source", Sdf.ValueTypeNames.String, link.name)
        define_body(prim, link.mass, link.com, *principal_axes(link.inertia))
        UsdGeom.Scope.Define(self.stage, f"{path}/collision").CreatePurposeAttr(
            UsdGeom.Tokens.guide
        )
        colliders = link.colliders
        for i, shape in enumerate(colliders):
            self._collider(f"{path}/collision/c{i}", shape, self._is_tip(number, shape, colliders))
        drawings = [shape for shape in link.shapes if not shape.collides] or colliders
        meshes = list(map(shape_mesh, drawings))
        for i, (shape, (vertices, faces)) in enumerate(zip(drawings, meshes, strict=True)):
            mesh = self._mesh(f"{path}/visual/v{i}", vertices, faces)
            mesh.CreateDisplayColorAttr([Gf.Vec3f(*shape.colour)])
        if meshes:
            self._points(f"{path}/points", meshes)

    def _is_tip(self, number: int, shape: Shape, colliders: list[Shape]) -> bool:
        """Whether a collider is the nearest to a fingertip on its link."""
        for joints, tip in zip(self.tree.fingers, self.stance.tips, strict=True):
            if joints.stop == number:
                distance = [_distance(other, tip[:3]) for other in colliders]
                return _distance(shape, tip[:3]) <= min(distance) + 1e-4
        return False

    def _collider(self, path: str, shape: Shape, tip: bool) -> None:
        pose = shape.frame
        if shape.kind == "box":
            cube = UsdGeom.Cube.Define(self.stage, path)
            cube.CreateSizeAttr(1.0)
            _place(cube, pose, scale=2.0 * np.array(shape.size))
        elif shape.kind == "sphere":
            UsdGeom.Sphere.Define(self.stage, path).CreateRadiusAttr(shape.size[0])
        elif shape.kind in ("capsule", "cylinder"):
            kind = UsdGeom.Capsule if shape.kind == "capsule" else UsdGeom.Cylinder
            solid = kind.Define(self.stage, path)
            solid.CreateRadiusAttr(shape.size[0])
            solid.CreateHeightAttr(2.0 * shape.size[1])
            solid.CreateAxisAttr("Z")
        else:
            hull = simplify_hull(convex_hull(shape_mesh(shape)[0]), HULL_VERTICES)
            middle = (hull.vertices.min(axis=0) + hull.vertices.max(axis=0)) / 2.0
            mesh = self._mesh(path, hull.vertices - middle, hull.faces)
            pose = pose_at(middle)
            UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr("convexHull")
        prim = self.stage.GetPrimAtPath(path)
        if shape.kind != "box":
            _place(UsdGeom.Xformable(prim), pose)
        UsdPhysics.CollisionAPI.Apply(prim)
        _apply(prim, "NewtonCollisionAPI")
        _float(prim, "newton:contactGap", GAP_M)
        _float(prim, "newton:contactMargin", 0.0)
        material = UsdShade.Material.Get(
            self.stage, f"{self.root}/materials/{'fingertip_surface' if tip else 'surface'}"
        )
        UsdShade.MaterialBindingAPI.Apply(prim).Bind(
            material, UsdShade.Tokens.weakerThanDescendants, "physics"
        )

    def _mesh(self, path: str, vertices: np.ndarray, faces: np.ndarray) -> UsdGeom.Mesh:
        with Usd.EditContext(self.stage, self.meshes):
            return add_mesh(self.stage, path, vertices, faces)

    def _points(self, path: str, meshes: list[tuple[np.ndarray, np.ndarray]]) -> None:
        """Samples of what is drawn of a link."""
        vertices, faces = append_faces(*zip(*meshes, strict=True))
        points = UsdGeom.Points.Define(self.stage, path)
        points.CreatePurposeAttr(UsdGeom.Tokens.guide)
        points.CreateVisibilityAttr(UsdGeom.Tokens.invisible)
        with Usd.EditContext(self.stage, self.meshes):
            points.CreatePointsAttr(surface_points(Surface(vertices, faces), POINTS))

    def _joint(self, number: int, joint: Joint) -> None:
        path = f"{self.root}/{self.joints[number]}"
        revolute = UsdPhysics.RevoluteJoint.Define(self.stage, path)
        prim = revolute.GetPrim()
        # UsdPhysics knows axes x, y and z alone: both frames turn until x is the axis.
        turn = Rotation.align_vectors([joint.axis], [[1.0, 0.0, 0.0]])[0].as_quat()
        turned = np.array([0.0, 0.0, 0.0, *turn])
        parent_frame = compose(joint.parent_frame, turned)
        child_frame = compose(joint.child_frame, turned)
        revolute.CreateAxisAttr("X")
        revolute.CreateBody0Rel().SetTargets([f"{self.root}/{self.names[joint.parent]}"])
        revolute.CreateBody1Rel().SetTargets([f"{self.root}/{self.names[joint.child]}"])
        revolute.CreateLocalPos0Attr(Gf.Vec3f(*parent_frame[:3]))
        revolute.CreateLocalRot0Attr(Gf.Quatf(usd_quaternion(parent_frame[3:])))
        revolute.CreateLocalPos1Attr(Gf.Vec3f(*child_frame[:3]))
        revolute.CreateLocalRot1Attr(Gf.Quatf(usd_quaternion(child_frame[3:])))
        revolute.CreateLowerLimitAttr(float(np.degrees(joint.lower)))
        revolute.CreateUpperLimitAttr(float(np.degrees(joint.upper)))
        drive = UsdPhysics.DriveAPI.Apply(prim, "angular")
        drive.CreateTypeAttr("force")
        drive.CreateTargetPositionAttr(0.0)
        drive.CreateStiffnessAttr(float(np.radians(joint.kp)))
        drive.CreateDampingAttr(float(np.radians(joint.kd)))
        drive.CreateMaxForceAttr(joint.effort)
        _apply(prim, "NewtonJointAPI")
        _float(prim, "newton:armature", joint.armature)
        _custom(prim, "mjc:solreflimit", Sdf.ValueTypeNames.Float2, Gf.Vec2f(*LIMIT_SOLREF))
        _float(prim, "newton:velocityLimit", float(np.degrees(joint.velocity)))
        if joint.mimic is not None:
            _, factor, offset = joint.mimic
            leader = self.joints[self.tree.leader(joint)]
            _apply(prim, "NewtonMimicAPI")
            prim.CreateRelationship("newton:mimicJoint").SetTargets([f"{self.root}/{leader}"])
            _float(prim, "newton:mimicCoef0", float(np.degrees(offset)))
            _float(prim, "newton:mimicCoef1", factor)
        kinds = Sdf.ValueTypeNames
        _custom(prim, "vd:source", kinds.String, joint.name)
        _custom(prim, "vd:start", kinds.Double, float(self.stance.start[number]))
        if motor := self.said.motors.get(joint.name):
            _author_motor(prim, motor)


def _author_motor(joint: Usd.Prim, motor: MotorModel) -> None:
    names = Sdf.ValueTypeNames
    kinds = {str: names.String, int: names.Int, float: names.Double}
    for name, kind in MOTOR_ATTRIBUTES.items():
        _custom(joint, motor_attribute(name), kinds[kind], kind(getattr(motor, name)))


def shape_mesh(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [T, 3] of any shape, in its link."""
    match shape.kind:
        case "mesh":
            vertices = shape.vertices
            faces = shape.faces
        case "box":
            made = trimesh.creation.box(2.0 * np.array(shape.size))
        case "sphere":
            made = trimesh.creation.icosphere(2, shape.size[0])
        case "ellipsoid":
            made = trimesh.creation.icosphere(2).apply_scale(shape.size)
        case "capsule":
            made = trimesh.creation.capsule(2.0 * shape.size[1], shape.size[0], count=[16, 16])
        case _:
            made = trimesh.creation.cylinder(shape.size[0], 2.0 * shape.size[1], sections=24)
    if shape.kind != "mesh":
        vertices = np.array(made.vertices)
        faces = np.array(made.faces)
        if shape.kind == "capsule":
            vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    return placed(shape.frame, vertices), faces


def _distance(shape: Shape, point: np.ndarray) -> float:
    """From a point to the box around a shape [m]."""
    pose, half = shape_box(shape)
    local = placed(invert(pose), point)
    return float(np.linalg.norm(np.maximum(np.abs(local) - half, 0.0)))


def _apply(prim: Usd.Prim, schema: str) -> None:
    """Apply a schema by its name: Newton's are no Python classes."""
    prim.AddAppliedSchema(schema)


def _custom(prim: Usd.Prim, name: str, kind: Sdf.ValueTypeName, value: Any) -> None:
    """Author an attribute of ours."""
    prim.CreateAttribute(name, kind, custom=True).Set(value)


def _float(prim: Usd.Prim, name: str, value: float) -> None:
    prim.CreateAttribute(name, Sdf.ValueTypeNames.Float, custom=False).Set(float(value))


def _place(xform: UsdGeom.Xformable, pose: np.ndarray, scale: np.ndarray | None = None) -> None:
    xform.AddTranslateOp().Set(Gf.Vec3d(*pose[:3]))
    xform.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(usd_quaternion(pose[3:]))
    if scale is not None:
        xform.AddScaleOp().Set(Gf.Vec3f(*scale))
