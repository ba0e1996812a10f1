"""Shapes of objects on the device: what a teacher sees of them, and how high they are.

Without a simulator.

N environments, D joints, F fingers, B bodies. World frame: z up; metres, quaternions xyzw.
"""

import warp as wp

from vd.kernels.launch import launch
from vd.kernels.task.shapes import (
    ORIENTATIONS,
    clearance_kernel,
    extent_directions,
    extent_kernel,
    shape_observation_slices,
    surface_kernel,
)
from vd.paper import PAPER


class ShapeObserver:
    """Writes the values of ``vd.kernels.task.shapes``, and how high the objects are.

    Args:
        points: Samples of each object's surface in its frame, unscaled [m], shape [K, P].
        world_object: Object of each environment, shape [N].
        world_scale: Factor on its size, shape [N].
        tip_body: Link of each fingertip, shape [F].
        tip_offset: Fingertip frames in the frames of their links, shape [F].
    """

    def __init__(
        self,
        points: wp.array,
        world_object: wp.array,
        world_scale: wp.array,
        tip_body: wp.array,
        tip_offset: wp.array,
    ):
        device = points.device
        self._shapes = [points, world_object, world_scale]
        self._tips = [tip_body, tip_offset]
        fingers = len(tip_body)
        self._directions = wp.array(extent_directions(fingers), dtype=wp.vec3, device=device)
        self._slices = shape_observation_slices(fingers)
        self._surface_dim = len(world_object), fingers
        self._extent_dim = len(world_object), ORIENTATIONS, len(self._directions)

    def measure_clearance(self, joint_q: wp.array, column: int, out: wp.array) -> None:
        """Write heights of the objects' lowest points above the table [m] into ``out``, shape [N].

        Args:
            joint_q: Coordinates, shape [N, *].
            column: Column of ``joint_q`` at which the object's pose begins.
            out: Heights.
        """
        table = PAPER.scene.table_top_m
        launch(clearance_kernel, len(out), [*self._shapes, column, table, joint_q], [out])

    def observe(
        self,
        joint_q: wp.array,
        column: int,
        body_q: wp.array,
        goal: wp.array,
        out: wp.array,
        first: int = 0,
    ) -> None:
        """Write what is seen of the shapes.

        Args:
            joint_q: Coordinates, shape [N, *].
            column: Column of ``joint_q`` at which the object's pose begins.
            body_q: Poses of the bodies, shape [N, B].
            goal: Wanted orientations, shape [N].
            out: Observation, shape [N, *].
            first: Column of ``out`` at which the shape's values begin.
        """
        begin = {name: first + columns.start for name, columns in self._slices.items()}
        surface = [*self._shapes, *self._tips, column, begin["surface"], joint_q, body_q]
        launch(surface_kernel, self._surface_dim, surface, [out])
        extent = [*self._shapes, self._directions, column, begin["extent"], joint_q, goal]
        launch(extent_kernel, self._extent_dim, extent, [out])
