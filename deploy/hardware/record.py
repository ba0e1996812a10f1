"""Record motions for vd-gap.

The paper's steps and sines, or a plan of vd-gap's, finger by finger.
"""

import itertools
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import tyro
from scipy.stats import theilslopes

from vd.command.config import require
from vd.command.files import check_folder
from vd.deploy.clock import Pacer
from vd.deploy.hardware.answers import HandState
from vd.deploy.hardware.aside import aside
from vd.deploy.hardware.check import ready
from vd.deploy.hardware.connect import Connection, HandOptions, connect, motors_of
from vd.deploy.hardware.control_table import RAD_PER_COUNT, TICK_MODULUS
from vd.deploy.safety.limits import SafetyCfg
from vd.deploy.safety.safety import SafeHand
from vd.deploy.timely import undisturbed
from vd.logs.hand_log import read_columns

if TYPE_CHECKING:
    from vd.assets_usd.hand_model import HandModel
    from vd.deploy.hardware.joints import JointMotors
    from vd.logs.recording import Recording, Trajectory

RATE_HZ = 100.0
"""Rate that is tried, that of the excitations; the bus may be slower."""
ROUNDING_S = 1e-6
"""Of times on the grid of samples."""
SPEED_RAD_S = 1.0
"""Of the way to where a motion starts."""
WIDE = SafetyCfg(step_rad=4.0)
"""Steps go through most of a joint's range at once, which a policy must not."""
TWIN_JOINT_HZ = 9 * 3840.0
"""Steps of the twin a second, times its joints: half of what a core does. At 3840 Hz its integrator
is as exact as vd-gap's; at 960 it is off by 0.3 mrad (median of a moving hand; up to 0.9), two
thirds of what the encoders round."""
RATE_SHARE = 0.95
"""Share of the rate that is wanted below which a recording says that it missed it."""
AGAIN_S = 0.01
"""A state that was asked for so long after its goal was sent was asked for again."""
CLOCK_SAMPLES = 200
"""By which two clocks are compared."""
STATE_CHANNELS = ("velocity", "current", "pwm", "voltage", "temperature")


class RecordError(ValueError):
    """A recording that cannot be made or gone on with; names the file and the remedy."""


@dataclass(frozen=True)
class RecordCfg(HandOptions):
    """Record motions for vd-gap. Started again with the same options, it goes on where it stopped.

    One joint moves at a time, the others hold; nothing may be in the way, and no object in the
    hand.
    """

    out: Path = Path("recording")
    """Folder of the recording."""
    fingers: tuple[int, ...] = ()
    """Fingers to move, from 0; all by default."""
    excitations: tuple[str, ...] = ("steps_and_sines",)
    """Sets of motions, as vd-gap names them."""
    plan: Path | None = None
    """Plan of vd-gap (next_experiment.json) in place of --excitations; its motions are added to
    --out.
    """
    rate_hz: float = RATE_HZ
    """Samples a second, as far as the bus allows."""
    safety: SafetyCfg = field(default_factory=lambda: WIDE)
    """Limits."""
    realtime: bool = True
    """Run before all ordinary programs, where that is permitted (root, ulimit -r)."""
    yes: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Do not ask before it moves."""


def payload_of(motion: "Trajectory") -> tuple[float, str]:
    """Mass that has to hang at a fingertip [kg], and at whose; of nobody without one."""
    mass = float(motion.conditions.get("payload_kg", 0.0))
    return mass, _finger(motion.joints[0]) if mass > 0.0 else ""


class Sample(NamedTuple):
    """A goal and the state at the moment at which it arrived, of the whole hand."""

    state: HandState
    goal: np.ndarray
    sent_s: float
    enabled: np.ndarray


def motions_of(
    motors: "JointMotors", fingers: Sequence[int], sets: Sequence[str]
) -> list["Trajectory"]:
    """The motions of excitation sets, finger by finger.

    Raises:
        ValueError: A set or a finger is unknown.
    """
    from vd.logs.excitations import JointRange, excitation_set, numbered

    hand = motors.hand
    reach = JointRange(hand.joint_names, hand.lower, hand.upper, p_gain=float(motors.p_gain))
    joints = joints_of(hand, fingers)
    chosen = [motion for motion in excitation_set(reach, sets) if motion.joints[0] in joints]
    chosen.sort(key=lambda motion: _finger(motion.joints[0]))
    return [_of_hand(motion, motors) for motion in numbered(chosen)]


def _finger(joint: str) -> str:
    """The finger of a joint, as its name says."""
    return joint.partition("_")[0]


def _of_hand(motion: "Trajectory", motors: "JointMotors") -> "Trajectory":
    """A motion with the other fingers aside, and the usual gain if it names none."""
    hand = motors.hand
    command = motion.command.copy()
    moving = hand.joint_finger[hand.joint_names.index(motion.joints[0])]
    others = hand.joint_finger != moving
    command[:, others] = aside(hand, int(moving))[others]
    conditions = {"p_gain": float(motors.p_gain), **motion.conditions}
    return replace(motion, command=command, conditions=conditions)


def read_plan(path: Path, motors: "JointMotors") -> list["Trajectory"]:
    """The motions of a plan that ``vd-gap plan`` wrote; joints that it does not name are straight.

    ``path`` is next_experiment.json, or the folder with it.

    Raises:
        RecordError: It is no such plan, or one of another hand.
    """
    file = path / "next_experiment.json" if path.is_dir() else path
    try:
        plan: dict[str, Any] = json.loads(file.read_text())
        entries = plan["trajectories"]
        return [_planned(file.parent, entry, plan["joints"], motors) for entry in entries]
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise RecordError(
            f"{file} is no plan for {motors.hand.name}: {error}; vd-gap plan writes one"
        ) from error


def _planned(
    folder: Path, entry: Mapping[str, Any], joints: Sequence[str], motors: "JointMotors"
) -> "Trajectory":
    """The motion of a plan's entry, whose file is in ``folder``."""
    from vd.logs.recording import Trajectory

    hand = motors.hand
    columns = read_columns(folder / entry["file"])
    command = np.tile(0.5 * (hand.lower + hand.upper), (len(columns["t"]), 1))
    enabled = np.ones(command.shape, dtype=bool)
    for name in joints:
        if name not in hand.joint_names:
            raise ValueError(f"the hand has no joint {name}")
        column = hand.joint_names.index(name)
        command[:, column] = columns[f"command.{name}"]
        enabled[:, column] = columns.get(f"enabled.{name}", np.ones(len(command))) > 0.0
    file = "plan_" + Path(entry["file"]).name
    kind = entry["excitation"]
    joints = tuple(entry["joints"])
    motion = Trajectory(
        file, kind, joints, entry["conditions"], columns["t"], command, command, enabled
    )
    return _of_hand(motion, motors)


def joints_of(hand: "HandModel", fingers: Sequence[int]) -> tuple[str, ...]:
    """Joints of some fingers, all without any.

    Raises:
        ValueError: The hand lacks a finger.
    """
    names: list[str] = []
    for finger in sorted(set(fingers)) or range(hand.num_fingers):
        if not 0 <= finger < hand.num_fingers:
            raise ValueError(
                f"--fingers {finger}: {hand.name} has fingers 0 to {hand.num_fingers - 1}"
            )
        names.extend(hand.joint_names[hand.fingers[finger]])
    return tuple(names)


def measured_at(asked_s: np.ndarray, ticks: np.ndarray) -> np.ndarray:
    """Times of states on this computer's clock, by those of the motors.

    Between a program and its motors lie an adapter, a driver and a scheduler, which pass a packet
    on milliseconds later on a busy machine. The motors have a clock of their own in their state.

    Args:
        asked_s: When each was asked for [T] [s].
        ticks: What the motors' clocks said [T, D] [ms], which start again at their modulus: whole
            milliseconds, each from a moment of its own, so that the mean of nine is as good as 0.1
            ms.

    Returns:
        When each was measured [T] [s]: as long after it was asked for as most of them were.
    """
    gone = np.diff(ticks, axis=0) % TICK_MODULUS
    motor_s = np.concatenate([[0.0], 1e-3 * gone.mean(axis=1).cumsum()])
    # The rates of two clocks differ; a share of the packets that comes late must not count. All
    # pairs of some samples: those of all take longer than a hand may wait for its loop.
    rows = np.unique(np.linspace(0, len(motor_s) - 1, CLOCK_SAMPLES).astype(int))
    rate, begin, *_ = theilslopes((asked_s - motor_s)[rows], motor_s[rows])
    return np.asarray(motor_s * (1.0 + rate) + begin)


def play(
    safe: SafeHand, motion: "Trajectory", columns: Sequence[int], rate_hz: float
) -> "Trajectory":
    """Play a motion from its start on an armed hand, and give what was measured of some joints.

    Raises:
        StoppedError: The hand was stopped.
        BusError: A gain could not be written.
    """
    bus = safe.bus
    safe.move(motion.command[0], SPEED_RAD_S)
    # Of motors whose gains differ, each has the same share of its own.
    share = float(motion.conditions["p_gain"]) / safe.joints.p_gain
    ids = [bus.ids[column] for column in columns]
    bus.stiffen(share, ids)
    samples = list[Sample]()
    pacer = Pacer(rate_hz, bus.clock)
    pacer.wait()
    begin = pacer.due_s
    on = np.ones(len(bus.ids), dtype=bool)
    while (now := pacer.due_s - begin) < motion.duration:
        at = int(np.searchsorted(motion.time, now + ROUNDING_S, side="right")) - 1
        if not np.array_equal(on, motion.enabled[at]):
            on = motion.enabled[at]
            safe.switch(on)
        goal = safe.command(motion.command[at], with_state=True)
        sent_s = bus.clock.now()
        state = safe.read()
        if not samples or state.time_s > samples[-1].state.time_s:  # else the last one again
            samples.append(Sample(state, goal, sent_s, on))
        safe.beat()
        pacer.wait()
    if not on.all():
        safe.switch(np.ones_like(on))
    bus.stiffen(1.0, ids)
    return _trajectory(motion, columns, samples)


def _trajectory(
    motion: "Trajectory", columns: Sequence[int], samples: Sequence[Sample]
) -> "Trajectory":
    """What was measured, of some joints, at the times of the motors' clocks."""
    states = [sample.state for sample in samples]

    def of(name: str) -> np.ndarray:
        return np.array([getattr(state, name) for state in states])[:, columns]

    asked_s = np.array([state.time_s for state in states])
    sent_s = np.array([sample.sent_s for sample in samples])
    measured_s = measured_at(asked_s, np.array([state.tick for state in states]))
    # A goal arrives with the question for its state, unless that was asked again.
    sent_s = np.where(asked_s - sent_s < AGAIN_S, measured_s, sent_s)
    channels: dict[str, Any] = {name: of(name) for name in STATE_CHANNELS}
    if not channels["pwm"].any():  # a motor that does not tell its duty cycle says zero
        del channels["pwm"]
    return replace(
        motion,
        time=measured_s - measured_s[0],
        command_time=sent_s - measured_s[0],
        command=np.array([sample.goal for sample in samples])[:, columns],
        position=of("position"),
        enabled=np.array([sample.enabled for sample in samples])[:, columns],
        **channels,
    )


def record(cfg: RecordCfg) -> int:
    """Record what is not recorded yet."""
    from vd.logs.recording import write_recording

    require(cfg, "--", "positive", "rate_hz")
    check_folder(cfg.out)
    motors = motors_of(cfg)
    joints = joints_of(motors.hand, cfg.fingers)
    recording = _begun(cfg, motors, joints)
    if cfg.plan is None:
        motions = motions_of(motors, cfg.fingers, cfg.excitations)
    else:
        motions = read_plan(cfg.plan, motors)
    physics_hz = TWIN_JOINT_HZ / motors.hand.num_joints
    with connect(cfg, physics_hz=physics_hz) as connection, undisturbed(cfg.realtime):
        done = {trajectory.file for trajectory in recording.trajectories}
        left = [motion for motion in motions if motion.file not in done]
        print(
            f"{len(motions)} motions, {len(motions) - len(left)} of them recorded", file=sys.stderr
        )
        written: list[Future[Path]] = []
        # Beside the loop: a hand that holds has to be told so all the time.
        with ThreadPoolExecutor(1) as writer:

            def keep(trajectory: "Trajectory") -> None:
                nonlocal recording
                recording = replace(recording, trajectories=(*recording.trajectories, trajectory))
                only = (trajectory.file,)
                written.append(writer.submit(write_recording, recording, cfg.out, only=only))

            left.sort(key=payload_of)
            for payload, group in itertools.groupby(left, key=payload_of):
                _session(cfg, connection, joints, list(group), payload, keep)
        for writing in written:
            writing.result()
    print(f"{cfg.out}: {len(recording.trajectories)} motions; vd-gap run {cfg.out} --out gap")
    return 0


def _session(
    cfg: RecordCfg,
    connection: Connection,
    joints: tuple[str, ...],
    motions: Sequence["Trajectory"],
    payload: tuple[float, str],
    keep: Callable[["Trajectory"], None],
) -> None:
    """Motions with one payload [kg] at one finger, between preflight and torque off."""
    payload_kg, finger = payload
    seconds = sum(motion.duration for motion in motions)
    question = f"The hand will move for about {seconds:.0f} s, one joint at a time and quickly."
    if payload_kg > 0.0:
        if cfg.yes or cfg.twin:
            raise RecordError(
                f"{motions[0].file}: somebody has to hang {payload_kg:g} kg at the fingertip"
            )
        question = f"Hang {payload_kg:g} kg at the fingertip of {finger}. {question}"
    ready(connection, question, yes=cfg.yes)
    columns = list(map(connection.joints.names.index, joints))
    with SafeHand(connection.bus, connection.joints, cfg.safety) as safe:
        safe.arm()
        for number, motion in enumerate(motions, 1):
            trajectory = play(safe, motion, columns, cfg.rate_hz)
            rate = (len(trajectory.time) - 1) / trajectory.time[-1]
            what = f"{number}/{len(motions)} {Path(motion.file).stem}"
            line = f"{what}: {trajectory.time[-1]:.1f} s at {rate:.0f} Hz"
            if rate < RATE_SHARE * cfg.rate_hz:
                look = "" if cfg.twin else "look at the adapter's latency timer and the baud rate, "
                line += (
                    f", not {cfg.rate_hz:g}: a sample takes {1e3 / rate:.1f} ms; {look}"
                    f"end other programs, or ask for --rate-hz {rate:.0f}"
                )
            print(line, file=sys.stderr, flush=True)
            keep(trajectory)


def _begun(cfg: RecordCfg, motors: "JointMotors", joints: tuple[str, ...]) -> "Recording":
    """The recording in the folder, or an empty one."""
    from vd.assets_usd.hands import called
    from vd.logs.recording import Recording, read_recording

    model = called(motors.hand)
    if (cfg.out / "recording.json").exists():
        begun = read_recording(cfg.out)
        if begun.joints != joints or begun.model != model:
            raise RecordError(
                f"{cfg.out} is of {begun.model}, {', '.join(begun.joints)}; choose another --out"
            )
        return begun
    return Recording(cfg.out, model, joints, motors.servo(), RAD_PER_COUNT, ())
