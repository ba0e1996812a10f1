"""Imitation of the teacher on what the student does: rollouts, labels, and updates through whole sequences.

T steps, N environments, D actions, G the student's memory.
"""

import math
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import nn

from vd.frame_maps import FrameMaps
from vd.policy import Policy
from vd.train.config import RunCfg
from vd.train.loop import TrainingDivergedError, check_update
from vd.train.metrics import GoalWindow, StepMeans
from vd.train.student.config import DaggerCfg
from vd.train.student.losses import POSE_VALUES, imitation_figures, imitation_loss, poses
from vd.train.student.rollout import UNCLIPPED, Rollout, taken
from vd.train.student.runner import StudentRunner, scheduled
from vd.train.vec_env import OBSERVATION_GROUP, ReorientVecEnv
from vd.vision.network import Student

CHECKPOINT_ROLLOUT_BYTES = 2**28
"""Kept rollouts that are larger together, those with camera points, are not written into checkpoints: a run
that goes on from one begins with the rollouts to come."""
LOWER_RATES = "lower --dagger.learning-rate or --dagger.grad-norm, or take --dagger.precision fp32"
"""Remedy for a network that diverges."""


class WorldTeacher:
    """A teacher of symmetry frames on observations in the world frame: each state says in which it acts.

    Args:
        policy: The teacher.
        maps: Its frames; ``None`` if it has none.
    """

    def __init__(self, policy: Policy, maps: FrameMaps | None) -> None:
        self.num_actions = policy.num_actions
        self._policy, self._maps = policy, maps

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """Mean actions [N, D], in the world's order, for observations [N, O]."""
        if self._maps is None:
            return self._policy.act(observation)
        frame = self._maps.choose(observation)
        return self._maps.world_action(self._policy.act(self._maps.take(observation, frame)), frame)


class Dagger(StudentRunner):
    """Trains a student by the labels of a teacher that sees the noise-free state (Ross et al. 2011).

    One iteration: the student acts T steps in N environments and the teacher labels every state; then some
    passes over the environments, whole sequences in each minibatch, gradients through all T steps except
    across ends of episodes. As in the released code only the latest rollout is learned from, unless more are
    to be kept. In rollouts batch norms use running statistics, as they do where the student is deployed.

    Args:
        env: The environments.
        view: What the student sees of them (:class:`vd.evaluate.student.StudentView`).
        student: The network.
        teacher: Labels observations of ``env``.
        cfg: Settings.
        run: Run settings.
        **kept: What :class:`StudentRunner` keeps with the student, and its device and deadline.
    """

    def __init__(
        self,
        env: ReorientVecEnv,
        view: Any,
        student: Student,
        teacher: Policy,
        cfg: DaggerCfg,
        run: RunCfg,
        **kept: Any,
    ) -> None:
        heads: dict[str, nn.Module] = {}
        if cfg.pose_weight > 0.0:  # predicts poses from embeddings
            width, inside = student.cfg.encoder.embedding, student.cfg.distance_hidden
            layers = (nn.Linear(width, inside), nn.GELU(), nn.Linear(inside, POSE_VALUES))
            heads["pose"] = nn.Sequential(*layers)
        super().__init__(student, heads, run, amsgrad=cfg.amsgrad, **kept)
        self.env, self.view, self.teacher, self.cfg = env, view, teacher, cfg
        self.weights = {"imitation": 1.0, "distance": cfg.distance_weight, "pose": cfg.pose_weight}
        """Weights of the losses."""
        self._hidden = student.initial_hidden(env.num_envs)
        self._window = GoalWindow(math.ceil(2 * env.max_episode_length / cfg.rollout_steps))
        self._means = StepMeans()
        self._kept: deque[Rollout] = deque(maxlen=cfg.keep_rollouts)
        self._figures: dict[str, torch.Tensor] = {}

    def _samples(self) -> int:
        return self.cfg.rollout_steps * self.env.num_envs

    def _iterate(self) -> dict[str, Any] | None:
        start = time.perf_counter()
        rollout = self.collect()
        if rollout is None:
            return None
        means = self._means.read(self.world_size) | self._read(self._figures)
        collected = time.perf_counter()
        self._kept.append(rollout)
        losses = self.update(list(self._kept))
        return {
            "collect_s": round(collected - start, 4),
            "learn_s": round(time.perf_counter() - collected, 4),
            **self._window.add(means),
            **means,
            **self.env.end_iteration(),
            **losses,
        }

    def teacher_share(self) -> float:
        """Share of environments in which the teacher acts in this iteration."""
        first, last = self.cfg.teacher_share, self.cfg.teacher_share_last
        if self.cfg.teacher_share_iterations == 0:
            return first
        return first + (last - first) * min(1.0, self.iteration / self.cfg.teacher_share_iterations)

    def collect(self) -> Rollout | None:
        """Let the student act, and the teacher label; ``None`` if it was cut short."""
        cfg, envs = self.cfg, self.env.num_envs
        self.student.eval()
        if cfg.reset:
            self.env.env.reset()
            self._hidden = self.student.initial_hidden(envs)
        first = self._hidden
        # Whole rollouts of an environment: mixed from step to step it would be what neither of the two does.
        taught = torch.rand((envs, 1), device=self.device) < self.teacher_share()
        frames: dict[str, torch.Tensor] = {}
        labels: list[torch.Tensor] = []
        means: list[torch.Tensor] = []
        done = torch.zeros((cfg.rollout_steps, envs), dtype=torch.bool, device=self.device)
        with torch.no_grad():
            observation = self.env.get_observations()
            for step in range(cfg.rollout_steps):
                if self._stopping():
                    self._means.clear()
                    return None
                frame = self.view.frame()
                self._record(frames, frame, step)
                label = self.teacher.act(self.view.observation(observation[OBSERVATION_GROUP]))
                labels.append(label.clamp(-1.0, 1.0) if cfg.clip_labels else label)
                embedding = self._encode(self.view.sites(frame, augment=True), cfg.precision)
                known = self.student.proprioception(frame)
                output = self.student(embedding[None], known[None], self._hidden)
                action, std = output.mean[0], output.log_std[0].exp()
                means.append(action)
                error = (output.distance[0, :, -1] - frame["distance"]).abs().mean()
                if cfg.imitation == "likelihood":
                    action = action + std * torch.randn_like(action)
                observation, _, ended, extras = self.env.step(torch.where(taught, labels[-1], action))
                done[step] = ended.bool()
                self._hidden = output.hidden.masked_fill(done[step, :, None], 0.0)
                log = {"student/distance_error": error, **extras["log"]}
                if cfg.reset and step == cfg.rollout_steps - 1:
                    # Goals that the end of the rollout cuts off would be in no count otherwise.
                    log["task/timed_out"] = log["task/timed_out"] + (~done[step]).float().mean()
                self._means.add(log | {"policy/std": std.mean()})
        rollout = Rollout(frames, torch.stack(labels), done, first, torch.arange(envs, device=self.device))
        own = ~taught[:, 0] if not bool(taught.all()) else taught[:, 0]
        self._figures = imitation_figures(torch.stack(means)[:, own], rollout.label[:, own])
        self._check_rollout(rollout)
        return rollout

    def update(self, rollouts: Sequence[Rollout]) -> dict[str, float]:
        """All passes over rollouts; means of its losses over the minibatches."""
        self.student.train()
        batches = self.minibatches(len(rollouts))
        steps = [self._minibatch_step(taken(rollouts, sequences)) for sequences in batches]
        self._share_statistics()
        means = torch.stack([torch.stack(tuple(step.values())) for step in steps]).mean(dim=0)
        losses = dict(zip(steps[0], means.tolist(), strict=True))
        check_update(losses, self.networks, LOWER_RATES)
        return losses

    def minibatches(self, rollouts: int) -> Iterator[torch.Tensor]:
        """Sequences of each optimiser step: as many a pass as environments, none twice, in a new order.

        Sequence n of rollout k is number k N + n. Of the latest rollout alone that is every environment once.
        The last minibatch of a pass may be smaller.
        """
        envs = self.env.num_envs
        for _ in range(self.cfg.epochs):
            order = torch.randperm(rollouts * envs, device=self.device)[:envs]
            yield from order.split(self.cfg.minibatch_envs)

    def losses(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """Losses of sequences by name, with new noise on their clouds; their weights are in ``weights``."""
        steps, count = rollout.done.shape
        flat = {name: value.flatten(0, 1) for name, value in rollout.frames.items()}
        sites = self.view.sites(flat, rollout.envs.repeat(steps), augment=True)
        embedding = self._encode(sites, self.cfg.precision).view(steps, count, -1)
        known = self.student.proprioception(rollout.frames)
        output = self.student(embedding, known, rollout.hidden, rollout.done)
        error = output.distance - rollout.frames["distance"][..., None]
        found = {
            "imitation": imitation_loss(
                output, rollout.label, self.cfg.imitation, bounded=self.cfg.clip_labels
            ),
            "distance": error.square().mean(),
        }
        if "pose" in self.heads:
            error = self.heads["pose"](embedding) - poses(rollout.frames)
            found["pose"] = error.square().mean()
        return found

    def _learner(self) -> dict[str, Any]:
        return super()._learner() | {"window": self._window.state_dict()}

    def _load_learner(self, state: dict[str, Any]) -> None:
        super()._load_learner(state)
        self._window.load_state_dict(state["window"])

    def _own_state(self) -> dict[str, Any]:
        # The next iteration drops the oldest: one that stands alone, or the first of a full store.
        kept = list(self._kept)[-(self.cfg.keep_rollouts - 1) :] if self.cfg.keep_rollouts > 1 else []
        if sum(rollout.num_bytes for rollout in kept) > CHECKPOINT_ROLLOUT_BYTES:
            kept = []
        return {
            "env": self.env.env.state_dict(),
            "view": self.view.state_dict(),
            "hidden": self._hidden.cpu(),
            "rollouts": [rollout.state_dict() for rollout in kept],
        }

    def _load_own_state(self, state: dict[str, Any]) -> None:
        self.env.env.load_state_dict(state["env"])
        self.view.load_state_dict(state["view"])
        self._hidden = state["hidden"].to(self.device)
        self._kept.clear()
        self._kept.extend(Rollout.from_state(rollout, self.device) for rollout in state["rollouts"])

    def _misfit(self, ranks: list[dict[str, Any]]) -> str:
        envs = {len(rank["hidden"]) for rank in ranks}
        if envs == {self.env.num_envs}:
            return ""
        return f"it is of {max(envs)} environments a process, this run has {self.env.num_envs}"

    def _close(self) -> None:
        self.env.env.close()

    def _record(self, frames: dict[str, torch.Tensor], frame: dict[str, torch.Tensor], step: int) -> None:
        """Write the frame of a step [N, ...] into those of the rollout [T, N, ...]."""
        for name, value in frame.items():
            if step == 0:
                # A tenth of a millimetre is lost of camera points, and half of the memory gained.
                dtype = torch.half if name in UNCLIPPED else value.dtype
                frames[name] = value.new_empty((self.cfg.rollout_steps, *value.shape), dtype=dtype)
            frames[name][step] = value

    def _minibatch_step(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """One optimiser step; its losses and the gradient's norm, on the device."""
        cfg, losses = self.cfg, self.losses(rollout)
        total = torch.stack([self.weights[name] * loss for name, loss in losses.items()]).sum()
        rate = scheduled(
            cfg.learning_rate,
            self._steps_done + 1,
            warmup=cfg.warmup_steps,
            decay_after=cfg.decay_after_steps,
        )
        norm = self._descend(total, rate=rate, grad_norm=cfg.grad_norm)
        return {f"loss/{name}": loss.detach() for name, loss in losses.items()} | {"loss/grad_norm": norm}

    def _check_rollout(self, rollout: Rollout) -> None:
        """Stop before an update on values that are not finite."""
        tensors = {"the teacher's actions": rollout.label, "the student's memory": self._hidden}
        tensors |= {name: frame for name, frame in rollout.frames.items() if name not in UNCLIPPED}
        finite = torch.stack([torch.isfinite(tensor).all() for tensor in tensors.values()]).tolist()
        bad = [name for name, good in zip(tensors, finite, strict=True) if not good]
        if bad:
            self.env.env.check()  # says more, if the simulation is the cause
            raise TrainingDivergedError(f"{', '.join(bad)} not finite in the rollout; {LOWER_RATES}")
