"""Import of meshes: repair, scale, decomposition, refusals by name, and work that is not done twice."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from vd.assets_usd.objects import decompose as d
from vd.assets_usd.objects import importer
from vd.assets_usd.objects import meshes as m
from vd.assets_usd.objects.geometry import Hull, hull_depth, union_depth
from vd.assets_usd.objects.importer import import_meshes
from vd.assets_usd.objects.model import read_object
from vd.assets_usd.objects.plan import (
    ImportSettings,
    default_set,
    find_meshes,
    object_name,
)
from vd.paper import PAPER

FAST = d.DecomposeSettings(threshold=0.05, mcts_iterations=20, time_limit_s=60.0)


def l_shape() -> trimesh.Trimesh:
    """A closed, non-convex solid 0.12 m long: an L, extruded."""
    outline = [(0, 0), (0.12, 0), (0.12, 0.03), (0.03, 0.03), (0.03, 0.08), (0, 0.08)]
    low = np.array([(x, y, 0.0) for x, y in outline])
    vertices = np.concatenate([low, low + np.array([0.0, 0.0, 0.03])])
    caps = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    faces = [(a, c, b) for a, b, c in caps] + [(a + 6, b + 6, c + 6) for a, b, c in caps]
    for i in range(6):
        j = (i + 1) % 6
        faces += [(i, j, j + 6), (i, j + 6, i + 6)]
    return trimesh.Trimesh(vertices, faces, process=False)


L_VOLUME = (0.12 * 0.03 + 0.03 * 0.05) * 0.03


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory):
    """A folder with good and bad meshes, imported once: (folder, out, settings, results by name)."""
    root = tmp_path_factory.mktemp("import")
    folder = root / "meshes"
    (folder / "sub").mkdir(parents=True)
    l_shape().export(folder / "bracket.stl")
    box = trimesh.creation.box((120.0, 60.0, 40.0))
    box.export(folder / "brick in mm.ply")
    trimesh.creation.box((0.1, 0.05, 0.05)).export(folder / "sub" / "clamp.glb")
    (folder / "empty.obj").write_text("")
    (folder / "cloud.obj").write_text("".join(f"v {i} {i * i} 1\n" for i in range(9)))
    (folder / "nan.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv nan 0 1\nf 1 2 3\nf 1 2 4\n")
    (folder / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n")
    (folder / "junk.stl").write_bytes(b"this is no stereolithography file")
    notes = root / "notes.txt"
    notes.write_text("hello")
    with (folder / "objects.csv").open("w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(["name", "source", "split"])
        rows.writerow(["bracket", "our workshop (CC0-1.0)", "train"])
    settings = ImportSettings(FAST, licence="MIT", cache=str(root / "cache"))
    seen = []
    results = import_meshes(
        [folder, notes], root / "out", settings, jobs=2, progress=lambda r, i, n: seen.append((r.name, i, n))
    )
    assert [i for _, i, _ in seen] == list(range(1, len(results) + 1))
    return folder, root / "out", settings, {r.name: r for r in results}


REFUSALS = {
    "empty": "empty file",
    "cloud": "not a mesh: 9 points and no faces|empty: no faces",
    "nan": "1 of 4 vertices are NaN or infinite",
    "flat": "degenerate: flat",
    "junk": "neither mesh nor points|empty",
    "notes": r"unsupported type \.txt; use \.obj, \.stl, \.ply, \.glb, \.usd",
}


@pytest.mark.parametrize("name", sorted(REFUSALS))
def test_bad_meshes_are_refused_with_the_reason(imported, name: str):
    _, out, _, results = imported
    assert results[name].status == "refused"
    assert re.search(REFUSALS[name], results[name].reason), results[name].reason
    assert not (out / f"{name}.usd").exists()


def test_the_rest_still_imports(imported):
    _, out, _, results = imported
    good = {name for name, r in results.items() if r.status == "imported"}
    assert good == {"bracket", "clamp", "brick_in_mm"}
    assert {p.stem for p in out.glob("*.usd")} == good


def test_hulls_are_convex_contain_the_mesh_and_keep_its_volume(imported):
    model = read_object(imported[1] / "bracket.usd")
    assert 2 <= len(model.hulls) <= 8
    for hull in model.hulls:
        assert len(hull.vertices) <= 32
        assert hull_depth(hull, hull.vertices).max() < 1e-6
    assert union_depth(model.hulls, model.surface_points.astype(float)).max() < 1e-3
    assert model.volume_error < 0.05
    assert imported[3]["bracket"].decomposed


def test_mass_properties_are_those_of_the_solid(imported):
    model = read_object(imported[1] / "bracket.usd")
    mesh = l_shape()
    np.testing.assert_allclose(np.ptp(model.vertices, axis=0), [0.12, 0.08, 0.03], atol=1e-6)
    # The corner of the L lies at minus its centre of mass.
    arms = np.array([0.12 * 0.03, 0.03 * 0.05])
    centre = (arms @ np.array([[0.06, 0.015, 0.015], [0.015, 0.055, 0.015]])) / arms.sum()
    np.testing.assert_allclose(model.vertices.min(axis=0), -centre, atol=1e-6)
    mass = PAPER.materials.object_mass_kg
    np.testing.assert_allclose(
        model.inertia_matrix, mesh.moment_inertia * mass / mesh.volume, rtol=1e-5, atol=1e-10
    )
    assert mesh.volume == pytest.approx(L_VOLUME)
    assert model.mass_kg == pytest.approx(mass)


def test_millimetres_are_recognised(imported):
    model = read_object(imported[1] / "brick_in_mm.usd")
    np.testing.assert_allclose(np.ptp(model.vertices, axis=0), [0.12, 0.06, 0.04], atol=1e-6)
    assert model.scale == pytest.approx(1e-3)
    assert any("taken as mm" in note for note in model.notes)
    assert not imported[3]["brick_in_mm"].decomposed
    assert len(model.hulls) == 1 and len(model.hulls[0].vertices) == 8


def test_licence_and_source_come_from_the_sidecar(imported):
    bracket, brick = (read_object(imported[1] / f"{n}.usd") for n in ("bracket", "brick_in_mm"))
    assert (bracket.licence, bracket.split) == ("CC0-1.0", "train")
    assert bracket.source == "our workshop (CC0-1.0): bracket.stl"
    assert (brick.licence, brick.source, brick.family) == ("MIT", "brick in mm.ply", "imported")


def test_a_second_run_does_no_work(imported):
    folder, out, settings, first = imported
    before = {p: p.stat().st_mtime_ns for p in out.glob("*.usd")}
    again = {r.name: r for r in import_meshes([folder], out, settings, jobs=2)}
    assert {p: p.stat().st_mtime_ns for p in out.glob("*.usd")} == before
    for name in ("bracket", "clamp", "brick_in_mm"):
        assert again[name].status == "cached"
        assert again[name].hulls == first[name].hulls
        assert again[name].volume_error == pytest.approx(first[name].volume_error)


def test_a_finished_decomposition_is_reused_and_another_setting_is_not(imported, tmp_path: Path):
    folder, _, settings, first = imported
    mesh = folder / "bracket.stl"
    reused = import_meshes([mesh], tmp_path / "a", settings)[0]
    assert (reused.status, reused.decomposed) == ("imported", False)
    assert reused.volume_error == pytest.approx(first["bracket"].volume_error)
    finer = replace(settings, decompose=replace(FAST, seed=1))
    assert import_meshes([mesh], tmp_path / "a", finer)[0].decomposed


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_interrupted_import_leaves_no_part_and_no_process(ending: signal.Signals, tmp_path: Path):
    """However an import ends, its children and theirs end too; no half-written file stays."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    for i in range(4):
        mesh = trimesh.creation.torus(0.05, 0.02, major_sections=96, minor_sections=48)
        mesh.apply_scale(1.0 + 0.01 * i)
        mesh.export(folder / f"ring{i}.stl")
    command = [
        sys.executable,
        "-m",
        "vd.assets_usd.cli",
        "import",
        str(folder),
        "--out",
        str(tmp_path / "out"),
    ]
    environment = os.environ | {"VD_ASSETS": str(tmp_path / "assets")}
    child = subprocess.Popen(
        [*command, "--mcts-iterations", "500", "--threshold", "0.01"],
        env=environment, stderr=subprocess.PIPE, text=True,
        # A shell that runs tests in the background makes its children deaf to Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    deadline = time.monotonic() + 120
    while not (below := [p for w in _children(child.pid) for p in _children(w)]):
        assert time.monotonic() < deadline, "no decomposition has begun"
        time.sleep(0.1)
    processes = _children(child.pid) + below
    child.send_signal(ending)
    _, errors = child.communicate(timeout=120)
    if ending == signal.SIGKILL:
        assert child.returncode == -ending
    else:
        assert child.returncode == 128 + ending
        assert "goes on from there" in errors
    deadline = time.monotonic() + 20
    while left := [pid for pid in processes if _runs(pid)]:
        assert time.monotonic() < deadline, left
        time.sleep(0.1)
    assert not [p for p in (tmp_path / "out").iterdir() if p.suffix != ".usd" or p.name.startswith(".")]


def _children(parent: int) -> list[int]:
    """Child processes of a process."""
    tasks = Path(f"/proc/{parent}/task").glob("*/children")
    return [int(pid) for task in tasks for pid in task.read_text().split()]


def _runs(pid: int) -> bool:
    """Whether a process runs, and is not merely waiting for somebody to ask how it ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.parametrize(
    ("sides", "scaled", "note"),
    [
        ((0.12, 0.08, 0.05), (0.12, 0.08, 0.05), ""),
        ((0.095, 0.095, 0.095), (0.095, 0.095, 0.095), ""),
        ((0.03, 0.05, 0.04), (0.057, 0.095, 0.076), "scaled by 1.9"),
        ((0.08, 0.33, 0.06), (0.04, 0.165, 0.03), "scaled by 0.5"),
        ((120.0, 80.0, 50.0), (0.12, 0.08, 0.05), "taken as mm"),
        ((12.0, 8.0, 5.0), (0.12, 0.08, 0.05), "taken as cm"),
        ((250.0, 50.0, 50.0), (0.165, 0.033, 0.033), "taken as mm, scaled"),
        ((2.0, 1.0, 1.0), (0.095, 0.0475, 0.0475), "taken as cm, scaled"),
        ((0.16, 0.12, 0.04), (0.13, 0.0975, 0.0325), "scaled by 0.812"),  # too wide for the fingers
        ((0.12, 0.12, 0.12), (0.095, 0.095, 0.095), "scaled by 0.792"),  # which is as far as its length goes
        ((0.1, 0.03, 0.02), (0.125, 0.0375, 0.025), "scaled by 1.25"),  # too thin to be got hold of
        ((0.15, 0.03, 0.02), (0.165, 0.033, 0.022), "scaled by 1.1"),  # which is as far as its length goes
        ((0.12, 0.1, 0.02), (0.13, 0.13 / 1.2, 0.13 / 6.0), "scaled by 1.08"),  # or its width
    ],
)
def test_meshes_are_scaled_to_fit_the_hand(
    sides: tuple[float, ...], scaled: tuple[float, ...], note: str
) -> None:
    width = m.mean_width(trimesh.creation.box(sides).vertices)
    assert width == pytest.approx(sum(sides) / 2)
    factor, words = m.choose_scale(sides, width)
    assert np.asarray(sides) * factor == pytest.approx(scaled)
    assert words.startswith(note) and bool(words) == bool(note)


def test_the_mean_width_of_points_is_that_of_their_hull() -> None:
    points = np.random.default_rng(0).normal(size=(200, 3)) * (0.05, 0.03, 0.02)
    towards = np.random.default_rng(1).normal(size=(20000, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    expected = np.ptp(points @ towards.T, axis=0).mean()
    assert m.mean_width(points) == pytest.approx(expected, rel=0.01)


def test_repair_closes_and_turns_a_mesh():
    mesh = l_shape()
    mesh.invert()
    faces = np.concatenate([mesh.faces[:-1], mesh.faces[:1], [[0, 0, 1]]])
    repaired = m.repair_mesh(trimesh.Trimesh(mesh.vertices, faces, process=False))
    assert repaired.watertight
    assert m.solid_of(repaired)[0].volume == pytest.approx(L_VOLUME)
    assert any("filled holes" in n for n in repaired.notes)
    assert any("removed 2" in n for n in repaired.notes)


def test_convex_pieces_need_no_decomposition():
    pieces = [trimesh.creation.box((0.1, 0.03, 0.03)), trimesh.creation.box((0.03, 0.03, 0.1))]
    repaired = m.repair_mesh(trimesh.util.concatenate(pieces))
    assert len(repaired.pieces) == 2
    solid, method = m.solid_of(repaired)
    assert solid.volume == pytest.approx(0.03**2 * 0.17, rel=0.02)
    assert method == "union of the pieces by voxels"
    assert m.repair_mesh(l_shape()).pieces == ()


def test_open_mesh_is_tolerated_with_a_note():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.06)
    cut = mesh.triangles_center[:, 2] < 0.05
    repaired = m.repair_mesh(trimesh.Trimesh(mesh.vertices, mesh.faces[cut], process=False))
    assert not repaired.watertight
    assert any("not watertight" in n for n in repaired.notes)


def test_a_decomposition_that_hangs_or_dies_falls_back(monkeypatch: pytest.MonkeyPatch):
    mesh = l_shape()
    monkeypatch.setattr(d, "_coacd_child", lambda *_: time.sleep(60))
    result = d.decompose(mesh.vertices, mesh.faces, replace(FAST, time_limit_s=0.5))
    assert result.method == "one hull" and len(result.hulls) == 1
    assert "no result after 0.5 s" in result.notes[0]
    assert hull_depth(result.hulls[0], mesh.vertices).max() < 1e-9
    monkeypatch.setattr(d, "_coacd_child", lambda *_: os._exit(11))
    result = d.decompose(mesh.vertices, mesh.faces, FAST)
    assert "exit code 11" in result.notes[0]


def test_slivers_are_dropped():
    block = trimesh.creation.box((0.1, 0.05, 0.05)).vertices
    sheet = trimesh.creation.box((0.1, 0.05, 1e-5)).vertices
    crumb = trimesh.creation.box((0.002, 0.002, 0.002)).vertices
    line = np.linspace([0, 0, 0], [0.1, 0, 0], 5)
    hulls = d.tidy_hulls([block, sheet, crumb, line], 32)
    assert len(hulls) == 1
    assert isinstance(hulls[0], Hull)
    assert d.relative_volume_error(hulls, 0.1 * 0.05 * 0.05) == pytest.approx(0.0, abs=1e-9)


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Imports in this process: another one takes seconds to start."""
    monkeypatch.setattr(importer, "_run_child", lambda job, settings, *_: importer.import_mesh(job, settings))


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
    with pytest.raises(m.MeshError, match="no such file or folder"):
        find_meshes([tmp_path / "nowhere"])
    (tmp_path / "none").mkdir()
    with pytest.raises(m.MeshError, match="no mesh in"):
        find_meshes([tmp_path / "none"])
    (tmp_path / "none" / "mug.step").write_text("ISO-10303-21;\nHEADER;\n")
    with pytest.raises(m.MeshError, match=r"no mesh in(.|\n)*mug\.step is a STEP file"):
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
    ],
)
def test_an_object_is_called_by_what_says_something(path: str, name: str, tmp_path: Path):
    assert object_name(tmp_path / path) == name


def test_two_meshes_of_one_name_are_refused_whether_in_one_call_or_two(in_process: None, tmp_path: Path):
    first, second = brick(tmp_path / "a" / "mug.stl"), brick(tmp_path / "b" / "mug.stl", (0.1, 0.05, 0.05))
    out = tmp_path / "out"
    with pytest.raises(m.MeshError) as both:
        import_meshes([first, second], out)
    assert not out.exists()
    assert import_meshes([first], out)[0].name == "mug"
    before = (out / "mug.usd").read_bytes()
    with pytest.raises(m.MeshError) as later:
        import_meshes([second], out, force=True)
    assert (out / "mug.usd").read_bytes() == before
    for error in (both, later):
        assert all(word in str(error.value) for word in (str(first), str(second), "rename", "--out"))
    # The same file by another way, or a copy of it, is no other object.
    (tmp_path / "link").symlink_to(tmp_path / "a")
    assert import_meshes([tmp_path / "link" / "mug.stl"], out)[0].status == "cached"
    copy = tmp_path / "c" / "mug.stl"
    copy.parent.mkdir()
    copy.write_bytes(first.read_bytes())
    assert [r.status for r in import_meshes([first, copy], out)] == ["cached"]


def test_what_is_no_object_of_ours_is_never_written_over(tmp_path: Path):
    mesh = brick(tmp_path / "mug.stl")
    mine = tmp_path / "out" / "mug.usd"
    mine.parent.mkdir()
    mine.write_text("#usda 1.0\n")
    with pytest.raises(m.MeshError, match=r"mug\.usd is there and no object of vd-assets.*--out"):
        import_meshes([mesh], mine.parent, force=True)
    assert mine.read_text() == "#usda 1.0\n"


def test_objects_whose_mesh_is_gone_stay_until_they_are_dropped(in_process: None, tmp_path: Path):
    old, new, out = brick(tmp_path / "old.stl"), brick(tmp_path / "new.stl"), tmp_path / "out"
    import_meshes([old], out)
    old.unlink()
    result = {r.name: r.status for r in import_meshes([new], out)}
    assert result == {"new": "imported", "old": "gone"}
    assert (out / "old.usd").is_file()
    result = {r.name: r.status for r in import_meshes([new], out, drop_gone=True)}
    assert result == {"new": "cached", "old": "dropped"}
    assert not (out / "old.usd").exists()


def test_a_default_set_has_the_objects_of_one_folder(
    in_process: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("VD_ASSETS", str(tmp_path / "cache"))
    kits = [brick(tmp_path / place / "kit" / "meshes" / f"{place}.stl") for place in ("here", "there")]
    first, second = (kit.parent for kit in kits)
    out = default_set([first])
    assert out == default_set(kits[:1] * 2).parent / "kit" and default_set(kits[:1]).name == "here"
    import_meshes([first], out)
    assert default_set([first]) == out
    with pytest.raises(m.MeshError) as error:
        default_set([second])
    assert all(word in str(error.value) for word in (str(out), str(kits[0]), "--out"))
    for path in ("cube.stl", "procedural-7-seed3/meshes/a.stl"):
        reserved = brick(tmp_path / path)
        with pytest.raises(m.MeshError, match="built-in object set; say where with --out"):
            default_set([reserved if path == "cube.stl" else reserved.parent])


def test_nameless_files_of_a_download_cache_come_by_their_links(in_process: None, tmp_path: Path):
    blob = brick(tmp_path / "hub" / "blobs" / "mesh.ply").rename(tmp_path / "hub" / "blobs" / "0a1b2c")
    (blob.parent / "ffff").write_text("no mesh")
    link = tmp_path / "hub" / "snapshots" / "5d6e" / "Cup" / "model.ply"
    link.parent.mkdir(parents=True)
    link.symlink_to(blob)
    assert find_meshes([tmp_path / "hub"]) == [link]
    assert find_meshes([blob.parent]) == [blob]
    for path, name in ((link, "Cup"), (blob, "o_0a1b2c")):
        (result,) = import_meshes([path], tmp_path / "out")
        assert (result.status, result.name) == ("imported", name)


@pytest.mark.parametrize(
    ("sizing", "mass", "longest", "words"),
    [
        (m.Sizing("in"), 0.1, 0.1524, "taken as in"),
        (m.Sizing("mm", keep_size=True), 0.1, 0.006, "does not fit the hand at its real size of 0.006 m"),
        (m.Sizing("in", keep_size=True, density=1000.0), 36e3 * 0.0254**3, 0.1524, "mean width 0.140 m"),
        (m.Sizing("in", mass_kg=0.25), 0.25, 0.1524, "mass 0.25 kg as given"),
    ],
)
def test_unit_size_and_mass(
    sizing: m.Sizing, mass: float, longest: float, words: str, in_process: None, tmp_path: Path
):
    mesh = brick(tmp_path / "block.stl", (6.0, 2.0, 1.0) if "mean" not in words else (6.0, 3.0, 2.0))
    (result,) = import_meshes([mesh], tmp_path / "out", ImportSettings(sizing=sizing))
    model = read_object(tmp_path / "out" / "block.usd")
    assert model.longest_side == pytest.approx(longest, rel=1e-3)
    assert model.scale * 6.0 == pytest.approx(longest, rel=1e-3)
    assert (result.mass_kg, model.mass_kg) == pytest.approx((mass, mass), rel=1e-3)
    assert words in " ".join((*model.notes, *model.warnings))


@pytest.mark.parametrize(
    ("sizing", "words"),
    [
        (m.Sizing("mm", density=2.7), "--density 2.7.*water"),
        (m.Sizing("mm", density=1000.0, mass_kg=0.1), "--density and --mass"),
        (m.Sizing("mm", mass_kg=-1.0), "--mass -1"),
        (m.Sizing("foot"), "--units foot: choose"),
    ],
)
def test_sizes_that_cannot_be_meant_are_refused_before_anything_is_written(
    sizing: m.Sizing, words: str, tmp_path: Path
):
    with pytest.raises(m.MeshError, match=words):
        import_meshes([brick(tmp_path / "x.stl")], tmp_path / "out", ImportSettings(sizing=sizing))
    assert not (tmp_path / "out").exists()


def test_a_real_size_needs_a_unit_and_a_mass_a_material(tmp_path: Path):
    box = trimesh.creation.box((0.12, 0.06, 0.04)).vertices
    for declared in (None, 1.0):
        sizing = m.Sizing(keep_size=True)
        if declared is None:
            with pytest.raises(m.MeshError, match=r"no unit.*--units mm"):
                sizing.scale(box, declared)
        else:
            assert sizing.scale(box, declared)[0] == 1.0
    nut = 0.012 * 0.012 * 0.005
    assert "give --density or --mass" in m.Sizing().mass(nut)[2][0]
    with pytest.raises(m.MeshError, match="--mass is in kg"):
        m.Sizing(mass_kg=5.0).mass(nut)


def test_a_real_mesh(shared_dir: Path, tmp_path: Path):
    duck = shared_dir / "objects" / "test" / "duck.stl"
    if not duck.is_file():
        pytest.skip(f"no {duck}")
    result = import_meshes([duck], tmp_path, ImportSettings(d.DecomposeSettings(mcts_iterations=5)))[0]
    assert result.status == "imported", result.reason
    assert result.volume_error < 0.15
    model = read_object(Path(result.target))
    assert model.licence.startswith("Apache-2.0") and model.split == "test"
    assert model.longest_side == pytest.approx(0.096, abs=1e-3)
    assert Path(result.target).stat().st_size < 60_000
    assert json.dumps(result.notes)
