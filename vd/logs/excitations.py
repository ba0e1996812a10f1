"""Motions that excite one joint at a time.

The paper's steps and sines, and a menu for what they leave open.

The paper commands steps and sines of 0.05 to 1.5 Hz, amplitudes in proportion to the joint limits.
Commands are in rad, times in seconds.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from vd.logs.motions import Trajectory

RATE_HZ = 100.0
"""Rate at which commands are written. Not tuned."""
AMPLITUDE = 0.7
"""Largest command, in half the joint's range: room for overshoot before the stops. Not tuned."""


@dataclass(frozen=True, eq=False)
class JointRange:
    """What motions are scaled to.

    Attributes:
        joints: Names [J].
        lower: Lower limits [J] [rad].
        upper: Upper limits [J] [rad].
        p_gain: Full P gain of the servos as recordings name it; the ladder's top.
        payloads_kg: The usual payload and a second one; of a finger two links' weight at its tip.
    """

    joints: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    p_gain: float = 1.0
    payloads_kg: tuple[float, float] = (0.0, 0.05)


@dataclass(frozen=True, eq=False)
class MenuMotion:
    """A motion of the menu, of any joint.

    Attributes:
        name: Kind of motion.
        shape: Command at ``RATE_HZ`` [T], in shares of the amplitude.
        gain: P gain as a share of the full one, where it is varied.
        payload: Index of the payload, where it is varied.
        release_s: When the torque is switched off [s].
    """

    name: str
    shape: np.ndarray
    gain: float | None = None
    payload: int | None = None
    release_s: float = np.inf

    def of(self, reach: JointRange, joint: int) -> Trajectory:
        """This motion of one joint about the centre of its range, while the others hold there."""
        time = np.arange(len(self.shape)) / RATE_HZ
        command = np.tile(0.5 * (reach.lower + reach.upper), (len(time), 1))
        command[:, joint] += 0.5 * AMPLITUDE * (reach.upper - reach.lower)[joint] * self.shape
        enabled = np.ones(command.shape, dtype=bool)
        enabled[time >= self.release_s, joint] = False
        conditions: dict[str, float | str] = {}
        if self.gain is not None:
            conditions["p_gain"] = self.gain * reach.p_gain
        if self.payload is not None:
            conditions["payload_kg"] = reach.payloads_kg[self.payload]
        name = reach.joints[joint]
        file = f"{name}_{self.name}.csv"
        return Trajectory(file, self.name, (name,), conditions, time, command, command, enabled)


def numbered(motions: Iterable[Trajectory]) -> tuple[Trajectory, ...]:
    """Motions with their place in front of the names of their files."""
    return tuple(replace(motion, file=f"{i:03d}_{motion.file}") for i, motion in enumerate(motions))


def _levels(name: str, hold_s: float, *levels: float) -> MenuMotion:
    """Levels held in turn, after half a second at zero so that the onset is in the recording."""
    time = _time(0.5 + hold_s * len(levels))
    place = np.floor((time - 0.5) / hold_s + 1e-9).astype(int) + 1
    return MenuMotion(name, np.array([0.0, *levels])[np.clip(place, 0, len(levels))])


def _sine(name: str, frequency_hz: float, duration_s: float) -> MenuMotion:
    return MenuMotion(name, np.sin(2.0 * np.pi * frequency_hz * _time(duration_s)))


def _triangle(name: str, period_s: float, duration_s: float) -> MenuMotion:
    return MenuMotion(
        name, -2.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi / period_s * _time(duration_s)))
    )


def _chirp(
    name: str, size: float, first_hz: float, last_hz: float, duration_s: float
) -> MenuMotion:
    """A sine whose frequency grows exponentially."""
    time = _time(duration_s)
    rate = np.log(last_hz / first_hz) / duration_s
    return MenuMotion(name, size * np.sin(2.0 * np.pi * first_hz * np.expm1(rate * time) / rate))


def _time(duration_s: float) -> np.ndarray:
    return np.arange(round(duration_s * RATE_HZ) + 1) / RATE_HZ


_LADDER = (_levels("ladder_step", 1.75, 0.4, -0.2), _sine("ladder_sine", 0.4, 5.0))
MENU: dict[str, tuple[MenuMotion, ...]] = {
    "steps_and_sines": (
        _levels("step_small", 1.75, 0.12, -0.12),
        _levels("step_medium", 1.75, 0.4, -0.2),
        _levels("step_large", 1.75, -0.9, 0.9),
        _sine("sine_0.05hz", 0.05, 12.0),  # one reversal
        _sine("sine_0.20hz", 0.2, 7.5),
        _sine("sine_0.50hz", 0.5, 6.0),
        _sine("sine_1.00hz", 1.0, 5.0),
        _sine("sine_1.50hz", 1.5, 4.0),
    ),
    # A constant slow speed both ways: friction against its direction, play at its reversals.
    "slow_triangle": (_triangle("slow_triangle", 16.0, 20.0),),
    # Steps and sines at falling P gains: what scales with the gain is the servo's.
    "gain_ladder": tuple(
        replace(motion, gain=gain) for gain, motion in product((1.0, 0.5, 0.25), _LADDER)
    ),
    # The same sine with two payloads: what grows with the load.
    "second_payload": tuple(replace(_sine("payload_sine", 0.25, 8.0), payload=i) for i in (0, 1)),
    # Lifted, then the torque is switched off: what is left is gravity, friction and inertia.
    "torque_release": (replace(_levels("torque_release", 4.5, 0.8), release_s=2.0),),
    # Levels held for seconds: creep, warming, and where the joint comes to rest.
    "long_holds": (_levels("long_holds", 4.0, 0.5, 0.9, -0.3, -0.8),),
    # Small steps with more and more reversals: play, dead zone, stiction.
    "reversal_staircase": (
        _levels(
            "reversal_staircase",
            0.8,
            *0.04 * np.array([1, 2, 3, 2, 1, 2, 1, 0, -1, 0, -2, -1, -2, 0]),
        ),
    ),
    # A small sine of rising frequency: delay against filter against inertia.
    "chirp": (_chirp("chirp", 0.25, 0.2, 6.0, 10.0),),
}
"""Sets of motions by name."""


def excitation_set(
    reach: JointRange, names: Sequence[str] = ("steps_and_sines",)
) -> list[Trajectory]:
    """The motions of several sets, in order, joint by joint.

    Their commands stand in the place of positions.

    Args:
        reach: Joints and limits.
        names: Keys of :data:`MENU`.

    Raises:
        ValueError: A set is unknown.
    """
    for name in names:
        if name not in MENU:
            raise ValueError(f"unknown excitation {name!r}; choose from {', '.join(MENU)}")
    motions = []
    for name in names:
        for joint in range(len(reach.joints)):
            motions += [motion.of(reach, joint) for motion in MENU[name]]
    return motions
