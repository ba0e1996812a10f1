"""Hands in random poses around the reset, each with an object near the table."""

from typing import Any

import newton
import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.model import ObjectModel
from vd.sim.cfg import SimCfg
from vd.sim.scene import Scene, build_scene

JOINT_SPREAD_RAD = 0.3
"""Standard deviation of the joints around the reset: fingers around, over and beside the object."""
OBJECT_HEIGHT_M = 0.05
"""Height of the objects' centres: about that of an object on the table."""
OBJECT_SPREAD_M = 0.01
"""Standard deviation of the objects' positions, along each axis."""


def posed_scene(
    objects: list[ObjectModel],
    envs: int,
    hand: str,
    device: str,
    seed: int,
    *,
    visuals: bool = False,
) -> tuple[Scene, Any]:
    """A scene, and a Newton state with random poses; of few environments fewer objects."""
    scene = build_scene(
        hand=load_hand(hand),
        objects=objects[:envs],
        num_envs=envs,
        cfg=SimCfg(),
        device=device,
        visuals=visuals,
    )
    state = scene.model.state()
    pose(scene, state, np.random.default_rng(seed))
    return scene, state


def pose(scene: Scene, state: Any, generator: np.random.Generator) -> None:
    """Give every world of a state random joints and a random pose of its object."""
    n, d = scene.num_envs, scene.hand.num_joints
    joints = scene.hand.start + JOINT_SPREAD_RAD * generator.standard_normal((n, d))
    position = OBJECT_SPREAD_M * generator.standard_normal((n, 3)) + [0.0, 0.0, OBJECT_HEIGHT_M]
    quat = Rotation.random(n, random_state=generator).as_quat()
    joints = np.clip(joints, scene.hand.lower, scene.hand.upper)
    state.joint_q.assign(
        np.concatenate([joints, position, quat], axis=1).astype(np.float32).ravel()
    )
    newton.eval_fk(scene.model, state.joint_q, state.joint_qd, state)
