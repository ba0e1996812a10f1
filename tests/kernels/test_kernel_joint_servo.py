"""Commands in transit, measured positions and limits of the simulator's servo, against NumPy."""

import numpy as np
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, device_array, floats, launch, streams, unwritten

from vd.kernels.servo import actuators as servo
from vd.kernels.servo.effects import neutral_row
from vd.kernels.servo.joint_servo import (
    drive_joint_kernel,
    finish_joint_kernel,
    measure_joint_kernel,
    receive_command_kernel,
    send_command_kernel,
    vec10,
)

DT = 1.0 / 120.0
SUBSTEPS = 4
CONTROL_DT = SUBSTEPS * DT


def hundredths(low: int, high: int) -> st.SearchStrategy[float]:
    """Numbers from ``low`` to ``high`` hundredths."""
    return st.integers(low, high).map(lambda value: value / 100.0)


def parameter_rows(count: int, **columns: object) -> np.ndarray:
    """Neutral rows with columns, by the names of their constants, set."""
    rows = np.tile(neutral_row(), (count, 1))
    for name, value in columns.items():
        rows[:, getattr(servo, name)] = value
    return rows


def mean_of_delayed(commands: np.ndarray, start: float, delay: float, step: int) -> float:
    """Mean over physics step ``step`` of commands that hold from k CONTROL_DT + DT / 2 + delay on.

    Integrated on a grid a thousand times finer.
    """
    times = (step + (np.arange(1000) + 0.5) / 1000.0) * DT
    index = np.floor((times - 0.5 * DT - delay) / CONTROL_DT + 1e-9).astype(int)
    return float(np.where(index < 0, start, commands[np.clip(index, 0, len(commands) - 1)]).mean())


@EXAMPLES
@given(commands=floats((6,)), start=hundredths(-200, 200), delay=hundredths(0, 15))
def test_commands_arrive_after_their_delay(device, commands, start, delay):
    joints, capacity = 2, 8
    rows = device_array(parameter_rows(joints, COMMAND_DELAY=[0.0, delay]), float, device)
    state = device_array(np.zeros((joints, servo.STATE_COLUMNS)), float, device)
    head, count = (wp.zeros((1, joints), dtype=wp.int32, device=device) for _ in range(2))
    value, time = (unwritten((1, joints, capacity), float, device) for _ in range(2))
    held = device_array(np.full((1, joints), start), float, device)
    rng = streams(1, 0, device)
    transit = [head, count, value, time]
    for control, command in enumerate(commands):
        both = device_array([[command, command]], float, device)
        launch(send_command_kernel, 1, [rows, DT, both, state, rng, *transit], device)
        for k in range(SUBSTEPS):
            inputs = [rows, DT, state, *transit, held]
            (reference,) = launch(receive_command_kernel, (1, joints), inputs, device, (1, joints))
            step = control * SUBSTEPS + k
            expected = [mean_of_delayed(commands, start, d, step) for d in (0.0, delay)]
            # The grid resolves a thousandth of a step; commands jump by 4 at most.
            assert np.allclose(reference[0], expected, atol=0.02)
            clock = state.numpy()
            clock[:, servo.STATE_TIME] += DT
            state.assign(clock)


def test_jitter_delays_in_order_and_drops_its_share(device):
    worlds, sends = 4000, 3
    rows = device_array(parameter_rows(worlds, JITTER_SIGMA=0.05, JITTER_DROP=0.25), float, device)
    state = device_array(np.zeros((worlds, servo.STATE_COLUMNS)), float, device)
    head, count = (wp.zeros((worlds, 1), dtype=wp.int32, device=device) for _ in range(2))
    value, time = (unwritten((worlds, 1, 4), float, device) for _ in range(2))
    rng = streams(worlds, 1, device)
    command = wp.zeros((worlds, 1), dtype=float, device=device)
    for _ in range(sends):
        inputs = [rows, DT, command, state, rng, head, count, value, time]
        launch(send_command_kernel, worlds, [*inputs], device)
    kept = count.numpy()[:, 0]
    # Six standard deviations of a binomial mean.
    assert abs(kept.mean() / sends - 0.75) < 6.0 * np.sqrt(0.75 * 0.25 / (worlds * sends))
    arrivals = time.numpy()[:, 0]
    first = arrivals[kept > 0, 0] - 0.5 * DT
    assert first.min() >= 0.0
    # The mean of |N(0, sigma)| is sigma sqrt(2 / pi).
    assert abs(first.mean() - 0.05 * np.sqrt(2.0 / np.pi)) < 6.0 * 0.05 / np.sqrt(worlds)
    all_kept = arrivals[kept == sends][:, :sends]
    assert np.all(np.diff(all_kept, axis=1) >= 0.0)


@EXAMPLES
@given(
    positions=floats((12,)),
    delay=hundredths(0, 6),
    bias=hundredths(-50, 50),
    limit=hundredths(50, 5000),
)
def test_what_is_measured_is_old_limited_and_biased(device, positions, delay, bias, limit):
    rows = device_array(
        parameter_rows(1, READ_DELAY=delay, ENCODER_BIAS=bias, VELOCITY_LIMIT=limit), float, device
    )
    index = wp.zeros((1, 1), dtype=wp.int32, device=device)
    history, speed_history = (device_array(np.zeros((1, 1, 10)), float, device) for _ in range(2))
    past, past_speed, before = [0.0] * 12, [0.0] * 12, 0.0
    for position in positions:
        speed = (position - before) / DT
        allowed = float(np.clip(speed, -limit, limit))
        after = position if abs(speed) <= limit else before + allowed * DT
        q, qd = device_array([[position]], float, device), device_array([[speed]], float, device)
        inputs = [rows, DT, [[before]], q, qd, index, history, speed_history]
        launch(finish_joint_kernel, (1, 1), inputs, device)
        assert np.allclose(qd.numpy(), allowed, rtol=1e-4, atol=1e-4)
        assert np.allclose(q.numpy(), after, atol=1e-4)
        before = float(q.numpy()[0, 0])
        past.append(before)
        past_speed.append(float(qd.numpy()[0, 0]))
        inputs = [rows, DT, index, history, speed_history]
        measured, measured_speed = launch(
            measure_joint_kernel, (1, 1), inputs, device, (1, 1), (1, 1)
        )
        when = np.arange(-len(past) + 1, 1) * DT
        assert np.allclose(measured, np.interp(-delay, when, past) + bias, atol=1e-3)
        assert np.allclose(measured_speed, np.interp(-delay, when, past_speed), atol=1e-2)


@EXAMPLES
@given(kp=floats((2, 3), 0.5, 5.0), kd=floats((2, 3), 0.0, 0.5))
def test_gains_reach_the_actuators_of_their_joints_and_nothing_beyond(device, kp, kd):
    """Of three joints the second follows another one, and has none; a third world is not there."""
    worlds, joints = kp.shape
    rows = parameter_rows(worlds * joints, KP=kp.ravel(), KD=kd.ravel())
    nothing = np.zeros((worlds, joints))
    everything = np.ones((worlds, joints))
    model = [rows, [0, 0, 0], everything, everything, [0, -1, 1]]
    motion = [DT, nothing, everything, nothing, nothing]
    state = np.zeros((worlds * joints, servo.STATE_COLUMNS))
    gain, bias = (unwritten((worlds + 1, 2), vec10, device) for _ in range(2))
    outputs = [nothing, nothing, gain[:worlds], bias[:worlds]]
    launch(
        drive_joint_kernel,
        (worlds, joints),
        [*model, *motion, state, *outputs],
        device,
        *[(worlds, joints)] * 3,
    )
    expected = np.full((2, worlds + 1, 2, 10), np.nan)
    expected[0, :worlds, :, 0] = kp[:, [0, 2]]
    expected[1, :worlds, :, 1] = -kp[:, [0, 2]]
    # Half of a damping that is small for the step is implicit, which is of second order.
    expected[1, :worlds, :, 2] = -0.5 * kd[:, [0, 2]]
    np.testing.assert_allclose([gain.numpy(), bias.numpy()], expected, rtol=1e-5, atol=1e-6)
