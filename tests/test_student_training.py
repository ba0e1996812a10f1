"""The student's training: what stages learn, that runs go on, and the policy that they leave at work."""

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from test_hand_import import write_urdf

from vd.assets_usd.hand_data import compose, invert
from vd.assets_usd.hand_import.importer import import_hand
from vd.assets_usd.hands import load_hand
from vd.deploy.loop.policy_runner import CameraRunner, Sensed
from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.compare import actor_of
from vd.evaluate.trace import advance
from vd.policy.bundle import read_policy, write_policy
from vd.train.checkpoint import list_checkpoints
from vd.train.cli import main as train
from vd.train.config import StageTaskCfg
from vd.train.student import made
from vd.train.student.build import build_student
from vd.train.student.config import SimulatedCfg, StudentTrainCfg, smoke
from vd.train.student.sequences import belief_errors, flow_loss
from vd.train.student.simulated import BeliefErrors
from vd.vision.acting import LEAST_SEEN, StudentPolicy
from vd.vision.cfg import StudentCfg
from vd.vision.inputs import Belief, carried
from vd.vision.rotations import quaternion_matrices, random_rotations
from vd.vision.student import rigid_motion

CPU = torch.device("cpu")

TINY = StudentCfg(channels=(8, 16), blocks=1, flow=32, senses=16, memory=32, head=32, voxel_m=0.01)


def settings(stage: int, out: Path, **learn) -> StudentTrainCfg:
    """A stage with a cube that is small enough to learn in seconds."""
    cfg = smoke(stage)
    learn = {
        "window": 3,
        "batch": 4,
        "sequences": 4,
        "learning_rate": 3e-3,
        "warmup_steps": 0,
    } | learn
    return replace(
        cfg,
        smoke=False,
        teacher="dclaw3",
        student=TINY,
        run=replace(cfg.run, out=out, max_steps=10**6, save_every=10**6, max_minutes=None),
        learn=replace(cfg.learn, **learn),
        clouds=replace(cfg.clouds, points=200),
        task=replace(cfg.task, objects=("cuboid",), num_envs=4),
    )


def trainer_of(cfg: StudentTrainCfg):
    return build_student(cfg, say=lambda _: None)


def weights(trainer) -> torch.Tensor:
    return torch.nn.utils.parameters_to_vector(trainer.network.parameters()).detach().clone()


@pytest.fixture(scope="module")
def unlike(tmp_path_factory) -> str:
    """A teacher of a moment's training: an imported hand of 2 and 3 motors looks up and holds cubes."""
    folder = tmp_path_factory.mktemp("unlike")
    (folder / "said.yaml").write_text("workspace: {size: [0.04, 0.05]}")
    hand = import_hand(write_urdf(folder), folder / "hand", folder / "said.yaml").hand
    out = str(folder / "run")
    flags = ["--preset", "leap-cube", "--hand", str(hand.path), "--smoke", "--out", out]
    assert train(["teacher", *flags]) == 0
    return out


@pytest.fixture(params=["dclaw3", "unlike"])
def teacher(request) -> str:
    """Whom a student imitates, of fingers that are alike and of others."""
    return "dclaw3" if request.param == "dclaw3" else request.getfixturevalue("unlike")


@pytest.mark.parametrize("stage", [0, 1, 2])
def test_every_stage_learns_what_it_is_shown(stage, teacher, tmp_path):
    """The same few looks and sequences again and again: their losses fall."""
    trainer = trainer_of(replace(settings(stage, tmp_path), teacher=teacher))
    assert trainer.source.collect(trainer.acting, lambda: False)
    looks = next(trainer.source.looks(trainer.acting))
    sequences = next(trainer.source.sequences(), None)
    assert (sequences is not None) == (stage > 0)
    first = {}
    for _ in range(25):
        figures = trainer.see(looks, 0.0)
        if sequences is not None:
            figures |= trainer.act(sequences, 0.0)
        first = first or figures
    for name in {"loss/flow", "loss/action"} & figures.keys():
        assert figures[name] < first[name], name
    assert figures["loss/flow"] < first["loss/flow"] - 0.5  # a likelihood half as large again
    trainer.close()


def test_seeing_and_acting_learn_by_themselves(tmp_path):
    trainer = trainer_of(settings(1, tmp_path))
    assert trainer.source.collect(trainer.acting, lambda: False)
    before = {name: w.detach().clone() for name, w in trainer.network.named_parameters()}

    def changed() -> set[str]:
        now = trainer.network.named_parameters()
        return {name.split(".")[0] for name, weight in now if (weight != before[name]).any()}

    trainer.see(next(trainer.source.looks(trainer.acting)), 0.0)
    eyes = changed()
    assert eyes == {"stages", "flow"}
    trainer.act(next(trainer.source.sequences()), 0.0)
    rest = changed() - eyes
    assert rest == {"senses", "memory", "head", "action"}
    trainer.close()


@pytest.mark.parametrize("stage", [1, 2])
def test_a_sequence_is_what_was_done(stage, tmp_path):
    """In evaluation mode it says what the rollout said."""
    cfg = settings(stage, tmp_path)
    cfg = replace(cfg, simulated=replace(cfg.simulated, blank_probability=0.3))
    trainer = trainer_of(cfg)
    acting = trainer.acting
    trainer.network.eval()
    told = []
    said = []
    decide = acting.decide

    def heard(numbers, frame):
        decision = decide(numbers, frame)
        told.append(numbers)
        said.append(acting.build.frames.joints_in(decision.action, frame))
        return decision

    acting.decide = heard
    env = trainer.source.env
    env.episode_length_buf = torch.full((4,), env.max_episode_length - 2)  # ends inside
    assert trainer.source.collect(acting, lambda: False)
    sequences = next(trainer.source.sequences())
    assert sequences.done.any()
    same = (sequences.told[:, :, None] == torch.stack(told)[:, None]).all(dim=-1).all(dim=0)
    assert (same.sum(dim=1) == 1).all()
    rows = same.int().argmax(dim=1)
    decision = trainer.network(sequences.told, sequences.hidden, sequences.done)
    torch.testing.assert_close(decision.action, torch.stack(said)[:, rows], atol=1e-5, rtol=1e-4)
    assert float(sequences.label.abs().max()) <= 1.0
    trainer.close()


def test_truth_is_where_the_objects_points_are(tmp_path):
    trainer = trainer_of(settings(1, tmp_path))
    assert trainer.source.collect(trainer.acting, lambda: False)
    looks = next(trainer.source.looks(trainer.acting))
    apart = []
    for belief in (looks.truth, looks.sight.belief):
        laid = carried(looks.sight.goal, belief.rotation, belief.position[:, None])
        apart.append(torch.cdist(laid, looks.sight.camera).amin(dim=-1).median())
    assert apart[0] < 0.008  # two clouds of 200 points of one surface
    assert apart[1] > 1.5 * apart[0]
    trainer.close()


@pytest.mark.parametrize(("seen_share", "least", "most"), [(0.0, 0.0, 0.3), (1.0, 0.6, 1.0)])
def test_a_camera_sees_the_hand_too(seen_share, least, most, tmp_path):
    """Hands are of some thousand points, objects of 200."""
    cfg = settings(0, tmp_path)
    trainer = trainer_of(replace(cfg, clouds=replace(cfg.clouds, seen_share=seen_share)))
    sight = next(trainer.source.looks(trainer.acting)).sight
    apart = torch.cdist(sight.camera.nan_to_num(nan=9.0), sight.hand).amin(dim=-1)
    seen = torch.isfinite(sight.camera[..., 0])
    assert least <= (apart[seen] < 0.004).float().mean() <= most
    trainer.close()


@pytest.mark.parametrize("stage", [0, 1])
def test_beliefs_begin_about_where_objects_are(stage, tmp_path):
    cfg = settings(stage, tmp_path, batch=64, window=1)
    trainer = trainer_of(replace(cfg, task=replace(cfg.task, num_envs=64)))
    assert trainer.source.collect(trainer.acting, lambda: False)
    looks = next(trainer.source.looks(trainer.acting))
    turn, shift = belief_errors(looks.sight.belief, looks.truth)
    assert turn.max() < made.AWAY_RAD + 1e-3
    assert turn.mean() == pytest.approx(0.5 * made.AWAY_RAD, abs=0.2)  # four deviations
    assert shift.max() < np.sqrt(3.0) * made.AWAY_M + 1e-6
    trainer.close()


def test_by_a_camera_half_the_looks_are_from_anywhere_as_in_a_search(tmp_path):
    """A network without weights leaves beliefs as they are."""
    cfg = settings(2, tmp_path, window=1, batch=64)
    cfg = replace(cfg, simulated=replace(cfg.simulated, looks=64))
    trainer = trainer_of(replace(cfg, task=replace(cfg.task, num_envs=64)))
    with torch.no_grad():
        for weight in trainer.network.parameters():
            weight.zero_()
    assert trainer.source.collect(trainer.acting, lambda: False)
    looks = next(trainer.source.looks(trainer.acting))
    turn, _ = belief_errors(looks.sight.belief, looks.truth)
    farther = (turn > made.AWAY_RAD + 1e-3).float().mean()
    # Of rotations uniform on SO(3) so many are farther; 0.1 is four deviations.
    share = 1.0 - (made.AWAY_RAD - np.sin(made.AWAY_RAD)) / np.pi
    assert farther == pytest.approx(0.5 * share, abs=0.1)
    trainer.close()


def test_errors_of_beliefs_are_as_large_and_last_as_they_are_said_to():
    torch.manual_seed(0)
    envs = 4000
    errors = BeliefErrors(envs, SimulatedCfg(belief_rad=0.2, belief_m=0.004), CPU)
    truth = Belief(quaternion_matrices(random_rotations(envs, CPU)), torch.randn(envs, 3))
    fresh = torch.zeros(envs, dtype=torch.bool)
    fresh[:2000] = True
    steps = []
    for step in range(2):
        belief = errors.about(truth, fresh & (step > 0))
        turn = belief.rotation @ truth.rotation.mT
        axis = Rotation.from_matrix(turn.numpy()).as_rotvec()
        steps.append(np.hstack([axis / 0.2, (belief.position - truth.position) / 0.004]))
    first, later = steps
    # Normal, with a deviation that is uniform in [0, 1] for each environment.
    assert later.std(axis=0) == pytest.approx(np.full(6, np.sqrt(1.0 / 3.0)), abs=0.04)
    together = (first * later).mean(axis=1)
    assert together[:2000].mean() == pytest.approx(0.0, abs=0.02)
    assert together[2000:].mean() == pytest.approx(0.9 / 3.0, abs=0.04)


def test_losses_are_least_at_the_truth(tmp_path):
    trainer = trainer_of(settings(1, tmp_path))
    assert trainer.source.collect(trainer.acting, lambda: False)
    looks = next(trainer.source.looks(trainer.acting))
    truth = looks.truth
    believed = looks.sight.belief
    flow = trainer.network.look(looks.sight).flow
    moved = truth.rotation @ believed.rotation.mT
    end = (moved[flow.look] @ flow.start[..., None])[..., 0]
    end = end + (truth.position - believed.position)[flow.look]
    sure = torch.full_like(flow.log_scale, -3.0)
    exact = replace(flow, shift=end - flow.start, log_scale=sure)
    assert float(flow_loss(exact, looks)) == pytest.approx(-9.0, abs=1e-3)
    rotation, position = rigid_motion(exact, len(moved))
    torch.testing.assert_close(rotation @ believed.rotation, truth.rotation, atol=1e-3, rtol=0.0)
    torch.testing.assert_close(believed.position + position, truth.position)
    sequences = next(trainer.source.sequences())
    label = torch.full_like(sequences.label, 0.3)
    for wrong, loss in ((0.0, 0.0), (0.1, 0.01)):
        trainer.network.action.weight.data.zero_()
        trainer.network.action.bias.data.fill_(0.3)
        acted = trainer.act(replace(sequences, label=label - wrong), 0.0)
        assert float(acted["loss/action"]) == pytest.approx(loss, abs=1e-6)
    trainer.close()


@pytest.mark.parametrize("stage", [0, 1, 2])
def test_a_run_that_goes_on_is_the_run_that_was_not_stopped(stage, tmp_path):
    whole = trainer_of(settings(stage, tmp_path / "whole"))
    whole.learn(3)
    whole.close()
    part = trainer_of(settings(stage, tmp_path / "part"))
    part.learn(2)
    part.close()
    checkpoint = list_checkpoints(tmp_path / "part")[-1]
    again = trainer_of(replace(settings(stage, tmp_path / "part"), resume=str(checkpoint)))
    assert again.iteration == 2
    again.learn(1)
    again.close()
    if stage == 0:
        torch.testing.assert_close(weights(again), weights(whole), atol=0.0, rtol=0.0)
    else:
        torch.testing.assert_close(weights(again), weights(whole), atol=1e-5, rtol=1e-4)


@pytest.fixture(scope="module")
def policy(tmp_path_factory) -> Path:
    """A student that was trained for a moment."""
    folder = tmp_path_factory.mktemp("student")
    trainer = trainer_of(settings(1, folder))
    trainer.learn(1)
    trainer.close()
    return folder / "policy.safetensors"


def test_a_run_leaves_a_policy_that_is_the_network(policy):
    student = read_policy(policy)
    assert isinstance(student, StudentPolicy)
    assert (student.kind, student.hand, student.num_actions) == ("student", "dclaw3", 9)
    assert student.contract.env_steps == 12
    with torch.no_grad():
        student.network.action.bias += 0.1
    write_policy(student, policy.with_name("other.safetensors"))
    other = read_policy(policy.with_name("other.safetensors"))
    torch.testing.assert_close(other.network.action.bias, student.network.action.bias)


def test_a_student_of_unlike_fingers_sees_what_lies_in_the_palm_and_moves_all_motors(
    unlike, tmp_path
):
    trainer = trainer_of(replace(settings(2, tmp_path), teacher=unlike))
    teacher_sees = trainer.source.env.env.cfg.randomisation
    assert teacher_sees.enabled and not teacher_sees.tracked_pose.enabled
    trainer.learn(1)
    trainer.close()
    student = read_policy(tmp_path / "policy.safetensors")
    assert student.num_actions == 5
    env = environment(student)
    actor, _ = actor_of(str(tmp_path), student, env, goals="points", sensor_errors=True)
    advance(env, actor.act(torch.empty(0)))
    points = actor.camera.points.numpy()
    scene, hand = env.scene, env.hand
    assert np.isfinite(actor.act(torch.empty(0)).numpy()).all()
    poses = env.sim.body_q.numpy()[:, scene.object_body]
    in_base = compose(invert(hand.mount), poses)[:, :3]
    near = np.linalg.norm(points - in_base[:, None], axis=2) < 0.5 * env.objects[0].longest_side
    assert (near.sum(axis=1) > LEAST_SEEN).all()
    env.close()


def test_objects_of_a_teacher_that_are_not_here_are_to_be_named(monkeypatch, tmp_path):
    monkeypatch.setattr(ReorientCfg, "of", lambda *_: ReorientCfg(objects=("fit",)))
    with pytest.raises(ValueError, match=r"teacher's own objects .*--objects[\s\S]*'fit'"):
        trainer_of(replace(settings(1, tmp_path), task=StageTaskCfg()))


def test_a_teacher_without_goals_is_refused(tmp_path):
    with pytest.raises(ValueError, match="leap-spin has no goals"):
        trainer_of(replace(settings(1, tmp_path), teacher="leap-spin"))


def test_shapes_that_are_made_have_the_sizes_that_the_hand_holds(unlike, tmp_path):
    trainer = trainer_of(replace(settings(0, tmp_path), teacher=unlike))
    assert trainer.source.collect(trainer.acting, lambda: False)
    clouds = torch.cat([looks.sight.goal for looks in trainer.source.looks(trainer.acting)])
    side = (clouds.amax(dim=1) - clouds.amin(dim=1)).amax(dim=1)
    # A tenth beyond 4 to 5 cm, and the noise of scans.
    assert side.min() > 0.03 and side.max() < 0.08
    trainer.close()


def test_the_eyes_of_another_hands_student_are_gone_on_from(policy, unlike, tmp_path):
    begun = replace(settings(0, tmp_path), teacher=unlike, init=policy)
    wider = replace(begun.student, flow=2 * begun.student.flow)
    with pytest.raises(ValueError, match="another size; leave out --student"):
        trainer_of(replace(begun, student=wider))
    trainer = trainer_of(begun)
    eyes = read_policy(policy).network
    assert trainer.network.num_actions != eyes.num_actions
    for name in ("stages", "flow"):
        weights = getattr(trainer.network, name).state_dict()
        torch.testing.assert_close(weights, getattr(eyes, name).state_dict())
    trainer.close()


def environment(policy, **changes) -> ReorientEnv:
    task = ReorientCfg.of(policy, num_envs=2, objects=("cuboid",), **changes)
    return ReorientEnv(task, "cpu")


def test_an_actor_forgets_where_episodes_begin_and_blind_weights_do_nothing(policy):
    student = read_policy(policy)
    env = environment(student)
    actor, agent = actor_of(str(policy), student, env, goals="points", sensor_errors=True)
    assert (agent.kind, agent.sees) == ("student", "rendered clouds")
    for _ in range(2):
        advance(env, actor.act(torch.empty(0)))
    acting = actor.tracker
    assert acting.hidden.any(dim=1).all()
    assert torch.isfinite(actor.predicted).all()
    env.reset()
    actor.act(torch.empty(0))
    hidden = acting.hidden.clone()
    env.reset()
    acting.belief = Belief(acting.belief.rotation, acting.belief.position + 1.0)
    actor.act(torch.empty(0))
    assert acting.belief.position.abs().max() < 0.5
    assert hidden.any(dim=1).all()
    actor.active[1] = False
    for weight in student.network.parameters():
        weight.zero_()
    assert not actor.act(torch.empty(0)).any()
    env.close()


def test_a_runner_on_a_robot_does_as_the_actor_in_simulation(policy):
    student = read_policy(policy)
    # Objects too have their own size, as the runner believes.
    env = environment(student, randomisation=RandomisationCfg(enabled=False))
    actor, _ = actor_of(str(policy), student, env, goals="points")
    runner = CameraRunner(student, load_hand("dclaw3"), env.objects[0])
    assert runner.kind == "student" and not runner.calibrated
    action = actor.act(torch.empty(0))
    sensed = Sensed(
        joint_q=env.measured_q.numpy()[0, :9],
        joint_qd=env.measured_qd.numpy()[0, :9],
        smoothed=env.smoothed.numpy()[0],
        goal_quat=env.goal_quat.numpy()[0],
        depth=actor.camera.depth.numpy()[0],
    )
    decision = runner.decide(sensed)
    np.testing.assert_allclose(decision.action, action[0].numpy(), atol=1e-4)
    assert decision.distance == pytest.approx(float(actor.predicted[0]), rel=0.05)
    assert decision.voxels > 20 and decision.found.shape == (7,)
    blank = runner.decide(dataclasses.replace(sensed, depth=np.zeros_like(sensed.depth)))
    assert blank.voxels == 0 and np.isfinite(blank.action).all()
    env.close()
