"""How much of an update is signal: the noise scale of the policy gradient, by lambda of GAE.

Groups of worlds give independent estimates g_i of one gradient, each of b samples. Products of different
groups have no noise in common, so that their mean is the square of the true gradient without bias:

    signal = mean over i != j of g_i . g_j        noise = b (mean over i of g_i . g_i - signal)

``noise`` is the variance of the gradient of one sample. At ``noise / signal`` samples both are equal: the
simple noise scale (McCandlish et al. 2018, An Empirical Model of Large-Batch Training, eq. 2.8). Updates of
far fewer samples are mostly a random walk, on which the divergence they may make is spent.

A lambda below 1 has less noise and a bias. How much of the gradient of lambda 1, which has none, it sees for
its noise, ``g_lambda . g_1 / sqrt(noise)``, again from different groups, is the progress of a step of given
length.
"""

import dataclasses
import json
import math
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict
from tqdm import tqdm

from vd.train.config import NoiseCfg
from vd.train.progress import waiting
from vd.train.vec_env import OBSERVATION_GROUP

if TYPE_CHECKING:
    from vd.train.presets import TeacherCfg
    from vd.train.runner import TeacherRunner

REFRESH_S = 2.0
"""Seconds between two pictures of the progress."""
CHUNK = 32768
"""Samples that pass through the actor at a time (ours)."""
TOLD = 2.0
"""Standard errors above 0 from which a signal counts as told from it: 19 times in 20 (ours)."""


@dataclass(frozen=True)
class Rollout:
    """What a policy did and met, T steps in N worlds."""

    observations: torch.Tensor
    """What the actor read, shape [T, N, O]."""
    actions: torch.Tensor
    """What it drew, shape [T, N, D]."""
    rewards: torch.Tensor
    """Rewards, with the value of a step that timed out added as in training, shape [T, N]."""
    dones: torch.Tensor
    """1 where the return ends, shape [T, N]."""
    values: torch.Tensor
    """Of the critic, the state after the last step included, shape [T + 1, N]."""


@dataclass(frozen=True)
class Estimate:
    """A number and its standard error, from leaving out one group at a time (jackknife)."""

    value: float
    error: float


@dataclass(frozen=True)
class NoiseRow:
    """The gradient of one GAE lambda; advantages have a standard deviation of 1."""

    gae_lambda: float
    signal: Estimate
    """Square of the gradient."""
    noise: float
    """Variance of the gradient of one sample, summed over the weights."""
    noise_scale: float
    """Samples at which noise and signal are equal; infinite where the signal is not told from 0."""
    progress: Estimate
    """Of a step of given length, by the gradient of lambda 1, relative to that of the learner's lambda."""


def record(runner: "TeacherRunner", steps: int) -> Rollout:
    """Let the policy act as in training, its curriculum at rest, and keep what happened.

    Worlds begin at random times of their episode, and one episode passes first.
    """
    env, alg, gamma = runner.env, runner.alg, runner.ppo.gamma
    env.episode_length_buf = torch.randint_like(env.episode_length_buf, high=int(env.max_episode_length))
    kept: dict[str, list[torch.Tensor]] = {
        name: [] for name in ("observations", "actions", "rewards", "dones", "values")
    }
    observation = env.get_observations()
    with torch.inference_mode():
        every = range(-int(env.max_episode_length), steps)
        for step in tqdm(every, desc="recording", unit="step", mininterval=REFRESH_S):
            actions = alg.act(observation).clone()
            values = alg.critic(observation).squeeze(-1)
            before = observation[OBSERVATION_GROUP]
            observation, rewards, dones, extras = env.step(actions)
            alg.transition.clear()
            if step >= 0:
                # rsl-rl's way with time-outs: the value of the state before the step (train/ppo.py).
                rewards = rewards + gamma * values * extras["time_outs"]
                for name, tensor in zip(kept, (before, actions, rewards, dones, values), strict=True):
                    kept[name].append(tensor)
        env.check()
        kept["values"].append(alg.critic(observation).squeeze(-1))
    return Rollout(**{name: torch.stack(tensors) for name, tensors in kept.items()})


def advantages(rollout: Rollout, gamma: float, gae_lambda: float) -> torch.Tensor:
    """Generalised advantage estimates, shape [T, N] (Schulman et al. 2016, eq. 16).

    rsl-rl's are written into its storage, which holds one update's steps and one lambda.
    """
    result, advantage = (
        torch.empty_like(rollout.rewards),
        torch.zeros_like(rollout.rewards[0]),
    )
    for step in reversed(range(len(result))):
        goes_on = 1.0 - rollout.dones[step].to(result)
        error = rollout.rewards[step] + gamma * goes_on * rollout.values[step + 1] - rollout.values[step]
        advantage = error + gamma * gae_lambda * goes_on * advantage
        result[step] = advantage
    return result


def group_gradients(
    runner: "TeacherRunner", rollout: Rollout, weights: Sequence[torch.Tensor], groups: int
) -> torch.Tensor:
    """Gradients of the mean of advantage times log-probability, the surrogate at the policy that acted.

    Args:
        runner: Whose actor it is.
        rollout: Its samples.
        weights: Advantages, each [S, N] of the first S steps.
        groups: Number of groups G, a divisor of N.

    Returns:
        Gradients by all of the actor's weights P, shape [len(weights), G, P], on the host.
    """
    actor = runner.alg.actor
    parameters = list(actor.parameters())
    size = weights[0].shape[1] // groups
    steps = weights[0].shape[0]
    chunk = max(1, CHUNK // size)
    result = torch.zeros(len(weights), groups, sum(p.numel() for p in parameters))
    for group in range(groups):
        worlds = slice(group * size, (group + 1) * size)
        for start in range(0, steps, chunk):
            rows = slice(start, min(steps, start + chunk))
            observed = rollout.observations[rows, worlds].flatten(0, 1)
            batch = TensorDict({OBSERVATION_GROUP: observed}, batch_size=[len(observed)])
            actor.distribution.update(actor.mlp(actor.get_latent(batch)))
            log_prob = actor.get_output_log_prob(rollout.actions[rows, worlds].flatten(0, 1))
            for index, weight in enumerate(weights):
                part = (weight[rows, worlds].flatten() * log_prob).sum() / (steps * size)
                gradient = torch.autograd.grad(part, parameters, retain_graph=True)
                result[index, group] += torch.cat([g.flatten() for g in gradient]).cpu()
    return result


def between_groups(products: torch.Tensor) -> float:
    """Mean of the products of different groups, from all of them, shape [G, G]."""
    count = len(products)
    return float((products.sum() - products.trace()) / (count * (count - 1)))


def jackknife(function: Callable[[torch.Tensor], float], groups: int) -> Estimate:
    """``function`` of the indices of the groups to use, and its standard error."""
    every = torch.arange(groups)
    without = torch.tensor([function(every[every != group]) for group in range(groups)], dtype=torch.float64)
    spread = (without - without.mean()).square().sum()
    return Estimate(function(every), math.sqrt((groups - 1) / groups * float(spread)))


def compare(
    gradients: torch.Tensor, lambdas: Sequence[float], base: float, group_samples: int
) -> list[NoiseRow]:
    """Signal, noise and progress of every lambda.

    Args:
        gradients: Shape [len(lambdas), G, P].
        lambdas: With 1, which has no bias, and ``base`` among them.
        base: The one that progress is relative to.
        group_samples: Samples b of a group.
    """
    unbiased = gradients[lambdas.index(1.0)].double()
    own, cross = [], []
    for one in gradients:  # one at a time: in double precision all take twice their memory
        one = one.double()
        own.append(one @ one.T)
        cross.append(one @ unbiased.T)

    def signal(index: int, groups: torch.Tensor) -> float:
        return between_groups(own[index][groups][:, groups])

    def noise(index: int, groups: torch.Tensor) -> float:
        return group_samples * (float(own[index].diagonal()[groups].mean()) - signal(index, groups))

    def seen(index: int, groups: torch.Tensor) -> float:
        return between_groups(cross[index][groups][:, groups]) / math.sqrt(noise(index, groups))

    every, rows, reference = torch.arange(gradients.shape[1]), [], lambdas.index(base)
    for index, gae_lambda in enumerate(lambdas):
        found = jackknife(lambda groups, i=index: signal(i, groups), len(every))  # type: ignore[misc]
        spread = noise(index, every)
        rows.append(
            NoiseRow(
                gae_lambda=gae_lambda,
                signal=found,
                noise=spread,
                noise_scale=spread / found.value if found.value > TOLD * found.error else math.inf,
                progress=jackknife(
                    lambda groups, i=index: seen(i, groups) / seen(reference, groups),  # type: ignore[misc]
                    len(every),
                ),
            )
        )
    return rows


def gradient_noise(runner: "TeacherRunner", cfg: NoiseCfg) -> tuple[list[NoiseRow], int]:
    """Measure; returns rows by rising lambda and the number of samples.

    The last third of the steps is left out: their returns are cut off, and the critic stands for the rest.
    """
    cfg.validate(runner.env.num_envs)
    runner.alg.train_mode()
    runner.set_std_floor()
    rollout = record(runner, cfg.steps)
    kept = cfg.steps - cfg.steps // 3
    lambdas = sorted({*cfg.lambdas, 1.0, runner.ppo.gae_lambda})
    weights = [advantages(rollout, runner.ppo.gamma, value)[:kept] for value in lambdas]
    weights = [(weight - weight.mean()) / weight.std() for weight in weights]
    gradients = group_gradients(runner, rollout, weights, cfg.groups)
    samples = weights[0].numel()
    return compare(gradients, lambdas, runner.ppo.gae_lambda, samples // cfg.groups), samples


def table(rows: Sequence[NoiseRow], samples: int, update: int) -> str:
    """What was found, for people."""
    lines = [
        f"{samples:,} samples; an update of this learner has {update:,}",
        f"{'lambda':>8}{'signal':>22}{'noise scale':>14}{'signal in an update':>22}{'progress':>18}",
    ]
    for row in rows:
        told = math.isfinite(row.noise_scale)
        share = update / (update + row.noise_scale) if told else 0.0
        lines.append(
            f"{row.gae_lambda:8g}{row.signal.value:12.3g} +- {row.signal.error:6.2g}"
            f"{f'{row.noise_scale / 1e6:.3g} M' if told else 'not told':>14}"
            f"{f'{share:.1%}' if told else 'not told from 0':>22}"
            f"{row.progress.value:10.2f} +- {row.progress.error:.2f}"
        )
    return "\n".join(lines)


def print_noise(
    cfg: NoiseCfg, teacher: "TeacherCfg", build: Callable[["TeacherCfg"], "TeacherRunner"]
) -> None:
    """Measure and print for ``vd-train noise``.

    Args:
        cfg: What to measure.
        teacher: The run that it is about; its folder is left alone.
        build: What makes a runner of it.
    """
    cfg.validate(teacher.env.num_worlds)
    with tempfile.TemporaryDirectory() as folder:
        teacher = dataclasses.replace(teacher, run=dataclasses.replace(teacher.run, run_dir=Path(folder)))
        with waiting("building the worlds (the first start compiles the kernels: minutes)", not cfg.json):
            runner = build(teacher)
        rows, samples = gradient_noise(runner, cfg)
        runner.env.close()
    if cfg.json:
        json.dump(
            {"samples": samples, "rows": [dataclasses.asdict(row) for row in rows]}, sys.stdout, indent=1
        )
        print()
    else:
        print(table(rows, samples, teacher.ppo.rollout_steps * teacher.env.num_worlds))
