"""What cannot be written: a plain message with path and remedy, and nothing left half-written."""

import importlib
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from full_disk import small_files, somebody_else

from vd.assets_usd.objects.model import write_object
from vd.assets_usd.objects.procedural import cube
from vd.command.files import (
    OutputError,
    atomic_path,
    check_file,
    check_folder,
    make_folder,
    write_text,
)
from vd.play.video import write_frames
from vd.policy.agents import open_policy
from vd.policy.bundle import write_policy
from vd.train.checkpoint import save_checkpoint

LIMIT = 1 << 16


def noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)


def write(path: Path) -> None:
    """More than LIMIT bytes, by the writer of files of this kind."""
    if path.suffix == ".html":
        write_text(path, "x" * 2 * LIMIT)
    elif path.suffix == ".safetensors":
        write_policy(open_policy("dclaw3", "cpu"), path)
    elif path.suffix == ".pt":
        save_checkpoint(path, {"weights": torch.zeros(LIMIT)})
    elif path.suffix == ".npz":
        with atomic_path(path) as temporary:
            np.savez(temporary, values=noise(2 * LIMIT))
    elif path.suffix == ".mp4":
        write_frames(path, list(noise(8, 200, 200, 3)), 12.0)
    else:
        write_object(path, replace(cube(), notes=("x" * 2 * LIMIT,)))


@pytest.mark.parametrize(
    "name", ["page.html", "model.pt", "policy.safetensors", "cache.npz", "film.mp4", "cube.usda"]
)
def test_a_file_that_cannot_grow_is_named_and_the_old_one_stays(tmp_path, name):
    """Whatever writes it, and however that reports it."""
    path = tmp_path / name
    path.write_bytes(b"old")
    with (
        small_files(LIMIT),
        pytest.raises(OutputError, match=rf"{name}: .*free some space"),
    ):
        write(path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def refused(*cases):
    for check, path, message in cases:
        with pytest.raises(OutputError, match=f"cannot write {path}: {message}"):
            check(path)


def test_folders_that_cannot_be_made_are_refused_before_anything_is_written(tmp_path, capsys):
    (tmp_path / "file").touch()
    refused(
        (check_folder, tmp_path / "file/a/b", ".*file is a file; choose another path"),
        (check_folder, tmp_path / "file", "Not a directory; choose another path"),
        (make_folder, tmp_path / "file", "File exists"),
        (check_file, tmp_path, "Is a directory"),
        (check_file, tmp_path / "file/a.png", ".*file is a file"),
    )
    with somebody_else() as folder:
        refused(
            (check_folder, folder / "run/a", "Permission denied"),
            (make_folder, folder / "run", "Permission denied"),
            (lambda path: write_text(path, ""), folder / "a.txt", "Permission denied"),
        )
    check_folder(tmp_path / "new" / "folder")
    check_file(tmp_path / "new.txt")
    assert [path.name for path in tmp_path.iterdir()] == ["file"] and not capsys.readouterr().err
    check_file(tmp_path / "file")
    assert "will be replaced" in capsys.readouterr().err


def commands(taken: str) -> dict[str, list[str]]:
    """Command lines whose output would lie below a file."""
    return {
        "vd-train": ["teacher", "--preset", "gpu", "--out", taken],
        "vd-train ": ["student", "--teacher", "dclaw4-cube", "--out", taken],
        "vd-train  ": ["export", "x.pt", f"{taken}/x.safetensors"],
        "vd-train     ": [
            "tracker",
            "dclaw4",
            "--objects",
            "cube",
            "--out",
            f"{taken}/x.safetensors",
        ],
        "vd-eval": ["zero", "--out", taken],
        "vd-play": ["zero", "--video", f"{taken}/x.mp4"],
        "vd-gap": ["run", "recording", "--out", taken],
        "vd-deploy": ["record", "--twin", "--hand", "dclaw3", "--out", taken],
        "vd-deploy ": ["--twin", "--hand", "dclaw3", "--log", taken],
        "vd-assets": ["hand", "import", "hand.urdf", "--out", taken],
        "vd-assets ": ["import", "mesh.obj", "--out", taken],
        "vd-assets  ": ["show", "cube", "--out", f"{taken}/x.png"],
        "vd-bench": ["sim", "--json", f"{taken}/x.json"],
    }


@pytest.mark.parametrize("command", commands(""))
def test_every_command_says_so_at_once(tmp_path, command, monkeypatch, capsys):
    scripts = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"][
        "scripts"
    ]
    module, _, function = scripts[command.strip()].partition(":")
    (tmp_path / "file").touch()
    arguments = commands(str(tmp_path / "file" / "out"))[command]
    monkeypatch.setattr("sys.argv", [command.strip(), *arguments])
    try:
        status = getattr(importlib.import_module(module), function)()
    except SystemExit as end:  # what a script's exit status is made from: a number, or a message
        status = end.code
    text = capsys.readouterr().err + str(status)
    assert status
    assert "cannot write" in text and "choose another path" in text
    assert "Traceback" not in text and not list(tmp_path.glob("file/*"))
