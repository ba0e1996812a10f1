"""From a configuration to a trainer: environments, network, and where it begins."""

from collections.abc import Callable
from dataclasses import replace

import torch

from vd.assets_usd.hand_data import HandModel
from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.command.config import to_dict
from vd.command.versions import installed_versions
from vd.envs.cfg import ObservationCfg, ReorientCfg, TrackedPoseCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.conditions import CONDITIONS
from vd.policy.actor import PACKAGES, TrainedPolicy
from vd.policy.agents import open_policy, policy_name
from vd.policy.contract import Contract, PolicySpec, StudentSpec, derive_interface
from vd.sensors.cfg import DepthCameraCfg
from vd.sensors.depth_camera import DepthCamera
from vd.train.stages import build_stage, task_of_teacher
from vd.train.student.bank import mesh_points
from vd.train.student.config import MADE, RENDERED, StudentTrainCfg
from vd.train.student.made import CLOUDS, MadeSequences
from vd.train.student.simulated import SimulatedSequences
from vd.train.student.trainer import StudentTrainer
from vd.train.student.views import Hands
from vd.train.vec_env import ReorientVecEnv
from vd.vision.acting import ActingStudent, StudentPolicy
from vd.vision.student import Student


def student_task(teacher: TrainedPolicy, cfg: StudentTrainCfg) -> ReorientCfg:
    """The environments: those of the teacher's training, of which it observes the present without noise.

    In stage 2 servos are as in *mixed* at least.
    """
    draws = replace(
        ReorientCfg.of(teacher).randomisation,
        observation_noise_mean=0.0,
        observation_noise_std=0.0,
        observation_offset_std=0.0,
        observation_latency_s=(0.0, 0.0),
        encoder_latency_s=(0.0, 0.0),
        tracked_pose=TrackedPoseCfg(),
    )
    if cfg.stage == RENDERED and draws.enabled:
        draws = replace(draws, effects={**CONDITIONS["mixed"].effects, **draws.effects})
    return task_of_teacher(teacher, cfg.task, draws)


def student_contract(
    task: ReorientCfg, hand: HandModel, teacher: TrainedPolicy, cfg: StudentTrainCfg
) -> Contract:
    """What the student's file says of it, before anything was learned."""
    # Who sees by a camera observes nothing of the simulator's, and is not told noise.
    own_task = replace(
        task, observation=ObservationCfg(), randomisation=ReorientCfg.of(teacher).randomisation
    )
    spec = StudentSpec(
        teacher=policy_name(str(cfg.teacher)),
        camera=cfg.camera,
        depth=DepthCameraCfg.of_hand(hand),
        network=cfg.student,
    )
    actions = PolicySpec(
        num_observations=0,
        num_actions=teacher.num_actions,
        hidden=(),
        distribution="state-dependent",
        normalise_observations=False,
    )
    return Contract(
        interface=derive_interface(own_task, hand, spec),
        network=actions,
        task=to_dict(own_task),
        iterations=0,
        env_steps=0,
        student=spec,
        software=installed_versions(PACKAGES),
    )


def open_student(name: str, device: str = "cpu") -> StudentPolicy:
    """The student that ``--init`` names.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no student.
    """
    policy = open_policy(name, device)
    if not isinstance(policy, StudentPolicy):
        raise ValueError(f"--init {name} is no student; name one of vd-train student")
    return policy


def build_student(cfg: StudentTrainCfg, *, say: Callable[[str], object] = print) -> StudentTrainer:
    """Build network, shapes and environments as ``cfg`` says; as :func:`vd.train.stages.build_stage`."""
    return build_stage(cfg, "student", network_of=_network, trainer_of=_trainer, say=say)


def _network(cfg: StudentTrainCfg, teacher: TrainedPolicy, device: str) -> Student:
    """The student, with the weights of the one that it begins from; of another hand's, its eyes."""
    network = Student(cfg.student, teacher.num_actions, teacher.contract.num_tips).to(device)
    if cfg.init is not None:
        policy = open_student(str(cfg.init), device)
        if policy.spec.network != cfg.student:
            raise ValueError(f"--init {cfg.init} is of another size; leave out --student")
        if policy.hand == teacher.hand:
            network.load_state_dict(policy.network.state_dict())
        else:
            network.stages.load_state_dict(policy.network.stages.state_dict())
            network.flow.load_state_dict(policy.network.flow.state_dict())
    return network


def _trainer(
    cfg: StudentTrainCfg, teacher: TrainedPolicy, network: Student, device: str
) -> StudentTrainer:
    """The student's trainer, with what it learns from."""
    task = student_task(teacher, cfg)
    begin = _made if cfg.stage == MADE else _simulated
    source, acting = begin(cfg, task, teacher, network, device)
    contract = student_contract(task, load_hand(task.hand, task.fingertip), teacher, cfg)
    return StudentTrainer(acting, source, cfg, contract=contract, device=device)


def _made(
    cfg: StudentTrainCfg,
    task: ReorientCfg,
    teacher: TrainedPolicy,
    network: Student,
    device: str,
) -> tuple[MadeSequences, ActingStudent]:
    """Shapes without simulation, and the student at work on them."""
    hand = load_hand(task.hand, task.fingertip, task.hand_layer)
    hands = Hands(
        hand,
        cfg.clouds.hands,
        camera=cfg.camera,
        camera_range=cfg.camera_range,
        device=device,
    )
    held_out = load_set(cfg.task.validation) if cfg.task.validation else []
    if task.fit_objects:
        held_out = [item.fitted(hand.workspace.size_m) for item in held_out]
    source = MadeSequences(load_set(task.objects), held_out, hands, cfg)
    goals = torch.zeros((cfg.learn.batch, cfg.clouds.points, 3), device=device)
    return source, ActingStudent(network, hand, goals)


def _simulated(
    cfg: StudentTrainCfg,
    task: ReorientCfg,
    teacher: TrainedPolicy,
    network: Student,
    device: str,
) -> tuple[SimulatedSequences, ActingStudent]:
    """Environments, and the student at work in them."""
    simulation = ReorientEnv(task, device)
    env = ReorientVecEnv(simulation)
    camera = None
    if cfg.stage == RENDERED:
        depth = replace(
            DepthCameraCfg.of_hand(simulation.hand).with_errors(),
            latency_s=cfg.simulated.latency_s,
            place_range=cfg.camera_range,
        )
        camera = DepthCamera.of_scene(
            simulation.scene,
            simulation.sim.body_q,
            depth,
            simulation.hand.camera.at(cfg.camera),
            frame_s=task.sim.control_dt,
            seed=task.seed,
        )
    count = CLOUDS * cfg.clouds.points
    surfaces = mesh_points(simulation.objects, count, torch.device(env.device))[..., :3]
    source = SimulatedSequences(env, teacher, surfaces, cfg, camera)
    acting = ActingStudent(network, simulation.hand, source.goals)
    # Or all episodes would time out at once.
    env.episode_length_buf = torch.randint_like(env.episode_length_buf, env.max_episode_length)
    return source, acting
