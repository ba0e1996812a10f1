"""The symmetry frames of a teacher that sees its goals in them, for those without a simulator.

The simulator keeps a frame as long as a goal (:mod:`vd.envs.symmetry`). Here it is chosen anew in
every step, from the rotation as it is known: a teacher acts as well so, and nothing has to be
remembered. N hands, O values of the observation, D actions. World frame: z up; quaternions xyzw.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from vd.assets_usd.hand_data import HandModel
from vd.envs.cfg import ObservationCfg
from vd.envs.symmetry_frames import symmetry_frames
from vd.kernels.task.observations import teacher_observation_slices


class FrameMaps:
    """From observations in the world frame to symmetry frames, and from actions in them to the joints.

    Args:
        hand: The hand.
        observation: How its teacher observes.
        device: Of the observations.
    """

    def __init__(self, hand: HandModel, observation: ObservationCfg, device: torch.device) -> None:
        # What else a training observes, only simulators know.
        actor = replace(observation, dynamics="none", critic_terms={})
        tables = symmetry_frames(hand, actor, observation.view)

        def tensor(values: Any, dtype: torch.dtype) -> Tensor:
            return torch.tensor(values, dtype=dtype, device=device)

        self._source = tensor(tables.source, torch.int64)
        self._joints = tensor(tables.joints, torch.int64)
        self._factor = tensor(tables.factor, torch.float32)
        self._offset = tensor(tables.offset, torch.float32)
        self._sign = tensor(tables.sign, torch.float32)
        self._sector = tensor(tables.sector, torch.float32)
        self._turn = teacher_observation_slices(hand.num_fingers, hand.num_joints)[
            "relative_orientation"
        ]

    def choose(self, observation: Tensor) -> Tensor:
        """Frames [N] of observations [N, O]: the axis of the wanted rotation is in their sector."""
        turn = observation[..., self._turn]
        # Observed is the object from the goal; wanted is the other way, by less than half a turn.
        axis = torch.where(turn[..., 3:] < 0.0, turn[..., :3], -turn[..., :3])
        return (axis @ self._sector.T).argmax(dim=-1)

    def take(self, observation: Tensor, frame: Tensor) -> Tensor:
        """Observations [N, O] as frames [N] show them."""
        values = observation[..., None].take_along_dim(self._source[frame], dim=1)
        return (self._factor[frame] * values).sum(dim=-1) + self._offset[frame]

    def world_action(self, action: Tensor, frame: Tensor) -> Tensor:
        """Actions [N, D] of frames [N] with the joints in the world's order."""
        return self._sign[frame] * action.take_along_dim(self._joints[frame], dim=1)


def turns_of_hand(hand: HandModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The turns that put the fingers of a hand in each other's places; one where they are not alike.

    Returns:
        Matrices from the base frame to the V turned ones [V, 3, 3]; in the base frame, the direction
        near which each has the axis of the wanted rotation [V, 3]; and the joint of the turned hand
        that is each of the hand's, int [V, D].
    """
    try:
        tables = symmetry_frames(hand, ObservationCfg(), "goal")
    except ValueError:  # its fingers are not alike
        return np.eye(3)[None], np.zeros((1, 3)), np.arange(hand.num_joints)[None]
    to_world = Rotation.from_quat(hand.mount[3:]).as_matrix()
    return to_world.T @ tables.turn @ to_world, tables.sector @ to_world, tables.joints
