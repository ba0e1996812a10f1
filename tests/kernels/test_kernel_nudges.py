"""When a hand is nudged, against a NumPy oracle that looks back over the distances; and how; and noise."""

import numpy as np
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, device_array, settings_array, streams, unwritten

from vd.kernels.nudges import UNKNOWN, NudgeParams, explore_kernel, nudge_kernel

JOINTS = 3


def run(device, action, distance, predicted, count, new_goal, *, seed=0, **settings):
    """Actions of the kernel, [T, N, D], for sequences of its inputs."""
    worlds = action.shape[1]
    params = settings_array(NudgeParams, device, beyond=0.5, still=0.1, **settings)
    state = [
        device_array(np.full(worlds, UNKNOWN), float, device),
        *(device_array(np.zeros(worlds), int, device) for _ in range(2)),
        device_array(np.zeros((worlds, action.shape[2])), float, device),
        streams(worlds, seed, device),
    ]
    found = []
    for t in range(len(action)):
        out = unwritten(action.shape[1:], float, device)
        inputs = [
            device_array(action[t], float, device),
            device_array(distance[t], float, device),
            device_array(predicted[t], float, device),
            device_array(count[t], int, device),
            device_array(new_goal[t], int, device),
        ]
        wp.launch(nudge_kernel, dim=worlds, inputs=[params, *inputs, *state], outputs=[out], device=device)
        found.append(out.numpy())
    return np.array(found)


def oracle(distances, begins, still_steps, nudge_steps):
    """In which steps one world is nudged."""
    nudged, first, until = [], 0, -1
    for t, begin in enumerate(begins):
        if begin:
            first, until = t, -1
        # A step counts that is far, follows another of the same goal at nearly its distance, and is free.
        waited = [
            k
            for k in range(max(first, until + 1), t + 1)
            if k > first and distances[k] > 0.5 and abs(distances[k] - distances[k - 1]) <= 0.1
        ]
        if t > until and waited[-still_steps:] == list(range(t - still_steps + 1, t + 1)):
            until = t + nudge_steps - 1
        nudged.append(t <= until)
    return np.array(nudged)


@EXAMPLES
@given(
    seed=st.integers(0, 2**31), worlds=st.integers(1, 4), waits=st.integers(1, 3), nudges=st.integers(1, 3)
)
def test_hands_whose_object_stands_still_far_away_are_nudged(device, seed, worlds, waits, nudges):
    random = np.random.default_rng(seed)
    steps = 24
    action = random.uniform(-1, 1, (steps, worlds, JOINTS)).astype(np.float32)
    # Well to either side of the bounds: multiples of 0.2, where 0.1 is still and 0.5 is near.
    distance = 0.2 * random.choice([2, 3, 4, 4, 4, 4], (steps, worlds))
    predicted = np.where(random.random((steps, worlds)) < 0.8, UNKNOWN, distance[::-1])
    count = np.where(random.random((steps, worlds)) < 0.08, 0, 5)
    new_goal = np.where(random.random((steps, worlds)) < 0.08, 1, 0)
    # A std of 0 makes a nudge an action of 0, which no policy here gives.
    found = run(
        device, action, distance, predicted, count, new_goal, std=0.0, still_steps=waits, nudge_steps=nudges
    )
    begins = (count == 0) | (new_goal == 1)
    begins[0] = True
    seen = np.where(predicted >= 0.0, predicted, distance)
    for world in range(worlds):
        nudged = oracle(seen[:, world], begins[:, world], waits, nudges)
        expected = np.where(nudged[:, None], 0.0, action[:, world])
        assert np.array_equal(found[:, world], expected)


def test_a_nudge_is_one_draw_of_its_std_and_another_each_time(device):
    """Of 4000 worlds stuck from the beginning: two steps of waiting, two of the nudge, and so on."""
    worlds, steps = 4000, 8
    shape = (steps, worlds)
    found = run(
        device,
        np.full((*shape, JOINTS), 0.75),
        np.full(shape, 2.0),
        np.full(shape, UNKNOWN),
        np.full(shape, 5),
        np.zeros(shape),
        seed=3,
        std=0.25,
        still_steps=2,
        nudge_steps=2,
    )
    own = np.full((worlds, JOINTS), 0.75, dtype=np.float32)
    for step in (0, 1, 4, 7):
        assert np.array_equal(found[step], own), step
    first, second = found[2], found[5]
    assert np.array_equal(found[2], found[3]) and np.array_equal(found[5], found[6])
    for kick in (first, second):
        assert abs(kick.mean()) < 0.01 and abs(kick.std() - 0.25) < 0.01
        assert np.abs(np.corrcoef(kick.T) - np.eye(JOINTS)).max() < 0.08
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.05


def test_a_large_nudge_is_clipped(device):
    shape = (3, 500)
    found = run(
        device,
        np.zeros((*shape, JOINTS)),
        np.full(shape, 2.0),
        np.full(shape, UNKNOWN),
        np.full(shape, 5),
        np.zeros(shape),
        std=5.0,
        still_steps=1,
        nudge_steps=1,
    )
    assert np.abs(found).max() == 1.0


def explored(device, action, distance, predicted, rng, *, beyond=0.5, std=0.25):
    """Actions of the kernel with noise, [N, D]."""
    out = unwritten(action.shape, float, device)
    inputs = [device_array(values, float, device) for values in (action, distance, predicted)]
    wp.launch(
        explore_kernel, dim=len(action), inputs=[beyond, std, *inputs, rng], outputs=[out], device=device
    )
    return out.numpy()


@EXAMPLES
@given(seed=st.integers(0, 2**31), worlds=st.integers(1, 40))
def test_actions_have_noise_only_while_the_goal_is_far(device, seed, worlds):
    random = np.random.default_rng(seed)
    action = random.uniform(-2.0, 2.0, (worlds, JOINTS)).astype(np.float32)
    distance = random.choice([0.2, 0.8], worlds)
    predicted = np.where(random.random(worlds) < 0.5, UNKNOWN, random.choice([0.0, 0.2, 0.8], worlds))
    found = explored(device, action, distance, predicted, streams(worlds, seed, device))
    far = np.where(predicted < 0.0, distance, predicted) > 0.5
    assert np.array_equal(found[~far], action[~far]), "not even clipped"
    assert np.abs(found[far]).max(initial=0.0) <= 1.0
    inside = far[:, None] & (np.abs(found) < 1.0)
    assert (found[inside] != action[inside]).all()


def test_noise_is_drawn_anew_for_each_world_joint_and_step(device):
    worlds = 4000
    rng = streams(worlds, 7, device)
    action = np.full((worlds, JOINTS), 0.125, dtype=np.float32)
    far, unknown = np.full(worlds, 2.0), np.full(worlds, UNKNOWN)
    first, second = (
        explored(device, action, far, unknown, rng, std=0.125).astype(float) - 0.125 for _ in range(2)
    )
    for noise in (first, second):
        assert abs(noise.mean()) < 0.005 and abs(noise.std() - 0.125) < 0.005
        assert np.abs(np.corrcoef(noise.T) - np.eye(JOINTS)).max() < 0.08
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.05
    assert not np.array_equal(first[:1], first[1:2])
