"""Imitation of the teacher on what the student does: rollouts, labels, and updates through whole sequences.

T steps, N worlds, D actions, G the student's memory.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import torch
from torch import nn

from vd.policy import Policy
from vd.student.network import Student
from vd.student.sites import Sites
from vd.train.ending import TrainingDivergedError
from vd.train.metrics import GoalWindow, StepMeans
from vd.train.student.config import DaggerCfg
from vd.train.student.losses import distance_loss, imitation_loss
from vd.train.vec_env import OBSERVATION_GROUP, ReorientVecEnv

STATISTICS = ("loss/imitation", "loss/distance", "loss/grad_norm")
"""What every minibatch reports."""
LOWER_RATES = "lower --dagger.learning-rate or --dagger.grad-norm, or take --dagger.precision fp32"
"""Remedy for a network that diverges."""


class View(Protocol):
    """What the student sees of the environment (:class:`vd.vision.StudentView`)."""

    def frame(self) -> dict[str, torch.Tensor]:
        """Tensors [N, ...] of the present state, among them ``action`` [N, D] and ``distance`` [N]."""
        ...

    def sites(
        self, frame: Mapping[str, torch.Tensor], worlds: torch.Tensor | None = None, *, augment: bool
    ) -> tuple[Sites, ...]:
        """Voxels of frames [R, ...] of the given worlds [R]."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Random states."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore them."""
        ...


@dataclass
class Rollout:
    """What an update needs of N sequences of T steps."""

    frames: dict[str, torch.Tensor]
    """Frames before each step, tensors [T, N, ...]."""
    label: torch.Tensor
    """The teacher's mean action of each state [T, N, D]."""
    done: torch.Tensor
    """Where the goal or the episode ended with the step [T, N], bool."""
    hidden: torch.Tensor
    """The student's memory before the first step [N, G]."""
    worlds: torch.Tensor
    """World of each sequence [N]."""


class Dagger:
    """Trains a student by the labels of a teacher that sees the noise-free state (Ross et al. 2011).

    One iteration: the student acts T steps in N worlds and the teacher labels every state; then some passes
    over the worlds, whole sequences in each minibatch, gradients through all T steps except across ends of
    episodes. As in the released code only the latest rollout is learned from, unless more are to be kept. In
    rollouts batch norms use their running statistics, as they do where the student is deployed.

    Args:
        env: The worlds.
        view: What the student sees of them.
        student: The network.
        teacher: Labels observations of ``env``.
        cfg: Settings.
        world_size: Processes of the run: gradients are averaged over them.
    """

    def __init__(
        self,
        env: ReorientVecEnv,
        view: View,
        student: Student,
        teacher: Policy,
        cfg: DaggerCfg,
        *,
        world_size: int = 1,
    ) -> None:
        self.env, self.view, self.student, self.teacher, self.cfg = env, view, student, teacher, cfg
        self.device = torch.device(env.device)
        self.optimizer = make_optimizer(student, cfg.learning_rate)
        self.samples_per_iteration = cfg.rollout_steps * env.num_envs
        self.iteration = 0
        """Iterations completed; decides the teacher's share."""
        self._world_size = world_size
        self._hidden = student.initial_hidden(env.num_envs)
        self._window = GoalWindow(math.ceil(2 * env.max_episode_length / cfg.rollout_steps))
        self._means = StepMeans()
        self._scene: dict[str, Any] | None = None
        self._kept: deque[Rollout] = deque(maxlen=cfg.keep_rollouts)

    def iterate(self, stopping: Callable[[], bool]) -> dict[str, float | None] | None:
        """One rollout and update.

        Args:
            stopping: Asked before every step whether to give up.

        Returns:
            Figures of the iteration, or ``None`` if it was given up.

        Raises:
            TrainingDivergedError: Something is not finite any more.
        """
        start = time.perf_counter()
        rollout = self.collect(stopping)
        if rollout is None:
            return None
        means = self._means.read(self._world_size)
        collected = time.perf_counter()
        self._kept.append(rollout)
        losses = self.update(merged(self._kept))
        self.iteration += 1
        return {
            "collect_s": round(collected - start, 4),
            "learn_s": round(time.perf_counter() - collected, 4),
            **self._window.add(means),
            **means,
            **self.env.end_iteration(),
            **losses,
        }

    def teacher_share(self) -> float:
        """Share of worlds and steps in which the teacher acts in this iteration."""
        if self.cfg.teacher_share_iterations == 0:
            return self.cfg.teacher_share
        return self.cfg.teacher_share * max(0.0, 1.0 - self.iteration / self.cfg.teacher_share_iterations)

    def collect(self, stopping: Callable[[], bool] = lambda: False) -> Rollout | None:
        """Let the student act, and the teacher label; ``None`` if ``stopping`` said so on the way."""
        cfg, worlds = self.cfg, self.env.num_envs
        self.student.eval()
        if cfg.reset:
            self._begin_episodes()
            self._hidden = self.student.initial_hidden(worlds)
        first, share = self._hidden, self.teacher_share()
        frames: dict[str, torch.Tensor] = {}
        labels: list[torch.Tensor] = []
        done = torch.zeros((cfg.rollout_steps, worlds), dtype=torch.bool, device=self.device)
        with torch.no_grad():
            observation = self.env.get_observations()
            for step in range(cfg.rollout_steps):
                if stopping():
                    self._means.clear()
                    return None
                frame = self.view.frame()
                for name, value in frame.items():
                    if step == 0:
                        frames[name] = value.new_empty((cfg.rollout_steps, *value.shape))
                    frames[name][step] = value
                labels.append(self._label(observation[OBSERVATION_GROUP]))
                sites = self.view.sites(frame, augment=True)
                output = self.student(self._encode(sites)[None], frame["action"][None], self._hidden)
                action, std = output.mean[0], output.log_std[0].exp()
                log = imitation_log(output.distance[0, :, -1], frame["distance"], action, labels[-1])
                if cfg.imitation == "likelihood":
                    action = action + std * torch.randn_like(action)
                if share > 0.0:
                    teacher = torch.rand((worlds, 1), device=self.device) < share
                    action = torch.where(teacher, labels[-1], action)
                observation, _, ended, extras = self.env.step(action)
                done[step] = ended.bool()
                self._hidden = output.hidden.masked_fill(done[step, :, None], 0.0)
                log |= extras["log"]
                if cfg.reset and step == cfg.rollout_steps - 1:
                    # Goals that the end of the rollout cuts off would be in no count otherwise.
                    log["task/timed_out"] = log["task/timed_out"] + (~done[step]).float().mean()
                self._means.add(log | {"policy/std": std.mean()})
        rollout = Rollout(frames, torch.stack(labels), done, first, torch.arange(worlds, device=self.device))
        self._check_rollout(rollout)
        return rollout

    def update(self, rollout: Rollout) -> dict[str, float]:
        """All passes over a rollout; means of :data:`STATISTICS` over its minibatches."""
        self.student.train()
        batches = self.minibatches(len(rollout.worlds))
        steps = torch.stack([self._minibatch_step(rollout, sequences) for sequences in batches])
        if self._world_size > 1:
            # Each process averaged its own batch statistics; from here on all use those of the first.
            for buffer in self.student.buffers():
                torch.distributed.broadcast(buffer, 0)
        losses = dict(zip(STATISTICS, steps.mean(dim=0).tolist(), strict=True))
        bad = [name for name, value in losses.items() if not math.isfinite(value)]
        if bad or not all_finite(self.student):
            raise TrainingDivergedError(
                f"{', '.join(bad) or 'weights'} not finite after the update; {LOWER_RATES}"
            )
        return losses

    def minibatches(self, sequences: int) -> Iterator[torch.Tensor]:
        """Sequences of each optimiser step: as many a pass as there are worlds, none twice, in a new order.

        Of the latest rollout alone that is every world once. The last minibatch of a pass may be smaller.
        """
        for _ in range(self.cfg.epochs):
            order = torch.randperm(sequences, device=self.device)[: self.env.num_envs]
            yield from order.split(self.cfg.minibatch_worlds)

    def losses(self, rollout: Rollout, sequences: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Imitation and distance loss of some sequences, with new noise on their clouds."""
        frames = {name: value[:, sequences] for name, value in rollout.frames.items()}
        steps, count = frames["action"].shape[:2]
        flat = {name: value.flatten(0, 1) for name, value in frames.items()}
        sites = self.view.sites(flat, rollout.worlds[sequences].repeat(steps), augment=True)
        embedding = self._encode(sites).view(steps, count, -1)
        hidden, done = rollout.hidden[sequences], rollout.done[:, sequences]
        output = self.student(embedding, frames["action"], hidden, done)
        imitation = imitation_loss(output, rollout.label[:, sequences], self.cfg.imitation)
        return imitation, distance_loss(output.distance, frames["distance"])

    def state_dict(self) -> dict[str, Any]:
        """What all processes share besides the network: optimiser, and the window of rates."""
        return {"optimizer": self.optimizer.state_dict(), "window": self._window.state_dict()}

    def load_state_dict(self, state: dict[str, Any], iteration: int) -> None:
        """Restore what :meth:`state_dict` gave."""
        self.optimizer.load_state_dict(state["optimizer"])
        self._window.load_state_dict(state["window"])
        self.iteration = iteration

    def local_state(self) -> dict[str, Any]:
        """What belongs to this process: its worlds, random states, the student's memory, kept rollouts."""
        # The next iteration drops the oldest: one that stands alone, or the first of a full store.
        kept = list(self._kept)[-(self.cfg.keep_rollouts - 1) :] if self.cfg.keep_rollouts > 1 else []
        return {
            "env": self.env.state_dict(),
            "view": self.view.state_dict(),
            "hidden": self._hidden.cpu(),
            "scene": self._scene,
            "rollouts": [moved(rollout, "cpu") for rollout in kept],
        }

    def load_local_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`local_state` gave."""
        self.env.load_state_dict(state["env"])
        self.view.load_state_dict(state["view"])
        self._hidden = state["hidden"].to(self.device)
        self._scene = state["scene"]
        self._kept.clear()
        self._kept.extend(Rollout(**moved(rollout, self.device)) for rollout in state["rollouts"])

    def fits(self, ranks: list[dict[str, Any]]) -> str:
        """Why the worlds of a checkpoint cannot be restored; empty if they can."""
        if len(ranks) != self._world_size:
            return f"it is of {len(ranks)} processes, this run has {self._world_size}"
        worlds = {len(rank["local"]["hidden"]) for rank in ranks}
        if worlds != {self.env.num_envs}:
            return f"it is of {max(worlds)} worlds a process, this run has {self.env.num_envs}"
        return ""

    def close(self) -> None:
        """Release the simulation."""
        self.env.close()

    def _begin_episodes(self) -> None:
        if self._scene is not None:
            self.env.load_state_dict(self._scene)
            return
        self.env.env.reset()
        if self.cfg.same_scene:
            self._scene = self.env.state_dict()

    def _label(self, observation: torch.Tensor) -> torch.Tensor:
        label = self.teacher.act(observation)
        return label.clamp(-1.0, 1.0) if self.cfg.clip_labels else label

    def _encode(self, sites: tuple[Sites, ...]) -> torch.Tensor:
        """Embeddings; what follows the encoder is small, and stays in single precision."""
        with autocast(self.device, self.cfg.precision):
            return self.student.encode(*sites).float()

    def _minibatch_step(self, rollout: Rollout, sequences: torch.Tensor) -> torch.Tensor:
        """One optimiser step; :data:`STATISTICS` on the device."""
        imitation, distance = self.losses(rollout, sequences)
        norm = descend(
            self.student,
            self.optimizer,
            imitation + self.cfg.distance_weight * distance,
            self.cfg.grad_norm,
            self._world_size,
        )
        return torch.stack((imitation.detach(), distance.detach(), norm))

    def _check_rollout(self, rollout: Rollout) -> None:
        """Stop before an update on values that are not finite."""
        tensors = {"the teacher's actions": rollout.label, **rollout.frames}
        tensors.pop("points", None)  # where there is no point it is NaN, on purpose
        finite = torch.stack([torch.isfinite(tensor).all() for tensor in tensors.values()]).tolist()
        bad = [name for name, good in zip(tensors, finite, strict=True) if not good]
        if bad or not bool(torch.isfinite(self._hidden).all()):
            self.env.check()  # says more, if the simulation is the cause
            what = ", ".join(bad) or "the student's memory"
            raise TrainingDivergedError(f"{what} not finite in the rollout; {LOWER_RATES}")


def merged(rollouts: Sequence[Rollout]) -> Rollout:
    """The sequences of several rollouts of equal length as one."""
    if len(rollouts) == 1:
        return rollouts[0]
    return Rollout(
        {name: torch.cat([one.frames[name] for one in rollouts], dim=1) for name in rollouts[0].frames},
        torch.cat([one.label for one in rollouts], dim=1),
        torch.cat([one.done for one in rollouts], dim=1),
        torch.cat([one.hidden for one in rollouts]),
        torch.cat([one.worlds for one in rollouts]),
    )


def moved(rollout: Rollout | dict[str, Any], device: str | torch.device) -> dict[str, Any]:
    """A rollout, or the dictionary of one, as a dictionary of tensors on ``device``."""
    values = rollout if isinstance(rollout, dict) else asdict(rollout)
    return {
        name: moved(value, device) if isinstance(value, dict) else value.to(device)
        for name, value in values.items()
    }


def imitation_log(
    predicted: torch.Tensor, true: torch.Tensor, action: torch.Tensor, label: torch.Tensor
) -> dict[str, torch.Tensor]:
    """Errors of a step of N worlds while the student acts: root mean square of actions, distances [rad]."""
    return {
        "student/action_error": (action - label).square().mean().sqrt(),
        "student/distance_error": (predicted - true).abs().mean(),
    }


def make_optimizer(student: nn.Module, learning_rate: float) -> torch.optim.Optimizer:
    """AdamW with amsgrad, as in the released code."""
    return torch.optim.AdamW(student.parameters(), lr=learning_rate, amsgrad=True)


def autocast(device: torch.device, precision: str) -> torch.autocast:
    """Products in half precision where ``precision`` is ``bf16``."""
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=precision == "bf16")


def descend(
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    loss: torch.Tensor,
    grad_norm: float,
    world_size: int = 1,
) -> torch.Tensor:
    """One optimiser step on the gradient of ``loss``, averaged over processes and clipped.

    Returns:
        Norm of the gradient before clipping, a scalar on the device.
    """
    optimizer.zero_grad()
    loss.backward()
    parameters = list(network.parameters())
    if world_size > 1:
        # Every process has to take part with every weight, also one whose loss does not reach it.
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        torch.distributed.all_reduce(flat)
        flat /= world_size
        parts = flat.split([p.numel() for p in parameters])
        for parameter, part in zip(parameters, parts, strict=True):
            if parameter.grad is not None:
                parameter.grad.copy_(part.view_as(parameter))
    norm = nn.utils.clip_grad_norm_(parameters, grad_norm)
    optimizer.step()
    return norm.detach()


def all_finite(network: nn.Module) -> bool:
    """Whether all weights are; one wait for the device."""
    return math.isfinite(float(torch.stack([p.detach().sum() for p in network.parameters()]).sum()))
