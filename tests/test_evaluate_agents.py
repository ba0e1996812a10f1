"""Which policy a name means, and the task it is evaluated in."""

import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp

import vd
from vd.assets_usd.hands import hand_usd
from vd.evaluate.cli import main
from vd.evaluate.conditions import CONDITIONS
from vd.evaluate.result import SUCCESS, Result
from vd.policy.agents import (
    SHIPPED_POLICIES,
    find_policy,
    open_policy,
    policy_at,
    policy_name,
    task_for,
)
from vd.policy.bundle import read_policy
from vd.policy.contract import installed_contract
from vd.policy.store import check_for_others
from vd.train.begin import find_start
from vd.train.cli import main as train


def task_of(policy, **changes):
    return task_for(
        policy, **{"stop_tolerance_rad": 0.4, "randomised": False, "num_envs": 2} | changes
    )


@pytest.mark.parametrize("name", SHIPPED_POLICIES)
def test_installed_policies_load_and_act(name):
    policy = open_policy(name, "cpu")
    check_for_others(SHIPPED_POLICIES[name])
    assert installed_contract(SHIPPED_POLICIES[name]) == policy.contract
    assert name.split("-")[0] == policy.task["hand"], "the name begins with the hand"
    if policy.kind == "student":
        network = policy.network
        told = torch.zeros(3, network.senses[0].in_features)
        action = network.decide(told, network.first_hidden(3)).action
    else:
        layers = policy if policy.kind == "teacher" else policy.teacher
        action = layers.act(torch.zeros(3, layers.num_observations))
    assert action.shape == (3, policy.num_actions) and torch.isfinite(action).all()
    assert not any("/" in item for item in policy.task["objects"]), (
        "a path of the machine it was trained on"
    )


def test_names_mean_files_and_files_have_names(tmp_path, monkeypatch):
    path = SHIPPED_POLICIES["dclaw4-cube"]
    monkeypatch.chdir(path.parent)
    assert (
        policy_name(path) == policy_name(path.name) == policy_name("dclaw4-cube") == "dclaw4-cube"
    )
    assert policy_name(tmp_path / path.name) == str(tmp_path / path.name)
    with pytest.raises(FileNotFoundError, match=r"policy\.safetensors"):
        find_policy(tmp_path)
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints/best.pt").touch()
    assert find_policy(tmp_path) == tmp_path / "checkpoints/best.pt"
    (tmp_path / "policy.safetensors").touch()
    assert (
        find_policy(tmp_path)
        == find_policy(tmp_path / "policy.safetensors")
        == tmp_path / "policy.safetensors"
    )


@pytest.mark.parametrize("own", ["./dclaw4", Path("dclaw4"), Path("./dclaw4")], ids=repr)
def test_a_path_is_a_path_where_a_policy_is_called_the_same(own, tmp_path, monkeypatch):
    """The folder of a run, called like an installed policy."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "dclaw4"
    folder.mkdir()
    shutil.copy(SHIPPED_POLICIES["dclaw4-cube"], folder / "policy.safetensors")
    cube = open_policy("dclaw4-cube", "cpu").contract
    assert find_policy("dclaw4") == SHIPPED_POLICIES["dclaw4"], "a bare name is an installed policy"
    assert find_policy(own).resolve() == folder / "policy.safetensors"
    assert vd.load_policy(own, device="cpu").contract == cube
    assert (
        train(["export", str(own) if isinstance(own, str) else policy_at(own), "o.safetensors"])
        == 0
    )
    assert vd.load_policy("o.safetensors", device="cpu").contract == cube
    assert find_start("./dclaw4").resolve() == folder / "policy.safetensors"
    with pytest.raises(ValueError, match="nosuchset"):
        vd.evaluate_policies(own, objects=("nosuchset",))
    (folder / "policy.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match="dclaw4 holds no"):
        vd.evaluate_policies(own, objects=("cube",))


@pytest.mark.parametrize("policy", ["dclaw4", "dclaw4-vision"])
def test_another_hand_is_refused_before_anything_is_built(policy, tmp_path, capsys, monkeypatch):
    from vd.envs import reorient
    from vd.play.cli import main as play

    monkeypatch.setattr(reorient, "ReorientEnv", lambda *_: pytest.fail("the scene is built"))
    for command, flags in (
        (main, ["--out", str(tmp_path)]),
        (play, ["--video", str(tmp_path / "m.mp4")]),
    ):
        assert command([policy, "--hand", "dclaw3", "--device", "cpu", *flags]) == 1
        error = capsys.readouterr().err
        assert f"{policy} was trained for dclaw4 (12 motors), not for dclaw3 (9)" in error
    other = tmp_path / "other.usda"
    other.write_text(hand_usd("dclaw4").read_text().replace("dclaw4", "other"))
    assert main([policy, "--hand", str(other), "--device", "cpu", "--out", str(tmp_path)]) == 1
    assert "not for other (12)" in capsys.readouterr().err


def test_start_goals_and_layer_are_as_trained_unless_asked_otherwise():
    trained = read_policy(SHIPPED_POLICIES["dclaw4-cube"])
    assert task_of(trained).start.at_rest and not task_of(None).start.at_rest
    assert not task_of(trained, at_rest=False).start.at_rest
    assert task_of(None, at_rest=True).start.at_rest
    assert task_of(trained).goal.max_angle_rad == pytest.approx(1.0)
    assert task_of(None).goal.max_angle_rad == pytest.approx(math.pi)
    assert task_of(trained, max_goal_angle_rad=0.5).goal.max_angle_rad == 0.5
    assert task_of(trained).hand_layer is None
    trained.task["hand_layer"] = "bench/identified.usda"
    assert task_of(trained).hand_layer == "bench/identified.usda"
    assert task_of(trained, hand_layer="other.usda").hand_layer == "other.usda"
    assert task_of(trained, hand_layer="none").hand_layer is None


def test_conditions_replace_what_a_policy_was_trained_in_and_nobody_tells_a_critic():
    trained = read_policy(SHIPPED_POLICIES["dclaw4-cube"])
    trained.task["observation"] = {"dynamics": "critic", "canonical": True}
    for condition in CONDITIONS.values():
        task = task_of(trained, condition=condition)
        task.validate()
        assert task.randomisation == condition
        assert task.observation.dynamics == "none" and task.observation.canonical
    assert not CONDITIONS["nominal"].enabled and CONDITIONS["mixed"].observation_latency_s == (
        0.0,
        0.12,
    )
    assert CONDITIONS["hard"].force_s == 5.0 * CONDITIONS["s3"].force_s


@pytest.mark.parametrize("extra", [[], ["--consecutive"], ["--engine", "mujoco"]], ids=str)
def test_an_environment_whose_physics_fails_costs_its_episode_alone(
    tmp_path, monkeypatch, capsys, extra
):
    def act(env, policy, envs):
        if env.step_count.numpy()[1] == 2:
            env.sim.joint_qd.numpy()[1, 0] = np.nan
        return policy.act(wp.to_torch(env.observation))

    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    monkeypatch.setattr("vd.evaluate.trace.act_in", act)
    flags = [
        "--objects",
        "cube",
        "--episodes",
        "3",
        "--episode-s",
        "0.5",
        "--device",
        "cpu",
        *extra,
    ]
    assert main(["zero", *flags, "--out", str(tmp_path)]) == 0
    assert "zero cube: physics failed in 1 of 3" in capsys.readouterr().out
    row = Result.read(tmp_path / "eval.json").rows[0]
    assert [e.steps <= 3 for e in row.episodes] == [False, True, False] and not row.episodes[
        1
    ].stopped
    assert math.isfinite(row.overall.median_error_rad.value)


@pytest.mark.slow
def test_evaluation_at_rest_of_the_installed_policy_beats_doing_nothing(tmp_path):
    flags = ["--objects", "cube", "--episodes", "8", "--max-goal-angle", "1.0", "--episode-s", "3"]
    assert (
        main(
            ["dclaw4-cube", "zero", "--at-rest", *flags, "--device", "cpu", "--out", str(tmp_path)]
        )
        == 0
    )
    rows = [row for row in Result.read(tmp_path / "eval.json").rows if row.stopped_by == SUCCESS]
    trained, zero = (row.episodes for row in rows)
    assert all(row.protocol.at_rest for row in rows)
    for one, other in zip(trained, zero, strict=True):
        np.testing.assert_allclose(one.start_quat, other.start_quat, atol=1e-3)
        np.testing.assert_allclose(one.goal_quat, other.goal_quat, atol=1e-3)
    assert all(e.start_error_rad <= 1.0 + 1e-3 for e in trained)
    assert sum(e.stopped for e in trained) >= 6 > sum(e.stopped for e in zero)
    assert "dclaw4-cube" in (tmp_path / "eval.html").read_text()
    again = ["--device", "cpu", "--out", str(tmp_path / "again")]
    assert main(["zero", "--at-rest", *flags, *again]) == 0
    assert [row.episodes for row in Result.read(tmp_path / "again" / "eval.json").rows][1] == zero
