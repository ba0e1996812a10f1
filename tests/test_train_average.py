"""The mean of policies' weights, and what has none."""

import pytest
import torch
from train_dummy import make_runner

from vd.policy import load_policy, policy_export
from vd.train.average import averaged, shares
from vd.train.checkpoint import load_checkpoint, save_checkpoint
from vd.train.cli import main


@pytest.fixture
def states(tmp_path):
    """Policies of a run after 2 and 4 iterations, as they are exported."""
    runner = make_runner(tmp_path / "run")
    found = []
    for _ in range(2):
        runner.learn(2)
        runner.save(str(tmp_path / "checkpoint.pt"))
        found.append(policy_export(load_checkpoint(tmp_path / "checkpoint.pt")))
    return found


def test_weights_are_the_mean_and_all_else_is_the_newest(states):
    old, new = states
    mean = averaged([new, old], [0.75, 0.25], ["new", "old"])
    for network in ("actor_state_dict", "critic_state_dict"):
        assert mean[network].keys() == new[network].keys()
        for key, value in mean[network].items():
            expected = 0.75 * new[network][key] + 0.25 * old[network][key]
            if key.startswith("obs_normalizer."):
                expected = new[network][key]
            assert torch.allclose(value, expected), key
    assert mean["env_steps"] == new["env_steps"] > old["env_steps"]
    assert mean["averaged_steps"] == [new["env_steps"], old["env_steps"]]


def test_the_newest_is_known_whatever_the_order(states):
    old, new = states
    one, other = averaged([new, old], [0.5, 0.5], ["a", "b"]), averaged([old, new], [0.5, 0.5], ["b", "a"])
    assert one["env_steps"] == other["env_steps"]
    assert all(torch.allclose(v, other["actor_state_dict"][k]) for k, v in one["actor_state_dict"].items())


def test_a_critic_that_one_lacks_is_left_out(states):
    old, new = states
    without = {key: value for key, value in old.items() if key != "critic_state_dict"}
    assert "critic_state_dict" not in averaged([new, without], [0.5, 0.5], ["a", "b"])


def test_what_cannot_be_averaged_is_named(states):
    old, new = states
    other_hand = old | {"task": old["task"] | {"hand": "another"}}
    with pytest.raises(ValueError, match=r"old\.pt cannot be averaged.*the hand \(another, dummy\)"):
        averaged([new, other_hand], [0.5, 0.5], ["new.pt", "old.pt"])
    smaller = old | {"policy": old["policy"] | {"hidden": [4]}}
    with pytest.raises(ValueError, match="the shape of the networks"):
        averaged([new, smaller], [0.5, 0.5], ["new.pt", "old.pt"])
    seen = old | {"task": old["task"] | {"observation": {"view": "goal"}}}
    with pytest.raises(ValueError, match=r"env\.observation\.view world, here goal"):
        averaged(
            [seen | {"env_steps": 10**9}, new | {"task": new["task"] | {"observation": {"view": "world"}}}],
            [0.5, 0.5],
            ["seen.pt", "new.pt"],
        )


def test_shares_sum_to_one_or_are_refused():
    assert shares((), 4) == [0.25] * 4
    assert shares((3.0, 1.0), 2) == [0.75, 0.25]
    for weights, count in (((), 1), ((1.0,), 2), ((1.0, 0.0), 2), ((1.0, -1.0), 2)):
        with pytest.raises(ValueError, match=r"--weights has|at least two"):
            shares(weights, count)


def test_the_command_writes_a_policy_that_acts(states, tmp_path, capsys):
    files = []
    for index, state in enumerate(states):
        files.append(str(tmp_path / f"{index}.pt"))
        save_checkpoint(tmp_path / f"{index}.pt", state)
    out = tmp_path / "mean.pt"
    assert main(["average", *files, "--output", str(out)]) == 0
    assert capsys.readouterr().out.strip() == str(out)
    policy = load_policy(out)
    means = sum(state["actor_state_dict"]["mlp.0.weight"] for state in states) / 2
    assert torch.allclose(policy.weights["mlp.0.weight"], means)
    assert torch.isfinite(policy.act(torch.randn(3, policy.num_observations))).all()
    assert main(["average", files[0], str(tmp_path / "none.pt")]) == 1
    assert "no policy at" in capsys.readouterr().err
