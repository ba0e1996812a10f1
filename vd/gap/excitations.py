"""Motions that excite one joint at a time: the paper's steps and sines, and a menu for what they leave open.

The paper commands steps and sines of 0.05 to 1.5 Hz, amplitudes in proportion to the joint limits.
Commands are in rad, times in seconds.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

RATE_HZ = 100.0
"""Rate at which commands are written."""
AMPLITUDE = 0.7
"""Largest command, as a share of half the joint's range: room for overshoot before the stops."""
REST_S = 0.5
"""Hold before a step, so that the onset is in the recording."""
STEPS: Mapping[str, tuple[float, ...]] = {
    "step_small": (0.12, -0.12),
    "step_medium": (0.4, -0.2),
    "step_large": (-0.9, 0.9),
}
"""Levels of the steps, held in turn, as shares of the amplitude."""
STEP_HOLD_S = 1.75
SINES: Mapping[float, float] = {0.05: 12.0, 0.2: 7.5, 0.5: 6.0, 1.0: 5.0, 1.5: 4.0}
"""Frequency [Hz] to duration [s]; the slowest covers one reversal."""
GAIN_LADDER = (1.0, 0.5, 0.25)
"""P gains of the ladder, as shares of the full gain."""
SECOND_PAYLOAD_KG = 0.05
"""A payload that a finger carries at its tip: two links' weight."""
RELEASE_S = 2.0
"""Time at which a torque release switches the servo off."""


@dataclass(frozen=True, eq=False)
class Excitation:
    """One motion to be recorded.

    Attributes:
        name: Kind of motion, the ``excitation`` of a recording.
        joints: The joints that it excites.
        time: Time stamps [T] [s].
        command: Commanded positions of all joints [T, J] [rad].
        conditions: What is varied on purpose.
        enabled: Torque on [T, J] bool.
    """

    name: str
    joints: tuple[str, ...]
    time: np.ndarray
    command: np.ndarray
    conditions: dict[str, float | str]
    enabled: np.ndarray

    @property
    def duration(self) -> float:
        """Length [s]."""
        return float(self.time[-1])


@dataclass(frozen=True, eq=False)
class JointRange:
    """What motions are scaled to.

    Attributes:
        joints: Names [J].
        lower: Lower limits [J] [rad].
        upper: Upper limits [J] [rad].
        p_gain: Full P gain of the servos as recordings name it; the ladder's top.
    """

    joints: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    p_gain: float = 1.0

    @property
    def centre(self) -> np.ndarray:
        """Where joints that are not excited hold, and motions start [J] [rad]."""
        return 0.5 * (self.lower + self.upper)

    @property
    def amplitude(self) -> np.ndarray:
        """Largest command about the centre [J] [rad]."""
        return 0.5 * AMPLITUDE * (self.upper - self.lower)


def sampled(duration: float) -> np.ndarray:
    """Regular stamps from 0 to ``duration`` [s]."""
    return np.arange(round(duration * RATE_HZ) + 1) / RATE_HZ


def excite(
    reach: JointRange,
    joint: int,
    name: str,
    time: np.ndarray,
    shape: np.ndarray,
    *,
    conditions: Mapping[str, float | str] | None = None,
    release_s: float | None = None,
) -> Excitation:
    """Move one joint by ``shape`` [T], in shares of its amplitude, while the others hold."""
    command = np.tile(reach.centre, (len(time), 1))
    command[:, joint] += reach.amplitude[joint] * shape
    enabled = np.ones(command.shape, dtype=bool)
    if release_s is not None:
        enabled[time >= release_s, joint] = False
    return Excitation(name, (reach.joints[joint],), time, command, dict(conditions or {}), enabled)


def staircase(levels: Sequence[float], hold: float) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and shape of ``levels`` held in turn for ``hold`` [s] each, after a rest at zero."""
    time = sampled(REST_S + hold * len(levels))
    steps = np.concatenate([[0.0], np.asarray(levels, dtype=float)])
    index = np.clip(np.floor((time - REST_S) / hold + 1e-9).astype(int) + 1, 0, len(levels))
    return time, steps[index]


def _triangle(time: np.ndarray, period: float) -> np.ndarray:
    phase = time / period
    return 4.0 * np.abs(phase - 0.25 - np.floor(phase - 0.25 + 0.5)) - 1.0


def steps_and_sines(reach: JointRange) -> list[Excitation]:
    """The paper's excitation: every joint in turn by steps and sines, the others holding."""
    motions = []
    for joint in range(len(reach.joints)):
        for name, levels in STEPS.items():
            motions.append(excite(reach, joint, name, *staircase(levels, STEP_HOLD_S)))
        for frequency, duration in SINES.items():
            time = sampled(duration)
            shape = np.sin(2.0 * np.pi * frequency * time)
            motions.append(excite(reach, joint, f"sine_{frequency:.2f}hz", time, shape))
    return motions


def slow_triangle(reach: JointRange) -> list[Excitation]:
    """A constant slow speed both ways: friction against its direction, play at its reversals."""
    time = sampled(20.0)
    shape = _triangle(time, 16.0)
    return [excite(reach, j, "slow_triangle", time, shape) for j in range(len(reach.joints))]


def gain_ladder(reach: JointRange) -> list[Excitation]:
    """The same steps and sine at falling P gains: what scales with the gain is the servo's."""
    motions = []
    sine = sampled(5.0)
    for joint in range(len(reach.joints)):
        for share in GAIN_LADDER:
            conditions = {"p_gain": share * reach.p_gain}
            time, shape = staircase(STEPS["step_medium"], STEP_HOLD_S)
            motions.append(excite(reach, joint, "ladder_step", time, shape, conditions=conditions))
            shape = np.sin(2.0 * np.pi * 0.4 * sine)
            motions.append(excite(reach, joint, "ladder_sine", sine, shape, conditions=conditions))
    return motions


def second_payload(reach: JointRange) -> list[Excitation]:
    """The same motion without and with a mass at the tip: what grows with the load."""
    time = sampled(8.0)
    shape = np.sin(2.0 * np.pi * 0.25 * time)
    return [
        excite(reach, joint, "payload_sine", time, shape, conditions={"payload_kg": mass})
        for joint in range(len(reach.joints))
        for mass in (0.0, SECOND_PAYLOAD_KG)
    ]


def torque_release(reach: JointRange) -> list[Excitation]:
    """Lift, then switch the torque off: what is left is gravity, friction and inertia."""
    time = sampled(5.0)
    shape = np.where(time < REST_S, 0.0, 0.8)
    return [
        excite(reach, j, "torque_release", time, shape, release_s=RELEASE_S) for j in range(len(reach.joints))
    ]


def long_holds(reach: JointRange) -> list[Excitation]:
    """Levels held for seconds: creep, warming, and where the joint comes to rest."""
    time, shape = staircase((0.5, 0.9, -0.3, -0.8), 4.0)
    return [excite(reach, j, "long_holds", time, shape) for j in range(len(reach.joints))]


def reversal_staircase(reach: JointRange) -> list[Excitation]:
    """Small steps up and down with more and more reversals: play, dead zone, stiction."""
    levels = (0.04, 0.08, 0.12, 0.08, 0.04, 0.08, 0.04, 0.0, -0.04, 0.0, -0.08, -0.04, -0.08, 0.0)
    time, shape = staircase(levels, 0.8)
    return [excite(reach, j, "reversal_staircase", time, shape) for j in range(len(reach.joints))]


def chirp(reach: JointRange) -> list[Excitation]:
    """A small sine of rising frequency: delay against filter against inertia."""
    time, first, last = sampled(10.0), 0.2, 6.0
    rate = np.log(last / first) / time[-1]
    shape = 0.25 * np.sin(2.0 * np.pi * first * np.expm1(rate * time) / rate)
    return [excite(reach, j, "chirp", time, shape) for j in range(len(reach.joints))]


MENU: dict[str, Callable[[JointRange], list[Excitation]]] = {
    "steps_and_sines": steps_and_sines,
    "slow_triangle": slow_triangle,
    "gain_ladder": gain_ladder,
    "second_payload": second_payload,
    "torque_release": torque_release,
    "long_holds": long_holds,
    "reversal_staircase": reversal_staircase,
    "chirp": chirp,
}
"""Sets of motions by name."""


def excitation_set(reach: JointRange, names: Sequence[str] = ("steps_and_sines",)) -> list[Excitation]:
    """The motions of several sets, in order.

    Args:
        reach: Joints and limits.
        names: Keys of :data:`MENU`.

    Raises:
        ValueError: A set is unknown.
    """
    for name in names:
        if name not in MENU:
            raise ValueError(f"unknown excitation {name!r}; choose from {', '.join(MENU)}")
    return [motion for name in names for motion in MENU[name](reach)]
