"""Symmetry views that a critic selects, for goals that are not reached.

A policy of views knows a scene that is turned from finger to finger, or seen in the mirror, as another scene:
where it is stuck in one it may not be in the other, and what its critic expects of each says where to go on.
O values of the observation.
"""

from collections.abc import Callable

import torch

from vd.views import ViewMaps

AFTER_S = 3.0
"""Time after which a goal that is not reached is looked at again [s] (ours): four in five are by then."""
EVERY_S = 1.0
"""Between two looks [s] (ours). Chosen with AFTER_S on 636 episodes, judged on others."""


class ViewSelection:
    """Which environments look at their goals again, and in which views they go on, by a critic.

    Args:
        maps: The views of the hand, all that may be selected.
        control_hz: Control steps a second.
    """

    def __init__(self, maps: ViewMaps, control_hz: float) -> None:
        self.maps = maps
        self._after, self._every = round(AFTER_S * control_hz), round(EVERY_S * control_hz)

    def due(self, goal_steps: torch.Tensor) -> torch.Tensor:
        """Environments to look again if far [N], so many control steps after their goal was new [N]."""
        late = goal_steps - self._after
        return (late >= 0) & (late % self._every == 0)

    def of(self, world: torch.Tensor) -> torch.Tensor:
        """Views to choose from [C, M] for observations in the world frame [M, O].

        They are, of a hand that is its own mirror image, the view in whose sector the goal lies now and that
        in the mirror; else all views.
        """
        fingers = self.maps.fingers
        if len(self.maps) > fingers:
            near = self.maps.nearness(world).unflatten(-1, (2, fingers)).argmax(dim=-1)
            return torch.stack((near[:, 0], near[:, 1] + fingers))
        return torch.arange(fingers, device=world.device)[:, None].expand(-1, len(world))

    def better(self, world: torch.Tensor, value: Callable[[torch.Tensor], torch.Tensor]) -> torch.Tensor:
        """Views [M] of which most is expected.

        Args:
            world: Observations in the world frame [M, O].
            value: What a critic expects [M] of observations as a view shows them [M, O].
        """
        views = self.of(world)
        expected = torch.stack([value(self.maps.take(world, view)) for view in views])
        return views.gather(0, expected.argmax(dim=0, keepdim=True))[0]
