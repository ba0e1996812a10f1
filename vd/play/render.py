"""Pictures of the scene without a display or a GPU.

Newton's ray-traced camera on a model of its own.

The picture model is separate from the simulated one: it has the visual shapes, one *cell* for every
world that is shown (hand, table, object, and the object in the goal's orientation, high above where
nothing else is). Joint positions are all it needs, so a recording can be drawn later, or
elsewhere.

World frame (z up, table top at z = 0), metres, radians, quaternions xyzw.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_model import HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.sim.cfg import SimCfg
from vd.sim.scene import TABLE_LABEL, add_object, build_hand, new_builder, show_table

# Packed as the renderer packs its bytes: A B G R. Signed, or its kernel compiles with warnings.
BACKGROUND = 0xFFEBE1D8 - (1 << 32)
GOAL_COLOR = (0.35, 0.68, 0.42)
GHOST_OPACITY = 0.7
# Light direction in the camera's right, forward (level) and up: from the upper left behind the
# viewer, and low enough to reach under the palm.
LIGHT_DIRECTION = (0.35, 0.9, -0.8)
UP = (0.0, 0.0, 1.0)
IN_PLACE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
"""Pose, [m] and xyzw, of what is shown at the origin."""
OUT_OF_SIGHT = (0.0, 0.0, -100.0, 0.0, 0.0, 0.0, 1.0)
"""The same of what is hidden far below: viewers have no cheaper way to hide one shape."""
GOAL_PLACE = (0.0, 0.0, 10.0)
"""Where the goal's object is drawn for a picture of its own [m]: its shadow falls on no table."""
BALL_SHARE = 0.8
"""Share of the picture's height that the ball takes at which a camera is aimed."""
GOAL_SHARE = 0.36
"""Side of the goal's picture, as a share of the height of the scene's."""
SKY = (0.42, 0.43, 0.46)
GROUND = (0.22, 0.21, 0.20)


@dataclass(frozen=True)
class PictureCamera:
    """A pinhole camera that looks at a point.

    The default looks along +y and sees hand, table and object, a little from above.
    """

    eye: tuple[float, float, float] = (0.0, -0.55, 0.21)
    """Position [m]."""
    target: tuple[float, float, float] = (0.0, 0.0, 0.095)
    """Point in the middle of the picture [m]."""
    fov: float = math.radians(34.0)
    """Vertical field of view [rad]."""

    @staticmethod
    def for_hand(hand: HandModel) -> "PictureCamera":
        """The default camera, turned to look through the nearest gap between fingers."""
        camera = PictureCamera()
        tips = hand.tip_poses(hand.start)[:, :3]
        tips = Rotation.from_quat(hand.mount[3:]).apply(tips)
        azimuth = np.sort(np.arctan2(tips[:, 1], tips[:, 0]))
        gaps = azimuth + 0.5 * np.diff(azimuth, append=azimuth[0] + 2 * np.pi)
        here = math.atan2(camera.eye[1], camera.eye[0])
        turns = (gaps - here + np.pi) % (2 * np.pi) - np.pi
        turn = Rotation.from_euler("z", turns[np.argmin(np.abs(turns))])
        return replace(camera, eye=_vector(turn.apply(camera.eye)))

    @cached_property
    def rotation(self) -> np.ndarray:
        """World from camera; the camera looks along -z, +x is right and +y is up. Shape [3, 3]."""
        forward = np.asarray(self.target, dtype=float) - np.asarray(self.eye, dtype=float)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, UP)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), -forward], axis=1)

    @property
    def transform(self) -> wp.transform:
        """Pose in the world."""
        return wp.transform(
            wp.vec3(*self.eye), wp.quat(*Rotation.from_matrix(self.rotation).as_quat())
        )

    def aimed_at(self, point: Sequence[float], radius: float) -> "PictureCamera":
        """A camera that looks the same way at a ball about ``point`` [m], which fills its picture."""
        distance = radius / math.sin(math.atan(BALL_SHARE * math.tan(0.5 * self.fov)))
        eye = np.asarray(point, dtype=float) + distance * self.rotation[:, 2]
        return replace(self, eye=_vector(eye), target=_vector(point))


class Picture(NamedTuple):
    """What the camera saw of one cell, and of the object in the goal's orientation; RGB bytes."""

    scene: np.ndarray  # [height, width, 3]
    goal: np.ndarray  # [size, size, 3]


class PictureModel:
    """The model of what is shown.

    C cells, each with a hand (or none), a table, an object, and it again as its goal.

    Args:
        hand: The hand; None shows objects alone.
        objects: The object of each cell, length C.
        device: Warp device.
        goal_opacity: Of the goal's object.
    """

    def __init__(
        self,
        hand: HandModel | None,
        objects: Sequence[ObjectModel],
        *,
        device: str = "cpu",
        goal_opacity: float = 1.0,
    ):
        cfg = SimCfg()
        self.cells = len(objects)
        scene = new_builder()
        hand_builder = build_hand(hand, cfg, visuals=True) if hand else None
        for item in objects:
            world = new_builder()
            if hand_builder:
                world.add_builder(hand_builder)
            add_object(world, item, cfg, scale=1.0, visuals=True)
            # A body, although it never moves in the simulation: so it can be shown as taken away.
            table = world.add_body(
                mass=1.0, inertia=wp.mat33(np.eye(3)), label=TABLE_LABEL, lock_inertia=True
            )
            show_table(world, cfg, table)
            goal = add_object(world, item, cfg, scale=1.0, visuals=True)
            visual = world.body_shapes[goal][-1]
            world.shape_color[visual] = GOAL_COLOR
            world.shape_opacity[visual] = goal_opacity
            scene.add_world(world)
        self.model = scene.finalize(device=device)
        self.state = self.model.state()

    def pose(
        self,
        joint_q: np.ndarray,
        goal_quat: np.ndarray,
        goal_position: Sequence[float] = GOAL_PLACE,
        *,
        table: np.ndarray | bool = True,
    ) -> None:
        """Place hands, objects, tables and goals.

        Args:
            joint_q: Hand joints [rad], object position [m] and quaternion xyzw, shape [C, D + 7].
            goal_quat: Goal orientations xyzw, shape [C, 4].
            goal_position: Where the goals' objects are drawn [m].
            table: Whether the table is there, shape [C] or one for all.
        """
        goal = np.concatenate([np.tile(goal_position, (self.cells, 1)), goal_quat], axis=1)
        tables = np.where(np.broadcast_to(table, self.cells)[:, None], IN_PLACE, OUT_OF_SIGHT)
        q = np.concatenate([joint_q, tables, goal], axis=1)
        self.state.joint_q.assign(np.ravel(q).astype(np.float32))
        newton.eval_fk(self.model, self.state.joint_q, self.state.joint_qd, self.state)


class Renderer:
    """Draws cells of hand and object, ``width`` by ``height`` pixels, with the goal beside each.

    Hand, objects and device are as of :class:`PictureModel`; the CPU is quick enough for video. The
    picture of the goal is a square with sides of GOAL_SHARE of the height.
    """

    def __init__(
        self,
        hand: HandModel | None,
        objects: Sequence[ObjectModel],
        *,
        width: int = 640,
        height: int = 400,
        camera: PictureCamera | None = None,
        device: str = "cpu",
    ):
        self.camera = camera or (PictureCamera.for_hand(hand) if hand else PictureCamera())
        self.pictured = PictureModel(hand, objects, device=device)
        cells = len(objects)
        self._sensor = SensorCamera(self.pictured.model)
        right = self.camera.rotation[:, 0]
        axes = np.stack([right, np.cross(UP, right), UP])
        light = wp.normalize(wp.vec3(*(LIGHT_DIRECTION @ axes)))
        self._sensor.create_default_light(enable_shadows=True, direction=light)
        self._sensor.set_ambient_light(SKY, GROUND)
        radius = max(float(np.linalg.norm(item.vertices, axis=1).max()) for item in objects)
        side = round(GOAL_SHARE * height)

        def view(camera: PictureCamera, *size: int) -> dict[str, Any]:
            """What the sensor wants to know, and its buffers, to draw each cell."""
            return {
                "camera_transforms": wp.array(
                    [camera.transform] * cells, dtype=wp.transformf, device=device
                ),
                "camera_rays": SensorCamera.compute_camera_rays_pinhole(
                    *size, camera_fov=camera.fov, device=device
                ),
                "color_image": self._sensor.allocate_image_color(cells, *size),
                "world_indices": wp.array(list(range(cells)), dtype=wp.int32, device=device),
            }

        goal_camera = self.camera.aimed_at(GOAL_PLACE, radius)
        self._views = (view(self.camera, width, height), view(goal_camera, side, side))

    def render(
        self, joint_q: np.ndarray, goal_quat: np.ndarray, table: np.ndarray | bool = True
    ) -> list[Picture]:
        """Draw all cells.

        Args:
            joint_q: Hand joints [rad], object position [m] and quaternion xyzw, shape [C, D + 7].
            goal_quat: Goal orientations xyzw, shape [C, 4].
            table: Whether the table is there, shape [C] or one for all.

        Returns:
            C pictures.
        """
        self.pictured.pose(joint_q, goal_quat, table=table)
        state = self.pictured.state
        drawn = []
        self.pictured.model.bvh_refit_shapes(state)
        for view in self._views:
            self._sensor.update(
                state,
                **view,
                clear_data=SensorCamera.ClearData(clear_color=BACKGROUND),
                render_config=SensorCamera.RenderConfig(enable_shadows=True),
            )
            # On the CPU a view of the buffer that the next frame overwrites.
            packed = view["color_image"].numpy().copy()
            drawn.append(packed.view(np.uint8).reshape(*packed.shape, 4)[..., :3])
        return [Picture(scene, goal) for scene, goal in zip(*drawn, strict=True)]


def _vector(values: Sequence[float] | np.ndarray) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z
