"""No episode begins with a finger inside the object, by the distances of MuJoCo C."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import HandModel, compose
from vd.assets_usd.objects.model import ObjectModel
from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.paper import PAPER

OBJECTS = "procedural-24-seed0"
GEOMS = {"box": mujoco.mjtGeom.mjGEOM_BOX, "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE}
DEEP_M = 0.001


def hand_depth(hand: HandModel, item: ObjectModel, poses: np.ndarray) -> list[float]:
    """How deep a convex part of an object is in a shape of the hand after a reset [m], at poses [n, 7]."""
    spec = mujoco.MjSpec()
    links = compose(hand.mount, hand.forward_kinematics(hand.start))
    for shape in hand.shapes:
        pose = compose(links[shape.link], shape.frame)
        size = [*shape.size, 0.0][:3]
        spec.worldbody.add_geom(
            type=GEOMS[shape.kind], size=size, pos=pose[:3], quat=pose[[6, 3, 4, 5]]
        )
    body = spec.worldbody.add_body(mass=0.1, inertia=[1e-4] * 3, explicitinertial=True)
    body.add_freejoint()
    for index, (vertices, _) in enumerate(item.hulls):
        mesh = spec.add_mesh(name=str(index))
        mesh.uservert = np.asarray(vertices).flatten()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=str(index))
    model = spec.compile()
    data, depths = mujoco.MjData(model), []
    for pose in poses:
        data.qpos[:] = pose[[0, 1, 2, 6, 3, 4, 5]]
        mujoco.mj_fwdPosition(model, data)
        depths.append(max([0.0, *(-data.contact.dist)]))
    return depths


@pytest.mark.parametrize("hand", ["dclaw3", "dclaw4"])
def test_no_finger_is_inside_an_object_that_starts_in_the_orientation_that_is_asked_for(hand):
    count = 150
    cfg = ReorientCfg(
        hand=hand, objects=(OBJECTS,), num_envs=count, randomisation=RandomisationCfg(enabled=False)
    )
    env = ReorientEnv(cfg, "cpu")
    drawn = Rotation.random(count, rng=np.random.default_rng(0)).as_quat().astype(np.float32)
    env.reset(drawn)
    poses = env.object_pose()
    np.testing.assert_array_equal(poses[:, 3:], drawn)
    as_drawn = poses.copy()
    as_drawn[:, :3] = env.hand.workspace.drop_m
    before, after = (
        np.concatenate(
            [
                hand_depth(env.hand, env.objects[which], p[[world]])
                for world, which in enumerate(env.world_object)
            ]
        )
        for p in (as_drawn, poses)
    )
    assert (before > DEEP_M).mean() > {"dclaw3": 0.25, "dclaw4": 0.01}[hand]
    assert after.max() < DEEP_M
    away = np.linalg.norm(poses[:, :3] - env.hand.workspace.drop_m, axis=1)
    noise = np.sqrt(3.0) * PAPER.scene.object_start_noise_m
    assert (away < noise + 1e-6)[before < 1e-9].mean() > 0.8, "what is free starts as in the paper"
