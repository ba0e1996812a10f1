"""Import of meshes: repair, scale, decomposition, refusals by name, and work that is not done twice."""

import csv
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
from vd.assets_usd.objects.bodies import body_of, error_of_parts
from vd.assets_usd.objects.geometry import Hull, hull_depth, union_depth
from vd.assets_usd.objects.importer import import_mesh, import_meshes
from vd.assets_usd.objects.model import read_object
from vd.assets_usd.objects.plan import plan_jobs
from vd.assets_usd.objects.repair import repair_mesh
from vd.assets_usd.objects.settings import ImportSettings
from vd.evaluate.symmetry import symmetries
from vd.paper import PAPER

FAST = ImportSettings(threshold=0.05, mcts_iterations=20, time_limit=60.0)


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
    """A folder with good and bad meshes, imported once.

    (folder, out, settings, results by name).
    """
    root = tmp_path_factory.mktemp("import")
    folder = root / "meshes"
    (folder / "sub").mkdir(parents=True)
    l_shape().export(folder / "bracket.stl")
    box = trimesh.creation.box((120.0, 60.0, 40.0))
    box.export(folder / "brick in mm.ply")
    trimesh.creation.box((0.1, 0.05, 0.05)).export(folder / "sub" / "clamp.glb")
    trimesh.creation.annulus(0.05, 0.058, 0.02, sections=16).export(folder / "ring.stl")
    (folder / "cloud.obj").write_text("".join(f"v {i} {i * i} 1\n" for i in range(9)))
    (folder / "nan.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv nan 0 1\nf 1 2 3\nf 1 2 4\n")
    (folder / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n")
    trimesh.creation.box((100.0, 0.15, 0.15)).export(folder / "needle.stl")
    notes = root / "notes.txt"
    notes.write_text("hello")
    with (folder / "objects.csv").open("w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(["name", "source", "split"])
        rows.writerow(["bracket", "our workshop (CC0-1.0)", "train"])
    settings = replace(FAST, licence="MIT")
    seen = []
    told = {"progress": lambda r, i, n: seen.append((r.job.name, i, n))}
    results = import_meshes([folder, notes], root / "out", settings, jobs=2, **told)
    assert [i for _, i, _ in seen] == list(range(1, len(results) + 1))
    return folder, root / "out", settings, {r.job.name: r for r in results}


REFUSALS = {
    "cloud": "not a mesh, or cut short: 9 points and no faces",
    "nan": "1 of 4 vertices are NaN or infinite",
    "flat": "degenerate: flat",
    "needle": "degenerate: flat.*give it thickness",
    "notes": r"unsupported type \.txt; use \.obj, \.stl, \.ply, \.glb, \.usd",
}


@pytest.mark.parametrize("name", sorted(REFUSALS))
def test_bad_meshes_are_refused_with_the_reason(imported, name: str):
    _, out, _, results = imported
    assert results[name].status == "refused"
    assert re.search(REFUSALS[name], results[name].reason), results[name].reason
    assert not (out / f"{name}.usd").exists()


def test_hulls_are_convex_contain_the_mesh_and_keep_its_volume(imported):
    model = read_object(imported[1] / "bracket.usd")
    assert 2 <= len(model.hulls) <= 8
    for hull in model.hulls:
        assert len(hull.vertices) <= 32
        assert hull_depth(hull, hull.vertices).max() < 1e-6
    assert union_depth(model.hulls, model.surface_points.astype(float)).max() < 1e-3
    assert model.volume_error < 0.05


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


def test_licence_and_source_come_from_the_sidecar(imported):
    bracket, brick = (read_object(imported[1] / f"{n}.usd") for n in ("bracket", "brick_in_mm"))
    assert (bracket.licence, bracket.split) == ("CC0-1.0", "train")
    assert bracket.source == "our workshop (CC0-1.0): bracket.stl"
    assert (brick.licence, brick.source, brick.family) == ("MIT", "brick in mm.ply", "imported")


def test_a_second_run_does_no_work(imported):
    folder, out, settings, first = imported
    before = {p: p.stat().st_mtime_ns for p in out.glob("*.usd")}
    again = {r.job.name: r for r in import_meshes([folder], out, settings, jobs=2)}
    assert {p: p.stat().st_mtime_ns for p in out.glob("*.usd")} == before
    for name in ("bracket", "clamp", "brick_in_mm"):
        assert again[name].status == "cached"
        assert len(again[name].model.hulls) == len(first[name].model.hulls)
    # Settings that make another object do.
    (finer,) = import_meshes([folder / "sub"], out, replace(settings, mass=0.2))
    assert (finer.status, finer.model.mass_kg) == ("imported", 0.2)


@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGKILL])
def test_interrupted_import_leaves_no_part_and_no_process(ending: signal.Signals, tmp_path: Path):
    """However an import ends, its children and theirs end too; no half-written file stays."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    for i in range(4):
        mesh = trimesh.creation.torus(0.05, 0.02, major_sections=96, minor_sections=48)
        mesh.apply_scale(1.0 + 0.01 * i)
        mesh.export(folder / f"ring{i}.stl")
    flags = ["--out", str(tmp_path / "out"), "--mcts-iterations", "500", "--threshold", "0.01"]
    child = subprocess.Popen(
        [sys.executable, "-m", "vd.assets_usd.cli", "import", str(folder), *flags],
        env=os.environ | {"VD_ASSETS": str(tmp_path / "assets")},
        stderr=subprocess.PIPE,
        text=True,
    )
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
        assert "goes on from" in errors
    deadline = time.monotonic() + 120
    while left := [pid for pid in processes if _runs(pid)]:
        assert time.monotonic() < deadline, left
        time.sleep(0.1)
    assert not [
        p for p in (tmp_path / "out").iterdir() if p.suffix != ".usd" or p.name.startswith(".")
    ]


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
        ((2.0, 1.0, 1.0), (0.095, 0.0475, 0.0475), "taken as cm, scaled"),
        ((0.16, 0.12, 0.04), (0.13, 0.0975, 0.0325), "scaled by 0.812"),  # too wide for the fingers
        # That is as far as its length goes.
        (
            (0.12, 0.12, 0.12),
            (0.095, 0.095, 0.095),
            "scaled by 0.792",
        ),
        ((0.1, 0.03, 0.02), (0.125, 0.0375, 0.025), "scaled by 1.25"),  # too thin to be got hold of
        # Which is as far as its length goes.
        (
            (0.15, 0.03, 0.02),
            (0.165, 0.033, 0.022),
            "scaled by 1.1",
        ),
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


def test_repair_closes_and_turns_a_mesh():
    mesh = l_shape()
    mesh.invert()
    faces = np.concatenate([mesh.faces[:-1], mesh.faces[:1], [[0, 0, 1]]])
    repaired = repair_mesh(trimesh.Trimesh(mesh.vertices, faces, process=False))
    assert repaired.watertight
    assert body_of(repaired).solid.volume == pytest.approx(L_VOLUME)
    assert any("filled 1 hole" in n for n in repaired.notes)
    assert any("removed 2" in n for n in repaired.notes)


def dome(height: float) -> trimesh.Trimesh:
    """A sphere of radius 0.06 without what is above a height, open there."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.06)
    return trimesh.Trimesh(
        mesh.vertices, mesh.faces[mesh.triangles_center[:, 2] < height], process=False
    )


def test_a_small_hole_is_filled_and_a_large_opening_is_said():
    small, large = (repair_mesh(dome(height)) for height in (0.055, 0.0))
    assert small.watertight and small.notes[0] == "filled 1 hole"
    whole = 4.0 / 3.0 * np.pi * 0.06**3
    assert body_of(small).solid.volume == pytest.approx(whole, rel=0.02)
    assert body_of(small).warnings == ()
    assert not large.closed
    sheet = body_of(large)
    assert "open: the surface" in sheet.warnings[0]
    # Not half a ball but its shell: of the thickness that is said, and with the inertia of that.
    said = float(sheet.warnings[0].partition("a sheet ")[2].partition(" mm")[0])
    assert 0.5 < said < 1e3 * 0.12 / 96
    assert sheet.solid.volume == pytest.approx(2 * np.pi * 0.06**2 * said * 1e-3, rel=0.1)
    about_axis = sheet.solid.inertia[2, 2] / sheet.solid.volume
    assert about_axis == pytest.approx(2.0 / 3.0 * 0.06**2, rel=0.05)


def test_debris_does_not_set_the_scale(tmp_path: Path):
    speck = trimesh.Trimesh(
        [[2.0, 0, 0], [2.001, 0, 0], [2.0, 0.001, 0]], [[0, 1, 2]], process=False
    )
    crumb = trimesh.creation.box((0.008, 0.008, 0.008)).apply_translation([0.0, 2.0, 0.0])
    for debris in (speck, crumb):
        repaired = repair_mesh(trimesh.util.concatenate([l_shape(), debris]))
        assert np.ptp(repaired.surface.vertices, axis=0) == pytest.approx([0.12, 0.08, 0.03])
        assert body_of(repaired).solid.volume == pytest.approx(L_VOLUME)
        assert len(repaired.warnings) == 1
    # Inside of the object's box it changes nothing that matters.
    inside = trimesh.Trimesh(speck.vertices - [1.98, -0.01, -0.01], speck.faces, process=False)
    assert repair_mesh(trimesh.util.concatenate([l_shape(), inside])).warnings == ()


def test_two_bodies_are_refused():
    apart = l_shape().apply_translation([0.0, 0.0, 0.1])
    with pytest.raises(m.MeshError, match=r"2 bodies apart.*50 %.*each alone"):
        repair_mesh(trimesh.util.concatenate([l_shape(), apart]))


def test_surfaces_that_touch_along_an_edge_are_closed():
    first = trimesh.creation.box((0.05, 0.05, 0.05))
    second = first.copy().apply_translation([0.05, 0.05, 0.0])
    repaired = repair_mesh(trimesh.util.concatenate([first, second]))
    assert len(repaired.pieces) == 2
    assert body_of(repaired).solid.volume == pytest.approx(2 * 0.05**3, rel=0.02)


@pytest.mark.parametrize(("inward", "hollow"), [(True, True), (False, False)])
def test_a_cavity_counts_in_mass_properties_and_is_said(tmp_path: Path, inward: bool, hollow: bool):
    outer, inner = trimesh.creation.box((0.12, 0.1, 0.1)), trimesh.creation.box((0.1, 0.08, 0.08))
    inner.apply_translation([0.005, 0.0, 0.0])
    if inward:
        inner.invert()
    trimesh.util.concatenate([outer, inner]).export(tmp_path / "box.stl")
    result = import_meshes([tmp_path / "box.stl"], tmp_path / "out", FAST)[0]
    model = read_object(Path(result.job.target))
    assert result.status == "imported" and model.warnings == result.model.warnings
    (warning,) = model.warnings
    assert ("closed cavity of 53 %" if hollow else "taken as solid") in warning
    full, empty = 0.12 * 0.1 * 0.1, 0.1 * 0.08 * 0.08
    assert model.volume_error == pytest.approx(empty / (full - empty) if hollow else 0.0, abs=1e-6)
    # About x, through the centre of both boxes: of the full box and of the one that is missing.
    missing = empty if hollow else 0.0
    about_x = (
        (full * (0.1**2 + 0.1**2) - missing * (0.08**2 + 0.08**2)) / 12.0 * 0.1 / (full - missing)
    )
    scale = model.longest_side / 0.12
    assert model.inertia_matrix[0, 0] == pytest.approx(about_x * scale**2, rel=1e-5)


def test_the_error_of_parts_counts_what_they_lack_and_what_they_have_too_much():
    cube = trimesh.creation.box((0.1, 0.1, 0.1))
    error_of = error_of_parts(body_of(repair_mesh(cube)), cube.vertices)
    moved = Hull(cube.vertices + np.array([0.005, 0.0, 0.0]), cube.faces)
    assert error_of([moved]) == pytest.approx(0.1, rel=0.02)
    # As large as the cube, but no cube: what is outside at each end is missing at the sides.
    longer = Hull(cube.vertices * [1.1, 1.0, 1.0 / 1.1], cube.faces)
    assert error_of([longer]) == pytest.approx(2.0 * (1.0 - 1.0 / 1.1), rel=0.02)
    assert error_of([Hull(cube.vertices, cube.faces)]) < 1e-3


def test_a_ring_gets_more_parts_and_a_bracket_does_not(imported):
    ring, bracket = (read_object(imported[1] / f"{name}.usd") for name in ("ring", "bracket"))
    assert ring.volume_error <= d.GOOD_ERROR and ring.warnings == ()
    assert 8 < len(ring.hulls) <= 16 and len(bracket.hulls) <= 8


def test_a_mesh_of_many_faces_is_simplified_and_its_error_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.06)
    ball.export(tmp_path / "ball.ply")
    (job,) = plan_jobs([tmp_path / "ball.ply"], tmp_path, "MIT")
    monkeypatch.setattr(importer, "MAX_FACES", 20_000)
    result = import_mesh(job, FAST)
    model = result.model
    assert result.status == "imported", result.reason
    note = next(note for note in model.notes if "simplified from 81920 to" in note)
    said = float(note.partition("up to ")[2].partition(" %")[0])
    assert 0.0 < said < 0.5
    assert "exact mesh volume" in model.volume_method
    off = np.abs(np.linalg.norm(model.surface_points, axis=1) / model.scale - 0.06)
    assert off.max() < 1.5e-2 * said * 0.12


IMPORT_AND_MEASURE = """
import resource, subprocess, sys
subprocess.run([sys.executable, "-m", "vd.assets_usd.cli", "import", *sys.argv[1:]], check=True)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_maxrss)
"""
"""Prints the largest resident memory of an import [kB].

A process of its own, since what it starts would begin with the memory of the tests.
"""


@pytest.mark.slow
def test_a_scan_takes_no_more_memory_than_two_million_faces_may(tmp_path: Path):
    """They may take 2 GB; a sixth of their faces takes half of that."""
    scan = trimesh.creation.icosphere(subdivisions=7, radius=0.06)
    scan.vertices[:, :2] *= 0.8 + 0.3 * np.cos(70.0 * scan.vertices[:, 2:])
    scan.export(tmp_path / "vase.stl")
    command = [sys.executable, "-c", IMPORT_AND_MEASURE, str(tmp_path / "vase.stl")]
    run = subprocess.run(
        [*command, "--out", str(tmp_path / "out"), "--jobs", "1"],
        capture_output=True,
        text=True,
        check=True,
    )
    memory_kb = float(run.stdout.split()[-1])
    assert len(scan.faces) == 327_680
    assert memory_kb < 1e6
    assert read_object(tmp_path / "out" / "vase.usd").warnings == ()


def with_antenna(closed: bool = True) -> trimesh.Trimesh:
    """A box of three different sides, and off its middle a rod 2 mm thick and 30 mm long."""
    body = trimesh.creation.box((0.12, 0.06, 0.03))
    rod = trimesh.creation.cylinder(0.001, 0.03, sections=12)
    if not closed:
        rod.update_faces(np.abs(rod.face_normals[:, 2]) < 0.5)
    rod.apply_translation([0.05, 0.02, 0.0299])
    return trimesh.util.concatenate([body, rod])


@pytest.mark.parametrize("closed", [True, False])
def test_a_thin_part_that_touches_is_of_the_object(closed: bool, tmp_path: Path):
    mesh = with_antenna(closed)
    mesh.export(tmp_path / "radio.stl")
    (job,) = plan_jobs([tmp_path / "radio.stl"], tmp_path, "MIT")
    model = import_mesh(job, replace(FAST, units="m", keep_size=True)).model
    np.testing.assert_allclose(np.ptp(model.vertices, axis=0), [0.12, 0.06, 0.0599], atol=1e-4)
    (warning,) = model.warnings
    assert "30 mm long" in warning
    # A box alone is the same after half a turn about each axis.
    assert len(symmetries([model], "cpu")[0]) == 1


def test_what_is_left_out_and_long_is_a_warning():
    body = trimesh.creation.box((0.12, 0.06, 0.05))
    scrap = trimesh.Trimesh(
        [[0.0, 0.0, 0.03], [0.01, 0.0, 0.03], [0.0, 0.001, 0.03]], [[0, 1, 2]], process=False
    )
    repaired = repair_mesh(trimesh.util.concatenate([body, scrap]))
    assert repaired.notes[0].startswith("1 convex piece") and len(repaired.surface.vertices) == 8
    assert repaired.warnings == ("removed 1 stray piece of surface, up to 8 % as long as it is",)


def test_parts_that_are_far_off_come_with_advice():
    parts = d.Decomposition((), "coacd", error=2.32)
    (warning,) = importer._parts_warnings(parts, 0.001)
    assert "232 %" in warning and "--threshold" in warning


def stuck(*_: object) -> list[np.ndarray]:
    """Stands for CoACD that never ends."""
    while True:
        pass


def crashing(*_: object) -> None:
    """Stands for CoACD that ends its process."""
    os._exit(11)


def waiting(surface: trimesh.Trimesh, *_: object) -> list[np.ndarray]:
    """Stands for CoACD on a machine with other things to do: 1.5 s for no work."""
    time.sleep(1.5)
    return [surface.vertices]


def test_only_processor_time_makes_a_decomposition_fall_back(monkeypatch: pytest.MonkeyPatch):
    mesh = l_shape()
    limits = replace(FAST, time_limit=1.0)
    monkeypatch.setattr(d, "_coacd_parts", stuck)
    result = d.decompose(mesh, limits)
    assert result.method == "one hull" and len(result.hulls) == 1
    assert "1 s of processor time" in result.fallback
    assert hull_depth(result.hulls[0], mesh.vertices).max() < 1e-9
    monkeypatch.setattr(d, "_coacd_parts", waiting)
    assert d.decompose(mesh, limits).fallback == ""


def test_a_fall_back_is_said_and_done_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    l_shape().export(tmp_path / "bracket.stl")
    (job,) = plan_jobs([tmp_path / "bracket.stl"], tmp_path, "MIT")
    settings = replace(FAST, licence="MIT")
    with monkeypatch.context() as patch:
        patch.setattr(d, "_coacd_parts", crashing)
        fallen = import_mesh(job, settings).model
    assert len(fallen.hulls) == 1 and "or it crashed" in fallen.warnings[0]
    assert "tried again" in fallen.warnings[0]
    # The hull of the L without the L: a triangle of half 9 x 5 cm.
    assert fallen.volume_error == pytest.approx(0.5 * 0.09 * 0.05 * 0.03 / L_VOLUME, rel=0.05)
    assert read_object(Path(job.target)).warnings == fallen.warnings
    again = import_meshes([tmp_path / "bracket.stl"], tmp_path, settings)[0]
    assert (again.status, again.model.warnings) == ("imported", ()) and len(again.model.hulls) > 1
    assert import_meshes([tmp_path / "bracket.stl"], tmp_path, settings)[0].status == "cached"
