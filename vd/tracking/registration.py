"""Where the object is, from the points seen of it and its known shape, followed over time.

What a network has to learn of each shape anew is computed: many rotations are tried at the first
look, the best are improved, and a few that fit well are kept and followed, so that a turn of the
object tells apart what one look does not. A few other rotations are tried in each step, in case
none of those kept is right.

N environments, P seen points at most, K kept poses. Base frame; metres, quaternions xyzw.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from vd.assets_usd.hand_data import CameraModel
from vd.assets_usd.objects.model import ObjectModel
from vd.geometry.arrays import Array, as_warp, of_warp, take_along
from vd.kernels.launch import launch
from vd.kernels.sensor.registration import (
    NEVER,
    Eye,
    fit_poses_kernel,
    keep_poses_kernel,
    nearness_kernel,
    place_poses_kernel,
)
from vd.kernels.sensor.shape_grids import Shapes, off_mesh_kernel, shape_distance_kernel

POINTS = 256
"""Points seen of the object that are looked at, at most."""
GRID = 32
"""Grid points along a side of a shape's distances: some 5 mm apart."""
BEYOND_M = 0.02
"""How far that grid reaches beyond the shape [m]."""
ON_MESH_M = 1e-3
"""A mesh is a shape's surface if the samples are no farther from it than this, root mean square:
one that was simplified misses a few by more. That of a scan is its hull."""
FAR_M = 0.012
"""Length at which distances are cut off [m]: what is farther is no point of the object."""
CELL_PX = 4.0
"""Side of a cell of the image [pixel]: with 6000 points of an image few cells on a surface are
empty.
"""
MARGIN_M = 0.002
"""Depth within which the shape may stand out [m]: half a cell, seen aslant."""
ROTATIONS = 2048
"""Rotations tried at the first look, about 0.25 rad apart."""
FIRST_STEPS = 3
"""Steps of each of these."""
FIRST_EVERY = 4
"""Every so many-th point is looked at in these."""
CHOSEN = 64
"""How many of them are improved further."""
CHOSEN_STEPS = 8
"""Steps of these."""
KEPT = 6
"""Poses that are followed."""
OTHERS = 6
"""Other rotations that are tried in each step (our choice)."""
STRIDE = 370
"""How far along the spiral of rotations those of the next step are: all come in turn."""
STEPS = 8
"""Steps of these and of those kept, at most (ours, likewise)."""
EVERY_SAMPLE = 2
"""Every so many-th surface sample is looked at for what stands out."""
APART_RAD = 0.3
"""Least angle between two kept poses."""
STAY = 0.8
"""Another pose must fit better by a fifth to be believed."""
WORSE = 1.5
"""A pose of which the misfit has grown by no more than this factor has not been left behind (ours,
likewise; 1.2 errs as little, 2 a little more)."""
SHARE = 0.1
"""Share of the latest misfit in the average: some ten looks count."""


def even_rotations(count: int) -> np.ndarray:
    """Rotations that lie evenly, quaternions xyzw [count, 4] (super-Fibonacci spiral, Alexa 2022)."""
    # Its two constants: the root of 2, and the positive root of x^4 = x + 4.
    first = np.sqrt(2.0)
    second = 1.533751168755204288118041
    along = np.arange(count) + 0.5
    share = along / count
    turn = 2.0 * np.pi * along
    inner = np.sqrt(share)
    outer = np.sqrt(1.0 - share)
    return np.stack(
        [
            inner * np.sin(turn / first),
            inner * np.cos(turn / first),
            outer * np.sin(turn / second),
            outer * np.cos(turn / second),
        ],
        axis=1,
    )


class Registration:
    """Finds and follows the object of each environment.

    Attributes:
        pose: Kept poses of the object in the base frame, the one that is believed first, [N, K, 7].
        misfit: Their misfits, averaged over time [m^2], [N, K].
        most: Points seen of the object that are looked at, at most.
        looks: How often each environment's object was seen since it was begun anew, [N] int32.
    """

    most = POINTS

    def __init__(
        self,
        objects: Sequence[ObjectModel],
        *,
        world_object: np.ndarray,
        world_scale: np.ndarray,
        camera: CameraModel | None,
        device: str,
        library: Any,
    ):
        """Measure the shapes.

        Args:
            objects: What may be looked for.
            world_object: Object of each environment, shape [N].
            world_scale: Size factor of each environment's object, shape [N].
            camera: What sees it, posed in the base frame; None where points are of all sides.
            device: Warp device.
            library: Of its arrays, torch or on a CPU numpy.
        """
        self.device = device
        envs = len(world_object)
        self._xp = xp = library
        place = wp.device_to_torch(device)

        def array(values: Any, dtype: Any) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        samples = np.stack([item.surface_points for item in objects])
        self.shapes = shapes = Shapes()
        """Samples and distances of each object's surface, on the device."""
        shapes.samples = array(samples, wp.vec3)
        shapes.half = array(np.abs(samples).max(axis=(1, 2)) + BEYOND_M, float)
        shapes.distance = wp.empty((len(objects), GRID, GRID, GRID), dtype=float, device=device)
        shapes.world_shape = array(world_object, wp.int32)
        shapes.world_scale = array(world_scale, float)
        meshes = [
            wp.Mesh(
                array(item.vertices, wp.vec3),
                array(item.faces.ravel(), wp.int32),
                support_winding_number=True,
            )
            for item in objects
        ]
        mesh = array([mesh.id for mesh in meshes], wp.uint64)
        off = wp.empty(samples.shape[:2], dtype=float, device=device)
        launch(off_mesh_kernel, off.shape, [shapes.samples, mesh], [off])
        meshed = array(np.sqrt(np.square(off.numpy()).mean(axis=1)) < ON_MESH_M, wp.int32)
        launch(
            shape_distance_kernel,
            shapes.distance.shape,
            [shapes.samples, mesh, shapes.half, meshed],
            [shapes.distance],
        )
        self._eye = Eye()
        cells = (0, 0)
        if camera is not None:
            self._eye.focal = wp.vec2(camera.fx, camera.fy)
            self._eye.centre = wp.vec2(camera.cx, camera.cy)
            self._eye.pose = wp.transform(*camera.position.tolist(), *camera.quaternion.tolist())
            self._eye.cell = CELL_PX
            self._eye.margin = MARGIN_M
            cells = (math.ceil(camera.height / CELL_PX), math.ceil(camera.width / CELL_PX))
        self._placing = [shapes, self._eye, int(camera is not None), EVERY_SAMPLE]
        self._nearness = wp.zeros((envs, *cells), dtype=float, device=device)
        self._rotations = xp.asarray(even_rotations(ROTATIONS), dtype=xp.float32, device=place)
        self.pose = xp.zeros((envs, KEPT, 7), dtype=xp.float32, device=place)
        self.pose[..., 6] = 1.0
        self.misfit = xp.zeros((envs, KEPT), dtype=xp.float32, device=place)
        self.looks = xp.zeros(envs, dtype=xp.int32, device=place)
        self._kept = [as_warp(self.pose, wp.transform), as_warp(self.misfit)]
        self._worlds = xp.arange(envs, dtype=xp.int32, device=place)
        # What a later look fits: poses kept before, the same where points are now, and others.
        self._found = wp.empty((envs, 2 * KEPT + OTHERS), dtype=wp.transform, device=device)
        self._cost = wp.zeros(self._found.shape, dtype=float, device=device)

    def look(
        self,
        seen: Array,
        count: Array,
        *,
        fresh: Array,
        points: Array | None = None,
    ) -> None:
        """Look once in every environment; where nothing is seen of the object all stays as it is.

        Args:
            seen: Points seen of the object [m], [N, P, 3].
            count: How many there are, [N] int32.
            fresh: Where nothing is known from before, bool [N].
            points: All that the camera saw [m], NaN for none, [N, K, 3]; None without a camera.
        """
        inputs = [as_warp(seen, wp.vec3), as_warp(count)]
        if points is not None:
            self._nearness.zero_()
            cloud = as_warp(points, wp.vec3)
            launch(nearness_kernel, cloud.shape, [self._eye, cloud], [self._nearness])
        self.looks[fresh] = 0
        seen_now = count > 0
        known = self.looks > 0
        self._follow(as_warp(self._xp.where(known & seen_now, self._worlds, -1)), inputs)
        first = self._xp.where(~known & seen_now)[0]  # waits for the device
        if len(first):
            self._find(as_warp(self._worlds[first]), inputs)
        self.looks += seen_now

    def tried(
        self, seen: Array, count: Array, *, steps: int, every: int
    ) -> tuple[wp.array, wp.array]:
        """All rotations that a first look tries, improved, where there is no camera.

        Nothing is kept.

        Args:
            seen: Points of the object from all sides [m], [N, P, 3].
            count: How many there are, [N] int32.
            steps: Steps of each.
            every: Look at every so many-th point.

        Returns:
            Poses [N, H] and their misfits [m^2], [N, H].
        """
        return self._tried(
            as_warp(self._worlds), steps, every, [as_warp(seen, wp.vec3), as_warp(count)]
        )

    def _tried(
        self, envs: wp.array, steps: int, every: int, inputs: list[wp.array]
    ) -> tuple[wp.array, wp.array]:
        """Poses in all rotations [M, H], improved, and their misfits."""
        poses = wp.empty((len(envs), ROTATIONS), dtype=wp.transform, device=self.device)
        cost = wp.zeros(poses.shape, dtype=float, device=self.device)
        turns = self._xp.broadcast_to(self._rotations, (len(envs), ROTATIONS, 4))
        self._place(poses, cost, envs, turns, inputs)
        self._fit(poses, cost, envs, steps, every, inputs)
        return poses, cost

    def _find(self, envs: wp.array, inputs: list[wp.array]) -> None:
        """Find the objects of some environments, of which nothing is known."""
        tried, cost = self._tried(envs, FIRST_STEPS, FIRST_EVERY, inputs)
        best = self._xp.argsort(of_warp(cost, self._xp), axis=1)[:, :CHOSEN, None]
        chosen = as_warp(take_along(of_warp(tried, self._xp), best, axis=1), wp.transform)
        cost = wp.zeros(chosen.shape, dtype=float, device=self.device)
        self._fit(chosen, cost, envs, CHOSEN_STEPS, 1, inputs)
        self._keep(0, envs, chosen, cost)

    def _follow(self, envs: wp.array, inputs: list[wp.array]) -> None:
        """Go on from the kept poses, and try a few others.

        A row an environment, -1 where it is left out.
        """
        known = slice(KEPT)
        again = slice(KEPT, 2 * KEPT)
        others = slice(2 * KEPT, None)
        self._cost.zero_()
        wp.copy(self._found[:, known], self._kept[0])
        self._fit(self._found[:, known], self._cost[:, known], envs, STEPS, 1, inputs)
        # What falls is 4 cm farther at the next look, and steps look FAR_M far: poses that do not
        # fit as they did are put where points are now, turned as they were.
        xp = self._xp
        pose = of_warp(self._found, xp)
        cost = of_warp(self._cost, xp)
        cost[:, again][cost[:, known] <= WORSE * self.misfit] = float(NEVER)
        tried = (self.looks[:, None] * STRIDE + xp.arange(OTHERS, device=cost.device)) % ROTATIONS
        for columns, turns in ((again, self.pose[..., 3:]), (others, self._rotations[tried])):
            self._place(self._found[:, columns], self._cost[:, columns], envs, turns, inputs)
            self._fit(self._found[:, columns], self._cost[:, columns], envs, STEPS, 1, inputs)
        better = cost[:, again] < cost[:, known]  # of two attempts at one pose
        pose[:, known] = xp.where(better[..., None], pose[:, again], pose[:, known])
        cost[:, known] = xp.where(better, cost[:, again], cost[:, known])
        cost[:, again] = float(NEVER)
        self._keep(KEPT, envs, self._found, self._cost)

    def _place(
        self, pose: wp.array, cost: wp.array, envs: wp.array, turns: Array, inputs: list[wp.array]
    ) -> None:
        """Write poses [M, C] in rotations [M, C, 4], but where the misfit is NEVER."""
        given = [*self._placing, envs, as_warp(turns, wp.quat), cost]
        launch(place_poses_kernel, pose.shape, [*given, *inputs], [pose])

    def _fit(
        self,
        pose: wp.array,
        cost: wp.array,
        envs: wp.array,
        steps: int,
        every: int,
        inputs: list[wp.array],
    ) -> None:
        """Improve poses [M, C], and write their misfits."""
        sizes = [FAR_M, steps, every, EVERY_SAMPLE]
        launch(
            fit_poses_kernel,
            pose.shape,
            [self.shapes, self._eye, *sizes, envs, *inputs, self._nearness],
            [pose, cost],
        )

    def _keep(self, known: int, envs: wp.array, found: wp.array, cost: wp.array) -> None:
        """Keep the best of poses [M, C], the first of which were kept before."""
        inputs = [APART_RAD, STAY, SHARE, known, envs, found]
        launch(keep_poses_kernel, len(envs), inputs, [cost, *self._kept])
