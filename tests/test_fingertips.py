"""Fingertips from joints: where the simulator has them and how they move.

Nothing of them is estimated.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import HandModel
from vd.assets_usd.hands import load_hand
from vd.kernels.task.observations import FINGERTIP_VALUES
from vd.vision.fingertips import Fingertips

HANDS = ("dclaw3", "dclaw4")
STEP_S = 1e-5
"""Step of the differences that velocities are compared with [s]."""

hand_named = cache(load_hand)


def oracle(hand: HandModel, joint_q: np.ndarray) -> list[tuple[np.ndarray, Rotation]]:
    """Places and orientations of the tips in the world [G] of joint positions [D]."""
    poses, mount = hand.tip_poses(joint_q), Rotation.from_quat(hand.mount[3:])
    return [
        (hand.mount[:3] + mount.apply(pose[:3]), mount * Rotation.from_quat(pose[3:]))
        for pose in poses
    ]


@pytest.mark.parametrize("name", HANDS)
@given(seed=st.integers(0, 2**31 - 1))
@settings(max_examples=20, deadline=None)
def test_poses_and_velocities_are_those_of_the_tree_of_links(name, seed):
    hand, rng = hand_named(name), np.random.default_rng(seed)
    joint_q, joint_qd = rng.uniform(hand.lower, hand.upper), rng.normal(size=hand.num_joints)
    state = (torch.tensor(values)[None] for values in (joint_q, joint_qd))
    found = Fingertips(hand, torch.tensor)(*state).numpy()
    here, there = oracle(hand, joint_q), oracle(hand, joint_q + STEP_S * joint_qd)
    tips = zip(found.reshape(-1, FINGERTIP_VALUES), here, there, strict=True)
    for tip, (place, turn), (place_after, turn_after) in tips:
        np.testing.assert_allclose(tip[:3], place, atol=1e-6)
        assert (Rotation.from_quat(tip[3:7]) * turn.inv()).magnitude() < 1e-5
        np.testing.assert_allclose(tip[7:10], (place_after - place) / STEP_S, atol=1e-4)
        np.testing.assert_allclose(
            tip[10:], (turn_after * turn.inv()).as_rotvec() / STEP_S, atol=1e-3
        )


def test_a_finger_that_is_no_chain_is_refused():
    hand = hand_named("dclaw3")
    parents = hand.joint_parent.copy()
    parents[2] = 0
    with pytest.raises(ValueError, match="finger 0 of dclaw3"):
        Fingertips(replace(hand, joint_parent=parents), torch.tensor)
