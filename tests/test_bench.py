"""The benchmarks measure what they say and write what scripts read."""

import json
import sys

import pytest

from vd.bench.cli import PhysicsCommand, SimCommand
from vd.bench.sim import kernel_rows, own_kernel_names, own_share, task, teacher_task
from vd.envs.reorient import ReorientEnv
from vd.evaluate.agents import find_policy
from vd.policy import load_policy


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
    SimCommand(envs=(4,), objects=("cube",), hand="dclaw3", device="cpu", allegro=False, json=out).run()
    (row,) = json.loads(out.read_text())["rows"]
    assert row["envs"] == 4 and row["rows_max"] > 0
    # The step alone is what is left when the policy's time is taken off; how fast either is depends on what
    # else runs here.
    assert 0.0 < row["with_policy"] < row["whole_step"]
    assert json.loads(capsys.readouterr().out)["envs"] == 4


def test_a_teacher_acts_in_its_own_task(tmp_path, capsys):
    SimCommand(
        envs=(4,), objects=("cube",), hand="dclaw3", policy="dclaw4-cube", device="cpu", allegro=False
    ).run()
    (row,) = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert row["with_policy"] > 0.0 and row["contacts_mean"] > 0.0
    assert teacher_task(load_policy(find_policy("dclaw4-cube")), ("cube",), 4).hand == "dclaw4"


def test_a_student_is_no_teacher_to_measure():
    with pytest.raises(ValueError, match="holds no policy"):
        SimCommand(policy="dclaw3-tracking", device="cpu", allegro=False).run()


def test_kernels_add_up_and_the_longest_is_first(device):
    if device == "cpu":
        pytest.skip("Warp times single kernels on a GPU only")
    cfg = task(("cube",), 8, "dclaw3", True)
    env = ReorientEnv(cfg, device)
    rows = kernel_rows(env)
    assert sum(row.share for row in rows) == pytest.approx(1.0)
    assert [row.seconds for row in rows] == sorted((row.seconds for row in rows), reverse=True)
    # The limit of joint speeds is ours and launched after every physics step.
    (limit,) = (row for row in rows if row.kernel.startswith("limit_joint_velocity_kernel"))
    assert limit.launches == cfg.sim.substeps
    assert 0.0 < own_share(rows) < 1.0


@pytest.fixture
def offline(monkeypatch):
    """Whatever asks for Newton's asset is noted, and finds no network."""
    asked = []

    def fetch(*args: object, **_kwargs: object) -> None:
        asked.append(args)
        raise OSError("no network")

    monkeypatch.setattr("newton.utils.download_asset", fetch)
    return asked


def test_the_allegro_example_runs_with_a_hand_of_boxes_and_without_the_network(offline, tmp_path):
    out = tmp_path / "rows.json"
    SimCommand(envs=(2,), objects=("cube",), hand="dclaw3", device="cpu", json=out).run()
    (row,) = json.loads(out.read_text())["rows"]
    assert row["allegro_hand"] == "boxes of the Allegro's size"
    assert row["allegro_dt_s"] == pytest.approx(1.0 / 400.0)
    assert row["physics_steps_over_allegro"] == pytest.approx(
        row["physics_only"] * 10 / row["allegro_physics_steps_s"]
    )
    assert offline == [], "nothing is fetched unasked"
    from vd.bench.allegro import allegro_rate

    with pytest.raises(RuntimeError, match="no network"):
        allegro_rate(1, "cpu", fetch=True)
    assert offline


def test_the_hand_of_boxes_passes_the_examples_own_test():
    """Its success criteria: fingers follow their targets, all hands move alike, no cube leaves its palm."""
    from vd.bench import allegro

    with allegro._in_place_of_the_asset(allegro.add_hand_of_boxes):
        example = allegro.make_example(2)
    assert example.hand_dof_count == 16
    assert example.model.body_mass.numpy()[:17].sum() == pytest.approx(1.0, abs=0.1)
    for _ in range(60):
        example.step()
        example.test_post_step()
    example.test_final()
    assert (example.solver.mjw_data.nefc.numpy() > 0).all(), "the cubes lie in the hands"


def test_the_example_is_as_it_was_after_a_hand_that_fails():
    import newton

    from vd.bench import allegro

    before = newton.ModelBuilder.add_usd, newton.utils.download_asset
    with pytest.raises(ZeroDivisionError), allegro._in_place_of_the_asset(lambda builder: 1 / 0):
        allegro.make_example(1)
    assert (newton.ModelBuilder.add_usd, newton.utils.download_asset) == before


def test_a_file_that_cannot_be_an_allegro_hand_is_refused(tmp_path):
    from vd.bench.allegro import allegro_rate

    with pytest.raises(ValueError, match=r"--allegro-file .*hand\.txt"):
        allegro_rate(1, "cpu", file=tmp_path / "hand.txt")
    broken = tmp_path / "hand.urdf"
    broken.write_text("<robot")
    with pytest.raises(RuntimeError, match="cannot run here"):
        allegro_rate(1, "cpu", file=broken)


def test_a_missing_allegro_example_is_reported_in_the_row(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "newton.examples.robot.example_robot_allegro_hand", None)
    out = tmp_path / "rows.json"
    SimCommand(envs=(2,), objects=("cube",), hand="dclaw3", device="cpu", json=out).run()
    (row,) = json.loads(out.read_text())["rows"]
    assert row["physics_only"] > 0.0 and "cannot run here" in row["allegro"]
    assert "allegro_physics_steps_s" not in row


def test_physics_report_names_what_moves(tmp_path):
    out = tmp_path / "physics.json"
    PhysicsCommand(objects=("cube",), json=out).run()
    report = json.loads(out.read_text())
    assert report["objects"] == 1 and report["at_rest_share"] == 1.0 and report["moving"] == []
    assert report["pinch"]["creep"] < 0.2e-3
