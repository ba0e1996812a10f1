"""Objects by failure: samples weigh more, the more often goals with their object are missed."""

from typing import Any

import numpy as np
import torch

KEPT = 0.99
"""Share of the counts that stays after an iteration (ours, not tuned): the mean is of the last
hundred, a minute."""


class ObjectFailures:
    """How often goals with each object are reached, and what samples of it weigh.

    Which objects environments have is built into their worlds, and to build them anew takes a
    minute and more. Weights of samples have the same gradient in the mean as objects that are drawn
    by these weights.

    Args:
        world_object: Object of each environment, shape [N].
        floor: What a sample weighs beside the share of goals that are missed with its object.
        device: Torch device.
    """

    def __init__(self, world_object: np.ndarray, floor: float, device: str) -> None:
        self._object = torch.as_tensor(world_object, dtype=torch.long, device=device)
        self._floor = floor
        # Begun goals and reached ones; one of two before anything is known.
        self._counts = torch.ones(int(self._object.max()) + 1, 2, device=device)
        self._counts[:, 0] = 2.0

    def add(self, ended: torch.Tensor, reached: torch.Tensor) -> None:
        """Count the goals of a step, by environment [N]."""
        goals = torch.stack([(ended > 0).float(), (reached > 0).float()], dim=1)
        self._counts.index_add_(0, self._object, goals)

    def end_iteration(self, world_size: int) -> None:
        """Forget a little; all processes come to the same counts."""
        self._counts *= KEPT
        if world_size > 1:
            torch.distributed.all_reduce(self._counts)
            self._counts /= world_size

    def success(self) -> torch.Tensor:
        """Share of the goals that are reached with each object, shape [K]."""
        return self._counts[:, 1] / self._counts[:, 0].clamp_min(1e-6)

    def weights(self) -> torch.Tensor:
        """Weights of the samples of each environment, 1 in the mean, shape [N]."""
        weights = (1.0 - self.success() + self._floor)[self._object]
        return weights / weights.mean()

    def state_dict(self) -> dict[str, Any]:
        """The counts."""
        return {"counts": self._counts.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore :meth:`state_dict`; of other objects nothing is known."""
        if state["counts"].shape == self._counts.shape:
            self._counts.copy_(state["counts"])
