"""The training loop: rollouts and updates, curves, checkpoints, and every way a run can end."""

import contextlib
import io
import math
import os
import time
from pathlib import Path
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from vd.config import to_dict
from vd.envs.curriculum import blend
from vd.policy import PolicySpec, policy_export
from vd.train.begin import at_stage, check_fit, completed, unlike, warmup_iterations
from vd.train.checkpoint import (
    BEST_NAME,
    CHECKPOINT_FOLDER,
    checkpoint_path,
    load_checkpoint,
    prune_checkpoints,
    random_state,
    save_checkpoint,
    saved_worlds,
    set_random_state,
    without_worlds,
)
from vd.train.config import ACTIVATION, PolicyCfg, PpoCfg, RunCfg, rsl_rl_config, validate
from vd.train.distributed import Processes, join_processes, watch_iteration
from vd.train.ending import EndRequest, Interrupted, TrainingDivergedError
from vd.train.imitate import IMITATED, Imitation, begin_imitation, resumed_imitation
from vd.train.metrics import GoalWindow, ProgressFile, StepMeans
from vd.train.ppo import TeacherPPO
from vd.train.progress import ProgressLine
from vd.train.vec_env import OBSERVATION_GROUP, ReorientVecEnv, all_values
from vd.train.widen import new_inputs, widen

POLICY_NAME = "policy.pt"
"""The best policy so far, in the run's folder: what vd-eval, vd-play and deployment read."""
LOWER_RATES = "lower --ppo.actor-learning-rate, --ppo.critic-learning-rate or --ppo.grad-norm"
"""Remedy for networks that diverge."""


class TeacherRunner(OnPolicyRunner):
    """rsl-rl's on-policy runner with a loop that can be stopped, resumed and watched.

    Under ``torchrun`` every process simulates its own environments; rsl-rl averages the gradients, and the
    first process logs and saves, with the random and environment state of all.

    Args:
        env: Vectorised environment.
        ppo: Algorithm settings.
        policy: Network settings.
        run: Run settings.
        task: The environment's configuration as a dictionary, kept with every policy.
        device: Torch device of networks and rollouts; the environment's.
        deadline: ``time.monotonic()`` at which to save and end; ``None`` for no limit.

    Attributes:
        current_learning_iteration: Iterations completed, over all resumed runs.
        env_steps: Control steps completed, over all environments and processes.
        new_episodes: Why the checkpoint that was loaded could not restore the environments; empty if it did.
        new_inputs: Observed values that the networks of that checkpoint did not read.
        critic_warmup: Iterations left in which the critic learns alone (``PpoCfg.critic_warmup_iterations``).
        imitation: What the actor does meanwhile, if anything (``PpoCfg.imitation_iterations``).
        begun: Whether this run began from another one's networks, in this process.
        unlike: What observations and actions mean otherwise than to the policy that the run began from.
        damaged: Newer checkpoints than the one that was loaded, and what is wrong with them.
    """

    alg: TeacherPPO
    env: ReorientVecEnv

    def __init__(
        self,
        env: ReorientVecEnv,
        ppo: PpoCfg,
        policy: PolicyCfg,
        run: RunCfg,
        *,
        task: dict[str, Any],
        device: str,
        deadline: float | None = None,
    ) -> None:
        validate(ppo, policy, run)
        self.ppo, self.run, self.policy_cfg, self.task = ppo, run, policy, task
        # rsl-rl prints its models and observation groups while it builds them.
        with contextlib.redirect_stdout(io.StringIO()):
            config = rsl_rl_config(ppo, policy, env.num_envs, tuple(env.get_observations().keys()))
            super().__init__(env, config, log_dir=None, device=device)
        self.env_steps = 0
        self._steps_per_iteration = ppo.rollout_steps * env.num_envs * self.gpu_world_size
        self._elapsed_s = 0.0
        self._means = StepMeans()
        # Two episodes, so that a window never misses the time-outs of environments that run in step.
        self._window_length = math.ceil(2 * env.max_episode_length / ppo.rollout_steps)
        self._window = self._new_window()
        self._score = (0.0, 0.0, -math.inf)
        self._best: tuple[float, ...] | None = None
        self._end = EndRequest(deadline, device=device, distributed=self.is_distributed)
        self._stagger_due = True
        self.new_episodes = ""
        self.new_inputs = 0
        self.critic_warmup = ppo.critic_warmup_iterations or 0
        self.imitation: Imitation | None = None
        self.begun = False
        self.unlike: list[str] = []
        self.damaged: dict[Path, str] = {}

    def _new_window(self) -> GoalWindow:
        ends = bool(self.task.get("success_ends_episode", False))
        return GoalWindow(self._window_length, success_ends=ends)

    @property
    def num_observations(self) -> int:
        """Values that the actor reads, and the critic too."""
        return int(self.env.get_observations()[OBSERVATION_GROUP].shape[1])

    @property
    def total_iterations(self) -> int:
        """Iterations at the end of the run, those done included."""
        left = max(0, self.run.max_steps - self.env_steps)
        return self.current_learning_iteration + math.ceil(left / self._steps_per_iteration)

    @property
    def is_main(self) -> bool:
        """Whether this process logs and saves."""
        return self.gpu_global_rank == 0

    def learn(
        self, num_learning_iterations: int | None = None, init_at_random_ep_len: bool | None = None
    ) -> None:
        """Train until the steps, the time or the user end it, and save.

        Args:
            num_learning_iterations: Iterations to do now; up to ``run.max_steps`` if ``None``.
            init_at_random_ep_len: Stagger the first episodes, so that time-outs do not come all at once; yes
                if ``None``, and never where a checkpoint restored the environments.

        Raises:
            Interrupted: Ctrl-C or SIGTERM, after saving.
            TrainingDivergedError: Something is not finite any more. The last checkpoint is from before.
        """
        first = self.current_learning_iteration
        total = self.total_iterations if num_learning_iterations is None else first + num_learning_iterations
        self._stagger(init_at_random_ep_len is not False)
        if self.is_distributed:
            self.alg.broadcast_parameters()
        self.alg.train_mode()
        log = (
            ProgressFile(self.run.out, tensorboard=self.run.tensorboard, done=first) if self.is_main else None
        )
        progress = ProgressLine(total, done=first, enabled=self.is_main)
        try:
            with self._end.signals(progress.note), progress:
                self._iterate_until(total, log, progress)
        finally:
            if log is not None:
                log.close()
        if self._end.signal:
            raise Interrupted

    def _stagger(self, wanted: bool) -> None:
        """Start environments that are new at random times of their first episode."""
        if wanted and self._stagger_due:
            steps = self.env.episode_length_buf
            self.env.episode_length_buf = torch.randint_like(steps, high=int(self.env.max_episode_length))
        self._stagger_due = False

    def _iterate_until(self, total: int, log: ProgressFile | None, progress: ProgressLine) -> None:
        """Iterations up to ``total`` or the end of the time, curves, and checkpoints."""
        first = saved = self.current_learning_iteration
        observation = self.env.get_observations()
        while self.current_learning_iteration < total:
            if self.is_distributed:
                watch_iteration()
            row, observation = self._iterate(observation)
            if row is None:
                break
            if log is not None:
                log.write(row)
            done = self.current_learning_iteration - first
            progress.update(row, self._end.time_left(done, total - self.current_learning_iteration))
            if self.current_learning_iteration % self.run.save_every == 0:
                self._save_periodic()
                saved = self.current_learning_iteration
            if self._end.due():
                break
        if saved < self.current_learning_iteration or self.current_learning_iteration == 0:
            self._save_periodic()

    def _iterate(self, observation: TensorDict) -> tuple[dict[str, Any] | None, TensorDict]:
        """One rollout and update.

        Returns:
            The row for ``progress.jsonl``, or ``None`` if a signal cut the rollout short; the observation.
        """
        start = time.perf_counter()
        self.set_std_floor()
        with torch.inference_mode():
            for _ in range(self.cfg["num_steps_per_env"]):
                # With several processes all must do the same collectives, so they stop between iterations.
                if self._end.signal and not self.is_distributed:
                    self.alg.storage.clear()
                    self._means.clear()
                    return None, observation
                actions = self.alg.act(observation)
                observation, rewards, dones, extras = self.env.step(actions)
                self.alg.process_env_step(observation, rewards, dones, extras)
                self._means.add(extras["log"])
            action_std = float(self.alg.get_policy().output_std.mean())
            self._check_rollout(observation)
            self.alg.compute_returns(observation)
        collected = time.perf_counter()
        self.alg.actor_learns = self.critic_warmup == 0
        losses = self.alg.update()
        if self.imitation is not None and self.critic_warmup:
            losses |= self.imitation.update(min(1.0, self.critic_warmup / self.ppo.imitation_iterations))
        self.critic_warmup = max(0, self.critic_warmup - 1)
        self._check_update(losses)
        end = time.perf_counter()

        self.current_learning_iteration += 1
        self.env_steps += self._steps_per_iteration
        self._elapsed_s += end - start
        means = self._means.read(self.gpu_world_size)
        row: dict[str, Any] = {
            "iteration": self.current_learning_iteration,
            "env_steps": self.env_steps,
            "elapsed_s": round(self._elapsed_s, 3),
            "steps_per_s": self._steps_per_iteration / (end - start),
            "collect_s": round(collected - start, 4),
            "learn_s": round(end - collected, 4),
            **self._window.add(means),
            "action_std": action_std,
            "critic_warmup": self.critic_warmup,
            "actor_learning_rate": self.alg.learning_rate,
            "critic_learning_rate": self.alg.critic_learning_rate,
            **means,
            **self.env.end_iteration(),
            **{f"loss/{name}": value for name, value in losses.items()},
        }
        stage = row["task/difficulty"] + row["task/tightness"] - 1.0  # 1: the configured task
        self._score = (stage, row["success_per_goal"] or 0.0, row["mean_reward"])
        return row, observation

    def set_std_floor(self) -> None:
        """Let the least std of the actions fall as stillness tightens (``PolicyCfg.quiet_std``)."""
        quiet = self.policy_cfg.quiet_std
        if quiet is not None:
            floor = blend(self.policy_cfg.std_range[0], quiet, self.env.tightness)
            self.alg.actor.distribution.set_floor(floor)

    def save(self, path: str, infos: dict | None = None) -> None:
        """Write a checkpoint, whole or not at all. With several processes every one has to call it.

        Args:
            path: File to write.
            infos: Anything to keep with it (plain values).
        """
        state = self._state(infos)
        if self.is_main:
            save_checkpoint(Path(path), state)

    def load(
        self, path: str, load_cfg: dict | None = None, strict: bool = True, map_location: str | None = None
    ) -> dict:
        """Go on from a checkpoint: networks, optimiser, iteration, curriculum, random states.

        With the processes and environments of the checkpoint the run goes on exactly. With others, or from a
        checkpoint without environments, all but environments and random states is restored, and episodes
        start anew. So they do where the run observes more than the checkpoint's networks read, which are
        widened.

        Args:
            path: The checkpoint.
            load_cfg: rsl-rl's choice of parts; all if ``None``. Random and environment state come with all.
            strict: Whether the networks have to fit exactly.
            map_location: Device to read to.

        Raises:
            ValueError: The file is damaged, a policy only, or of another network.
        """
        state = load_checkpoint(Path(path), map_location or self.device)
        if "optimizer_state_dict" not in state:
            raise ValueError(f"{path} is a policy, which nothing can resume; --init begins a new run from it")
        return self._restore(state, path, load_cfg, strict)

    def begin_from(self, path: str, stage: tuple[float, float] | None = None) -> None:
        """Begin with networks, optimiser, curriculum and counters of another run's checkpoint or policy.

        Environments, random states, learning rates and the choice of the best checkpoint are this run's own,
        and so are a critic and an optimiser that the file lacks; then the critic learns alone first.

        Args:
            path: Checkpoint or exported policy.
            stage: Difficulty and tightness to begin at, rather than those of the file.

        Raises:
            ValueError: The file is damaged, of another hand or of another network.
        """
        state = load_checkpoint(Path(path), self.device, flag="--init")
        check_fit(state, self._spec(), self.task, path)
        self.unlike = unlike(state["task"], self.task)
        warmup = warmup_iterations(state, self.ppo.critic_warmup_iterations)
        before = state
        state = self._widened(state)
        state = without_worlds(completed(state, self.alg.save() | {"window": self._window.state_dict()}))
        if stage is not None:
            state = at_stage(state, stage)
        self._restore(state, path, None, True)
        self.alg.set_learning_rates(self.ppo.actor_learning_rate, self.ppo.critic_learning_rate)
        self.begun, self.new_episodes = True, "it is of another run"
        self.imitation = begin_imitation(self.alg, self.ppo, self.env.num_present, before, path)
        self.critic_warmup = warmup if self.imitation is None else self.ppo.imitation_iterations
        self._best, self._window = None, self._new_window()

    def _restore(self, state: dict[str, Any], path: str, load_cfg: dict | None, strict: bool) -> dict:
        """Take over a checkpoint that was read; see :meth:`load`."""
        try:
            everything = self.alg.load(self._widened(state), load_cfg, strict)
        except (RuntimeError, ValueError, KeyError) as error:
            raise ValueError(
                f"{path} does not fit this run's networks or hand; resume with the configuration it was "
                f"trained with (its run folder's config.json), or start anew ({error})"
            ) from error
        if everything:
            self.current_learning_iteration = state["iter"]
            self.env_steps = state["env_steps"]
            self._elapsed_s = state["elapsed_s"]
            self.critic_warmup = state.get("critic_warmup", 0)
            self.imitation = resumed_imitation(self.alg, self.ppo, self.env.num_present, state)
            self._best = tuple(state["best"]) if state["best"] is not None else None
            self._window.load_state_dict(state["window"])
            self._load_worlds(state["ranks"])
        return state["infos"]

    def _widened(self, state: dict[str, Any]) -> dict[str, Any]:
        """A checkpoint with networks that read what this run observes, if its own read less."""
        inputs = new_inputs(state, self.num_observations, self.alg.critic.obs_dim)
        if not inputs:
            return state
        self.new_inputs = inputs
        return widen(state, self.alg.actor, self.alg.critic, num_observations=self.num_observations)

    def _load_worlds(self, ranks: list[dict[str, Any]]) -> None:
        """Restore environments and random state, or else the curriculum alone. All processes decide alike."""
        envs = {saved_worlds(rank) for rank in ranks}
        if envs == {0}:
            self.new_episodes = "it holds no worlds"
        elif self.new_inputs:
            self.new_episodes = f"this run observes {self.new_inputs} values more"
        elif len(ranks) != self.gpu_world_size:
            self.new_episodes = f"it is of {len(ranks)} processes, this run has {self.gpu_world_size}"
        elif envs != {self.env.num_envs}:
            self.new_episodes = (
                f"it is of {max(envs)} environments a process, this run has {self.env.num_envs}"
            )
        else:
            self.new_episodes = ""
        self._stagger_due = bool(self.new_episodes)
        if self.new_episodes:
            self.env.start_anew(ranks[0]["env"])
            return
        mine = ranks[self.gpu_global_rank]
        self.env.load_state_dict(mine["env"])
        set_random_state(mine["random"], self.device)

    def _state(self, infos: dict | None) -> dict[str, Any]:
        """Everything a checkpoint holds."""
        mine = {"random": random_state(self.device), "env": self.env.state_dict()}
        ranks: list[Any] = [mine]
        if self.is_distributed:
            ranks = [None] * self.gpu_world_size
            torch.distributed.all_gather_object(ranks, mine)
        state = {
            "iter": self.current_learning_iteration,
            "infos": infos,
            "env_steps": self.env_steps,
            "elapsed_s": self._elapsed_s,
            "best": list(self._best) if self._best is not None else None,
            "window": self._window.state_dict(),
            "ranks": ranks,
            "critic_warmup": self.critic_warmup,
            "policy": to_dict(self._spec()),
            "learner": {"ppo": to_dict(self.ppo), "policy": to_dict(self.policy_cfg)},
            "task": self.task,
        }
        if self.imitation is not None and self.critic_warmup:
            state[IMITATED] = self.imitation.teacher.state_dict()
        return self.alg.save() | state

    def _spec(self) -> PolicySpec:
        """Shape of the actor."""
        return PolicySpec(
            num_observations=self.num_observations,
            num_actions=self.env.num_actions,
            hidden=self.policy_cfg.hidden,
            activation=ACTIVATION,
            distribution=self.policy_cfg.distribution,
            normalise_observations=self.policy_cfg.normalise_observations,
        )

    def _save_periodic(self) -> None:
        """Write the checkpoint of this iteration, and the best if it is one.

        The best is chosen by the curriculum's stage, then success per goal over the last two
        episodes, then mean reward, in that order: while nothing succeeds the reward decides. Until two
        episodes are over the latest takes its place: environments whose goal is near succeed first, so that
        early rates are too high and no later one would beat them.
        """
        path = checkpoint_path(self.run.out, self.current_learning_iteration)
        better = self.current_learning_iteration > 0 and (self._best is None or self._score > self._best)
        if better and self._window.full:
            self._best = self._score
        state = self._state(None)
        if not self.is_main:
            return
        save_checkpoint(path, state)
        if better:
            save_checkpoint(path.with_name(BEST_NAME), state)
        if better or not (self.run.out / POLICY_NAME).exists():
            save_checkpoint(self.run.out / POLICY_NAME, policy_export(state))
        prune_checkpoints(self.run.out, self.current_learning_iteration, self.run.keep_every)

    def _check_rollout(self, latest: TensorDict) -> None:
        """Stop before an update on values that are not finite. One wait for the device an iteration."""
        storage = self.alg.storage
        # In the order in which a step makes them.
        tensors = (
            ("observations", torch.cat((all_values(storage.observations), all_values(latest)[None]))),
            ("values", storage.values),
            ("actions", storage.actions),
            ("rewards", storage.rewards),
        )
        finite = torch.stack([torch.isfinite(tensor).all() for _, tensor in tensors]).tolist()
        bad = [
            (name, ~torch.isfinite(t).all(dim=2))
            for (name, t), ok in zip(tensors, finite, strict=True)
            if not ok
        ]
        if not bad:
            return
        # What was not finite first has made the rest so.
        name, where = min(bad, key=lambda pair: int(pair[1].any(dim=1).nonzero()[0]))
        envs = where.any(dim=0)
        if name in ("observations", "rewards"):
            self.env.check()  # says more, if the simulation is the cause
            remedy = "the simulation gave them: raise --env.sim.physics-hz or lower --env.action.scale-rad-s"
        else:
            remedy = f"the networks gave them: {LOWER_RATES}"
        raise TrainingDivergedError(
            f"iteration {self.current_learning_iteration + 1}: {name} not finite in "
            f"{int(envs.sum())} environments (first: {envs.nonzero().flatten()[:8].tolist()}); "
            f"{remedy}. {self._last_good()}"
        )

    def _check_update(self, losses: dict[str, float]) -> None:
        """Stop when a loss, a gradient or a parameter is not finite."""
        bad = [name for name, value in losses.items() if not math.isfinite(value)]
        # A sum is finite only if all its terms are; one number for both networks, one wait.
        parameters = [*self.alg.actor.parameters(), *self.alg.critic.parameters()]
        if not math.isfinite(float(torch.stack([p.detach().sum() for p in parameters]).sum())):
            bad.append("parameters")
        if bad:
            raise TrainingDivergedError(
                f"iteration {self.current_learning_iteration + 1}: {', '.join(bad)} not finite after the "
                f"update; {LOWER_RATES}, or raise the lower end of --policy.std-range. {self._last_good()}"
            )

    def _last_good(self) -> str:
        folder = self.run.out / CHECKPOINT_FOLDER
        return f"The last checkpoint in {folder} is from before; go on from it with --resume"

    def _configure_multi_gpu(self) -> None:
        """As rsl-rl, but with our limits of time, and with gloo where the device is the CPU."""
        self.is_distributed = int(os.environ.get("WORLD_SIZE", "1")) > 1
        processes = join_processes(self.device) if self.is_distributed else Processes(0, 0, 1)
        self.gpu_world_size = processes.world_size
        self.gpu_local_rank = processes.local_rank
        self.gpu_global_rank = processes.rank
        self.cfg["multi_gpu"] = None
        if self.is_distributed:
            self.cfg["multi_gpu"] = {
                "global_rank": processes.rank,
                "local_rank": processes.local_rank,
                "world_size": processes.world_size,
            }

    def shutdown(self) -> None:
        """Leave the process group, so that torchrun ends without a warning.

        All processes have to call it, so not after an error of one: see
        :func:`vd.train.distributed.ending_together`.
        """
        if self.is_distributed:
            torch.distributed.destroy_process_group()
