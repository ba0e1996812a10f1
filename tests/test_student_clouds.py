"""Clouds of scenes: what is authored in USD, carried by the simulator's poses, and their noise."""

import numpy as np
import pytest
import warp as wp

from vd.assets_usd.hand_data import compose
from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.clouds import HandKinematics, SceneClouds
from vd.paper import PAPER
from vd.sim.scene import hand_mount
from vd.vision.cfg import NoiseCfg
from vd.vision.voxels import Voxeliser


@pytest.fixture(scope="module")
def assets():
    return load_hand("dclaw4"), load_set("cube")


def scene(assets, device, *, scales=(1.0,)):
    """Clouds of environments that differ in the size of the object, and their (equal) poses."""
    hand, objects = assets
    links = len(hand.link_names)
    clouds = SceneClouds(
        hand,
        objects,
        link_body=np.arange(links),
        object_body=links,
        world_object=np.zeros(len(scales), np.int32),
        world_scale=np.array(scales),
        device=device,
    )
    q = np.tile(PAPER.scene.reset_joint_rad, hand.num_fingers)
    poses = np.concatenate(
        [compose(np.array(hand_mount()), hand.forward_kinematics(q)), [[0.01, 0.02, 0.1, 0, 0, 0, 1]]]
    )
    body_q = wp.array(np.tile(poses, (len(scales), 1, 1)), dtype=wp.transform, device=device)
    goal = wp.array(np.tile([0, 0, 0, 1.0], (len(scales), 1)), dtype=wp.quat, device=device)
    return clouds, body_q, goal


def written(clouds, body_q, goal, **options):
    points = wp.full(
        (body_q.shape[0], clouds.item.stop), wp.vec3(np.nan), dtype=wp.vec3, device=clouds.device
    )
    clouds.write(points, body_q, goal, **options)
    return points.numpy()


def test_a_cloud_has_the_papers_points_where_the_parts_are(assets, device):
    hand = assets[0]
    clouds, body_q, goal = scene(assets, device)
    points = written(clouds, body_q, goal)[0]
    per_link, per_object = PAPER.cloud.points_per_link, PAPER.cloud.object_points
    assert points.shape == (16 * per_link + 2 * per_object, 3)
    np.testing.assert_allclose(points[clouds.goal].mean(0), PAPER.cloud.goal_position_m, atol=2e-3)
    # base frame: turned pi about y at 0.25 m, so x and z are mirrored
    np.testing.assert_allclose(points[clouds.item].mean(0), [-0.01, 0.02, 0.15], atol=2e-3)
    q = np.tile(PAPER.scene.reset_joint_rad, hand.num_fingers)
    links = hand.forward_kinematics(q)
    last = links[hand.point_link[-1]]
    expected = compose(last, np.c_[hand.link_points[-1], np.tile([0, 0, 0, 1.0], (per_link, 1))])[:, :3]
    np.testing.assert_allclose(points[clouds.hand][-per_link:], expected, atol=1e-6)
    # the goal lies apart from everything else: that is all that tells it from the scene
    rest = points[clouds.hand.start :]
    assert points[clouds.goal][:, 2].max() < rest[:, 2].min()


def test_rows_are_of_their_worlds_which_differ_in_size(assets, device):
    clouds, body_q, goal = scene(assets, device, scales=(1.0, 1.05))
    points = written(clouds, body_q, goal)
    for part in (clouds.goal, clouds.item):
        size = np.ptp(points[:, part], axis=1)
        np.testing.assert_allclose(size[1], 1.05 * size[0], rtol=1e-4)
    np.testing.assert_array_equal(*points[:, clouds.hand])
    envs = wp.array([1, 0, 1], dtype=wp.int32, device=device)
    again = [
        wp.array(np.repeat(a.numpy()[:1], 3, axis=0), dtype=a.dtype, device=device) for a in (body_q, goal)
    ]
    np.testing.assert_array_equal(written(clouds, *again, envs=envs), points[[1, 0, 1]])


def test_without_the_object_its_columns_are_left_to_a_camera(assets, device):
    clouds, body_q, goal = scene(assets, device)
    points = written(clouds, body_q, goal, with_object=False)
    assert np.isnan(points[:, clouds.item]).all()
    assert np.isfinite(points[:, : clouds.item.start]).all()


@pytest.mark.parametrize("name", ["dclaw3", "dclaw4"])
def test_kinematics_match_the_hands(name, device):
    hand = load_hand(name)
    generator = np.random.default_rng(0)
    q = generator.uniform(hand.lower, hand.upper, (20, hand.num_joints))
    links = generator.permutation(len(hand.link_names) + 2)[: len(hand.link_names)]
    base = compose(np.array(hand_mount()), np.array([0.1, 0, 0, 0, 0, 0, 1.0]))
    kinematics = HandKinematics(hand, link_body=links, base=base, device=device)
    body_q = wp.full((20, len(links) + 2), wp.transform(*[np.nan] * 7), dtype=wp.transform, device=device)
    kinematics.write(wp.array(q, dtype=float, device=device), body_q)
    poses, expected = body_q.numpy(), compose(base, hand.forward_kinematics(q))
    np.testing.assert_allclose(poses[:, links, :3], expected[..., :3], atol=1e-6)
    aligned = np.abs(np.sum(poses[:, links, 3:] * expected[..., 3:], axis=-1))
    np.testing.assert_allclose(aligned, 1.0, atol=1e-6)
    assert np.isnan(np.delete(poses, links, axis=1)).all()


def test_noise_only_where_asked_for_and_never_shared(device):
    points = np.tile(np.random.default_rng(0).normal(size=(1, 500, 3)).astype(np.float32) * 0.05, (3, 1, 1))
    array = wp.array(points, dtype=wp.vec3, device=device)
    always = NoiseCfg(jitter_probability=1.0, dropout_probability=1.0)
    voxelise = Voxeliser(noise=always, clouds=3, seed=1, device=device)

    def split(sites):
        rows = sites.coordinates.cpu().numpy()
        return [rows[rows[:, 0] == cloud][:, 1:].tobytes() for cloud in range(3)]

    assert len(set(split(voxelise(array)))) == 1
    first, second = split(voxelise(array, augment=True)), split(voxelise(array, augment=True))
    assert len({*first, *second}) == 6
    assert split(Voxeliser(noise=always, clouds=3, seed=1, device=device)(array, augment=True)) == first


def test_noise_must_have_been_prepared():
    points = wp.zeros((2, 1), dtype=wp.vec3, device="cpu")
    with pytest.raises(ValueError, match="noise"):
        Voxeliser()(points, augment=True)
    with pytest.raises(ValueError, match="2 clouds"):
        Voxeliser(noise=NoiseCfg(), clouds=1)(points, augment=True)
    with pytest.raises(ValueError, match="dropout_ratio"):
        Voxeliser(noise=NoiseCfg(dropout_ratio=(0.3, 0.1)), clouds=1)
    with pytest.raises(ValueError, match="jitter_probability"):
        NoiseCfg(jitter_probability=1.5).validate()
