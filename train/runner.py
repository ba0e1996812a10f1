"""The teacher's training.

Rollouts and updates of PPO, its checkpoints, and beginning from another run.
"""

import math
import time
from pathlib import Path
from typing import Any

import torch
from torch import nn

from vd.command.config import to_dict
from vd.envs.curriculum import blend
from vd.policy.actor import teacher_in
from vd.policy.bundle import write_policy
from vd.policy.contract import PolicySpec
from vd.train.begin import check_fit, first_levels, read_start, take_critic, unlike
from vd.train.checkpoint import BEST_NAME, POLICY_NAME, load_checkpoint, save_checkpoint
from vd.train.config import PolicyCfg, PpoCfg, RunCfg
from vd.train.loop import TrainingLoop, check_update
from vd.train.metrics import GoalWindow, StepMeans
from vd.train.ppo import make_learner
from vd.train.vec_env import OBSERVATION_GROUP, ReorientVecEnv

LOWER_RATES = "lower --ppo.actor-learning-rate, --ppo.critic-learning-rate or --ppo.grad-norm"
"""Remedy for networks that diverge."""


class TeacherRunner(TrainingLoop):
    """Trains the teacher with rsl-rl's PPO.

    ``task`` is the configuration of the environment, kept with every policy, as is ``interface``
    (:func:`vd.policy.contract.derive_interface`); others as of TrainingLoop.

    Attributes:
        critic_warmup: Iterations left in which the critic learns alone.
        begun: Whether this run began from another one's networks, in this process.
        unlike: What observations and actions mean otherwise than to the policy that the run began
            from.
    """

    env: ReorientVecEnv

    def __init__(
        self,
        env: ReorientVecEnv,
        ppo: PpoCfg,
        policy: PolicyCfg,
        run: RunCfg,
        *,
        task: dict[str, Any],
        interface: dict[str, Any] | None = None,
        device: str,
    ) -> None:
        super().__init__(run, device=device, env=env)
        self.ppo = ppo
        self.policy_cfg = policy
        self.task = task
        self.interface = interface or {}
        self.alg = make_learner(env, ppo, policy, rank=self.rank, world_size=self.world_size)
        self._networks = nn.ModuleList([self.alg.actor, self.alg.critic])
        self._means = StepMeans()
        # Two episodes, so that a window never misses the time-outs of environments that run in
        # step.
        length = math.ceil(2 * env.max_episode_length / ppo.rollout_steps)
        self.window = GoalWindow(length, success_ends=bool(task.get("success_ends_episode")))
        """The newest goals, by which the best is chosen."""
        self._score = (0.0, 0.0, -math.inf)
        self._best: tuple[float, ...] | None = None
        self._better = False
        self._stagger_due = True
        self.critic_warmup = 0
        self.begun = False
        self.unlike: list[str] = []

    @property
    def num_observations(self) -> int:
        """Values that the actor reads, and the critic too."""
        return int(self.env.get_observations()[OBSERVATION_GROUP].shape[1])

    def load(self, path: str | Path) -> None:
        """Go on from a checkpoint: networks, optimiser, iteration, curriculum and random states.

        With the processes and environments of the checkpoint the run goes on exactly. With others,
        or from a checkpoint without environments, all but these and random states is restored, and
        episodes start anew.

        Raises:
            ValueError: The file is damaged, a policy only, or of another network.
        """
        self._take(load_checkpoint(Path(path), self.device), path)

    def begin_from(self, path: str | Path, levels: tuple[float, ...] | None = None) -> None:
        """Begin with networks, optimiser, curriculum and counters of another run.

        Environments, random states, learning rates and the choice of the best checkpoint are this
        run's own, and so are a critic and an optimiser that the file lacks; then the critic learns
        alone first. With ``levels`` those of the curriculum are these.

        Raises:
            ValueError: The file is damaged, of another hand or of another network.
        """
        state = read_start(Path(path), self.device)
        check_fit(state, self._spec(), self.task, path)
        self.unlike = unlike(state["task"], self.task)
        stage = first_levels(state, levels)
        self.alg.actor.load_state_dict(state["actor_state_dict"])
        self.critic_warmup = take_critic(self.alg, state)
        self.alg.set_learning_rates(self.ppo.actor_learning_rate, self.ppo.critic_learning_rate)
        self.iteration = state["iter"]
        self.env_steps = state["env_steps"]
        self._elapsed_s = state.get("elapsed_s", 0.0)
        self.env.start_anew({"levels": stage})
        self.begun = True

    def save(self) -> None:
        """Write checkpoint and policy; the policy is that of the best checkpoint.

        The best is chosen by the curriculum's progress, then success per goal over the last two
        episodes, then mean reward, in that order: while nothing succeeds the reward decides. Until
        two episodes are over the latest takes its place: near goals are reached first, so that
        early rates are too high and no later one would beat them.
        """
        self._better = self.iteration > 0 and (self._best is None or self._score > self._best)
        if self._better and self.window.full:
            self._best = self._score
        super().save()

    def _save_policy(self, path: Path, state: dict[str, Any]) -> None:
        if self._better:
            save_checkpoint(path.with_name(BEST_NAME), state)
        if self._better or not (self.run.out / POLICY_NAME).exists():
            write_policy(teacher_in(state, path, self.device), self.run.out / POLICY_NAME)

    def _samples(self) -> int:
        return self.ppo.rollout_steps * self.env.num_envs

    def _begin(self) -> None:
        # New environments begin within their episode, or all would time out at once.
        if self._stagger_due:
            steps = self.env.episode_length_buf
            self.env.episode_length_buf = torch.randint_like(
                steps, high=int(self.env.max_episode_length)
            )
        self._stagger_due = False
        if self.is_distributed:
            self.alg.broadcast_parameters()
        self.alg.train_mode()

    def _iterate(self) -> dict[str, Any] | None:
        start = time.perf_counter()
        quiet = self.policy_cfg.quiet_std
        if quiet is not None:  # the least std falls as stillness tightens
            floor = blend(self.policy_cfg.std_range[0], quiet, self.env.env.levels.stillness)
            self.alg.actor.distribution.set_floor(floor)
        if self.ppo.late_kl is not None:
            progress = self.env.env.progress
            self.alg.desired_kl = blend(self.ppo.desired_kl, self.ppo.late_kl, progress)
        if not self._collect():
            return None
        action_std = float(self.alg.get_policy().output_std.mean())
        collected = time.perf_counter()
        losses = self._update()
        learned = time.perf_counter()
        means = self._means.read(self.world_size)
        figures: dict[str, Any] = {
            "collect_s": round(collected - start, 4),
            "learn_s": round(learned - collected, 4),
            **self.window.add(means),
            "action_std": action_std,
            "critic_warmup": self.critic_warmup,
            "actor_learning_rate": self.alg.learning_rate,
            "critic_learning_rate": self.alg.critic_learning_rate,
            **means,
            **self.env.end_iteration(),
            **{f"loss/{name}": value for name, value in losses.items()},
        }
        progress = self.env.env.progress
        self._score = (progress, figures["success_per_goal"] or 0.0, figures["mean_reward"])
        return figures

    def _collect(self) -> bool:
        """One rollout and its returns; false if it was cut short."""
        observation = self.env.get_observations()
        with torch.inference_mode():
            for _ in range(self.ppo.rollout_steps):
                if self._stopping():
                    self.alg.storage.clear()
                    self._means.clear()
                    return False
                actions = self.alg.act(observation)
                observation, rewards, dones, extras = self.env.step(actions)
                self.alg.process_env_step(observation, rewards, dones, extras)
                self._means.add(extras["log"])
            self.alg.compute_returns(observation)
        self.env.env.check()  # before an update makes something of what the simulation made
        return True

    def _update(self) -> dict[str, float]:
        """All epochs of PPO, or of the critic alone; its losses."""
        self.alg.actor_learns = self.critic_warmup == 0
        losses = self.alg.update()
        self.critic_warmup = max(0, self.critic_warmup - 1)
        check_update(
            losses, self._networks, f"{LOWER_RATES}, or raise the lower end of --policy.std-range"
        )
        return losses

    def _spec(self) -> PolicySpec:
        """Shape of the actor."""
        return PolicySpec(
            num_observations=self.num_observations,
            num_actions=self.env.num_actions,
            hidden=self.policy_cfg.hidden,
            distribution=self.policy_cfg.distribution,
            normalise_observations=self.policy_cfg.normalise_observations,
        )

    def _shared_state(self) -> dict[str, Any]:
        return self.alg.save() | {
            "infos": None,
            "best": list(self._best) if self._best is not None else None,
            "window": self.window.state_dict(),
            "critic_warmup": self.critic_warmup,
            "policy": to_dict(self._spec()),
            "learner": {"ppo": to_dict(self.ppo), "policy": to_dict(self.policy_cfg)},
            "task": self.task,
            "interface": self.interface,
        }

    def _take(self, state: dict[str, Any], path: str | Path) -> None:
        """Take over what was read from ``path``."""
        try:
            self.alg.load(state, None, True)
        except (RuntimeError, ValueError, KeyError) as error:
            raise ValueError(
                f"{path} does not fit this run's networks or hand; resume with the configuration "
                f"it was trained with (its run folder's config.json), or start anew ({error})"
            ) from error
        self.critic_warmup = state.get("critic_warmup", 0)
        self._best = tuple(state["best"]) if state["best"] is not None else None
        self.window.load_state_dict(state["window"])
        self._restore(state)
        self._stagger_due = bool(self.new_episodes)

    def close(self) -> None:
        """Free the environments."""
        self.env.env.close()
