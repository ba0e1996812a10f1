"""The object file: round trip, what other USD readers see, and errors that say what to do."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from vd.assets_usd.objects import procedural, sets
from vd.assets_usd.objects.geometry import Hull
from vd.assets_usd.objects.model import ObjectError, read_object, write_object
from vd.assets_usd.objects.sets import load_set
from vd.paper import PAPER


@pytest.fixture(scope="module")
def example() -> procedural.ObjectModel:
    return replace(
        procedural.procedural_set(2, 3)[1],
        symmetry=procedural.cuboid().symmetry,
        licence="CC0-1.0",
        notes=("one", "two"),
        warnings=("three", "four"),
        file="/home/me/x.stl",
        volume_error=0.125,
    )


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("VD_ASSETS", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.mark.parametrize("suffix", [".usd", ".usda", ".usdc"])
def test_round_trip(tmp_path: Path, example: procedural.ObjectModel, suffix: str):
    path = write_object(tmp_path / f"x{suffix}", example)
    back = read_object(path)
    for item in fields(example):
        mine, theirs = getattr(example, item.name), getattr(back, item.name)
        if item.name == "hulls":
            assert len(mine) == len(theirs)
            for a, b in zip(mine, theirs, strict=True):
                assert isinstance(b, Hull)
                np.testing.assert_array_equal(a.vertices, b.vertices)
                np.testing.assert_array_equal(a.faces, b.faces)
        elif isinstance(mine, np.ndarray):
            # Masses and quaternions are single precision in UsdPhysics.
            np.testing.assert_allclose(mine, theirs, rtol=1e-6, atol=1e-7, err_msg=item.name)
        elif isinstance(mine, float):
            assert mine == pytest.approx(theirs, rel=1e-6), item.name
        else:
            assert mine == theirs, item.name


def test_usd_physics_says_what_the_model_says(tmp_path: Path, example: procedural.ObjectModel):
    from pxr import Usd, UsdGeom, UsdPhysics

    stage = Usd.Stage.Open(str(write_object(tmp_path / "x.usda", example)))
    root = stage.GetDefaultPrim()
    assert root.GetName() == example.name
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert root.HasAPI(UsdPhysics.RigidBodyAPI)
    mass = UsdPhysics.MassAPI(root)
    assert mass.GetMassAttr().Get() == pytest.approx(PAPER.materials.object_mass_kg)
    assert tuple(mass.GetCenterOfMassAttr().Get()) == (0.0, 0.0, 0.0)
    colliders = [p for p in stage.Traverse() if p.HasAPI(UsdPhysics.CollisionAPI)]
    assert len(colliders) == len(example.hulls)
    for prim in colliders:
        assert UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get() == "convexHull"
    visual = stage.GetPrimAtPath(root.GetPath().AppendChild("visual"))
    assert not visual.HasAPI(UsdPhysics.CollisionAPI)


def test_rewritten_file_is_read_anew(tmp_path: Path, example: procedural.ObjectModel):
    path = write_object(tmp_path / "x.usd", example)
    read_object(path)
    write_object(path, replace(example, licence="other"))
    assert read_object(path).licence == "other"


def test_bad_files_are_named(tmp_path: Path):
    with pytest.raises(ObjectError, match=r"gone\.usd: no"):
        read_object(tmp_path / "gone.usd")
    junk = tmp_path / "junk.usd"
    junk.write_text("not a stage")
    with pytest.raises(ObjectError, match=r"junk\.usd: .*remove"):
        read_object(junk)
    foreign = tmp_path / "foreign.usda"
    foreign.write_text('#usda 1.0\n(defaultPrim = "a")\ndef Xform "a" {}\n')
    with pytest.raises(
        ObjectError, match=r"foreign\.usda: formatVersion is None.*vd-assets import"
    ):
        read_object(foreign)


def test_load_set_takes_files_folders_and_names(
    tmp_path: Path, cache: Path, example: procedural.ObjectModel
):
    folder = tmp_path / "mine"
    sets.write_set(folder, [example])
    models = load_set([folder, "cube"])
    assert [m.name for m in models] == [example.name, "cube"]
    assert (sets.built_in_folder("cube") / "cube.usd").is_file()
    assert [m.name for m in load_set("symmetric")] == ["cube", "cuboid"]
    assert len(load_set("procedural-2-seed5")) == 2
    assert load_set(folder / f"{example.name}.usd")[0].name == example.name
    sets.write_set(cache / "objects" / "shelf", [example])
    assert load_set("shelf")[0].name == example.name


@pytest.mark.parametrize("name", ["cube", "cuboid", "symmetric", "procedural-2-seed5"])
def test_a_users_folder_with_the_name_of_a_built_in_set_is_left_alone(
    name: str, cache: Path, example: procedural.ObjectModel, monkeypatch: pytest.MonkeyPatch
):
    mine = cache / "objects" / name / "cube.usd"
    write_object(mine, replace(example, name="cube", source="cube.stl", file="/home/me/cube.stl"))
    (mine.parent / "notes.txt").write_text("mine")
    before = mine.read_bytes()
    monkeypatch.chdir(mine.parent.parent)  # nor is it the set where a command is started beside it
    assert all(not model.file for model in load_set(name))
    assert load_set(f"./{name}")[0].file == "/home/me/cube.stl"
    assert mine.read_bytes() == before and (mine.parent / "notes.txt").read_text() == "mine"


def test_a_folder_of_meshes_does_not_hide_the_set_of_its_name(
    tmp_path: Path, cache: Path, example: procedural.ObjectModel, monkeypatch: pytest.MonkeyPatch
):
    sets.write_set(cache / "objects" / "meshes", [example])
    monkeypatch.chdir(tmp_path)
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "a.stl").touch()
    sets.check_sets(["meshes"])
    assert [model.name for model in load_set("meshes")] == [example.name]


def test_unknown_set_says_what_there_is(
    tmp_path: Path, cache: Path, example: procedural.ObjectModel
):
    sets.write_set(cache / "objects" / "shelf", [example])
    with pytest.raises(ObjectError) as error:
        load_set("shelves")
    for word in (
        "'shelves'",
        "shelf",
        "cube",
        "procedural-heldout",
        "vd-assets import",
        "procedural-heldout-30-seed0",
    ):
        assert word in str(error.value)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ObjectError, match=r"empty: no "):
        load_set(tmp_path / "empty")
    with pytest.raises(ObjectError, match=r"empty: no "):
        sets.check_sets([tmp_path / "empty"])
    names = [item.name for item in load_set(["cube", "symmetric"])]
    assert names[0] == "cube" and "cube-symmetric" in names and len(set(names)) == len(names)
    for folder in ("one/cube", "two/cube"):
        sets.write_set(tmp_path / folder, load_set("cube"))
    with pytest.raises(ObjectError, match="cube-cube"):
        load_set(["cube", tmp_path / "one/cube", tmp_path / "two/cube"])
    with pytest.raises(ObjectError, match="no object set"):
        load_set([])
