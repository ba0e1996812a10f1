"""The symmetry frames ("views") of a teacher that sees its goals in them, for those without a simulator.

The simulator keeps a view as long as a goal (:mod:`vd.envs.symmetry`). Here it is chosen anew in every step,
from the rotation as it is known: a teacher acts as well so, and nothing has to be remembered. O values of the
observation, D actions. World frame: z up; quaternions xyzw.
"""

import torch

from vd.assets_usd.hand_data import HandModel
from vd.envs.cfg import ObservationCfg
from vd.envs.view_tables import TERMS, view_tables
from vd.kernels.task.observations import teacher_observation_slices


class ViewMaps:
    """From observations in the world frame to views, and from actions in views to the world's joints.

    Args:
        hand: The hand.
        seen: What its teacher observes, and in which views.
        device: Torch device.
    """

    def __init__(self, hand: HandModel, seen: ObservationCfg, device: str | torch.device = "cpu") -> None:
        def array(values: object, dtype: torch.dtype) -> torch.Tensor:
            return torch.as_tensor(values).to(device=device, dtype=dtype)

        tables = view_tables(hand, seen, seen.view)
        self._source, self._joints = (array(v, torch.long) for v in (tables.source, tables.joints))
        self._factor, self._offset, self._sign, self._sector = (
            array(v, torch.float32) for v in (tables.factor, tables.offset, tables.sign, tables.sector)
        )
        self._turn = teacher_observation_slices(hand.num_fingers)["relative_orientation"]

    def choose(self, observation: torch.Tensor) -> torch.Tensor:
        """Views [..] of observations [.., O]: the axis of the wanted rotation is in their sector."""
        turn = observation[..., self._turn]
        # Observed is the object from the goal; wanted is the other way, by less than half a turn.
        axis = torch.where(turn[..., 3:] < 0.0, turn[..., :3], -turn[..., :3])
        return (axis @ self._sector.T).argmax(dim=-1)

    def take(self, observation: torch.Tensor, view: torch.Tensor) -> torch.Tensor:
        """Observations [.., O] as views [..] show them."""
        values = observation.gather(-1, self._source[view].flatten(-2)).unflatten(-1, (-1, TERMS))
        return (self._factor[view] * values).sum(dim=-1) + self._offset[view]

    def world_action(self, action: torch.Tensor, view: torch.Tensor) -> torch.Tensor:
        """Actions [.., D] of views [..] with the joints in the world's order."""
        return self._sign[view] * action.gather(-1, self._joints[view])
