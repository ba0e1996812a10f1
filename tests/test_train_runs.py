"""How runs end and go on: checkpoints, resuming, signals, limits, divergence."""

import dataclasses
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from train_dummy import SMALL_POLICY, SMALL_PPO, DummyEnv, make_runner

from vd.envs.curriculum import Levels
from vd.policy.bundle import read_policy
from vd.train.checkpoint import find_checkpoint, list_checkpoints, load_checkpoint
from vd.train.loop import Interrupted, TrainingDivergedError
from vd.train.metrics import GoalWindow, read_progress

TIMING = ("elapsed_s", "steps_per_s", "collect_s", "learn_s")


def _weights(runner) -> dict[str, torch.Tensor]:
    saved = runner.alg.save()
    return saved["actor_state_dict"] | {
        f"critic.{k}": v for k, v in saved["critic_state_dict"].items()
    }


def _rows(folder: Path) -> list[dict]:
    return [
        {k: v for k, v in row.items() if k not in TIMING}
        for row in read_progress(folder / "progress.jsonl")
    ]


@pytest.mark.parametrize("schedule", ["fixed", "adaptive"])
def test_three_and_three_more_equal_six(tmp_path, schedule):
    ppo = dataclasses.replace(SMALL_PPO, schedule=schedule)
    whole = make_runner(tmp_path / "whole", ppo=ppo)
    whole.learn(6)

    part = tmp_path / "part"
    make_runner(part, ppo=ppo).learn(3)
    resumed = make_runner(part, ppo=ppo, env=DummyEnv(num_envs=16, seed=99), seed=99)
    resumed.load(str(find_checkpoint(part, "latest")))
    assert resumed.iteration == 3 and resumed.new_episodes == ""
    resumed.learn(3)

    one, two = _weights(whole), _weights(resumed)
    assert all(torch.equal(one[name], two[name]) for name in one)
    assert _rows(tmp_path / "whole") == _rows(part)
    assert [row["iteration"] for row in _rows(part)] == [1, 2, 3, 4, 5, 6]
    assert resumed.env_steps == whole.env_steps
    assert resumed.alg.learning_rate == whole.alg.learning_rate
    assert resumed.env.env.levels == whole.env.env.levels


def test_keeps_the_last_and_the_best_since_two_episodes_are_over(tmp_path):
    runner = make_runner(tmp_path, save_every=1)
    runner.window = GoalWindow(2)
    runner.learn(1)
    assert load_checkpoint(find_checkpoint(tmp_path, "best"))["iter"] == 1, (
        "before, it is the latest"
    )
    runner.learn(5)
    assert [p.name for p in list_checkpoints(tmp_path)] == [
        f"model_000000{i}.pt" for i in (4, 5, 6)
    ]
    best = load_checkpoint(find_checkpoint(tmp_path, "best"))
    scores = [
        (0.5 * (row["level/goals"] + 1.0), row["success_per_goal"] or 0.0, row["mean_reward"])
        for row in _rows(tmp_path)
    ]
    assert best["iter"] == 2 + scores[1:].index(max(scores[1:]))
    policy = read_policy(tmp_path / "policy.safetensors")
    assert policy.contract.iterations == best["iter"]
    with pytest.raises(ValueError, match=r"trained on observations \[N, 5\]"):
        policy.act(torch.zeros(3, 6))
    with pytest.raises(FileExistsError, match="add --resume"):
        find_checkpoint(tmp_path, None)
    for path in list_checkpoints(tmp_path):
        path.rename(path.with_name(f"{path.name}.damaged"))
    found = find_checkpoint(tmp_path, "latest")
    assert found == find_checkpoint(tmp_path, "auto") == find_checkpoint(tmp_path, "best")
    other = make_runner(tmp_path / "other", policy=dataclasses.replace(SMALL_POLICY, hidden=(8,)))
    with pytest.raises(ValueError, match="does not fit"):
        other.load(str(found))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_and_the_run_goes_on(tmp_path, number):
    env = DummyEnv(num_envs=16)
    runner = make_runner(tmp_path, env=env, save_every=100)
    step, handler = env.step, signal.getsignal(number)

    def interrupting(action) -> None:
        step(action)
        if env.steps == 20:  # in the middle of the third rollout of 8 steps
            os.kill(os.getpid(), number)

    env.step = interrupting
    with pytest.raises(Interrupted):
        runner.learn(10)
    assert signal.getsignal(number) == handler
    assert env.steps == 20, "the rollout was not cut short"
    assert find_checkpoint(tmp_path, "latest").name == "model_0000002.pt"
    resumed = make_runner(tmp_path)
    resumed.load(str(find_checkpoint(tmp_path, "latest")))
    resumed.learn(1)
    assert [row["iteration"] for row in _rows(tmp_path)] == [1, 2, 3]


def test_limits_of_steps_and_time(tmp_path):
    # 16 environments x 8 steps = 128 an iteration.
    runner = make_runner(tmp_path / "steps", max_steps=300)
    runner.learn()
    assert runner.iteration == 3 and runner.env_steps == 384
    timed = make_runner(tmp_path / "time", max_minutes=1e-6, save_every=100)
    timed.learn(50)
    assert timed.iteration == 1
    assert find_checkpoint(tmp_path / "time", "latest").name == "model_0000001.pt"


def test_compiling_does_not_count_as_training(tmp_path, monkeypatch):
    """Kernels compile until the first iteration ends, however long that takes."""
    env, now = DummyEnv(num_envs=16), [0.0]
    monkeypatch.setattr("vd.train.loop.time.monotonic", lambda: now[0])
    step = env.step

    def slow(action) -> None:
        step(action)
        now[0] += 600.0 if env.steps == 1 else 1.0

    env.step = slow
    runner = make_runner(tmp_path, env=env, max_minutes=0.5)
    runner.learn(50)
    assert runner.iteration == 5, "of 8 s each, until 30 s have passed since the first"


@pytest.mark.parametrize("where", ["observation", "reward"])
def test_nan_from_the_simulation_stops_and_is_not_saved(tmp_path, where):
    env = DummyEnv(num_envs=16)
    runner = make_runner(tmp_path, env=env, save_every=1)
    step = env.step

    def poisoned(action) -> None:
        step(action)
        if env.steps == 12:
            values = getattr(env, where).numpy().copy()
            values[3] = np.nan
            getattr(env, where).assign(values)

    env.step = poisoned
    with pytest.raises(TrainingDivergedError, match=r"iteration 2: .*finite.*--resume"):
        runner.learn(5)
    assert find_checkpoint(tmp_path, "latest").name == "model_0000001.pt"


def test_nan_in_the_networks_stops_with_what_to_change(tmp_path):
    runner = make_runner(tmp_path)
    update = runner.alg.update

    def broken() -> dict[str, float]:
        losses = update()
        with torch.no_grad():
            next(runner.alg.actor.parameters())[0, 0] = float("inf")
        return losses

    runner.alg.update = broken
    with pytest.raises(TrainingDivergedError, match=r"parameters.*--ppo\.actor-learning-rate"):
        runner.learn(1)


def test_values_that_are_not_finite_become_null_and_a_torn_line_is_skipped(tmp_path):
    from vd.train.metrics import ProgressFile

    log = ProgressFile(tmp_path, logger="none")
    log.write({"iteration": 1, "value": float("nan")})
    log.close()
    path = tmp_path / "progress.jsonl"
    path.write_text(path.read_text() + '{"iteration": 2, "va')
    assert read_progress(path) == [{"iteration": 1, "value": None}]
    path.write_text('{"iteration": 2, "va\n{"iteration": 3}\n')
    with pytest.raises(ValueError, match="line 1"):
        read_progress(path)


def test_tensorboard_files_hold_the_curve(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    make_runner(tmp_path, logger="tensorboard").learn(2)
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [e.step for e in events.Scalars("task/rotation_error")] == [1, 2]
    assert "run/success_per_goal" in events.Tags()["scalars"]


def test_the_floor_of_the_std_falls_as_stillness_tightens(tmp_path):
    policy = dataclasses.replace(SMALL_POLICY, std_range=(0.2, 1.0), quiet_std=0.05)
    env = DummyEnv(num_envs=16)
    runner = make_runner(tmp_path, env=env, policy=policy)
    observation = torch.randn(50, env.num_observations)
    seen = []
    for tightness in (0.0, 0.5, 1.0):
        env.levels = Levels(1.0, tightness)
        runner.learn(1)
        with torch.no_grad():  # an output that asks for as little noise as there can be
            runner.alg.actor.mlp[-2].bias[2:] = -50.0
        seen.append(_outputs(runner, observation)[1])
    for std, floor in zip(seen, (0.2, 0.1, 0.05), strict=True):
        assert torch.allclose(std, torch.full_like(std, floor), rtol=1e-4)

    again = make_runner(tmp_path, env=DummyEnv(num_envs=16), policy=policy)
    again.env.env.levels = Levels(1.0, 0.5)
    again.learn(1)
    assert float(again.alg.actor.distribution.log_floor) == pytest.approx(np.log(0.1))


def test_the_best_is_the_tightest_before_the_most_successful(tmp_path):
    env = DummyEnv(num_envs=16)
    runner = make_runner(tmp_path, env=env, save_every=1)
    runner.window = GoalWindow(1)
    scores = []
    for tightness in (0.0, 0.5, 0.25):
        env.levels = Levels(1.0, tightness)
        runner.learn(1)
        scores.append(runner._score)
    assert [score[0] for score in scores] == [0.5, 0.75, 0.625]
    assert load_checkpoint(find_checkpoint(tmp_path, "best"))["iter"] == 2


def _outputs(runner, observation: torch.Tensor) -> list[torch.Tensor]:
    """Means, standard deviations and values."""
    from tensordict import TensorDict

    seen = TensorDict({"policy": observation}, batch_size=[len(observation)])
    with torch.inference_mode():
        runner.alg.actor(seen, stochastic_output=True)
        policy = runner.alg.get_policy()
        return [policy.output_mean.clone(), policy.output_std.clone(), runner.alg.critic(seen)]


def test_a_new_run_can_begin_from_anothers_checkpoint_at_its_own_rates(tmp_path):
    adaptive = dataclasses.replace(SMALL_PPO, schedule="adaptive", desired_kl=1e-4)
    first = make_runner(tmp_path / "first", ppo=adaptive, save_every=1)
    first.window = GoalWindow(1)
    first.learn(3)
    checkpoint = find_checkpoint(tmp_path / "first", "latest")
    assert load_checkpoint(checkpoint)["best"] is not None
    assert first.alg.learning_rate < adaptive.actor_learning_rate, "the rate has to have moved"
    wanted = dataclasses.replace(SMALL_PPO, actor_learning_rate=7e-4, critic_learning_rate=8e-4)
    second = make_runner(tmp_path / "second", env=DummyEnv(num_envs=16, seed=7), seed=7, ppo=wanted)
    second.begin_from(str(checkpoint))
    assert second.begun and second.alg.learning_rate == 7e-4
    assert [group["lr"] for group in second.alg.optimizer.param_groups] == [7e-4, 8e-4]
    one, two = _weights(first), _weights(second)
    assert all(torch.equal(one[name], two[name]) for name in one)
    assert not second.env.env.step_count.numpy().any()
    assert second._best is None and not second.window.full, (
        "another run's rates would decide which is best"
    )
    second.learn(1)
    assert [row["iteration"] for row in _rows(tmp_path / "second")] == [4]
    with pytest.raises(ValueError, match="nothing can resume; --init"):
        second.load(str(tmp_path / "first" / "policy.safetensors"))
    second.load(str(checkpoint))
    assert second.alg.learning_rate == first.alg.learning_rate, (
        "a resumed run goes on with those it had"
    )


def test_a_run_goes_on_with_another_number_of_worlds_to_the_same_steps(tmp_path):
    make_runner(tmp_path).learn(3)  # 16 environments x 8 steps = 128 an iteration
    resumed = make_runner(tmp_path, env=DummyEnv(num_envs=8), max_steps=600)
    resumed.load(str(find_checkpoint(tmp_path, "latest")))
    assert "16 environments" in resumed.new_episodes
    assert resumed.total_iterations == 3 + 4  # 600 - 384 steps, 64 an iteration
    resumed.learn()
    assert _rows(tmp_path)[-1]["env_steps"] == 384 + 4 * 64
