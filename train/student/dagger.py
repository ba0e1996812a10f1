"""Imitation of the teacher on what the student does: rollouts, labels, and updates through whole sequences.

T steps, N environments, D actions, G the student's memory.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

import torch
from torch import nn

from vd.policy import Policy
from vd.train.ending import TrainingDivergedError
from vd.train.metrics import GoalWindow, StepMeans
from vd.train.student.config import DaggerCfg
from vd.train.student.losses import (
    POSE_VALUES,
    distance_loss,
    imitation_figures,
    imitation_loss,
    in_view,
    match_loss,
    poses,
)
from vd.train.student.optimise import all_finite, autocast, descend, make_optimizer, scheduled
from vd.train.student.rollout import UNCLIPPED, Rollout, moved, rollout_bytes, taken
from vd.train.student.rotations import angle_between
from vd.train.vec_env import OBSERVATION_GROUP, ReorientVecEnv
from vd.vision.match import Matches
from vd.vision.network import Student, StudentOutput
from vd.vision.sites import Sites
from vd.vision.state import StateHead

CHECKPOINT_ROLLOUT_BYTES = 2**28
"""Kept rollouts that are larger together, those with camera points, are not written into checkpoints: a run
that goes on from one begins with the rollouts to come."""
FIT_BATCHES = 16
"""Minibatches of the first rollout that the first estimate of the teacher's observation is fitted to."""
LOWER_RATES = "lower --dagger.learning-rate or --dagger.grad-norm, or take --dagger.precision fp32"
"""Remedy for a network that diverges."""


class View(Protocol):
    """What the student sees of the environment (:class:`vd.evaluate.student.StudentView`)."""

    def frame(self) -> dict[str, torch.Tensor]:
        """Tensors [N, ...] of the present state, among them the student's senses and ``distance`` [N]."""
        ...

    def observation(self, observed: torch.Tensor) -> torch.Tensor:
        """What the teacher would observe if of all that looks like its goal the nearest were its goal."""
        ...

    def sites(
        self, frame: Mapping[str, torch.Tensor], envs: torch.Tensor | None = None, *, augment: bool
    ) -> tuple[Sites, ...]:
        """Voxels of frames [R, ...] of the given environments [R]."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Random states."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore them."""
        ...


class Dagger:
    """Trains a student by the labels of a teacher that sees the noise-free state (Ross et al. 2011).

    One iteration: the student acts T steps in N environments and the teacher labels every state; then some
    passes over the environments, whole sequences in each minibatch, gradients through all T steps except
    across ends of episodes. As in the released code only the latest rollout is learned from, unless more are
    to be kept. In rollouts batch norms use their running statistics, as they do where the student is
    deployed.

    The last environments may be held out: nothing is learned from them, and their sequences of the first
    episode are the fixed set on which each iteration measures the error, whatever states the student comes
    to.

    Args:
        env: The environments.
        view: What the student sees of them.
        student: The network.
        teacher: Labels observations of ``env``, once [N, D] or in each view that the student may take
            [N, F, D]: then the label of a state is that of the view the student takes.
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
        self.pose: nn.Module | None = None
        """Predicts :func:`poses` from embeddings, in training only."""
        if cfg.pose_weight > 0.0:
            width, inside = student.cfg.encoder.embedding, student.cfg.distance_hidden
            layers = (nn.Linear(width, inside), nn.GELU(), nn.Linear(inside, POSE_VALUES))
            self.pose = nn.Sequential(*layers).to(self.device)
        self.weights = {
            "imitation": 1.0,
            "distance": cfg.distance_weight,
            "pose": cfg.pose_weight,
            "state": cfg.state_weight,
            "match": cfg.match_weight,
        }
        """Weights of the losses."""
        self.network = nn.ModuleList([student, *([] if self.pose is None else [self.pose])])
        """All that is trained."""
        self.optimizer = make_optimizer(self.network, cfg.learning_rate, amsgrad=cfg.amsgrad)
        self.samples_per_iteration = cfg.rollout_steps * env.num_envs
        self.iteration = 0
        """Iterations completed; decides the teacher's share."""
        self._world_size = world_size
        self._hidden = student.initial_hidden(env.num_envs)
        self._window = GoalWindow(math.ceil(2 * env.max_episode_length / cfg.rollout_steps))
        self._means = StepMeans()
        self._scene: dict[str, Any] | None = None
        self._kept: deque[Rollout] = deque(maxlen=cfg.keep_rollouts)
        self._held_out: list[Rollout] = []
        self._steps_done = 0
        self._figures: dict[str, torch.Tensor] = {}
        self._episode_rollouts = math.ceil(env.max_episode_length / cfg.rollout_steps)
        self._learned_worlds = env.num_envs - cfg.validation_envs
        if self._learned_worlds < 1:
            raise ValueError(
                f"--dagger.validation-envs {cfg.validation_envs} leaves none of {env.num_envs} environments "
                "to learn from; give fewer, or more --num-envs"
            )

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
        means = self._means.read(self._world_size) | self._read(self._figures)
        collected = time.perf_counter()
        self._kept.append(rollout)
        if self.cfg.validation_envs and len(self._held_out) < self._episode_rollouts:
            held_out = torch.arange(self._learned_worlds, self.env.num_envs, device=self.device)
            self._held_out.append(taken([rollout], held_out))
        state = self.student.state
        if state is not None and not state.fitted:
            self._fit_state(state, rollout)
        losses = self.update(list(self._kept))
        learned = time.perf_counter()
        figures = self.validate()
        self.iteration += 1
        return {
            "collect_s": round(collected - start, 4),
            "learn_s": round(learned - collected, 4),
            **self._window.add(means),
            **means,
            **self.env.end_iteration(),
            **losses,
            **figures,
        }

    def teacher_share(self) -> float:
        """Share of environments in which the teacher acts in this iteration."""
        first, last, iterations = (
            self.cfg.teacher_share,
            self.cfg.teacher_share_last,
            self.cfg.teacher_share_iterations,
        )
        if iterations == 0:
            return first
        return first + (last - first) * min(1.0, self.iteration / iterations)

    def collect(self, stopping: Callable[[], bool] = lambda: False) -> Rollout | None:
        """Let the student act, and the teacher label; ``None`` if ``stopping`` said so on the way."""
        cfg, envs = self.cfg, self.env.num_envs
        self.student.eval()
        if cfg.reset:
            self._begin_episodes()
            self._hidden = self.student.initial_hidden(envs)
        first = self._hidden
        # Whole rollouts of a world: mixed from step to step it would be what neither of the two does.
        taught = torch.rand((envs, 1), device=self.device) < self.teacher_share()
        frames: dict[str, torch.Tensor] = {}
        labels: list[torch.Tensor] = []
        wanted: list[torch.Tensor] = []
        means: list[torch.Tensor] = []
        done = torch.zeros((cfg.rollout_steps, envs), dtype=torch.bool, device=self.device)
        with torch.no_grad():
            observation = self.env.get_observations()
            for step in range(cfg.rollout_steps):
                if stopping():
                    self._means.clear()
                    return None
                frame, observed = self.view.frame(), self.view.observation(observation[OBSERVATION_GROUP])
                if self.student.state is not None:
                    frame["observation"] = observed
                for name, value in frame.items():
                    if step == 0:
                        # A tenth of a millimetre is lost of camera points, and half of the memory won.
                        dtype = torch.half if name in UNCLIPPED else value.dtype
                        frames[name] = value.new_empty((cfg.rollout_steps, *value.shape), dtype=dtype)
                    frames[name][step] = value
                labels.append(self._label(observed))
                sites = self.view.sites(frame, augment=True)
                senses = self.student.senses(frame)
                output = self.student(self._look(sites)[0][None], senses[None], self._hidden)
                action, std = output.mean[0], output.log_std[0].exp()
                means.append(action)
                wanted.append(in_view(labels[-1], output.view[0]))
                error = (output.distance[0, :, -1] - frame["distance"]).abs().mean()
                if cfg.imitation == "likelihood":
                    action = action + std * torch.randn_like(action)
                action = torch.where(taught, in_view(labels[-1], self._true_view(observed)), action)
                observation, _, ended, extras = self.env.step(action)
                done[step] = ended.bool()
                self._hidden = output.hidden.masked_fill(done[step, :, None], 0.0)
                log = {"student/distance_error": error, **extras["log"]}
                if cfg.reset and step == cfg.rollout_steps - 1:
                    # Goals that the end of the rollout cuts off would be in no count otherwise.
                    log["task/timed_out"] = log["task/timed_out"] + (~done[step]).float().mean()
                self._means.add(log | {"policy/std": std.mean()})
        rollout = Rollout(frames, torch.stack(labels), done, first, torch.arange(envs, device=self.device))
        own = ~taught[:, 0] if not bool(taught.all()) else taught[:, 0]
        self._figures = imitation_figures("student", torch.stack(means)[:, own], torch.stack(wanted)[:, own])
        self._check_rollout(rollout)
        return rollout

    def validate(self) -> Mapping[str, float | None]:
        """Error on the sequences that were held out, without noise; none before an episode of them is there.

        The memory runs on through the whole episode, as the student's own does.
        """
        if not self.cfg.validation_envs:
            return {}
        names = ["action_error", "zero_error", "unexplained", "distance_error"]
        if self.pose is not None:
            names.append("rotation_error")
        if len(self._held_out) < self._episode_rollouts:
            return {f"validation/{name}": None for name in names}
        self.student.eval()
        hidden = self.student.initial_hidden(self.cfg.validation_envs)
        means, wanted, errors, turns = [], [], [], []
        with torch.no_grad():
            for part in self._held_out:
                output, embedding, _ = self._run(part, hidden, augment=False)
                hidden = output.hidden.masked_fill(part.done[-1, :, None], 0.0)
                means.append(output.mean)
                wanted.append(in_view(part.label, output.view))
                if self.pose is not None:
                    turns.append(angle_between(self.pose(embedding)[..., 3:], poses(part.frames)[..., 3:]))
                errors.append((output.distance[..., -1] - part.frames["distance"]).abs())
        figures = imitation_figures("validation", torch.cat(means), torch.cat(wanted))
        figures["validation/distance_error"] = torch.cat(errors).mean()
        if turns:
            figures["validation/rotation_error"] = torch.cat(turns).mean()
        return self._read(figures)

    def update(self, rollouts: Sequence[Rollout]) -> dict[str, float]:
        """All passes over rollouts; means of its losses over the minibatches."""
        self.student.train()
        batches = self.minibatches(len(rollouts))
        steps = [self._minibatch_step(taken(rollouts, sequences)) for sequences in batches]
        if self._world_size > 1:
            # Each process averaged its own batch statistics; from here on all use those of the first.
            for buffer in self.student.buffers():
                torch.distributed.broadcast(buffer, 0)
        means = torch.stack([torch.stack(tuple(step.values())) for step in steps]).mean(dim=0)
        losses = dict(zip(steps[0], means.tolist(), strict=True))
        bad = [name for name, value in losses.items() if not math.isfinite(value)]
        if bad or not all_finite(self.network):
            raise TrainingDivergedError(
                f"{', '.join(bad) or 'weights'} not finite after the update; {LOWER_RATES}"
            )
        return losses

    def minibatches(self, rollouts: int) -> Iterator[torch.Tensor]:
        """Sequences of each optimiser step: each environment once a pass, in a new order.

        Sequence n of rollout k is number k N + n; those of environments that are held out never come. Of the
        latest rollout alone that is every other world once. The last minibatch of a pass may be smaller.
        """
        learned, envs = self._learned_worlds, self.env.num_envs
        for _ in range(self.cfg.epochs):
            order = torch.randperm(rollouts * learned, device=self.device)[:learned]
            yield from (order // learned * envs + order % learned).split(self.cfg.minibatch_envs)

    def losses(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """Losses of sequences by name, with new noise on their clouds; their weights are in ``weights``."""
        output, embedding, matches = self._run(rollout, rollout.hidden, augment=True)
        found = {
            "imitation": imitation_loss(
                output,
                in_view(rollout.label, output.view),
                self.cfg.imitation,
                bounded=self.cfg.clip_labels,
            ),
            "distance": distance_loss(output.distance, rollout.frames["distance"]),
        }
        if self.pose is not None:
            error = self.pose(embedding) - poses(rollout.frames)
            found["pose"] = error.square().mean()
        if self.student.state is not None:
            error = output.state - self.student.state.target(rollout.frames["observation"])
            found["state"] = error.square().mean()
        if matches is not None and self.cfg.match_weight > 0.0:
            poses_of = (rollout.frames[name].flatten(0, 1) for name in ("body_q", "goal_quat"))
            found["match"] = match_loss(matches, *poses_of)
        return found

    def state_dict(self) -> dict[str, Any]:
        """What all processes share besides the network: optimiser, and the window of rates."""
        return {
            "optimizer": self.optimizer.state_dict(),
            "steps": self._steps_done,
            "pose": None if self.pose is None else self.pose.state_dict(),
            "window": self._window.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any], iteration: int) -> None:
        """Restore what :meth:`state_dict` gave."""
        self.optimizer.load_state_dict(state["optimizer"])
        self._steps_done = state["steps"]
        if self.pose is not None:
            self.pose.load_state_dict(state["pose"])
        self._window.load_state_dict(state["window"])
        self.iteration = iteration

    def local_state(self) -> dict[str, Any]:
        """What belongs to this process: environments, random states, the student's memory, kept rollouts."""
        # The next iteration drops the oldest: one that stands alone, or the first of a full store.
        kept = list(self._kept)[-(self.cfg.keep_rollouts - 1) :] if self.cfg.keep_rollouts > 1 else []
        if sum(rollout_bytes(rollout) for rollout in kept) > CHECKPOINT_ROLLOUT_BYTES:
            kept = []
        return {
            "env": self.env.state_dict(),
            "view": self.view.state_dict(),
            "hidden": self._hidden.cpu(),
            "scene": self._scene,
            "rollouts": [moved(rollout, "cpu") for rollout in kept],
            "held_out": [moved(rollout, "cpu") for rollout in self._held_out],
        }

    def load_local_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`local_state` gave."""
        self.env.load_state_dict(state["env"])
        self.view.load_state_dict(state["view"])
        self._hidden = state["hidden"].to(self.device)
        self._scene = state["scene"]
        self._kept.clear()
        self._kept.extend(Rollout(**moved(rollout, self.device)) for rollout in state["rollouts"])
        self._held_out = [Rollout(**moved(rollout, self.device)) for rollout in state["held_out"]]

    def fits(self, ranks: list[dict[str, Any]]) -> str:
        """Why the environments of a checkpoint cannot be restored; empty if they can."""
        if len(ranks) != self._world_size:
            return f"it is of {len(ranks)} processes, this run has {self._world_size}"
        envs = {len(rank["local"]["hidden"]) for rank in ranks}
        if envs != {self.env.num_envs}:
            return f"it is of {max(envs)} environments a process, this run has {self.env.num_envs}"
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

    def _true_view(self, observation: torch.Tensor) -> torch.Tensor:
        """The view that each state calls for [N]: the one in which the teacher acts itself."""
        state = self.student.state
        if state is None or state.views is None:
            return torch.zeros(len(observation), dtype=torch.long, device=self.device)
        return state.views.choose(observation)

    def _look(self, sites: tuple[Sites, ...]) -> tuple[torch.Tensor, Matches | None]:
        """Embeddings and matches; what follows the encoder is small, and stays in single precision."""
        with autocast(self.device, self.cfg.precision):
            embedding, matches = self.student.look(*sites)
        return embedding.float(), matches

    def _run(
        self, rollout: Rollout, hidden: torch.Tensor, *, augment: bool
    ) -> tuple[StudentOutput, torch.Tensor, Matches | None]:
        """What the student says to sequences of frames, with memory before the first of them [N, G].

        Returns:
            That, the embeddings of the clouds [T, N, E], and the matches of the T N clouds.
        """
        steps, count = rollout.done.shape
        flat = {name: value.flatten(0, 1) for name, value in rollout.frames.items()}
        sites = self.view.sites(flat, rollout.envs.repeat(steps), augment=augment)
        embedding, matches = self._look(sites)
        embedding = embedding.view(steps, count, -1)
        output = self.student(embedding, self.student.senses(rollout.frames), hidden, rollout.done)
        return output, embedding, matches

    def _fit_state(self, state: StateHead, rollout: Rollout) -> None:
        """Let the estimate of the teacher's observation begin with the best one in least squares."""
        self.student.train()  # as in the updates that follow
        seen, observed = [], []
        envs = torch.arange(self._learned_worlds, device=self.device)
        with torch.no_grad():
            for some in envs.split(self.cfg.minibatch_envs)[:FIT_BATCHES]:
                part = taken([rollout], some)
                output, _, _ = self._run(part, part.hidden, augment=True)
                seen.append(output.seen.flatten(0, 1))
                observed.append(part.frames["observation"].flatten(0, 1))
        state.fit(torch.cat(seen), torch.cat(observed))
        if self._world_size > 1:
            for weight in state.estimate.parameters():
                torch.distributed.broadcast(weight.data, 0)

    def _minibatch_step(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """One optimiser step; its losses and the gradient's norm, on the device."""
        losses = self.losses(rollout)
        total = torch.stack([self.weights[name] * loss for name, loss in losses.items()]).sum()
        self._steps_done += 1
        for group in self.optimizer.param_groups:
            group["lr"] = scheduled(
                self.cfg.learning_rate,
                self._steps_done,
                warmup=self.cfg.warmup_steps,
                decay_after=self.cfg.decay_after_steps,
            )
        norm = descend(
            self.network,
            self.optimizer,
            total,
            self.cfg.grad_norm,
            self._world_size,
        )
        return {f"loss/{name}": loss.detach() for name, loss in losses.items()} | {"loss/grad_norm": norm}

    def _read(self, figures: dict[str, torch.Tensor]) -> dict[str, float]:
        """Scalars averaged over the processes; waits for the device."""
        values = torch.stack(tuple(figures.values()))
        if self._world_size > 1:
            torch.distributed.all_reduce(values)
            values /= self._world_size
        return dict(zip(figures, values.tolist(), strict=True))

    def _check_rollout(self, rollout: Rollout) -> None:
        """Stop before an update on values that are not finite."""
        tensors = {"the teacher's actions": rollout.label, **rollout.frames}
        for name in UNCLIPPED:
            tensors.pop(name, None)
        finite = torch.stack([torch.isfinite(tensor).all() for tensor in tensors.values()]).tolist()
        bad = [name for name, good in zip(tensors, finite, strict=True) if not good]
        if bad or not bool(torch.isfinite(self._hidden).all()):
            self.env.check()  # says more, if the simulation is the cause
            what = ", ".join(bad) or "the student's memory"
            raise TrainingDivergedError(f"{what} not finite in the rollout; {LOWER_RATES}")
