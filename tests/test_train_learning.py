"""The vectorised environment, the algorithm and the distribution, on an environment with known answers."""

import dataclasses
import math

import numpy as np
import pytest
import torch
import warp as wp
from train_dummy import SMALL_POLICY, SMALL_PPO, DummyEnv, make_runner

from vd.policy.actor import TrainedPolicy
from vd.train.distribution import BoundedStdGaussian
from vd.train.metrics import GoalWindow, StepMeans, read_progress
from vd.train.ppo import RUNAWAY_KL
from vd.train.vec_env import ReorientVecEnv

needs_gpu = pytest.mark.skipif(
    not torch.cuda.is_available(), reason="CUDA graphs and waits need a GPU"
)
NORMALISING = dataclasses.replace(SMALL_POLICY, normalise_observations=True)
TIGHTENING = dataclasses.replace(NORMALISING, std_range=(0.2, 1.0), quiet_std=0.05)


def _fixed_flags(env: ReorientVecEnv, success, fell, timed_out) -> None:
    """Make the dummy end its step with the given flags."""
    flags = {"success": success, "fell": fell, "timed_out": timed_out}

    def step(_action: wp.array) -> None:
        for name, values in flags.items():
            getattr(env.env, name).assign(np.array(values, dtype=np.int32))

    env.env.step = step


def test_success_is_done_and_a_pure_time_out_adds_the_discounted_value_of_what_was_seen(tmp_path):
    runner = make_runner(tmp_path, env=DummyEnv(num_envs=4))
    _fixed_flags(runner.env, success=[1, 0, 0, 1], fell=[0, 1, 0, 0], timed_out=[0, 0, 1, 1])
    observation = runner.env.get_observations()
    with torch.inference_mode():
        value = runner.alg.critic(observation).squeeze(1)
        actions = runner.alg.act(observation)
        observation, _, done, extras = runner.env.step(actions)
        reward = torch.tensor([1.0, 2.0, 3.0, 4.0])
        runner.alg.process_env_step(observation, reward, done, extras)
    expected = reward + runner.alg.gamma * value * torch.tensor([0.0, 0.0, 1.0, 0.0])
    assert torch.allclose(runner.alg.storage.rewards[0].squeeze(1), expected)
    assert runner.alg.storage.dones[0].flatten().tolist() == [1, 1, 1, 1]
    shares = {
        name: float(extras["log"][f"task/{name}"]) for name in ("reached", "dropped", "timed_out")
    }
    assert shares == {"reached": 0.5, "dropped": 0.25, "timed_out": 0.25}


@pytest.mark.parametrize("distribution", ["state-dependent", "gaussian"])
def test_learns_to_follow_the_target_on_a_gpu_by_a_graph(tmp_path, distribution, device):
    ppo = dataclasses.replace(SMALL_PPO, minibatch_size=128, cuda_graph=device != "cpu")
    policy = dataclasses.replace(SMALL_POLICY, distribution=distribution)
    env = DummyEnv(num_envs=64, device=device)
    runner = make_runner(tmp_path, env=env, ppo=ppo, policy=policy, device=device, save_every=100)
    runner.learn(25)
    rows = read_progress(tmp_path / "progress.jsonl")
    first, last = rows[0], rows[-1]
    assert last["reward/distance"] > 0.3 * first["reward/distance"]
    assert last["success_per_goal"] > 2 * first["success_per_goal"]
    assert last["action_std"] < first["action_std"]
    assert last["loss/value"] < 0.2 * first["loss/value"]


def test_an_update_that_runs_away_ends_with_its_epoch(tmp_path):
    kls = {}
    for schedule in ("adaptive", "fixed"):
        ppo = dataclasses.replace(
            SMALL_PPO, schedule=schedule, epochs=4, desired_kl=0.01, actor_learning_rate=0.05
        )
        runner = make_runner(tmp_path / schedule, ppo=ppo)
        step, kls[schedule] = runner.alg.minibatch_step, []

        def kept(rows, step=step, kls=kls[schedule]):
            kls.append(step(rows))
            return kls[-1]

        runner.alg.minibatch_step = kept
        runner.learn(1)
        row = read_progress(tmp_path / schedule / "progress.jsonl")[-1]
        kls[schedule] = [float(statistics[3]) for statistics in kls[schedule]]
        assert row["loss/kl"] == pytest.approx(np.mean(kls[schedule]), rel=1e-5)
    share = len(kls["fixed"]) // 4
    epochs = [
        np.mean(kls["adaptive"][i : i + share]) for i in range(0, len(kls["adaptive"]), share)
    ]
    assert len(kls["adaptive"]) == share * len(epochs) < len(kls["fixed"])
    assert epochs[-1] > RUNAWAY_KL * 0.01 >= max(epochs[:-1], default=0.0)


def test_gradient_is_clipped_by_the_joint_norm(tmp_path):
    ppo = dataclasses.replace(SMALL_PPO, grad_norm=1e-3, value_coefficient=100.0)
    runner = make_runner(tmp_path, ppo=ppo)
    norms = []

    def record(*_args) -> None:
        parameters = [*runner.alg.actor.parameters(), *runner.alg.critic.parameters()]
        norms.append(math.sqrt(sum(float(p.grad.square().sum()) for p in parameters)))

    runner.alg.optimizer.register_step_pre_hook(record)
    runner.learn(1)
    assert norms == pytest.approx([1e-3] * len(norms), rel=1e-2)


def test_means_beyond_the_bound_come_back_only_with_their_loss(tmp_path):
    beyond = {}
    for coefficient in (0.0, 0.1):
        ppo = dataclasses.replace(
            SMALL_PPO, bound_coefficient=coefficient, actor_learning_rate=1e-2
        )
        runner = make_runner(tmp_path / str(coefficient), ppo=ppo)
        # Flat advantages leave the surrogate without a gradient in the mean: the loss alone moves
        # it.
        with torch.no_grad():
            runner.alg.actor.mlp[-2].bias[: runner.env.num_actions] = 3.0
        with torch.inference_mode():
            observation = runner.env.get_observations()
            for _ in range(8):
                action = runner.alg.act(observation)
                observation, reward, done, extras = runner.env.step(action)
                runner.alg.process_env_step(observation, reward, done, extras)
            runner.alg.compute_returns(observation)
        storage = runner.alg.storage
        storage.advantages = torch.zeros_like(storage.advantages)
        first = runner.alg.update()["beyond_bound"]
        mean = runner.alg.actor(runner.env.get_observations())
        beyond[coefficient] = (first, float(mean.detach().mean()))
    assert beyond[0.0][0] == 1.0 and beyond[0.0][1] == pytest.approx(3.0, abs=0.5)
    assert beyond[0.1][1] < 2.8 < beyond[0.0][1]


def test_every_sample_is_used_once_an_epoch_in_a_new_order(tmp_path):
    alg = _after_a_rollout(make_runner(tmp_path, ppo=dataclasses.replace(SMALL_PPO, epochs=2))).alg
    epochs = torch.cat(list(alg.minibatches())).view(2, -1)
    assert all(torch.equal(epoch.sort().values, torch.arange(128)) for epoch in epochs)
    assert not torch.equal(*epochs)
    assert torch.equal(alg.samples["log_prob"], alg.storage.actions_log_prob.flatten())


def test_state_dependent_std_starts_as_asked_and_keeps_a_gradient_at_the_bounds():
    distribution = BoundedStdGaussian(3, init_std=0.5, std_range=(0.02, 1.0))
    head = torch.nn.Linear(4, 6)
    distribution.init_mlp_weights(torch.nn.Sequential(head, torch.nn.Unflatten(-1, [2, 3])))
    distribution.update(head(torch.randn(7, 4)).view(7, 2, 3))
    assert torch.allclose(distribution.std, torch.full((7, 3), 0.5), atol=1e-5)
    raw = torch.tensor([[[0.0, 0.0, 0.0], [-8.0, 0.0, 8.0]]], requires_grad=True)
    distribution.update(raw)
    std = distribution.std[0].detach()
    assert ((std > 0.02) & (std < 1.0)).all() and (std.diff() > 0).all()
    distribution.std.sum().backward()
    assert (raw.grad[0, 1].abs() > 0).all()


def test_step_means_and_window_ratios():
    means = StepMeans()
    for value in (1.0, 3.0):
        means.add({"a": torch.tensor(value), "b": torch.tensor(-value)})
    assert means.read() == {"a": 2.0, "b": -2.0}
    window = GoalWindow(2)
    row = {"task/reached": 0.0, "task/dropped": 0.0, "task/timed_out": 0.0, "reward/total": 1.0}
    assert window.add(row)["success_per_goal"] is None
    result = window.add(
        row | {"task/reached": 0.3, "task/dropped": 0.1, "task/timed_out": 0.2, "reward/total": 3.0}
    )
    assert result["success_per_goal"] == pytest.approx(0.5)
    assert result["goals_per_episode"] == pytest.approx(1.0)
    assert result["drop_rate"] == pytest.approx(1 / 3)
    assert result["mean_reward"] == 2.0
    # The third iteration pushes the first out.
    assert window.add(row | {"task/timed_out": 0.6})["success_per_goal"] == pytest.approx(0.25)


@pytest.mark.parametrize("distribution", ["state-dependent", "gaussian"])
@pytest.mark.parametrize("normalise", [False, True])
def test_policy_equals_the_actor_it_came_from(tmp_path, distribution, normalise):
    policy = dataclasses.replace(
        SMALL_POLICY, distribution=distribution, normalise_observations=normalise
    )
    runner = make_runner(tmp_path, policy=policy)
    runner.learn(3)
    from vd.policy.bundle import read_policy

    observation = runner.env.get_observations()
    wanted = runner.alg.get_policy()(observation)
    for file in (tmp_path / "checkpoints" / "model_0000003.pt", tmp_path / "policy.safetensors"):
        loaded = read_policy(file)
        assert isinstance(loaded, TrainedPolicy)
        assert torch.allclose(loaded.act(observation["policy"]), wanted, atol=1e-6)
        assert loaded.hand == "dummy" and loaded.contract.iterations == 3


def _after_a_rollout(runner):
    """The runner with a rollout whose samples lie where minibatches are gathered from."""
    observation = runner.env.get_observations()
    with torch.inference_mode():
        for _ in range(8):
            observation, reward, done, extras = runner.env.step(runner.alg.act(observation))
            runner.alg.process_env_step(observation, reward, done, extras)
        runner.alg.compute_returns(observation)
    runner.alg.take_samples()
    return runner


def test_what_gradients_are_computed_from_stays_where_it_is_in_memory(tmp_path):
    """A recorded graph reads the addresses of the recording, whatever an attribute has become since."""

    def read(alg) -> dict[str, int]:
        tensors = dict(alg.samples) | {"rows": alg._rows}
        for name, network in (("actor", alg.actor), ("critic", alg.critic)):
            tensors |= {f"{name}.{key}": tensor for key, tensor in network.named_parameters()}
            tensors |= {f"{name}.{key}": tensor for key, tensor in network.named_buffers()}
        return {name: tensor.data_ptr() for name, tensor in tensors.items()}

    runner = make_runner(tmp_path, policy=TIGHTENING, save_every=1)
    runner.learn(1)
    before = read(runner.alg)
    assert {
        "advantages",
        "old 1",
        "actor.obs_normalizer._std",
        "actor.distribution.log_floor",
    } <= set(before)
    std = runner.alg.actor.obs_normalizer._std.clone()
    runner.learn(2)
    runner.load(str(tmp_path / "checkpoints" / "model_0000002.pt"))
    runner.learn(1)
    assert read(runner.alg) == before
    normaliser = runner.alg.actor.obs_normalizer
    assert not torch.equal(normaliser._std, std)
    assert torch.allclose(normaliser._std, normaliser._var.sqrt())


@needs_gpu
def test_a_recorded_graph_gives_the_gradients_of_every_minibatch(tmp_path):
    graphed = dataclasses.replace(SMALL_PPO, cuda_graph=True)
    plain, recorded = (
        _after_a_rollout(make_runner(tmp_path, ppo=ppo, policy=TIGHTENING, device="cuda:0")).alg
        for ppo in (SMALL_PPO, graphed)
    )
    assert torch.equal(plain.samples["actions"], recorded.samples["actions"])
    for rows in (
        *torch.randperm(128, device="cuda:0").split(64),
        torch.arange(64, device="cuda:0"),
    ):
        for alg in (plain, recorded):
            alg.actor.distribution.set_floor(0.1)
        statistics = [alg.minibatch_step(rows) for alg in (plain, recorded)]
        assert torch.allclose(*statistics, rtol=1e-4, atol=1e-5)
        for one, two in zip(plain._parameters, recorded._parameters, strict=True):
            assert torch.allclose(one.grad, two.grad, rtol=1e-3, atol=1e-5)
            with torch.no_grad():  # rounding must not add up
                two.copy_(one)
