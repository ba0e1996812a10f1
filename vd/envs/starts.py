"""Starts of the objects without a finger inside them."""

import numpy as np
import warp as wp

from vd.assets_usd.hand_data import CollisionShape, compose
from vd.envs.task_state import TaskState
from vd.kernels.task.starts import (
    APART_M,
    CHUNKS,
    OpenHand,
    move_start_kernel,
    start_depth_kernel,
    start_places,
)
from vd.paper import PAPER


class FreeStarts:
    """Moves objects that start inside the hand to the nearest place where they do not.

    Args:
        state: The task.
        reset_q: Hand joints after a reset [rad], shape [D].
    """

    def __init__(self, state: TaskState, reset_q: np.ndarray):
        self._state = state
        device = state.device
        shapes = state.hand.shapes
        links = compose(state.hand.mount, state.hand.forward_kinematics(reset_q))
        poses = np.array([compose(links[shape.link], shape.frame) for shape in shapes])
        half, radius = zip(*map(rounded_box, shapes), strict=True)
        self._hand = OpenHand()
        self._hand.pose = wp.array(poses, dtype=wp.transform, device=device)
        self._hand.half = wp.array(half, dtype=wp.vec3, device=device)
        self._hand.radius = wp.array(radius, dtype=float, device=device)
        reach = np.linalg.norm(half, axis=1) + radius + APART_M
        self._hand.reach = wp.array(reach, dtype=float, device=device)
        self._places = wp.array(start_places(up=state.hand.palm_up), dtype=wp.vec3, device=device)
        self._depth = state.zeros(state.num_envs, len(self._places))

    def move(self, reset: wp.array) -> None:
        """Move the objects of the environments of ``reset`` [N], once they are reset.

        Device work only.
        """
        state = self._state
        places = self._places
        state.launch(
            start_depth_kernel,
            [
                self._hand,
                state.surface_points,
                state.world_object,
                state.world_scale,
                places,
                -np.inf if state.hand.palm_up else PAPER.scene.table_top_m,
                state.num_joints,
                reset,
                state.sim.joint_q,
            ],
            [self._depth],
            dim=(*self._depth.shape, CHUNKS),
        )
        state.launch(
            move_start_kernel, [places, state.num_joints, reset], [self._depth, state.sim.joint_q]
        )


def rounded_box(shape: CollisionShape) -> tuple[tuple[float, ...], float]:
    """Half extents and radius [m] of the rounded box that a shape is.

    Of a cylinder the box around it.
    """
    match shape.kind:
        case "sphere":
            return (0.0, 0.0, 0.0), shape.size[0]
        case "capsule":
            return (0.0, 0.0, shape.size[1]), shape.size[0]
        case "cylinder":
            return (shape.size[0], shape.size[0], shape.size[1]), 0.0
        case _:
            return shape.size, 0.0
