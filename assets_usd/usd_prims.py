"""Prims that the USD files of hands and objects share."""

from collections.abc import Iterable

import newton_usd_schemas  # noqa: F401 - before the first stage, or it lacks mimic joints
import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdPhysics, Vt
from scipy.spatial.transform import Rotation


def define_root(stage: Usd.Stage, name: str) -> Usd.Prim:
    """Define the default prim of a stage in metres and kilograms with z up."""
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    prim = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
    stage.SetDefaultPrim(prim)
    return prim


def define_body(
    prim: Usd.Prim, mass: float, com: Iterable[float], moments: np.ndarray, axes: np.ndarray
) -> None:
    """Make a prim a rigid body with a mass [kg], a centre [m], and moments [kg m^2] about it.

    Args:
        prim: The prim.
        mass: Mass.
        com: Centre of mass [3].
        moments: Principal moments of inertia [3].
        axes: Their frame, quaternion xyzw.
    """
    UsdPhysics.RigidBodyAPI.Apply(prim)
    body = UsdPhysics.MassAPI.Apply(prim)
    body.CreateMassAttr(mass)
    body.CreateCenterOfMassAttr(Gf.Vec3f(*com))
    body.CreateDiagonalInertiaAttr(Gf.Vec3f(*moments))
    body.CreatePrincipalAxesAttr(Gf.Quatf(usd_quaternion(axes)))


def add_mesh(stage: Usd.Stage, path: str, vertices: np.ndarray, faces: np.ndarray) -> UsdGeom.Mesh:
    """Define a ``UsdGeom.Mesh`` of vertices [V, 3] and triangles [T, 3] in a stage."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(np.ascontiguousarray(vertices))
    mesh.CreateFaceVertexIndicesAttr(np.ascontiguousarray(faces, dtype=np.int32).ravel())
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(faces), 3))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateExtentAttr(np.stack([vertices.min(axis=0), vertices.max(axis=0)]))
    return mesh


def usd_quaternion(xyzw: np.ndarray) -> Gf.Quatd:
    """A quaternion xyzw [4] as USD's; of q and -q, one rotation, always the same."""
    x, y, z, w = Rotation.from_quat(xyzw).as_quat(canonical=True)
    return Gf.Quatd(w, x, y, z)


def numpy_quaternion(quaternion: Gf.Quatf) -> np.ndarray:
    """A USD quaternion as a unit quaternion xyzw [4], in double precision."""
    components = np.array([*quaternion.GetImaginary(), quaternion.GetReal()], dtype=float)
    return np.asarray(components / np.linalg.norm(components))
