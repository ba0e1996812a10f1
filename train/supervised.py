"""Training by labels: one network, one optimiser, a learning rate that falls to the end."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor, nn

from vd.train.checkpoint import load_checkpoint
from vd.train.config import RunCfg
from vd.train.loop import TrainingLoop, check_update

if TYPE_CHECKING:
    from vd.train.alignment.config import AlignCfg
    from vd.train.student.config import LearnCfg
    from vd.train.vec_env import ReorientVecEnv

GRAD_NORM = 1.0
"""Gradient norm is clipped to this."""
LEAST_RATE = 0.02
"""Of the learning rate, at the end of the run."""


class SupervisedLoop(TrainingLoop):
    """Trains a network by labels with AdamW.

    Args:
        network: The network.
        run: Run settings.
        learn: The learning rate, which falls along a cosine to the end of the run, and its warm-up.
        measure_every: Iterations from one measurement to the next.
        task: The environment's configuration as a dictionary, kept with checkpoints.
        device: Torch device.
        env: Environments that checkpoints hold, if any.

    Attributes:
        kind: What the network is called, in checkpoints and on the command line.
        network: The network.
        optimizer: Its optimiser.
    """

    kind: ClassVar[str]

    def __init__(
        self,
        network: nn.Module,
        run: RunCfg,
        learn: "AlignCfg | LearnCfg",
        *,
        measure_every: int,
        task: dict[str, Any],
        device: str,
        env: "ReorientVecEnv | None" = None,
    ) -> None:
        super().__init__(run, device=device, env=env)
        self.network = network
        self.optimizer = torch.optim.AdamW(network.parameters())
        self.task = task
        self._learn = learn
        self._measure_every = measure_every
        self._steps_done = 0

    def load(self, path: Path) -> None:
        """Go on from a checkpoint.

        Args:
            path: The checkpoint.

        Raises:
            ValueError: The file is damaged, or of another network.
        """
        state = load_checkpoint(path, self.device, network=self.kind)
        try:
            self.network.load_state_dict(state[f"{self.kind}_state_dict"])
            self.optimizer.load_state_dict(state["learner"]["optimizer"])
            self._steps_done = state["learner"]["steps"]
            self._restore(state)
        except (RuntimeError, ValueError, KeyError) as error:
            raise ValueError(
                f"{path} does not fit this run's network; resume with the configuration it was "
                f"trained with (its run folder's config.json), or start anew ({error})"
            ) from error

    def _begin(self) -> None:
        if self.is_distributed:
            for value in self.network.state_dict().values():
                torch.distributed.broadcast(value, 0)

    def _descend(
        self, losses: dict[str, Tensor], done: float, parameters: Sequence[nn.Parameter]
    ) -> dict[str, Tensor]:
        """One optimiser step on the gradient of a sum, averaged over processes and clipped.

        Args:
            losses: Losses by name, whose sum it is.
            done: Share of the run that is done.
            parameters: What is to learn.

        Returns:
            The losses, and the norm of the gradient before clipping, scalars on the device.
        """
        self._steps_done += 1
        warm = min(1.0, self._steps_done / max(1, self._learn.warmup_steps))
        left = max(LEAST_RATE, 0.5 * (1.0 + math.cos(math.pi * done)))
        self.optimizer.param_groups[0]["lr"] = self._learn.learning_rate * warm * left
        self.optimizer.zero_grad()
        torch.stack(tuple(losses.values())).sum().backward()
        if self.is_distributed:
            # Every process has to take part with every weight, also one whose loss does not reach
            # it.
            gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
            flat = self._average(nn.utils.parameters_to_vector(gradients))
            nn.utils.vector_to_parameters(flat, gradients)
        norm = nn.utils.clip_grad_norm_(parameters, GRAD_NORM)
        self.optimizer.step()
        logged = {f"loss/{name}": loss.detach() for name, loss in losses.items()}
        logged["loss/grad_norm"] = norm.detach()
        return logged

    def _figures(self, steps: list[dict[str, Tensor]]) -> dict[str, float]:
        """Means over the optimiser steps of an iteration, and every so often what is measured.

        Raises:
            TrainingDivergedError: One is not finite, or a weight.
        """
        means = {name: torch.stack([step[name] for step in steps]).mean() for name in steps[0]}
        iteration = self.iteration + 1
        if iteration % self._measure_every == 0 or iteration == self.total_iterations:
            means |= self.measure()
        figures = self._read(means)
        check_update(figures, self.network, "lower the learning rate, or take fp32 as precision")
        return figures

    def measure(self) -> dict[str, Tensor]:
        """Errors on what is not learned from; empty for none."""
        return {}

    def _average(self, values: Tensor) -> Tensor:
        """Mean over the processes, in place."""
        if self.is_distributed:
            torch.distributed.all_reduce(values)
            values /= self.world_size
        return values

    def _read(self, figures: dict[str, Tensor]) -> dict[str, float]:
        """Scalars, averaged over the processes; waits for the device."""
        values = self._average(torch.stack(tuple(figures.values())))
        return dict(zip(figures, values.tolist(), strict=True))

    def _done(self) -> float:
        """Share of the run that is done, by clouds or by time, whichever is more.

        All processes agree.
        """
        share = self.env_steps / max(1, self.run.max_steps)
        if self.run.max_minutes is not None:
            length = 60.0 * self.run.max_minutes
            share = max(share, 1.0 - self._time_left(length) / length)
        if self.is_distributed:
            agreed = torch.tensor(share, device=self.device)
            torch.distributed.all_reduce(agreed, op=torch.distributed.ReduceOp.MAX)
            share = float(agreed)
        return min(1.0, share)

    def _shared_state(self) -> dict[str, Any]:
        return {
            f"{self.kind}_state_dict": self.network.state_dict(),
            "learner": {"optimizer": self.optimizer.state_dict(), "steps": self._steps_done},
            "task": self.task,
        }
