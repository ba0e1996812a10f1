"""Students in the real environment: what they see, their memory, the table that goes, and vd-eval."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from student_dummy import TINY, untrained_student

from vd.config import to_dict
from vd.envs.cfg import RandomisationCfg, ReorientCfg, SuccessCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate import student as module
from vd.evaluate.agents import open_policy, sees_clouds
from vd.evaluate.cli import main
from vd.evaluate.result import Result
from vd.evaluate.scanned import MISSING, NOISE_M, known_objects, scan
from vd.evaluate.student import StudentActor, StudentView
from vd.evaluate.trace import NEVER_RAD, record
from vd.paper import PAPER
from vd.sensors.cfg import DepthCameraCfg, DepthSensorCfg
from vd.train.checkpoint import save_checkpoint
from vd.vision.saved import student_export

TASK = ReorientCfg(
    hand="dclaw3",
    objects=("cube",),
    num_envs=3,
    episode_s=0.5,
    success=replace(SuccessCfg(), rotation_rad=NEVER_RAD),
    success_ends_episode=True,
)


def make_student(stage=1):
    return untrained_student(TASK, stage)


def save_student(path, stage):
    student = make_student(stage)
    state = {
        "spec": to_dict(student.spec),
        "task": student.task,
        "depth": student.depth,
        "iter": 1,
        "env_steps": 100,
        "student_state_dict": student.network.state_dict(),
    }
    save_checkpoint(path, student_export(state))
    return str(path)


DRAWN = RandomisationCfg(redraw_s=0.0, force_probability=0.0)
"""Frictions and gains are handed to the solver now and then, which must not move the table. No pushes: they
would lose objects from open fingers."""


@pytest.fixture(scope="module")
def env():
    return ReorientEnv(replace(TASK, randomisation=DRAWN), "cpu")


def test_environments_are_seen_in_parts_and_some_alone_without_a_difference(env, monkeypatch):
    env.reset()
    state = env.state_dict()

    def run(steps, active=None):
        env.load_state_dict(state)
        actor = StudentActor(env, make_student())
        actor.active = actor.active if active is None else torch.tensor(active)
        for _ in range(steps):
            action = actor.act(wp.to_torch(env.observation))
            env.step(wp.from_torch(action.contiguous()))
        return torch.cat([action, actor.predicted[:, None]], dim=1)

    whole = run(3)
    assert whole[:, -1].any()
    some = run(1, active=[True, False, True])
    torch.testing.assert_close(some[[0, 2]], run(1)[[0, 2]], atol=1e-4, rtol=0.0)
    assert not some[1].any()
    monkeypatch.setattr(module, "CLOUDS", 2)
    torch.testing.assert_close(run(3), whole, atol=1e-4, rtol=0.0)


def test_memory_lasts_until_the_reset(env):
    env.reset()
    actor, state = StudentActor(env, make_student()), env.state_dict()
    first = actor.act(wp.to_torch(env.observation)).clone()
    env.step(wp.from_torch(first.contiguous()))
    actor.act(wp.to_torch(env.observation))
    env.load_state_dict(state)
    torch.testing.assert_close(actor.act(wp.to_torch(env.observation)), first, atol=1e-5, rtol=0.0)
    # the same sight in the middle of an episode is met with memory
    env.step_count.fill_(1)
    assert not torch.allclose(actor.act(wp.to_torch(env.observation)), first, atol=1e-5)


def test_what_it_sees_is_as_its_stage_was_trained_and_errs_where_that_is_asked(env, tmp_path):
    assert sees_clouds(open_policy(save_student(tmp_path / "student.pt", 2), "cpu"))
    assert not any(sees_clouds(open_policy(name, "cpu")) for name in ("dclaw3-table", "zero"))
    assert [StudentActor(env, make_student(stage)).rendered for stage in (1, 2)] == [False, True]
    with pytest.raises(ValueError, match="stage 0 is an encoder"):
        StudentActor(env, make_student(0))
    plain, real = (
        StudentActor(env, make_student(2), sensor_errors=errs)._view.senses.camera.cfg
        for errs in (False, True)
    )
    assert not plain.sensor.enabled and plain.latency_s == (0.0, 0.0) and plain.position_noise_m == 0.0
    assert real.sensor == DepthSensorCfg.realistic() and real.latency_s[1] > real.latency_s[0] > 0.0
    assert real.position_noise_m > 0.0 and real.rotation_noise_rad > 0.0
    assert real.points == plain.points, "all else is as in its training"


def test_a_scan_is_noisy_and_misses_one_side():
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(4000, 3))
    ball *= 0.05 / np.linalg.norm(ball, axis=1, keepdims=True)
    scanned = scan(ball, rng)
    assert scanned.shape == ball.shape
    assert scan(ball.astype(np.float32), rng).dtype == np.float32, "of the kind that the search for it takes"
    off = np.linalg.norm(scanned, axis=1) - 0.05  # across the surface only one axis of the noise shows
    assert off.std() == pytest.approx(NOISE_M, rel=0.1)
    side = -scanned.mean(axis=0) / np.linalg.norm(scanned.mean(axis=0))
    # A cap with a fifth of a sphere's area begins at 0.6 of its radius.
    assert (scanned @ side > (0.6 * 0.05 + 3 * NOISE_M)).mean() < 0.01
    assert (ball @ side > 0.6 * 0.05).mean() == pytest.approx(MISSING, abs=0.03)


def test_only_the_goal_is_scanned(env):
    env.reset()
    settings = dict(rendered=True, depth=DepthCameraCfg(points=300))
    scans = known_objects(env.objects, "scan", seed=0, device="cpu")
    exact, scanned = (StudentView(env, TINY, **settings, goals=goals) for goals in (None, scans))
    frame = exact.frame()
    rows = torch.tensor([2, 0])
    chosen = {key: value[rows] for key, value in frame.items()}
    clouds = [view.sight.points(chosen, rows) for view in (exact, scanned)]
    goal = len(env.objects[0].surface_points)
    np.testing.assert_array_equal(*(cloud[:, goal:].numpy() for cloud in clouds))
    centre = np.array(PAPER.cloud.goal_position_m)
    reach = [np.linalg.norm(cloud[:, :goal].numpy() - centre, axis=-1).max() for cloud in clouds]
    assert not torch.allclose(clouds[0][:, :goal], clouds[1][:, :goal], atol=NOISE_M)
    assert reach[1] < reach[0] + 5 * NOISE_M, "the goal is where it belongs"
    np.testing.assert_array_equal(scanned.sight.points(chosen, rows).numpy(), clouds[1].numpy())


def test_without_a_table_objects_fall_and_it_comes_back():
    class Still:
        def act(self, observation):
            """Nothing: open fingers hold nothing."""
            return torch.zeros((3, 9))

    # Over a second long: the solver is told of new frictions in between.
    env = ReorientEnv(replace(TASK, randomisation=DRAWN, episode_s=3.0), "cpu")
    starts, goals = (np.tile(quat, (1, 3, 1)) for quat in ([0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0]))
    settings = dict(starts=starts, goals=goals)
    rests = record(env, Still(), 3, **settings)
    falls = record(env, Still(), 3, **settings, table_steps=24)
    again = record(env, Still(), 3, **settings)
    assert not rests.fell.any() and not again.fell.any()
    assert falls.fell.all() and (falls.steps > 24).all() and (falls.steps <= 28).all()
    env.check()


@pytest.mark.slow
def test_students_and_teacher_side_by_side(tmp_path, capsys):
    students = [save_student(tmp_path / f"stage{n}" / "student.pt", n) for n in (1, 2)]
    flags = ["--objects", "training=cuboid", "both=cube", "both=cuboid", "--episodes", "2", "--device", "cpu"]
    flags += ["--episode-s", "0.5", "--out", str(tmp_path / "out")]
    assert main([*students, "dclaw3-table", "zero", *flags, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    result = Result.read(tmp_path / "out" / "eval.json")
    assert [row["policy"] for row in printed["rows"]] == [row.policy for row in result.rows]
    assert {(row.kind, row.sees) for row in result.rows} == {
        ("student of stage 1", "complete clouds"),
        ("student of stage 2", "rendered clouds"),
        ("teacher", "state"),
        ("zero", "nothing"),
    }
    assert len(result.policies) == 4 and len(result.rows) == 2 * 4 * 2
    assert len(printed["differences"]) == 2 * 3
    alone, both = (next(row for row in result.rows if row.group == group) for group in ("training", "both"))
    assert alone.object_names == ("cuboid",) and both.object_names == ("cube", "cuboid")
    assert [e.error_rad for e in alone.episodes] == [e.error_rad for e in both.episodes[2:]]
    starts = {
        (row.object_names[episode.object_index], episode.start_quat, episode.goal_quat)
        for row in result.rows
        for episode in row.episodes
    }
    assert len(starts) == 2 * 2, "everyone has the same starts and goals"
    assert (tmp_path / "out" / "eval.html").is_file()
