"""The symmetry frames ("views") of a teacher that sees its goals in them, for those without a simulator.

The simulator keeps a view as long as a goal (:mod:`vd.envs.symmetry`). Here it is chosen anew in every step,
from the rotation as it is known: a teacher acts as well so, and nothing has to be remembered. F views, O
values of the observation, D actions. World frame: z up; quaternions xyzw.
"""

from collections.abc import Callable

import torch

from vd.assets_usd.hand_data import HandModel
from vd.envs.cfg import ObservationCfg, View
from vd.envs.view_tables import TERMS, ViewTables, view_tables
from vd.kernels.task.observations import JOINTS_PER_FINGER, teacher_observation_slices

AFTER_S = 3.0
"""Time after which a goal that is not reached is looked at again [s] (ours): four in five are by then."""
EVERY_S = 1.0
"""Between two looks [s] (ours). Chosen with AFTER_S on 636 episodes, judged on others."""


class ViewMaps:
    """From observations in the world frame to views, and from actions in views to the world's joints.

    Args:
        tables: What the views are made of.
        first: Views that :meth:`choose` chooses from, the first ones; all by default.
        device: Torch device.

    Attributes:
        fingers: Fingers of the hand: as many as there are views without those in the mirror.
    """

    def __init__(
        self, tables: ViewTables, *, first: int | None = None, device: str | torch.device = "cpu"
    ) -> None:
        def array(values: object, dtype: torch.dtype) -> torch.Tensor:
            return torch.as_tensor(values).to(device=device, dtype=dtype)

        self._source, self._joints = (array(v, torch.long) for v in (tables.source, tables.joints))
        self._factor, self._offset, self._sign, self._sector = (
            array(v, torch.float32) for v in (tables.factor, tables.offset, tables.sign, tables.sector)
        )
        self._first, self.fingers = first, self._joints.shape[1] // JOINTS_PER_FINGER
        self._turn = teacher_observation_slices(self.fingers)["relative_orientation"]

    def __len__(self) -> int:
        return len(self._sector)

    @classmethod
    def of(
        cls, hand: HandModel, seen: ObservationCfg, view: View, device: str | torch.device = "cpu"
    ) -> "ViewMaps":
        """The views of a hand: those of ``view``, of which those of ``seen.view`` are chosen from.

        Args:
            hand: The hand.
            seen: What its teacher observes.
            view: What goals may be seen in.
            device: Torch device.
        """
        return cls(view_tables(hand, seen, view), first=seen.views(hand.num_fingers), device=device)

    def choose(self, observation: torch.Tensor) -> torch.Tensor:
        """Views [..] of observations [.., O]: the axis of the wanted rotation is in their sector."""
        return self.nearness(observation)[..., : self._first].argmax(dim=-1)

    def nearness(self, observation: torch.Tensor) -> torch.Tensor:
        """How near to the middle of each view's sector that axis is [.., F], the larger the nearer."""
        turn = observation[..., self._turn]
        # Observed is the object from the goal; wanted is the other way, by less than half a turn.
        axis = torch.where(turn[..., 3:] < 0.0, turn[..., :3], -turn[..., :3])
        return axis @ self._sector.T

    def take(self, observation: torch.Tensor, view: torch.Tensor) -> torch.Tensor:
        """Observations [.., O] as views [..] show them."""
        values = observation.gather(-1, self._source[view].flatten(-2)).unflatten(-1, (-1, TERMS))
        return (self._factor[view] * values).sum(dim=-1) + self._offset[view]

    def world_action(self, action: torch.Tensor, view: torch.Tensor) -> torch.Tensor:
        """Actions [.., D] of views [..] with the joints in the world's order."""
        return self._sign[view] * action.gather(-1, self._joints[view])


class ViewSelection:
    """Selects symmetry views by a critic, for goals that are not reached.

    A policy of views knows a scene that is turned from finger to finger, or seen in the mirror, as another
    scene: where it is stuck in one it may not be in the other, and what its critic expects of each says where
    to go on.

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
