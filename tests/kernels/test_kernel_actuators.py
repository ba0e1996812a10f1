"""Each stage of the servo against closed forms; each effect off is the plain model, bit for bit."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, launch

from vd.kernels.servo import actuators as servo
from vd.kernels.servo.effects import BASELINE, EFFECTS, neutral_row

DT = 1 / 480
SWITCHES = {
    "torque_speed_limit": servo.STALL_TORQUE,
    "elastic_transmission": servo.ELASTIC_STIFFNESS,
    "gravity_load": servo.GRAVITY_TORQUE,
    "stribeck_friction": None,
}
"""The parameter that turns an effect of several off at zero; None: all but its neutral scale."""

floats = st.floats


@wp.kernel
def step_kernel(
    command: wp.array2d[float],
    position: wp.array[float],
    speed: wp.array[float],
    power: wp.array[float],
    steps: int,
    dt: float,
    parameters: wp.array2d[float],
    state: wp.array2d[float],
    out: wp.array3d[float],
):
    """Steps of servos whose joints do not move. Launch: [R].

    Command [R, steps], out [R, steps, 5].
    """
    row = wp.tid()
    servo.start_servo(command[row, 0], position[row], row, state)
    for k in range(steps):
        reference = servo.shape_command(command[row, k], dt, parameters, row, state)
        drive = servo.drive_joint(
            reference,
            reference,
            0.0,
            position[row],
            speed[row],
            power[row],
            dt,
            servo.NO_EFFORT_LIMIT,
            parameters,
            row,
            state,
        )
        out[row, k, 0] = drive.reference
        out[row, k, 1] = drive.stiffness
        out[row, k, 2] = drive.damping
        out[row, k, 3] = drive.torque
        out[row, k, 4] = drive.friction


REFERENCE, STIFFNESS, DAMPING, TORQUE, FRICTION = range(5)


def steps_of(device, rows, command, position=0.0, speed=0.0, *, power=1.0):
    """Run the servos of rows [R, P] through commands [T] or [R, T]: out [R, T, 5]."""
    rows = np.atleast_2d(rows)
    count = len(rows)
    command = np.broadcast_to(np.atleast_1d(command), (count, np.shape(np.atleast_1d(command))[-1]))
    inputs = [
        command,
        *(np.broadcast_to(v, count) for v in (position, speed, power)),
        command.shape[1],
        DT,
    ]
    shapes = [(count, servo.STATE_COLUMNS), (count, command.shape[1], 5)]
    state, out = launch(step_kernel, count, [*inputs, rows], device, *shapes)
    assert np.isfinite(out).all() and np.isfinite(state).all(), "not written, or no number"
    return out


def row_of(kp=3.0, kd=0.3, **settings):
    """A parameter row; settings by the names of the columns."""
    row = np.array(neutral_row())
    row[servo.KP], row[servo.KD] = kp, kd
    for name, value in settings.items():
        row[getattr(servo, name)] = value
    return row


@EXAMPLES
@given(
    numbers=st.tuples(*[floats(-2, 2, width=32)] * 3),
    kp=floats(0.0078125, 100.0, width=32),
    kd=floats(0.0, 10.0, width=32),
    power=st.sampled_from([0.0, 0.25, 1.0]),
)
def test_with_every_effect_off_it_is_the_plain_servo_bit_for_bit(device, numbers, kp, kd, power):
    command, position, speed = numbers
    out = steps_of(device, row_of(kp, kd), [command], position, speed, power=power)
    expected = [command, np.float32(power) * np.float32(kp), kd if power > 0.0 else 0.0, 0.0, 0.0]
    np.testing.assert_array_equal(out[0, 0], np.array(expected, np.float32))


@pytest.mark.parametrize("effect", EFFECTS)
def test_an_effect_at_neutral_changes_no_bit(device, effect):
    """The effect's other parameters may have any value when the one that turns it off is neutral."""
    rng = np.random.default_rng(1)
    rows = np.tile(row_of(), (50, 1))
    switch = SWITCHES.get(effect)
    if switch is not None:
        for parameter in EFFECTS[effect].parameters:
            if parameter.column != switch:
                rows[:, parameter.column] = rng.uniform(parameter.lower, parameter.upper, 50)
    if effect == "stribeck_friction":
        rows[:, servo.STRIBECK_SPEED] = rng.uniform(0.01, 10.0, 50)
    command = rng.uniform(-1, 1, (50, 20))
    position, speed = rng.uniform(-1, 1, 50), rng.uniform(-5, 5, 50)
    plain = steps_of(device, np.tile(row_of(), (50, 1)), command, position, speed)
    out = steps_of(device, rows, command, position, speed)
    np.testing.assert_array_equal(out, plain)


def test_the_table_names_every_column_once():
    parameters = [*BASELINE, *(p for effect in EFFECTS.values() for p in effect.parameters)]
    assert sorted(p.column for p in parameters) == list(range(servo.PARAMETER_COLUMNS))
    for p in parameters:
        assert p.lower <= p.typical <= p.upper, p
        assert p.neutral >= 0.0, p
