"""The environment as Gymnasium's vector environment.

Its own checks, and the three ways to reset.
"""

import itertools

import numpy as np
import pytest
import torch

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils import env_checker, passive_env_checker  # noqa: E402
from gymnasium.wrappers.vector import RecordEpisodeStatistics  # noqa: E402


class OnHost(gymnasium.vector.VectorWrapper):
    """NumPy arrays of torch tensors: Gymnasium's checks know no others."""

    def reset(self, *, seed=None, options=None):
        """NumPy arrays."""
        return host(self.env.reset(seed=seed, options=options))

    def step(self, actions):
        """NumPy arrays."""
        return host(self.env.step(actions))


def host(value):
    if isinstance(value, dict):
        return {key: host(item) for key, item in value.items()}
    return value.numpy() if isinstance(value, torch.Tensor) else tuple(map(host, value))


@pytest.mark.parametrize("mode", ["SameStep", "NextStep", "Disabled"])
def test_gymnasium_finds_no_fault_and_episodes_end_as_the_mode_says(mode):
    task = {"hand": "dclaw3", "episode_s": 0.5, "device": "cpu"}
    env = gymnasium.make_vec("vd.gym:VisualDexterity-v0", 3, autoreset_mode=mode, **task)
    on_host = OnHost(env)
    env_checker.check_reset_return_type(on_host)
    env_checker.check_reset_seed_determinism(on_host)
    env_checker.check_action_space(env.action_space)
    env_checker.check_observation_space(env.observation_space)
    watched = RecordEpisodeStatistics(on_host)
    calls, ended = [watched.reset(seed=3)], []
    for step in range(1, 14):
        seen, reward, terminated, truncated, info = watched.step(env.action_space.sample())
        calls.append((seen, info))
        begins = (env.env.step_count.numpy() == 0).all()
        assert truncated.all() == truncated.any() and not terminated.any()
        if truncated.all():
            ended.append(step)
            assert info["episode"]["l"].tolist() == [6, 6, 6] and begins == (mode == "SameStep")
            assert mode != "SameStep" or not np.allclose(info["final_obs"], seen)
        else:
            assert begins == (mode == "NextStep" and step - 1 in ended) == (not reward.any())
        if mode == "Disabled" and truncated.all():
            watched.reset(options={"reset_mask": np.array([True, False, True])})
            assert env.env.step_count.numpy().tolist() == [0, 6, 0]
            watched.reset(options={"reset_mask": np.array([False, True, False])})
    assert ended == ([6, 13] if mode == "NextStep" else [6, 12])
    shared = passive_env_checker.data_shares_objects
    assert not any(shared(one, two) for one, two in itertools.pairwise(calls))


def test_widths_masks_devices_and_settings_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match=r"sucess; .*success\?"):
        gymnasium.make_vec("vd.gym:VisualDexterity-v0", 2, device="cpu", reward={"sucess": 1.0})
    with pytest.raises(ValueError, match=r"'cuda:99'; .*cpu"):
        gymnasium.make_vec("vd.gym:VisualDexterity-v0", 2, device="cuda:99")
    env = gymnasium.make_vec("vd.gym:VisualDexterity-v0", 2, device="auto", hand="dclaw3")
    with pytest.raises(ValueError, match=r"\(9,\), not \(2, 9\)"):
        env.step(np.zeros(9))
    with pytest.raises(ValueError, match=r"torch.int64 \(2,\); give booleans"):
        env.reset(options={"reset_mask": np.array([0, 1])})
    with pytest.raises(ValueError, match=r"\(2, 9\) of wp.from_torch"):
        env.unwrapped.env.step(torch.zeros(2, 9))
    with pytest.raises(ValueError, match="not finite"):
        env.step(np.full((2, 9), np.nan))
    env.close()
    with pytest.raises(gymnasium.error.ClosedEnvironmentError, match="after close"):
        env.step(np.zeros((2, 9)))


def test_a_single_environment_is_refused_by_the_name_of_what_makes_them():
    with pytest.raises(gymnasium.error.Error, match=r'make_vec\("vd\.gym:VisualDexterity-v0"'):
        gymnasium.make("vd.gym:VisualDexterity-v0")
