"""Pooling that turns with a cloud: equivariance, what it may depend on, and that it learns a rotation."""

import dataclasses

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial.transform import Rotation

from vd.quaternions import relative_rotation
from vd.train.student.rotations import angle_between, random_rotations, two_columns
from vd.vision.cfg import EncoderCfg, StudentCfg, TurnCfg
from vd.vision.match import PointMatch, orthogonal
from vd.vision.network import Student
from vd.vision.turn import ShapeVectors, TurnEncoder
from vd.vision.voxels import Voxeliser

SIZES = TurnCfg(vectors=4, rounds=2, hidden=8, pairs=3)
GOAL_POINTS, HAND_POINTS, ITEM_POINTS = 60, 40, 60
ENDS = (GOAL_POINTS, GOAL_POINTS + HAND_POINTS)
GOAL_PLACE, HAND_PLACE = (0.0, 0.0, -0.3), (0.3, 0.0, 0.0)


def shape(points: int = ITEM_POINTS, seed: int = 0) -> np.ndarray:
    """An irregular cloud [P, 3], some centimetres wide."""
    return np.random.default_rng(seed).normal(size=(points, 3)) * (0.03, 0.02, 0.01)


def scene(item: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Goal, hand and object, apart from each other [1, P, 3]."""
    hand = shape(HAND_POINTS, seed=9) + HAND_PLACE
    return np.concatenate([goal + GOAL_PLACE, hand, item])[None].astype(np.float32)


def voxels(points: np.ndarray, device: str):
    return Voxeliser(device=device)(wp.array(points, dtype=wp.vec3, device=device), ends=ENDS)


def turn_encoder(device: str) -> TurnEncoder:
    torch.manual_seed(0)
    return TurnEncoder(SIZES, 0.005, 16).to(wp.device_to_torch(device)).eval()


def test_vectors_and_tensors_turn_with_the_cloud():
    torch.manual_seed(0)
    pool = ShapeVectors(SIZES).double()
    points = torch.from_numpy(shape() / 0.05)[None]
    present = torch.ones_like(points[..., :1])
    matrix = torch.from_numpy(Rotation.random(random_state=1).as_matrix())
    here, there = pool(points, present, whole=True), pool(points @ matrix.T + 3.0, present, whole=True)
    torch.testing.assert_close(there.vectors, here.vectors @ matrix.T)
    torch.testing.assert_close(there.tensors, matrix @ here.tensors @ matrix.T)
    torch.testing.assert_close(there.seen, here.seen)
    assert here.vectors.norm(dim=-1).min() > 0.05  # they do say something


def test_absent_points_count_for_nothing():
    torch.manual_seed(0)
    pool = ShapeVectors(SIZES)
    points = torch.from_numpy(shape() / 0.05).float()[None]
    present = torch.ones_like(points[..., :1])
    more = torch.cat([points, torch.full((1, 7, 3), 5.0)], dim=1)
    fewer = torch.cat([present, torch.zeros(1, 7, 1)], dim=1)
    one, other = pool(points, present, whole=False), pool(more, fewer, whole=False)
    torch.testing.assert_close(one.vectors, other.vectors)
    torch.testing.assert_close(one.tensors, other.tensors)
    match = PointMatch(SIZES, pool.values)
    found = [
        match((one.points, shape.points), (one.seen, shape.seen), (present, shape.present))
        for shape in (one, other)
    ]
    torch.testing.assert_close(found[0], found[1])
    found, _ = match((other.points, one.points), (other.seen, one.seen), (fewer, present))
    torch.testing.assert_close(
        found, match(*(((part), (part)) for part in (one.points, one.seen, present)))[0]
    )


def test_places_are_those_of_the_voxels_of_each_cloud(device):
    clouds = np.concatenate([scene(shape(seed=i), shape(seed=i)) for i in range(3)])
    sites = voxels(clouds, device)
    item, goal = sites.item, sites.goal
    assert not (item & goal).any()
    points, present = sites.places(goal, GOAL_POINTS)
    for i in range(3):
        own = np.unique(np.floor(clouds[i, :GOAL_POINTS] / 0.005), axis=0) + 0.5
        found = points[i][present[i, :, 0] > 0].cpu().numpy()
        assert np.array_equal(own, np.unique(found, axis=0))
    most, whole = 7, [points[i][present[i, :, 0] > 0] for i in range(3)]
    points, present = sites.places(goal, most)
    assert points.shape == (3, most, 3) and present.all()
    for all_of_them, some in zip(whole, points, strict=True):
        rows = [(all_of_them == point).all(dim=1).nonzero().item() for point in some]
        steps = np.diff([*rows, len(all_of_them)])
        assert rows[0] == 0 and max(steps) - min(steps) <= 1  # as far apart as can be
    points, present = sites.places(torch.zeros_like(goal), most)
    assert points.shape == (3, 1, 3) and not present.any()


def test_the_object_has_no_voxel_that_touches_the_hand(device):
    points = scene(shape(), shape())
    seen = points[0, ENDS[0] : ENDS[1]] + np.float32(0.005)  # the camera's points of the hand, beside its own
    sites = voxels(np.concatenate([points, seen[None]], axis=1), device)
    item, own = sites.item, np.floor(points[0] / 0.005)
    found = sites.coordinates[item][:, 1:].cpu().numpy()
    assert set(map(tuple, found)) == set(map(tuple, own[ENDS[1] :].astype(int)))
    assert len(sites) > len(np.unique(own, axis=0))  # some of what the camera sees is not marked
    whole = sites.fresh()
    whole.complete = True  # then all without a mark is the object's
    assert torch.equal(whole.item, (sites.marks == 0).all(dim=1)) and whole.item.sum() > item.sum()


def test_embedding_sees_shapes_but_not_places_nor_the_hand(device):
    net = turn_encoder(device)
    turned = shape() @ Rotation.random(random_state=2).as_matrix().T
    points = scene(turned, shape())
    first, _ = net(voxels(points, device))
    moved = points.copy()
    moved[:, ENDS[1] :] += np.float32(0.04)  # 8 voxels, away from goal and hand
    moved[:, ENDS[0] : ENDS[1]] *= np.float32(1.1)
    torch.testing.assert_close(net(voxels(moved, device))[0], first, rtol=1e-4, atol=1e-5)
    other, _ = net(voxels(scene(shape(), shape()), device))
    assert (other - first).abs().max() > 1e-3


def test_every_pair_of_frames_tells_the_rotation(device):
    """Whatever the weights are: all that voxels leave is the rounding of places to a cell."""
    net = turn_encoder(device)
    turn = Rotation.random(random_state=3).as_matrix()
    points = scene(shape() @ turn.T, shape())
    sites = Voxeliser(0.0005, device=device)(wp.array(points, dtype=wp.vec3, device=device), ends=ENDS)
    net.scale *= 0.1
    net.pairs.weight.data *= 10.0  # long vectors have length 1 in the frames
    now, aim = (
        net._frames(net._shape(sites, which, whole=bool(whole)))[0]
        for whole, which in enumerate((sites.item, sites.goal))
    )
    expected = torch.from_numpy(turn).float().to(now.device).expand(1, SIZES.pairs, 3, 3)
    torch.testing.assert_close(now @ aim.mT, expected, rtol=0.0, atol=0.05)


def test_goal_apart_gives_the_same(device):
    net = turn_encoder(device)
    points = scene(shape(seed=1), shape())
    voxelise = Voxeliser(device=device)
    whole, _ = net(voxels(points, device))
    parts = [wp.array(part, dtype=wp.vec3, device=device) for part in np.split(points, [GOAL_POINTS], axis=1)]
    goal = voxelise(parts[0], ends=(GOAL_POINTS, GOAL_POINTS))
    rest = voxelise(parts[1], ends=(0, HAND_POINTS))
    torch.testing.assert_close(net(rest, goal)[0], whole)


def test_a_cloud_without_an_object_is_finite(device):
    points = scene(np.full((ITEM_POINTS, 3), np.nan), shape())
    net = turn_encoder(device)
    found, _ = net(voxels(points, device))
    found.sum().backward()
    assert torch.isfinite(found).all()
    assert all(p.grad is None or torch.isfinite(p.grad).all() for p in net.parameters())


def test_needs_marks(device):
    cfg = StudentCfg(turn=SIZES, encoder=EncoderCfg(inputs=("constant",)))
    with pytest.raises(ValueError, match="add marks"):
        Student(cfg, 9)
    with pytest.raises(ValueError, match="vectors"):
        Student(dataclasses.replace(cfg, turn=TurnCfg(vectors=-1)), 9)
    bare = Voxeliser(device=device)(wp.array(scene(shape(), shape()), dtype=wp.vec3, device=device))
    with pytest.raises(ValueError, match="marks"):
        turn_encoder(device)(bare)


def test_gradients_agree_with_finite_differences():
    torch.manual_seed(0)
    pool = ShapeVectors(TurnCfg(vectors=2, rounds=2, hidden=3)).double()
    points = torch.from_numpy(shape(6) / 0.05)[None]
    present = torch.ones_like(points[..., :1])
    parameters = tuple(pool.parameters())

    def outputs(*values):
        names = [name for name, _ in pool.named_parameters()]
        state = dict(zip(names, values, strict=True))
        found = torch.func.functional_call(pool, state, (points, present), {"whole": True})
        return found.vectors, found.tensors, found.seen

    assert torch.autograd.gradcheck(outputs, parameters)


def test_relative_rotation_is_learned_where_neither_cloud_alone_says_anything():
    torch.manual_seed(0)
    torch.set_num_threads(1)
    pool, head = ShapeVectors(TurnCfg(vectors=8, rounds=2, hidden=16)), torch.nn.Linear(9, 6)
    weights = torch.nn.Parameter(torch.ones(8))
    optimizer = torch.optim.Adam([*pool.parameters(), *head.parameters(), weights], lr=5e-3)
    cloud = torch.from_numpy(shape(48) / 0.05).float()
    cloud[:, 0] += cloud[:, 1].square() + cloud[:, 2].abs()  # no symmetry
    present, errors = torch.ones(32, 48, 1), []
    for _ in range(600):
        turn, goal = (random_rotations(32, torch.device("cpu")) for _ in range(2))
        clouds = [
            cloud @ torch.from_numpy(Rotation.from_quat(q.numpy()).as_matrix()).float().mT
            for q in (turn, goal)
        ]
        one, other = (pool(points, present, whole=False).vectors for points in clouds)
        predicted = head(torch.einsum("k,bki,bkj->bij", weights, one, other).flatten(1))
        true = two_columns(relative_rotation(turn, goal))
        loss = (predicted - true).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        errors.append(float(angle_between(predicted.detach(), true).mean()))
    assert np.mean(errors[-20:]) < 0.3  # of any guess the mean is 2.2


def test_matched_points_tell_the_rotation_whichever_part_is_seen():
    """With descriptions that say where on the shape a point is, half of it is enough."""
    torch.manual_seed(0)
    cfg = dataclasses.replace(SIZES, match=16)
    match = PointMatch(cfg, 3)
    goal = torch.from_numpy(shape(80) / 0.05).float()
    frequencies = 8.0 * torch.randn(3, cfg.match // 2)
    match.describe = torch.nn.Module()  # waves over the shape: alike where they are near

    def describe(places):
        waves = torch.cat([(places @ frequencies).sin(), (places @ frequencies).cos()], dim=-1)
        return torch.cat([6.0 * waves, torch.zeros_like(places[..., :1])], dim=-1)

    match.describe.forward = describe
    turn = torch.from_numpy(Rotation.random(random_state=4).as_matrix()).float()
    part = goal[goal[:, 0] > 0.0]
    own = (part - part.mean(dim=0)) @ turn.T
    ones = (torch.ones(1, len(part), 1), torch.ones(1, len(goal), 1))
    found, places = match((own[None], goal[None]), (part[None], goal[None]), ones)
    assert (places[0] - part).norm(dim=1).median() < 0.1  # of shapes of about one
    rotation, scaled = found[0, :9].view(3, 3), found[0, 9:18].view(3, 3)
    torch.testing.assert_close(rotation, turn, rtol=0.0, atol=0.05)
    assert float(scaled.norm()) == pytest.approx(1.0, abs=0.01) and float(found[0, -1]) > 0.0


def test_the_nearest_rotation_is_that_of_the_singular_values():
    torch.manual_seed(0)
    left, right = (torch.linalg.qr(torch.randn(20, 3, 3, dtype=torch.double))[0] for _ in range(2))
    values = torch.tensor([0.8, 0.5, 0.2], dtype=torch.double)
    torch.testing.assert_close(orthogonal(left * values @ right), left @ right, rtol=0.0, atol=1e-4)
