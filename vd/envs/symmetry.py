"""The views of :mod:`vd.kernels.symmetry` for a hand and an observation: their tables, and their launches."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from vd.kernels.observations import FINGERTIP_VALUES, JOINTS_PER_FINGER, teacher_observation_slices
from vd.kernels.shapes import extent_directions, shape_observation_slices
from vd.kernels.symmetry import choose_view_kernel, view_observation_kernel, world_action_kernel

if TYPE_CHECKING:
    from vd.envs.reorient import ReorientEnv

TERMS = 4
"""Most values that a turned value is made of: those of a quaternion."""
TOLERANCE_M = 1e-4
"""Farthest that a turned fingertip may be from the one whose place it takes."""
SECTOR = np.array([1.0, 0.0, 0.0])
"""Views turn the axis of the wanted rotation near to this direction, world frame; any would do."""


@dataclass(frozen=True)
class ViewTables:
    """What the F views of a hand are made of."""

    source: np.ndarray
    """Values of the world frame that make each value of a view, int [F, O, T]."""
    factor: np.ndarray
    """Their factors [F, O, T]."""
    joints: np.ndarray
    """Joint of the view that is each joint of the world, int [F, D]."""
    sector: np.ndarray
    """The direction near which a view has the axis of the wanted rotation, as it is in the world [F, 3]."""


def view_tables(env: "ReorientEnv") -> ViewTables:
    """The views of an environment's hand and observation.

    Raises:
        ValueError: The fingers are not spaced evenly about the vertical.
    """
    fingers, tips = env.num_fingers, _tips(env)
    maps = [_observation_map(tips, step, sees_shape=env.sees_shape) for step in range(fingers)]
    source = np.stack([np.argsort(-np.abs(m), axis=1, kind="stable")[:, :TERMS] for m in maps])
    turns = [_turn(step, fingers) for step in range(fingers)]
    return ViewTables(
        source=source,
        factor=np.take_along_axis(np.stack(maps), source, axis=2),
        joints=np.stack([_joint_source(_finger_source(tips, -step)) for step in range(fingers)]),
        sector=np.stack([turn.inv().apply(SECTOR) for turn in turns]),
    )


class Views:
    """The view of each world of ``env``, and what the policy sees and does in it.

    Attributes:
        view: View of each world, 0 to F - 1, shape [N].
        observation: Observation in the world frame, shape [N, O]; views of it go to ``env.observation``.
    """

    def __init__(self, env: "ReorientEnv"):
        """Put the tables of the hand on the device.

        Raises:
            ValueError: The fingers are not spaced evenly about the vertical.
        """
        self._env = env
        device, worlds, tables = env.device, env.num_worlds, view_tables(env)
        self._source = wp.array(tables.source, dtype=wp.int32, device=device)
        self._factor = wp.array(tables.factor, dtype=float, device=device)
        self._joints = wp.array(tables.joints, dtype=wp.int32, device=device)
        self._sector = wp.array(tables.sector, dtype=wp.vec3, device=device)
        self._action = wp.zeros((worlds, env.num_actions), dtype=float, device=device)
        self.view = wp.zeros(worlds, dtype=wp.int32, device=device)
        self.observation = wp.zeros((worlds, env.num_observations), dtype=float, device=device)

    def choose(self, reset: wp.array, new_goal: wp.array) -> None:
        """Choose anew for worlds in which either mask, shape [N], is set."""
        env = self._env
        wp.launch(
            choose_view_kernel,
            dim=env.num_worlds,
            inputs=[self._sector, env.num_actions, reset, new_goal, env.sim.joint_q, env.goal_quat],
            outputs=[self.view],
            device=env.device,
        )

    def observe(self) -> None:
        """Write ``env.observation``."""
        env = self._env
        wp.launch(
            view_observation_kernel,
            dim=env.observation.shape,
            inputs=[self._source, self._factor, self.view, self.observation],
            outputs=[env.observation],
            device=env.device,
        )

    def world_action(self, action: wp.array, out: wp.array | None = None) -> wp.array:
        """Action of the views, shape [N, D], with the joints in the world's order; in ``out`` if given."""
        out = self._action if out is None else out
        wp.launch(
            world_action_kernel,
            dim=action.shape,
            inputs=[self._joints, self.view, action],
            outputs=[out],
            device=self._env.device,
        )
        return out


class WorldOrder:
    """A policy of views with its actions in the world's order: a teacher for a student that acts there."""

    def __init__(self, policy: Any, env: "ReorientEnv"):
        """Wrap ``policy``; without views in ``env`` it acts as before."""
        self._policy, self._views = policy, env.views
        self.num_observations, self.num_actions = policy.num_observations, policy.num_actions

    def act(self, observation: Any) -> Any:
        """Actions [N, D] (torch) of ``env.observation``."""
        action = self._policy.act(observation)
        if self._views is None:
            return action
        ordered = self._views.world_action(wp.from_torch(action.contiguous()))
        return wp.to_torch(ordered).clone()


def _tips(env: "ReorientEnv") -> np.ndarray:
    """Fingertip poses of a hand with all angles zero, with the simulation's signs [F, 7]."""
    joints = env.sim.joint_q.numpy().copy()
    straight = joints.copy()
    straight[:, : env.num_actions] = 0.0
    env.sim.joint_q.assign(straight)
    env.sim.forward_kinematics()
    bodies = env.sim.body_q.numpy()[0].copy()
    env.sim.joint_q.assign(joints)
    env.sim.forward_kinematics()
    pairs = zip(bodies[env.fingers.tip_body.numpy()], env.fingers.tip_offset.numpy(), strict=True)
    tips: list[Any] = [wp.transform_multiply(wp.transform(*body), wp.transform(*tip)) for body, tip in pairs]
    return np.array([[tip[i] for i in range(7)] for tip in tips])


def _turn(step: int, fingers: int) -> Rotation:
    return Rotation.from_euler("z", 2.0 * np.pi * step / fingers)


def _finger_source(tips: np.ndarray, step: int) -> np.ndarray:
    """The finger that takes the place of each after a turn by ``step`` fingers [F]."""
    turned = _turn(step, len(tips)).apply(tips[:, :3])
    distance = np.linalg.norm(turned[:, None] - tips[None, :, :3], axis=2)
    source = np.argmin(distance, axis=0)
    if sorted(source) != list(range(len(tips))) or distance.min(axis=0).max() > TOLERANCE_M:
        raise ValueError(
            "the fingers of this hand are not spaced evenly about the vertical; set observation.view to world"
        )
    return source


def _joint_source(fingers: np.ndarray) -> np.ndarray:
    """Joints of the fingers, in their order [D]."""
    return (JOINTS_PER_FINGER * fingers[:, None] + np.arange(JOINTS_PER_FINGER)).ravel()


def _observation_map(tips: np.ndarray, step: int, *, sees_shape: bool) -> np.ndarray:
    """Matrix [O, O] from an observation in the world frame to that of the view ``step``.

    Args:
        tips: Fingertip poses with the same angles in all fingers, shape [F, 7].
        step: Fingers by which the view is turned.
        sees_shape: Whether the object's shape is observed.
    """
    count = len(tips)
    turn, fingers = _turn(step, count), _finger_source(tips, step)
    vector, quaternion = turn.as_matrix(), _left_product(turn.as_quat())
    conjugation = np.eye(4)
    conjugation[:3, :3] = vector
    joints = np.eye(JOINTS_PER_FINGER * count)[_joint_source(fingers)]
    tip_blocks = np.zeros((count, FINGERTIP_VALUES, count, FINGERTIP_VALUES))
    for finger, old in enumerate(fingers):
        # q and -q are the same orientation, but a fingertip never shows the other one.
        sign = np.sign(tips[finger, 3:] @ quaternion @ tips[old, 3:])
        for begin, block in ((0, vector), (3, sign * quaternion), (7, vector), (10, vector)):
            end = begin + len(block)
            tip_blocks[finger, begin:end, old, begin:end] = block
    parts = {
        "joint_position": joints,
        "joint_velocity": joints,
        "object_position": vector,
        "object_orientation": quaternion,
        "object_velocity": vector,
        "object_spin": vector,
        "goal_orientation": quaternion,
        "relative_orientation": conjugation,
        "fingertips": tip_blocks.reshape(count * FINGERTIP_VALUES, -1),
        "previous_action": joints,
    }
    slices = teacher_observation_slices(count)
    if sees_shape:
        directions = np.array(extent_directions(count))
        back = turn.inv().apply(directions)
        same = np.argmin(np.linalg.norm(back[:, None] - directions[None], axis=2), axis=1)
        extents = np.eye(len(directions))[same]
        parts |= {
            "surface": np.kron(np.eye(count)[fingers], vector),
            "extent": extents,
            "goal_extent": extents,
        }
        first = slices["previous_action"].stop
        for name, columns in shape_observation_slices(count).items():
            slices[name] = slice(first + columns.start, first + columns.stop)
    size = max(columns.stop for columns in slices.values())
    matrix = np.zeros((size, size))
    for name, block in parts.items():
        matrix[slices[name], slices[name]] = block
    matrix[np.abs(matrix) < np.finfo(np.float32).eps] = 0.0
    return matrix


def _left_product(q: np.ndarray) -> np.ndarray:
    """Matrix [4, 4] of the product q * p of quaternions xyzw."""
    x, y, z, w = q
    return np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])
