"""The symmetry frames of a hand and an observation: what they are made of, without a simulator.

How they are used: :mod:`vd.envs.symmetry` and :mod:`vd.geometry.frame_maps`.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import HandModel, compose
from vd.envs.cfg import ObservationCfg, View
from vd.envs.parts import observation_parts
from vd.kernels.task.dynamics import JOINT_CHANNELS, SCALARS
from vd.kernels.task.observations import FINGERTIP_VALUES, teacher_observation_slices
from vd.kernels.task.shapes import extent_directions, shape_observation_slices

TERMS = 4
"""Most values that a turned value is made of: those of a quaternion."""
TOLERANCE_M = 1e-4
"""Farthest that a turned fingertip may be from the one whose place it takes; of a mirrored one's
axes likewise."""
SECTOR = np.array([1.0, 0.0, 0.0])
"""Frames turn the axis of the wanted rotation near to this direction, world frame; any would do."""
UP = np.array([0.0, 0.0, 10.0])
"""Added to it where there are mirrors, so that up counts before the sector does: seen from above,
wanted rotations are counter-clockwise, but for axes within 2 degrees of level (ours)."""
MIRROR_SIGNS = np.array([-1.0, 1.0, 1.0])
"""Factors on the angles of a finger in the mirror: it swings to the other side, and bends as
before. The first joint is the one that swings (hand's description, joint order)."""
OBJECT_MIRROR = np.diag([1.0, -1.0, 1.0])
"""What is mirrored has left-handed axes; its y axis is turned round, of fingertips and objects
alike.
"""
BENT = np.array([0.3, 0.5, -0.4])
"""Angles [rad] of every finger, far from zero, at which a hand has to be its own mirror image
(ours).
"""


@dataclass(frozen=True)
class SymmetryFrames:
    """The V symmetry frames of a hand: one for each finger, and as many in the mirror, if any."""

    source: np.ndarray
    """Values of the world frame that make each value of a frame, int [V, O, T]."""
    factor: np.ndarray
    """Their factors [V, O, T]."""
    offset: np.ndarray
    """What is added to their sum [V, O]: limits about which a joint is observed may be uneven."""
    joints: np.ndarray
    """Joint of the frame that is each joint of the world, int [V, D]."""
    sign: np.ndarray
    """-1 where that joint turns the other way, else 1 [V, D]."""
    sector: np.ndarray
    """The direction near which a frame has the axis of the wanted rotation, as it is in the world
    [V, 3].
    """
    turn: np.ndarray
    """Turn or reflection of the world that makes each [V, 3, 3]."""


def symmetry_frames(hand: HandModel, observation: ObservationCfg, view: View) -> SymmetryFrames:
    """The symmetry frames of a hand and an observation.

    Args:
        hand: The hand.
        observation: What is observed.
        view: What goals are seen in (``ObservationCfg.view``); frames in the mirror come after the
            others.

    Raises:
        ValueError: The fingers are not spaced evenly about the vertical, or the hand is not its own
            mirror image, or has joints that follow others.
    """
    if len(hand.actuated) < hand.num_joints:
        raise ValueError(f"joints of {hand.name} follow others; set observation.view to world")
    fingers = hand.num_fingers
    each = hand.joints_per_finger
    tips = _tips(hand, np.zeros(each))
    turns = [_turn(step, fingers) for step in range(fingers)]
    if view == "mirrored":
        mirror = _mirror(hand, tips)
        turns += [turn @ mirror for turn in turns]
    direction = SECTOR + UP if view == "mirrored" else SECTOR
    maps = np.stack([_observation_map(observation, tips, each, turn) for turn in turns])
    source = np.argsort(-np.abs(maps), axis=2, kind="stable")[:, :, :TERMS]
    order = [_joint_source(_finger_source(tips, turn.T), each) for turn in turns]
    return SymmetryFrames(
        source=source,
        factor=np.take_along_axis(maps, source, axis=2),
        offset=np.stack([_observation_offset(hand, observation, turn) for turn in turns]),
        joints=np.stack(order),
        sign=np.stack([_joint_signs(turn, fingers, each) for turn in turns]),
        # An axis of rotation looks the other way in a mirror.
        sector=np.stack([np.linalg.det(turn) * turn.T @ direction for turn in turns]),
        turn=np.stack(turns),
    )


def _tips(hand: HandModel, angles: np.ndarray) -> np.ndarray:
    """Fingertip poses in the world frame with these angles [3] in all fingers [F, 7]."""
    return compose(hand.mount, hand.tip_poses(np.tile(angles, hand.num_fingers)))


def _turn(step: int, fingers: int) -> np.ndarray:
    """Turn about the vertical by ``step`` of so many fingers [3, 3]."""
    return Rotation.from_euler("z", 2.0 * np.pi * step / fingers).as_matrix()


def _mirror(hand: HandModel, tips: np.ndarray) -> np.ndarray:
    """Reflection [3, 3] in the vertical plane through the first fingertip and the hand's axis.

    Raises:
        ValueError: The hand is not its own mirror image in it.
    """
    across = np.array([-tips[0, 1], tips[0, 0], 0.0]) / np.linalg.norm(tips[0, :2])
    mirror = np.eye(3) - 2.0 * np.outer(across, across)
    refusal = f"{hand.name} is not its own mirror image; set observation.view to goal"
    if hand.joints_per_finger != len(MIRROR_SIGNS):
        raise ValueError(refusal)
    try:
        source = _finger_source(tips, mirror)
    except ValueError as error:
        raise ValueError(refusal) from error
    bent = _tips(hand, BENT)[source]
    opposite = _tips(hand, MIRROR_SIGNS * BENT)
    apart = np.linalg.norm(bent[:, :3] @ mirror.T - opposite[:, :3], axis=1)
    axes = Rotation.from_quat(bent[:, 3:]).as_matrix()
    twisted = np.abs(
        mirror @ axes @ OBJECT_MIRROR - Rotation.from_quat(opposite[:, 3:]).as_matrix()
    )
    if max(apart.max(), twisted.max()) > TOLERANCE_M:
        raise ValueError(refusal)
    return mirror


def _finger_source(tips: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """The finger that takes the place of each after a turn or reflection ``turn`` [3, 3] of the hand [F]."""
    turned = tips[:, :3] @ turn.T
    distance = np.linalg.norm(turned[:, None] - tips[None, :, :3], axis=2)
    source = np.argmin(distance, axis=0)
    if sorted(source) != list(range(len(tips))) or distance.min(axis=0).max() > TOLERANCE_M:
        raise ValueError(
            "the fingers of this hand are not spaced evenly about the vertical; set "
            "observation.view to world"
        )
    return source


def _joint_source(fingers: np.ndarray, each: int) -> np.ndarray:
    """Joints of the fingers with so many ``each``, in their order [D]."""
    return (each * fingers[:, None] + np.arange(each)).ravel()


def _joint_signs(turn: np.ndarray, fingers: int, each: int) -> np.ndarray:
    """Factors on joints in a frame [D]."""
    return np.tile(MIRROR_SIGNS if np.linalg.det(turn) < 0.0 else np.ones(each), fingers)


def _observation_offset(
    hand: HandModel, observation: ObservationCfg, turn: np.ndarray
) -> np.ndarray:
    """What is added in a frame to what :func:`_observation_map` makes [A].

    An angle is observed as it lies between its limits, from -1 to 1; of one that is turned round
    these are the limits of the other side.
    """
    parts = observation_parts(observation, hand.num_fingers, hand.num_joints)
    offset = np.zeros(max(columns.stop for columns in parts.values()))
    lower = np.asarray(hand.lower)
    upper = np.asarray(hand.upper)
    turned_round = _joint_signs(turn, hand.num_fingers, hand.joints_per_finger) < 0.0
    columns = teacher_observation_slices(hand.num_fingers, hand.num_joints)["joint_position"]
    for part in {"state", "present"} & parts.keys():
        offset[parts[part]][columns] = np.where(
            turned_round, -2.0 * (upper + lower) / (upper - lower), 0.0
        )
    return offset


def _observation_map(
    observation: ObservationCfg, tips: np.ndarray, each: int, turn: np.ndarray
) -> np.ndarray:
    """Matrix [A, A] from an observation in the world frame to that of a frame.

    Args:
        observation: What is observed.
        tips: Fingertip poses with all angles zero, shape [F, 7].
        each: Joints of each finger.
        turn: Turn or reflection [3, 3] of the world that makes the frame.
    """
    count = len(tips)
    fingers = _finger_source(tips, turn)
    parts = observation_parts(observation, count, each * count)
    quaternion = _orientation_map(turn)
    axial = np.linalg.det(turn) * turn  # rotations look the other way in a mirror
    conjugation = np.eye(4)
    conjugation[:3, :3] = axial
    order = _joint_source(fingers, each)
    joints = _joint_signs(turn, count, each)[:, None] * np.eye(each * count)[order]
    tip_blocks = np.zeros((count, FINGERTIP_VALUES, count, FINGERTIP_VALUES))
    for finger, old in enumerate(fingers):
        # q and -q are the same orientation, but a fingertip never shows the other one.
        sign = np.sign(tips[finger, 3:] @ quaternion @ tips[old, 3:])
        for begin, block in ((0, turn), (3, sign * quaternion), (7, turn), (10, axial)):
            end = begin + len(block)
            tip_blocks[finger, begin:end, old, begin:end] = block
    blocks = {
        "joint_position": joints,
        "joint_velocity": joints,
        "object_position": turn,
        "object_orientation": quaternion,
        "object_velocity": turn,
        "object_spin": axial,
        "goal_orientation": quaternion,
        "relative_orientation": conjugation,
        "fingertips": tip_blocks.reshape(count * FINGERTIP_VALUES, -1),
        "previous_action": joints,
    }
    slices = teacher_observation_slices(count, each * count)
    if "shape" in parts:
        directions = np.array(extent_directions(count))
        back = directions @ turn
        same = np.argmin(np.linalg.norm(back[:, None] - directions[None], axis=2), axis=1)
        extents = np.eye(len(directions))[same]
        blocks |= {
            "surface": np.kron(np.eye(count)[fingers], turn),
            "extent": extents,
            "goal_extent": extents,
        }
        first = parts["shape"].start
        for name, columns in shape_observation_slices(count).items():
            slices[name] = slice(first + columns.start, first + columns.stop)
    blocks["dynamics"] = block_diag(
        np.kron(np.eye(JOINT_CHANNELS), np.abs(joints)), np.eye(SCALARS)
    )
    for name in ("terms", "critic_terms"):  # own values, of which nobody here knows how they turn
        blocks[name] = np.eye(sum(getattr(observation, name).values()))
    slices |= {name: columns for name, columns in parts.items() if name in blocks}
    size = max(columns.stop for columns in parts.values())
    matrix = np.zeros((size, size))
    for name, columns in slices.items():
        matrix[columns, columns] = blocks[name]
    if "present" in parts:
        again = parts["present"]
        seen = slice(again.stop - again.start)
        matrix[again, again] = matrix[seen, seen]
    matrix[np.abs(matrix) < np.finfo(np.float32).eps] = 0.0
    return matrix


def _orientation_map(turn: np.ndarray) -> np.ndarray:
    """Matrix [4, 4] from an orientation R, a quaternion xyzw, to ``turn`` R, in a mirror ``turn`` R M."""
    if np.linalg.det(turn) > 0.0:
        return _left_product(Rotation.from_matrix(turn).as_quat())
    # turn R M = (turn M)(M R M), M = OBJECT_MIRROR: M R M turns about the mirrored axis, the other
    # way.
    mirrored = np.diag([*-np.diag(OBJECT_MIRROR), 1.0])
    return _left_product(Rotation.from_matrix(turn @ OBJECT_MIRROR).as_quat()) @ mirrored


def _left_product(q: np.ndarray) -> np.ndarray:
    """Matrix [4, 4] of the product q * p of quaternions xyzw."""
    x, y, z, w = q
    return np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])
