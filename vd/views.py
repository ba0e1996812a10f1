"""The symmetry frames ("views") of a teacher that sees its goals in them, for those without a simulator.

The simulator keeps a view as long as a goal (:mod:`vd.envs.symmetry`). Here it is chosen anew in every step,
from the rotation as it is known: a teacher acts as well so, and nothing has to be remembered. F views, O
values of the observation, D actions. World frame: z up; quaternions xyzw.
"""

from typing import Any

import torch
from torch import nn

from vd.assets_usd.hand_data import HandModel
from vd.envs.cfg import ObservationCfg
from vd.envs.view_tables import ViewTables, view_tables
from vd.kernels.task.observations import JOINTS_PER_FINGER, teacher_observation_slices

TERMS = 4
"""Most values that a value of a view is made of, those of a quaternion."""
BUFFERS = ("source", "factor", "offset", "joints", "sign", "sector")
"""What views are made of."""


class ViewMaps(nn.Module):
    """From observations in the world frame to views, and from actions in views to the world's joints.

    They map nothing to nothing until :meth:`adopt`.

    Args:
        views: F, as many as the hand has fingers, or twice that with those in the mirror.
        values: O.
        num_actions: D.

    """

    source: torch.Tensor
    factor: torch.Tensor
    offset: torch.Tensor
    joints: torch.Tensor
    sign: torch.Tensor
    sector: torch.Tensor

    def __init__(self, views: int, values: int, num_actions: int) -> None:
        super().__init__()
        self.register_buffer("source", torch.zeros((views, values, TERMS), dtype=torch.long))
        self.register_buffer("factor", torch.zeros((views, values, TERMS)))
        self.register_buffer("offset", torch.zeros((views, values)))
        self.register_buffer("joints", torch.zeros((views, num_actions), dtype=torch.long))
        self.register_buffer("sign", torch.ones((views, num_actions)))
        self.register_buffer("sector", torch.zeros((views, 3)))
        self._turn = teacher_observation_slices(num_actions // JOINTS_PER_FINGER)["relative_orientation"]
        self._register_load_state_dict_pre_hook(self._complete)

    def __len__(self) -> int:
        return len(self.sector)

    @classmethod
    def of(cls, hand: HandModel, seen: ObservationCfg) -> "ViewMaps":
        """The views in which a hand's teacher sees its goals.

        Args:
            hand: The hand.
            seen: What its teacher observes.
        """
        tables = view_tables(hand, seen, seen.view)
        views, values = tables.offset.shape
        maps = cls(views, values, hand.num_joints)
        maps.adopt(tables)
        return maps

    def adopt(self, tables: ViewTables) -> None:
        """Take over the tables of a hand."""
        for name in BUFFERS:
            buffer = getattr(self, name)
            buffer.copy_(torch.as_tensor(getattr(tables, name), dtype=buffer.dtype))

    def choose(self, observation: torch.Tensor) -> torch.Tensor:
        """Views [..] of observations [.., O]: the axis of the wanted rotation is in their sector."""
        turn = observation[..., self._turn]
        # Observed is the object from the goal; wanted is the other way, by less than half a turn.
        axis = torch.where(turn[..., 3:] < 0.0, turn[..., :3], -turn[..., :3])
        return (axis @ self.sector.T).argmax(dim=-1)

    def take(self, observation: torch.Tensor, view: torch.Tensor) -> torch.Tensor:
        """Observations [.., O] as views [..] show them."""
        values = observation.gather(-1, self.source[view].flatten(-2)).unflatten(-1, (-1, TERMS))
        return (self.factor[view] * values).sum(dim=-1) + self.offset[view]

    def world_action(self, action: torch.Tensor, view: torch.Tensor) -> torch.Tensor:
        """Actions [.., D] of views [..] with the joints in the world's order."""
        return self.sign[view] * action.gather(-1, self.joints[view])

    def world_moments(self, mean: torch.Tensor, std: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and standard deviation of values in the world frame [O], from those in a view [O].

        Every view is taken to be as likely as the others, and its values to be uncorrelated.
        """
        views, values, _ = self.source.shape
        maps = mean.new_zeros((views, values, values)).scatter_add(2, self.source, self.factor)
        means = torch.einsum("kvw,kv->kw", maps, mean - self.offset)  # maps are orthogonal
        variance = torch.einsum("kvw,v->kw", maps.square(), std.square()) + means.square()
        centre = means.mean(dim=0)
        return centre, (variance.mean(dim=0) - centre.square()).clamp(min=0.0).sqrt()

    def _complete(self, state: dict[str, Any], prefix: str, *_: Any) -> None:
        """Students from before there were mirrors have neither signs nor offsets."""
        if prefix + "joints" in state:
            state.setdefault(prefix + "sign", torch.ones_like(self.sign))
            state.setdefault(prefix + "offset", torch.zeros_like(self.offset))
