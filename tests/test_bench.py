"""The benchmarks measure what they say and write what scripts read."""

import json
import sys

import pytest

from vd.bench.cli import PhysicsCommand, SimCommand
from vd.bench.sim import own_kernel_names


def test_all_kernels_of_a_step_count_as_ours():
    names = own_kernel_names()
    assert {
        "reward_kernel",
        "teacher_observation_kernel",
        "limit_joint_velocity_kernel",
        "guard_kernel",
    } <= names
    assert not any("mujoco" in name for name in names)


def test_sim_rows_add_up(tmp_path, capsys):
    out = tmp_path / "rows.json"
    SimCommand(worlds=(4,), objects=("cube",), hand="dclaw3", device="cpu", allegro=False, json=out).run()
    (row,) = json.loads(out.read_text())["rows"]
    assert row["worlds"] == 4 and row["rows_max"] > 0
    # What includes more is not faster; timing ripples, so the bound is wide.
    assert 0.0 < row["with_policy"] < 1.5 * row["physics_only"]
    assert json.loads(capsys.readouterr().out)["worlds"] == 4


def test_the_allegro_example_that_cannot_be_fetched_is_reported(monkeypatch):
    from vd.bench.allegro import allegro_rate

    def offline(*_args: object, **_kwargs: object) -> None:
        raise OSError("no network")

    monkeypatch.setattr("newton.utils.download_asset", offline)
    with pytest.raises(RuntimeError, match="no network"):
        allegro_rate(1, "cpu")


def test_a_missing_allegro_example_is_reported_in_the_row(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "newton.examples.robot.example_robot_allegro_hand", None)
    out = tmp_path / "rows.json"
    SimCommand(worlds=(2,), objects=("cube",), hand="dclaw3", device="cpu", json=out).run()
    (row,) = json.loads(out.read_text())["rows"]
    assert row["physics_only"] > 0.0 and "cannot run here" in row["allegro"]
    assert "allegro_physics_steps_s" not in row


def test_physics_report_names_what_moves(tmp_path):
    out = tmp_path / "physics.json"
    PhysicsCommand(objects=("cube",), json=out).run()
    report = json.loads(out.read_text())
    assert report["objects"] == 1 and report["at_rest_share"] == 1.0 and report["moving"] == []
    assert report["pinch"]["creep"] < 0.2e-3
