"""The training loop around a learner of the student: imitation or pre-training."""

from pathlib import Path
from typing import Any

import torch

from vd.config import to_dict
from vd.train.checkpoint import load_checkpoint, save_checkpoint
from vd.train.config import RunCfg
from vd.train.loop import TrainingLoop
from vd.train.student.config import STUDENT_NAME
from vd.train.student.dagger import Dagger
from vd.train.student.pretrain import Pretrainer
from vd.vision.saved import StudentSpec, student_export


class StudentRunner(TrainingLoop):
    """Runs a learner of the student.

    The latest student is the one that is kept: imitation learns from ever new rollouts and does not overfit
    one, and its success rate is too noisy to choose by.

    Args:
        learner: What to run.
        run: Run settings.
        spec: Description of the student, kept with it.
        task: The environment's configuration as a dictionary, kept with it.
        depth: The depth camera's configuration as a dictionary, kept with it.
        device: Torch device.
        deadline: ``time.monotonic()`` at which to save and end; ``None`` for no limit.
    """

    def __init__(
        self,
        learner: Dagger | Pretrainer,
        run: RunCfg,
        *,
        spec: StudentSpec,
        task: dict[str, Any],
        depth: dict[str, Any],
        device: str,
        deadline: float | None = None,
    ) -> None:
        super().__init__(run, device=device, deadline=deadline)
        self.learner, self.spec, self.task, self.depth = learner, spec, task, depth

    def load(self, path: Path) -> None:
        """Go on from a checkpoint: exactly, with its processes and environments; else with new episodes.

        Args:
            path: The checkpoint.

        Raises:
            ValueError: The file is damaged, or of another network.
        """
        state = load_checkpoint(path, self.device, network="student")
        try:
            self.learner.student.load_state_dict(state["student_state_dict"])
            self.learner.load_state_dict(state["learner"], state["iter"])
        except (RuntimeError, ValueError, KeyError) as error:
            raise ValueError(
                f"{path} does not fit this run's network; resume with the configuration it was trained with "
                f"(its run folder's config.json), or start anew ({error})"
            ) from error
        self._restore(state)

    def _samples(self) -> int:
        return self.learner.samples_per_iteration

    def _begin(self) -> None:
        if self.is_distributed:
            for value in self.learner.network.state_dict().values():
                torch.distributed.broadcast(value, 0)

    def _iterate(self) -> dict[str, Any] | None:
        return self.learner.iterate(self._stopping)

    def _shared_state(self) -> dict[str, Any]:
        return {
            "student_state_dict": self.learner.student.state_dict(),
            "learner": self.learner.state_dict(),
            "spec": to_dict(self.spec),
            "task": self.task,
            "depth": self.depth,
        }

    def _own_state(self) -> dict[str, Any]:
        return {"local": self.learner.local_state()}

    def _load_own_state(self, state: dict[str, Any]) -> None:
        self.learner.load_local_state(state["local"])

    def _misfit(self, ranks: list[dict[str, Any]]) -> str:
        return self.learner.misfit([rank["local"] for rank in ranks])

    def _save_policy(self, path: Path, state: dict[str, Any]) -> None:
        save_checkpoint(self.run.out / STUDENT_NAME, student_export(state))

    def _close(self) -> None:
        self.learner.close()
