"""The benchmarks measure what they say and write what scripts read."""

import json
import sys
import time
from types import SimpleNamespace

import pytest

from vd.bench import allegro
from vd.bench.cli import PhysicsCommand, SimCommand
from vd.bench.sim import own_kernel_names, own_share
from vd.envs.cfg import ReorientCfg
from vd.envs.reorient import ReorientEnv


def test_all_kernels_of_a_step_count_as_ours():
    names = own_kernel_names()
    assert {
        "reward_kernel",
        "teacher_observation_kernel",
        "limit_joint_velocity_kernel",
        "guard_kernel",
    } <= names
    assert not any("mujoco" in name for name in names)


def measured(folder, **flags):
    """The row of a few environments with a teacher."""
    out = folder / "rows.json"
    SimCommand(envs=(2,), objects=("cube",), policy="dclaw4-cube", device="cpu", json=out, **flags).run()
    (row,) = json.loads(out.read_text())["rows"]
    return row


def test_sim_rows_add_up(tmp_path, capsys):
    row = measured(tmp_path)
    assert row["envs"] == 2 and row["rows_max"] > 0 and row["contacts_mean"] > 0.0
    # The step alone is what is left when the policy's time is taken off; how fast either is depends on what
    # else runs here.
    assert 0.0 < row["with_policy"] < row["whole_step"]
    assert json.loads(capsys.readouterr().out) == row


def test_a_policy_that_cannot_be_measured_is_told_at_once():
    with pytest.raises(ValueError, match="sees point clouds"):
        SimCommand(policy="dclaw3-tracking", device="cpu").run()


def test_our_kernels_take_a_share_of_a_step(device):
    if device == "cpu":
        pytest.skip("Warp times single kernels on a GPU only")
    cfg = ReorientCfg(hand="dclaw3", objects=("cube",), num_envs=8)
    assert 0.0 < own_share(ReorientEnv(cfg, device)) < 1.0


def test_newtons_allegro_example_stands_beside(monkeypatch, tmp_path):
    example = SimpleNamespace(step=lambda: time.sleep(0.001), sim_substeps=8, sim_dt=1.0 / 400.0)
    monkeypatch.setattr(allegro, "make_example", lambda envs: example)
    row = measured(tmp_path, allegro=True)
    assert 0.0 < row["allegro_physics_steps_s"] < 2 * 8 * 1000 and row["allegro_dt_s"] == 1.0 / 400.0
    assert row["physics_steps_over_allegro"] == pytest.approx(
        row["physics_only"] * 10 / row["allegro_physics_steps_s"]
    )


def test_a_missing_allegro_example_is_reported_in_the_row(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "newton.examples.robot.example_robot_allegro_hand", None)
    row = measured(tmp_path, allegro=True)
    assert row["physics_only"] > 0.0 and "cannot run here" in row["allegro"]
    assert "allegro_physics_steps_s" not in row


def test_physics_report_names_what_moves(tmp_path):
    out = tmp_path / "physics.json"
    PhysicsCommand(objects=("cube",), json=out).run()
    (report,) = json.loads(out.read_text())["rows"]
    assert report["objects"] == 1 and report["at_rest_share"] == 1.0 and report["moving"] == []
    assert report["pinch"]["creep"] < 0.2e-3
