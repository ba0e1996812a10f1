"""Clouds of hands: what is authored in USD, carried by poses that joint positions give."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from vd.assets_usd.hand_data import compose
from vd.assets_usd.hands import load_hand
from vd.geometry.clouds import HandCloud


@pytest.mark.parametrize("name", ["dclaw3", "dclaw4"])
def test_poses_and_points_are_those_of_the_hand(name, device):
    hand = load_hand(name)
    generator = np.random.default_rng(0)
    q = generator.uniform(hand.lower, hand.upper, (20, hand.num_joints))
    links = generator.permutation(len(hand.link_names) + 2)[: len(hand.link_names)]
    hand = replace(hand, mount=compose(hand.mount, np.array([0.1, 0, 0, 0, 0, 0, 1.0])))
    cloud = HandCloud(hand, link_body=links, device=device)
    body_q = wp.full(
        (20, len(links) + 2), wp.transform(*[np.nan] * 7), dtype=wp.transform, device=device
    )
    cloud.pose(wp.array(q, dtype=float, device=device), body_q)
    poses, in_base = body_q.numpy(), hand.forward_kinematics(q)
    expected = compose(hand.mount, in_base)
    np.testing.assert_allclose(poses[:, links, :3], expected[..., :3], atol=1e-6)
    aligned = np.abs(np.sum(poses[:, links, 3:] * expected[..., 3:], axis=-1))
    np.testing.assert_allclose(aligned, 1.0, atol=1e-6)
    assert np.isnan(np.delete(poses, links, axis=1)).all()
    points = cloud(body_q).numpy()
    each = hand.link_points.shape[1]
    assert points.shape == (20, len(hand.point_link) * each, 3)
    for number, link in enumerate(hand.point_link):
        local = np.c_[hand.link_points[number], np.tile([0, 0, 0, 1.0], (each, 1))]
        wanted = compose(in_base[:, link, None], local)[..., :3]
        np.testing.assert_allclose(
            points[:, number * each : (number + 1) * each], wanted, atol=2e-6
        )
