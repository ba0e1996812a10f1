"""What an import finds, what it calls objects and where it writes them.

Their unit, size and mass.
"""

from pathlib import Path

import pytest
import trimesh

from vd.assets_usd.hands import hand_usd
from vd.assets_usd.objects import importer
from vd.assets_usd.objects import meshes as m
from vd.assets_usd.objects.importer import import_meshes
from vd.assets_usd.objects.model import ObjectError, read_object
from vd.assets_usd.objects.plan import default_set, find_meshes, object_name
from vd.assets_usd.objects.sets import load_set
from vd.assets_usd.objects.settings import ImportSettings


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Imports in this process: another one takes seconds to start."""

    def run_tasks(work, tasks, finished, **_):
        for task in tasks:
            finished(task, work(task), "")

    monkeypatch.setattr(importer, "run_tasks", run_tasks)


def brick(path: Path, sides: tuple[float, float, float] = (0.12, 0.06, 0.04)) -> Path:
    """Write a box, of which an import makes one convex part at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(sides).export(path)
    return path


def test_meshes_are_found_once_and_in_order(tmp_path: Path):
    for name in ("b/a.obj", "a/a.STL", "a/A.ply", "a/.hidden/x.obj", "a/._A.ply"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("x")
    found = find_meshes([tmp_path / "b", tmp_path, tmp_path / "a" / "a.STL"])
    assert [p.name for p in found] == ["a.obj", "A.ply", "a.STL"]
    with pytest.raises(m.MeshError, match="no such file"):
        find_meshes([tmp_path / "nowhere"])
    (tmp_path / "none").mkdir()
    with pytest.raises(m.MeshError, match="no mesh in"):
        find_meshes([tmp_path / "none"])


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("3d-print (final).stl", "o_3d_print_final"),
        ("mugs/mug_2.obj", "mug_2"),
        ("ycb/003_cracker_box/google_16k/textured.obj", "o_003_cracker_box"),
        ("gso/Ace_Mug/meshes/model.obj", "Ace_Mug"),
        ("shapenet/02691156/1015e71a/models/model_normalized.obj", "o_1015e71a"),
        ("duck/Mesh.STL", "duck"),
        ("bop/models/obj_000001.ply", "obj_000001"),
        ("things/杯子.stl", "u676fu5b50"),
        ("things/碗 2.stl", "u7897_2"),
        ("things/Café.stl", "Cafe"),
    ],
)
def test_an_object_is_called_by_what_says_something(path: str, name: str, tmp_path: Path):
    assert object_name(tmp_path / path) == name


def test_a_mesh_that_cannot_even_be_read_stops_no_other(
    in_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    read = importer.content_hash

    def content_hash(job, settings):
        if job.name == "huge":
            raise MemoryError("40 GiB")
        return read(job, settings)

    monkeypatch.setattr(importer, "content_hash", content_hash)
    meshes = [brick(tmp_path / f"{name}.stl") for name in ("huge", "mug")]
    huge, mug = import_meshes(meshes, tmp_path / "out")
    assert (huge.status, mug.status) == ("refused", "imported")
    assert huge.reason == (
        "MemoryError: 40 GiB; export it again with fewer faces, or import it alone (--jobs 1)"
    )


def test_what_fails_in_its_process_is_refused_with_a_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def run_tasks(work, tasks, finished, **_):
        for task in tasks:
            finished(task, None, "its process died: out of memory, or killed")

    monkeypatch.setattr(importer, "run_tasks", run_tasks)
    (result,) = import_meshes([brick(tmp_path / "mug.stl")], tmp_path / "out")
    assert result.status == "refused"
    assert "out of memory" in result.reason


@pytest.mark.parametrize("place", ["cube", "cache/objects/cuboid", "procedural-7-seed3"])
def test_no_set_gets_the_name_of_a_built_in_one(place: str, tmp_path: Path):
    mesh = brick(tmp_path / "mug.stl")
    out = tmp_path / place
    with pytest.raises(ObjectError, match=f"built-in object set.*--out {tmp_path}.*/my-{out.name}"):
        import_meshes([mesh], out)
    assert not out.exists()


def test_a_name_that_means_a_folder_here_and_a_set_is_refused(
    in_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("VD_ASSETS", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    there = tmp_path / "cache" / "objects" / "things"
    import_meshes([brick(tmp_path / "here.stl")], tmp_path / "things")
    import_meshes([brick(tmp_path / "there.stl")], there)
    with pytest.raises(ObjectError, match=rf"write \./things, or {there}"):
        load_set("things")
    assert [item.name for item in load_set("./things")] == ["here"]
    assert [item.name for item in load_set(str(there))] == ["there"]


def test_objects_fit_the_hand_that_is_named(in_process: None, tmp_path: Path):
    text = hand_usd("dclaw3").read_text().replace("(0.095, 0.165)", "(0.055, 0.09)")
    hand = tmp_path / "small.usda"
    hand.write_text(text)
    meshes = [
        brick(tmp_path / "long.stl", (0.12, 0.03, 0.03)),
        brick(tmp_path / "wide.stl", (0.12, 0.1, 0.04)),
    ]
    settings = ImportSettings(units="m", hand=str(hand))
    long, wide = (result.model for result in import_meshes(meshes, tmp_path / "out", settings))
    assert long.longest_side == pytest.approx(0.09, rel=1e-3)
    # Of a D'Claw 0.13 m at 0.165 m.
    assert m.mean_width(wide.vertices) == pytest.approx(0.13 * 0.09 / 0.165, rel=1e-3)
    with pytest.raises(ValueError, match="'claw'"):
        import_meshes(meshes, tmp_path / "other", ImportSettings(hand="claw"))


def test_two_meshes_of_one_name_are_refused_whether_in_one_call_or_two(
    in_process: None, tmp_path: Path
):
    first, second = (
        brick(tmp_path / "a" / "mug.stl"),
        brick(tmp_path / "b" / "mug.stl", (0.1, 0.05, 0.05)),
    )
    out = tmp_path / "out"
    with pytest.raises(m.MeshError) as both:
        import_meshes([first, second], out)
    assert not out.exists()
    assert import_meshes([first], out)[0].job.name == "mug"
    before = (out / "mug.usd").read_bytes()
    with pytest.raises(m.MeshError) as later:
        import_meshes([second], out)
    assert (out / "mug.usd").read_bytes() == before
    for error in (both, later):
        assert all(
            word in str(error.value) for word in (str(first), str(second), "rename", "--out")
        )
    # The same file by another way is no other object.
    (tmp_path / "link").symlink_to(tmp_path / "a")
    assert import_meshes([tmp_path / "link" / "mug.stl"], out)[0].status == "cached"


@pytest.mark.parametrize("text", ["#usda 1.0\n", "", "PXR-USDC cut short"])
def test_what_is_no_object_of_ours_is_never_written_over(text: str, tmp_path: Path):
    mesh = brick(tmp_path / "mug.stl")
    mine = tmp_path / "out" / "mug.usd"
    mine.parent.mkdir()
    mine.write_text(text)
    with pytest.raises(m.MeshError, match=r"mug\.usd .*remove it.*--out"):
        import_meshes([mesh], mine.parent)
    assert mine.read_text() == text


def test_a_default_set_has_the_objects_of_one_folder(
    in_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("VD_ASSETS", str(tmp_path / "cache"))
    kits = [
        brick(tmp_path / place / "kit" / "meshes" / f"{place}.stl") for place in ("here", "there")
    ]
    first, second = (kit.parent for kit in kits)
    out = default_set([first])
    assert (
        out == default_set(kits[:1] * 2).parent / "meshes" and default_set(kits[:1]).name == "here"
    )
    import_meshes([first], out)
    assert default_set([first]) == out
    with pytest.raises(m.MeshError) as error:
        default_set([second])
    assert all(word in str(error.value) for word in (str(out), str(kits[0]), "--out"))
    for path in ("cube.stl", "procedural-7-seed3/a.stl"):
        reserved = brick(tmp_path / path)
        with pytest.raises(ObjectError, match=r"built-in .*--out"):
            default_set([reserved if path == "cube.stl" else reserved.parent])


@pytest.mark.parametrize(
    ("settings", "mass", "longest", "words"),
    [
        (ImportSettings("in"), 0.1, 0.1524, "taken as in"),
        (
            ImportSettings("mm", keep_size=True),
            0.1,
            0.006,
            "does not fit the hand at its real size of 0.006 m",
        ),
        (ImportSettings("in", keep_size=True, density=1000.0), 0.59, 0.1524, "mean width 0.140 m"),
        (ImportSettings("in", mass=0.25), 0.25, 0.1524, "mass 0.25 kg as given"),
    ],
)
def test_unit_size_and_mass(
    settings: ImportSettings,
    mass: float,
    longest: float,
    words: str,
    in_process: None,
    tmp_path: Path,
):
    mesh = brick(
        tmp_path / "block.stl", (6.0, 2.0, 1.0) if "mean" not in words else (6.0, 3.0, 2.0)
    )
    (result,) = import_meshes([mesh], tmp_path / "out", settings)
    model = read_object(tmp_path / "out" / "block.usd")
    assert model.longest_side == pytest.approx(longest, rel=1e-3)
    assert model.scale * 6.0 == pytest.approx(longest, rel=1e-3)
    assert (result.model.mass_kg, model.mass_kg) == pytest.approx((mass, mass), rel=1e-3)
    assert words in " ".join((*model.notes, *model.warnings))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (ImportSettings("mm", density=2.7), "--density 2.7.*water"),
        (ImportSettings("mm", density=1000.0, mass=0.1), "--density and --mass"),
        (ImportSettings("mm", mass=-1.0), "--mass is -1"),
        (ImportSettings(max_hulls=0), "--max-hulls is 0; it has to be positive"),
        (ImportSettings(threshold=5.0), "--threshold 5: give 0.01 to 1"),
    ],
)
def test_what_cannot_be_meant_is_refused_before_anything_is_written(
    settings: ImportSettings, words: str, tmp_path: Path
):
    with pytest.raises(ValueError, match=words):
        import_meshes([brick(tmp_path / "x.stl")], tmp_path / "out", settings)
    assert not (tmp_path / "out").exists()


def test_a_real_size_needs_a_unit_and_a_mass_a_material(in_process: None, tmp_path: Path):
    settings = ImportSettings(keep_size=True)
    (refused,) = import_meshes([brick(tmp_path / "x.stl")], tmp_path / "out", settings)
    assert refused.status == "refused" and "--units mm" in refused.reason
    (kept,) = import_meshes([brick(tmp_path / "x.glb")], tmp_path / "out", settings)
    assert kept.model.scale == 1.0
    nut = 0.012 * 0.012 * 0.005
    assert "--density or --mass" in m.mass_of(ImportSettings(), nut)[2][0]
    with pytest.raises(m.MeshError, match="--mass is in kg"):
        m.mass_of(ImportSettings(mass=5.0), nut)
