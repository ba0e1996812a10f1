"""Alignment of clouds: rotations, the search with a network that is right when near, training, files."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.geometry.quaternions import relative_rotation, rotation_distance
from vd.train.alignment.align import CLOUDS, AlignTrainer, alignment_losses
from vd.train.alignment.config import AlignCfg
from vd.train.checkpoint import list_checkpoints
from vd.train.config import RunCfg
from vd.train.student.bank import ShapeBank, centred_points
from vd.train.student.shapes import made_shapes
from vd.train.student.views import Hands
from vd.vision.alignment import Aligner, AlignmentNetwork, Residual
from vd.vision.cfg import AlignmentCfg
from vd.vision.finder import LEAST, GoalFinder
from vd.vision.rotations import (
    cube_rotations,
    quaternion_matrices,
    quaternions,
    random_rotations,
    turn_angle,
)
from vd.vision.saved import AlignmentSpec, load_alignment

CPU = torch.device("cpu")
TINY = AlignmentCfg(width=16, layers=1, heads=2, tokens=12, neighbours=6, patch=8)
QUICK = AlignCfg(
    batch=16,
    steps=2,
    learning_rate=3e-3,
    warmup_steps=0,
    shapes=16,
    fresh_shapes=2,
    hands=4,
    points=48,
    validate_every=2,
    views=1,
    network=TINY,
)


def test_rotations_agree_with_scipys():
    torch.manual_seed(0)
    a, b = (random_rotations(50, CPU) for _ in range(2))
    first, second = Rotation.from_quat(a.numpy()), Rotation.from_quat(b.numpy())
    between = first * second.inv()
    np.testing.assert_allclose(rotation_distance(a, b), between.magnitude(), atol=1e-5)
    difference = Rotation.from_quat(relative_rotation(a, b).numpy())
    assert (difference * between.inv()).magnitude().max() < 1e-5
    turn = quaternion_matrices(relative_rotation(a, b))
    np.testing.assert_allclose(turn, between.as_matrix(), atol=1e-5)
    np.testing.assert_allclose(turn_angle(turn), between.magnitude(), atol=2e-3)
    every = Rotation.concatenate([first, Rotation.create_group("O")])  # of half a turn too
    back = quaternions(torch.tensor(every.as_matrix(), dtype=torch.float32))
    assert (Rotation.from_quat(back.numpy()) * every.inv()).magnitude().max() < 1e-5
    small = torch.tensor(Rotation.from_rotvec([[1e-3, 0.0, 0.0]]).as_matrix(), dtype=torch.float32)
    assert float(turn_angle(small)) == pytest.approx(1e-3, rel=1e-3)


def test_no_rotation_is_far_from_the_starts():
    starts = cube_rotations(CPU)
    torch.testing.assert_close(starts[0], torch.eye(3))
    torch.manual_seed(0)
    anywhere = quaternion_matrices(random_rotations(2000, CPU))
    apart = turn_angle(starts.transpose(-1, -2) @ anywhere[:, None]).amin(dim=1)
    assert 0.9 < apart.max() < 1.1


class NearSighted(torch.nn.Module):
    """Right by half of what is left where the goal is near the truth; else it errs.

    The goal's cloud is the three axes, so that its tokens say how it is turned.
    """

    def __init__(self, truth):
        super().__init__()
        self.truth, self.summary = truth, torch.zeros(1)

    def neighbours(self, cloud):
        """None."""
        return torch.zeros(len(cloud), 0)

    def encode(self, cloud, kind, near):
        """The cloud itself, or the number of its pair."""
        return cloud if kind == 0 else cloud[:, :1, :1]

    def compare(self, goal, seen):
        """What is left, halved."""
        turned = goal - goal[:, 3:]
        turned = torch.nn.functional.normalize(turned[:, :3], dim=-1).transpose(-1, -2)
        wanted = self.truth[seen[:, 0, 0].round().long()]
        left, near = self.halfway(turned, wanted)
        wrong = torch.tensor(
            Rotation.random(len(left), random_state=0).as_matrix(), dtype=torch.float32
        )
        return Residual(torch.where(near, left, wrong), torch.full((len(left), 3), 0.01))

    @staticmethod
    def halfway(turned, wanted):
        """Half of what is left, and where that is near."""
        left = wanted @ turned.transpose(-1, -2)
        half = torch.tensor(
            (Rotation.from_matrix(left.numpy()) ** 0.5).as_matrix(), dtype=torch.float32
        )
        return half, (turn_angle(left) < 1.2)[:, None, None]


@pytest.fixture
def near_sighted(monkeypatch):
    """Such networks; what they find is laid onto what is seen as they would, and fits as it is near."""

    def network(truth):
        made = NearSighted(truth)

        def refined(goal, normal, seen, rotation, offset, steps):
            wanted = made.truth[seen[:, 0, 0].round().long()]
            half, near = made.halfway(rotation, wanted)
            rotation = torch.where(near, half @ rotation, rotation)
            off = turn_angle(wanted.transpose(-1, -2) @ rotation)
            return rotation, torch.full_like(offset, 0.01), off

        monkeypatch.setattr("vd.vision.alignment.refine", refined)
        monkeypatch.setattr("vd.vision.alignment.normals", torch.zeros_like)
        return made

    return network


def clouds(rows):
    """Goals whose tokens say how they are turned, and seen clouds whose first token is their number."""
    axes = torch.cat([torch.eye(3), torch.zeros(1, 3)])
    seen = torch.zeros(len(rows), 2, 3)
    seen[:, 0, 0], seen[:, 1, 0] = rows, -rows
    return axes.expand(len(rows), 4, 3), seen


def test_a_first_look_finds_any_rotation_and_later_ones_improve_it(near_sighted):
    truth = torch.tensor(Rotation.random(12, random_state=1).as_matrix(), dtype=torch.float32)
    goal, seen = clouds(torch.arange(12.0))
    network, asked = near_sighted(truth), []
    compare = network.compare
    network.compare = lambda goal, seen: asked.append(len(goal)) or compare(goal, seen)
    aligner = Aligner(network, goal)
    errors = [turn_angle(aligner.look(seen).rotation.transpose(-1, -2) @ truth) for _ in range(4)]
    assert errors[0].max() < 0.2 and errors[3].max() < 0.05
    assert asked == [12 * 24, 12 * 24, 12, 12, 12, 12]  # later looks ask of one hypothesis
    found = aligner.look(seen + 0.1)
    torch.testing.assert_close(found.position, torch.full((12, 3), 0.11))


def test_a_reset_begins_anew(near_sighted):
    truth = torch.tensor(Rotation.random(2, random_state=2).as_matrix(), dtype=torch.float32)
    network = near_sighted(truth)
    goal, seen = clouds(torch.arange(2.0))
    aligner = Aligner(network, goal)
    aligner.look(seen)
    # It was wrong.
    network.truth = truth @ Rotation.from_euler("x", 2.0).as_matrix().astype(np.float32)
    aligner.reset(torch.tensor([True, False]))
    first = turn_angle(aligner.look(seen).rotation.transpose(-1, -2) @ network.truth)
    assert first[0] < 0.2 and first[1] > 0.5


def test_a_pose_is_that_of_the_frame_of_the_goals_points(near_sighted):
    """Whatever is seen as long as it is enough; what is fresh is begun anew."""
    truth = torch.tensor(Rotation.random(1, random_state=3).as_matrix(), dtype=torch.float32)
    points = 0.03 * np.concatenate([np.eye(3), np.zeros((1, 3))]) + np.array([0.01, 0.02, -0.03])
    goals = torch.tensor(0.5 * points, dtype=torch.float32).repeat(3, 1, 1)
    finder = GoalFinder(near_sighted(truth), goals)
    seen = torch.tensor([0.1, 0.2, 0.3]) + 0.001 * torch.randn(3, 20, 3)
    for look in range(4):
        finder.look(
            seen,
            torch.tensor([20, 20, LEAST - 1]),
            fresh=torch.tensor([look == 0, look == 3, True]),
        )
    assert finder.looks.tolist() == [4, 1, 0]
    assert torch.equal(finder.pose[2], torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
    found = Rotation.from_quat(finder.pose[:2, 3:].numpy())
    off = (found * Rotation.from_matrix(truth.numpy()).inv()).magnitude()
    assert off.max() < 0.2
    mean = finder.pose[:2, :3].numpy() + found.apply(0.5 * points.mean(axis=0))
    np.testing.assert_allclose(mean, np.tile([0.11, 0.21, 0.31], (2, 1)), atol=1e-3)


def test_points_are_chosen_evenly_whatever_their_number():
    finder = GoalFinder(AlignmentNetwork(TINY), torch.randn(1, 500, 3))
    for count in (16, 200, 512):
        often = (finder.share * count).long().bincount(minlength=count)
        assert (
            len(often) == count
            and often.min() >= 512 // count - 1
            and often.max() <= 512 // count + 2
        )


@pytest.fixture(scope="module")
def scenes():
    return make_quick_scenes()


def make_quick_scenes():
    torch.manual_seed(0)
    hands = Hands(load_hand("dclaw3"), QUICK.hands, device="cpu")
    points = CLOUDS * QUICK.points
    held_out = {
        "made": made_shapes(4, points, hands.sides, hands.eye.device),
        "validation": centred_points(load_set(["cuboid"]), points, hands.eye.device),
    }
    bank = ShapeBank(
        load_set(["cube", "cuboid"]), QUICK.shapes, points, hands.sides, hands.eye.device
    )
    return bank, held_out, hands


def make_runner(scenes=None, *, seed=0, cfg=QUICK, out=Path("unused"), steps=10_000, looks=None):
    """A trainer of a network that is small enough to learn in a second."""
    scenes = make_quick_scenes() if scenes is None else scenes
    torch.manual_seed(seed)
    return AlignTrainer(
        *scenes,
        AlignmentNetwork(cfg.network),
        cfg,
        RunCfg(out=out, device="cpu", save_every=1, logger="none", max_steps=steps),
        spec=AlignmentSpec(network=cfg.network, points=cfg.points, hand="dclaw3"),
        task={},
        looks=looks,
        device="cpu",
    )


def test_losses_are_least_at_the_truth_and_fall(scenes):
    runner = make_runner(scenes)
    pairs = runner.pairs()
    right = Residual(pairs.rotation, pairs.offset)
    losses, error = alignment_losses(right, pairs)
    assert float(sum(losses.values())) < 2e-3 and error.max() < 2e-3
    first = sum(alignment_losses(runner.network(pairs.goal, pairs.seen), pairs)[0].values()).item()
    for _ in range(60):
        runner.optimizer.zero_grad()
        loss = sum(alignment_losses(runner.network(pairs.goal, pairs.seen), pairs)[0].values())
        loss.backward()
        runner.optimizer.step()
    assert loss.item() < 0.8 * first
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in runner.network.parameters())


def test_goals_turned_by_the_network_keep_their_label(scenes):
    runner = make_runner(scenes)
    pairs = runner.pairs()
    turned = runner.searched(
        pairs, [runner.network.neighbours(c) for c in (pairs.goal, pairs.seen)]
    )
    assert not torch.allclose(turned.rotation, pairs.rotation, atol=1e-2)
    for name in ("goal", "surface"):
        place = [getattr(each, name) @ each.rotation.transpose(-1, -2) for each in (pairs, turned)]
        torch.testing.assert_close(*place, atol=1e-5, rtol=0.0)


def test_a_run_measures_goes_on_and_leaves_a_network(scenes, tmp_path):
    runner = make_runner(scenes, out=tmp_path, steps=96)
    runner.learn(2)
    again = make_runner(scenes, seed=5, out=tmp_path, steps=96)
    again.load(list_checkpoints(tmp_path)[-1])
    for name, value in runner.network.state_dict().items():
        assert torch.equal(value, again.network.state_dict()[name])
    assert again.iteration == 2 and again.total_iterations == 3
    figures = again.measure()
    for name in ("made", "validation"):
        assert 0.0 <= figures[f"{name}/within_0.1"] <= figures[f"{name}/within_0.4"] <= 1.0
        assert (
            0.0 < figures[f"{name}/rotation_error"] <= np.pi
            and figures[f"{name}/offset_error"] > 0.0
        )
    network, spec = load_alignment(tmp_path / "alignment.pt")
    assert spec.hand == "dclaw3" and spec.network == TINY
    pairs = again.pairs()
    expected = runner.network(pairs.goal, pairs.seen)
    torch.testing.assert_close(network(pairs.goal, pairs.seen).rotation, expected.rotation)


def test_shapes_are_renewed_from_the_oldest(scenes):
    bank, *_ = scenes
    before = bank.shapes.clone()
    bank.renew(3)
    bank.renew(4)
    same = (bank.shapes == before).flatten(1).all(dim=1)
    assert int((~same).sum()) == 7
