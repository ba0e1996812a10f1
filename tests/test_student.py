"""The student: what it reads, what it believes and remembers, and that it learns."""

import dataclasses
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial.transform import Rotation

from vd.assets_usd.hands import load_hand
from vd.geometry.quaternions import rotation_distance
from vd.policy.senses import Senses
from vd.train.student.sequences import Looks, flow_loss
from vd.vision.acting import ActingStudent
from vd.vision.cfg import StudentCfg
from vd.vision.inputs import Belief, HandFrames, InputBuilder, StudentInput, carried, each, either
from vd.vision.rivals import RIVALS, WATCHED
from vd.vision.rotations import (
    matrices_about,
    quaternion_matrices,
    random_rotations,
    turn_angle,
)
from vd.vision.sparse import voxelise
from vd.vision.student import Flow, Look, Student, rigid_motion

JOINTS = 9
TIPS = 3
SMALL = StudentCfg(channels=(8, 16), blocks=1, flow=32, senses=16, memory=32, head=32, voxel_m=0.01)


def box_clouds(count: int, points: int, generator: torch.Generator) -> torch.Tensor:
    """Points [m] on boxes of different lengths, with a smaller one on a face [count, points, 3]."""
    size = 0.02 + 0.04 * torch.rand((count, 1, 3), generator=generator)
    place = 2.0 * torch.rand((count, points, 3), generator=generator) - 1.0
    face = place.abs().argmax(dim=-1, keepdim=True)
    surface = place.scatter(-1, face, place.gather(-1, face).sign())
    bump = torch.arange(points)[None, :, None] % 3 == 0
    middle = torch.tensor([0.7, 0.5, 1.0])
    return 0.5 * size * torch.where(bump, 0.5 * surface + middle, surface)


def sights(lead: tuple[int, ...], seed: int = 0, points: int = 60) -> StudentInput:
    """Sights of objects turned by up to half a radian from where they are believed to be."""
    generator = torch.Generator().manual_seed(seed)
    count = int(np.prod(lead))
    torch.manual_seed(seed)
    goal = box_clouds(count, points, generator)
    goal = goal - goal.mean(dim=1, keepdim=True)
    cpu = torch.device("cpu")
    believed = quaternion_matrices(random_rotations(count, cpu))
    axis = torch.randn((count, 3), generator=generator)
    off = matrices_about(axis, 0.5 * torch.ones(count))
    position = 0.02 * torch.randn((count, 3), generator=generator) + torch.tensor([0.0, 0, 0.17])
    sight = StudentInput(
        camera=carried(goal, off @ believed, position[:, None]),
        hand=0.05 * torch.randn((count, points, 3), generator=generator),
        goal=goal,
        goal_rotation=quaternion_matrices(random_rotations(count, cpu)),
        proprioception=torch.randn((count, 3 * JOINTS), generator=generator),
        tips=0.05 * torch.randn((count, TIPS, 3), generator=generator),
        belief=Belief(believed, position),
        frame=torch.zeros(count, dtype=torch.int64),
    )
    return each(sight, lambda value: value.unflatten(0, lead))


def student(cfg: StudentCfg = SMALL, seed: int = 0) -> Student:
    torch.manual_seed(seed)
    return Student(cfg, JOINTS, TIPS).eval()


def test_without_weights_it_does_nothing_and_believes_what_it_did():
    network = student()
    with torch.no_grad():
        for weight in network.parameters():
            weight.zero_()
    for seed in range(2):
        sight = sights((3,), seed)
        look, decision = network.act(sight, network.first_hidden(3))
        assert not decision.action.any()
        torch.testing.assert_close(look.belief.rotation, sight.belief.rotation)
        torch.testing.assert_close(look.belief.position, sight.belief.position)


def test_what_it_says_depends_on_every_thing_that_it_reads():
    network = student()
    sight = sights((2,))
    _, decision = network.act(sight, network.first_hidden(2))
    other = sights((2,), seed=1)
    for field in dataclasses.fields(StudentInput):
        if field.name == "frame":  # which only tells how the rest is given
            continue
        changed = dataclasses.replace(sight, **{field.name: getattr(other, field.name)})
        _, found = network.act(changed, network.first_hidden(2))
        assert (found.action != decision.action).any(dim=1).all(), field.name
    _, remembered = network.act(sight, decision.hidden)
    assert (remembered.action != decision.action).any(dim=1).all()


def test_a_sequence_is_its_steps_and_ended_episodes_are_forgotten():
    network = student()
    steps = [sights((3,), seed) for seed in range(4)]
    told = torch.stack([network.told(sight, network.look(sight).belief) for sight in steps])
    done = torch.zeros((4, 3), dtype=torch.bool)
    done[1, 0] = done[3, 2] = True
    whole = network(told, torch.ones(3, SMALL.memory), done)
    hidden = torch.ones(3, SMALL.memory)
    for step, sight in enumerate(steps):
        _, decision = network.act(sight, hidden)
        hidden = decision.hidden.masked_fill(done[step, :, None], 0.0)
        torch.testing.assert_close(decision.action, whole.action[step], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(hidden, whole.hidden)
    assert not hidden[2].any()


def test_a_scene_moved_with_the_belief_looks_the_same():
    """Voxels are counted from where the object is believed to be."""
    network = student()
    sight = sights((3,), points=20)
    shift = torch.tensor([0.0123, -0.0077, 0.0031])
    belief = Belief(sight.belief.rotation, sight.belief.position + shift)
    moved = dataclasses.replace(
        sight, camera=sight.camera + shift, hand=sight.hand + shift, belief=belief
    )
    seen = network.look(sight).flow
    again = network.look(moved).flow
    torch.testing.assert_close(again.shift, seen.shift, atol=1e-3, rtol=0.0)
    torch.testing.assert_close(again.log_scale, seen.log_scale, atol=2e-3, rtol=0.0)
    aside = network.look(dataclasses.replace(sight, belief=belief)).flow
    assert (aside.log_scale - seen.log_scale).abs().max() > 0.01


def test_it_reads_nothing_out_of_reach():
    network = student()
    sight = sights((2,))
    far = sight.belief.position[:, None] + torch.tensor([0.0, 0.0, SMALL.reach_m])
    read = network.look(sight)
    for step, seen in ((1.01, False), (0.95, True)):
        points = sight.belief.position[:, None] + step * (far - sight.belief.position[:, None])
        camera = torch.cat([sight.camera, points], dim=1)
        found = network.look(dataclasses.replace(sight, camera=camera))
        assert torch.allclose(found.flow.shift, read.flow.shift, atol=1e-6) != seen
        assert (found.voxels == read.voxels + seen).all()


def senses_of(hand, envs: int, place: torch.device) -> Senses:
    generator = np.random.default_rng(0)

    def random(low, high, *shape):
        return torch.tensor(generator.uniform(low, high, shape), dtype=torch.float32, device=place)

    joints = hand.num_joints
    return Senses(
        joint_q=torch.tensor(
            generator.uniform(hand.lower, hand.upper, (envs, joints)),
            dtype=torch.float32,
            device=place,
        ),
        joint_qd=random(-1, 1, envs, joints),
        action=random(-1, 1, envs, joints),
        goal_quat=random_rotations(envs, place),
        points=torch.full((envs, 4, 3), torch.nan, device=place),
        fresh=torch.ones(envs, dtype=torch.bool, device=place),
    )


def test_it_reads_no_joints_that_follow_others():
    hand = load_hand("dclaw3")
    mimic = np.array([-1, -1, 1, -1, -1, 4, -1, -1, 7])
    build = InputBuilder(replace(hand, mimic=mimic), torch.zeros(2, 10, 3))
    senses = senses_of(hand, 2, torch.device("cpu"))
    sight = build(senses, build.first_belief(senses.goal_quat))
    moved = np.flatnonzero(mimic < 0)
    all_joints = InputBuilder(hand, torch.zeros(2, 10, 3))(senses, sight.belief).proprioception
    torch.testing.assert_close(
        sight.proprioception, all_joints.unflatten(-1, (3, 9))[..., moved].flatten(-2)
    )


def test_it_reads_the_hand_by_its_joints_and_the_goal_where_it_is_believed(device):
    hand = load_hand("dclaw3")
    place = torch.device(wp.device_to_torch(device))
    generator = torch.Generator().manual_seed(0)
    goals = (box_clouds(2, 300, generator) + 0.01).to(place)
    build = InputBuilder(hand, goals)
    senses = senses_of(hand, 2, place)
    belief = build.first_belief(senses.goal_quat)
    # In the world's axes, about where objects are handled: 8 cm above the table.
    world = quaternion_matrices(senses.goal_quat).cpu()
    to_base = quaternion_matrices(torch.tensor(hand.mount[3:]).float()).T
    torch.testing.assert_close(belief.rotation.cpu(), to_base @ world)
    torch.testing.assert_close(belief.position.cpu(), torch.tensor([[0.0, 0.0, 0.17]] * 2))
    sight = build(senses, belief)
    poses = hand.forward_kinematics(senses.joint_q.cpu().numpy())
    tip = sight.hand[0].cpu().numpy().reshape(len(hand.point_link), -1, 3)
    for link, points in zip(hand.point_link, tip, strict=True):
        assert np.abs(points - poses[0, link, :3]).max() < 0.12
    tips = hand.tip_poses(senses.joint_q.cpu().numpy())[..., :3]
    np.testing.assert_allclose(sight.tips.cpu(), tips, atol=1e-5)
    # An object where it is believed to be fills the goal's voxels, and no others.
    seen = carried(goals, belief.rotation, belief.position[:, None])
    mean = goals.mean(dim=1, keepdim=True)
    seen = seen - carried(mean, belief.rotation)
    laid = carried(sight.goal, belief.rotation)
    both = voxelise([seen - belief.position[:, None], laid], 0.005).features
    assert (both[:, 0] == both[:, 4]).float().mean() > 0.97
    twice = build(each_row(senses, [1, 0]), each(belief, lambda v: v.flip(0)), torch.tensor([1, 0]))
    torch.testing.assert_close(twice.goal, sight.goal.flip(0))
    torch.testing.assert_close(twice.hand, sight.hand.flip(0))


def test_a_scene_turned_from_finger_to_finger_is_read_the_same():
    """Against a turn of the world that is made here."""
    hand = load_hand("dclaw3")
    envs = 40
    torch.manual_seed(2)
    goals = 0.03 * torch.randn(envs, 30, 3)
    build = InputBuilder(hand, goals)
    senses = senses_of(hand, envs, torch.device("cpu"))
    senses = replace(senses, points=0.1 * torch.randn(envs, 20, 3))
    rotation = quaternion_matrices(random_rotations(envs, torch.device("cpu")))
    belief = Belief(rotation, 0.05 * torch.randn(envs, 3))
    sight = build(senses, belief)
    assert sight.frame.unique().tolist() == [0, 1, 2]
    third = Rotation.from_euler("z", 120.0, degrees=True)
    to_world = Rotation.from_quat(hand.mount[3:])
    base = to_world.inv() * third * to_world
    turn = torch.tensor(base.as_matrix()).float()
    goal = third * Rotation.from_quat(senses.goal_quat.numpy())
    rest = hand.tip_poses(np.zeros(9))[:, :3]
    apart = np.linalg.norm(base.apply(rest)[:, None] - rest[None], axis=2)
    fingers = apart.argmin(axis=0)  # which finger comes to the place of each
    order = (3 * fingers[:, None] + np.arange(3)).ravel()
    moved = Senses(
        joint_q=senses.joint_q[:, order],
        joint_qd=senses.joint_qd[:, order],
        action=senses.action[:, order],
        goal_quat=torch.tensor(goal.as_quat()).float(),
        points=carried(senses.points, turn),
        fresh=senses.fresh,
    )
    again = build(moved, Belief(turn @ rotation, belief.position @ turn.T))
    assert (again.frame != sight.frame).all()
    for name in ("camera", "goal_rotation", "proprioception", "tips"):
        torch.testing.assert_close(getattr(again, name), getattr(sight, name), atol=1e-5, rtol=0.0)
    torch.testing.assert_close(again.belief.rotation, sight.belief.rotation)
    torch.testing.assert_close(again.belief.position, sight.belief.position)
    # What is done there is done by the other fingers.
    action = torch.randn(envs, 9)
    done = build.frames.joints_out(action, sight.frame)
    torch.testing.assert_close(build.frames.joints_out(action, again.frame), done[:, order])


def test_a_hand_whose_fingers_differ_is_read_in_its_base_frame():
    hand = load_hand("dclaw3")
    uneven = replace(hand, mount=hand.mount + np.array([0.05, 0, 0, 0, 0, 0, 0]))
    frames = HandFrames(uneven, torch.device("cpu"))
    torch.testing.assert_close(frames.turn, torch.eye(3)[None])


def test_a_belief_strays_no_farther_than_the_network_sees():
    network = student().eval()
    with torch.no_grad():
        network.flow[-1].bias[:3] = 0.5  # 9 cm in every step
    acting = ActingStudent(network, load_hand("dclaw3"), 0.02 * torch.randn(2, 50, 3))
    senses = senses_of(load_hand("dclaw3"), 2, torch.device("cpu"))
    first = acting.build.first_belief(senses.goal_quat)
    in_sight = first.position[:, None] + 0.02 * torch.randn(2, 40, 3)
    senses = dataclasses.replace(senses, points=in_sight)
    acting.step(senses)
    senses = dataclasses.replace(senses, fresh=torch.zeros(2, dtype=torch.bool))
    for _ in range(5):
        acting.step(senses)
    strayed = (acting.belief.position - first.position).norm(dim=-1)
    torch.testing.assert_close(strayed, torch.full((2,), SMALL.reach_m))


def each_row(senses: Senses, rows: list[int]) -> Senses:
    taken = {f.name: getattr(senses, f.name)[rows] for f in dataclasses.fields(Senses)}
    return Senses(**taken)


def test_a_rigid_motion_is_that_of_the_voxels_which_are_sure(device):
    """Against SciPy's weighted fit; voxels that are not sure count for nothing."""
    place = torch.device(wp.device_to_torch(device))
    random = np.random.default_rng(3)
    looks = 5
    look = np.repeat(np.arange(looks), 40)
    start = random.normal(0.0, 0.03, (len(look), 3))
    turns = Rotation.random(looks, rng=random)
    moved = np.concatenate([turns[k].apply(start[look == k]) for k in range(looks)])
    shift = moved + random.normal(0.0, 0.02, (looks, 3))[look] - start
    shift += random.normal(0.0, 0.002, shift.shape)
    log_scale = random.uniform(-1.0, 1.0, len(look))
    wrong = random.random(len(look)) < 0.2
    shift[wrong] += 0.1
    log_scale[wrong] = 12.0

    def tensor(values):
        return torch.tensor(values, dtype=torch.float32, device=place)

    flow = Flow(tensor(start), tensor(shift), tensor(log_scale), torch.tensor(look, device=place))
    rotation, translation = rigid_motion(flow, looks)
    for k in range(looks):
        rows = (look == k) & ~wrong
        weight = np.exp(-2.0 * log_scale[rows])
        before = np.average(start[rows], axis=0, weights=weight)
        end = start[rows] + shift[rows]
        after = np.average(end, axis=0, weights=weight)
        fit, _ = Rotation.align_vectors(end - after, start[rows] - before, weights=weight)
        np.testing.assert_allclose(rotation[k].cpu(), fit.as_matrix(), atol=2e-3)
        expected = after - fit.apply(before)
        np.testing.assert_allclose(translation[k].cpu(), expected, atol=2e-4)


def test_about_a_line_nothing_is_turned():
    start = torch.linspace(-0.05, 0.05, 20)[:, None] * torch.tensor([[0.6, 0.0, 0.8]])
    axis = torch.tensor([[0.0, 1.0, 0.0]])
    turn = matrices_about(axis, torch.tensor([0.3]))
    shift = carried(start[None], turn)[0] - start
    still = torch.zeros(20)
    rotation, _ = rigid_motion(Flow(start, shift, still, torch.zeros(20).long()), 1)
    torch.testing.assert_close(rotation, turn, atol=1e-3, rtol=0.0)


def truth_of(sight: StudentInput) -> Belief:
    """Where goals lie on what is seen, by least squares."""
    seen = sight.camera - sight.belief.position[..., None, :]
    u, _, vt = torch.linalg.svd(sight.goal.transpose(-1, -2) @ seen)
    return Belief((u @ vt).transpose(-1, -2), sight.belief.position)


def test_it_learns_how_a_belief_is_wrong():
    """Eight objects half a radian off are turned right after a few dozen steps."""
    network = student().train()
    sight = sights((8,), points=200)
    looks = Looks(sight, truth_of(sight))
    turn = looks.truth.rotation.mT
    torch.testing.assert_close(
        turn_angle(sight.belief.rotation @ turn), torch.full((8,), 0.5), atol=1e-3, rtol=0.0
    )
    optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
    for _ in range(60):
        look = network.look(sight)
        loss = flow_loss(look.flow, looks)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert turn_angle(look.belief.rotation @ turn).mean() < 0.15
    assert look.flow.log_scale.mean() < 0.0


HALF_TURN = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))


class Told(torch.nn.Module):
    """A network that sets near beliefs right where it sees, and doubts those that stay wrong.

    ``beliefs`` counts those by which it looked.
    """

    cfg = SMALL
    beliefs = 0

    def __init__(self, truth: torch.Tensor, frames: HandFrames):
        super().__init__()
        self.truth = truth
        self.frames = frames

    def first_hidden(self, envs: int) -> torch.Tensor:
        """No memory."""
        return torch.zeros(envs, 1)

    def look(self, sight: StudentInput) -> Look:
        """The truth where the belief is near it."""
        believed = sight.belief
        self.beliefs += len(believed.rotation)
        truth = self.frames.turn[sight.frame] @ self.truth
        seen = sight.camera.isfinite().any(dim=2).any(dim=1)
        better, doubt = self.better(believed, truth)
        return Look(either(seen, better, believed), doubt, doubt, None)

    def told(self, sight: StudentInput, belief: Belief) -> torch.Tensor:
        """Where it believes the object to be."""
        return belief.position

    def better(self, believed: Belief, truth: torch.Tensor) -> tuple[Belief, torch.Tensor]:
        """What it believes where it sees, and how much it doubts that."""
        near = turn_angle(believed.rotation.mT @ truth) < 1.15
        rotation = torch.where(near[:, None, None], truth, believed.rotation)
        return Belief(rotation, believed.position), turn_angle(rotation.mT @ truth)


def acting_by(kind: type[Told], hands: int) -> tuple[ActingStudent, Senses]:
    """Who acts by a network of a kind that knows a random truth, and what hands sense [N]."""
    hand = load_hand("dclaw3")
    device = torch.device("cpu")
    truth = quaternion_matrices(random_rotations(1, device))[0]
    network = kind(truth, HandFrames(hand, device))
    acting = ActingStudent(network, hand, torch.randn(hands, 50, 3))
    return acting, senses_of(hand, hands, device)


def test_an_object_is_looked_for_once_it_is_seen_and_then_followed():
    acting, senses = acting_by(Told, 2)
    truth = acting.network.truth
    middle = torch.tensor([0.01, -0.02, 0.16])
    seen = middle + 0.02 * torch.randn(2, 40, 3)
    seen[1] = torch.nan
    acting.follow(dataclasses.replace(senses, points=seen))
    assert acting.lost.tolist() == [False, True]
    torch.testing.assert_close(acting.belief.rotation[0], truth)
    assert (acting.belief.position[0] - middle).norm() < 0.02
    first = acting.build.first_belief(senses.goal_quat)
    torch.testing.assert_close(acting.belief.rotation[1], first.rotation[1])
    later = dataclasses.replace(senses, fresh=torch.zeros(2, dtype=torch.bool))
    acting.follow(dataclasses.replace(later, points=seen.flip(0)))
    assert not acting.lost.any()
    torch.testing.assert_close(acting.belief.rotation[1], truth)
    for _ in range(WATCHED):
        acting.follow(dataclasses.replace(later, points=seen.flip(0)))
    wrong = truth @ HALF_TURN
    acting.belief.rotation[0] = wrong
    acting.follow(dataclasses.replace(later, points=seen.flip(0)))
    torch.testing.assert_close(acting.belief.rotation[0], wrong)


class Misled(Told):
    """A network that takes the other way round for the truth, at the first look."""

    doubts = 0.5, 0.4

    def better(self, believed: Belief, truth: torch.Tensor) -> tuple[Belief, torch.Tensor]:
        """The truth or its opposite where the belief is near it, a millimetre aside."""
        rotation = believed.rotation
        doubt = torch.full((len(rotation),), 2.0)
        for likely, how in zip((truth, truth @ HALF_TURN), self.doubts, strict=True):
            near = turn_angle(rotation.mT @ likely) < 1.15
            rotation = torch.where(near[:, None, None], likely, rotation)
            doubt = torch.where(near, how, doubt)
        return Belief(rotation, believed.position + 0.001), doubt


def test_of_two_likely_beliefs_that_is_followed_which_later_looks_doubt_less():
    acting, senses = acting_by(Misled, 1)
    misled = acting.network
    truth = misled.truth
    seen = torch.tensor([0.01, -0.02, 0.16]) + 0.02 * torch.randn(1, 40, 3)
    senses = dataclasses.replace(senses, points=seen)
    acting.follow(senses)
    torch.testing.assert_close(acting.belief.rotation[0], truth @ HALF_TURN)
    found = acting.belief.position
    misled.doubts = 0.3, 0.35
    senses = dataclasses.replace(senses, fresh=torch.zeros(1, dtype=torch.bool))
    blank = dataclasses.replace(senses, points=torch.full_like(seen, torch.nan))
    for _ in range(WATCHED):
        acting.follow(blank)  # tells nothing, and takes no step of those that do
    misled.beliefs = 0
    acting.follow(senses)  # 0.8 for 0.75: not yet
    torch.testing.assert_close(acting.belief.rotation[0], truth @ HALF_TURN)
    torch.testing.assert_close(acting.belief.position, found)  # what is seen makes it better once
    assert misled.beliefs == RIVALS, "by each it looks once"
    for _ in range(2):
        acting.follow(senses)
    torch.testing.assert_close(acting.belief.rotation[0], truth)
    misled.doubts = 0.3, 4.0  # and what is given up never comes back
    acting.follow(senses)
    misled.doubts = 4.0, 0.0
    acting.follow(senses)
    torch.testing.assert_close(acting.belief.rotation[0], truth)


def test_hands_side_by_side_see_as_each_alone():
    """One is followed by rivals, while the other is not seen, found or followed too."""
    hand = load_hand("dclaw3")
    network = student()
    goals = 0.02 * torch.randn(2, 50, 3)
    senses = senses_of(hand, 2, torch.device("cpu"))
    both = ActingStudent(network, hand, goals)
    alone = [ActingStudent(network, hand, goal[None]) for goal in goals]
    for step, unseen in enumerate((1, 1, None, None, 0)):
        points = torch.tensor([0.01, -0.02, 0.16]) + 0.02 * torch.randn(2, 40, 3)
        if unseen is not None:
            points[unseen] = torch.nan
        fresh = torch.full((2,), step == 0)
        now = dataclasses.replace(senses, points=points, fresh=fresh)
        sighting = both.follow(now)
        for i, one in enumerate(alone):
            found = one.follow(each_row(now, [i]))
            for name in ("told", "frame", "angle", "doubt", "voxels"):
                together = getattr(sighting, name)[i]
                torch.testing.assert_close(together, getattr(found, name)[0], atol=1e-4, rtol=1e-3)
            torch.testing.assert_close(both.belief.position[i], one.belief.position[0])


def test_it_stops_by_the_angle_from_its_belief_to_the_goal_and_not_before_it_saw_anything():
    hand = load_hand("dclaw3")
    senses = senses_of(hand, 2, torch.device("cpu"))
    acting = ActingStudent(student(), hand, torch.randn(2, 50, 3))
    seen = torch.tensor([0.01, -0.02, 0.16]) + 0.02 * torch.randn(2, 40, 3)
    seen[1] = torch.nan
    decision = acting.step(dataclasses.replace(senses, points=seen))
    angle = rotation_distance(decision.orientation, senses.goal_quat)
    torch.testing.assert_close(decision.angle[0], angle[0], atol=1e-3, rtol=0.0)
    assert decision.angle[1] == pytest.approx(np.pi)


def test_it_learns_in_half_precision(device):
    place = torch.device(wp.device_to_torch(device))
    network = student().train().to(place)
    sight = each(sights((6,)), lambda value: value.to(place))
    hidden = torch.ones((6, SMALL.memory), device=place)
    single, decided = network.act(sight, hidden)
    network.half = True
    look, decision = network.act(sight, hidden)
    assert decision.action.dtype == look.belief.rotation.dtype == torch.float32
    torch.testing.assert_close(decision.action, decided.action, atol=0.02, rtol=0.02)
    assert (look.flow.shift != single.flow.shift).any()
    spoken = [decision.action, look.flow.shift, look.flow.log_scale]
    sum(value.square().sum() for value in spoken).backward()
    for name, weight in network.named_parameters():
        assert torch.isfinite(weight.grad).all(), name
        assert weight.grad.any(), name


def test_a_robot_runs_its_stages_in_half_precision():
    network = student()
    sight = sights((2,))
    with torch.inference_mode():
        _, single = network.act(sight, network.first_hidden(2))
        network.stages.bfloat16()
        _, decision = network.act(sight, network.first_hidden(2))
    torch.testing.assert_close(decision.action, single.action, atol=0.02, rtol=0.02)
    assert decision.hidden.dtype == torch.float32


def test_a_robot_needs_no_simulator():
    code = """
import sys, torch
from vd.vision.acting import ActingStudent
from vd.vision.cfg import StudentCfg
from vd.vision.inputs import Belief, StudentInput
from vd.vision.student import Student
belief = Belief(torch.eye(3)[None], torch.zeros(1, 3))
points = torch.rand(1, 5, 3)
joints = torch.zeros(1, 9)
frame = torch.zeros(1).long()
sight = StudentInput(points, points, points, belief.rotation, joints, points, belief, frame)
student = Student(StudentCfg(channels=(8,), blocks=0), 3, 5).eval()
print(student.act(sight, student.first_hidden(1))[1].action.shape[1], *sys.modules)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    printed = run.stdout.split()
    assert "3" in printed
    assert not {"newton", "mujoco", "pxr", "rsl_rl"} & set(printed)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"channels": ()}, "channels"),
        ({"channels": (8, 0)}, "channels"),
        ({"blocks": -1}, "blocks"),
        ({"voxel_m": 0.0}, "voxel_m"),
        ({"reach_m": -0.1}, "reach_m"),
        ({"memory": 0}, "memory"),
    ],
)
def test_refuses_sizes_that_make_no_network(change, field):
    with pytest.raises(ValueError, match=f"student.{field}"):
        Student(dataclasses.replace(SMALL, **change), JOINTS, TIPS)
