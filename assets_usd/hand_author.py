"""Author a hand as USD: the file that simulator, training and deployment read.

Layout of the stage (z up, metres, kilograms; ``/dclaw4`` for example):

* ``/dclaw4``: articulation root and default prim, variant set ``fingertip`` = {rigid, soft},
* ``/dclaw4/base``: palm and first motors, with the ``camera`` and the points of the motors (``f0_motor``),
* ``/dclaw4/f0_l1`` ... ``f0_l3``: links, siblings of ``base``, posed as at q = 0,
* ``/dclaw4/f0_j1`` ... ``f0_j3``: revolute joints, in the order of the hand's degrees of freedom,
* ``/dclaw4/f0_l3/f0_tip``: fingertip site,
* under each link ``collision/*`` (primitives, purpose guide), ``visual/*`` (meshes) and ``points``
  (surface samples),
* ``/dclaw4/materials``: display and contact materials.

Units are USD's: limits in degrees, drive gains per degree, speed limits in degrees per second.
The schemas of Newton are authored by name, so that no plug-in is needed.
"""

import functools
import hashlib
import itertools
import math
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt
from scipy.spatial.transform import Rotation

from vd.assets_usd.cache import assets_dir
from vd.assets_usd.hand_meshes import Mesh, place, solid_mesh, surface_points
from vd.assets_usd.hand_schema import (
    Box,
    Capsule,
    Collider,
    Cylinder,
    FingertipSpec,
    HandSpec,
    JointSpec,
    LinkSpec,
    Pose,
    Sphere,
    SurfaceSpec,
    Visual,
)
from vd.assets_usd.hand_spec import HANDS, TIP
from vd.files import atomic_path

POINTS_PER_LINK = 500
"""Surface samples of a link: the released code's number."""

SITE_RADIUS = 0.001
"""Drawn radius of a fingertip site [m]; a site has no physics."""

POINT_WIDTH = 0.001
"""Drawn diameter of a surface sample [m]."""

CAMERA_APERTURE_MM = 20.955
"""Width of the camera's film: USD's default; only its ratio to the focal length has a meaning."""

BASE_DIGITS = 12
"""Decimals kept of the base's centre of mass and inertia, so that their zeros are zeros."""

OPTICAL_TO_USD = Rotation.from_euler("x", 180, degrees=True)
"""A USD camera looks along -z with +y up; the optical frame along +z with +y down."""


def hand_usd(name: str) -> Path:
    """The USD file of a hand, authored into the cache if it is not there.

    The file name carries a hash of the content, so a file of an older description is never read.

    Raises:
        ValueError: No hand has this name.
    """
    if name not in HANDS:
        raise ValueError(f"no hand is called {name!r}: choose one of {', '.join(HANDS)}")
    stage = _author(HANDS[name])
    text = stage.GetRootLayer().ExportToString()
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    path = assets_dir() / "hands" / f"{name}-{digest}.usda"
    if not path.is_file() or path.read_text() != text:
        _export(stage, path)
    return path


def author_hand(spec: HandSpec, path: Path) -> None:
    """Write ``spec`` as USD to ``path`` (``.usda``, ``.usdc`` or ``.usd``), atomically.

    Raises:
        ValueError: The suffix is not one of USD's.
    """
    path = Path(path)
    if path.suffix not in (".usda", ".usdc", ".usd"):
        raise ValueError(f"{path}: a hand is written as .usda, .usdc or .usd, not {path.suffix!r}")
    _export(_author(spec), path)


def _export(stage: Usd.Stage, path: Path) -> None:
    with atomic_path(path) as temporary:
        if not stage.GetRootLayer().Export(str(temporary)):
            raise OSError(f"{path}: USD could not write the hand; is the disk full?")


def _author(spec: HandSpec) -> Usd.Stage:
    """The stage of a hand, in memory."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, f"/{spec.name}").GetPrim()
    stage.SetDefaultPrim(root)
    root.SetDocumentation(f"D'Claw hand with {len(spec.finger_frames)} fingers. {spec.note}")
    UsdPhysics.ArticulationRootAPI.Apply(root)
    _materials(stage, spec)

    base_prim = _body(stage, root.GetPath().AppendChild("base"), Pose(), *_base_inertia(spec))
    _colliders(stage, base_prim.GetPath(), "", spec.palm.colliders, Pose(), spec)
    drawn = {"palm": (spec.palm.visuals, Pose())}
    for finger, frame in enumerate(spec.finger_frames):
        _colliders(stage, base_prim.GetPath(), f"f{finger}_", spec.motor.colliders, frame, spec)
        drawn[f"f{finger}_motor"] = (spec.motor.visuals, frame)
    for name, (visuals, frame) in drawn.items():
        _visuals(stage, base_prim.GetPath(), f"{name}_", visuals, frame, spec)
        if name != "palm":
            _points(stage, base_prim.GetPath().AppendChild(f"{name}_points"), visuals, frame)
    _camera(stage, base_prim.GetPath().AppendChild("camera"), spec)

    for finger, frame in enumerate(spec.finger_frames):
        _finger(stage, spec, finger, frame)
    for first, second in _filtered_pairs(spec):
        api = UsdPhysics.FilteredPairsAPI.Apply(stage.GetPrimAtPath(root.GetPath().AppendChild(first)))
        api.CreateFilteredPairsRel().AddTarget(root.GetPath().AppendChild(second))
    return stage


def _finger(stage: Usd.Stage, spec: HandSpec, finger: int, frame: Pose) -> None:
    """One finger: three links, three joints and the site of the tip."""
    root = Sdf.Path(f"/{spec.name}")
    parent, parent_frame = "base", Pose()
    for link, joint in zip(spec.links, spec.joints, strict=True):
        # The first joint is placed by the finger frame, the others by their parents' unturned frames.
        to_joint = frame if parent == "base" else Pose()
        anchor = _compose(to_joint, Pose(joint.offset))
        pose = _compose(parent_frame, anchor)
        name = f"f{finger}_{link.name}"
        prim = _body(stage, root.AppendChild(name), pose, link.mass, link.com, np.diag(link.inertia))
        _colliders(stage, prim.GetPath(), "", link.colliders, Pose(), spec)
        _visuals(stage, prim.GetPath(), "", link.visuals, Pose(), spec)
        _points(stage, prim.GetPath().AppendChild("points"), link.visuals, Pose())
        _joint(stage, root, f"f{finger}_{joint.name}", joint, parent, name, anchor)
        parent, parent_frame = name, pose
    site = UsdGeom.Sphere.Define(stage, root.AppendPath(f"{parent}/f{finger}_tip"))
    site.CreateRadiusAttr(SITE_RADIUS)
    site.CreatePurposeAttr(UsdGeom.Tokens.guide)
    site.GetPrim().AddAppliedSchema("NewtonSiteAPI")
    _place(site, Pose(spec.tip))


def _filtered_pairs(spec: HandSpec) -> list[tuple[str, str]]:
    """Links that joints connect, whose colliders overlap by design, and links that cannot meet."""
    pairs: list[tuple[str, str]] = []
    for finger in range(len(spec.finger_frames)):
        chain = ["base", *(f"f{finger}_{link.name}" for link in spec.links)]
        pairs += itertools.pairwise(chain)
    return pairs + list(spec.unreachable)


def _body(
    stage: Usd.Stage,
    path: Sdf.Path,
    pose: Pose,
    mass: float,
    com: tuple[float, float, float],
    inertia: np.ndarray,
) -> Usd.Prim:
    """A rigid body at ``pose`` with ``inertia`` [3, 3] about its centre of mass."""
    xform = UsdGeom.Xform.Define(stage, path)
    _place(xform, pose)
    prim = xform.GetPrim()
    UsdPhysics.RigidBodyAPI.Apply(prim)
    if np.count_nonzero(inertia - np.diag(np.diag(inertia))) == 0:
        moments, axes = np.diag(inertia), np.eye(3)
    else:
        moments, axes = np.linalg.eigh(inertia)
        axes = axes * np.sign(np.linalg.det(axes))
    api = UsdPhysics.MassAPI.Apply(prim)
    api.CreateMassAttr(mass)
    api.CreateCenterOfMassAttr(Gf.Vec3f(*com))
    api.CreateDiagonalInertiaAttr(Gf.Vec3f(*(float(m) for m in moments)))
    api.CreatePrincipalAxesAttr(_quatf(Rotation.from_matrix(axes).as_quat()))
    return prim


def _base_inertia(spec: HandSpec) -> tuple[float, tuple[float, float, float], np.ndarray]:
    """Mass, centre of mass and inertia [3, 3] of the palm with the first motor of every finger."""
    parts: list[tuple[LinkSpec, Pose]] = [(spec.palm, Pose())]
    parts += [(spec.motor, frame) for frame in spec.finger_frames]
    mass = sum(part.mass for part, _ in parts)
    centres = [np.asarray(_compose(frame, Pose(part.com)).position) for part, frame in parts]
    com = sum(part.mass * centre for (part, _), centre in zip(parts, centres, strict=True)) / mass
    inertia = np.zeros((3, 3))
    for (part, frame), centre in zip(parts, centres, strict=True):
        turn = Rotation.from_quat(frame.quaternion).as_matrix()
        arm = centre - com
        inertia += turn @ np.diag(part.inertia) @ turn.T
        inertia += part.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    x, y, z = (float(c) for c in np.round(com, BASE_DIGITS))
    return mass, (x, y, z), np.round(inertia, BASE_DIGITS)


def _joint(
    stage: Usd.Stage, root: Sdf.Path, name: str, joint: JointSpec, parent: str, child: str, anchor: Pose
) -> None:
    """A driven revolute joint between two links; ``anchor`` is its frame in the parent link."""
    prim = UsdPhysics.RevoluteJoint.Define(stage, root.AppendChild(name))
    prim.CreateBody0Rel().SetTargets([root.AppendChild(parent)])
    prim.CreateBody1Rel().SetTargets([root.AppendChild(child)])
    prim.CreateAxisAttr(joint.axis)
    prim.CreateLocalPos0Attr(Gf.Vec3f(*anchor.position))
    prim.CreateLocalRot0Attr(_quatf(anchor.quaternion))
    prim.CreateLocalPos1Attr(Gf.Vec3f(0.0))
    prim.CreateLocalRot1Attr(Gf.Quatf(1.0))
    prim.CreateLowerLimitAttr(math.degrees(joint.lower))
    prim.CreateUpperLimitAttr(math.degrees(joint.upper))
    drive = UsdPhysics.DriveAPI.Apply(prim.GetPrim(), "angular")
    drive.CreateTypeAttr("force")
    drive.CreateStiffnessAttr(math.radians(joint.kp))  # N m per degree
    drive.CreateDampingAttr(math.radians(joint.kd))
    drive.CreateMaxForceAttr(joint.effort)
    drive.CreateTargetPositionAttr(0.0)
    prim.GetPrim().AddAppliedSchema("NewtonJointAPI")
    _newton(prim.GetPrim(), "armature", joint.armature)
    _newton(prim.GetPrim(), "velocityLimit", math.degrees(joint.velocity))


def _colliders(
    stage: Usd.Stage,
    link: Sdf.Path,
    prefix: str,
    colliders: tuple[Collider, ...],
    frame: Pose,
    spec: HandSpec,
) -> None:
    """Collision primitives of a link, placed in ``frame`` of it."""
    group = UsdGeom.Scope.Define(stage, link.AppendChild("collision"))
    group.CreatePurposeAttr(UsdGeom.Tokens.guide)
    for collider in colliders:
        path = group.GetPath().AppendChild(prefix + collider.name)
        shape, scale = collider.shape, None
        match shape:
            case Box():
                gprim: UsdGeom.Gprim = UsdGeom.Cube.Define(stage, path)
                gprim.CreateSizeAttr(1.0)
                scale = shape.size
            case Sphere():
                gprim = UsdGeom.Sphere.Define(stage, path)
                gprim.CreateRadiusAttr(shape.radius)
            case Capsule() | Cylinder():
                kind = UsdGeom.Capsule if isinstance(shape, Capsule) else UsdGeom.Cylinder
                gprim = kind.Define(stage, path)
                gprim.CreateRadiusAttr(shape.radius)
                gprim.CreateHeightAttr(shape.length)
                gprim.CreateAxisAttr(shape.axis)
        _place(gprim, _compose(frame, shape.pose))
        if scale is not None:
            UsdGeom.Xformable(gprim).AddScaleOp().Set(Gf.Vec3f(*scale))
        prim = gprim.GetPrim()
        UsdPhysics.CollisionAPI.Apply(prim)
        prim.AddAppliedSchema("NewtonCollisionAPI")
        _newton(prim, "contactGap", spec.contact_gap)
        _newton(prim, "contactMargin", 0.0)
        _bind(stage, prim, spec, "fingertip_surface" if collider.fingertip else "surface", physics=True)


@functools.cache
def _drawing(visuals: tuple[Visual, ...]) -> tuple[tuple[Mesh, ...], np.ndarray]:
    """Meshes of a link's parts and its surface samples, in its own frame: the same for every finger."""
    meshes = tuple(solid_mesh(visual.solid) for visual in visuals)
    return meshes, surface_points(meshes, POINTS_PER_LINK)


def _visuals(
    stage: Usd.Stage, link: Sdf.Path, prefix: str, visuals: tuple[Visual, ...], frame: Pose, spec: HandSpec
) -> None:
    """The drawing of a link placed in ``frame``: one mesh per material."""
    group = UsdGeom.Scope.Define(stage, link.AppendChild("visual"))
    parts, _ = _drawing(visuals)
    for material in dict.fromkeys(visual.material for visual in visuals):
        meshes = [mesh for mesh, visual in zip(parts, visuals, strict=True) if visual.material == material]
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
        faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)])
        vertices = place(np.concatenate([mesh.vertices for mesh in meshes]), frame).astype(np.float32)
        prim = UsdGeom.Mesh.Define(stage, group.GetPath().AppendChild(prefix + material))
        prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices))
        prim.CreateFaceVertexCountsAttr(Vt.IntArray(len(faces), 3))
        prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        prim.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(prim.GetPointsAttr().Get()))
        _bind(stage, prim.GetPrim(), spec, material, physics=False)


def _points(stage: Usd.Stage, path: Sdf.Path, visuals: tuple[Visual, ...], frame: Pose) -> None:
    """Surface samples of a link, which no viewer draws and no simulator reads as particles."""
    _, samples = _drawing(visuals)
    prim = UsdGeom.Points.Define(stage, path)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(place(samples, frame).astype(np.float32)))
    prim.CreateWidthsAttr([POINT_WIDTH])
    prim.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    prim.CreatePurposeAttr(UsdGeom.Tokens.guide)
    prim.CreateVisibilityAttr(UsdGeom.Tokens.invisible)


def _camera(stage: Usd.Stage, path: Sdf.Path, spec: HandSpec) -> None:
    """The depth camera; a USD camera has no resolution of its own, so ``vd:resolution`` carries it."""
    camera = spec.camera
    width = CAMERA_APERTURE_MM
    height = width * (camera.height / camera.fy) / (camera.width / camera.fx)
    prim = UsdGeom.Camera.Define(stage, path)
    prim.CreateProjectionAttr(UsdGeom.Tokens.perspective)
    prim.CreateHorizontalApertureAttr(width)
    prim.CreateVerticalApertureAttr(height)
    prim.CreateFocalLengthAttr(camera.fx * width / camera.width)
    # A window shifted to the right moves the principal point to the left in the image; up, down.
    prim.CreateHorizontalApertureOffsetAttr((0.5 - camera.cx / camera.width) * width)
    prim.CreateVerticalApertureOffsetAttr((camera.cy / camera.height - 0.5) * height)
    prim.CreateClippingRangeAttr(Gf.Vec2f(camera.near, camera.far))
    resolution = prim.GetPrim().CreateAttribute("vd:resolution", Sdf.ValueTypeNames.Int2, custom=True)
    resolution.Set(Gf.Vec2i(camera.width, camera.height))
    optical = Rotation.from_quat(camera.pose.quaternion)
    x, y, z, w = (float(c) for c in (optical * OPTICAL_TO_USD).as_quat())
    _place(prim, Pose(camera.pose.position, (x, y, z, w)))


def _materials(stage: Usd.Stage, spec: HandSpec) -> None:
    """Display and contact materials; what depends on the fingertip is authored in its variants only."""
    root = stage.GetDefaultPrim()
    scope = UsdGeom.Scope.Define(stage, root.GetPath().AppendChild("materials")).GetPath()
    for name, color in spec.colors.items():
        _color(stage, scope.AppendChild(name), color)
    _surface(stage, scope.AppendChild("surface"), spec.surface)
    for name in ("fingertip_surface", TIP):
        UsdShade.Material.Define(stage, scope.AppendChild(name))
    variants = root.GetVariantSets().AddVariantSet("fingertip")
    for kind, fingertip in spec.fingertips.items():
        variants.AddVariant(kind)
        variants.SetVariantSelection(kind)
        with variants.GetVariantEditContext():
            _fingertip(stage, scope, fingertip)
    variants.SetVariantSelection(next(iter(spec.fingertips)))


def _fingertip(stage: Usd.Stage, scope: Sdf.Path, fingertip: FingertipSpec) -> None:
    """What a kind of fingertip says about the materials, in the current edit target."""
    _surface(stage, scope.AppendChild("fingertip_surface"), fingertip.surface)
    _color(stage, scope.AppendChild(TIP), fingertip.color)


def _surface(stage: Usd.Stage, path: Sdf.Path, surface: SurfaceSpec) -> None:
    """A contact material."""
    prim = UsdShade.Material.Define(stage, path).GetPrim()
    api = UsdPhysics.MaterialAPI.Apply(prim)
    # Both: an importer that reads only the one or the other would else see no friction.
    api.CreateStaticFrictionAttr(surface.friction)
    api.CreateDynamicFrictionAttr(surface.friction)
    api.CreateRestitutionAttr(surface.restitution)
    prim.AddAppliedSchema("NewtonMaterialAPI")
    _newton(prim, "contactStiffness", surface.stiffness)
    _newton(prim, "contactDamping", surface.damping)


def _color(stage: Usd.Stage, path: Sdf.Path, color: tuple[float, float, float]) -> None:
    """A preview material of one colour."""
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, path.AppendChild("preview"))
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*color))
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.5)
    shader.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")


def _bind(stage: Usd.Stage, prim: Usd.Prim, spec: HandSpec, name: str, *, physics: bool) -> None:
    """Bind a material of this hand to a prim, for display or for physics."""
    material = UsdShade.Material(stage.GetPrimAtPath(f"/{spec.name}/materials/{name}"))
    purpose = "physics" if physics else UsdShade.Tokens.allPurpose
    api = UsdShade.MaterialBindingAPI.Apply(prim)
    api.Bind(material, UsdShade.Tokens.weakerThanDescendants, purpose)


def _newton(prim: Usd.Prim, name: str, value: float) -> None:
    """A float attribute of Newton's schemas."""
    prim.CreateAttribute(f"newton:{name}", Sdf.ValueTypeNames.Float, custom=False).Set(value)


def _place(prim: UsdGeom.Xformable, pose: Pose) -> None:
    """Author ``pose`` relative to the parent prim, in double precision."""
    x, y, z, w = pose.quaternion
    prim.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*pose.position))
    prim.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(w, x, y, z))


def _compose(first: Pose, second: Pose) -> Pose:
    """``first * second``: the pose ``second``, given in the frame ``first``, in the frame of ``first``."""
    turn = Rotation.from_quat(first.quaternion)
    px, py, pz = (float(c) for c in turn.apply(second.position) + np.asarray(first.position))
    x, y, z, w = (float(c) for c in (turn * Rotation.from_quat(second.quaternion)).as_quat())
    return Pose((px, py, pz), (x, y, z, w))


def _quatf(quaternion: "np.ndarray | tuple[float, float, float, float]") -> Gf.Quatf:
    """A USD quaternion from xyzw."""
    x, y, z, w = (float(c) for c in quaternion)
    return Gf.Quatf(w, x, y, z)
