"""What recorded voltage and duty cycle contradict.

The voltage that a sagging supply needs is there to be seen. And the duty cycle of a position servo is
its controller's output: where it follows the plain error at the recorded gain, nothing upstream of it
(a delay, a filter, a dead zone, integral action) is at work.
"""

import numpy as np

import vd.kernels.servo.actuators as servo
from vd.gap.chain import Chain
from vd.gap.recording import Recording, Trajectory
from vd.gap.worker_pool import JointSpec

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
LAGS_S = np.arange(0.0, 0.3, 2.5e-3)
"""Lags that are tried [s]: up to the longest delay searched, as fine as the duty cycle tells."""
CLEARER = 4.0
"""How many times more of the duty cycle the wrong delay must leave than the right one."""
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
    reason, late = _plain_duty(recording, chain, spec, trajectories, rows[spec.joint])
    if reason:
        others = (name for name in (*UPSTREAM, REFERENCE_SIDE) if name != late)
        result.update(dict.fromkeys(others, reason))
    return result


def late_side(recording: Recording, chain: Chain, spec: JointSpec) -> str:
    """Which of command and reading is late, if the recorded duty cycle says so.

    Positions alone cannot tell (:data:`vd.kernels.servo.effects.EQUIVALENT`). The duty cycle follows the late
    command less the position there is, or the command there is less the position that is reported later.

    Returns:
        ``command_delay``, ``read_delay``, or nothing where neither fits, both do, or no duty is recorded.
    """
    column = int(chain.columns[spec.joint])
    trajectories = [recording.trajectories[i] for i in spec.trajectories]
    left, side, lag = min(
        (1.0 - _follows(trajectories, column, chain.reference_p_gain, **{side: lag}), side, lag)
        for side in ("command_delay", "read_delay")
        for lag in LAGS_S
    )
    other = "read_delay" if side == "command_delay" else "command_delay"
    rest = 1.0 - max(_follows(trajectories, column, chain.reference_p_gain, **{other: lag}) for lag in LAGS_S)
    # Registers read one after the other are less than a sample apart: that is nobody's delay.
    sample = float(np.median(np.concatenate([np.diff(t.time) for t in trajectories])))
    return side if lag >= sample and left < 1.0 - LINEAR and CLEARER * left < rest else ""


def _follows(
    trajectories: list[Trajectory],
    column: int,
    reference_gain: float | None,
    command_delay: float = 0.0,
    read_delay: float = 0.0,
) -> float:
    """Share of the duty cycle that follows the error if command or reading is that late [s]."""
    errors, duties = [], []
    for t in trajectories:
        if t.pwm is None or not np.isfinite(t.pwm[:, column]).all():
            continue
        sent = np.maximum(np.searchsorted(t.sent, t.time - command_delay, side="right") - 1, 0)
        position = np.interp(t.time + read_delay, t.time, t.position[:, column])
        gain = float(t.conditions.get("p_gain", reference_gain)) / reference_gain if reference_gain else 1.0
        used = t.enabled[:, column] & (np.abs(t.pwm[:, column]) < SATURATED)
        errors.append(gain * (t.command[sent, column] - position)[used])
        duties.append(t.pwm[used, column])
    if sum(map(len, errors)) < MIN_SAMPLES:
        return 0.0
    error, duty = np.concatenate(errors), np.concatenate(duties)
    slope = float(error @ duty) / max(float(error @ error), 1e-300)
    return 1.0 - float(np.sum((duty - slope * error) ** 2)) / max(float(duty @ duty), 1e-300)


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
    recording: Recording, chain: Chain, spec: JointSpec, trajectories: list[Trajectory], row: np.ndarray
) -> tuple[str, str]:
    """Why the duty cycle speaks against anything between command and controller, and but for which delay."""
    if row[servo.KP] <= 0.0:
        return "", ""
    late = late_side(recording, chain, spec)
    if late:
        return f"the recorded duty cycle follows the error with a {late.replace('_', ' ')} alone", late
    share = _follows(trajectories, int(chain.columns[spec.joint]), chain.reference_p_gain)
    if share < LINEAR:
        return "", ""
    text = f"the recorded duty cycle follows the plain error ({100.0 * share:.1f} % of it)"
    return f"{text}: it acts downstream", ""
