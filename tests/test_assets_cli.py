"""``vd-assets`` from end to end."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg

from vd.assets_usd import cli
from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects import sheet
from vd.assets_usd.objects.sets import load_set


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("VD_ASSETS", str(tmp_path / "cache"))
    return tmp_path / "cache"


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """Exit status of ``vd-assets`` with these arguments."""
    monkeypatch.setattr(sys, "argv", ["vd-assets", *map(str, arguments)])
    return cli.main()


def picture(path: Path) -> np.ndarray:
    from PIL import Image

    return np.asarray(Image.open(path).convert("RGB"), dtype=float) / 255.0


def test_import_then_show(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    folder = tmp_path / "things"
    folder.mkdir()
    trimesh.creation.box((0.12, 0.05, 0.03)).export(folder / "brick.stl")
    (folder / "broken.obj").write_text("v 0 0 0\n")
    crumb = trimesh.creation.box((0.005, 0.005, 0.005)).apply_translation([0.0, 1.0, 0.0])
    trimesh.util.concatenate([trimesh.creation.box((0.12, 0.05, 0.03)), crumb]).export(
        folder / "dirty.stl"
    )
    assert run(monkeypatch, "import", folder) == 1
    assert "2 imported, 0 unchanged, 1 refused" in capsys.readouterr().out
    # Without --out, the set lies in the cache under the folder's name and can be loaded by it.
    assert [m.name for m in load_set("things")] == ["brick", "dirty"]

    assert (
        run(monkeypatch, "import", folder / "brick.stl", "--out", cache / "objects" / "things") == 0
    )
    assert "0 imported, 1 unchanged, 0 refused" in capsys.readouterr().out
    nothing = tmp_path / "nothing"
    assert (
        run(monkeypatch, "import", folder / "broken.obj", "--out", nothing) == 1
        and not nothing.exists()
    )
    assert run(monkeypatch, "import", folder) == 1
    out = capsys.readouterr().out
    assert "1 refused" in out and "broken.obj: " in out and "volume error" in out
    assert "warning dirty: removed 1 " in out  # unchanged, and still said

    drawing = tmp_path / "sheet.png"
    assert run(monkeypatch, "show", "things", "cube", "--out", drawing) == 0
    image = picture(drawing)
    drawn = np.abs(image - image[0, 0]).max(axis=2) > 0.1
    assert 0.05 < drawn.mean() < 0.7
    saturation = image.max(axis=2) - image.min(axis=2)
    assert (saturation > 0.3).mean() > 0.02, "the coloured parts are missing"


def test_a_contact_sheet_says_all_there_is_to_say_and_within_its_edges(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    figures = []
    monkeypatch.setattr(sheet, "save_figure", lambda figure, path: figures.append(figure))
    words = (
        "has a closed cavity of 53 % of its volume: mass and inertia are those of the hollow body"
    )
    cube = replace(load_set("cube")[0], warnings=(words, "its parts are full"))
    sheet.contact_sheet([cube, cube], tmp_path / "sheet.png", "a set with a name that is long " * 3)
    (figure,) = figures
    caption, _, title = (text.get_text().split() for text in figure.texts)
    assert " ".join(caption).endswith(f"{words} its parts are full")
    assert title[-1].endswith("%")
    renderer = FigureCanvasAgg(figure).get_renderer()
    for text in figure.texts:
        box = text.get_window_extent(renderer)
        assert box.x0 >= 0.0 and box.x1 <= figure.bbox.width, text.get_text()
        assert box.y0 >= 0.0 and box.y1 <= figure.bbox.height, text.get_text()


def test_the_name_of_a_procedural_set_makes_it():
    assert len(load_set("procedural-3-seed4")) == 3
    assert [item.family for item in load_set("procedural-tools-2-seed4")] == ["bar", "handled"]


def test_an_imported_cube_is_not_taken_for_the_built_in_one(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    mesh = tmp_path / "cube.stl"
    trimesh.creation.box((0.12, 0.05, 0.03)).export(mesh)
    assert run(monkeypatch, "import", mesh) == 1
    error = capsys.readouterr().err
    out = cache / "objects" / "my-cube"
    assert "built-in" in error and f"--out {out}" in error and not (cache / "objects").exists()
    assert run(monkeypatch, "import", mesh, "--out", out, "--units", "m", "--mass", "0.2") == 0
    text = capsys.readouterr().out
    assert "0.12 to 0.12 m (0 of 1 scaled), mass 0.2" in text
    assert load_set("my-cube")[0].longest_side == pytest.approx(0.12)


def test_errors_are_one_line_and_status_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    assert run(monkeypatch, "show", "nothing-here") == 1
    assert "'nothing-here'" in capsys.readouterr().err
    assert run(monkeypatch, "import") == 1
    assert "mesh files" in capsys.readouterr().err
    assert run(monkeypatch, "hand", "dclaw5") == 1
    assert "dclaw3" in capsys.readouterr().err


def test_hand(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    assert run(monkeypatch, "hand", "dclaw3") == 0
    assert load_hand(capsys.readouterr().out.strip()).num_joints == 9
