import itertools

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import (
    ALPHA,
    EXAMPLES,
    SENTINEL,
    angle_between,
    ball_cdf,
    device_array,
    goals,
    indices,
    launch,
    quaternions,
    relative_quaternion,
    rotation_angles,
    streams,
)
from scipy import stats
from scipy.spatial.transform import Rotation

from vd.kernels.task.resets import episode_kernel, reset_kernel
from vd.paper import PAPER

START = np.array([0.0, 0.0, 0.12])
NOISE = PAPER.scene.object_start_noise_m


def end_episodes(device, success, fell, before, *, age, ends):
    """Launch; returns every array by name.

    Steps and age of the goal are ``before`` and ``age`` before it.
    """
    count = len(before)
    state = [device_array(before, int, device), device_array(age, int, device)]
    state.append(device_array([1.0, 2.0, 3.0], float, device))
    out = launch(episode_kernel, count, [success, fell, 10, ends, *state], device, *[count] * 4)
    names = ("steps", "age", "counts", "timed_out", "done", "reset", "new_goal")
    return dict(zip(names, [*(array.numpy() for array in state), *out], strict=True))


@pytest.mark.parametrize("ends", [0, 1])
def test_episode_ends_as_stated_in_every_case(device, ends):
    # Success, fell, steps before; limit 10.
    cases = list(itertools.product([0, 1], [0, 1], [3, 8, 9, 20]))
    success, fell, before = (np.array(column) for column in zip(*cases, strict=True))
    count = len(cases)
    out = end_episodes(device, success, fell, before, age=np.full(count, 8), ends=ends)
    np.testing.assert_array_equal(out["steps"], before + 1)
    np.testing.assert_array_equal(out["age"], 9)
    np.testing.assert_array_equal(
        out["counts"] - [1, 2, 3], [out["done"].sum(), success.sum(), fell.sum()]
    )
    for i, (s, f, b) in enumerate(cases):
        end = b + 1 >= 10
        assert out["timed_out"][i] == int(end and not s and not f)
        assert out["done"][i] == int(bool(s or f or end))
        reset = bool(f or end or (s and ends))
        assert out["reset"][i] == int(reset)
        assert out["new_goal"][i] == int(bool(s) and not reset)


def goal_beside(goal, orientation, found):
    """Goals with the sign by which the rotation from them is the shorter.

    Half a turn has either.
    """
    shortest = relative_quaternion(orientation, goal)[:, 3:]
    either = np.sign((goal * found).sum(axis=1, keepdims=True))
    return np.where(np.abs(shortest) < 1e-6, either, np.sign(shortest)) * goal


class World:
    """State of N worlds before a reset, and the launch."""

    def __init__(self, device, worlds, fingers=3, seed=0, orientation=None):
        self.device, self.joints = device, 3 * fingers
        joints = self.joints
        self.reset_q = np.tile([0.0, 0.8, -1.1], fingers).astype(np.float32)
        q = np.random.default_rng(1).normal(size=(worlds, joints + 7)).astype(np.float32)
        q[:, joints + 3 :] /= np.linalg.norm(q[:, joints + 3 :], axis=1, keepdims=True)
        if orientation is not None:
            q[:, joints + 3 :] = orientation
        self.before = {
            "q": q,
            "rng": streams(worlds, seed, device).numpy(),
            "qd": np.full((worlds, joints + 6), np.nan, np.float32),
            "smoothed": np.full((worlds, joints), np.nan, np.float32),
            "steps": np.full(worlds, SENTINEL, np.int32),
            "age": np.full(worlds, SENTINEL, np.int32),
            "goal": np.full((worlds, 4), np.nan, np.float32),
            "error": np.full(worlds, np.nan, np.float32),
        }

    def reset(
        self, mask, new_goal, max_angle=np.pi, noise=NOISE, *, vertical=0, rest=None, **given
    ):
        """Launch; returns every array by name."""
        types = {"rng": wp.uint32, "steps": int, "age": int, "goal": wp.quat}
        state = {
            n: device_array(a, types.get(n, float), self.device) for n, a in self.before.items()
        }
        env_mask = wp.zeros(len(mask) + 1, wp.bool, device=self.device)
        start = {"position": wp.vec3(*START), "noise": noise}
        goal = {"max_angle": max_angle, "about_vertical": vertical}
        inputs = [self.reset_q, start, goal, np.zeros((len(mask), 0, 7)) if rest is None else rest]
        inputs += [mask, new_goal]
        for name in ("start_quat", "goal_quat"):
            inputs += [given.get(name, np.zeros((0, 4))), int(name in given)]
        launch(reset_kernel, len(mask), [*inputs, *state.values(), env_mask], self.device)
        np.testing.assert_array_equal(env_mask.numpy(), [*(np.asarray(mask) != 0), False])
        return {name: array.numpy() for name, array in state.items()}


@EXAMPLES
@given(
    data=st.data(),
    fingers=st.sampled_from([3, 4]),
    worlds=st.integers(1, 6),
    given_quats=st.booleans(),
)
def test_only_masked_worlds_change_and_only_in_what_is_theirs(
    device, data, fingers, worlds, given_quats
):
    mask, new_goal = data.draw(indices(worlds, 2)), data.draw(indices(worlds, 2))
    start = data.draw(quaternions((worlds,))) if given_quats else None
    goal = data.draw(quaternions((worlds,))) if given_quats else None
    world = World(device, worlds, fingers, orientation=data.draw(quaternions((worlds,))))
    given = {"start_quat": start, "goal_quat": goal} if given_quats else {}
    after = world.reset(mask, new_goal, **given)
    joints = world.joints
    untouched = (mask == 0) & (new_goal == 0)
    for name, array in after.items():
        before = world.before[name]
        assert array[untouched].tobytes() == before[untouched].tobytes(), (
            f"{name} of a world outside the masks"
        )
    for name in ("q", "qd", "steps"):
        kept = mask == 0
        assert after[name][kept].tobytes() == world.before[name][kept].tobytes(), (
            f"{name} at a new goal"
        )

    reset = mask == 1
    np.testing.assert_array_equal(
        after["q"][reset, :joints], np.tile(world.reset_q, (reset.sum(), 1))
    )
    assert np.abs(after["q"][reset, joints : joints + 3] - START).max(initial=0.0) <= NOISE + 1e-6
    for name in ("qd", "steps"):
        assert not after[name][reset].any(), name
    changed = ~untouched
    assert not after["smoothed"][changed].any() and not after["age"][changed].any()
    assert np.all(after["rng"][changed] != world.before["rng"][changed])
    orientation = after["q"][:, joints + 3 :]
    np.testing.assert_allclose(np.linalg.norm(orientation[reset], axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(after["goal"][changed], axis=1), 1.0, atol=1e-6)
    if start is not None and goal is not None:
        np.testing.assert_array_equal(orientation[reset], start[reset])
        wanted = goal_beside(goal, orientation, after["goal"])
        np.testing.assert_array_equal(after["goal"][changed], wanted[changed])
    if changed.any():
        error = angle_between(orientation[changed], after["goal"][changed])
        np.testing.assert_allclose(after["error"][changed], error, atol=2e-3)


def test_starts_and_goals_are_uniform_and_independent(device):
    worlds = 50_000
    everywhere = np.ones(worlds, int)
    world = World(device, worlds, seed=7)
    after = world.reset(everywhere, 0 * everywhere)
    joints = world.joints
    for axis in range(3):
        offset = after["q"][:, joints + axis] - START[axis]
        uniform = stats.uniform(-NOISE, 2 * NOISE)
        assert stats.kstest(offset, uniform.cdf).pvalue > ALPHA
    start, goal = after["q"][:, joints + 3 :].astype(float), after["goal"].astype(float)
    for q in (start, goal):
        assert stats.kstest(rotation_angles(q), lambda a: ball_cdf(a, np.pi)).pvalue > ALPHA
    assert after["error"].mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.015)
    assert stats.kstest(after["error"], lambda a: ball_cdf(a, np.pi)).pvalue > ALPHA
    cross = np.corrcoef(np.hstack([start * np.sign(start[:, 3:]), goal * np.sign(goal[:, 3:])]).T)[
        :4, 4:
    ]
    assert np.abs(cross).max() < 0.03, "goals depend on starts"
    place_and_error = np.column_stack([after["q"][:, joints : joints + 3], after["error"]])
    assert np.abs(np.corrcoef(place_and_error.T) - np.eye(4)).max() < 0.03, (
        "the goal reuses numbers"
    )

    again = World(device, worlds, seed=7).reset(everywhere, 0 * everywhere)
    assert all(after[name].tobytes() == again[name].tobytes() for name in after), (
        "the seed does not fix the draw"
    )


@pytest.mark.parametrize("max_angle", [0.01, 0.3, 1.0, 2.5])
def test_new_goals_stay_within_their_angle_of_the_present_orientation(device, max_angle):
    worlds = 20_000
    everywhere = np.ones(worlds, int)
    world = World(device, worlds, seed=8)
    after = world.reset(0 * everywhere, everywhere, max_angle=max_angle)
    orientation = world.before["q"][:, world.joints + 3 :]
    error = angle_between(orientation, after["goal"])
    assert error.max() <= max_angle + 1e-3
    assert stats.kstest(error, lambda a: ball_cdf(a, max_angle)).pvalue > ALPHA


def test_goals_about_the_vertical_turn_nothing_else(device):
    worlds = 20_000
    everywhere = np.ones(worlds, int)
    world = World(device, worlds, seed=9)
    after = world.reset(0 * everywhere, everywhere, max_angle=1.0, vertical=1)
    before = Rotation.from_quat(world.before["q"][:, world.joints + 3 :])
    turn = (Rotation.from_quat(after["goal"]) * before.inv()).as_rotvec()
    assert np.abs(turn[:, :2]).max() < 1e-5
    assert stats.kstest(turn[:, 2], stats.uniform(-1.0, 2.0).cdf).pvalue > ALPHA


def test_starts_at_rest_keep_place_and_tilt(device):
    worlds, poses = 3000, 3
    everywhere = np.ones(worlds, int)
    random = np.random.default_rng(4)
    rest = np.zeros((worlds, poses, 7), np.float32)
    rest[..., :3] = random.normal(size=(worlds, poses, 3))
    rest[..., 3:] = Rotation.random(worlds * poses, rng=5).as_quat().reshape(worlds, poses, 4)
    world = World(device, worlds, seed=10)
    after = world.reset(everywhere, 0 * everywhere, rest=rest)
    position = after["q"][:, world.joints : world.joints + 3]
    chosen = np.argmin(np.linalg.norm(rest[..., :3] - position[:, None], axis=2), axis=1)
    picked = rest[np.arange(worlds), chosen]
    np.testing.assert_array_equal(position, picked[:, :3])
    assert np.bincount(chosen, minlength=poses).min() > 0.8 * worlds / poses
    turn = (
        Rotation.from_quat(after["q"][:, world.joints + 3 :])
        * Rotation.from_quat(picked[:, 3:]).inv()
    )
    assert np.abs(turn.as_rotvec()[:, :2]).max() < 1e-5
    assert stats.kstest(turn.as_rotvec()[:, 2], stats.uniform(-np.pi, 2 * np.pi).cdf).pvalue > ALPHA


@EXAMPLES
@given(data=st.data(), worlds=st.integers(1, 5))
def test_a_given_goal_counts_the_same_by_either_of_its_quaternions(device, data, worlds):
    """Half a turn and equal orientations among them."""
    orientation = data.draw(quaternions((worlds,)))
    goal = data.draw(goals(orientation))
    ones = np.ones(worlds)
    found = [
        World(device, worlds).reset(ones, 0 * ones, start_quat=orientation, goal_quat=g)
        for g in (goal, -goal)
    ]
    for name in found[0]:
        np.testing.assert_array_equal(found[0][name], found[1][name], err_msg=name)
    kept = found[0]["goal"]
    turn = relative_quaternion(orientation, kept)
    assert (turn[:, 3] > -1e-7).all(), "less than half a turn, as of the goals that are drawn"
    np.testing.assert_allclose(np.abs((kept * goal).sum(axis=1)), 1.0, atol=1e-6)
