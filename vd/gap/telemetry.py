"""What recorded voltage and duty cycle contradict.

The voltage that a sagging supply needs is there to be seen. And the duty cycle of a position servo is
its controller's output: where it follows the plain error at the recorded gain, nothing upstream of it
(a delay, a filter, a dead zone, integral action) is at work.
"""

import numpy as np

import vd.kernels.actuators as servo
from vd.gap.recording import Recording, Trajectory
from vd.gap.rollout import Chain
from vd.gap.team import JointSpec

LINEAR = 0.995
"""Share of the duty cycle's variance that plain error and speed must explain for it to be linear."""
MIN_SAMPLES = 100
SATURATED = 0.95
"""Duty cycles above this are limited."""
SAG_NEEDED = 0.1
"""Share of the supply by which the voltage must fall for sag to matter: it takes that much torque."""
UPSTREAM = (
    "command_delay",
    "read_delay",
    "command_filter",
    "command_jitter",
    "acceleration_limit",
    "dead_zone",
    "integral_action",
)
"""Effects between command and controller output; the duty cycle shows each of them."""
BEHIND_SENSOR = {
    "supply_sag": "only as a resistance behind the voltage sensor, which loses torque like a sagging supply"
}
"""Effects whose cause telemetry contradicts, but not a loss of the same form where it has no sensor."""
REFERENCE_SIDE = "backlash"
"""Play of the reference, as the servo model has it; play behind the motor does not show."""


def vetoes(recording: Recording, chain: Chain, spec: JointSpec, rows: np.ndarray) -> dict[str, str]:
    """Effects of a joint that telemetry contradicts, with the reason.

    Args:
        recording: The recording.
        chain: The joint's chain.
        spec: The joint's problem.
        rows: Baseline rows of the chain [n, PARAMETER_COLUMNS].
    """
    column = int(chain.columns[spec.joint])
    trajectories = [recording.trajectories[i] for i in spec.trajectories]
    trajectories = [t for t in trajectories if chain.joints[spec.joint] in t.joints]
    result = {}
    reason = _steady_voltage(trajectories, column)
    if reason:
        result["supply_sag"] = reason
    reason = _plain_duty(trajectories, column, chain.reference_p_gain, rows[spec.joint])
    if reason:
        result.update(dict.fromkeys((*UPSTREAM, REFERENCE_SIDE), reason))
    return result


def _steady_voltage(trajectories: list[Trajectory], column: int) -> str:
    """Why the voltage speaks against a sagging supply, or nothing."""
    volts, pulls = [], []
    for t in trajectories:
        if t.voltage is None or not np.isfinite(t.voltage[:, column]).all():
            continue
        on = t.enabled[:, column]
        duty = t.pwm is not None and np.isfinite(t.pwm[:, column]).all()
        pull = t.pwm if duty and t.pwm is not None else t.command - t.position
        volts.append(t.voltage[on, column])
        pulls.append(np.abs(pull[on, column]))
    if not volts or sum(map(len, volts)) < MIN_SAMPLES:
        return ""
    volt, pull = np.concatenate(volts), np.concatenate(pulls)
    slope, idle = np.polyfit(pull, volt, 1)
    fall = max(-slope * float(np.percentile(pull, 99.0)), 0.0)
    if fall >= SAG_NEEDED * idle:
        return ""
    return f"the recorded voltage falls by {fall:.2f} V of {idle:.1f} V at full pull, too little for sag"


def _plain_duty(
    trajectories: list[Trajectory], column: int, reference_gain: float | None, row: np.ndarray
) -> str:
    """Why the duty cycle speaks against anything between command and controller, or nothing."""
    errors, duties = [], []
    for t in trajectories:
        if t.pwm is None or not np.isfinite(t.pwm[:, column]).all():
            continue
        gain = float(t.conditions.get("p_gain", reference_gain)) / reference_gain if reference_gain else 1.0
        used = t.enabled[:, column] & (np.abs(t.pwm[:, column]) < SATURATED)
        errors.append(gain * (t.command - t.position)[:, column][used])
        duties.append(t.pwm[:, column][used])
    if not errors or sum(map(len, errors)) < MIN_SAMPLES:
        return ""
    error, duty = np.concatenate(errors), np.concatenate(duties)
    power = float(error @ error)
    if power <= 0.0 or row[servo.KP] <= 0.0:
        return ""
    slope = float(error @ duty) / power
    left = float(np.sum((duty - slope * error) ** 2)) / max(float(np.sum(duty**2)), 1e-300)
    if 1.0 - left < LINEAR:
        return ""
    share = 100.0 * (1.0 - left)
    return f"the recorded duty cycle follows the plain error ({share:.1f} % of it): it acts downstream"
