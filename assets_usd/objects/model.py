"""The object format: one USD file per rigid object, written and read here and nowhere else.

Layout of a file (metres, kilograms, z up; the origin is the centre of mass)::

    /<name>              Xform, default prim; RigidBodyAPI, MassAPI (mass, inertia, principal axes)
      visual             Mesh, for pictures only
      collision/hull_0.. Mesh with CollisionAPI and MeshCollisionAPI (convexHull), bound to material
      surface_points     Points, the object's point cloud
      material           physics material (nominal friction)

Everything that is not geometry or physics (licence, source, errors, symmetries) is custom data of
the root prim under ``visualDexterity``. Files are binary crates (``.usd``): 150 objects are a few
MB.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.objects.contact_layer import (
    LAYER_FORMAT,
    Identified,
    author_contact,
    read_contact,
)
from vd.assets_usd.objects.geometry import Hull, Solid, Surface, principal_axes
from vd.command.files import atomic_path
from vd.paper import PAPER

FORMAT_VERSION = 1
SURFACE_POINTS = 500
"""Points of an object's cloud (the paper samples 500 from each CAD model)."""

SUFFIXES = (".usd", ".usda", ".usdc")
IDENTITY = np.array([[0.0, 0.0, 0.0, 1.0]])
_CUSTOM = "visualDexterity"
_STORED: dict[str, type] = {
    "licence": str,
    "source": str,
    "file": str,
    "family": str,
    "split": str,
    "scale": float,
    "volume_error": float,
    "volume_method": str,
    "content_hash": str,
}
"""Fields of :class:`ObjectModel` that are custom data under their names in camel case."""


class ObjectError(ValueError):
    """An object file or set cannot be used; the message names it, the field and the remedy."""


@dataclass(frozen=True)
class ObjectModel:
    """A rigid object with its origin at the centre of its volume (object frame, SI).

    Attributes:
        name: Prim and file name.
        vertices: Visual mesh, [V, 3] float32.
        faces: Visual triangles, [T, 3] int32, outward.
        hulls: Convex collision parts.
        mass_kg: Nominal mass.
        inertia: Principal moments about the centre of mass, [3], kg m^2.
        inertia_quat: Principal frame in the object frame, quaternion xyzw, [4].
        surface_points: Even samples of the surface, [500, 3] float32.
        symmetry: Rotations that map the object to itself, quaternions xyzw [K, 4]; the identity
            first.
        licence: Licence of the shape.
        source: Where the shape comes from.
        file: Mesh file it was imported from, absolute; empty if it was authored.
        family: Kind of object (procedural family, or ``imported``).
        split: ``train``, ``test`` or empty.
        scale: Factor from the source's units to metres in this file.
        volume_error: Volume in which the union of hulls and the solid differ / volume of the solid.
        volume_method: How that was estimated.
        content_hash: Hash of what the file was made from; equal hashes need no new work.
        notes: What was repaired or assumed.
        warnings: What may be wrong with the object: reports on it repeat them.
        centre_of_mass: In the object frame, [3]; the origin unless it was identified.
        contact: What was identified of its contact (:mod:`vd.assets_usd.objects.contact_layer`).
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    hulls: tuple[Hull, ...]
    mass_kg: float
    inertia: np.ndarray
    inertia_quat: np.ndarray
    surface_points: np.ndarray
    symmetry: np.ndarray = field(default_factory=IDENTITY.copy)
    licence: str = "unknown"
    source: str = ""
    file: str = ""
    family: str = ""
    split: str = ""
    scale: float = 1.0
    volume_error: float = 0.0
    volume_method: str = ""
    content_hash: str = ""
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    centre_of_mass: tuple[float, ...] = (0.0, 0.0, 0.0)
    contact: Identified = field(default_factory=dict)

    @property
    def inertia_matrix(self) -> np.ndarray:
        """Inertia about the centre of mass in the object frame, [3, 3], kg m^2."""
        axes = Rotation.from_quat(self.inertia_quat).as_matrix()
        return axes @ np.diag(self.inertia) @ axes.T

    @property
    def longest_side(self) -> float:
        """Longest side of the axis-aligned bounding box of the visual mesh, m."""
        return float(np.ptp(self.vertices, axis=0).max())

    def fitted(self, sides: tuple[float, float]) -> "ObjectModel":
        """The object, scaled as little as gives its longest side one of these lengths [m].

        Its mass stays.
        """
        factor = float(np.clip(self.longest_side, *sides)) / self.longest_side
        return replace(
            self,
            vertices=self.vertices * np.float32(factor),
            hulls=tuple(hull.times(float(np.float32(factor))) for hull in self.hulls),
            inertia=self.inertia * factor**2,
            surface_points=self.surface_points * np.float32(factor),
            centre_of_mass=tuple(factor * c for c in self.centre_of_mass),
            scale=self.scale * factor,
        )


def build_model(
    name: str,
    surface: Surface,
    hulls: Sequence[Hull],
    solid: Solid,
    points: np.ndarray,
    *,
    mass_kg: float = PAPER.materials.object_mass_kg,
    **fields: Any,
) -> ObjectModel:
    """Assemble a model from geometry in any frame: moves the origin to the solid's centroid.

    Args:
        name: A valid prim name.
        surface: Visual mesh, m.
        hulls: Collision parts in the same frame.
        solid: Mass properties at density 1 in the same frame.
        points: Surface points [500, 3] in the same frame.
        mass_kg: Mass; the inertia is scaled to it.
        **fields: The remaining fields of :class:`ObjectModel`.
    """
    moments, quat = principal_axes(solid.inertia * (mass_kg / solid.volume))
    return ObjectModel(
        name=name,
        vertices=np.asarray(surface.vertices - solid.centroid, dtype=np.float32),
        faces=np.asarray(surface.faces, dtype=np.int32),
        hulls=tuple(
            Hull(np.asarray(h.vertices - solid.centroid, np.float32), np.asarray(h.faces, np.int32))
            for h in hulls
        ),
        mass_kg=float(mass_kg),
        inertia=moments,
        inertia_quat=quat,
        surface_points=np.asarray(points - solid.centroid, dtype=np.float32),
        **fields,
    )


def write_object(path: Path, model: ObjectModel) -> Path:
    """Write a model to one USD file, atomically.

    Args:
        path: Target; ``.usd``/``.usdc`` are binary, ``.usda`` is text.
        model: What to write.

    Returns:
        The path.
    """
    from pxr import Usd, UsdGeom, UsdPhysics, UsdShade, Vt

    from vd.assets_usd.usd_prims import add_mesh, define_body, define_root

    stage = Usd.Stage.CreateInMemory()
    prim = define_root(stage, model.name)
    define_body(prim, model.mass_kg, model.centre_of_mass, model.inertia, model.inertia_quat)
    root = prim.GetPath()
    material = UsdShade.Material.Define(stage, f"{root}/material")
    physics = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    physics.CreateStaticFrictionAttr(PAPER.materials.friction)
    physics.CreateDynamicFrictionAttr(PAPER.materials.friction)

    add_mesh(stage, f"{root}/visual", model.vertices, model.faces)
    UsdGeom.Scope.Define(stage, f"{root}/collision")
    for i, hull in enumerate(model.hulls):
        mesh = add_mesh(stage, f"{root}/collision/hull_{i}", hull.vertices, hull.faces)
        mesh.CreatePurposeAttr(UsdGeom.Tokens.guide)
        UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
        collision = UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim())
        collision.CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material, materialPurpose="physics")
    points = UsdGeom.Points.Define(stage, f"{root}/surface_points")
    points.CreatePointsAttr(model.surface_points)
    points.CreatePurposeAttr(UsdGeom.Tokens.guide)
    prim.SetCustomDataByKey(
        _CUSTOM,
        {
            "formatVersion": FORMAT_VERSION,
            **{_key(name): kind(getattr(model, name)) for name, kind in _STORED.items()},
            "notes": "\n".join(model.notes),
            "warnings": "\n".join(model.warnings),
            "symmetry": Vt.DoubleArray(model.symmetry.ravel().tolist()),
        },
    )
    author_contact(stage.GetRootLayer().GetPrimAtPath(root), model.contact)
    with atomic_path(path) as temporary:
        if not stage.GetRootLayer().Export(str(temporary)):
            raise OSError(f"{path}: USD could not write the object; is the disk full?")
    return path


def _key(name: str) -> str:
    """A field's name in camel case."""
    return name[0] + name.title().replace("_", "")[1:]


def _layer(path: Path) -> Any:
    """The layer of a USD file as it is now, with its sublayers in it; None if it is none."""
    from pxr import Sdf, Tf, Usd

    try:
        # Anonymous: a layer cached by path would hide that the file was written anew.
        layer = Sdf.Layer.OpenAsAnonymous(str(path))
    except Tf.ErrorException:
        return None
    if layer is None or not layer.subLayerPaths:
        return layer
    below = []  # which live as long as the stage is read
    for file in map(path.parent.joinpath, layer.subLayerPaths):
        sublayer = _layer(file)
        if sublayer is None:
            raise ObjectError(
                f"{path}: its sublayer {file} is missing or no USD; put the object's file there"
            )
        below.append(sublayer)
    layer.subLayerPaths = [sublayer.identifier for sublayer in below]
    return Usd.Stage.Open(layer).Flatten()


def _custom(layer: Any) -> dict[str, Any]:
    """Custom data of an object's root prim; empty if the layer is no object of ours."""
    prim = layer and layer.GetPrimAtPath(f"/{layer.defaultPrim}")
    return dict(prim.customData.get(_CUSTOM, {})) if prim else {}


def is_object(stage: Any) -> bool:
    """Whether a stage is an object file of ours, of any version."""
    return bool(_custom(stage.GetRootLayer()))


def stored_facts(path: Path) -> dict[str, Any]:
    """Custom data of an object file of any version, by names in camel case.

    Empty of any other file.
    """
    return _custom(_layer(path))


def read_object(path: Path) -> ObjectModel:
    """Read an object file.

    Args:
        path: A file written by :func:`write_object`.

    Raises:
        ObjectError: The file is missing, no USD, of another version, or a part is missing.
    """
    from pxr import Usd, UsdPhysics

    from vd.assets_usd.usd_prims import numpy_quaternion

    path = Path(path)
    if not path.is_file():
        raise ObjectError(f"{path}: no such object file")
    layer = _layer(path)
    if layer is None:
        raise ObjectError(
            f"{path}: not a USD file, or a damaged one; remove it, and import or author the object "
            f"again"
        )
    data = _custom(layer)
    if data.get("formatVersion") != FORMAT_VERSION:
        raise ObjectError(
            f"{path}: formatVersion is {data.get('formatVersion')}, this version reads "
            f"{FORMAT_VERSION}; import it again (vd-assets import); a hand's layer goes to "
            "--hand-layer"
        )
    stage = Usd.Stage.Open(layer)
    prim = stage.GetDefaultPrim()
    root = prim.GetPath()

    def array(relative: str, attribute: str) -> np.ndarray:
        child = stage.GetPrimAtPath(root.AppendPath(relative))
        value = child.GetAttribute(attribute).Get() if child else None
        if value is None or not len(value):
            raise ObjectError(f"{path}: {relative}.{attribute} is missing; import the object again")
        return np.array(value).reshape(-1, 3)

    def mesh(relative: str) -> Surface:
        return Surface(array(relative, "points"), array(relative, "faceVertexIndices"))

    try:
        contact = read_contact(prim, str(path))
    except ValueError as error:
        raise ObjectError(str(error)) from error
    collision = stage.GetPrimAtPath(root.AppendPath("collision"))
    parts = collision.GetChildren() if collision else ()
    hulls = [mesh(f"collision/{part.GetName()}") for part in parts]
    if not hulls:
        raise ObjectError(f"{path}: collision has no hull; import the object again")
    visual = mesh("visual")
    mass = UsdPhysics.MassAPI(prim)
    return ObjectModel(
        name=prim.GetName(),
        vertices=visual.vertices,
        faces=visual.faces,
        hulls=tuple(hulls),
        mass_kg=float(mass.GetMassAttr().Get()),
        centre_of_mass=tuple(mass.GetCenterOfMassAttr().Get()),
        contact=contact,
        inertia=np.array(mass.GetDiagonalInertiaAttr().Get(), dtype=np.float64),
        inertia_quat=numpy_quaternion(mass.GetPrincipalAxesAttr().Get()),
        surface_points=array("surface_points", "points"),
        symmetry=np.array(data["symmetry"], dtype=np.float64).reshape(-1, 4),
        **{name: kind(data[_key(name)]) for name, kind in _STORED.items()},
        notes=tuple(data["notes"].splitlines()),
        warnings=tuple(data["warnings"].splitlines()),
    )


def write_contact_layer(
    path: Path, item_file: Path, identified: Identified, recording: str
) -> None:
    """Write what was identified as a layer over an object's file, atomically.

    Args:
        path: File to write, ``.usda``.
        item_file: The object's file, which becomes a sublayer.
        identified: What was identified.
        recording: From which recording, for people.

    Raises:
        ObjectError: The file is no object.
    """
    from pxr import Gf, Sdf

    from vd.assets_usd.hand_layer import author, new_layer, save_layer

    item = read_object(item_file)
    layer = new_layer(
        item.name,
        f"Contact of {item.name}, identified by vd-gap contact from {recording}: "
        "pass it as --objects.",
        {"format": LAYER_FORMAT, "recording": recording},
    )
    layer.subLayerPaths.append(os.path.relpath(item_file.resolve(), path.resolve().parent))
    prim = Sdf.PrimSpec(layer, item.name, Sdf.SpecifierOver)

    author_contact(prim, identified)
    if "mass" in identified:
        mass = identified["mass"][0][0]
        moments = Gf.Vec3f(*map(float, item.inertia * mass / item.mass_kg))
        author(prim, "physics:mass", Sdf.ValueTypeNames.Float, mass)
        author(prim, "physics:diagonalInertia", Sdf.ValueTypeNames.Float3, moments)
    if "centre_of_mass" in identified:
        centre = Gf.Vec3f(*identified["centre_of_mass"][0])
        author(prim, "physics:centerOfMass", Sdf.ValueTypeNames.Point3f, centre)
    save_layer(layer, path)


def object_files(folder: Path) -> list[Path]:
    """The object files of a set's folder, sorted by name."""
    return sorted(file for file in folder.glob("[!.]*.usd*") if file.suffix in SUFFIXES)
