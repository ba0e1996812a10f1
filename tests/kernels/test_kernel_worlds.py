"""Guards, contacts and bookkeeping against NumPy oracles."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, SENTINEL, device_array, launch

from vd.kernels.task.contacts import pair_force_kernel
from vd.kernels.task.environments import (
    redraw_mask_kernel,
    write_friction_kernel,
    write_object_force_kernel,
)
from vd.kernels.task.guard import collect_overflow_kernel, guard_kernel

FRICTION = 0.8


@EXAMPLES
@given(seed=st.integers(0, 2**31), worlds=st.integers(1, 5))
def test_pair_forces_are_summed_per_world(device, seed, worlds):
    random = np.random.default_rng(seed)
    slots, rows, geoms = 12, 9, 4
    count = int(random.integers(0, slots + 1))
    world = random.integers(0, worlds, slots)
    pairs = random.integers(-1, geoms, (slots, 2))
    first = random.integers(0, rows - 6, slots)
    row = np.where(random.random(slots) < 0.2, -1, first)[:, None] + np.arange(6)
    row[row[:, 0] < 0] = -1
    force = random.normal(size=(worlds, rows)).astype(np.float32)
    kind = random.integers(0, 3, (worlds, geoms))

    expected = np.zeros(worlds)
    for c in range(count):
        if row[c, 0] < 0 or pairs[c].min() < 0:
            continue
        kinds = sorted(kind[world[c], pairs[c]])
        if kinds != [1, 2]:
            continue
        expected[world[c]] += force[world[c], row[c, 0]]

    out = device_array(np.zeros(worlds), float, device)
    inputs = [np.array([count]), world, pairs, row, force, kind, 1, 2, out]
    launch(pair_force_kernel, slots, inputs, device)
    np.testing.assert_allclose(out.numpy(), expected, atol=1e-5)


def test_overflow_bits_stick_and_others_do_not_count(device):
    seen = device_array(np.array([0, 4, 0]), int, device)
    for bits in ([1, 8, 1 << 9], [2, 0, 1 << 9]):
        launch(collect_overflow_kernel, 3, [np.array(bits), 15, seen], device)
    np.testing.assert_array_equal(seen.numpy(), [3, 12, 0])


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e3])
@pytest.mark.parametrize("where", ["q", "qd"])
def test_guard_counts_the_bad_steps_of_each_world(device, where, value):
    worlds, bad = 3, 1
    q, qd = np.zeros((worlds, 4)), np.zeros((worlds, 3))
    if where == "q" and np.isfinite(value):
        pytest.skip("positions have no bound")
    (q if where == "q" else qd)[bad, 2] = value
    failures, failed = (
        device_array(values, int, device) for values in (np.zeros(worlds), [SENTINEL] * worlds)
    )
    for scale, expected in ((1.0, [0, 1, 0]), (0.0, [0, 0, 0]), (1.0, [0, 1, 0])):
        state = (q, qd) if scale else (np.zeros_like(q), np.zeros_like(qd))
        launch(guard_kernel, worlds, [*state, 500.0, failures, failed], device)
        np.testing.assert_array_equal(failed.numpy(), expected)
    np.testing.assert_array_equal(failures.numpy(), [0, 2, 0])


@EXAMPLES
@given(seed=st.integers(0, 2**31), worlds=st.integers(1, 6))
def test_redraw_waits_for_a_reset_of_old_dynamics(device, seed, worlds):
    random = np.random.default_rng(seed)
    reset, age = random.integers(0, 2, worlds), random.integers(0, 20, worlds)
    ages = device_array(age, int, device)
    (mask,) = launch(redraw_mask_kernel, worlds, [reset, 10, ages], device, worlds)
    due = (reset == 1) & (age + 1 >= 10)
    np.testing.assert_array_equal(mask, due.astype(int))
    np.testing.assert_array_equal(ages.numpy(), np.where(due, 0, age + 1))


@EXAMPLES
@given(seed=st.integers(0, 2**31), worlds=st.integers(1, 4))
def test_friction_of_a_pair_is_the_average(device, seed, worlds):
    random = np.random.default_rng(seed)
    shapes = 12
    world, kind = random.integers(-1, worlds, shapes), random.integers(0, 4, shapes)
    nominal = random.uniform(0.5, 1.5, shapes).astype(np.float32)
    hand, item, table = random.uniform(0.05, 1.6, (3, worlds)).astype(np.float32)
    share = random.choice([0.5, 1.0], worlds).astype(np.float32)
    before = random.uniform(size=shapes).astype(np.float32)
    expected = before.copy()
    for s in range(shapes):
        w = world[s]
        if w < 0:
            continue
        if kind[s] == 2:
            expected[s] = item[w]
        elif kind[s] == 1:
            expected[s] = share[w] * table[w] + (1.0 - share[w]) * item[w]
        elif kind[s] == 3:
            expected[s] = 0.5 * (hand[w] * nominal[s] / FRICTION + item[w])
    out = device_array(before, float, device)
    inputs = [world, kind, nominal, share, FRICTION, 1, 2, 3, hand, item, table, out]
    launch(write_friction_kernel, shapes, inputs, device)
    np.testing.assert_allclose(out.numpy(), expected, rtol=1e-5)


def test_a_force_and_a_share_of_the_weight_act_on_the_object_alone(device):
    random, envs = np.random.default_rng(0), 4
    force = random.normal(size=(envs, 3)).astype(np.float32)
    mass, lightened = random.uniform(0.05, 0.2, envs).astype(np.float32), np.array([0, 1, 1, 0])
    body_force = wp.zeros((envs, 5), dtype=wp.spatial_vector, device=device)
    inputs = [mass, lightened, wp.vec3(0.5, 0.0, -9.81), np.array([0.3]), 4, force, body_force]
    launch(write_object_force_kernel, envs, inputs, device)
    carried = force - 0.7 * (lightened * mass)[:, None] * np.array([0.5, 0.0, -9.81])
    np.testing.assert_allclose(body_force.numpy()[:, 4, :3], carried, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(body_force.numpy()[lightened == 0, 4, :3], force[lightened == 0])
    assert not body_force.numpy()[:, :4].any() and not body_force.numpy()[:, 4, 3:].any()
