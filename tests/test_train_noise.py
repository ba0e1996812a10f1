"""The noise scale of the policy gradient, on gradients whose signal and noise are known."""

import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from train_dummy import make_runner

from vd.train.cli import main
from vd.train.noise import NoiseCfg, Rollout, advantages, compare, gradient_noise, group_gradients, record


def gradients(seed: int, *, groups: int, size: int, signal: float, noise: float) -> torch.Tensor:
    """Gradients of groups: a mean of square ``signal`` and an independent part of square ``noise`` each."""
    generator = torch.Generator().manual_seed(seed)
    mean = torch.randn(size, generator=generator)
    parts = torch.randn(groups, size, generator=generator)
    return math.sqrt(signal) * mean / mean.norm() + math.sqrt(noise / size) * parts


@pytest.mark.parametrize("seed", range(3))
def test_signal_and_noise_are_told_apart(seed):
    group = gradients(seed, groups=64, size=2000, signal=0.5, noise=20.0)
    (row,) = compare(group[None], [1.0], 1.0, group_samples=1000)
    assert abs(row.signal.value - 0.5) < 4.0 * row.signal.error < 0.5
    assert row.noise == pytest.approx(1000 * 20.0, rel=0.05)
    assert row.noise_scale == pytest.approx(40_000, rel=0.35)
    assert row.progress.value == pytest.approx(1.0) and row.progress.error < 1e-9


def test_a_gradient_of_noise_alone_has_no_scale():
    found = [
        compare(gradients(s, groups=32, size=500, signal=0.0, noise=20.0)[None], [1.0], 1.0, 100)[0]
        for s in range(20)
    ]
    # Two standard errors by chance: one in forty.
    assert sum(math.isinf(row.noise_scale) for row in found) >= 17
    assert abs(np.mean([row.signal.value for row in found])) < 0.1


def test_less_noise_is_progress_and_another_direction_is_none():
    noisy = gradients(0, groups=64, size=3000, signal=1.0, noise=16.0)
    quiet = gradients(0, groups=64, size=3000, signal=1.0, noise=4.0)
    elsewhere = gradients(1, groups=64, size=3000, signal=1.0, noise=16.0)
    rows = compare(torch.stack((elsewhere, quiet, noisy)), [0.5, 0.9, 1.0], 1.0, 10)
    assert abs(rows[1].progress.value - 2.0) < 4.0 * rows[1].progress.error < 0.5
    assert abs(rows[0].progress.value) < 4.0 * rows[0].progress.error < 0.5


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    steps=st.integers(1, 12),
    gamma=st.floats(0.5, 1.0),
    gae_lambda=st.floats(0.0, 1.0),
)
def test_advantages_are_the_sums_of_their_definition(seed, steps, gamma, gae_lambda):
    rng = np.random.default_rng(seed)
    rewards, values = rng.normal(size=(steps, 3)), rng.normal(size=(steps + 1, 3))
    dones = (rng.random((steps, 3)) < 0.2).astype(int)
    expected = np.zeros((steps, 3))
    for world in range(3):
        for first in range(steps):
            weight = 1.0
            for step in range(first, steps):
                after = 0.0 if dones[step, world] else gamma * values[step + 1, world]
                expected[first, world] += weight * (rewards[step, world] + after - values[step, world])
                if dones[step, world]:
                    break
                weight *= gamma * gae_lambda
    tensors = (torch.from_numpy(a) for a in (rewards, dones, values))
    empty = torch.empty(0)
    found = advantages(Rollout(empty, empty, *tensors), gamma, gae_lambda)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-10)


def test_a_record_pairs_what_was_seen_done_and_earned(tmp_path):
    runner = make_runner(tmp_path)
    runner.alg.train_mode()
    rollout = record(runner, 40)
    worlds = runner.env.num_envs
    assert rollout.observations.shape[:2] == rollout.actions.shape[:2] == (40, worlds)
    assert rollout.values.shape == (41, worlds)
    # The dummy's reward is minus the squared distance to a target that stands in the observation, and 1 where
    # the distance is small; a step that timed out has the value of its state besides, discounted.
    distance = (rollout.actions - rollout.observations[..., :2]).square().sum(dim=-1)
    extra = rollout.rewards + distance - (distance.sqrt() < runner.env.env.reach).float()
    bonus = runner.ppo.gamma * rollout.values[:-1]
    timed_out = extra.abs() > 1e-5
    assert timed_out.any() and (rollout.dones[timed_out] == 1).all()
    assert torch.allclose(extra[timed_out], bonus[timed_out], atol=1e-5)


def test_gradients_of_groups_add_up_to_that_of_all(tmp_path):
    runner = make_runner(tmp_path)
    runner.alg.train_mode()
    rollout = record(runner, 12)
    weight = advantages(rollout, 0.9, 0.8)[:9]
    found = group_gradients(runner, rollout, [weight, 2.0 * weight], runner.env.num_envs // 2)
    actor = runner.alg.actor
    observed = {"policy": rollout.observations[:9].flatten(0, 1)}
    actor(torch_dict(observed), stochastic_output=True)
    log_prob = actor.get_output_log_prob(rollout.actions[:9].flatten(0, 1))
    whole = torch.autograd.grad((weight.flatten() * log_prob).mean(), list(actor.parameters()))
    expected = torch.cat([g.flatten() for g in whole])
    assert torch.allclose(found[0].mean(dim=0), expected, rtol=1e-4, atol=1e-5)
    assert torch.allclose(found[1], 2.0 * found[0], rtol=1e-4, atol=1e-5)


def torch_dict(tensors):
    from tensordict import TensorDict

    return TensorDict(tensors, batch_size=[len(next(iter(tensors.values())))])


def test_measuring_leaves_the_policy_as_it_is(tmp_path):
    runner = make_runner(tmp_path)
    before = [p.clone() for p in runner.alg.actor.parameters()]
    rows, samples = gradient_noise(runner, NoiseCfg(steps=12, groups=4, lambdas=(0.5,)))
    assert [row.gae_lambda for row in rows] == sorted({0.5, runner.ppo.gae_lambda, 1.0})
    assert samples == 8 * runner.env.num_envs
    assert all(torch.equal(p, b) for p, b in zip(runner.alg.actor.parameters(), before, strict=True))


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--groups", "3"], "a divisor of the 8 worlds"),
        (["--steps", "2"], "--steps is 2"),
        (["--lambdas", "1.5"], "--lambdas has 1.5"),
    ],
)
def test_what_cannot_be_measured_is_refused(flags, message, capsys):
    assert main(["noise", "--smoke", "--num-worlds", "8", *flags]) == 1
    assert message in capsys.readouterr().err


def test_the_command_prints_rows(capsys):
    flags = ["--num-worlds", "8", "--groups", "4", "--steps", "6", "--device", "cpu", "--json"]
    assert main(["noise", "--smoke", *flags]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["samples"] == 8 * 4
    assert [row["gae_lambda"] for row in report["rows"]] == [0.8, 0.9, 0.95, 0.98, 1.0]
    assert all(row["noise"] > 0.0 for row in report["rows"])
