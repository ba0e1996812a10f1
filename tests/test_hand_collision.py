"""Collision shapes: clear of each other where they should be, by MuJoCo's distance function."""

import itertools
from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from vd.assets_usd.hand_model import HandModel, read_hand
from vd.assets_usd.hands import hand_usd

GEOMS = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
}
FAR = 0.5
RESET = (0.0, 0.8, -1.1)

Distances = Callable[[np.ndarray, list[tuple[int, int]]], dict[tuple[int, int], float]]


@pytest.fixture(scope="module", params=("dclaw3", "dclaw4"))
def hand(request: pytest.FixtureRequest) -> HandModel:
    return read_hand(hand_usd(request.param))


@pytest.fixture(scope="module")
def distances(hand: HandModel) -> Distances:
    """Least distance [m] between the shapes of pairs of links at ``q``; negative where they overlap."""
    spec = mujoco.MjSpec()
    for index, name in enumerate(hand.link_names):
        body = spec.worldbody.add_body(name=name, mocap=True)
        for shape in hand.shapes:
            if shape.link == index:
                size, frame = [*shape.size, 0.0, 0.0][:3], shape.frame
                body.add_geom(
                    name=shape.path,
                    type=GEOMS[shape.kind],
                    size=size,
                    pos=frame[:3],
                    quat=frame[[6, 3, 4, 5]],
                )
    model = spec.compile()
    data = mujoco.MjData(model)
    geoms: list[list[int]] = [[] for _ in hand.link_names]
    for shape in hand.shapes:
        geoms[shape.link].append(model.geom(shape.path).id)

    def measure(q: np.ndarray, pairs: list[tuple[int, int]]) -> dict[tuple[int, int], float]:
        poses = hand.forward_kinematics(q)
        data.mocap_pos[:] = poses[:, :3]
        data.mocap_quat[:] = poses[:, [6, 3, 4, 5]]
        mujoco.mj_kinematics(model, data)
        return {
            (a, b): min(
                mujoco.mj_geomDistance(model, data, i, j, FAR, None)
                for i, j in itertools.product(geoms[a], geoms[b])
            )
            for a, b in pairs
        }

    return measure


def test_no_self_penetration_at_reset_pose(hand: HandModel, distances: Distances) -> None:
    pairs = set(itertools.combinations(range(len(hand.link_names)), 2)) - set(hand.filtered_pairs)
    clearances = distances(np.tile(RESET, hand.num_fingers), sorted(pairs))
    assert min(clearances.values()) > 0.002, clearances


def test_other_filtered_pairs_cannot_touch(hand: HandModel, distances: Distances) -> None:
    """Random poses, a third of the joints at a limit; by symmetry the pairs of finger 0 are enough."""
    joined = set(zip(hand.joint_parent.tolist(), hand.joint_child.tolist(), strict=True))
    pairs = [p for p in hand.filtered_pairs if p not in joined and p[0] <= 3]
    assert pairs
    random = np.random.default_rng(0)
    for _ in range(300):
        unit = random.random(hand.num_joints)
        unit = np.where(random.random(hand.num_joints) < 1 / 3, np.round(unit), unit)
        q = hand.lower + unit * (hand.upper - hand.lower)
        clearances = distances(q, pairs)
        assert min(clearances.values()) > 0.005, (clearances, q)
