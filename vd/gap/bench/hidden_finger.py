"""A finger for the hidden plant.

Mass matrix and bias by MuJoCo's engine in C, dry friction of our own.
"""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import HandModel

FRICTION_SWEEPS = 8
"""Gauss-Seidel sweeps over the joints: their coupling is one part in ten, of a LEAP hand one in
three.
"""
GRAVITY_M_S2 = 9.81


def finger_of(hand: HandModel, finger: int, heavier: np.ndarray, payload: float = 0.0) -> Any:
    """MuJoCo's model of a finger of a hand, with all joints at zero and in the axes of the base.

    Args:
        hand: The hand.
        finger: Number of the finger.
        heavier: Factors of its links' masses and inertias [n].
        payload: Point mass at its tip [kg].
    """
    joints = hand.fingers[finger]
    poses = hand.forward_kinematics(np.zeros(hand.num_joints))
    parents = poses[hand.joint_parent[joints]]
    frames = hand.joint_parent_frame[joints]
    turns = Rotation.from_quat(parents[:, 3:])
    place = parents[:, :3] + turns.apply(frames[:, :3])
    axis = (turns * Rotation.from_quat(frames[:, 3:])).apply(hand.joint_axis[joints])
    links = hand.joint_child[joints]
    own = Rotation.from_quat(poses[links, 3:])
    matrix = own.as_matrix()
    offset = np.diff(place, axis=0, prepend=np.zeros((1, 3)))
    com = poses[links, :3] + own.apply(hand.link_com[links]) - place
    inertia = matrix @ hand.link_inertia[links] @ matrix.transpose(0, 2, 1) * heavier[:, None, None]
    spec = mujoco.MjSpec()
    spec.option.gravity = GRAVITY_M_S2 * hand.down
    spec.compiler.autolimits = False
    body = spec.worldbody
    for i, x in enumerate(inertia):
        full = [x[0, 0], x[1, 1], x[2, 2], x[0, 1], x[0, 2], x[1, 2]]
        mass = hand.link_mass[links[i]] * heavier[i]
        inertial = {"ipos": com[i], "fullinertia": full, "explicitinertial": True}
        body = body.add_body(pos=offset[i], mass=mass, **inertial)
        body.add_joint(axis=axis[i])
    if payload:
        tip = poses[links[-1], :3] + own[-1].apply(hand.tip_frame[finger, :3]) - place[-1]
        tiny = [1e-12] * 3  # of a point, as small as the engine takes it
        body.add_body(pos=tip, mass=payload, inertia=tiny, explicitinertial=True)
    return spec.compile()


class Finger:
    """Equations of motion of fingers [B] with n joints each.

    Args:
        models: The fingers, as MuJoCo's models.
    """

    def __init__(self, models: Sequence[Any]):
        self._models = models
        self._data = [mujoco.MjData(model) for model in models]

    def weight(self, q: np.ndarray) -> np.ndarray:
        """Torques that hold the fingers against gravity [B, n] [N m]."""
        return self._forward(q, np.zeros_like(q))[1]

    def _forward(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mass matrices [B, n, n] [kg m^2], and what gravity and speeds pull [B, n] [N m]."""
        mass = np.empty((*q.shape, q.shape[1]))
        bias = np.empty_like(q)
        for i, (model, data) in enumerate(zip(self._models, self._data, strict=True)):
            data.qpos[:] = q[i]
            data.qvel[:] = v[i]
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            mujoco.mj_fullM(model, data, mass[i])
            bias[i] = data.qfrc_bias
        return mass, bias

    def velocity(
        self,
        q: np.ndarray,
        v: np.ndarray,
        push: np.ndarray,
        resisting: np.ndarray,
        minus: np.ndarray,
        plus: np.ndarray,
        inertia: np.ndarray,
        dt: float,
    ) -> np.ndarray:
        """Speeds after a step [B, n]: the engine's equations, dry friction by complementarity.

        Args:
            q: Positions [B, n] [rad].
            v: Speeds before [B, n] [rad/s].
            push: Torques of drives and loads [B, n] [N m].
            resisting: What resists the speed, as an impedance [B, n] [N m s/rad].
            minus: Dry friction against moving back [B, n] [N m].
            plus: And forth [B, n] [N m].
            inertia: Of the drives [B, n] [kg m^2].
            dt: Time step [s].
        """
        links, bias = self._forward(q, v)
        system = links / dt
        joints = range(q.shape[1])
        system[:, joints, joints] += inertia / dt + resisting
        momentum = np.einsum("bij,bj->bi", system, v) + push - bias
        new = v.copy()
        for _ in range(FRICTION_SWEEPS):
            for i in joints:
                own = system[:, i, i]
                others = np.einsum("bj,bj->b", system[:, i], new)
                left = momentum[:, i] - others + own * new[:, i]
                new[:, i] = slip(left, minus[:, i], plus[:, i]) / own
        return new


def slip(momentum: np.ndarray, minus: np.ndarray, plus: np.ndarray) -> np.ndarray:
    """What dry friction leaves of a push.

    Nothing within its bounds (stick), else the rest (slip).
    """
    return momentum - np.minimum(np.maximum(momentum, -minus), plus)
