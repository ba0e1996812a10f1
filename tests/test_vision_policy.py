"""Vision policies: what they observe of a scene, how their teachers act on it, their files and commands."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial.transform import Rotation
from sensed_world import state_of

from vd.assets_usd.hands import load_hand
from vd.command.config import to_dict
from vd.deploy.loop.action import ActionFilter
from vd.deploy.loop.policy_runner import CameraRunner
from vd.envs.cfg import ObservationCfg, RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate import cli
from vd.evaluate.camera_actor import CameraActor, sensed
from vd.evaluate.goals import ONE_GOAL
from vd.evaluate.result import Result
from vd.evaluate.trace import Trace
from vd.kernels.task.observations import teacher_observation_slices
from vd.kernels.task.shapes import shape_observation_size
from vd.policy.actor import TrainedPolicy, perceptron
from vd.policy.agents import SHIPPED_POLICIES, find_policy, open_policy, sees_clouds, task_for
from vd.policy.bundle import read_policy, write_policy
from vd.policy.contract import (
    Contract,
    ContractError,
    PolicySpec,
    VisionSpec,
    contract_of,
    contract_text,
)
from vd.sensors.cfg import DepthSensorCfg
from vd.sensors.depth_camera import DepthCamera
from vd.train.checkpoint import save_checkpoint
from vd.train.cli import main as vd_train
from vd.vision.acting_teacher import ActingTeacher, VisionPolicy
from vd.vision.alignment import AlignmentNetwork
from vd.vision.camera_observer import UNSEEN, CameraObserver, Found
from vd.vision.cfg import AlignmentCfg
from vd.vision.saved import AlignmentSpec, alignment_export

INSTALLED = [name for name in SHIPPED_POLICIES if name.endswith("-vision")]
WORLDS = 12
EXACT = RandomisationCfg(enabled=False)
CLOSE_RAD = 0.3
"""A rotation that was found, from a camera's points."""
SIZES = AlignmentCfg(width=16, layers=1, heads=2, tokens=12)


def untrained() -> AlignmentNetwork:
    """A network of random weights."""
    torch.manual_seed(0)
    return AlignmentNetwork(SIZES).eval().requires_grad_(False)


def observer_of(env: ReorientEnv) -> CameraObserver:
    clouds = np.stack([item.surface_points for item in env.objects])[env.scene.world_object]
    return CameraObserver(
        env.hand,
        read_policy(find_policy("dclaw3-vision")).alignment,
        torch.tensor(clouds),
        num_observations=env.num_observations,
        control_hz=env.cfg.sim.control_hz,
    )


def camera_of(env: ReorientEnv) -> DepthCamera:
    return DepthCamera.of_scene(env.scene, env.sim.body_q, frame_s=env.cfg.sim.control_dt)


@pytest.fixture(scope="module")
def env():
    """Cubes that were let go, hands that moved."""
    cfg = ReorientCfg(
        hand="dclaw3",
        num_envs=3,
        objects=("cube",),
        seed=1,
        observation=ObservationCfg(shape="full"),
        randomisation=EXACT,
    )
    made = ReorientEnv(cfg, "cpu")
    torch.manual_seed(0)
    for _ in range(3):
        wp.to_torch(made.action).uniform_(-1.0, 1.0)
        made.step(made.action)
    return made


def test_it_observes_what_its_teacher_does(env):
    """All but the object is the environment's own; the object is found near where it is."""
    camera, observer = camera_of(env), observer_of(env)
    observed, angle = observer(replace(sensed(env, camera), fresh=torch.ones(3, dtype=torch.bool)))
    true, columns = (
        wp.to_torch(env.world_observation),
        teacher_observation_slices(env.num_fingers, env.num_actions),
    )
    for name in ("joint_position", "joint_velocity", "fingertips", "previous_action"):
        torch.testing.assert_close(
            observed[:, columns[name]], true[:, columns[name]], atol=2e-5, rtol=1e-4
        )
    torch.testing.assert_close(
        observed[:, columns["object_position"]],
        true[:, columns["object_position"]],
        atol=6e-3,
        rtol=0.0,
    )
    for name in (*UNSEEN, "object_velocity", "object_spin"):  # a first look knows no motion
        assert not observed[:, columns[name]].any()
    assert [float(observer.known[columns[name]].sum()) for name in UNSEEN] == [0.0, 0.0]
    group, pose = Rotation.create_group("O"), env.object_pose()
    for world, goal in enumerate(env.goal_quat.numpy()):
        found = Rotation.from_quat(observer.found.orientation[world].numpy())
        assert (
            Rotation.from_quat(pose[world, 3:7]).inv() * found * group
        ).magnitude().min() < CLOSE_RAD, "a cube looks the same from 24 sides"
        away = (found * Rotation.from_quat(goal).inv()).magnitude()
        assert away == pytest.approx(float(angle[world]), abs=1e-3)
        told = Rotation.from_quat(observed[world, columns["relative_orientation"]].numpy())
        assert told.magnitude() == pytest.approx(float(angle[world]), abs=1e-3)


def test_the_shape_of_a_true_pose_is_as_the_environment_observes_it(env, monkeypatch):
    senses, observer = sensed(env, camera_of(env)), observer_of(env)
    observer(senses)
    pose = torch.tensor(env.object_pose()[:, :7])
    truly = replace(observer.found, position=pose[:, :3], orientation=pose[:, 3:])
    monkeypatch.setattr(observer, "_find", lambda _: truly)
    observed, shape = observer(senses)[0], slice(-shape_observation_size(env.num_fingers), None)
    true = wp.to_torch(env.world_observation)
    torch.testing.assert_close(observed[:, shape], true[:, shape], atol=1e-4, rtol=0.0)


def test_motion_is_that_between_two_looks(env, monkeypatch):
    senses, observer = sensed(env, camera_of(env)), observer_of(env)
    base = Rotation.from_quat(env.hand.mount[3:])
    turn, shift = np.array([0.0, 0.0, 0.1]), np.array([0.01, 0.0, 0.0])
    poses = [np.zeros(3), Rotation.identity()], [shift, Rotation.from_rotvec(turn)]

    def look(seen, count, *, fresh):
        place, rotation = poses[int(observer.finder.looks[0])]
        observer.finder.looks += 1
        pose = [*base.inv().apply(place), *(base.inv() * rotation).as_quat()]
        observer.finder.pose[:] = torch.tensor(pose)

    monkeypatch.setattr(observer.finder, "look", look)
    for _ in poses:
        observer(senses)
    rate = env.cfg.sim.control_hz
    np.testing.assert_allclose(observer.found.velocity, np.tile(rate * shift, (3, 1)), atol=1e-4)
    np.testing.assert_allclose(observer.found.spin, np.tile(rate * turn, (3, 1)), atol=1e-2)


@pytest.fixture(
    scope="module", params=["dclaw3 goal", "dclaw4 goal", "dclaw3 mirrored", "dclaw4 world"]
)
def teacher(request):
    """A teacher of random weights, whose observation is not normalised by nature."""
    hand, view = request.param.split()
    observation = ObservationCfg(view=view)
    task = ReorientCfg(hand=hand, objects=("cube",), num_envs=1, observation=observation)
    columns = teacher_observation_slices(load_hand(hand).num_fingers, load_hand(hand).num_joints)
    sizes = columns["previous_action"].stop, columns["joint_position"].stop, (16, 8)
    spec = PolicySpec(*sizes, "gaussian", normalise_observations=True)
    torch.manual_seed(0)
    weights = {f"mlp.{name}": value for name, value in perceptron(spec).state_dict().items()}
    weights["obs_normalizer._mean"] = torch.randn(1, spec.num_observations)
    weights["obs_normalizer._std"] = 0.5 + torch.rand(1, spec.num_observations)
    return TrainedPolicy(Contract({}, spec, to_dict(task), 0, 0), weights)


def acting(
    teacher: TrainedPolicy, monkeypatch, world: torch.Tensor, angle: torch.Tensor
) -> ActingTeacher:
    """A teacher by a camera that observes what it is told."""
    envs = len(world)
    contract = replace(teacher.contract, tracking=VisionSpec(alignment=SIZES))
    policy = VisionPolicy(teacher, contract, untrained())
    actor = ActingTeacher(policy, load_hand(teacher.hand), torch.randn(envs, 500, 3))
    monkeypatch.setattr(CameraObserver, "__call__", lambda self, senses: (world, angle))
    place = torch.zeros(envs, 3)
    turn = torch.tensor([0.0, 0.0, 0.0, 1.0]).repeat(envs, 1)
    actor.observer.found = Found(turn, place, place, place, torch.zeros(envs))
    return actor


def observations(teacher: TrainedPolicy, angle: torch.Tensor) -> torch.Tensor:
    """Random observations in the world frame of objects that far from their goals."""
    torch.manual_seed(1)
    world = torch.randn(WORLDS, teacher.num_observations)
    half = 0.5 * angle[:, None]
    axis = torch.nn.functional.normalize(torch.randn(WORLDS, 3), dim=-1)
    columns = teacher_observation_slices(teacher.num_actions // 3, teacher.num_actions)
    world[:, columns["relative_orientation"]] = torch.cat([half.sin() * axis, half.cos()], dim=-1)
    return world


def test_its_teacher_acts_in_the_nearest_view_but_is_told_the_mean_of_what_no_camera_shows(
    teacher, monkeypatch
):
    angle = torch.full((WORLDS,), 2.0)
    world = observations(teacher, angle)
    actor = acting(teacher, monkeypatch, world, angle)
    decision, maps = actor.step(None), actor._maps
    assert torch.equal(decision.angle, angle)
    seen = world if maps is None else maps.take(world, maps.choose(world))
    told, columns = (
        seen.clone(),
        teacher_observation_slices(teacher.num_actions // 3, teacher.num_actions),
    )
    for name in UNSEEN:
        told[:, columns[name]] = teacher.network.offset[:, columns[name]]
    action = teacher.act(told)
    action = action if maps is None else maps.world_action(action, maps.choose(world))
    torch.testing.assert_close(decision.action, action)
    assert (teacher.act(seen) - teacher.act(told)).abs().max() > 1e-3


@pytest.mark.parametrize("name", INSTALLED)
def test_an_installed_one_is_small_and_has_rules_from_episodes(name):
    path = SHIPPED_POLICIES[name]
    policy = read_policy(path)
    assert policy.kind == "vision" and sees_clouds(open_policy(name, "cpu"))
    assert path.stat().st_size < 4e6, "no critic, no optimiser"
    assert policy.spec.calibrated_on and "/" not in policy.spec.teacher + policy.spec.calibrated_on


def test_a_vision_policy_comes_back(tmp_path):
    policy, clouds = read_policy(find_policy("dclaw3-vision")), torch.randn(2, 3, 40, 3)
    contract = replace(policy.contract, tracking=replace(policy.spec, alignment=SIZES))
    vision = replace(policy, contract=contract, alignment=untrained())
    write_policy(vision, tmp_path / "vision.safetensors")
    found = open_policy(tmp_path / "vision.safetensors", "cpu")
    assert (found.kind, found.spec) == ("vision", vision.spec) and sees_clouds(found)
    assert torch.equal(found.alignment(*clouds).rotation, vision.alignment(*clouds).rotation)


def test_a_policy_without_a_network_is_refused():
    """Such as an earlier version's, which looked for the object's mesh."""
    contract = read_policy(find_policy("dclaw3-vision")).contract
    without = replace(contract, tracking=replace(contract.tracking, alignment=None))
    with pytest.raises(
        ContractError, match=r"it: contract\.tracking\.alignment: .*take the version"
    ):
        contract_of(contract_text(without), "it")


def test_a_camera_errs_as_a_real_one_where_it_is_asked_to(env):
    policy = read_policy(find_policy("dclaw3-vision"))
    plain, real = (
        CameraActor(env, policy, sensor_errors=errs).camera.cfg for errs in (False, True)
    )
    assert (
        not plain.sensor.enabled and plain.latency_s == (0.0, 0.0) and plain.position_noise_m == 0.0
    )
    assert real.sensor == DepthSensorCfg.realistic() and real.latency_s[1] > real.latency_s[0] > 0.0
    assert real.position_noise_m > 0.0 and real.rotation_noise_rad > 0.0
    assert real.points == plain.points, "all else is as in its training"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dclaw3-vision", "dclaw3-student"])
def test_a_runner_decides_on_a_hand_as_in_the_simulator(name):
    """An episode of the policy; the deploy side is given joints, goal and image, nothing else."""
    policy = open_policy(name, "cpu")
    task = task_for(
        policy,
        objects=("cube",),
        num_envs=1,
        seed=3,
        stop_tolerance_rad=0.4,
        episode_s=3.0,
        randomised=False,
        success_ends_episode=False,
    )
    env = ReorientEnv(task, "cpu")
    actor, runner = CameraActor(env, policy), CameraRunner(policy, env.hand, env.objects[0])
    runner.begin()
    assert runner.kind == policy.kind
    actions = ActionFilter(env.hand, task)
    for step in range(env.max_episode_steps):
        sensed = state_of(env)
        action = actor.act(wp.to_torch(env.observation))
        image = actor.camera.depth.numpy()[0].copy()
        decision = runner.decide(replace(sensed, depth=image))
        np.testing.assert_allclose(decision.action, action[0], atol=1e-3, err_msg=f"step {step}")
        assert decision.distance == pytest.approx(float(actor.predicted[0]), abs=1e-4)
        if not sensed.smoothed.any():  # an episode begins
            actions.reset()
        target = actions.goal(action[0].numpy(), sensed.joint_q)
        env.step(wp.from_torch(action.contiguous()))
        np.testing.assert_allclose(target, env.sim.target.numpy()[0, : env.num_actions], atol=1e-6)
    with pytest.raises(ValueError, match="no image"):
        runner.decide(sensed)


@pytest.mark.slow
def test_an_evaluation_in_the_air_by_scans(tmp_path):
    flags = [
        "--in-air",
        "--goals",
        "scan",
        "--episodes",
        "1",
        "--device",
        "cpu",
        "--episode-s",
        "0.5",
    ]
    assert cli.main(["dclaw3-vision", *flags, "--out", str(tmp_path)]) == 0
    row = Result.read(tmp_path / "eval.json").rows[0]
    assert (row.kind, row.sees, row.stopped_by) == ("vision", "rendered clouds", "prediction")
    assert row.protocol.goals == "scan" and row.protocol.sensor_errors and row.protocol.in_air
    assert row.prediction is not None and row.held is not None


def test_the_command_writes_a_policy_with_rules_for_the_conditions_it_was_told(
    tmp_path, monkeypatch, capsys
):
    asked = []

    def spy(cfg, *_others):
        asked.append(cfg)
        seen = np.zeros((1, 1, 4))
        norms, quat = np.array([[[0.0, 0.5, 0.4, 0.3]]]), np.zeros((1, 1, 4))
        ends = np.full((1, 1), 4), np.zeros((1, 1), bool), np.zeros((1, 1), bool)
        none = np.zeros((1, 1), int)
        begin = ONE_GOAL, 0, quat, quat
        return Trace(*begin, seen, seen, norms, seen, *ends, still=seen == 0.0, reached=none)

    monkeypatch.setattr("vd.evaluate.compare.run_episodes", spy)
    path = tmp_path / "vision.safetensors"
    flags = ["tracker", "dclaw3", "--objects", "cube", "--episodes", "1", "--device", "cpu"]
    flags += ["--out", str(path)]
    assert vd_train(flags) == 0
    policy, cfg = read_policy(path), asked[-1]
    assert (
        policy.spec.calibrated_on
        == "cube: 1 episodes, goals by points, tolerance 0.4 rad, seed 1000"
    )
    assert policy.spec.teacher == "dclaw3" and policy.spec.precise is not None
    installed = read_policy(SHIPPED_POLICIES["dclaw3-vision"])
    learned = zip(*(p.alignment.parameters() for p in (policy, installed)), strict=True)
    assert all(torch.equal(*both) for both in learned), "of the hand's installed vision policy"
    assert 0.0 < policy.spec.stopping.action_norm < 1.0
    assert cfg.sensor_errors and cfg.goals == "points"
    said = capsys.readouterr().out
    assert "Of 1 episodes" in said and "--alignment dclaw3-vision" in said
    assert vd_train([*flags, "--in-air"]) == 0
    assert asked[-1].in_air and "in the air" in read_policy(path).spec.calibrated_on
    network, camera = untrained(), (0.1, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0)
    learned = AlignmentSpec(network=network.cfg, points=512, hand="dclaw4", camera=camera)
    state = {
        "alignment_state_dict": network.state_dict(),
        "spec": to_dict(learned),
        "iter": 1,
        "env_steps": 2,
    }
    save_checkpoint(tmp_path / "alignment.pt", alignment_export(state))
    assert vd_train([*flags, "--alignment", str(tmp_path / "alignment.pt")]) == 0
    assert read_policy(path).spec.alignment == SIZES and read_policy(path).spec.camera == camera
    assert vd_train([*flags, "--alignment", "dclaw4-vision"]) == 0
    assert read_policy(path).spec.alignment == installed.spec.alignment
    assert vd_train([*flags, "--alignment", "dclaw3"]) == 1
    assert vd_train(["tracker", "dclaw3-vision", *flags[2:]]) == 1
    assert "give a teacher" in capsys.readouterr().err


def test_without_a_vision_policy_of_the_hand_a_network_has_to_be_named(monkeypatch, capsys):
    def none(hand, *kinds):
        raise ValueError(f"no vision policy of {hand} is installed")

    monkeypatch.setattr("vd.train.tracker.default_policy", none)
    assert vd_train(["tracker", "dclaw3", "--objects", "cube", "--device", "cpu"]) == 1
    assert "alignment made: no vision policy of dclaw3" in capsys.readouterr().err
