"""The student's benchmark measures the networks it names, and says what it could not measure."""

import dataclasses
import json
import sys

import pytest
import torch

from vd.assets_usd.objects.model import load_set
from vd.bench.cli import StudentCommand
from vd.bench.student import Scenes, measure_training, open_network, take_turns
from vd.bench.student_twins import DenseEncoder, scattered, voxels_per_cell
from vd.student.cfg import LEAN
from vd.student.clouds import Voxeliser
from vd.student.network import VoxelEncoder
from vd.student.sparse import SparseConv3d

ENDS = (500, 500 + 12 * 500)
"""Where the points of the goal and of the hand end."""


@pytest.fixture(autouse=True)
def threads():
    """One thread, quicker for so little on busy cores; put back what it was, and what a benchmark changes."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_latency_row_and_what_is_missing(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "spconv", None)
    monkeypatch.setitem(sys.modules, "spconv.pytorch", None)
    out = tmp_path / "rows.json"
    networks = ("lean", "dclaw3-student")
    StudentCommand(networks=networks, objects=("cube",), hand="dclaw3", calls=2, threads=1, json=out).run()
    row, installed = json.loads(out.read_text())["latency"]
    # the installed one is of the same network, and has its teacher's layers besides
    assert installed["points"] == row["points"] and installed["parameters"] > row["parameters"]
    assert row["points"] == 500 + 12 * 500 + 6000
    assert 1000 < row["voxels"] < 500 + 12 * 500
    assert row["sites"] == sorted(row["sites"], reverse=True) and len(row["sites"]) == 5
    assert 0.0 < row["median_ms"] <= row["p99_ms"]
    assert set(row["encoder_ms"]) == set(row["encoder_cpu_ms"]) == {"ours", "per offset", "dense"}
    assert row["cpu_ms"] > 0.0 and set(row["parts_cpu_ms"]) == set(row["parts_ms"])
    assert "spconv" in row["missing"]
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["network"] == "dclaw3-student"


def test_training_row(device):
    row = measure_training(load_set("cube"), "lean", device, hand="dclaw3", worlds=2, steps=2, calls=1)
    assert row.clouds == 4 and 1000 < row.voxels < 7000
    assert set(row.parts_ms) == {"points", "voxels", "maps", "forward", "backward"}
    # parts are of the minibatch alone, and nothing of it is left out
    assert sum(row.parts_ms.values()) == pytest.approx(1e3 * row.clouds / row.clouds_per_s, rel=0.2)
    assert row.act_clouds_per_s > 0.0


def test_dense_twin_has_the_encoders_layers(device):
    """As many weights as the encoder's convolutions and norms have, and pooled features of the same width."""
    cfg = dataclasses.replace(LEAN.encoder, channels=(4, 8), blocks=1)
    scenes = Scenes(load_set("cube"), "dclaw3", 1, device, 0)
    scenes.write()
    sites = Voxeliser(device=device)(scenes.points, ends=ENDS)
    twin = DenseEncoder(cfg).to(sites.device).eval()
    assert voxels_per_cell(cfg) == 8
    assert twin(sites).shape == (1, 16)
    sparse = sum(p.numel() for stage in twin.stages for p in stage.parameters())
    assert sparse == 27 * (6 * 4 + 4 * 8 + 2 * 16 + 2 * 64) + 2 * (4 + 8 + 2 * 4 + 2 * 8)


def test_scattered_twin_gives_the_same_features(device):
    scenes = Scenes(load_set("cube"), "dclaw3", 2, device, 0)
    scenes.write()
    sites = Voxeliser(device=device)(scenes.points, ends=ENDS)
    torch.manual_seed(0)
    cfg = dataclasses.replace(LEAN.encoder, channels=(4, 8), blocks=1)
    encoder = VoxelEncoder(cfg).to(sites.device).eval()
    with torch.inference_mode():
        expected, twin = encoder.pooled(sites), scattered(encoder)
        torch.testing.assert_close(twin.pooled(sites), expected, atol=1e-5, rtol=1e-5)
    assert not any(type(module) is SparseConv3d for module in twin.modules())


def test_turns_are_taken():
    order = []
    times = take_turns({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 3)
    assert order[:4] == ["a", "b", "a", "b"]
    assert {name: values.shape for name, values in times.items()} == {"a": (3, 2), "b": (3, 2)}


def test_refuses_an_unknown_network():
    with pytest.raises(ValueError, match="paper"):
        StudentCommand(networks=("fat",)).run()
    with pytest.raises(ValueError, match="a teacher"):
        open_network("dclaw3-table", "dclaw3")
