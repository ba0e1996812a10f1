"""Make recordings in which an effect is hidden, to test what finds it.

The recording comes from :mod:`vd.gap.bench.hidden_plant`: random base parameters, sensor noise, encoder
counts and jittered stamps. What is hidden is written beside the folder, never into it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter

from vd.assets_usd.hands import load_hand
from vd.command.files import write_json
from vd.gap.bench.hidden_finger import finger_of
from vd.gap.bench.hidden_plant import (
    OUTSIDE,
    TUNED,
    HiddenPlant,
    Physics,
    PlantRun,
    simulate,
)
from vd.kernels.servo.effects import EFFECTS
from vd.logs.excitations import JointRange, excitation_set, numbered
from vd.logs.recording import BARE_MODELS, STIFFNESS, Recording, Trajectory, write_recording

ENCODER_COUNT = 2.0 * math.pi / 4096
"""Twelve bits a turn, as of Dynamixel X and Feetech STS servos [rad]."""
NOISE_RAD = 3.0e-4
"""Standard deviation of the reading before it is rounded to counts [rad]."""
NOISE_FLOOR_RAD = math.hypot(NOISE_RAD, ENCODER_COUNT / math.sqrt(12.0))
"""Standard deviation of a reading about the true position: noise, and rounding to counts [rad]."""
STAMP_JITTER_S = 1.0e-3
"""Standard deviation of the sampling instants about the regular ones [s]; the stamps tell them."""
SHORTEST_PERIOD_S = 1.0e-3
BASE_SPREAD = 0.2
"""Base parameters lie within this share of the hand's, as the paper's randomisation has it."""
PAUSE_S = 2.0
"""Between two trajectories of a session."""
FULL_P_GAIN = 400.0
"""P gain, in the units of Dynamixel X servos, at which the stiffness is the plant's."""
CHUNK = 48
"""Trajectories simulated together: enough to amortise Python, few enough for memory."""

BASE = ("kp", "kd", "velocity_limit", "inertia", "gravity_torque")
"""Base parameters of a plant, which the truth tells."""
BARE = {
    "servo": (3.0, 0.3, 7.0, 2.0e-3, 0.0),
    "pendulum": (3.0, 0.2, 8.0, 6.0e-3, 0.4),
}
"""Base parameters of a hobby servo that turns a small load about a vertical axis, and of the rig of
the XL330 recordings, some 0.4 kg on an arm of 0.1 m."""
BARE_REACH_RAD = 1.5
"""Range of a bare servo about its centre [rad]."""
INERTIA_SPREAD = math.log(2.0)
"""The unknown inertia and gravity of a bare servo vary by a factor of two, log-uniform."""

COUPLING = "joint_coupling"
"""The effect that takes more than one joint."""


@dataclass(frozen=True)
class Hiding:
    """What to make a recording of.

    Attributes:
        model: A hand's name (one finger of it is recorded), ``servo`` or ``pendulum``.
        effects: Name to parameter to value; absent parameters take typical values.
        seed: Of base parameters, noise, jitter.
        joints: Joints recorded; empty: the first finger, or the one joint of a bare model.
        excitations: Sets of :data:`vd.logs.excitations.MENU`.
        base_spread: Spread of stiffness, damping and speed limit about the hand's; 0: exactly the
            hand's.
        mass_spread: Spread of the finger's masses and inertias about the hand's.
        physics: Of the plant, and of its sensor.
    """

    model: str
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    seed: int = 0
    joints: tuple[str, ...] = ()
    excitations: tuple[str, ...] = ("steps_and_sines",)
    base_spread: float = BASE_SPREAD
    mass_spread: float = 0.0
    physics: Physics = TUNED


@dataclass(frozen=True)
class Hidden:
    """A recording and what is hidden in it.

    Attributes:
        recording: The recording, not yet written.
        truth: Model, seed, base parameters per joint, effects with their parameters and joints,
            noise.
    """

    recording: Recording
    truth: dict[str, Any]


def parse_effect(text: str) -> tuple[str, dict[str, float]]:
    """Name and given parameters of ``NAME[:p=v,..]``.

    Raises:
        ValueError: A value is no number. What there is to hide, :func:`hide` knows.
    """
    name, _, tail = text.partition(":")
    values: dict[str, float] = {}
    for item in tail.split(",") if tail else ():
        key, _, value = item.partition("=")
        try:
            values[key.strip()] = float(value)
        except ValueError as error:
            raise ValueError(f"effect {text!r}: {key} is {value!r}; write {key}=NUMBER") from error
    return name.strip(), values


def effect_parameters(name: str) -> dict[str, float]:
    """Parameters of an effect, of the table or outside, with typical values.

    Raises:
        ValueError: There is no such effect.
    """
    if name in OUTSIDE:
        return dict(OUTSIDE[name])
    if name in EFFECTS:
        return {parameter.name: parameter.typical for parameter in EFFECTS[name].parameters}
    raise ValueError(f"unknown effect {name!r}; choose from {', '.join((*EFFECTS, *OUTSIDE))}")


def hide(hiding: Hiding, out: str | Path) -> Hidden:
    """Write a recording in which effects are hidden to ``out``, and the truth beside it, ``OUT.truth.json``.

    Raises:
        ValueError: An unknown model, joint, effect, parameter or excitation.
    """
    hidden = simulate_hidden(hiding)
    write_recording(hidden.recording, Path(out))
    write_json(truth_path(out), hidden.truth)
    return hidden


def truth_path(out: str | Path) -> Path:
    """Where the truth about the recording in ``out`` is written."""
    out = Path(out)
    return out.parent / f"{out.name}.truth.json"


def check_hidden(out: Path) -> None:
    """Refuse a folder with a recording in which nothing was hidden.

    Raises:
        ValueError: It is one.
    """
    if (out / "recording.json").exists() and not truth_path(out).exists():
        raise ValueError(
            f"--out {out} holds a recording in which nothing was hidden; name another folder"
        )


def simulate_hidden(hiding: Hiding) -> Hidden:
    """Make a recording.

    Raises:
        ValueError: As of :func:`hide`.
    """
    rng = np.random.default_rng(hiding.seed)
    reach, plant = machine(hiding, rng)
    motions = numbered(excitation_set(reach, hiding.excitations))
    runs = []
    session_s = 0.0
    for motion in motions:
        time = _stamps(motion, rng)
        seed = int(rng.integers(2**31))
        run = PlantRun(
            plant, time, motion.command, motion.enabled, motion.conditions, session_s, seed
        )
        runs.append(run)
        session_s += motion.duration + PAUSE_S
    moved = _simulate(runs)
    trajectories = []
    for motion, run, own in zip(motions, runs, moved, strict=True):
        noise = reading_noise(hiding.physics.noise_s, own.shape, run.time, rng)
        recorded = replace(
            motion,
            conditions={"p_gain": plant.full_gain, **motion.conditions},
            time=run.time,
            position=np.round((own + noise) / ENCODER_COUNT) * ENCODER_COUNT,
        )
        trajectories.append(recorded)
    servo: dict[str, Any] = {"model": "test rig", "p_gain": plant.full_gain}
    if hiding.model in BARE_MODELS:  # without masses nothing else tells how large torques are
        servo[STIFFNESS] = _by_joint(plant, plant.kp)
    recording = Recording(
        Path(), hiding.model, plant.joints, servo, ENCODER_COUNT, tuple(trajectories)
    )
    return Hidden(recording, _truth(hiding, plant))


def _stamps(motion: Trajectory, rng: np.random.Generator) -> np.ndarray:
    """The instants at which commands are written and positions read [T] [s], from 0."""
    time = motion.time + rng.normal(0.0, STAMP_JITTER_S, len(motion.time))
    time[0] = 0.0
    # Late ones push the next; as many digits as are written, so that readers see the same stamps.
    for i in range(1, len(time)):
        time[i] = max(time[i], time[i - 1] + SHORTEST_PERIOD_S)
    return np.round(time, 6)


def _simulate(runs: Sequence[PlantRun]) -> list[np.ndarray]:
    """Simulate runs, those of about the same length together: a batch runs as long as its longest."""
    order = sorted(range(len(runs)), key=lambda index: runs[index].time[-1])
    moved: dict[int, np.ndarray] = {}
    for start in range(0, len(order), CHUNK):
        part = order[start : start + CHUNK]
        motions = simulate([runs[index] for index in part])
        moved.update(zip(part, motions, strict=True))
    return [moved[index] for index in range(len(runs))]


def reading_noise(
    noise_s: float, shape: tuple[int, ...], time: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Noise of a reading [T, J] [rad]; of the same size whatever its correlation time [s]."""
    white = rng.normal(0.0, NOISE_RAD, shape)
    if noise_s <= 0.0:
        return white
    keep = math.exp(-float(np.median(np.diff(time))) / noise_s)
    new = math.sqrt(1.0 - keep * keep)
    return lfilter([new], [1.0, -keep], white, axis=0, zi=(1.0 - new) * white[:1])[0]


def _truth(hiding: Hiding, plant: HiddenPlant) -> dict[str, Any]:
    effects: dict[str, Any] = {}
    for name, parameters in plant.effects.items():
        values = {}
        for key, value in parameters.items():
            values[key] = _by_joint(plant, value)
        effects[name] = {"joints": list(plant.joints), "parameters": values}
    base = {}
    for name in BASE:
        base[name] = _by_joint(plant, getattr(plant, name))
    return {
        "format": "vd-hidden/1",
        "model": hiding.model,
        "seed": hiding.seed,
        "noise_floor_rad": NOISE_FLOOR_RAD,
        "mass_spread": hiding.mass_spread,
        "base": base,
        "effects": effects,
    }


def _by_joint(plant: HiddenPlant, values: np.ndarray) -> dict[str, float]:
    return dict(zip(plant.joints, values.tolist(), strict=True))


def machine(hiding: Hiding, rng: np.random.Generator) -> tuple[JointRange, HiddenPlant]:
    """Draw the machine: the range of its joints, and the plant with its effects."""
    reach, plant = _bare(hiding, rng) if hiding.model in BARE_MODELS else _finger(hiding, rng)
    effects: dict[str, dict[str, np.ndarray]] = {}
    for name, given in hiding.effects.items():
        _check_effect(name, given)
        if name == COUPLING and len(plant.joints) == 1:
            raise ValueError(
                f"{name}: {hiding.model} has one joint, which nothing can drive; take a hand"
            )
        effects[name] = {}
        for key, value in {**effect_parameters(name), **given}.items():
            effects[name][key] = np.full(len(plant.joints), value)
    return reach, replace(plant, effects=effects, physics=hiding.physics)


def _check_effect(name: str, given: Mapping[str, float]) -> None:
    typical = effect_parameters(name)
    signed = []
    if name in EFFECTS:
        signed = [p.name for p in EFFECTS[name].parameters if p.signed]
    for key, value in given.items():
        if key not in typical:
            raise ValueError(f"{name} has no parameter {key!r}; it has {', '.join(typical)}")
        if not math.isfinite(value):
            raise ValueError(f"{name}: {key} is {value}; give a finite number")
        if value < 0.0 and key not in signed:
            raise ValueError(f"{name}: {key} is {value}; it cannot be negative")


def _bare(hiding: Hiding, rng: np.random.Generator) -> tuple[JointRange, HiddenPlant]:
    joints = hiding.joints or ("joint" if hiding.model == "servo" else "pendulum",)
    count = len(joints)
    near = _spread(rng, hiding.base_spread, (3, count))
    far = np.exp(_spread(rng, INERTIA_SPREAD if hiding.base_spread else 0.0, (2, count)) - 1.0)
    reach = JointRange(
        joints, np.full(count, -BARE_REACH_RAD), np.full(count, BARE_REACH_RAD), FULL_P_GAIN
    )
    values = np.vstack([near, far]) * np.array(BARE[hiding.model])[:, None]
    base = dict(zip(BASE, values, strict=True))
    return reach, HiddenPlant(joints=joints, **base, full_gain=FULL_P_GAIN)


def _spread(rng: np.random.Generator, width: float, shape: tuple[int, ...]) -> np.ndarray:
    """Factors 1 - width .. 1 + width."""
    return 1.0 + rng.uniform(-width, width, shape)


def _finger(hiding: Hiding, rng: np.random.Generator) -> tuple[JointRange, HiddenPlant]:
    try:
        hand = load_hand(hiding.model)
    except ValueError as error:
        raise ValueError(
            f"model {hiding.model!r}: {error}; or take {' or '.join(BARE_MODELS)}"
        ) from error
    fingers = [tuple(hand.joint_names[finger]) for finger in hand.fingers]
    joints = tuple(hiding.joints or fingers[0])
    if joints not in fingers:
        raise ValueError(f"joints {', '.join(joints)}: name the joints of one finger, in order")
    if (hand.mimic >= 0).any():
        raise ValueError(
            f"{hand.name}: some joints follow others, which the gap workflow does not model"
        )
    finger = fingers.index(joints)
    n = len(joints)
    index = hand.fingers[finger]
    near = _spread(rng, hiding.base_spread, (3, n))
    heavy = _spread(rng, hiding.mass_spread, (n,))
    reach = JointRange(joints, hand.lower[index], hand.upper[index], FULL_P_GAIN)
    return reach, HiddenPlant(
        joints=joints,
        kp=hand.kp[index] * near[0],
        kd=hand.kd[index] * near[1],
        velocity_limit=hand.velocity_limit[index] * near[2],
        inertia=hand.armature[index],
        gravity_torque=np.zeros(n),
        body=partial(finger_of, hand, finger, heavy),
        full_gain=FULL_P_GAIN,
        effort=hand.effort[index],
    )
