"""What a camera sees of shapes in a hand.

Hidden sides, the hand before and beside them, goals from scans.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from vd.assets_usd.hands import load_hand
from vd.evaluate.scanned import MISSING
from vd.train.student.shapes import made_shapes
from vd.train.student.views import (
    POINT_STD_M,
    TOUCH_M,
    Hands,
    draw_pairs,
    goal_points,
    own_points,
    posture_points,
    visible,
)
from vd.vision.rotations import turn_angle

CPU = torch.device("cpu")
COUNT = 128


@pytest.fixture(scope="module")
def hand():
    return load_hand("dclaw3")


@pytest.fixture(scope="module")
def hands(hand):
    torch.manual_seed(0)
    return Hands(hand, 8, device="cpu")


@pytest.fixture
def shapes():
    torch.manual_seed(1)
    return made_shapes(16, 5 * COUNT, (0.085, 0.165), CPU)


def plates(hands, gap_m):
    """Two plates across the line of sight, both facing the camera, one behind the other.

    [1, 800, 6].
    """
    middle = hands.box.mean(dim=0)
    towards = torch.nn.functional.normalize(hands.eye[0] - middle, dim=0)
    side = torch.nn.functional.normalize(torch.linalg.cross(towards, torch.eye(3)[2]), dim=0)
    grid = torch.stack(
        torch.meshgrid(*2 * [torch.linspace(-0.03, 0.03, 20)], indexing="ij"), -1
    ).reshape(-1, 2)
    front = middle + grid[:, :1] * side + grid[:, 1:] * torch.linalg.cross(towards, side)
    points = torch.cat([front, front - gap_m * towards])
    return torch.cat([points, towards.expand(len(points), 3)], dim=1)[None]


def empty(hands, monkeypatch):
    """The same camera without a hand."""
    monkeypatch.setattr(hands, "_depth", torch.full_like(hands._depth, torch.inf))
    monkeypatch.setattr(hands, "_near", torch.zeros_like(hands._near))


def test_what_is_before_hides_what_is_behind(hands, monkeypatch):
    empty(hands, monkeypatch)
    row = torch.zeros(1, dtype=torch.long)
    shown = visible(hands, row, plates(hands, 0.05))[0]
    # Perspective lets its rim be seen.
    assert shown[:400].all() and shown[400:].float().mean() < 0.15
    turned = plates(hands, 0.05) * torch.tensor([1.0, 1, 1, -1, -1, -1])
    assert not visible(hands, row, turned)[0].any(), "a surface shows its outside alone"


@pytest.mark.parametrize("camera_range", [(0.0, 0.0), (0.05, 0.087)])
def test_the_hand_hides_what_is_behind_it_and_takes_what_it_touches(hand, camera_range):
    """Against a search through all of the hand's points, angle by angle."""
    torch.manual_seed(3)
    one = Hands(hand, 1, camera_range=camera_range, device="cpu")
    own = posture_points(hand, one.joints)[0].double().numpy()
    points = one.box[0] - 0.05 + (one.box[1] - one.box[0] + 0.1) * torch.rand(1, 1500, 3)
    row = torch.zeros(1, dtype=torch.long)
    cell, depth = one.project(row, points)
    free = (one.before(row, cell, depth) & ~one.near(row, points))[0].numpy()
    eye = one.eye[0].double().numpy()
    optical = Rotation.from_matrix(one._optical[0].numpy()).inv()
    moved = np.abs(eye - hand.camera.position).max()
    assert (moved > 0.005) == (camera_range[0] > 0.0)
    at, there = (optical.apply(x - eye) for x in (points[0].double().numpy(), own))
    across = np.linalg.norm(
        (at[:, None, :2] / at[:, None, 2:] - there[None, :, :2] / there[None, :, 2:]), axis=-1
    )
    width = float(one._cell[0])
    before = there[None, :, 2] < at[:, None, 2]
    hidden = (before & (across < 0.3 * width)).any(axis=1)
    clear = ~(before & (across < 1.5 * width)).any(axis=1)
    apart = np.linalg.norm(points[0].numpy()[:, None] - own[None], axis=-1).min(axis=1)
    assert hidden.sum() > 50 and clear.sum() > 300
    assert not free[hidden & (apart > 2 * TOUCH_M)].any() or free[hidden].mean() < 0.3
    assert free[clear & (apart > 2 * TOUCH_M)].all()
    touching = one._near[0, one._voxel(torch.tensor(own[None], dtype=torch.float32))[0]]
    assert touching.float().mean() > 0.5  # the rest lies outside of where objects are


def test_of_a_hand_a_camera_has_what_neither_it_nor_an_object_hides(hand):
    """Against a search through all points, angle by angle."""
    torch.manual_seed(5)
    one = Hands(hand, 1, device="cpu")
    own = posture_points(hand, one.joints)
    middle = one.box.mean(dim=0)
    ball = middle + 0.04 * torch.nn.functional.normalize(torch.randn(1, 4000, 3), dim=-1)
    seen = own_points(one, torch.zeros(1, dtype=torch.long), ball, own)[0].numpy()
    shown = np.isfinite(seen).all(axis=1)
    assert np.abs(seen - own[0].numpy())[shown].max() < 6 * POINT_STD_M
    optical = Rotation.from_matrix(one._optical[0].numpy()).inv()
    there = optical.apply(own[0].double().numpy() - one.eye[0].double().numpy())
    blocks = np.vstack([there, optical.apply(ball[0].double().numpy() - one.eye[0].numpy())])
    place, others = (x[:, :2] / x[:, 2:] for x in (there, blocks))
    across = np.linalg.norm(place[::7, None] - others[None], axis=-1)
    behind = there[::7, None, 2] - blocks[None, :, 2]
    width = float(one._cell[0])
    hidden = ((behind > 0.025) & (across < 0.3 * width)).any(axis=1)
    clear = ~((behind > 0.006) & (across < 1.5 * width)).any(axis=1)
    assert hidden.sum() > 50 and clear.sum() > 50
    inside = one.project(torch.zeros(1, dtype=torch.long), own)[0][0].numpy()[::7] < one.cells - 1
    assert not shown[::7][hidden & inside].any()
    assert shown[::7][clear].all()


def test_a_camera_elsewhere_sees_another_side(hand, monkeypatch):
    torch.manual_seed(0)
    place = hand.camera
    behind = np.diag([-1.0, -1.0, 1.0])
    pose = (
        *(behind @ place.position),
        *(Rotation.from_matrix(behind) * Rotation.from_quat(place.quaternion)).as_quat(),
    )
    sides = []
    for camera in (None, pose):
        hands = Hands(hand, 1, camera=camera, device="cpu")
        empty(hands, monkeypatch)
        torch.manual_seed(0)
        ball = torch.nn.functional.normalize(torch.randn(1, 500, 3), dim=-1)
        shown = visible(
            hands,
            torch.zeros(1, dtype=torch.long),
            torch.cat([hands.box.mean(0) + 0.04 * ball, ball], dim=-1),
        )[0]
        sides.append(float(ball[0, shown, 0].mean()))
    assert sides[0] > 0.2 and sides[1] < -0.2


def test_objects_are_in_a_hand_that_holds_them_palm_up_and_joints_follow(hand):
    factor = np.array([0.0, 0.0, 0.5] * 3)
    mimic = np.array([-1, -1, 1, -1, -1, 4, -1, -1, 7])
    place = replace(hand.workspace, goal_m=(0.1, 0.0, 0.25), drop_m=(0.1, 0.0, 0.28))
    other = replace(
        hand,
        mount=np.array([0.1, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0]),
        workspace=place,
        mounted_camera=None,
        mimic=mimic,
        mimic_factor=factor,
    )
    hands = Hands(other, 8, camera_range=(0.05, 0.087), device="cpu")
    around = 0.4 * place.fall_m
    expected = np.array([[0, 0, 0.15], [0, 0, 0.18]]) + around * np.array([[-1.0], [1.0]])
    np.testing.assert_allclose(hands.box, expected, atol=1e-6)
    torch.testing.assert_close(hands.joints[:, 2], 0.5 * hands.joints[:, 1])
    # From above a ball's upper half is seen, by each camera.
    ball = torch.nn.functional.normalize(torch.randn(8, 500, 3), dim=-1)
    balls = torch.cat([hands.box.mean(0) + 0.03 * ball, ball], dim=-1)
    shown = visible(hands, torch.arange(8), balls)
    assert shown.any(dim=1).all() and ball[shown][:, 2].min() > -0.1


def test_pairs_lie_as_they_say(hands, shapes):
    pairs = draw_pairs(hands, shapes, COUNT, near=1.0)
    assert turn_angle(pairs.rotation).max() <= 0.9 + 1e-4
    posed = pairs.surface @ pairs.rotation.transpose(-1, -2) + pairs.offset[:, None]
    apart = torch.cdist(pairs.seen, posed).amin(dim=-1)
    spacing = torch.cdist(pairs.surface, pairs.surface).topk(2, largest=False).values[..., 1].mean()
    assert apart.mean() < spacing and apart.mean() < 0.004
    assert torch.cdist(pairs.goal, pairs.surface).amin(dim=-1).max() < 2e-4  # as exact as cdist is
    for cloud in (pairs.goal, pairs.seen):
        assert cloud.mean(dim=1).abs().max() < 1e-6 and cloud.isfinite().all()
    # From one side: what is seen covers less of the shape than the goal does.
    back = torch.cdist(posed, pairs.seen).amin(dim=-1).mean()
    assert back > 2 * torch.cdist(pairs.surface, pairs.goal).amin(dim=-1).mean()
    wide = turn_angle(draw_pairs(hands, shapes.repeat(20, 1, 1), COUNT).rotation)
    assert wide.mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.15)  # uniform on SO(3)


def test_goals_from_scans_lack_a_side_and_are_noisy():
    torch.manual_seed(0)
    ball = torch.nn.functional.normalize(torch.randn(30, 500, 3), dim=-1) * 0.05
    assert torch.equal(goal_points(ball, 500, 0.0), ball)
    scans = goal_points(ball, 500, 1.0)
    assert (scans.norm(dim=-1) - 0.05).std() == pytest.approx(0.004, rel=0.1)
    # The mean of a ball without its cap lies on the other side.
    assert scans.mean(dim=1).norm(dim=-1).mean() > 0.5 * MISSING * 0.05
