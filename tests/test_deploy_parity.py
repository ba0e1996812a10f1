"""For the same state a policy on a hand sees what it saw in training: through episodes, both hands."""

import numpy as np
import pytest
import torch
import warp as wp
from sensed_world import state_of

from vd.deploy.loop.action import ActionFilter
from vd.deploy.loop.policy_runner import seen_points, senses_of
from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.student import StudentView
from vd.sensors.cfg import DepthCameraCfg
from vd.sensors.depth_cloud import CameraCloud
from vd.vision.cfg import PRESETS
from vd.vision.network import Student
from vd.vision.sight import Sight

POINT_M = 2e-6
"""Points of the two clouds lie this close: rounding of poses that were computed in another order."""
SENSE = 1e-6
COMPARED = 0.5
"""Least share of steps in which actions are compared: until rounding first decides about a voxel or a pose.
Where it was counted it never did."""


def keys(sites) -> set[tuple[int, ...]]:
    return {tuple(row) for row in sites.coordinates.tolist()}


def near_border(points: np.ndarray, side: float) -> int:
    """Points that lie so close to a border between voxels that rounding decides."""
    cells = points[np.isfinite(points).all(axis=1)] / side
    return int((np.abs(cells - np.round(cells)) < 2.0 * POINT_M / side).any(axis=1).sum())


@pytest.mark.slow
@pytest.mark.parametrize(("hand", "episode_s"), [("dclaw3", 3.0), ("dclaw4", 1.0)])
def test_a_student_sees_on_a_hand_what_it_sees_in_the_simulator(hand, episode_s):
    """Episodes of random actions; the deploy side is given joints, goal and image, nothing else."""
    nothing = RandomisationCfg(enabled=False)
    task = ReorientCfg(hand=hand, num_envs=1, seed=3, episode_s=episode_s, randomisation=nothing)
    env = ReorientEnv(task, "cpu")
    network = PRESETS["small"]
    depth = DepthCameraCfg()
    view = StudentView(env, network, rendered=True, depth=depth)
    eye = CameraCloud(env.hand.camera)
    sight = Sight(env.hand, env.objects, network, complete=False)
    actions = ActionFilter(env.hand, task)
    torch.manual_seed(0)
    student = Student(network, env.num_actions).eval()
    hidden = there = student.initial_hidden(1)
    rng = np.random.default_rng(0)
    apart, borders, steps, compared = 0, 0, 0, 0
    for _ in range(env.max_episode_steps):
        seen = view.frame()
        sensed = state_of(env)
        cloud = seen_points(eye, view.senses.camera.depth.numpy()[0].copy())
        known = sight.frame(senses_of(sensed, cloud), None)
        points, expected = sight.points(known), view.sight.points(seen)
        there_is = torch.isfinite(expected).all(dim=-1)
        assert torch.equal(there_is, torch.isfinite(points).all(dim=-1))
        assert (points[there_is] - expected[there_is]).abs().max() < POINT_M
        ours, theirs = sight.sites(known), view.sites(seen, augment=False)
        apart += len(keys(ours) ^ keys(theirs))
        borders += near_border(expected[0].numpy(), network.voxel_m)
        names = ("action", "position", "velocity")
        assert all((known[name] - seen[name]).abs().max() < SENSE for name in names)
        felt, wanted = student.proprioception(known), student.proprioception(seen)
        with torch.inference_mode():
            one = student.act(ours, felt, hidden)
            other = student.act(theirs, wanted, there)
        hidden, there = one.hidden, other.hidden
        if keys(ours) == keys(theirs):
            np.testing.assert_allclose(one.mean, other.mean, atol=2e-2)
            compared += 1
        action = rng.uniform(-1.0, 1.0, env.num_actions).astype(np.float32)
        actions.put(sensed.smoothed)
        target = actions.goal(action, sensed.joint_q)
        env.step(wp.array(action[None], dtype=float, device="cpu"))
        np.testing.assert_allclose(target, env.sim.target.numpy()[0, : env.num_actions], atol=1e-6)
        steps += 1
    assert steps == env.max_episode_steps
    assert apart <= 2 * borders, f"{apart} voxels differ, {borders} points lie on borders"
    assert compared >= COMPARED * steps, f"actions could be compared in {compared} of {steps} steps"
