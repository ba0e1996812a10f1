"""A policy that turns objects by its joints alone: trained, judged and driven, with no other sense."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from sensed_world import state_of

from vd.assets_usd.objects.sets import load_set
from vd.deploy import cli as deploy
from vd.deploy.loop.policy_runner import load_runner
from vd.deploy.loop.run_page import PAGE_FILE, goal_results, revolutions
from vd.envs.cfg import ObservationCfg, RewardCfg, SpinCfg, StartCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate import cli as evaluate
from vd.evaluate import compare
from vd.evaluate.spin import SPIN_FILE, SpinResult, Turns, turn
from vd.logs.hand_log import read_log
from vd.policy.agents import open_policy, task_for
from vd.train import cli as train
from vd.train.presets import PRESETS, cpu_demo, smoke
from vd.train.teacher import build_teacher

STEPS = 4
"""Of the history."""


@pytest.fixture(scope="module")
def policy(tmp_path_factory) -> str:
    """One iteration of learning to spin, with a hand that is always there."""
    out = tmp_path_factory.mktemp("spin")
    cfg = smoke(cpu_demo())
    task = replace(
        cfg.env,
        num_envs=4,
        observation=ObservationCfg(history=STEPS, shape="full", dynamics="critic"),
        reward=RewardCfg(spin=SpinCfg(rate=1.0, axis=(0.0, 0.0, 2.0))),
        start=StartCfg(),
    )
    run = replace(cfg.run, out=out, max_minutes=None)
    build_teacher(replace(cfg, run=run, env=task)).learn(1)
    return str(out / "policy.safetensors")


def world(policy: str, **changes) -> ReorientEnv:
    """An environment of its task, without noise."""
    of = open_policy(policy, "cpu")
    asked = {"stop_tolerance_rad": 0.4, "randomised": False, "objects": ("cube",)}
    return ReorientEnv(task_for(of, **asked, **changes), "cpu")


def test_presets_of_palm_up_hands_see_thirty_steps_of_the_joints_alone():
    for name, hand in (("leap-spin", "leap"), ("allegro-spin", "allegro")):
        env = PRESETS[name]().env
        env.validate()
        assert env.hand == hand and env.observation.history == 30
        assert env.reward.spin.rate > 0.0 and env.reward.success == env.reward.progress == 0.0


def test_a_hand_decides_as_in_training_with_nobody_telling_of_the_object(policy):
    """Also a second time, when the past is forgotten."""
    env = world(policy, num_envs=1)
    actor = open_policy(policy, "cpu")
    assert actor.contract.interface["observation"]["parts"] == {"history": [0, STEPS * 18]}
    runner = load_runner(policy, "dclaw3", env.hand, env.objects[0])
    assert runner.camera is None and runner.kind == "joints"
    for _ in range(2):
        env.reset()
        runner.new_goal()
        for _ in range(STEPS + 2):
            action = wp.from_torch(actor.act(wp.to_torch(env.observation)))
            blind = replace(state_of(env), truth=None, object_state=None)
            found = runner.decide(blind)
            np.testing.assert_allclose(found.action, action.numpy()[0], atol=2e-3)
            assert math.isnan(found.distance)
            env.step(action)


class Pusher:
    """Turns the objects of an environment by so much in each step [rad], whatever the hand does."""

    def __init__(self, env: ReorientEnv, rates: list[float]):
        self._env, self._rates, self._step = env, rates, 0

    def act(self, observation):
        """Put each object where it would be by now, before the hand."""
        env, d = self._env, self._env.num_joints
        q = env.sim.joint_q.numpy()
        for row, rate in zip(q, self._rates, strict=True):
            row[d : d + 3] = env.hand.workspace.goal_m
            if self._step > 2 and rate > 1.0:
                row[d : d + 3] = 1.0  # far away
            about = Rotation.from_rotvec([0.0, 0.0, rate]) * Rotation.from_quat(row[d + 3 :])
            row[d + 3 :] = about.as_quat()
        env.sim.joint_q.assign(q)
        self._step += 1
        return observation.new_zeros(env.num_envs, env.num_actions)


def test_turns_are_counted_to_the_drop_or_the_end(policy):
    env = world(policy, num_envs=3, episode_s=1.0)
    rates = [0.2, -0.1, 2.0]
    angle, held_s, dropped = turn(env, Pusher(env, rates), 3)
    assert dropped.tolist() == [[False, False, True]]
    np.testing.assert_allclose(held_s, [[1.0, 1.0, 4 / 12]])
    # What a finger adds in a step is little beside.
    np.testing.assert_allclose(angle[0, :2], [12 * 0.2, -12 * 0.1], atol=0.4)


def test_it_is_judged_by_its_turns_and_is_no_policy_with_goals(
    policy, tmp_path, capsys, monkeypatch
):
    opened = []
    monkeypatch.setattr(
        compare, "open_policy", lambda *agent: opened.append(agent[0]) or open_policy(*agent)
    )
    flags = ["--objects", "cube", "--episodes", "2", "--episode-s", "0.5", "--device", "cpu"]
    assert evaluate.main([policy, "zero", *flags, "--out", str(tmp_path)]) == 0
    assert opened == [policy, "zero"], "each once"
    found = json.loads((tmp_path / SPIN_FILE).read_text())
    assert [row["object"] for row in found["rows"]] == ["cube", "cube"]
    assert found["software"]["newton"]
    assert all(0.0 < row["held_s"] <= 0.5 and row["episodes"] == 2 for row in found["rows"])
    assert "revolutions" in capsys.readouterr().out
    for more, why in (
        ([policy, "--goals", "scan", "--stop-tolerance", "0.1"], "--goals, --stop-tolerance"),
        ([policy, "dclaw3"], "to goals"),
    ):
        assert evaluate.main([*more, *flags, "--out", str(tmp_path)]) == 1
        assert why in capsys.readouterr().err
    assert train.main(["tracker", policy, "--objects", "cube", "--device", "cpu"]) == 1
    assert f"{policy} turns objects" in capsys.readouterr().err


def test_what_hardly_turned_backwards_turned_nothing():
    row = Turns("zero", "cube", 2, -1e-4, 0.0, -1e-4, 0.5, 1.0)
    assert "-" not in SpinResult((row,), (0.0, 0.0, 1.0), 30.0, "off", 0, {}).text()


def test_revolutions_are_about_the_axis_however_often_it_goes_round():
    tilt = Rotation.from_euler("x", 0.3)
    angles = np.linspace(0.0, 5.0 * math.pi, 40)
    turns = Rotation.from_rotvec(np.outer(angles, [0.0, 0.0, 1.0])) * tilt
    assert revolutions(turns.as_quat(), (0.0, 0.0, -2.0)) == pytest.approx(-2.5)
    assert revolutions(turns.as_quat(), (1.0, 0.0, 0.0)) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
def test_it_drives_a_twin_without_camera_and_pose(policy, tmp_path, capsys):
    pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")
    folder = tmp_path / "log"
    on = [policy, "--hand", "dclaw3", "--twin"]
    patient = ["--safety.misses", "1000", "--safety.lost-s", "30", "--safety.watchdog-s", "2.5"]
    status = deploy.main([*on, *patient, "--episode-s", "2", "--log", str(folder)])
    out, words = capsys.readouterr()
    if "loop rate" in words or "asked again" in words:
        pytest.skip(f"this machine is too busy: {words.splitlines()[-1]}")
    assert status == 0, words
    log = read_log(folder)
    (result,) = goal_results(log)
    assert log.run["kind"] == "joints" and result.success is None and result.turned is not None
    assert "turned" in out and "revolutions" in (folder / PAGE_FILE).read_text()
    assert deploy.main([*on, "--pose", "sim"]) == 1
    assert "its joints alone" in capsys.readouterr().err


def test_the_cylinder_is_as_symmetric_as_it_says():
    (item,) = load_set("cylinder")
    assert len(item.symmetry) == 24
    corners = item.hulls[0][0]
    for turned in Rotation.from_quat(item.symmetry):
        moved = turned.apply(corners)
        nearest = np.linalg.norm(moved[:, None] - corners[None], axis=2).min(axis=1)
        assert nearest.max() < 1e-6


def test_what_hardly_turned_has_turned_by_zero_without_a_sign():
    row = Turns("p", "cube", 4, -0.001, 0.0, per_drop=-0.01, dropped=0.25, held_s=1.0)
    text = SpinResult((row,), (0.0, 0.0, 1.0), 1.0, "off", 0, {}).text()
    assert "0.00 (sd 0.00)" in text and "-0.0" not in text
