"""From a configuration to a runner: teacher, environments, network, and where it begins."""

import os
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from vd.command.config import to_dict
from vd.command.files import check_folder
from vd.command.warp_quiet import quiet_warp
from vd.envs.cfg import ObservationCfg, ReorientCfg
from vd.paper import PAPER
from vd.train.flags import write_config
from vd.train.student.config import SIMULATED, StudentTrainCfg
from vd.train.teacher import BUILDING

if TYPE_CHECKING:
    from vd.policy.actor import TrainedPolicy
    from vd.train.student.align import AlignTrainer
    from vd.train.student.looks import SimulatedLooks
    from vd.vision.alignment import AlignmentNetwork


def student_task(policy: "TrainedPolicy", cfg: StudentTrainCfg) -> ReorientCfg:
    """The environments of the student: those of the teacher's training."""
    from vd.policy.agents import task_for

    trained, chosen = ReorientCfg.of(policy), cfg.task
    task = task_for(
        policy,
        objects=chosen.objects or trained.objects,
        num_envs=chosen.num_envs,
        seed=chosen.seed,
        stop_tolerance_rad=PAPER.success.rotation_rad,
        episode_s=trained.episode_s,
        randomised=trained.randomisation.enabled,
        success_ends_episode=False,
    )
    return replace(task, observation=ObservationCfg())  # who sees by a camera does not look at it


def build_student(cfg: StudentTrainCfg, *, say: Callable[[str], object] = print) -> "AlignTrainer":
    """Build network, shapes and environments as ``cfg`` says, save the configuration, and resume if asked.

    Args:
        cfg: Configuration.
        say: Is told when the slow part begins.

    Raises:
        FileExistsError: The run folder holds another run and ``resume`` is not set.
        FileNotFoundError: There is no such teacher, network or checkpoint.
        ValueError: The settings do not fit each other, or the network to begin from.
    """
    from vd.command.device import resolve_device
    from vd.train.checkpoint import find_checkpoint

    cfg.validate()
    check_folder(cfg.run.out)
    device = resolve_device(cfg.run.device)
    checkpoint = find_checkpoint(cfg.run.out, cfg.resume, "student")
    if cfg.teacher is None:
        raise ValueError(
            "--teacher is missing; give the policy that acts: a policy.safetensors, a run's folder, "
            "or a name"
        )
    if cfg.stage == SIMULATED and cfg.init is None and checkpoint is None:
        raise ValueError(
            "--stage 1 begins from a network of stage 0; give its alignment.pt as --init"
        )
    say(BUILDING)

    import torch

    # A line for each of some hundred kernels would scroll the progress away.
    quiet_warp()
    from vd.command.workers import one_thread_without_gpu
    from vd.policy.agents import open_teacher
    from vd.train.student.network import open_network
    from vd.vision.alignment import AlignmentNetwork

    rank = int(os.environ.get("RANK", "0"))
    teacher = open_teacher(cfg.teacher, device)
    if teacher is None:
        raise ValueError(f"--teacher {cfg.teacher} has no layers; give a trained teacher")
    task = student_task(teacher, cfg)
    one_thread_without_gpu(device)
    # The network is the same in all processes, what they draw is not.
    torch.manual_seed(cfg.task.seed)
    torch.set_float32_matmul_precision("high")
    network = AlignmentNetwork(cfg.align.network).to(device)
    if cfg.init is not None and checkpoint is None:
        network.load_state_dict(open_network(str(cfg.init), device)[0].state_dict())
    own_task = replace(task, seed=cfg.task.seed + rank)
    torch.manual_seed(own_task.seed)
    kept = {"task": to_dict(task), "device": device}
    runner = _trainer(cfg, own_task, teacher, network, kept)
    if checkpoint is not None:
        runner.load(checkpoint)
    if rank == 0:
        # After all that can refuse: settings that a run cannot have must not take the place of its
        # own.
        write_config(cfg)
    return runner


def _trainer(
    cfg: StudentTrainCfg,
    task: ReorientCfg,
    teacher: "TrainedPolicy",
    network: "AlignmentNetwork",
    kept: dict[str, Any],
) -> "AlignTrainer":
    from vd.assets_usd.hands import load_hand
    from vd.assets_usd.objects.sets import load_set
    from vd.train.student.align import AlignTrainer, make_scenes
    from vd.train.student.views import Hands
    from vd.vision.saved import AlignmentSpec

    chosen, device = cfg.align, kept["device"]
    hand = load_hand(task.hand, task.fingertip, task.hand_layer)
    hands = Hands(hand, chosen.hands, camera=cfg.camera, device=device)
    held_out = load_set(list(chosen.validation)) if chosen.validation else []
    scenes = make_scenes(load_set(list(task.objects)), held_out, hands, chosen)
    spec = AlignmentSpec(
        network=chosen.network, points=chosen.points, hand=task.hand, camera=cfg.camera
    )
    looks = _looks(cfg, task, teacher, network, device) if cfg.stage == SIMULATED else None
    return AlignTrainer(scenes, network, chosen, cfg.run, spec=spec, looks=looks, **kept)


def _looks(
    cfg: StudentTrainCfg,
    task: ReorientCfg,
    teacher: "TrainedPolicy",
    network: "AlignmentNetwork",
    device: str,
) -> "SimulatedLooks":
    """Environments in which the teacher acts by the network."""
    import torch

    from vd.envs.reorient import ReorientEnv
    from vd.policy.contract import TrackingSpec
    from vd.tracking.policy import TrackingPolicy
    from vd.train.student.align import CLOUDS, mesh_points
    from vd.train.student.looks import SimulatedLooks
    from vd.train.vec_env import ReorientVecEnv

    simulation = ReorientEnv(task, device)
    env = ReorientVecEnv(simulation)
    # Or all episodes would time out at once.
    env.episode_length_buf = torch.randint_like(env.episode_length_buf, env.max_episode_length)
    spec = TrackingSpec(camera=cfg.camera, alignment=network.cfg)
    policy = TrackingPolicy(teacher, replace(teacher.contract, tracking=spec), network)
    surfaces = mesh_points(simulation.objects, CLOUDS * cfg.align.points, network.summary.device)
    return SimulatedLooks(env, policy, surfaces[..., :3].contiguous(), cfg.looks, task.seed)
