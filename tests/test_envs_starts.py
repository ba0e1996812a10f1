"""No episode begins with a finger inside the object, by the distances of MuJoCo C."""

import mujoco
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import HandModel, compose
from vd.assets_usd.objects.model import ObjectModel
from vd.envs import reached_starts
from vd.envs.cfg import RandomisationCfg, ReorientCfg, StartCfg
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


def test_an_episode_begins_in_a_state_that_was_reached_and_goes_on_as_it_did(monkeypatch):
    monkeypatch.setattr(reached_starts, "KEPT_SHARE", 1.0)
    cfg = ReorientCfg(
        hand="dclaw3",
        objects=("cube",),
        num_envs=3,
        randomisation=RandomisationCfg(enabled=False),
        start=StartCfg(reached_share=1.0),
    )
    env = ReorientEnv(cfg, "cpu")
    joints = env.num_joints

    def held(height: float, sink: float) -> dict[str, np.ndarray]:
        """The motion with the objects at a height, two slow and one not."""
        q, qd = env.sim.joint_q.numpy(), env.sim.joint_qd.numpy()
        q[:, joints + 2], qd[:, joints + 2] = height, sink
        qd[2, joints + 2] = -1.0
        env.sim.target.assign(env.sim.target.numpy() + 0.1)
        env.sim.joint_q.assign(q)
        env.sim.joint_qd.assign(qd)
        return {name: array.numpy().copy() for name, array in env.motion().items()}

    def three_steps() -> list[np.ndarray]:
        env.sim.forward_kinematics()
        seen = []
        for _ in range(3):
            env.hold()
            seen.append(env.sim.joint_q.numpy().copy())
        return seen

    wanted = held(0.14, -0.05)
    env.ended.zero_()
    env._reached.keep(env.ended, env.step_count)
    before = three_steps()
    goals = env.goal_quat.numpy().copy()
    env.step_count.fill_(7)
    env.renew(wp.ones(3, dtype=wp.int32, device="cpu"))
    for name, array in env.motion().items():
        rows = array.numpy().reshape(3, -1)[:2]
        np.testing.assert_array_equal(rows, wanted[name].reshape(3, -1)[:2], err_msg=name)
    assert (env.step_count.numpy() == 0).all()
    assert (np.abs(env.goal_quat.numpy() - goals).max(axis=1) > 1e-3).all()
    start = env.sim.joint_q.numpy()[2]
    assert start[joints + 2] != np.float32(0.14), "what falls is no start: it is dropped again"
    for one, other in zip(before, three_steps(), strict=True):
        np.testing.assert_array_equal(one[:2], other[:2])

    other = ReorientEnv(cfg, "cpu")
    other.load_state_dict(env.state_dict())
    saved = other.changing_arrays()
    reached = [name for name in saved if name.startswith("reached_")]
    assert "reached_count" in reached and "reached_joint_q" in reached
    for name in reached:
        np.testing.assert_array_equal(saved[name].numpy(), env.changing_arrays()[name].numpy())
