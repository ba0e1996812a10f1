"""What imitation and alignment share: the training loop of a network, its checkpoints and its file."""

import math
from pathlib import Path
from typing import Any

import torch
from torch import nn

from vd.config import to_dict
from vd.train.checkpoint import load_checkpoint, save_checkpoint
from vd.train.config import RunCfg
from vd.train.loop import TrainingLoop
from vd.train.student.config import STUDENT_NAME
from vd.vision.saved import AlignmentSpec, StudentSpec, student_export
from vd.vision.sites import Sites


class StudentRunner(TrainingLoop):
    """Trains a student, or the network of alignment.

    The latest student is the one that is kept: imitation learns from ever new rollouts and does not overfit
    one, and its success rate is too noisy to choose by.

    Args:
        student: The network.
        heads: Networks of the training alone.
        run: Run settings.
        amsgrad: Never forget the largest gradients.
        spec: Description of the student, kept with it.
        task: The environment's configuration as a dictionary, kept with it.
        depth: The depth camera's configuration as a dictionary, kept with it.
        device: Torch device.
        deadline: ``time.monotonic()`` at which to save and end; ``None`` for no limit.
    """

    def __init__(
        self,
        student: nn.Module,
        heads: dict[str, nn.Module],
        run: RunCfg,
        *,
        amsgrad: bool = False,
        spec: StudentSpec | AlignmentSpec,
        task: dict[str, Any],
        depth: dict[str, Any],
        device: str,
        deadline: float | None = None,
    ) -> None:
        super().__init__(run, device=device, deadline=deadline)
        self.student, self.spec, self.task, self.depth = student, spec, task, depth
        self.heads = nn.ModuleDict(heads).to(device)
        self.networks = nn.ModuleList([student, self.heads])
        """All that is trained."""
        self.optimizer = torch.optim.AdamW(self.networks.parameters(), amsgrad=amsgrad)
        self._steps_done = 0

    def load(self, path: Path) -> None:
        """Go on from a checkpoint: exactly, with its processes and environments; else with new episodes.

        Args:
            path: The checkpoint.

        Raises:
            ValueError: The file is damaged, or of another network.
        """
        state = load_checkpoint(path, self.device, network="student")
        try:
            self.student.load_state_dict(state["student_state_dict"])
            self._load_learner(state["learner"])
            self._restore(state)
        except (RuntimeError, ValueError, KeyError) as error:
            raise ValueError(
                f"{path} does not fit this run's network; resume with the configuration it was trained with "
                f"(its run folder's config.json), or start anew ({error})"
            ) from error

    def _descend(self, loss: torch.Tensor, *, rate: float, grad_norm: float) -> torch.Tensor:
        """One optimiser step on the gradient of ``loss``, averaged over processes and clipped.

        Returns:
            Norm of the gradient before clipping, a scalar on the device.
        """
        self._steps_done += 1
        self.optimizer.param_groups[0]["lr"] = rate
        self.optimizer.zero_grad()
        loss.backward()
        parameters = list(self.networks.parameters())
        if self.is_distributed:
            # Every process has to take part with every weight, also one whose loss does not reach it.
            gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
            flat = nn.utils.parameters_to_vector(gradients)
            torch.distributed.all_reduce(flat)
            nn.utils.vector_to_parameters(flat / self.world_size, gradients)
        norm = nn.utils.clip_grad_norm_(parameters, grad_norm)
        self.optimizer.step()
        return norm.detach()

    def _read(self, figures: dict[str, torch.Tensor]) -> dict[str, float]:
        """Scalars, averaged over the processes; waits for the device."""
        values = torch.stack(tuple(figures.values()))
        if self.is_distributed:
            torch.distributed.all_reduce(values)
            values /= self.world_size
        return dict(zip(figures, values.tolist(), strict=True))

    def _share_statistics(self) -> None:
        """Let all processes use the batch statistics of the first; each has averaged its own."""
        if self.is_distributed:
            for buffer in self.student.buffers():
                torch.distributed.broadcast(buffer, 0)

    def _encode(self, sites: Sites, precision: str) -> torch.Tensor:
        """Embeddings of clouds; with ``bf16`` by products in half precision. What follows is small."""
        half = torch.autocast(torch.device(self.device).type, torch.bfloat16, enabled=precision == "bf16")
        with half:
            return self.student.encode(sites).float()

    def _begin(self) -> None:
        if self.is_distributed:
            for value in self.networks.state_dict().values():
                torch.distributed.broadcast(value, 0)

    def _learner(self) -> dict[str, Any]:
        """What a checkpoint has of the training besides the student."""
        return {
            "optimizer": self.optimizer.state_dict(),
            "steps": self._steps_done,
            "heads": self.heads.state_dict(),
        }

    def _load_learner(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`_learner` gave."""
        self.optimizer.load_state_dict(state["optimizer"])
        self._steps_done = state["steps"]
        self.heads.load_state_dict(state["heads"])

    def _shared_state(self) -> dict[str, Any]:
        return {
            "student_state_dict": self.student.state_dict(),
            "learner": self._learner(),
            "spec": to_dict(self.spec),
            "task": self.task,
            "depth": self.depth,
        }

    def _save_policy(self, path: Path, state: dict[str, Any]) -> None:
        save_checkpoint(self.run.out / STUDENT_NAME, student_export(state))


def scheduled(rate: float, step: int, *, warmup: int = 0, decay_after: int = 0) -> float:
    """Learning rate of an optimiser step, counted from 1.

    Args:
        rate: After the warm-up and until the decay.
        step: Number of the step.
        warmup: Steps over which it rises from 0, linearly.
        decay_after: Step after which it falls as 1 / sqrt(steps); 0: never.
    """
    factor = min(1.0, step / max(1, warmup))
    if decay_after:
        factor *= min(1.0, math.sqrt(decay_after / max(1, step)))
    return factor * rate
