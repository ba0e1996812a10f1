"""The benchmarks measure what they say and write what scripts read."""

import json

import pytest

from vd.bench.cli import SimCommand


def test_sim_rows_add_up(tmp_path, capsys):
    out = tmp_path / "rows.json"
    SimCommand(envs=(2,), objects=("cube",), policy="dclaw4-cube", device="cpu", json=out).run()
    (row,) = json.loads(out.read_text())["rows"]
    assert row["envs"] == 2
    # The step alone is what is left when the policy's time is taken off; how fast either is depends
    # on what else runs here.
    assert 0.0 < row["with_policy"] < row["whole_step"]
    assert json.loads(capsys.readouterr().out) == row


def test_a_policy_that_cannot_be_measured_is_told_at_once():
    with pytest.raises(ValueError, match="sees point clouds"):
        SimCommand(policy="dclaw3-vision", device="cpu").run()
