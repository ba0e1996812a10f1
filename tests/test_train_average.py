"""The mean of several teachers' weights."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from train_dummy import SMALL_POLICY, SMALL_PPO, make_runner

from vd.evaluate.agents import SHIPPED_POLICIES
from vd.policy import load_policy, policy_export
from vd.train.average import NETWORKS, average_policies
from vd.train.checkpoint import find_checkpoint, load_checkpoint, save_checkpoint
from vd.train.cli import main

NORMALISING = replace(SMALL_POLICY, normalise_observations=True)


@pytest.fixture
def siblings(tmp_path) -> list[Path]:
    """Three policies of one run, each a few iterations on, the last a checkpoint."""
    runner = make_runner(tmp_path / "run", policy=NORMALISING, ppo=replace(SMALL_PPO, minibatch_size=128))
    paths = []
    for number in range(3):
        runner.learn(2)
        checkpoint = find_checkpoint(tmp_path / "run", "latest")
        path = tmp_path / f"{number}.pt"
        state = load_checkpoint(checkpoint)
        save_checkpoint(path, state if number == 2 else policy_export(state))
        paths.append(path)
    return paths


def test_weights_of_actor_and_critic_are_means(siblings, tmp_path, capsys):
    output = tmp_path / "mean.pt"
    assert main(["average", *map(str, siblings), "--out", str(output)]) == 0
    assert str(output) in capsys.readouterr().out
    states = [load_checkpoint(path) for path in siblings]
    mean = load_checkpoint(output)
    for network in NETWORKS:
        assert mean[network].keys() == states[0][network].keys()
        for name, found in mean[network].items():
            if name == "obs_normalizer.count":
                continue
            expected = np.mean([state[network][name].double().numpy() for state in states], axis=0)
            np.testing.assert_allclose(found.numpy(), expected, rtol=1e-5, atol=1e-6, err_msg=name)
    assert mean["env_steps"] == states[-1]["env_steps"] and "optimizer_state_dict" not in mean
    assert load_policy(output).critic_weights


def test_a_critic_that_not_all_have_is_left_out(siblings, tmp_path):
    state = load_checkpoint(siblings[0])
    save_checkpoint(tmp_path / "blind.pt", {k: v for k, v in state.items() if k != "critic_state_dict"})
    average_policies([str(siblings[1]), str(tmp_path / "blind.pt")], tmp_path / "mean.pt")
    assert not load_policy(tmp_path / "mean.pt").critic_weights


def test_policies_that_mean_something_else_are_refused_by_what_differs(siblings, tmp_path, capsys):
    output = tmp_path / "mean.pt"
    three, four = (str(SHIPPED_POLICIES[name]) for name in ("dclaw3-table", "dclaw4-table"))
    assert main(["average", three, four, "--out", str(output)]) == 1
    message = capsys.readouterr().err
    assert "dclaw4" in message and "num_actions 9, there 12" in message
    assert main(["average", str(siblings[0]), "--out", str(output)]) == 1
    assert "two policies at least" in capsys.readouterr().err
    assert main(["average", three, str(tmp_path / "none.pt"), "--out", str(output)]) == 1
    assert "none.pt" in capsys.readouterr().err
    state = load_checkpoint(siblings[0])
    state["task"] = state["task"] | {"action": {"ema_alpha": 0.5, "scale_rad_s": 3.5}}
    action = tmp_path / "action.pt"
    save_checkpoint(action, state)
    state["task"] = state["task"] | {"action": {"ema_alpha": 0.8, "scale_rad_s": 3.5}}
    save_checkpoint(tmp_path / "other.pt", state)
    assert main(["average", str(action), str(tmp_path / "other.pt"), "--out", str(output)]) == 1
    assert "env.action.ema_alpha 0.5, there 0.8" in capsys.readouterr().err
    assert not output.exists()
