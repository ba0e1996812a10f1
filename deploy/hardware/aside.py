"""Where the other fingers stand while one moves through its range.

Out of its way, and of each other's.
"""

import functools

import numpy as np

from vd.assets_usd.hand_data import HandModel
from vd.command.warp_quiet import quiet_warp

ASIDE = 0.8
"""How far a finger swings one of its joints aside, and how far motions go, as a share of half the
range.
"""
CLEARANCE_M = 0.01
"""Gap below which fingers count as touching [m]: gravity bends joints by 0.1 rad."""
STEPS = 13
"""Angles of a joint at which a finger that moves through its range is looked at."""


@functools.cache
def aside(hand: HandModel, moving: int) -> np.ndarray:
    """Joint angles [D] [rad] with a finger in the middle of its range and the others out of its way.

    Each of the others has one joint aside, the first outward if that will do; it is where it
    touches nothing, or least often.
    """
    touching = _Touching(hand)
    joints = np.arange(hand.num_joints)
    middle = 0.5 * (hand.lower + hand.upper)
    half = 0.5 * (hand.upper - hand.lower)
    moves = hand.joint_finger == moving
    swept = []
    for joint in joints[moves]:
        swing = half * (joints == joint)
        swept += [middle + share * swing for share in np.linspace(-ASIDE, ASIDE, STEPS)]
    pose = middle
    placed = {moving}
    for finger in sorted(set(range(hand.num_fingers)) - placed):
        placed.add(finger)
        candidates = []
        for joint in joints[hand.fingers[finger]]:
            swing = ASIDE * half * (joints == joint)
            candidates += [pose + swing, pose - swing]
        candidates.insert(1, pose)
        fewest = np.inf
        for candidate in candidates:
            touches = sum(touching(np.where(moves, q, candidate), placed) for q in swept)
            if touches < fewest:
                fewest = touches
                pose = candidate
    return pose


class _Touching:
    """Whether links of fingers touch, by MuJoCo's collision detection in the hand's model."""

    def __init__(self, hand: HandModel):
        import mujoco

        quiet_warp()
        from vd.sim.cfg import SimCfg
        from vd.sim.engine import make_solver
        from vd.sim.scene import build_hand, new_builder

        world = build_hand(hand, SimCfg(), visuals=False)
        builder = new_builder()
        builder.add_world(world)
        self._model = make_solver(builder.finalize(device="cpu"), SimCfg()).mj_model
        self._model.geom_margin[:] = CLEARANCE_M
        self._data = mujoco.MjData(self._model)
        link_finger = np.full(hand.num_joints + 1, -1)
        link_finger[hand.joint_child] = hand.joint_finger
        self._finger = np.concatenate([[-1], link_finger])[self._model.geom_bodyid]

    def __call__(self, q: np.ndarray, fingers: set[int]) -> bool:
        """Whether links of these fingers touch each other or the base, at joint angles [D] [rad]."""
        import mujoco

        self._data.qpos[:] = q
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_collision(self._model, self._data)
        pairs = self._finger[self._data.contact.geom]
        gaps = self._data.contact.dist
        near = gaps < np.where((pairs < 0).any(axis=1), 0.0, CLEARANCE_M)
        return bool((near & np.isin(pairs, [-1, *fingers]).all(axis=1)).any())
