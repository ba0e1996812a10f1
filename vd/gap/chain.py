"""Chains of joints that move each other.

A finger read from the hand's USD, or one bare servo or pendulum.

A bare servo and a pendulum are one joint with its own inertia; a finger is a chain of bodies,
hanging palm down as in the simulator.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import HandModel
from vd.kernels.servo import actuators as servo
from vd.kernels.servo.effects import BASELINE, neutral_row
from vd.logs.recording import BARE_MODELS, STIFFNESS, Recording

GRAVITY_M_S2 = 9.81
"""Acceleration of gravity, the simulator's."""


class Load(NamedTuple):
    """The point mass on a pendulum's arm, in kg and m."""

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
        reference_p_gain: Largest ``p_gain`` of the recording, at which kp is identified; None
            without.
        reference_load: A pendulum's load, at which inertia and gravity torque are identified, or
            None.
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
    """

    name: str
    joints: tuple[str, ...]
    columns: np.ndarray
    baseline_free: tuple[str, ...]
    start_row: np.ndarray
    slot: np.ndarray
    reference_p_gain: float | None
    reference_load: Load | None = None
    bodies: bool = False
    axis: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))
    offset: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))
    mass: np.ndarray = field(default_factory=lambda: np.zeros(1))
    com: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))
    inertia: np.ndarray = field(default_factory=lambda: np.zeros((1, 3, 3)))
    gravity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    lower: np.ndarray = field(default_factory=lambda: np.array([-np.inf]))
    upper: np.ndarray = field(default_factory=lambda: np.array([np.inf]))
    effort: np.ndarray = field(default_factory=lambda: np.array([np.inf]))

    def inertia_scale(self, joint: int) -> float:
        """Inertia of the links about a joint with all joints at zero, without the drive's own [kg m^2]."""
        axis = self.axis[joint]
        places = np.cumsum(self.offset, axis=0) + self.com
        levers = np.cross(axis, places - np.cumsum(self.offset, axis=0)[joint])[joint:]
        own = np.einsum("i,kij,j->k", axis, self.inertia[joint:], axis)
        return float(np.sum(self.mass[joint:] * (levers**2).sum(axis=1) + own))


def chains(recording: Recording, hand: HandModel | None = None) -> list[Chain]:
    """The chains of a recording: each finger with recorded joints, or each joint of a bare model.

    Joints of a finger that are not recorded are taken to stand at zero.

    Raises:
        ValueError: The recording is of a hand and none is given, it has joints that the hand has
            not, or joints follow others.
    """
    p_gain = None
    for trajectory in recording.trajectories:
        if (gain := trajectory.conditions.get("p_gain")) is not None:
            p_gain = max(p_gain or 0.0, float(gain))
    if recording.model in BARE_MODELS:
        return [_bare(recording, column, p_gain) for column in range(len(recording.joints))]
    if hand is None:
        raise ValueError(
            f"{recording.path}: a recording of {recording.model!r} needs its hand; pass it"
        )
    for name in recording.joints:
        if name not in hand.joint_names:
            raise ValueError(
                f"{recording.path}: {name} is no joint of {hand.name} "
                f"({', '.join(hand.joint_names)}); name the hand that was recorded"
            )
    if (hand.mimic >= 0).any():
        raise ValueError(
            f"{hand.name}: some joints follow others, which the gap workflow does not model"
        )
    found = []
    for finger in hand.fingers:
        joints = hand.joint_names[finger]
        if not {*joints}.isdisjoint(recording.joints):
            found.append(_finger(recording, hand, finger, p_gain))
    return found


def load_of(conditions: dict[str, float | str]) -> Load | None:
    """The load of a trajectory, if its conditions say it."""
    if "payload_kg" not in conditions or "arm_length_m" not in conditions:
        return None
    return Load(float(conditions["payload_kg"]), float(conditions["arm_length_m"]))


def _bare(recording: Recording, column: int, p_gain: float | None) -> Chain:
    """One joint that is its own inertia, its torques in the unit in which its stiffness is told."""
    row = np.array(neutral_row())
    told = known_stiffness(recording, recording.joints[column])
    unit = 1.0 if told is None else told / BASELINE[0].typical
    for parameter in BASELINE:
        row[parameter.column] = parameter.typical * (unit if parameter.of_torque else 1.0)
    free = [parameter.name for parameter in BASELINE]
    if all(t.enabled[:, column].all() for t in recording.trajectories):
        free.remove("kd_off")  # nothing shows it
    load = None
    if recording.model == "pendulum":
        free.append("tau_g_nm")
        for trajectory in recording.trajectories:
            own = load_of(trajectory.conditions)
            if own and (load is None or own.torque > load.torque):
                load = own
    if load:
        row[servo.GRAVITY_TORQUE] = load.torque
        row[servo.INERTIA] += load.inertia
    return Chain(
        name=recording.joints[column],
        joints=(recording.joints[column],),
        columns=np.array([column]),
        baseline_free=tuple(free),
        start_row=row[None],
        slot=np.zeros(1, int),
        reference_p_gain=p_gain,
        reference_load=load,
    )


def _finger(recording: Recording, hand: HandModel, finger: slice, p_gain: float | None) -> Chain:
    """A finger's bodies with all joints at zero.

    What an unrecorded joint carries is fixed to its parent.
    """
    names = []
    columns = []
    slots = []
    for slot, name in enumerate(hand.joint_names[finger]):
        if name in recording.joints:
            names.append(name)
            columns.append(recording.joints.index(name))
            slots.append(slot)
    joints = finger.start + np.array(slots)
    n = len(slots)
    poses = hand.forward_kinematics(np.zeros(hand.num_joints))
    parents = poses[hand.joint_parent[joints]]
    frames = hand.joint_parent_frame[joints]
    turns = Rotation.from_quat(parents[:, 3:])
    own = Rotation.from_quat(poses[:, 3:])
    origins = parents[:, :3] + turns.apply(frames[:, :3])
    centres = poses[:, :3] + own.apply(hand.link_com)
    matrices = own.as_matrix()
    turned = matrices @ hand.link_inertia @ matrices.transpose(0, 2, 1)
    mass = np.zeros(n)
    com = np.zeros((n, 3))
    inertia = np.zeros((n, 3, 3))
    for i, (first, end) in enumerate(pairwise([*joints, finger.stop])):
        links = hand.joint_child[first:end]
        masses = hand.link_mass[links]
        mass[i] = masses.sum()
        centre = masses @ centres[links] / mass[i]
        com[i] = centre - origins[i]
        arms = centres[links] - centre
        spread = masses * arms.T @ arms
        inertia[i] = turned[links].sum(axis=0) + np.trace(spread) * np.eye(3) - spread
    rows = np.tile(neutral_row(), (n, 1))
    rows[:, servo.KP] = hand.kp[joints]
    rows[:, servo.KD] = hand.kd[joints]
    rows[:, servo.VELOCITY_LIMIT] = hand.velocity_limit[joints]
    rows[:, servo.INERTIA] = hand.armature[joints]
    return Chain(
        name=names[0].partition("_")[0],
        joints=tuple(names),
        columns=np.array(columns),
        baseline_free=("kp", "kd", "velocity_limit"),
        start_row=rows,
        slot=np.array(slots),
        bodies=True,
        axis=(turns * Rotation.from_quat(frames[:, 3:])).apply(hand.joint_axis[joints]),
        offset=np.diff(origins, axis=0, prepend=np.zeros((1, 3))),
        mass=mass,
        com=com,
        inertia=inertia,
        gravity=GRAVITY_M_S2 * hand.down,
        lower=hand.lower[joints],
        upper=hand.upper[joints],
        effort=hand.effort[joints],
        reference_p_gain=p_gain,
    )


def known_stiffness(recording: Recording, joint: str) -> float | None:
    """Stiffness of a joint's drive at the largest P gain recorded [N m/rad], if the recording tells it.

    Commands and positions of a bare servo, or of a pendulum whose load is not known, show torques
    up to one common factor. The fit holds the stiffness, at a nominal value unless it is told.
    """
    told = recording.servo.get(STIFFNESS)
    value = told.get(joint) if isinstance(told, Mapping) else told
    return None if value is None else float(value)


def relative_torques(recording: Recording) -> bool:
    """Whether nothing tells how large the torques of a recording are.

    They have a unit of their own.
    """
    if recording.model not in BARE_MODELS:
        return False
    if recording.model == "pendulum" and any(load_of(t.conditions) for t in recording.trajectories):
        return False
    return any(known_stiffness(recording, joint) is None for joint in recording.joints)


def others_in(chain: Chain, joint: int) -> list[int]:
    """Slots of the other joints of a chain, whose motion can drive a joint."""
    return np.delete(chain.slot, joint).tolist()
