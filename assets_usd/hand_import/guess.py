"""What a source does not say and a hand has.

Fingertips, palm, gains, start pose, mount and workspace.

Every guess is a note that begins with "guess:" and names the entry of the description that
overrides it.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import Workspace, compose, placed, pose_at
from vd.assets_usd.hand_import.description import Description, Place
from vd.assets_usd.hand_import.source import Joint, Link
from vd.assets_usd.hand_import.tree import Tree, shape_box

FULL_TORQUE_RAD = 0.3
"""Error at which a guessed gain reaches the torque limit: of a small servo's position mode."""
SPEED_RAD_S = 8.0
ARMATURE_KG_M2 = 0.001
"""Of a Dynamixel of 50 g."""
BENT = 0.5
"""Share of the wider side of its range by which each joint bends to find the palm."""
TOGETHER = 0.5
"""Share of their ways that fingers go together when they bend; less, and they close like a claw."""
SNAP_RAD = 0.5
"""A direction within this of an axis of the base is that axis."""
GROUND_M = 0.05
"""Height of the lowest collider above the ground."""
SIZES = (0.35, 0.8)
"""Smallest and largest object for the mean length of the fingers."""
DROP_M = 0.01
"""Height of the drop point over the goal."""


@dataclass
class Stance:
    """Where a hand is and what it does there."""

    tips: list[np.ndarray]
    """Fingertip in the last link of each finger [7]."""
    start: np.ndarray
    """Angles at the start [D] [rad]."""
    palm: np.ndarray
    """Where the palm looks, base frame [3]."""
    mount: np.ndarray
    """Pose of the base in the world [7]."""
    workspace: Workspace


def take_stance(tree: Tree, said: Description) -> Stance:
    """Complete a hand by what is described, or else by guesses, which go into its notes."""
    tips = _tips(tree)
    start = _start(tree, said)
    _complete_drives(tree, start)
    palm = _palm(tree, tips, said)
    mount, workspace = stand(tree, tips, start, palm, said)
    return Stance(tips, start, palm, mount, workspace)


def stand(
    tree: Tree, tips: list[np.ndarray], start: np.ndarray, palm: np.ndarray, said: Description
) -> tuple[np.ndarray, Workspace]:
    """Mount and workspace of a hand at a start [D]; what is guessed goes into the tree's notes."""
    ends = roots(tree), tip_points(tree, tips, start)
    if said.mount is not None:
        quaternion = np.array(said.mount.quaternion) / np.linalg.norm(said.mount.quaternion)
        mount = np.array([*said.mount.position, *quaternion])
    else:
        mount = _mount(tree, ends, start, palm)
        tree.notes.append(f"guess: mounted palm up at {_text(mount)} (mount)")
    return mount, _workspace(tree, ends, palm, mount, said.workspace)


def _text(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{round(float(v), 3) + 0.0:g}" for v in values) + ")"


def _complete_drives(tree: Tree, start: np.ndarray) -> None:
    """Gains, speed and inertia of the drives, where neither file nor description has them."""
    for joint in tree.joints:
        if joint.mimic is not None:
            leader = tree.joints[tree.leader(joint)]
            leader.damping += joint.mimic[1] ** 2 * joint.damping
            joint.effort = joint.effort if joint.effort > 0.0 else leader.effort
            joint.kp = joint.kd = joint.damping = 0.0
    _fill(tree, "velocity", [SPEED_RAD_S] * len(tree.joints))
    _fill(tree, "armature", [ARMATURE_KG_M2] * len(tree.joints))
    _fill(tree, "kp", [joint.effort / FULL_TORQUE_RAD for joint in tree.joints])
    damping = []
    for joint, critical in zip(tree.joints, critical_damping(tree, start), strict=True):
        damping.append(max(critical, joint.damping))
        joint.kd += joint.damping
    _fill(tree, "kd", damping)


def _fill(tree: Tree, field: str, values: list[float]) -> None:
    """Give the drives that lack a number the one that is guessed, which a note says."""
    guessed = []
    for joint, value in zip(tree.joints, values, strict=True):
        if math.isnan(getattr(joint, field)):
            setattr(joint, field, value)
            guessed.append(value)
    if guessed:
        span = " to ".join(dict.fromkeys(f"{end:.3g}" for end in (min(guessed), max(guessed))))
        tree.notes.append(f"guess: {field} = {span} of {len(guessed)} joints (drive, drives)")


def critical_damping(tree: Tree, q: np.ndarray) -> np.ndarray:
    """Damping with which the drives just do not swing at angles [D] [rad], 0 of what follows.

    Each turns its rotor, the links beyond it and what follows it, while other joints stand still.

    Returns:
        Damping of each drive [D] [N m s/rad].
    """
    moves = np.eye(len(tree.joints))
    mass = _mass_matrix(tree, q)
    kp = np.zeros(len(tree.joints))
    for i, joint in enumerate(tree.joints):
        mass[i, i] += joint.armature
        kp[i] = joint.kp
        if joint.mimic is not None:
            moves[i, i] = 0.0
            moves[i, tree.leader(joint)] = joint.mimic[1]
    return np.asarray(2.0 * np.sqrt(kp * (mass @ moves * moves).sum(axis=0)))


def _mass_matrix(tree: Tree, q: np.ndarray) -> np.ndarray:
    """Of the links, without rotors, at angles [D] [rad]: [D, D] [kg m^2]."""
    poses = tree.forward_kinematics(q)
    total = np.zeros((len(q), len(q)))
    for last, (link, pose) in enumerate(zip(tree.links[1:], poses[1:], strict=True)):
        turn = Rotation.from_quat(pose[3:]).as_matrix()
        com = pose[:3] + turn @ link.com
        linear = np.zeros((3, len(q)))
        angular = np.zeros((3, len(q)))
        number = last
        while number >= 0:
            joint = tree.joints[number]
            frame = compose(poses[joint.parent], joint.parent_frame)
            axis = Rotation.from_quat(frame[3:]).apply(joint.axis)
            angular[:, number] = axis
            linear[:, number] = np.cross(axis, com - frame[:3])
            number = joint.parent - 1
        total += link.mass * linear.T @ linear
        total += angular.T @ turn @ link.inertia @ turn.T @ angular
    return total


def _tips(tree: Tree) -> list[np.ndarray]:
    """Fingertips; of fingers without a mark the middle of an end of a box, farthest from the last joint."""
    tips = []
    for joints, marked in zip(tree.fingers, tree.tips, strict=True):
        if marked is None:
            link = tree.links[joints.stop]
            marked = pose_at(_farthest(link, tree.joints[joints[-1]]))
            where = _text(marked[:3])
            tree.notes.append(
                f"guess: the tip of {link.name} is at {where}, what is farthest (tips)"
            )
        tips.append(marked)
    return tips


def _farthest(link: Link, joint: Joint) -> np.ndarray:
    """The middle of the end of a link that is farthest from its joint [3]."""
    root = joint.child_frame[:3]
    shapes = link.colliders or link.shapes
    if not shapes:
        return np.asarray(2.0 * link.com - root)
    ends = []
    for shape in shapes:
        pose, half = shape_box(shape)
        ends.append(placed(pose, np.concatenate([np.diag(half), -np.diag(half)])))
    points = np.concatenate(ends)
    return np.asarray(points[np.argmax(np.linalg.norm(points - root, axis=1))])


def _start(tree: Tree, said: Description) -> np.ndarray:
    """The pose that is described; elsewhere open: zero, or the limit nearest to it."""
    lower, upper = _limits(tree)
    angles = np.clip(0.0, lower, upper)
    for i, joint in enumerate(tree.joints):
        angles[i] = said.start.get(joint.name, angles[i])
    if not said.start:
        tree.notes.append(
            "guess: starts with all joints at zero, or their limit nearest to it (start)"
        )
    return np.clip(tree.followed(angles), lower, upper)


def _limits(tree: Tree) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper limits [D] [rad] each."""
    lower = np.array([joint.lower for joint in tree.joints])
    upper = np.array([joint.upper for joint in tree.joints])
    return lower, upper


def tip_points(tree: Tree, tips: list[np.ndarray], q: np.ndarray) -> np.ndarray:
    """Fingertips in the base [F, 3]."""
    poses = tree.forward_kinematics(q)
    last = [joints.stop for joints in tree.fingers]
    return compose(poses[last], np.stack(tips))[:, :3]


def roots(tree: Tree) -> np.ndarray:
    """First joints of the fingers in the base [F, 3]."""
    return np.stack([tree.joints[joints[0]].parent_frame[:3] for joints in tree.fingers])


def bent(tree: Tree, share: float | np.ndarray) -> np.ndarray:
    """Angles [D] [rad] of an open hand whose joints go a share of their way to the wider side.

    The share is one, or that of each finger [F]. Joints with as much way to both sides move fingers
    sideways, and stay.
    """
    lower, upper = _limits(tree)
    open_q = np.clip(0.0, lower, upper)
    wider = np.where(np.abs(upper) > np.abs(lower), upper, lower)
    one_sided = np.abs(lower + upper) > 0.2 * (upper - lower)
    share = np.repeat(np.broadcast_to(share, len(tree.fingers)), list(map(len, tree.fingers)))
    angles = tree.followed(np.where(one_sided, open_q + share * (wider - open_q), open_q))
    return np.clip(angles, lower, upper)


def _palm(tree: Tree, tips: list[np.ndarray], said: Description) -> np.ndarray:
    """Where the palm looks: where the fingertips go when fingers bend.

    Of a claw, where fingers point.
    """
    if said.palm is not None:
        return np.array(said.palm) / np.linalg.norm(said.palm)
    opened = tip_points(tree, tips, bent(tree, 0.0))
    along = opened - roots(tree)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    ways = tip_points(tree, tips, bent(tree, BENT)) - opened
    ways -= np.sum(ways * along, axis=1, keepdims=True) * along
    length = np.linalg.norm(ways, axis=1).mean()
    palm = ways.mean(axis=0)
    reason = "where the tips go when the fingers bend"
    if length < 1e-4 or np.linalg.norm(palm) < TOGETHER * length:
        palm = along.mean(axis=0)
        reason = "where the fingers point, as of a claw"
    palm = _snapped(palm / np.linalg.norm(palm))
    tree.notes.append(f"guess: the palm looks along {_text(palm)} of the base, {reason} (palm)")
    return palm


def _snapped(direction: np.ndarray) -> np.ndarray:
    """The axis of the base that is near to a direction [3], or the direction."""
    axis = np.argmax(np.abs(direction))
    nearest = np.eye(3)[axis] * np.sign(direction[axis])
    return nearest if np.arccos(np.clip(direction @ nearest, -1.0, 1.0)) < SNAP_RAD else direction


Ends = tuple[np.ndarray, np.ndarray]
"""Roots of the fingers, and their tips at the start, in the base [F, 3] each."""


def _mount(tree: Tree, ends: Ends, start: np.ndarray, palm: np.ndarray) -> np.ndarray:
    """Palm up, fingers towards +x, above the ground, with the middle of the hand above the origin."""
    forward = (ends[1] - ends[0]).mean(axis=0)
    forward -= (forward @ palm) * palm
    if np.linalg.norm(forward) < 0.01:
        forward = np.eye(3)[np.argmin(np.abs(palm))]
        forward -= (forward @ palm) * palm
    forward = _snapped(forward / np.linalg.norm(forward))
    forward -= (forward @ palm) * palm
    forward /= np.linalg.norm(forward)
    turn = Rotation.from_matrix(np.stack([forward, np.cross(palm, forward), palm]))
    down = turn.inv().apply([0.0, 0.0, -1.0])
    lowest = math.inf
    for link, pose in zip(tree.links, tree.forward_kinematics(start), strict=True):
        for shape in link.colliders:
            box, half = shape_box(shape)
            lowest = min(lowest, -_reach(down, compose(pose, box), half))
    middle = turn.apply(_middle(ends))
    return np.array([-middle[0], -middle[1], GROUND_M - lowest, *turn.as_quat()])


def _middle(ends: Ends) -> np.ndarray:
    """The middle between the roots of the fingers and their tips [3]."""
    return np.asarray((ends[0].mean(axis=0) + ends[1].mean(axis=0)) / 2.0)


def _reach(direction: np.ndarray, pose: np.ndarray, half: np.ndarray) -> float:
    """How far a box reaches along a direction [3] from the origin of its pose's frame."""
    axes = Rotation.from_quat(pose[3:]).as_matrix()
    return float(direction @ pose[:3] + np.abs(direction @ axes) @ half)


def _workspace(
    tree: Tree, ends: Ends, palm: np.ndarray, mount: np.ndarray, said: Place
) -> Workspace:
    """Over the palm, in the middle of roots and tips, half an object away from what collides there."""
    reach = float(np.linalg.norm(ends[1] - ends[0], axis=1).mean())
    size = said.size or (SIZES[0] * reach, SIZES[1] * reach)
    middle = _middle(ends)
    tops = [_reach(palm, *shape_box(shape)) for shape in tree.links[0].colliders]
    above = max(max(tops, default=0.0) + 0.5 * float(np.mean(size)) - palm @ middle, 0.0)
    goal = placed(mount, middle + above * palm)
    x, y, z = said.goal or map(float, goal)
    drop = said.drop or (x, y, z + DROP_M)
    fall = said.fall or reach  # the mean length of the fingers
    for name, value in {"drop": drop, "goal": (x, y, z), "size": size, "fall": (fall,)}.items():
        if getattr(said, name) is None:
            tree.notes.append(f"guess: {name} {_text(np.array(value))} m (workspace)")
    return Workspace(drop, (x, y, z), fall, size)
