"""Stage 0: random scenes and their targets, heads, learning, resuming."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial.transform import Rotation
from student_dummy import weights

from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.config import to_dict
from vd.quaternions import relative_rotation, rotation_distance
from vd.train.checkpoint import list_checkpoints
from vd.train.config import RunCfg
from vd.train.student.config import PretrainCfg
from vd.train.student.pretrain import (
    OBJECT_RANGE_M,
    Pretrainer,
    RandomScenes,
)
from vd.vision.rotations import angle_between, multiply, random_rotations, two_columns
from vd.vision.cfg import EncoderCfg, NoiseCfg, StudentCfg
from vd.vision.network import Student
from vd.vision.saved import StudentSpec

NETWORK = StudentCfg(
    encoder=EncoderCfg(channels=(8, 16), blocks=0, embedding=30), voxel_m=0.015, memory=8, head_hidden=8
)
QUICK = PretrainCfg(batch=16, steps=3, learning_rate=3e-3)
JOINTS = 9


@pytest.fixture(scope="module")
def assets():
    return load_hand("dclaw3"), load_set(["cube", "cuboid"])


def make(assets, cfg=QUICK, *, seed=0, noise=None, scales=(1.0,), out=Path("unused")):
    torch.manual_seed(seed)
    hand, objects = assets
    scenes = RandomScenes(
        hand,
        objects,
        NETWORK,
        scales=scales,
        noise=noise,
        batch=cfg.batch,
        device="cpu",
    )
    return Pretrainer(
        scenes,
        Student(NETWORK, JOINTS),
        len(objects),
        cfg,
        RunCfg(out=out, device="cpu", save_every=1, tensorboard=False),
        spec=StudentSpec(network=NETWORK, num_actions=JOINTS, stage=0),
        task={},
        depth=to_dict(NoiseCfg()),
        device="cpu",
    )


def test_rotations_agree_with_scipys():
    torch.manual_seed(0)
    a, b = (random_rotations(50, torch.device("cpu")) for _ in range(2))
    first, second = Rotation.from_quat(a.numpy()), Rotation.from_quat(b.numpy())
    between = first * second.inv()
    np.testing.assert_allclose(rotation_distance(a, b), between.magnitude(), atol=1e-5)
    difference = Rotation.from_quat(relative_rotation(a, b).numpy())
    assert (difference * between.inv()).magnitude().max() < 1e-5
    assert (Rotation.from_quat(multiply(a, b).numpy()) * (first * second).inv()).magnitude().max() < 1e-5
    columns = two_columns(relative_rotation(a, b))
    matrix = between.as_matrix()
    np.testing.assert_allclose(columns, np.concatenate([matrix[:, :, 0], matrix[:, :, 1]], axis=1), atol=1e-5)
    np.testing.assert_allclose(angle_between(columns), between.magnitude(), atol=2e-3)
    apart = angle_between(two_columns(a), two_columns(b))
    np.testing.assert_allclose(apart, (first.inv() * second).magnitude(), atol=2e-3)


def test_scenes_are_what_their_targets_say(assets):
    """Read back from the points: where the joints put the links, and how far object and goal are apart."""
    hand, objects = assets
    scenes = make(assets, replace(QUICK, batch=8), scales=(0.95, 1.05)).scenes
    _, targets = scenes.draw()
    points = scenes._points.numpy()
    clouds = scenes._clouds
    middle, half = 0.5 * (hand.upper + hand.lower), 0.5 * (hand.upper - hand.lower)
    for row in range(8):
        item = objects[int(targets["category"][row])].surface_points
        seen = [points[row, part] - points[row, part].mean(axis=0) for part in (clouds.item, clouds.goal)]
        item = item - item.mean(axis=0)
        turns = [Rotation.align_vectors(cloud, item)[0] for cloud in seen]
        factor = [np.linalg.norm(cloud) / np.linalg.norm(item) for cloud in seen]
        np.testing.assert_allclose(factor, factor[0], rtol=1e-4)
        assert min(abs(factor[0] - scale) for scale in (0.95, 1.05)) < 1e-3
        assert (turns[0] * turns[1].inv()).magnitude() == pytest.approx(
            float(targets["distance"][row]), abs=2e-3
        )
        links = hand.forward_kinematics(middle + half * targets["joints"][row].numpy())
        last = links[hand.point_link[-1]]
        expected = Rotation.from_quat(last[3:]).apply(hand.link_points[-1]) + last[:3]
        np.testing.assert_allclose(points[row, clouds.hand][-500:], expected, atol=2e-5)


def test_objects_stay_in_their_box_and_half_of_the_goals_are_near(assets):
    scenes = make(assets, replace(QUICK, batch=400)).scenes
    _, targets = scenes.draw()
    position = wp.to_torch(scenes._body_q)[:, -1, :3].numpy()
    low, high = np.array(OBJECT_RANGE_M).T
    assert (position >= low - 1e-6).all() and (position <= high + 1e-6).all()
    assert np.ptp(position, axis=0) == pytest.approx(high - low, rel=0.1)
    share = np.mean(targets["distance"].numpy() < 0.4)
    assert share == pytest.approx(0.5 * 0.4 / np.pi, abs=0.05)  # half are uniform in the angle
    assert targets["joints"].abs().max() <= 1.0 and set(targets["category"].tolist()) == {0, 1}


def test_the_encoder_learns_and_what_follows_it_does_not(assets):
    trainer = make(assets)
    policy = trainer.student.mean.weight.clone()
    batch = trainer.scenes.draw()
    first = sum(float(loss.detach()) for loss in trainer.losses(*batch)[0].values())
    for _ in range(25):
        trainer.optimizer.zero_grad()
        losses, figures = trainer.losses(*batch)
        sum(losses.values()).backward()
        trainer.optimizer.step()
    assert sum(float(loss.detach()) for loss in losses.values()) < 0.7 * first
    assert {"student/category", "student/distance_error", "student/joint_error"} <= figures.keys()
    torch.testing.assert_close(trainer.student.mean.weight, policy, rtol=1e-3, atol=1e-5)


def test_pre_training_goes_on_as_if_it_had_not_stopped(assets, tmp_path):
    def runner(name, seed=0):
        return make(assets, seed=seed, noise=NoiseCfg(), out=tmp_path / name)

    whole = runner("whole")
    whole.learn(2)
    runner("parts").learn(1)
    again = runner("parts", seed=7)
    again.load(list_checkpoints(tmp_path / "parts")[-1])
    again.learn(1)
    np.testing.assert_array_equal(weights(again.student), weights(whole.student))
