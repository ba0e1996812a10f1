"""Fingertips from joints: where the simulator has them and how they move; nothing of them is estimated."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import HandModel
from vd.assets_usd.hands import load_hand
from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.kernels.observations import FINGERTIP_VALUES, teacher_observation_slices
from vd.policy import PolicySpec
from vd.sim.scene import hand_mount
from vd.student.cfg import EncoderCfg, StudentCfg
from vd.student.fingertips import Fingertips
from vd.student.network import Student
from vd.student.state import state_cfg
from vd.train.student.follow import with_fingertips

HANDS = ("dclaw3", "dclaw4")
BASE = [float(value) for value in hand_mount()]
STEP_S = 1e-5
"""Step of the differences that velocities are compared with [s]."""

hand_named = cache(load_hand)


def tips_of(hand: HandModel) -> Fingertips:
    made = Fingertips(hand.num_joints)
    made.adopt(hand, BASE)
    return made.double()


def oracle(hand: HandModel, joint_q: np.ndarray) -> list[tuple[np.ndarray, Rotation]]:
    """Places and orientations of the tips in the world [G] of joint positions [D]."""
    poses, mount = hand.tip_poses(joint_q), Rotation.from_quat(BASE[3:])
    return [(BASE[:3] + mount.apply(pose[:3]), mount * Rotation.from_quat(pose[3:])) for pose in poses]


@pytest.mark.parametrize("name", HANDS)
@given(seed=st.integers(0, 2**31 - 1))
@settings(max_examples=20, deadline=None)
def test_poses_and_velocities_are_those_of_the_tree_of_links(name, seed):
    hand, rng = hand_named(name), np.random.default_rng(seed)
    joint_q, joint_qd = rng.uniform(hand.lower, hand.upper), rng.normal(size=hand.num_joints)
    found = tips_of(hand)(torch.tensor(joint_q), torch.tensor(joint_qd)).numpy()
    here, there = oracle(hand, joint_q), oracle(hand, joint_q + STEP_S * joint_qd)
    tips = zip(found.reshape(-1, FINGERTIP_VALUES), here, there, strict=True)
    for tip, (place, turn), (place_after, turn_after) in tips:
        np.testing.assert_allclose(tip[:3], place, atol=1e-6)
        assert (Rotation.from_quat(tip[3:7]) * turn.inv()).magnitude() < 1e-5
        np.testing.assert_allclose(tip[7:10], (place_after - place) / STEP_S, atol=1e-4)
        np.testing.assert_allclose(tip[10:], (turn_after * turn.inv()).as_rotvec() / STEP_S, atol=1e-3)


@pytest.mark.parametrize("name", HANDS)
def test_a_teacher_observes_them_so(name):
    """Signs of the quaternions included."""
    exact = RandomisationCfg(enabled=False)
    env = ReorientEnv(ReorientCfg(hand=name, objects=("cube",), num_worlds=3, randomisation=exact), "cpu")
    torch.manual_seed(0)
    for _ in range(6):
        wp.to_torch(env.action).uniform_(-1.0, 1.0)
        env.step(env.action)
    joints = env.num_actions
    position, velocity = (wp.to_torch(state)[:, :joints] for state in (env.sim.joint_q, env.sim.joint_qd))
    observed = wp.to_torch(env.observation)[:, teacher_observation_slices(env.num_fingers)["fingertips"]]
    tips = Fingertips(joints)
    tips.adopt(env.hand, BASE)
    torch.testing.assert_close(tips(position, velocity), observed, atol=2e-5, rtol=1e-4)
    env.close()


def student(hand: HandModel, *, fingertips: bool) -> Student:
    torch.manual_seed(0)
    spec = PolicySpec(
        num_observations=teacher_observation_slices(hand.num_fingers)["previous_action"].stop,
        num_actions=hand.num_joints,
        hidden=(8,),
        activation="elu",
        distribution="gaussian",
        normalise_observations=True,
    )
    state = replace(state_cfg(spec), inside=4, fingertips=fingertips)
    encoder = EncoderCfg(channels=(4, 4), blocks=1, embedding=6)
    small = StudentCfg(encoder=encoder, state=state, action_hidden=4, memory=5, head_hidden=5)
    return Student(small, hand.num_joints)


def test_a_student_that_estimated_them_knows_them():
    """Whatever its layers say: nothing is added to what the joints tell, and all else stays."""
    hand = hand_named("dclaw3")
    before = student(hand, fingertips=False)
    torch.nn.init.normal_(before.state.estimate.weight)
    before.state.offset.normal_()
    before.state.scale.uniform_(0.5, 2.0)
    after = with_fingertips(before, hand)
    assert after.cfg.state.fingertips and not before.cfg.state.fingertips
    position, velocity = torch.randn(7, hand.num_joints), torch.randn(7, hand.num_joints)
    senses = after.senses({"action": torch.randn(7, 9), "position": position, "velocity": velocity})
    embedding, hidden = torch.randn(1, 7, 6), after.initial_hidden(7)
    with torch.no_grad():
        old, new = (net(embedding, senses[None], hidden).state[0] for net in (before, after))
    columns = teacher_observation_slices(hand.num_fingers)["fingertips"]
    world = after.state.offset + after.state.scale * new
    tips = Fingertips(hand.num_joints)
    tips.adopt(hand, BASE)
    torch.testing.assert_close(world[:, columns], tips(position, velocity), atol=1e-4, rtol=1e-4)
    others = [column for column in range(old.shape[1]) if not columns.start <= column < columns.stop]
    torch.testing.assert_close(new[:, others], old[:, others])


def test_the_first_fit_leaves_them_to_the_joints():
    hand = hand_named("dclaw3")
    head = student(hand, fingertips=True).state
    head.fingertips.adopt(hand, BASE)
    width = head.estimate.in_features - head.inside[0].out_features
    head.fit(torch.randn(40, width), torch.randn(40, head.estimate.out_features))
    columns = teacher_observation_slices(hand.num_fingers)["fingertips"]
    assert not head.estimate.weight[columns].any() and not head.estimate.bias[columns].any()
    assert head.estimate.weight[: columns.start].any()


def test_without_its_joints_a_student_cannot_know_them():
    with pytest.raises(ValueError, match="add position and velocity to senses"):
        replace(student(hand_named("dclaw3"), fingertips=True).cfg, senses=("action",)).validate()


def test_another_number_of_fingers_is_refused():
    with pytest.raises(ValueError, match="dclaw4 has 4 fingers, the student 3"):
        Fingertips(9).adopt(hand_named("dclaw4"), BASE)
