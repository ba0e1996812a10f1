"""In its goal's symmetry frame a turned world looks the same, and moves the same under the same action."""

import dataclasses

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from vd.assets_usd.hands import load_hand
from vd.envs.cfg import ObservationCfg, RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.envs.symmetry_frames import SECTOR
from vd.kernels.task.observations import teacher_observation_slices

WORLDS = 6
CFG = ReorientCfg(
    hand="dclaw3",
    objects=("cuboid",),
    num_envs=WORLDS,
    randomisation=RandomisationCfg(enabled=False),
    observation=ObservationCfg(shape="full", view="goal"),
)


def turned_quat(quat: np.ndarray, angle: float) -> np.ndarray:
    """Orientation ``quat`` after a turn about the vertical, [N, 4], without a change of sign."""
    x, y, z, w = quat.T
    s, c = np.sin(angle / 2.0), np.cos(angle / 2.0)
    return np.stack([c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z], axis=1)


def with_signs_of(reference: np.ndarray, observation: np.ndarray, fingers: int) -> np.ndarray:
    """The observation with the object's quaternions, of either sign, in that of the reference."""
    observation = observation.copy()
    for name in ("object_orientation", "goal_orientation", "relative_orientation"):
        columns = teacher_observation_slices(fingers, 3 * fingers)[name]
        sign = np.sign((observation[:, columns] * reference[:, columns]).sum(axis=1, keepdims=True))
        observation[:, columns] *= sign
    return observation


def look(env: ReorientEnv) -> None:
    """Observe anew, in the frames for where the objects are now."""
    every = wp.ones(WORLDS, dtype=wp.int32, device=env.device)
    env.symmetry_frames.choose(every, every)
    env.observe()


def act(env: ReorientEnv, action: np.ndarray) -> None:
    env.action.assign(action)
    env.step(env.action)


def moved(env: ReorientEnv) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray]:
    """State and observation after random steps, and an action with what is seen after it (NaN: reset)."""
    rng = np.random.default_rng(3)
    for action in rng.uniform(-1, 1, (30, WORLDS, env.num_actions)).astype(np.float32):
        act(env, action)
    look(env)
    state, before = env.state_dict(), env.observation.numpy().copy()
    action = rng.uniform(-1, 1, (WORLDS, env.num_actions)).astype(np.float32)
    act(env, action)
    kept = env.done.numpy() == 0
    assert kept.any() and len(set(state["arrays"]["view"])) > 1, (
        "the environments are in different frames"
    )
    return state, before, action, np.where(kept[:, None], env.observation.numpy(), np.nan)


def assert_same_after(env: ReorientEnv, action: np.ndarray, after: np.ndarray) -> None:
    """The action leads to what is seen after it, as far as contacts found in another order allow."""
    act(env, action)
    kept = np.isfinite(after[:, 0])
    error = np.abs(with_signs_of(after, env.observation.numpy(), env.num_fingers) - after)[kept]
    assert np.median(error) < 1e-4 and np.quantile(error, 0.9) < 0.05


@pytest.mark.parametrize("hand", ["dclaw3", "dclaw4"])
def test_turned_worlds_look_and_move_the_same(hand):
    env = ReorientEnv(dataclasses.replace(CFG, hand=hand), "cpu")
    fingers, joints = env.num_fingers, env.num_actions
    state, before, action, after = moved(env)
    tips = load_hand(hand).tip_poses(np.zeros(joints))
    azimuth = np.arctan2(tips[:, 1], -tips[:, 0])  # the base is upside down, turned about y
    for step in range(1, fingers):
        angle = 2.0 * np.pi * step / fingers
        new = [
            int(np.argmin(np.abs(np.angle(np.exp(1j * (azimuth - a - angle)))))) for a in azimuth
        ]
        source = np.argsort(new)
        arrays = {name: value.copy() for name, value in state["arrays"].items()}
        for name in ("joint_q", "joint_qd", "target", "smoothed"):
            value = arrays[name][:, :joints].reshape(WORLDS, fingers, 3)
            arrays[name][:, :joints] = value[:, source].reshape(WORLDS, joints)
        rotation = Rotation.from_euler("z", angle)
        q, qd = arrays["joint_q"], arrays["joint_qd"]
        q[:, joints : joints + 3] = rotation.apply(q[:, joints : joints + 3])
        q[:, joints + 3 :] = turned_quat(q[:, joints + 3 :], angle)
        for begin in (joints, joints + 3):
            qd[:, begin : begin + 3] = rotation.apply(qd[:, begin : begin + 3])
        arrays["goal_quat"] = turned_quat(arrays["goal_quat"], angle).astype(np.float32)
        arrays["warm_start"][:] = 0.0
        env.load_state_dict(state | {"arrays": arrays})
        look(env)
        turned = (state["arrays"]["view"] - env.symmetry_frames.chosen.numpy()) % fingers
        assert (turned == step).all(), "the frame goes with the world"
        seen = with_signs_of(before, env.observation.numpy(), fingers)
        np.testing.assert_allclose(seen, before, atol=2e-4)
        assert_same_after(env, action, after)


def test_mirrored_worlds_look_and_move_the_same():
    """With a cuboid, which is its own mirror image; a reflection in the plane of one finger."""
    cfg = dataclasses.replace(CFG, observation=ObservationCfg(shape="full", view="mirrored"))
    env = ReorientEnv(cfg, "cpu")
    state, before, action, after = moved(env)
    points = env.state.surface_points  # drawn at random, so that theirs is another cuboid
    surface = points.numpy().copy()
    tips = load_hand("dclaw3").tip_poses(np.zeros(9))
    azimuth = np.arctan2(tips[:, 1], -tips[:, 0])  # the base is upside down, turned about y
    for finger in range(3):
        others = [f for f in range(3) if f != finger]
        source = np.arange(3)
        source[others] = source[others[::-1]]
        x, y = np.cos(azimuth[finger]), np.sin(azimuth[finger])
        mirror = np.array(
            [[x * x - y * y, 2 * x * y, 0.0], [2 * x * y, y * y - x * x, 0.0], [0.0, 0.0, 1.0]]
        )

        def in_mirror(quat, mirror=mirror):
            axes = mirror @ Rotation.from_quat(quat).as_matrix() @ np.diag([1.0, -1.0, 1.0])
            return Rotation.from_matrix(axes).as_quat().astype(np.float32)

        arrays = {name: value.copy() for name, value in state["arrays"].items()}
        for name in ("joint_q", "joint_qd", "target", "smoothed"):
            value = arrays[name][:, :9].reshape(WORLDS, 3, 3)
            arrays[name][:, :9] = (value[:, source] * [-1.0, 1.0, 1.0]).reshape(WORLDS, 9)
        q, qd = arrays["joint_q"], arrays["joint_qd"]
        q[:, 9:12] = q[:, 9:12] @ mirror
        q[:, 12:] = in_mirror(q[:, 12:])
        qd[:, 9:12] = qd[:, 9:12] @ mirror
        qd[:, 12:] = -qd[:, 12:] @ mirror
        arrays["goal_quat"] = in_mirror(arrays["goal_quat"])
        arrays["warm_start"][:] = 0.0
        env.load_state_dict(state | {"arrays": arrays})
        points.assign(surface * [1.0, -1.0, 1.0])
        look(env)
        was, now = state["arrays"]["view"] >= 3, env.symmetry_frames.chosen.numpy() >= 3
        assert (was != now).all(), (
            "what was seen in the mirror is seen as it is, and the other way round"
        )
        seen = with_signs_of(before, env.observation.numpy(), 3)
        np.testing.assert_allclose(seen, before, atol=2e-4)
        assert_same_after(env, action, after)


def test_a_hand_whose_fingers_lean_is_no_mirror_image():
    cfg = dataclasses.replace(CFG, hand="dclaw4", observation=ObservationCfg(view="mirrored"))
    with pytest.raises(ValueError, match=r"dclaw4 .*observation\.view to goal"):
        ReorientEnv(cfg, "cpu")


def test_the_axis_of_the_wanted_rotation_is_in_one_sector_when_the_goal_is_new():
    env = ReorientEnv(dataclasses.replace(CFG, num_envs=60), "cpu")
    pose, goal = env.object_pose()[:, 3:], env.goal_quat.numpy()
    wanted = (Rotation.from_quat(goal) * Rotation.from_quat(pose).inv()).as_rotvec()
    seen = np.stack(
        [
            Rotation.from_euler("z", 2.0 * np.pi * k / 3).apply(w)
            for k, w in zip(env.symmetry_frames.chosen.numpy(), wanted, strict=True)
        ]
    )
    cosine = seen @ SECTOR / np.linalg.norm(seen[:, :2], axis=1)
    assert (cosine > 0.5 - 1e-4).all(), "within 60 degrees of the direction"
    assert len(set(env.symmetry_frames.chosen.numpy())) == 3
    frames = env.symmetry_frames.chosen.numpy().copy()
    for _ in range(5):
        act(env, np.full((60, 9), 0.5, dtype=np.float32))
    same = env.step_count.numpy() == 5
    assert (env.symmetry_frames.chosen.numpy() == frames)[same].all(), (
        "a frame lasts as long as its goal"
    )


def test_the_world_frame_is_a_view_too():
    plain = ReorientEnv(dataclasses.replace(CFG, observation=ObservationCfg(shape="full")), "cpu")
    viewed = ReorientEnv(CFG, "cpu")
    assert plain.symmetry_frames is None
    assert np.array_equal(plain.observation.numpy(), viewed.world_observation.numpy())
    first = viewed.symmetry_frames.chosen.numpy() == 0
    assert first.any()
    np.testing.assert_allclose(
        viewed.observation.numpy()[first], plain.observation.numpy()[first], atol=1e-6
    )

    viewed.acts_in_frame = False
    rng = np.random.default_rng(0)
    for action in rng.uniform(-1, 1, (4, WORLDS, 9)).astype(np.float32):
        act(plain, action)
        act(viewed, action)
    assert np.array_equal(plain.sim.joint_q.numpy(), viewed.sim.joint_q.numpy())
