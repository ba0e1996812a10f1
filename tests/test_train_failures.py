"""Objects by failure: what samples weigh, and what of it learning sees."""

import dataclasses

import numpy as np
import pytest
import torch
from train_dummy import SMALL_PPO, DummyEnv, make_runner

from vd.train.failures import ObjectFailures


def test_samples_weigh_by_the_share_of_goals_that_are_missed_with_their_object():
    objects = np.array([0, 0, 1, 1, 1])
    failures = ObjectFailures(objects, 0.1, "cpu")
    assert failures.weights() == pytest.approx(torch.ones(5))
    for _ in range(2000):  # the second object is reached twice in three
        failures.add(torch.ones(5), torch.tensor([1, 1, 1, 1, 0]))
        failures.end_iteration(1)
    assert failures.success() == pytest.approx(torch.tensor([1.0, 2.0 / 3.0]), abs=1e-2)
    weights = failures.weights()
    assert weights.mean() == pytest.approx(1.0)
    assert weights[2] / weights[0] == pytest.approx((1.0 / 3.0 + 0.1) / 0.1, rel=0.05)
    again = ObjectFailures(objects, 0.1, "cpu")
    again.load_state_dict(failures.state_dict())
    assert torch.equal(again.weights(), weights)


def test_what_weighs_nothing_teaches_nothing(tmp_path):
    """The gradient of weighted samples is that of those that weigh something alone."""
    gradients = []
    for kept in (slice(None), slice(0, 8)):
        runner = make_runner(tmp_path / str(kept.stop), env=DummyEnv(num_envs=16))
        runner._begin()
        runner._collect()
        alg = runner.alg
        alg.weights = torch.zeros(16)
        alg.weights[:8] = 2.0 if kept.stop is None else 1.0
        alg.take_samples()
        rows = torch.arange(len(alg.samples["weights"])).view(-1, 16)[:, kept].flatten()
        alg._rows = rows
        alg.entropy_coef = alg.bound_coef = 0.0
        alg.optimizer.zero_grad()
        alg._compute_gradients()
        gradients.append([p.grad.clone() for p in alg._parameters if p.grad is not None])
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other)


def test_a_run_counts_weighs_and_keeps(tmp_path):
    ppo = dataclasses.replace(SMALL_PPO, failure_floor=0.2)
    env = DummyEnv(num_envs=16)
    env.world_object = np.arange(16) // 8
    runner = make_runner(tmp_path, env=env, ppo=ppo)
    runner.learn(3)
    assert not torch.equal(runner.alg.weights, torch.ones(16))
    other = DummyEnv(num_envs=16)
    other.world_object = env.world_object
    resumed = make_runner(tmp_path, env=other, ppo=ppo)
    resumed.load(tmp_path / "checkpoints" / "model_0000003.pt")
    assert torch.equal(resumed.failures.weights(), runner.failures.weights())
