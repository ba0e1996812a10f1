"""The start of a hand whose palm looks up: a bowl in which what falls stays, found by dropping.

Spheres and cubes of the sizes that fit the hand fall on it in MuJoCo, many at once and through each
other, while the hand stands still. The pose is searched by the cross-entropy method: poses are
drawn about the best of those before.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations
from queue import SimpleQueue

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import CollisionShape, HandModel, Workspace, compose
from vd.paper import PAPER

# All numbers of this search are ours, chosen so that it takes a minute, and not tuned.
OBJECTS = 32
"""Half of them spheres, half cubes, of even sizes."""
POSES = 24
"""In each round."""
BEST = 6
"""Of these by which the next are drawn."""
ROUNDS = 12
"""Of draws about the best."""
FALL_S = 1.5
"""After which an object that is still there stays [s]."""
STEP_S = 0.004
"""Of the physics [s]."""
BENT = 0.3
"""Share of the way to the farther end of its range by which a joint bends in the first round."""
SPREAD = 0.2
"""Standard deviation of the first round, of a joint's range."""
LEAST_SPREAD = 0.03
"""Standard deviation that every round has at least, of a joint's range."""
NEAR = 0.1
"""How much of an object it is worth that all objects lie at the goal: tells equals apart."""
TOUCH_M = 0.0005
"""By which colliders of two fingers may be in each other."""
RISE_M = 0.005
"""Steps by which what would start in the hand is raised."""
THREADS = 2
"""Poses scored at a time: as many cores as the smallest machines have. Changes no result."""


class Drops:
    """What is dropped on a hand, always the same; one for each thread.

    Args:
        hand: The hand; its own start does not matter.
        size_m: Smallest and largest longest side of an object [m].
    """

    def __init__(self, hand: HandModel, size_m: tuple[float, float]):
        spec = mujoco.MjSpec()
        spec.option.timestep = STEP_S
        for number in range(len(hand.link_names)):
            body = spec.worldbody.add_body(name=f"link {number}", mocap=True)
            for i, shape in enumerate(hand.shapes):
                if shape.link == number:
                    add_shape(spec, body, shape, f"hull {i}")
        rng = np.random.default_rng(0)
        self._offsets = rng.uniform(-1.0, 1.0, (OBJECTS, 3)) * PAPER.scene.object_start_noise_m
        self._turns = Rotation.random(OBJECTS, random_state=0).as_quat()[:, [3, 0, 1, 2]]
        self.sides = np.linspace(*size_m, OBJECTS // 2).repeat(2)
        for i, side in enumerate(self.sides):
            body = spec.worldbody.add_body(name=f"object {i}")
            body.add_freejoint()
            kind = mujoco.mjtGeom.mjGEOM_SPHERE if i % 2 else mujoco.mjtGeom.mjGEOM_BOX
            mass = PAPER.materials.object_mass_kg
            body.add_geom(
                type=kind,
                size=[side / 2] * 3,
                mass=mass,
                contype=0,
                conaffinity=1,
                friction=[0.0, 0.005, 0.0001],
            )
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        fingers = dict(zip(hand.joint_child.tolist(), hand.joint_finger.tolist(), strict=True))
        of_geom = [fingers.get(link, -1) for link in self._model.geom_bodyid - 1]
        pairs = []
        for a, b in combinations(range(len(hand.shapes)), 2):
            if -1 < of_geom[a] != of_geom[b] > -1:
                pairs.append((a, b))
        self._pairs = np.array(pairs, dtype=int).reshape(-1, 2)
        """Geoms of two fingers; bodies and geoms of the hand come first, in the order of links."""

    def score(self, links: np.ndarray, workspace: Workspace) -> tuple[float, float]:
        """How good a pose is, and the share of the objects that stay in it.

        Args:
            links: Poses of the links in the world [L, 7].
            workspace: What the hand then handles, and where.
        """
        model = self._model
        data = self._data
        mujoco.mj_resetData(model, data)
        data.mocap_pos[:] = links[:, :3]
        data.mocap_quat[:] = links[:, [6, 3, 4, 5]]
        objects = data.qpos.reshape(OBJECTS, 7)
        objects[:, :3] = np.array(workspace.drop_m) + self._offsets
        objects[:, 3:] = self._turns
        self._raise_free(objects)
        crossing = self._crossing()
        mujoco.mj_step(model, data, round(FALL_S / STEP_S))
        away = np.linalg.norm(objects[:, :3] - np.array(workspace.goal_m), axis=1)
        away = np.nan_to_num(away / workspace.fall_m, nan=1.0)
        kept = float(np.mean(away < 1.0))
        return kept - NEAR * float(np.minimum(away, 1.0).mean()) - crossing, kept

    def _raise_free(self, objects: np.ndarray) -> None:
        """Raise what is in the hand until it is not, at most by its size."""
        model = self._model
        data = self._data
        for _ in range(round(float(self.sides.max()) / RISE_M)):
            mujoco.mj_forward(model, data)
            deep = data.contact.dist < -TOUCH_M
            bodies = model.geom_bodyid[data.contact.geom[deep]].max(axis=1)
            inside = np.unique(bodies) - model.nbody + OBJECTS
            if not len(inside):
                return
            objects[inside, 2] += RISE_M

    def _crossing(self) -> int:
        """Pairs of colliders of two fingers that are in each other."""
        first, second = self._pairs.T
        place = self._data.geom_xpos
        reach = self._model.geom_rbound
        gap = np.linalg.norm(place[first] - place[second], axis=1)
        near = self._pairs[gap < reach[first] + reach[second]]
        apart = [
            mujoco.mj_geomDistance(self._model, self._data, a, b, TOUCH_M, None) for a, b in near
        ]
        return int(np.sum(np.array(apart) < -TOUCH_M))


@dataclass(frozen=True)
class Bowl:
    """What was found."""

    start: np.ndarray
    """Angles [D] [rad]."""
    kept: float
    """Share of the objects that stay in it."""
    kept_before: float
    """The same of the hand's own start."""


def find_bowl(hand: HandModel, place: Callable[[np.ndarray], tuple[np.ndarray, Workspace]]) -> Bowl:
    """Search the start in which most of what falls stays.

    Args:
        hand: The hand, open.
        place: For angles [D] [rad] the mount [7] and the workspace of the hand.
    """
    rng = np.random.default_rng(0)
    span = hand.upper - hand.lower
    farther = np.where(np.abs(hand.upper) > np.abs(hand.lower), hand.upper, hand.lower)
    bends = np.abs(hand.upper + hand.lower) > 0.2 * span  # others go to the side
    middle = np.where(bends, hand.start + BENT * (farther - hand.start), hand.start)
    spread = SPREAD * span
    drops = [Drops(hand, place(hand.start)[1].size_m) for _ in range(THREADS)]
    free = SimpleQueue[Drops]()
    for each in drops:
        free.put(each)

    def score(q: np.ndarray) -> tuple[float, float]:
        mount, workspace = place(q)
        own = free.get()
        try:
            return own.score(compose(mount, hand.forward_kinematics(q)), workspace)
        finally:
            free.put(own)

    best = hand.start
    value, before = score(best)
    kept = before
    with ThreadPoolExecutor(THREADS) as pool:
        for _ in range(ROUNDS):
            drawn = middle + spread * rng.standard_normal((POSES, hand.num_joints))
            poses = followed(hand, np.clip(drawn, hand.lower, hand.upper))
            scores = list(pool.map(score, poses))
            order = np.argsort([-found for found, _ in scores])[:BEST]
            if scores[order[0]][0] > value:
                best = poses[order[0]]
                value, kept = scores[order[0]]
            middle = poses[order].mean(axis=0)
            spread = np.maximum(poses[order].std(axis=0), LEAST_SPREAD * span)
    return Bowl(best, kept, before)


def followed(hand: HandModel, q: np.ndarray) -> np.ndarray:
    """Angles [.., D] with those joints where they are led that follow others."""
    led = hand.mimic_factor * q[..., hand.mimic] + hand.mimic_offset
    return np.clip(np.where(hand.mimic >= 0, led, q), hand.lower, hand.upper)


def add_shape(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    shape: CollisionShape,
    name: str,
    pose: np.ndarray | None = None,
) -> None:
    """Add a collider to a body of MuJoCo, a hull by this name, at its own frame or a pose [7]."""
    pose = shape.frame if pose is None else pose
    kind = "mesh" if shape.kind == "hull" else shape.kind
    geom = body.add_geom(
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"),
        size=[*shape.size, 0.0, 0.0][:3],
        pos=pose[:3],
        quat=pose[[6, 3, 4, 5]],
        friction=[shape.friction, 0.0, 0.0],
    )
    if kind == "mesh":
        geom.meshname = name
        mesh = spec.add_mesh(name=name, uservert=shape.vertices.ravel())
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
