"""A source welded to what a hand is: a base and fingers, each a chain of revolute joints."""

import math
from collections import Counter, defaultdict
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import HandError, compose, invert, placed, pose_at
from vd.assets_usd.hand_import.description import Description, Drive
from vd.assets_usd.hand_import.source import IDENTITY, Joint, Link, Shape, Source, lead
from vd.assets_usd.objects.geometry import Solid, hull_volume, joined, mesh_volume
from vd.kernels.servo.actuators import MAX_JOINTS

KINDS = ("box", "sphere", "capsule", "cylinder", "mesh", "ellipsoid")
"""What collides."""
MOST_WRIST = 3
"""Most joints before the fingers that are held without being asked: more are an arm."""
MOST_RAD = 2.0 * math.pi + 0.01
"""Limits beyond a turn are in degrees, or none."""
SLACK_RAD = 1e-3
"""By which a described angle may be rounded beyond a limit."""
LEAST_M = 0.0005
MOST_M = 1.0
"""Lengths of shapes between which they are those of a hand in metres."""
HOLLOW = 1.5
"""Volume of a hull over that of its mesh from which it closes a hollow that may matter."""
DENSITY_KG_M3 = 1000.0
"""Of the colliders of a link whose mass is not said: plastic."""


@dataclass
class Tree:
    """A hand in its own order: ``base`` first, then the fingers from the palm.

    D joints, D + 1 links.
    """

    source: str
    """File that it was read from, for people."""
    links: list[Link]
    """Welded; of each the frame is that of the source's link that moves."""
    joints: list[Joint] = field(default_factory=list)
    """Parents and children count in ``links``; joint i moves link i + 1."""
    fingers: list[range] = field(default_factory=list)
    """Joints of each finger."""
    tips: list[np.ndarray | None] = field(default_factory=list)
    """Fingertip in the last link of each finger [7], where the source marks one."""
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def names(self) -> list[str]:
        """Of the joints in the source; those of copies are there more than once."""
        return [joint.name for joint in self.joints]

    def leader(self, joint: Joint) -> int:
        """Number of the joint that one follows, or -1."""
        return -1 if joint.mimic is None else self.names.index(joint.mimic[0])

    def forward_kinematics(self, q: np.ndarray) -> np.ndarray:
        """Poses of all links in the base [L, 7] for joint angles [D] [rad]."""
        poses = [IDENTITY]
        for joint, angle in zip(self.joints, q, strict=True):
            poses.append(compose(poses[joint.parent], joint_pose(joint, angle)))
        return np.stack(poses)

    def followed(self, q: np.ndarray) -> np.ndarray:
        """Angles with those joints where they are led that follow others [D]."""
        q = q.copy()
        for i, joint in enumerate(self.joints):
            if joint.mimic is not None:
                _, factor, offset = joint.mimic
                q[i] = factor * q[self.leader(joint)] + offset
        return q


def joint_pose(joint: Joint, angle: float) -> np.ndarray:
    """Pose of a joint's child in its parent [7]."""
    turn = np.concatenate([np.zeros(3), Rotation.from_rotvec(angle * joint.axis).as_quat()])
    return compose(compose(joint.parent_frame, turn), invert(joint.child_frame))


def grow(source: Source, said: Description) -> Tree:
    """Weld a source to a hand.

    Raises:
        HandError: Everything that stands against it, each with a remedy.
    """
    return _Grower(source, said).grow()


class _Grower:
    """One source; problems are collected and raised together."""

    def __init__(self, source: Source, said: Description):
        self.source = source
        self.said = said
        self.notes = list(source.notes)
        self.problems = list(source.problems)
        self.warnings: list[str] = []
        self.by_name = {joint.name: joint for joint in source.joints}
        self.out: dict[int, list[Joint]] = defaultdict(list)
        self.above: dict[int, Joint] = {}
        for joint in source.joints:
            self.out[joint.parent].append(joint)
            self.above[joint.child] = joint
        self.held: dict[str, float] = dict(said.hold)
        self.raised: list[str] = []
        self.hollow: dict[str, float] = {}

    def fail(self) -> None:
        """Raise what was found, if anything."""
        if self.problems:
            text = "\n  - ".join(dict.fromkeys(self.problems))
            raise HandError(f"{self.source.path}: cannot be imported:\n  - {text}")

    def grow(self) -> Tree:
        self._check_names()
        self.fail()
        self._take_mimic()
        self._take_actuators()
        self._take_said()
        base, starts = self._palm()
        self.fail()
        chains: list[list[Joint]] = []
        for start in starts:
            chains += self._chains(start)
        copies = Counter(joint.name for chain in chains for joint in chain)
        tree = Tree(self.source.path.name, [self._welded(base)], notes=self.notes)
        tree.warnings = self.warnings
        for chain in chains:
            self._add_finger(tree, chain, copies)
        self.fail()
        if self.raised:
            self.notes.append(
                f"no body has the moments of inertia of {', '.join(self.raised)}; the smaller are "
                f"raised"
            )
        if self.hollow:
            self.notes.append(
                f"guess: meshes of {', '.join(self.hollow)} collide as their hulls, up to "
                f"{max(self.hollow.values()):.1f} times their volume; split them in the file"
            )
        self._check_followers(tree)
        self._check_numbers(tree)
        self.fail()
        return tree

    def _add_finger(self, tree: Tree, chain: list[Joint], copies: Counter[str]) -> None:
        """Put the joints of a finger into a tree, and the links that they move."""
        tree.fingers.append(range(len(tree.joints), len(tree.joints) + len(chain)))
        if len(chain) > MAX_JOINTS:
            self.problems.append(
                f"the finger of {chain[0].name} has {len(chain)} joints; hold some of them"
            )
        parent = 0
        for joint in chain:
            offset = self._group(self._first(joint.parent))[joint.parent]
            place = compose(offset, joint.parent_frame)
            child = len(tree.links)
            tree.joints.append(replace(joint, parent=parent, child=child, parent_frame=place))
            parent = child
            link = self._welded(joint.child)
            link.mass /= copies[joint.name]
            link.inertia = link.inertia / copies[joint.name]
            if any(link.name == other.name for other in tree.links):
                link.shapes = []  # they are of the finger before
            tree.links.append(link)
        tree.tips.append(self._tip(chain[-1].child))

    def _check_names(self) -> None:
        joints = [joint.name for joint in self.source.joints if joint.kind != "fixed"]
        links = [link.name for link in self.source.links]
        entries = dict.fromkeys(("hold", "mimic", "limits", "drives", "start", "motors"), "joint")
        entries |= dict.fromkeys(("mass", "tips"), "link")
        for entry, kind in entries.items():
            known = joints if kind == "joint" else links
            for name in getattr(self.said, entry):
                if name not in known:
                    there = ", ".join(known)
                    self.problems.append(f"{entry}: there is no {kind} {name}; there are {there}")

    def _take_mimic(self) -> None:
        """What follows what, by the description or the file."""
        for joint in self.source.joints:
            if joint.name in self.said.mimic:
                follow = self.said.mimic[joint.name]
                joint.mimic = follow.joint, follow.factor, follow.offset_rad
        for name in self.held:
            leader = lead(self.by_name, name)[0]
            if leader not in self.held:
                self.warnings.append(
                    f"{name} follows {leader} in the file, and is held: what it carries is off "
                    f"where {leader} moves; leave it out of hold"
                )

    def _take_actuators(self) -> None:
        """Gains and torque limits of joints, of those that others follow with what moves these."""
        limits = {name: joint.effort for name, joint in self.by_name.items()}
        efforts: dict[str, float] = {}
        for actuator in self.source.actuators:
            ratios: dict[str, float] = defaultdict(float)
            torques: dict[str, float] = defaultdict(float)
            free: dict[str, str] = {}
            for name, ratio in actuator.ratios.items():
                leader, factor, _ = lead(self.by_name, name)
                if leader not in self.by_name or name in self.held or leader in self.held:
                    continue
                torque = np.copysign(np.fmin(actuator.effort * abs(ratio), limits[name]), ratio)
                ratios[leader] += factor * ratio
                torques[leader] += factor * torque
                free.setdefault(leader, name)
            if len(ratios) > 1:
                first, *rest = free.values()
                lines = ", ".join(f"{name}: {{joint: {first}}}" for name in rest)
                self.problems.append(
                    f"the tendon {actuator.name} moves {', '.join(free.values())} together, which "
                    f"no drive of a joint does; say mimic: {{{lines}}}, or hold: {{{rest[0]}: 0}}"
                )
            for name, ratio in ratios.items():
                efforts[name] = float(np.fmin(abs(torques[name]), efforts.get(name, math.nan)))
                if actuator.kp > 0.0:
                    joint = self.by_name[name]
                    joint.kp = float(np.nansum([joint.kp, actuator.kp * ratio**2]))
                    joint.kd = float(np.nansum([joint.kd, actuator.kd * ratio**2]))
                    if joint.kd + joint.damping == 0.0:
                        joint.kd = math.nan  # nothing says it
        for name, effort in efforts.items():
            self.by_name[name].effort = effort

    def _take_said(self) -> None:
        """Put what the description says of joints and links into the source."""
        said = self.said
        for joint in self.source.joints:
            if joint.name in said.limits:
                joint.lower, joint.upper = said.limits[joint.name]
            for drive in (said.drive, said.drives.get(joint.name, Drive())):
                for name, value in vars(drive).items():
                    if not math.isnan(value):
                        setattr(joint, name, value)
                if not math.isnan(drive.kd):
                    joint.damping = 0.0  # what is described is all of it
        for link in self.source.links:
            if link.name in said.mass:
                scale = said.mass[link.name] / link.mass if link.mass > 0.0 else 0.0
                link.mass = said.mass[link.name]
                link.inertia = link.inertia * scale
        for name, angle in said.hold.items():
            self.notes.append(f"{name} is held at {angle:g} rad, as described")
            self._check_angle("hold", self.by_name[name], angle)

    def _check_angle(self, entry: str, joint: Joint, angle: float) -> None:
        """Refuse an angle that is described and beyond the limits."""
        if angle < joint.lower - SLACK_RAD or angle > joint.upper + SLACK_RAD:
            self.problems.append(
                f"{entry}: {angle:g} rad is beyond the limits of {joint.name}, {joint.lower:g} to "
                f"{joint.upper:g} rad"
            )

    def _is_welded(self, joint: Joint) -> bool:
        return joint.kind == "fixed" or joint.name in self.held

    def _group(self, first: int) -> dict[int, np.ndarray]:
        """Links that move with one, and their poses in it [7]."""
        poses = {first: IDENTITY}
        queue = [first]
        for link in queue:
            for joint in self.out[link]:
                if self._is_welded(joint):
                    angle = self.held.get(joint.name, 0.0) if joint.kind == "revolute" else 0.0
                    poses[joint.child] = compose(poses[link], joint_pose(joint, angle))
                    queue.append(joint.child)
        return poses

    def _first(self, link: int) -> int:
        """The link with whose frame a link moves."""
        while link in self.above and self._is_welded(self.above[link]):
            link = self.above[link].parent
        return link

    def _leaving(self, first: int) -> list[Joint]:
        """Joints that leave a group, in the order of the file."""
        group = self._group(first)
        joints = self.source.joints
        return [joint for joint in joints if joint.parent in group and not self._is_welded(joint)]

    def _palm(self) -> tuple[int, list[Joint]]:
        """The root and the first joints of the fingers; joints of a wrist become held."""
        roots = [i for i in range(len(self.source.links)) if i not in self.above]
        base = max(roots, key=self._moving)
        for root in roots:
            if root != base:
                self.notes.append(
                    f"{self.source.links[root].name} is no part of the hand and is left out"
                )
        wrist: list[str] = []
        starts = self._leaving(base)
        while len(starts) == 1 and self._branches(starts[0].child):
            wrist.append(starts[0].name)
            self.held[starts[0].name] = 0.0
            starts = self._leaving(base)
        if len(wrist) > MOST_WRIST:
            names = ", ".join(f"{name}: 0" for name in wrist)
            self.problems.append(
                f"{len(wrist)} joints come before the fingers: an arm; give the hand alone, or say "
                f"hold: {{{names}}}"
            )
        elif wrist:
            self.notes.append(
                f"{', '.join(wrist)} come before the fingers and are held at 0 (hold)"
            )
        if not starts:
            self.problems.append("no joint moves; a hand has fingers")
        return base, starts

    def _moving(self, link: int) -> int:
        """Joints that move below a link."""
        count = 0
        for joint in self.out[link]:
            count += self._moving(joint.child) + (not self._is_welded(joint))
        return count

    def _branches(self, link: int) -> bool:
        """Whether more than one joint leaves a link or what it carries."""
        leaving = self._leaving(link)
        return len(leaving) > 1 or any(self._branches(joint.child) for joint in leaving)

    def _chains(self, start: Joint) -> list[list[Joint]]:
        """The joints of a finger; of several, each with a copy, where they share what follows."""
        chain = [start]
        while leaving := self._leaving(chain[-1].child):
            if len(leaving) > 1:
                names = ", ".join(joint.name for joint in leaving)
                link = self.source.links[chain[-1].child].name
                if all(joint.mimic for joint in chain):
                    self.notes.append(
                        f"{link} carries the fingers of {names}; each gets a copy of what moves "
                        f"it, and a share of its mass"
                    )
                    return [chain + rest for joint in leaving for rest in self._chains(joint)]
                self.problems.append(
                    f"{link} moves, and carries the fingers of {names}; hold what moves it: "
                    f"hold: {{{', '.join(f'{joint.name}: 0' for joint in chain)}}}"
                )
                break
            chain.append(leaving[0])
        for joint in chain:
            if joint.kind != "revolute":
                self.problems.append(
                    f"{joint.name} is {joint.kind}; only revolute joints move: hold: "
                    f"{{{joint.name}: 0}}"
                )
        return [chain]

    def _welded(self, first: int) -> Link:
        """A link with all that is fixed to it."""
        whole = Link(self.source.links[first].name)
        parts: list[Solid] = []
        for number, pose in self._group(first).items():
            link = self.source.links[number]
            for shape in link.shapes:
                self._check_shape(link, shape)
                whole.shapes.append(replace(shape, frame=compose(pose, shape.frame)))
            for name, site in link.sites.items():
                whole.sites[name] = compose(pose, site)
            if number != first:
                whole.sites[link.name] = pose
            if not 0.0 <= link.mass < math.inf:
                self.problems.append(
                    f"{link.name} weighs {link.mass:g} kg in the file; say mass: "
                    f"{{{link.name}: 0.02}}"
                )
            parts.append(_mass_part(link.mass, pose, link.com, link.inertia))
        if sum(part.volume for part in parts) > 0.0:
            whole.take(joined(parts))
            return self._possible(whole)
        return self._weighed(whole)

    def _weighed(self, link: Link) -> Link:
        """A link whose mass nobody says, as the boxes around its colliders are."""
        parts: list[Solid] = []
        for shape in link.colliders:
            pose, half = shape_box(shape)
            mass = float(8.0 * np.prod(half) * DENSITY_KG_M3)
            inertia = np.diag(mass / 3.0 * (half @ half - half**2))
            parts.append(_mass_part(mass, pose, np.zeros(3), inertia))
        if not parts:
            self.problems.append(
                f"{link.name} has neither mass nor collider; give it one: mass: "
                f"{{{link.name}: 0.02}}"
            )
            return link
        link.take(joined(parts))
        self.notes.append(
            f"guess: {link.name} has no mass in the file; {link.mass:.3f} kg by its colliders "
            f"(mass)"
        )
        return link

    def _possible(self, link: Link) -> Link:
        """A link whose moments are those of a body: none above the sum of the others."""
        moments, axes = np.linalg.eigh(link.inertia)
        least = 1e-6 * link.mass  # of a ball of 1.6 mm
        mended = np.maximum(moments, least)
        mended[0] = max(mended[0], (mended[2] - mended[1]) * 1.001)
        mended[:2] = np.maximum(mended[:2], mended[0])
        if np.any(mended > moments * 1.01):
            self.raised.append(link.name)
        if np.any(mended != moments):
            link.inertia = axes @ np.diag(mended) @ axes.T
        return link

    def _tip(self, last: int) -> np.ndarray | None:
        """The fingertip that is described, or that the source marks, in the last link [7]."""
        sites: dict[str, np.ndarray] = {}
        frames: dict[str, np.ndarray] = {}
        for number, pose in self._group(last).items():
            link = self.source.links[number]
            if link.name in self.said.tips:
                return compose(pose, pose_at(self.said.tips[link.name]))
            for name, site in link.sites.items():
                sites[name] = compose(pose, site)
            if number != last:
                frames[link.name] = pose
        for name, pose in (sites | frames).items():
            if "tip" in name.lower():
                return pose_at(pose[:3])
        return None

    def _check_followers(self, tree: Tree) -> None:
        """Joints that follow what is held or missing."""
        by_name = {joint.name: joint for joint in tree.joints}
        for joint in tree.joints:
            if joint.mimic is None:
                continue
            joint.mimic = lead(by_name, joint.name)
            leader, factor, offset = joint.mimic
            if leader in self.held:
                angle = factor * self.held[leader] + offset
                self.problems.append(
                    f"{joint.name} follows {leader}, which is held; hold it too: "
                    f"hold: {{{joint.name}: {angle:g}}}"
                )
            elif leader not in by_name:
                self.problems.append(
                    f"{joint.name} follows {leader}, which is no joint of a finger; say mimic"
                )
            elif by_name[leader].mimic is not None:
                self.problems.append(f"{joint.name} and {leader} follow each other; say mimic")
            else:
                how = "as described" if joint.name in self.said.mimic else "as in the file"
                self.notes.append(
                    f"{joint.name} follows {leader}: {factor:g} q + {offset:g} rad, {how}"
                )

    def _check_numbers(self, tree: Tree) -> None:
        """Limits and torque limits, which are never guessed."""
        for joint in tree.joints:
            if not (joint.lower < joint.upper and max(-joint.lower, joint.upper) < MOST_RAD):
                self.problems.append(
                    f"{joint.name} has the limits {joint.lower:g} and {joint.upper:g} rad; give it "
                    f"some in "
                    f"radians: limits: {{{joint.name}: [-1.6, 1.6]}}"
                )
            elif joint.name in self.said.start:
                self._check_angle("start", joint, self.said.start[joint.name])
        weak = [j.name for j in tree.joints if not j.effort > 0.0 and j.mimic is None]
        if weak:
            self.problems.append(
                f"{', '.join(weak)}: no torque limit in the file; say drive: {{effort: 1.0}} (N m) "
                f"or drives: {{{weak[0]}: {{effort: 1.0}}}}; or mimic or hold, where there is no "
                "motor"
            )
        for joints in tree.fingers:
            link = tree.links[joints.stop]
            if not link.colliders:
                self.problems.append(
                    f"nothing collides of {link.name}, which has a fingertip; add a collision"
                )

    def _check_shape(self, link: Link, shape: Shape) -> None:
        """Kind, extent and unit of a collider or a drawing, and hollows of a mesh that collides whole."""
        what = f"a {shape.kind} of {link.name}"
        if shape.kind not in KINDS:
            if shape.collides:
                self.problems.append(f"a collider of {link.name} is a {shape.kind}; make it a mesh")
            return
        half = shape_box(shape)[1]
        if not LEAST_M < 2.0 * half.max() < MOST_M:
            self.problems.append(
                f"{what} is {2.0 * half.max():.3g} m long; give it its size in metres, a mesh by "
                "its scale, such as 0.001"
            )
        elif shape.collides and shape.kind == "mesh":
            hull = hull_volume(shape.vertices)
            volume = abs(mesh_volume(shape.vertices, shape.faces))
            if not hull > 0.0:
                self.problems.append(
                    f"{what} is flat and collides; give it a thickness, or make it a box"
                )
            elif hull > HOLLOW * volume > 0.0:
                self.hollow[link.name] = max(hull / volume, self.hollow.get(link.name, 0.0))
        elif shape.collides and not half.min() > 0.0:
            self.problems.append(f"{what} is flat and collides; give it a thickness")


def _mass_part(mass: float, pose: np.ndarray, com: np.ndarray, inertia: np.ndarray) -> Solid:
    """A body in a link, of which centre and inertia are in a frame with a pose [7]."""
    turn = Rotation.from_quat(pose[3:]).as_matrix()
    return Solid(mass, placed(pose, com), turn @ inertia @ turn.T)


def shape_box(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Pose [7] in the link, and half extents [3], of the box around a shape."""
    if shape.kind == "mesh":
        low = shape.vertices.min(axis=0)
        high = shape.vertices.max(axis=0)
        return compose(shape.frame, pose_at((low + high) / 2.0)), (high - low) / 2.0
    if shape.kind == "sphere":
        return shape.frame, np.full(3, shape.size[0])
    if shape.kind in ("capsule", "cylinder"):
        radius, half_length = shape.size
        if shape.kind == "capsule":
            half_length += radius
        return shape.frame, np.array([radius, radius, half_length])
    return shape.frame, np.array(shape.size[:3])
