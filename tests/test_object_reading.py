"""What mesh files are and what is read from them.

Formats by content, whole files, USD made elsewhere.
"""

import gzip
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import Gf, Usd, UsdGeom

from vd.assets_usd.objects import procedural
from vd.assets_usd.objects.model import write_object
from vd.assets_usd.objects.plan import Job, find_meshes
from vd.assets_usd.objects.reading import declared_unit, load_mesh, mesh_kind
from vd.assets_usd.objects.settings import ImportSettings, MeshError

BOX = trimesh.creation.box((0.1, 0.06, 0.04))
CORNERS = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\n"


FOREIGN = {
    "mug.stl": (
        b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n",
        "LFS pointer.*git lfs pull",
    ),
    "mug.step": (b"ISO-10303-21;\nHEADER;", r"unsupported type \.step; use .*: export a CAD"),
    "mug.obj": (b"<!DOCTYPE html><html>", "web page.*download it again"),
    "mug.glb": (gzip.compress(b"x"), "archive.*unpack it"),
    "mug.ply": (b"", "empty file"),
}


@pytest.mark.parametrize("name", sorted(FOREIGN))
def test_what_is_no_mesh_is_called_what_it_is_with_a_remedy(name: str, tmp_path: Path) -> None:
    content, words = FOREIGN[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(MeshError, match=words):
        mesh_kind(tmp_path / name)


@pytest.mark.parametrize("kind", ["obj", "stl", "stl_ascii", "ply", "glb"])
def test_every_kind_of_mesh_is_read(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"box.{kind.removesuffix('_ascii').upper()}"
    BOX.export(path, file_type=kind)
    mesh = load_mesh(path)
    assert len(mesh.faces) == 12
    np.testing.assert_allclose(mesh.extents, BOX.extents, atol=1e-6)
    assert declared_unit(path) == (1.0 if kind == "glb" else None)


@pytest.mark.parametrize(
    ("faces", "count"),
    [
        ("f 1 2 3 4\nf 5 6 7\n", 3),
        ("f 1 2 3 4 5 6\n", 4),
        ("f -8 -7 -6\n", 1),
        ("f\t1\t2\t3\nf 1 3 4\n", 2),
        ("f 1/1 2/1/1 3//1 # a corner\nf 1 2 \\\n3\n", 2),
        ("g a\ns off\nusemtl m\nf 1 2 3\no b\nf 1 3 4\r\n", 2),
    ],
)
def test_no_face_of_an_obj_is_lost(faces: str, count: int, tmp_path: Path) -> None:
    path = tmp_path / "x.obj"
    path.write_bytes(f"mtllib x.mtl\n{CORNERS}{faces}".encode())
    mesh = load_mesh(path)
    assert mesh.faces.shape == (count, 3) and mesh.faces.min() == 0 and len(mesh.vertices) == 8


@pytest.mark.parametrize("faces", ["f 1 2 3\nf 1 2 99\n", "f -9 1 2\n", "v 1,5 0 0\n", "f 1 2\n"])
def test_a_damaged_obj_is_refused(faces: str, tmp_path: Path) -> None:
    path = tmp_path / "x.obj"
    path.write_text(CORNERS + faces)
    with pytest.raises(MeshError, match=r"neither mesh|declares"):
        load_mesh(path)


@pytest.mark.parametrize("kind", ["stl", "stl_ascii", "ply", "ply_ascii", "glb"])
def test_a_file_that_is_cut_short_is_refused(kind: str, tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    name = kind.partition("_")[0]
    how = {"file_type": "ply", "encoding": "ascii"} if kind == "ply_ascii" else {"file_type": kind}
    data = ball.export(**how)
    data = data if isinstance(data, bytes) else data.encode()
    path = tmp_path / f"x.{name}"
    path.write_bytes(data[: int(0.8 * len(data))])
    with pytest.raises(MeshError, match=r"declares \d+ faces, of which|neither mesh|cut short"):
        load_mesh(path)


def add_box(stage: Usd.Stage, path: str, points: np.ndarray) -> UsdGeom.Mesh:
    """A box of quadrilaterals between the corners of ``points`` [2, 3]."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    corners = [tuple(points[(i >> k) & 1, k] for k in range(3)) for i in range(8)]
    mesh.CreatePointsAttr([Gf.Vec3f(*map(float, corner)) for corner in corners])
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    mesh.CreateFaceVertexIndicesAttr([i for quad in quads for i in quad])
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    return mesh


@pytest.fixture
def mug(tmp_path: Path) -> Path:
    """A USD as others make them.

    Centimetres, y up, parts by reference, an instance, variants, a collider.

    By the variant selected it is a box of 4 x 10 x 4 cm from (0, 0, 0) with a mirrored copy of a
    part of 1 x 2 x 1 cm, twice as large, beside it.
    """
    part = Usd.Stage.CreateNew(str(tmp_path / "parts" / "part.usda"))
    UsdGeom.SetStageMetersPerUnit(part, 0.01)
    part.SetDefaultPrim(UsdGeom.Xform.Define(part, "/part").GetPrim())
    add_box(part, "/part/geometry", np.array([[0, 0, 0], [1, 2, 1]]))
    part.Save()
    stage = Usd.Stage.CreateNew(str(tmp_path / "mug.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    root = UsdGeom.Xform.Define(stage, "/mug").GetPrim()
    stage.SetDefaultPrim(root)
    variants = root.GetVariantSets().AddVariantSet("size")
    for name, height in (("small", 5), ("large", 10)):
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            add_box(stage, "/mug/body", np.array([[0, 0, 0], [4, height, 4]]))
    handle = UsdGeom.Xform.Define(stage, "/mug/handle")
    handle.AddTranslateOp().Set(Gf.Vec3d(4, 0, 0))
    handle.AddScaleOp().Set(Gf.Vec3f(2, 2, -2))
    handle.GetPrim().GetReferences().AddReference("./parts/part.usda")
    handle.GetPrim().SetInstanceable(True)
    collider = add_box(stage, "/mug/collider", np.array([[-9, -9, -9], [9, 9, 9]]))
    collider.CreatePurposeAttr(UsdGeom.Tokens.guide)
    hidden = UsdGeom.Sphere.Define(stage, "/mug/hidden")
    hidden.CreateVisibilityAttr(UsdGeom.Tokens.invisible)
    add_box(stage, "/floor", np.array([[-99, -1, -99], [99, 0, 99]]))
    stage.Save()
    return tmp_path / "mug.usda"


def test_a_usd_made_elsewhere_is_read_as_it_is_composed(mug: Path, tmp_path: Path) -> None:
    mesh = load_mesh(mug)
    assert declared_unit(mug) == 0.01
    # y up becomes z up: (x, y, z) to (x, -z, y).
    np.testing.assert_allclose(mesh.bounds, [[0, -4, 0], [6, 2, 10]], atol=1e-6)
    mesh.merge_vertices()
    assert mesh.volume == pytest.approx(4 * 10 * 4 + 2 * 4 * 2), "a mirrored part is inside out"
    assert find_meshes([tmp_path]) == [mug], "a part of it is no object"


def test_usd_that_is_not_all_there_or_not_read_is_refused(mug: Path, tmp_path: Path) -> None:
    ours = write_object(tmp_path / "ours" / "cube.usd", procedural.cube())
    with pytest.raises(MeshError, match="vd-assets already"):
        load_mesh(ours)
    with pytest.raises(MeshError, match="no mesh in"):
        find_meshes([ours.parent])
    (tmp_path / "parts" / "part.usda").unlink()
    with pytest.raises(MeshError, match=r"incomplete.*part\.usda"):
        load_mesh(mug)
    stage = Usd.Stage.CreateNew(str(tmp_path / "many.usda"))
    for kind in (UsdGeom.PointInstancer, UsdGeom.Cube):
        name = kind.Define(stage, "/many").GetPrim().GetTypeName()
        stage.Save()
        with pytest.raises(MeshError, match=f"/many is a {name}.*make it a mesh"):
            load_mesh(tmp_path / "many.usda")


def test_a_part_that_changes_makes_another_object(mug: Path) -> None:
    from vd.assets_usd.objects.importer import content_hash

    job = Job(str(mug), "mug", "mug.usd", "", "", "")
    before = content_hash(job, ImportSettings())
    part = mug.parent / "parts" / "part.usda"
    part.write_text(part.read_text().replace("(1, 2, 1)", "(1, 3, 1)"))
    assert content_hash(job, ImportSettings()) != before
