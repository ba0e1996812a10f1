import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import (
    ALPHA,
    EXAMPLES,
    SENTINEL,
    device_array,
    floats,
    indices,
    launch,
    streams,
    unwritten,
)
from scipy import stats

from vd.kernels.task.reached_starts import (
    choose_kept_kernel,
    choose_start_kernel,
    keep_rows_kernel,
    put_rows_kernel,
)

JOINTS, SLOTS, COLUMNS = 9, 4, 3
SPEED, SPIN, FORCE = 0.1, 2.0, 0.2
ALWAYS = 1.0


@EXAMPLES
@given(data=st.data(), worlds=st.integers(1, 12))
def test_states_off_a_table_that_is_there_and_slow_go_to_the_oldest_slot(device, data, worlds):
    flags = indices((4, worlds), 2)
    ended, failed, late, touching = data.draw(flags)
    velocity = data.draw(floats((worlds, JOINTS + 6), -1.5, 1.5))
    velocity[:, JOINTS : JOINTS + 3] *= 0.05
    steps = data.draw(indices(worlds, 50))
    table_steps = steps - late
    pressed = np.where(touching, FORCE + 0.1, FORCE - 0.1).astype(np.float32)
    before = data.draw(indices(worlds, 3 * SLOTS))
    count = device_array(before, int, device)
    settings = [ALWAYS, SPEED, SPIN, FORCE, JOINTS]
    seen = [ended, steps, table_steps, pressed, failed, velocity]
    arguments = [*settings, *seen, SLOTS, count, streams(worlds, 3, device)]
    (slot,) = launch(choose_kept_kernel, worlds, arguments, device, worlds)

    exact = velocity.astype(float)
    slow = np.linalg.norm(exact[:, JOINTS : JOINTS + 3], axis=1) <= SPEED
    calm = np.linalg.norm(exact[:, JOINTS + 3 :], axis=1) <= SPIN
    held = slow & calm & (ended == 0) & (failed == 0) & (late == 0) & (touching == 0)
    np.testing.assert_array_equal(slot, np.where(held, before % SLOTS, -1))
    np.testing.assert_array_equal(count.numpy(), before + held)


@EXAMPLES
@given(data=st.data(), worlds=st.integers(1, 5))
def test_rows_are_copied_bit_by_bit_in_the_chosen_worlds_alone(device, data, worlds):
    slot = data.draw(indices(worlds, SLOTS + 1)) - 1
    rows = data.draw(floats((worlds, COLUMNS)))
    rows[:, 0] = np.nan
    rows = rows.view(np.int32)
    (kept,) = launch(keep_rows_kernel, rows.shape, [slot, rows], device, (worlds, SLOTS, COLUMNS))
    wanted = np.full((worlds, SLOTS, COLUMNS), SENTINEL)
    for world in np.flatnonzero(slot >= 0):
        wanted[world, slot[world]] = rows[world]
    np.testing.assert_array_equal(kept, wanted)

    present = unwritten(rows.shape, int, device)
    launch(put_rows_kernel, rows.shape, [slot, kept, present], device)
    chosen = (slot >= 0)[:, None]
    np.testing.assert_array_equal(present.numpy(), np.where(chosen, rows, SENTINEL))


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_share_of_the_states_is_kept_and_of_the_episodes_begins_in_one(device, share):
    worlds = 20_000
    still = np.zeros((worlds, JOINTS + 6), np.float32)
    nothing = np.zeros(worlds, np.int32)
    rng = streams(worlds, 5, device)
    drawn = rng.numpy().copy()
    count = device_array(nothing, int, device)
    seen = [nothing, nothing, nothing, nothing.astype(np.float32), nothing, still]
    arguments = [share, SPEED, SPIN, FORCE, JOINTS, *seen, SLOTS, count, rng]
    (slot,) = launch(choose_kept_kernel, worlds, arguments, device, worlds)
    assert (rng.numpy() != drawn).mean() > 0.99
    assert stats.binomtest(int((slot == 0).sum()), worlds, share).pvalue > ALPHA

    ended = (np.arange(worlds) % 4 > 0).astype(np.int32)
    known = np.arange(worlds) % 7  # more than there are slots, too
    goal = unwritten(worlds, int, device)
    steps = unwritten(worlds, int, device)
    drawn = rng.numpy().copy()
    arguments = [share, SLOTS, ended, known, goal, steps, rng]
    slot, reset = launch(choose_start_kernel, worlds, arguments, device, worlds, worlds)
    begun = slot >= 0
    assert not begun[(ended == 0) | (known == 0)].any()
    able = (ended == 1) & (known > 0)
    assert stats.binomtest(int(begun.sum()), int(able.sum()), share).pvalue > ALPHA
    np.testing.assert_array_equal(reset, ended & ~begun)
    np.testing.assert_array_equal(goal.numpy(), np.where(begun, 1, SENTINEL))
    np.testing.assert_array_equal(steps.numpy(), np.where(begun, 0, SENTINEL))
    np.testing.assert_array_equal(rng.numpy()[ended == 0], drawn[ended == 0])
    for number in range(1, 7):
        there = min(number, SLOTS)
        chosen = slot[begun & (known == number)]
        assert (chosen < there).all()
        if there > 1 and len(chosen):
            counts = np.bincount(chosen, minlength=there)
            assert stats.chisquare(counts).pvalue > ALPHA
