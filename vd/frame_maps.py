"""The symmetry frames of a teacher that sees its goals in them, for those without a simulator.

The simulator keeps a frame as long as a goal (:mod:`vd.envs.symmetry`). Here it is chosen anew in every step,
from the rotation as it is known: a teacher acts as well so, and nothing has to be remembered. O values of the
observation, D actions. World frame: z up; quaternions xyzw.
"""

from dataclasses import replace

import torch

from vd.assets_usd.hand_data import HandModel
from vd.envs.cfg import ObservationCfg
from vd.envs.symmetry_frames import TERMS, symmetry_frames
from vd.kernels.task.observations import teacher_observation_slices


class FrameMaps:
    """From observations in the world frame to symmetry frames, and from actions in them to the joints."""

    def __init__(self, hand: HandModel, seen: ObservationCfg, device: str | torch.device = "cpu") -> None:
        def array(values: object, dtype: torch.dtype) -> torch.Tensor:
            return torch.as_tensor(values).to(device=device, dtype=dtype)

        actors = replace(seen, dynamics="none", critic_terms={})  # what else is told, only simulators know
        tables = symmetry_frames(hand, actors, seen.view)
        self._source, self._joints = (array(v, torch.long) for v in (tables.source, tables.joints))
        self._factor, self._offset, self._sign, self._sector = (
            array(v, torch.float32) for v in (tables.factor, tables.offset, tables.sign, tables.sector)
        )
        self._turn = teacher_observation_slices(hand.num_fingers, hand.num_joints)["relative_orientation"]

    def choose(self, observation: torch.Tensor) -> torch.Tensor:
        """Frames [..] of observations [.., O]: the axis of the wanted rotation is in their sector."""
        turn = observation[..., self._turn]
        # Observed is the object from the goal; wanted is the other way, by less than half a turn.
        axis = torch.where(turn[..., 3:] < 0.0, turn[..., :3], -turn[..., :3])
        return (axis @ self._sector.T).argmax(dim=-1)

    def take(self, observation: torch.Tensor, frame: torch.Tensor) -> torch.Tensor:
        """Observations [.., O] as frames [..] show them."""
        values = observation.gather(-1, self._source[frame].flatten(-2)).unflatten(-1, (-1, TERMS))
        return (self._factor[frame] * values).sum(dim=-1) + self._offset[frame]

    def world_action(self, action: torch.Tensor, frame: torch.Tensor) -> torch.Tensor:
        """Actions [.., D] of frames [..] with the joints in the world's order."""
        return self._sign[frame] * action.gather(-1, self._joints[frame])
