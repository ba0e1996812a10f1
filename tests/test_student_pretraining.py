"""Stage 0: random scenes and their targets, heads, learning, resuming."""

from dataclasses import replace

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
from vd.sensors.cfg import DepthCameraCfg
from vd.train.checkpoint import list_checkpoints
from vd.train.config import RunCfg
from vd.train.student.config import PretrainCfg
from vd.train.student.losses import match_loss
from vd.train.student.pretrain import (
    OBJECT_RANGE_M,
    Pretrainer,
    PretrainHeads,
    RandomScenes,
)
from vd.train.student.rotations import angle_between, multiply, random_rotations, two_columns
from vd.train.student.runner import StudentRunner
from vd.vision.cfg import EncoderCfg, NoiseCfg, StudentCfg
from vd.vision.match import Matches
from vd.vision.network import Student
from vd.vision.saved import StudentSpec

NETWORK = StudentCfg(
    encoder=EncoderCfg(channels=(8, 16), blocks=0, embedding=30), voxel_m=0.015, memory=8, head_hidden=8
)
QUICK = PretrainCfg(batch=16, steps=3, learning_rate=3e-3, near_share=0.5)
JOINTS = 9


@pytest.fixture(scope="module")
def assets():
    return load_hand("dclaw3"), load_set(["cube", "cuboid"])


def make(assets, cfg=QUICK, *, seed=0, noise=None, scales=(1.0,)):
    torch.manual_seed(seed)
    hand, objects = assets
    scenes = RandomScenes(
        hand,
        objects,
        NETWORK,
        scales=scales,
        near_share=cfg.near_share,
        noise=noise,
        batch=cfg.batch,
        device="cpu",
    )
    return Pretrainer(scenes, Student(NETWORK, JOINTS), len(objects), cfg)


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


def test_matched_points_are_right_where_the_goal_has_them(assets):
    """Samples of goal and object are the same points of the shape, in the same order."""
    scenes = make(assets, replace(QUICK, batch=8), scales=(0.95, 1.05)).scenes
    _, targets = scenes.draw()
    points, clouds = wp.to_torch(scenes._points), scenes._clouds
    item, goal = points[:, clouds.item], points[:, clouds.goal]
    poses = {"body_q": targets["body_q"], "goal_quat": targets["goal"]}
    present = torch.ones_like(item[..., :1])
    assert float(match_loss(Matches(item, goal, present), **poses)) < 1e-4
    off = torch.tensor([0.0, 0.0, 0.02])  # 0.4 units: beyond the bend, 0.4 - 0.5 x 0.2
    assert float(match_loss(Matches(item, goal + off, present), **poses)) == pytest.approx(0.3, rel=1e-3)
    present[:, 250:] = 0.0
    wrong = torch.cat([goal[:, :250], goal[:, 250:] + 1.0], dim=1)
    assert float(match_loss(Matches(item, wrong, present), **poses)) < 1e-4


def test_a_part_of_the_scenes_is_seen_by_a_camera(assets):
    """From the camera's side: of the object what faces it, near its surface, and some of the hand."""
    torch.manual_seed(0)
    hand, objects = assets
    scenes = RandomScenes(
        hand,
        objects,
        NETWORK,
        rendered_share=0.5,
        depth=DepthCameraCfg(points=400),
        noise=NoiseCfg(),
        batch=12,
        device="cpu",
    )
    first = scenes.state_dict()
    (sites,), targets = scenes.draw()
    assert not sites.complete and targets["category"][:6].tolist() == [0, 1] * 3
    clouds, points = scenes._clouds, scenes._points.numpy()
    body_q = wp.to_torch(scenes._body_q).numpy()
    base = Rotation.from_quat(body_q[:, 0, 3:])
    for row in range(12):
        own = points[row, clouds.item.start :]
        own = own[np.isfinite(own).all(axis=1)]
        place = base[row].inv().apply(body_q[row, -1, :3] - body_q[row, 0, :3])
        near = own[np.linalg.norm(own - place, axis=1) < 0.12] - place
        towards = hand.camera.position - place
        depth = near @ (towards / np.linalg.norm(towards))
        if row < 6:
            assert 0 < len(own) <= 400 and depth.mean() > 0.005
        else:
            assert len(own) == 500 and abs(depth.mean()) < 0.02
    again = wp.clone(scenes._points)
    torch.manual_seed(0)
    scenes.load_state_dict(first)
    scenes.draw()
    np.testing.assert_array_equal(scenes._points.numpy(), again.numpy())
    with pytest.raises(ValueError, match="rendered-share"):
        RandomScenes(hand, objects, NETWORK, rendered_share=0.1, batch=12, device="cpu")


def test_objects_stay_in_their_box_and_goals_are_near_as_asked(assets):
    scenes = make(assets, replace(QUICK, batch=400, near_share=1.0)).scenes
    _, targets = scenes.draw()
    position = wp.to_torch(scenes._body_q)[:, -1, :3].numpy()
    low, high = np.array(OBJECT_RANGE_M).T
    assert (position >= low - 1e-6).all() and (position <= high + 1e-6).all()
    assert np.ptp(position, axis=0) == pytest.approx(high - low, rel=0.1)
    share = np.mean(targets["distance"].numpy() < 0.4)
    assert share == pytest.approx(0.4 / np.pi, abs=0.05)  # uniform in the angle
    scenes = make(assets, replace(QUICK, batch=400, near_share=0.0)).scenes
    assert np.mean(scenes.draw()[1]["distance"].numpy()) == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.15)
    assert targets["joints"].abs().max() <= 1.0 and set(targets["category"].tolist()) == {0, 1}


@pytest.mark.parametrize("distance", ["scalar", "6d"])
@pytest.mark.parametrize("embedding", ["single", "split"])
def test_every_variant_learns(assets, distance, embedding):
    trainer = make(assets, replace(QUICK, distance=distance, embedding=embedding))
    batch = trainer.scenes.draw()
    first = float(trainer.losses(*batch)[0].detach())
    for _ in range(25):
        trainer.optimizer.zero_grad()
        loss, figures = trainer.losses(*batch)
        loss.backward()
        trainer.optimizer.step()
    assert float(loss.detach()) < 0.7 * first
    assert {"student/category", "student/distance_error", "student/joint_error"} <= figures.keys()


def test_a_split_embedding_keeps_the_parts_apart(assets):
    """The category reads the object's part only, the joints the hand's."""
    trainer = make(assets, replace(QUICK, embedding="split"))
    embedding = torch.randn(4, 30, requires_grad=True)
    outputs = trainer.heads(embedding, trainer.student)
    reads = {
        name: torch.autograd.grad(value.sum(), embedding, retain_graph=True)[0].any(dim=0)
        for name, value in outputs.items()
    }
    part = torch.arange(30) // 10
    assert torch.equal(reads["category"], part == 0)
    assert torch.equal(reads["distance"], part <= 1)
    assert torch.equal(reads["joints"], part == 2)


def test_the_students_own_head_is_trained_where_it_has_one(assets):
    student = Student(NETWORK, JOINTS)
    assert "distance" not in PretrainHeads(student, PretrainCfg(), 2).heads
    assert "distance" in PretrainHeads(student, PretrainCfg(embedding="split"), 2).heads
    blind = Student(replace(NETWORK, distance=("after",)), JOINTS)
    assert "distance" in PretrainHeads(blind, PretrainCfg(), 2).heads
    none = PretrainHeads(student, PretrainCfg(distance_weight=0.0, category_weight=0.0), 2)
    assert set(none(torch.randn(1, 30), student)) == {"joints"}
    trainer = make(assets)
    before = trainer.student.distance["before"][0].weight.clone()
    policy = trainer.student.mean.weight.clone()
    trainer.iterate(lambda: False)
    assert not torch.equal(trainer.student.distance["before"][0].weight, before)
    # what stage 0 does not train only decays
    torch.testing.assert_close(trainer.student.mean.weight, policy, rtol=1e-3, atol=1e-5)


def test_pre_training_goes_on_as_if_it_had_not_stopped(assets, tmp_path):
    def runner(name, seed=0):
        return StudentRunner(
            make(assets, seed=seed, noise=NoiseCfg()),
            RunCfg(out=tmp_path / name, device="cpu", save_every=1, tensorboard=False),
            spec=StudentSpec(network=NETWORK, num_actions=JOINTS, stage=0),
            task={},
            depth=to_dict(NoiseCfg()),
            device="cpu",
        )

    whole = runner("whole")
    whole.learn(2)
    runner("parts").learn(1)
    again = runner("parts", seed=7)
    again.load(list_checkpoints(tmp_path / "parts")[-1])
    again.learn(1)
    np.testing.assert_array_equal(weights(again.learner.student), weights(whole.learner.student))
