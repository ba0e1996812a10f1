"""The shape of each world's object: its points on the device, what a teacher sees of it, how high it is."""

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from vd.kernels.observations import teacher_observation_size
from vd.kernels.shapes import (
    ORIENTATIONS,
    clearance_kernel,
    extent_directions,
    extent_kernel,
    shape_observation_slices,
    surface_kernel,
)
from vd.paper import PAPER

if TYPE_CHECKING:
    from vd.envs.observer import Observer
    from vd.envs.reorient import ReorientEnv


class ShapeObserver:
    """Writes the columns of ``vd.kernels.shapes`` behind the state in the observation of ``env``.

    Also how high the objects are, for the reward.
    """

    def __init__(self, env: "ReorientEnv", observer: "Observer"):
        """Put surface points and scales of the objects on the device."""
        self._env, self._observer = env, observer
        device = env.device
        points = np.stack([item.surface_points for item in env.objects])
        self._points = wp.array(points, dtype=wp.vec3, device=device)
        self._object = wp.array(env.scene.world_object, dtype=wp.int32, device=device)
        self._scale = wp.array(env.scene.world_scale, dtype=float, device=device)
        self._directions = wp.array(extent_directions(env.num_fingers), dtype=wp.vec3, device=device)
        first, slices = teacher_observation_size(env.num_fingers), shape_observation_slices(env.num_fingers)
        self._surface_column = first + slices["surface"].start
        self._extent_column = first + slices["extent"].start

    def measure_clearance(self) -> None:
        """Write the heights of the objects' lowest points into ``env.clearance``."""
        env = self._env
        wp.launch(
            clearance_kernel,
            dim=env.num_worlds,
            inputs=[
                self._points,
                self._object,
                self._scale,
                env.num_actions,
                PAPER.scene.table_top_m,
                env.sim.joint_q,
            ],
            outputs=[env.clearance],
            device=env.device,
        )

    def launch(self) -> None:
        """Write the values of the state that is seen, and of the goal."""
        env, out = self._env, self._observer.world_values
        _, _, joint_q, _, body_q, _ = self._observer.seen.arrays
        wp.launch(
            surface_kernel,
            dim=(env.num_worlds, env.num_fingers),
            inputs=[
                self._points,
                self._object,
                self._scale,
                env.fingers.tip_body,
                env.fingers.tip_offset,
                env.num_actions,
                self._surface_column,
                joint_q,
                body_q,
            ],
            outputs=[out],
            device=env.device,
        )
        wp.launch(
            extent_kernel,
            dim=(env.num_worlds, ORIENTATIONS, len(self._directions)),
            inputs=[
                self._points,
                self._object,
                self._scale,
                self._directions,
                env.num_actions,
                self._extent_column,
                joint_q,
                env.aimed_quat,
            ],
            outputs=[out],
            device=env.device,
        )
