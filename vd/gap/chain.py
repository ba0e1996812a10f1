"""Chains of joints that move each other: a finger read from the hand's USD, or one bare servo or pendulum.

A bare servo and a pendulum are one joint with its own inertia; a finger is a chain of bodies, hanging palm
down as in the simulator.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import HandModel
from vd.gap.recording import Recording
from vd.kernels.servo import actuators as servo
from vd.kernels.servo.effects import BASELINE, EFFECTS, neutral_row

GRAVITY_M_S2 = 9.81
"""Acceleration of gravity, the simulator's."""
FREE = 1.0e6
"""A position [rad] that no joint and a torque [N m] that no drive reaches: the bound of one that has none."""


@dataclass(frozen=True, eq=False)
class Load:
    """The point mass on a pendulum's arm.

    Attributes:
        mass_kg: Mass [kg].
        arm_m: Length of the arm [m].
    """

    mass_kg: float
    arm_m: float

    @property
    def torque(self) -> float:
        """Gravity torque with the arm level [N m]."""
        return self.mass_kg * GRAVITY_M_S2 * self.arm_m

    @property
    def inertia(self) -> float:
        """Inertia about the joint [kg m^2]."""
        return self.mass_kg * self.arm_m**2


@dataclass(frozen=True, eq=False)
class Chain:
    """Joints that move each other: a finger, or one servo. n joints; all arrays are of float64.

    Torques of a chain without bodies are known up to a common factor only (kp, kd, inertia, gravity
    and friction can all be doubled): whoever fits it must hold one of them.

    Attributes:
        name: Name for people.
        joints: Names of the joints in the recording [n].
        columns: Their columns in the recording [n].
        baseline_free: Names of the parameters that the baseline fits.
        start_row: Nominal parameter rows, every effect off [n, PARAMETER_COLUMNS].
        slot: Place of each joint in its finger, which is its column of the coupling [n].
        bodies: Whether the links have mass; if not, each joint is its own inertia.
        axis: Unit joint axes in the base frame, all joints at zero, as all that follows [n, 3].
        offset: From the joint before (the base) to the joint [n, 3] [m].
        mass: Mass behind each joint, up to the next [n] [kg].
        com: From the joint to that mass's centre [n, 3] [m].
        inertia: Inertia about that centre [n, 3, 3] [kg m^2].
        gravity: Acceleration of gravity in the base frame [3] [m/s^2].
        lower: Lower stops [n] [rad].
        upper: Upper stops [n] [rad].
        effort: Largest torques of the drives [n] [N m].
        reference_p_gain: Largest ``p_gain`` of the recording, at which kp is identified; None without.
        reference_load: A pendulum's load, at which inertia and gravity torque are identified, or None.
    """

    name: str
    joints: tuple[str, ...]
    columns: np.ndarray
    baseline_free: tuple[str, ...]
    start_row: np.ndarray
    slot: np.ndarray
    bodies: bool
    axis: np.ndarray
    offset: np.ndarray
    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray
    gravity: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    effort: np.ndarray
    reference_p_gain: float | None
    reference_load: Load | None

    def inertia_scale(self, joint: int) -> float:
        """Inertia of the links about a joint with all joints at zero, without the drive's own [kg m^2]."""
        if not self.bodies:
            return 0.0
        total, origin = 0.0, np.zeros(3)
        for link in range(joint, len(self.joints)):
            origin = origin + (self.offset[link] if link > joint else 0.0)
            lever = np.cross(self.axis[joint], origin + self.com[link])
            total += (
                self.mass[link] * lever @ lever + self.axis[joint] @ self.inertia[link] @ self.axis[joint]
            )
        return float(total)


def chains(recording: Recording, hand: HandModel | None = None) -> list[Chain]:
    """The chains of a recording: each finger with recorded joints, or each joint of a bare model.

    Joints of a finger that are not recorded are taken to stand at zero.

    Raises:
        ValueError: The recording is of a hand and none is given, it has joints that the hand has not, or
            joints follow others.
    """
    gains = [t.conditions["p_gain"] for t in recording.trajectories if "p_gain" in t.conditions]
    p_gain = max((float(gain) for gain in gains), default=None)
    if recording.model in ("servo", "pendulum"):
        return [_bare(recording, column, p_gain) for column in range(len(recording.joints))]
    if hand is None:
        raise ValueError(f"{recording.path}: a recording of {recording.model!r} needs its hand; pass it")
    unknown = [name for name in recording.joints if name not in hand.joint_names]
    if unknown:
        raise ValueError(
            f"{recording.path}: joints {', '.join(unknown)} are not joints of {hand.name} "
            f"({', '.join(hand.joint_names)}); name the hand that was recorded"
        )
    if (hand.mimic >= 0).any():
        raise ValueError(f"{hand.name}: some joints follow others, which the gap workflow does not model")
    found = []
    for finger in hand.fingers:
        names = tuple(name for name in hand.joint_names[finger] if name in recording.joints)
        if names:
            found.append(_finger(recording, hand, finger, names, p_gain))
    return found


def load_of(conditions: dict[str, float | str]) -> Load | None:
    """The load of a trajectory, if its conditions say it."""
    if "payload_kg" not in conditions or "arm_length_m" not in conditions:
        return None
    return Load(float(conditions["payload_kg"]), float(conditions["arm_length_m"]))


def _bare(recording: Recording, column: int, p_gain: float | None) -> Chain:
    """One joint that is its own inertia."""
    row = np.array(neutral_row())
    for parameter in BASELINE:
        row[parameter.column] = parameter.typical
    free = [parameter.name for parameter in BASELINE]
    if all(t.enabled[:, column].all() for t in recording.trajectories):
        free.remove("kd_off")  # nothing shows it
    load = None
    if recording.model == "pendulum":
        free.append("tau_g_nm")
        loads = [load for t in recording.trajectories if (load := load_of(t.conditions)) is not None]
        load = max(loads, key=lambda each: each.torque, default=None)
        if load is not None:
            row[servo.GRAVITY_TORQUE] = load.torque
            row[servo.INERTIA] += load.inertia
    return Chain(
        name=recording.joints[column],
        joints=(recording.joints[column],),
        columns=np.array([column]),
        baseline_free=tuple(free),
        start_row=row[None],
        slot=np.zeros(1, int),
        bodies=False,
        axis=np.zeros((1, 3)),
        offset=np.zeros((1, 3)),
        mass=np.zeros(1),
        com=np.zeros((1, 3)),
        inertia=np.zeros((1, 3, 3)),
        gravity=np.zeros(3),
        lower=np.array([-FREE]),
        upper=np.array([FREE]),
        effort=np.array([FREE]),
        reference_p_gain=p_gain,
        reference_load=load,
    )


def _finger(
    recording: Recording, hand: HandModel, finger: slice, names: tuple[str, ...], p_gain: float | None
) -> Chain:
    """A finger's bodies with all joints at zero; what an unrecorded joint carries is fixed to its parent."""
    length = finger.stop - finger.start
    slots = [i for i, name in enumerate(hand.joint_names[finger]) if name in names]
    joints = finger.start + np.array(slots)
    poses = hand.forward_kinematics(np.zeros(hand.num_joints))
    origins, axes = [], []
    for joint in joints:
        parent, frame = poses[hand.joint_parent[joint]], hand.joint_parent_frame[joint]
        turn = Rotation.from_quat(parent[3:])
        origins.append(parent[:3] + turn.apply(frame[:3]))
        axes.append((turn * Rotation.from_quat(frame[3:])).apply(hand.joint_axis[joint]))
    n = len(joints)
    mass, com, inertia = np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3, 3))
    for i, slot in enumerate(slots):
        last = slots[i + 1] if i + 1 < n else length
        carried = hand.joint_child[finger.start + np.arange(slot, last)]
        masses = hand.link_mass[carried]
        turns = [Rotation.from_quat(pose[3:]) for pose in poses[carried]]
        centres = np.array(
            [
                pose[:3] + t.apply(hand.link_com[link])
                for t, pose, link in zip(turns, poses[carried], carried, strict=True)
            ]
        )
        mass[i] = masses.sum()
        centre = masses @ centres / mass[i]
        com[i] = centre - origins[i]
        for link, turn, m, arm in zip(carried, turns, masses, centres - centre, strict=True):
            rotation = turn.as_matrix()
            inertia[i] += rotation @ hand.link_inertia[link] @ rotation.T
            inertia[i] += m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    rows = np.tile(neutral_row(), (n, 1))
    rows[:, servo.KP] = hand.kp[joints]
    rows[:, servo.KD] = hand.kd[joints]
    rows[:, servo.VELOCITY_LIMIT] = hand.velocity_limit[joints]
    rows[:, servo.INERTIA] = hand.armature[joints]
    return Chain(
        name=f"f{finger}",
        joints=names,
        columns=np.array([recording.joints.index(name) for name in names]),
        baseline_free=("kp", "kd", "velocity_limit"),
        start_row=rows,
        slot=np.array(slots),
        bodies=True,
        axis=np.array(axes),
        offset=np.diff(np.array(origins), axis=0, prepend=np.zeros((1, 3))),
        mass=mass,
        com=com,
        inertia=inertia,
        gravity=GRAVITY_M_S2 * hand.down,
        lower=hand.lower[joints],
        upper=hand.upper[joints],
        effort=hand.effort[joints],
        reference_p_gain=p_gain,
        reference_load=None,
    )


def others_in(chain: Chain, joint: int) -> list[int]:
    """Slots of the other joints of a chain, whose motion can drive a joint."""
    return [int(slot) for j, slot in enumerate(chain.slot) if j != joint]


def candidates(chain: Chain, effects: Sequence[str]) -> list[str]:
    """Effects that a joint of a chain can have besides its baseline."""
    excluded = set()
    if "tau_g_nm" in chain.baseline_free:
        excluded.add("gravity_load")
    if "inertia" in chain.baseline_free:
        excluded.add("payload_inertia")
    if len(chain.joints) == 1:
        excluded.add("joint_coupling")
    return [name for name in EFFECTS if name in effects and name not in excluded]
