"""From a configuration to a trainer: teacher, environments, network, and where it begins."""

import os
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from vd.command.config import to_dict
from vd.command.files import check_folder
from vd.command.warp_quiet import quiet_warp
from vd.envs.cfg import ReorientCfg
from vd.paper import PAPER
from vd.train.flags import write_config
from vd.train.student.config import MADE, RENDERED, StudentTrainCfg
from vd.train.teacher import BUILDING

if TYPE_CHECKING:
    from vd.assets_usd.hand_data import HandModel
    from vd.policy.actor import TrainedPolicy
    from vd.policy.contract import Contract
    from vd.train.student.sequences import SequenceSource
    from vd.train.student.trainer import StudentTrainer
    from vd.vision.acting import ActingStudent, StudentPolicy
    from vd.vision.student import Student


def student_task(teacher: "TrainedPolicy", cfg: StudentTrainCfg) -> ReorientCfg:
    """The environments: those of the teacher's training, of which it observes the present without noise.

    In stage 2 servos are as in *mixed* at least.
    """
    from vd.evaluate.conditions import CONDITIONS
    from vd.policy.agents import task_for

    trained = ReorientCfg.of(teacher)
    draws = replace(
        trained.randomisation,
        observation_noise_mean=0.0,
        observation_noise_std=0.0,
        observation_offset_std=0.0,
        observation_latency_s=(0.0, 0.0),
        observation_jitter_s=0.0,
        encoder_latency_s=(0.0, 0.0),
        object_pose_error=(0.0, 0.0),
    )
    if cfg.stage == RENDERED and draws.enabled:
        draws = replace(draws, effects={**CONDITIONS["mixed"].effects, **draws.effects})
    return task_for(
        teacher,
        objects=cfg.task.objects or trained.objects,
        num_envs=cfg.task.num_envs,
        seed=cfg.task.seed,
        stop_tolerance_rad=PAPER.success.rotation_rad,
        episode_s=trained.episode_s,
        randomised=draws.enabled,
        condition=draws,
        success_ends_episode=False,
    )


def student_contract(
    task: ReorientCfg, hand: "HandModel", teacher: "TrainedPolicy", cfg: StudentTrainCfg
) -> "Contract":
    """What the student's file says of it, before anything was learned."""
    from vd.command.versions import installed_versions
    from vd.envs.cfg import ObservationCfg
    from vd.policy.actor import PACKAGES
    from vd.policy.agents import policy_name
    from vd.policy.contract import Contract, PolicySpec, StudentSpec, derive_interface

    # Who sees by a camera observes nothing of the simulator's, and is not told noise.
    own_task = replace(
        task, observation=ObservationCfg(), randomisation=ReorientCfg.of(teacher).randomisation
    )
    spec = StudentSpec(
        teacher=policy_name(str(cfg.teacher)), camera=cfg.camera, network=cfg.student
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


def open_student(name: str, device: str = "cpu") -> "StudentPolicy":
    """The student that ``--init`` names.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no student.
    """
    quiet_warp()
    from vd.policy.agents import open_policy
    from vd.vision.acting import StudentPolicy

    policy = open_policy(name, device)
    if not isinstance(policy, StudentPolicy):
        raise ValueError(f"--init {name} is no student; name one of vd-train student")
    return policy


def build_student(
    cfg: StudentTrainCfg, *, say: Callable[[str], object] = print
) -> "StudentTrainer":
    """Build network, shapes and environments as ``cfg`` says, save the configuration, resume if asked.

    Args:
        cfg: Configuration.
        say: Is told when the slow part begins.

    Raises:
        FileExistsError: The run folder holds another run and ``resume`` is not set.
        FileNotFoundError: There is no such teacher, network or checkpoint.
        ValueError: The settings do not fit each other, or the student to begin from.
    """
    from vd.command.device import resolve_device
    from vd.train.checkpoint import find_checkpoint

    cfg.validate()
    check_folder(cfg.run.out)
    device = resolve_device(cfg.run.device)
    checkpoint = find_checkpoint(cfg.run.out, cfg.resume, "student")
    if cfg.teacher is None:
        raise ValueError("--teacher is missing; give the policy that labels: a file or a name")
    say(BUILDING)

    import torch

    quiet_warp()  # a line for each of some hundred kernels would scroll the progress away
    from vd.assets_usd.hands import load_hand
    from vd.command.workers import one_thread_without_gpu
    from vd.policy.agents import open_teacher
    from vd.train.student.trainer import StudentTrainer
    from vd.vision.acting import ActingStudent
    from vd.vision.student import Student

    rank = int(os.environ.get("RANK", "0"))
    teacher = open_teacher(cfg.teacher, device)
    if teacher is None:
        raise ValueError(f"--teacher {cfg.teacher} has no layers; give a trained teacher")
    task = student_task(teacher, cfg)
    one_thread_without_gpu(device)
    # The network is the same in all processes, what they draw is not.
    torch.manual_seed(cfg.task.seed)
    torch.set_float32_matmul_precision("high")
    network = Student(cfg.student, teacher.num_actions).to(device)
    if cfg.init is not None and checkpoint is None:
        policy = open_student(str(cfg.init), device)
        if policy.hand != task.hand:
            raise ValueError(f"--init {cfg.init} moves {policy.hand}, {cfg.teacher} {task.hand}")
        network.load_state_dict(policy.network.state_dict())
    own_task = replace(task, seed=cfg.task.seed + rank)
    torch.manual_seed(own_task.seed)
    hand = load_hand(task.hand, task.fingertip, task.hand_layer)
    if cfg.stage == MADE:
        source = _made(cfg, own_task, hand, device)
        goals = torch.zeros((cfg.learn.batch, cfg.clouds.points, 3), device=device)
        acting = ActingStudent(network, hand, goals)
    else:
        source, acting = _simulated(cfg, own_task, teacher, network, device)
    contract = student_contract(task, load_hand(task.hand, task.fingertip), teacher, cfg)
    trainer = StudentTrainer(acting, source, cfg, contract=contract, device=device)
    if checkpoint is not None:
        trainer.load(checkpoint)
    if rank == 0:
        # After all that can refuse: settings that a run cannot have must not take the place of its
        # own.
        write_config(cfg)
    return trainer


def _made(
    cfg: StudentTrainCfg, task: ReorientCfg, hand: "HandModel", device: str
) -> "SequenceSource":
    """Shapes without simulation."""
    from vd.assets_usd.objects.sets import load_set
    from vd.train.student.made import MadeSequences
    from vd.train.student.views import Hands

    hands = Hands(hand, cfg.clouds.hands, camera=cfg.camera, device=device)
    held_out = load_set(list(cfg.clouds.validation)) if cfg.clouds.validation else []
    return MadeSequences(load_set(list(task.objects)), held_out, hands, cfg)


def _simulated(
    cfg: StudentTrainCfg,
    task: ReorientCfg,
    teacher: "TrainedPolicy",
    network: "Student",
    device: str,
) -> "tuple[SequenceSource, ActingStudent]":
    """Environments, and the student at work in them."""
    import torch
    import warp as wp

    from vd.envs.reorient import ReorientEnv
    from vd.sensors.cfg import DepthCameraCfg
    from vd.sensors.depth_camera import DepthCamera
    from vd.train.student.bank import mesh_points
    from vd.train.student.made import CLOUDS
    from vd.train.student.simulated import SimulatedSequences
    from vd.train.vec_env import ReorientVecEnv
    from vd.vision.acting import ActingStudent

    simulation = ReorientEnv(task, device)
    env = ReorientVecEnv(simulation)
    camera = None
    if cfg.stage == RENDERED:
        depth = replace(DepthCameraCfg().with_errors(), latency_s=cfg.simulated.latency_s)
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
    acting.belief = acting.build.first_belief(wp.to_torch(simulation.goal_quat))
    # Or all episodes would time out at once.
    env.episode_length_buf = torch.randint_like(env.episode_length_buf, env.max_episode_length)
    return source, acting
