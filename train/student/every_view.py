"""Labels of a teacher in each of its views."""

import torch

from vd.policy import TrainedPolicy
from vd.views import ViewMaps


class EveryView:
    """A teacher of views, in each of them: for a state it has as many actions as there are views.

    Args:
        policy: The teacher.
        maps: Its views.
    """

    def __init__(self, policy: TrainedPolicy, maps: ViewMaps) -> None:
        self.num_actions = policy.num_actions
        self._policy, self._maps = policy, maps

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """Mean actions [N, F, D], in the world's order, for observations in the world frame [N, O]."""
        count, views = len(observation), len(self._maps)
        view = torch.arange(views, device=observation.device).expand(count, views)
        seen = self._maps.take(observation[:, None].expand(-1, views, -1), view)
        action = self._policy.act(seen.flatten(0, 1)).unflatten(0, (count, views))
        return self._maps.world_action(action, view)
