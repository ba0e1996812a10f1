"""``vd-bench depth`` measures both cameras on the same scene and writes what scripts read."""

import json

import pytest

from vd.bench import depth
from vd.bench.cli import DepthCommand


def test_rows_hold_rates_and_agreement(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(depth, "LEAST_TIME_S", 0.01)
    out = tmp_path / "depth.json"
    DepthCommand(envs=(1, 2), objects=("cube",), hand="dclaw3", device="cpu", json=out).run()
    report = json.loads(out.read_text())
    assert [row["envs"] for row in report["rows"]] == [1, 2]
    assert [json.loads(line) for line in capsys.readouterr().out.splitlines()] == report["rows"]
    for row in report["rows"]:
        assert row["images_over_newton"] == pytest.approx(row["images"] / row["newton"])
        # The hand covers some of the picture, and nobody sees it otherwise.
        assert row["points"] > 500
        assert row["different"] < 1e-3
