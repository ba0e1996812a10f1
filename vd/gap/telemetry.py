"""What recorded voltage and duty cycle contradict.

The voltage that a sagging supply needs is there to be seen. And the duty cycle of a position servo
is its controller's output: where it follows the plain error at the recorded gain, nothing upstream
of it (a delay, a filter, a dead zone, integral action) is at work.
"""

import numpy as np

from vd.gap.chain import Chain
from vd.gap.explanation import CLOSE
from vd.gap.recording import Recording, Trajectory
from vd.gap.recording_checks import MIN_SAMPLES
from vd.gap.rollout import STEP_S
from vd.gap.worker_pool import JointSpec
from vd.kernels.servo.effects import EFFECTS

LINEAR = 0.995
"""Share of the duty cycle's variance that the plain error must explain for it to be linear. Not
tuned.
"""
UPSTREAM = (
    "command_delay",
    "read_delay",
    "command_filter",
    "command_jitter",
    "acceleration_limit",
    "dead_zone",
    "integral_action",
    "backlash",
)
"""Effects between command and controller output, each of which the duty cycle shows. Backlash is
that of the reference, as the servo model has it, not play behind the motor."""
BEHIND_SENSOR = {
    "supply_sag": "only as a resistance behind the voltage sensor, which loses torque like a sagging supply"
}
"""Effects whose cause telemetry contradicts, but not a loss of the same form where it has no
sensor.
"""
CLEARER = 4.0
"""How many times more of the duty cycle the wrong delay must leave than the right one: a read delay
leaves 0.5 % on either side. Not tuned."""


def vetoes(recording: Recording, chain: Chain, spec: JointSpec) -> dict[str, str]:
    """Effects of a joint that telemetry contradicts, with the reason.

    Args:
        recording: The recording.
        chain: The joint's chain.
        spec: The joint's problem.
    """
    parts = [recording.trajectories[i] for i in spec.trajectories]
    driven = [t for t in parts if chain.joints[spec.joint] in t.joints]
    steady = _steady_voltage(driven, int(chain.columns[spec.joint]))
    result = {"supply_sag": steady} if steady else {}
    share = _follows(driven, chain, spec.joint)
    if late := late_side(recording, chain, spec):
        reason = f"the recorded duty cycle follows the error with a {late.replace('_', ' ')} alone"
    elif share >= LINEAR:
        told = f"{100.0 * share:.1f} % of it"
        reason = f"the recorded duty cycle follows the plain error ({told}): it acts downstream"
    else:
        return result
    return result | {name: reason for name in UPSTREAM if name != late}


def late_side(recording: Recording, chain: Chain, spec: JointSpec) -> str:
    """Which of command and reading is late, if the recorded duty cycle says so.

    Positions alone cannot tell (:data:`vd.kernels.servo.effects.EQUIVALENT`). The duty cycle
    follows the late command less the position there is, or the command there is less the position
    that is reported later.

    Returns:
        ``command_delay``, ``read_delay``, or nothing where neither fits, both do, or no duty is
        recorded.
    """
    parts = [recording.trajectories[i] for i in spec.trajectories]
    (delay,) = EFFECTS["command_delay"].parameters
    lags = np.arange(0.0, delay.upper, STEP_S)
    left = {
        side: [1.0 - _follows(parts, chain, spec.joint, **{side: lag}) for lag in lags]
        for side in ("command_delay", "read_delay")
    }
    side, other = sorted(left, key=lambda each: min(left[each]))
    lag = lags[np.argmin(left[side])]
    # Registers read one after the other are less than a sample apart: that is nobody's delay.
    sample = float(np.median(np.concatenate([np.diff(t.time) for t in parts])))
    clear = min(left[side]) < 1.0 - LINEAR and CLEARER * min(left[side]) < min(left[other])
    return side if lag >= sample and clear else ""


def _told(values: np.ndarray | None, column: int) -> bool:
    """Whether a channel is recorded for a joint."""
    return values is not None and bool(np.isfinite(values[:, column]).all())


def _follows(
    trajectories: list[Trajectory],
    chain: Chain,
    joint: int,
    command_delay: float = 0.0,
    read_delay: float = 0.0,
) -> float:
    """Share of a joint's duty cycle that follows the error if command or reading is that late [s]."""
    pairs, column, reference = [np.zeros((2, 0))], chain.columns[joint], chain.reference_p_gain
    for t in trajectories:
        if t.pwm is not None and _told(t.pwm, column):
            duty = t.pwm[:, column]
            sent = np.maximum(np.searchsorted(t.sent, t.time - command_delay, side="right") - 1, 0)
            position = np.interp(t.time + read_delay, t.time, t.position[:, column])
            gain = float(t.conditions.get("p_gain", reference)) / reference if reference else 1.0
            used = t.enabled[:, column] & (np.abs(duty) < 1.0)
            pairs.append(np.array([gain * (t.command[sent, column] - position), duty])[:, used])
    error, duty = np.concatenate(pairs, axis=1)
    if len(error) < MIN_SAMPLES:
        return 0.0
    slope = float(error @ duty) / max(float(error @ error), 1e-300)
    return 1.0 - float(np.sum((duty - slope * error) ** 2)) / max(float(duty @ duty), 1e-300)


def _steady_voltage(trajectories: list[Trajectory], column: int) -> str:
    """Why the voltage speaks against a sagging supply, or nothing."""
    pairs = [np.zeros((2, 0))]
    for t in trajectories:
        if t.voltage is not None and _told(t.voltage, column):
            pull = t.pwm if t.pwm is not None and _told(t.pwm, column) else t.command - t.position
            on = t.enabled[:, column]
            pairs.append(np.array([np.abs(pull[on, column]), t.voltage[on, column]]))
    pull, volt = np.concatenate(pairs, axis=1)
    if len(volt) < MIN_SAMPLES:
        return ""
    slope, idle = np.polyfit(pull, volt, 1)
    fall = max(-slope * float(np.percentile(pull, 99.0)), 0.0)
    if fall >= CLOSE * idle:
        return ""
    return f"the recorded voltage falls by {fall:.2f} V of {idle:.1f} V at full pull, too little for sag"
