"""Guards, contact forces and bookkeeping against NumPy oracles."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, SENTINEL, device_array, unwritten

from vd.kernels.task.contacts import pair_force_kernel
from vd.kernels.task.environments import (
    copy_columns_kernel,
    count_goals_kernel,
    place_table_kernel,
    record_step_kernel,
    redraw_mask_kernel,
    world_mask_kernel,
    write_friction_kernel,
    write_gains_kernel,
    write_object_force_kernel,
)
from vd.kernels.task.guard import collect_overflow_kernel, guard_kernel, put_back_kernel, void_step_kernel

FRICTION = 0.8


@EXAMPLES
@given(seed=st.integers(0, 2**31), worlds=st.integers(1, 5), pyramidal=st.booleans())
def test_pair_forces_are_summed_per_world(device, seed, worlds, pyramidal):
    random = np.random.default_rng(seed)
    slots, rows, geoms = 12, 9, 4
    count = int(random.integers(0, slots + 1))
    world = random.integers(0, worlds, slots)
    pairs = random.integers(-1, geoms, (slots, 2))
    dim = random.choice([1, 3, 4], slots)
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
        edges = 2 * (dim[c] - 1) if pyramidal and dim[c] > 1 else 1
        expected[world[c]] += force[world[c], row[c, :edges]].sum()

    out = device_array(np.zeros(worlds), float, device)
    wp.launch(
        pair_force_kernel,
        dim=slots,
        inputs=[
            device_array(np.array([count]), int, device),
            device_array(world, int, device),
            device_array(pairs, wp.vec2i, device),
            device_array(row, int, device),
            device_array(dim, int, device),
            device_array(force, float, device),
            device_array(kind, int, device),
            1,
            2,
            int(pyramidal),
        ],
        outputs=[out],
        device=device,
    )
    np.testing.assert_allclose(out.numpy(), expected, atol=1e-5)


def test_overflow_bits_stick_and_others_do_not_count(device):
    seen = device_array(np.array([0, 4, 0]), int, device)
    for bits in ([1, 8, 1 << 9], [2, 0, 1 << 9]):
        wp.launch(
            collect_overflow_kernel,
            dim=3,
            inputs=[device_array(np.array(bits), int, device), 0b1111],
            outputs=[seen],
            device=device,
        )
    np.testing.assert_array_equal(seen.numpy(), [3, 12, 0])


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e3])
@pytest.mark.parametrize("where", ["q", "qd"])
def test_guard_freezes_the_start_of_the_bad_step(device, where, value):
    worlds, good, bad = 3, 5.0, 1
    q, qd = np.zeros((worlds, 4)), np.zeros((worlds, 3))
    if where == "q" and np.isfinite(value):
        pytest.skip("positions have no bound")
    (q if where == "q" else qd)[bad, 2] = value
    failures, failed = (
        device_array(values, int, device) for values in (np.zeros(worlds), [SENTINEL] * worlds)
    )
    dumps = [device_array(np.full((worlds, n), np.nan), float, device) for n in (4, 3, 2)]

    def launch(start: float, q: np.ndarray, qd: np.ndarray) -> None:
        wp.launch(
            guard_kernel,
            dim=worlds,
            inputs=[
                device_array(q, float, device),
                device_array(qd, float, device),
                device_array(np.full((worlds, 4), start), float, device),
                device_array(np.full((worlds, 3), start), float, device),
                device_array(np.full((worlds, 2), start), float, device),
                500.0,
            ],
            outputs=[failures, *dumps, failed],
            device=device,
        )

    launch(good, q, qd)
    np.testing.assert_array_equal(failed.numpy(), [0, 1, 0])
    launch(good + 1.0, 0.0 * np.nan_to_num(q, posinf=0.0), 0.0 * np.nan_to_num(qd, posinf=0.0))
    np.testing.assert_array_equal(failed.numpy(), 0)
    launch(good + 2.0, q, qd)
    np.testing.assert_array_equal(failures.numpy(), [0, 2, 0])
    for dump in dumps:
        assert (dump.numpy()[bad] == good).all(), "frozen at the first step that failed"
        assert (dump.numpy()[[0, 2]] == good + 2.0).all(), "good worlds go on"


def test_a_failed_step_is_put_back_and_counts_for_nothing(device):
    failed = device_array([0, 1, 0], int, device)
    start = np.arange(12.0).reshape(3, 4)
    q, qd = (device_array(np.full((3, n), np.nan), float, device) for n in (4, 3))
    steps = device_array([5, 5, 5], int, device)
    wp.launch(
        put_back_kernel,
        dim=3,
        inputs=[failed, device_array(start, float, device), 59],
        outputs=[q, qd, steps],
        device=device,
    )
    np.testing.assert_array_equal(q.numpy()[1], start[1])
    np.testing.assert_array_equal(qd.numpy()[1], 0.0)
    assert np.isnan(q.numpy()[[0, 2]]).all() and np.isnan(qd.numpy()[[0, 2]]).all(), "others are left alone"
    np.testing.assert_array_equal(steps.numpy(), [5, 59, 5])

    reward, terms = (
        device_array([1.0, np.nan, 1.0], float, device),
        device_array([[1.0], [np.nan], [1.0]], float, device),
    )
    still, success, fell = (device_array([1, 1, 1], int, device) for _ in range(3))
    outputs = [reward, terms, still, success, fell]
    wp.launch(void_step_kernel, dim=3, inputs=[failed], outputs=outputs, device=device)
    for array in outputs:
        np.testing.assert_array_equal(array.numpy().ravel(), [1, 0, 1])


@EXAMPLES
@given(seed=st.integers(0, 2**31), worlds=st.integers(1, 6))
def test_redraw_waits_for_a_reset_of_old_dynamics(device, seed, worlds):
    random = np.random.default_rng(seed)
    reset, age = random.integers(0, 2, worlds), random.integers(0, 20, worlds)
    ages, mask = device_array(age, int, device), device_array(np.full(worlds, SENTINEL), int, device)
    wp.launch(
        redraw_mask_kernel,
        dim=worlds,
        inputs=[device_array(reset, int, device), 10, ages],
        outputs=[mask],
        device=device,
    )
    due = (reset == 1) & (age + 1 >= 10)
    np.testing.assert_array_equal(mask.numpy(), due.astype(int))
    np.testing.assert_array_equal(ages.numpy(), np.where(due, 0, age + 1))


@EXAMPLES
@given(seed=st.integers(0, 2**31), worlds=st.integers(1, 4))
def test_friction_of_a_pair_is_the_average(device, seed, worlds):
    random = np.random.default_rng(seed)
    shapes = 12
    world, kind = random.integers(-1, worlds, shapes), random.integers(0, 4, shapes)
    nominal = random.uniform(0.5, 1.5, shapes).astype(np.float32)
    hand, item, table = random.uniform(0.05, 1.6, (3, worlds)).astype(np.float32)
    before = random.uniform(size=shapes).astype(np.float32)
    expected = before.copy()
    for s in range(shapes):
        w = world[s]
        if w < 0:
            continue
        if kind[s] == 2:
            expected[s] = item[w]
        elif kind[s] == 1:
            expected[s] = 0.5 * (table[w] + item[w])
        elif kind[s] == 3:
            expected[s] = 0.5 * (hand[w] * nominal[s] / FRICTION + item[w])
    out = device_array(before, float, device)
    wp.launch(
        write_friction_kernel,
        dim=shapes,
        inputs=[
            device_array(world, int, device),
            device_array(kind, int, device),
            device_array(nominal, float, device),
            FRICTION,
            1,
            2,
            3,
            device_array(hand, float, device),
            device_array(item, float, device),
            device_array(table, float, device),
        ],
        outputs=[out],
        device=device,
    )
    np.testing.assert_allclose(out.numpy(), expected, rtol=1e-5)


def test_gains_force_pose_masks_and_counts_go_where_they_belong(device):
    random = np.random.default_rng(0)
    worlds, joints = 4, 3
    kp, kd = random.uniform(size=(2, worlds, joints)).astype(np.float32)
    model_kp, model_kd = (device_array(np.full((worlds, joints + 6), np.nan), float, device) for _ in "pd")
    wp.launch(
        write_gains_kernel,
        dim=(worlds, joints),
        inputs=[device_array(kp, float, device), device_array(kd, float, device)],
        outputs=[model_kp, model_kd],
        device=device,
    )
    np.testing.assert_array_equal(model_kp.numpy()[:, :joints], kp)
    np.testing.assert_array_equal(model_kd.numpy()[:, :joints], kd)
    assert np.isnan(model_kp.numpy()[:, joints:]).all(), "the object's free joint has no gains"

    force = random.normal(size=(worlds, 3)).astype(np.float32)
    mass, lightened = random.uniform(0.05, 0.2, worlds).astype(np.float32), np.array([0, 1, 1, 0])
    body_force = wp.zeros((worlds, 5), dtype=wp.spatial_vector, device=device)
    wp.launch(
        write_object_force_kernel,
        dim=worlds,
        inputs=[
            device_array(mass, float, device),
            device_array(lightened, int, device),
            wp.vec3(0.5, 0.0, -9.81),
            device_array(np.array([0.3]), float, device),
            4,
            device_array(force, wp.vec3, device),
        ],
        outputs=[body_force],
        device=device,
    )
    carried = force - 0.7 * (lightened * mass)[:, None] * np.array([0.5, 0.0, -9.81])
    np.testing.assert_allclose(body_force.numpy()[:, 4, :3], carried, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(body_force.numpy()[lightened == 0, 4, :3], force[lightened == 0])
    assert not body_force.numpy()[:, :4].any() and not body_force.numpy()[:, 4, 3:].any()

    q = random.normal(size=(worlds, joints + 7)).astype(np.float32)
    pose = device_array(np.full((worlds, 7), np.nan), wp.transform, device)
    wp.launch(
        record_step_kernel,
        dim=worlds,
        inputs=[device_array(q, float, device), joints],
        outputs=[pose],
        device=device,
    )
    np.testing.assert_array_equal(pose.numpy(), q[:, joints:])

    mask = wp.zeros(worlds + 1, dtype=wp.bool, device=device)
    flags = np.array([0, 1, 1, 0])
    wp.launch(
        world_mask_kernel,
        dim=worlds,
        inputs=[device_array(flags, int, device)],
        outputs=[mask],
        device=device,
    )
    np.testing.assert_array_equal(mask.numpy(), [False, True, True, False, False])

    counts = device_array(np.array([1.0, 2.0, 3.0]), float, device)
    success, fell, done = np.array([1, 0, 0, 1]), np.array([0, 1, 0, 0]), np.array([1, 1, 1, 1])
    wp.launch(
        count_goals_kernel,
        dim=worlds,
        inputs=[device_array(a, int, device) for a in (success, fell, done)],
        outputs=[counts],
        device=device,
    )
    np.testing.assert_array_equal(counts.numpy(), [5.0, 4.0, 4.0])


def test_the_first_columns_are_copied(device):
    wide = np.random.default_rng(0).normal(size=(3, 7)).astype(np.float32)
    narrow = unwritten((3, 4), float, device)
    wp.launch(
        copy_columns_kernel,
        dim=(3, 4),
        inputs=[device_array(wide, float, device)],
        outputs=[narrow],
        device=device,
    )
    np.testing.assert_array_equal(narrow.numpy(), wide[:, :4])


@EXAMPLES
@given(seed=st.integers(0, 2**31), worlds=st.integers(1, 5))
def test_tables_are_away_from_their_last_step_on(device, seed, worlds):
    random = np.random.default_rng(seed)
    kind, count = random.integers(0, 4, (worlds, 6)), random.integers(0, 5, worlds)
    last, position = random.integers(0, 5, worlds), random.normal(size=(worlds, 6, 3)).astype(np.float32)
    expected = position.copy()
    for w, g in np.argwhere(kind == 3):
        expected[w, g, 2] = 0.25 if count[w] < last[w] else -7.0
    out = device_array(position, wp.vec3, device)
    wp.launch(
        place_table_kernel,
        dim=(worlds, 6),
        inputs=[
            device_array(kind, int, device),
            3,
            device_array(count, int, device),
            device_array(last, int, device),
            0.25,
            -7.0,
        ],
        outputs=[out],
        device=device,
    )
    assert np.array_equal(out.numpy(), expected)
