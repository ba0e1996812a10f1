"""From a configuration to a runner: teacher, environments, network, and where a student begins."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vd.config import to_dict
from vd.envs.cfg import ReorientCfg
from vd.files import check_folder
from vd.paper import PAPER
from vd.train.flags import write_config
from vd.train.student.config import ALIGNING, RENDERED, StudentTrainCfg
from vd.train.teacher import BUILDING
from vd.warp_quiet import quiet_warp

if TYPE_CHECKING:
    from vd.policy import TrainedPolicy
    from vd.train.student.align import AlignTrainer
    from vd.train.student.dagger import Dagger
    from vd.vision.network import Student


def student_task(policy: "TrainedPolicy", cfg: StudentTrainCfg) -> ReorientCfg:
    """The environments of the student: those of the teacher, which sees their state without noise."""
    from vd.evaluate.agents import task_for, trained_task

    trained, chosen = trained_task(policy), cfg.task
    task = task_for(
        policy,
        hand=None,
        objects=chosen.objects or trained.objects,
        num_envs=chosen.num_envs,
        seed=chosen.seed,
        stop_tolerance_rad=PAPER.success.rotation_rad,
        max_goal_angle_rad=None,
        episode_s=trained.episode_s,
        randomised=trained.randomisation.enabled,
        success_ends_episode=False,
    )
    exact = replace(
        task.randomisation,
        observation_noise_mean=0.0,
        observation_noise_std=0.0,
        observation_offset_std=0.0,
    )
    # In the world frame, where the student sees; the teacher's frames are chosen from what is observed there.
    return replace(task, randomisation=exact, observation=replace(task.observation, view="world"))


def build_student(
    cfg: StudentTrainCfg, *, started: float | None = None, say: Callable[[str], object] = print
) -> "AlignTrainer | Dagger":
    """Build environments, student and learner as ``cfg`` says, save the configuration, and resume if asked.

    Args:
        cfg: Configuration.
        started: ``time.monotonic()`` from which ``max_minutes`` counts; now by default.
        say: Is told when the slow part begins, and what begins anew.

    Raises:
        FileExistsError: The run folder holds another run and ``resume`` is not set.
        FileNotFoundError: There is no such teacher, student or checkpoint.
        ValueError: The settings do not fit each other, or the student to begin from.
    """
    from vd.device import resolve_device
    from vd.train.checkpoint import find_checkpoint

    cfg.validate()
    check_folder(cfg.run.out)
    device = resolve_device(cfg.run.device)
    checkpoint = find_checkpoint(cfg.run.out, cfg.resume, "student")
    if cfg.teacher is None:
        raise ValueError(
            "--teacher is missing; give the policy to imitate: a policy.pt, a run's folder, or a name"
        )
    if cfg.stage == RENDERED and cfg.init is None and checkpoint is None:
        raise ValueError("--stage 2 begins from a student of an earlier stage; give it as --init")
    say(BUILDING)

    import torch

    # A line for each of some hundred kernels would scroll the progress away.
    quiet_warp()
    from vd.evaluate.agents import find_policy
    from vd.policy import load_policy
    from vd.workers import one_thread_without_gpu

    rank = int(os.environ.get("RANK", "0"))
    teacher = load_policy(find_policy(cfg.teacher), device)
    task = student_task(teacher, cfg)
    one_thread_without_gpu(device)
    # The network is the same in all processes, what they draw is not.
    torch.manual_seed(cfg.task.seed)
    torch.set_float32_matmul_precision("high")
    kept: dict[str, Any] = {"task": to_dict(task), "device": device, "deadline": cfg.run.deadline(started)}
    own_task = replace(task, seed=cfg.task.seed + rank)
    runner: AlignTrainer | Dagger
    if cfg.stage == ALIGNING:
        runner = _aligner(cfg, own_task, kept)
    else:
        runner = _imitation(cfg, own_task, teacher, begins=checkpoint is None, say=say, kept=kept)
    if checkpoint is not None:
        runner.load(checkpoint)
    if rank == 0:
        # After all that can refuse: settings that a run cannot have must not take the place of its own.
        write_config(cfg)
    return runner


def begin_from(path: Path, student: "Student", device: str) -> list[str]:
    """Take over the weights of another student, as far as they fit.

    One that acts has to be of the same network and hand. Of a pre-trained one the encoder is what counts: all
    else may be of another hand, or another network.

    Returns:
        Parts of the network that begin anew, wholly or in part.

    Raises:
        ValueError: It is of another network, or has learned to move another hand.
    """
    from vd.vision.saved import read_student, saved_spec

    state = read_student(path, device)
    spec = saved_spec(state, path)
    acts = spec.stage != ALIGNING
    if acts and spec.num_actions != student.num_actions:
        raise ValueError(
            f"{path} moves {spec.num_actions} joints, the teacher {student.num_actions}; "
            "give a student of the same hand, or one of stage 0"
        )
    own, theirs = student.state_dict(), state["student_state_dict"]
    fits = {key: value for key, value in theirs.items() if key in own and own[key].shape == value.shape}
    anew = sorted({name.split(".")[0] for name in own.keys() - fits.keys()})
    if spec.network != student.cfg and (acts or "encoder" in anew):
        raise ValueError(f"{path} is of another network than --network says; leave those flags out")
    student.load_state_dict(fits, strict=False)
    return anew


def _aligner(cfg: StudentTrainCfg, task: ReorientCfg, kept: dict[str, Any]) -> "AlignTrainer":
    import torch

    from vd.assets_usd.hands import load_hand
    from vd.assets_usd.objects.sets import load_set
    from vd.train.student.align import AlignTrainer, make_scenes
    from vd.train.student.views import Hands
    from vd.vision.alignment import AlignmentNetwork
    from vd.vision.saved import AlignmentSpec

    chosen, device = cfg.align, kept["device"]
    network = AlignmentNetwork(chosen.network).to(device)
    torch.manual_seed(task.seed)
    hand = load_hand(task.hand, task.fingertip, task.hand_layer)
    hands = Hands(hand, chosen.hands, camera=cfg.camera, device=device)
    held_out = load_set(list(chosen.validation)) if chosen.validation else []
    scenes = make_scenes(load_set(list(task.objects)), held_out, hands, chosen)
    spec = AlignmentSpec(network=chosen.network, points=chosen.points, hand=task.hand, camera=cfg.camera)
    return AlignTrainer(scenes, network, chosen, cfg.run, spec=spec, depth={}, **kept)


def _imitation(
    cfg: StudentTrainCfg,
    task: ReorientCfg,
    teacher: "TrainedPolicy",
    *,
    begins: bool,
    say: Callable[[str], object],
    kept: dict[str, Any],
) -> "Dagger":
    """Stages 1 and 2; ``begins``: not resumed. The random state is as the network's has to be."""
    import torch

    from vd.evaluate.agents import policy_name
    from vd.vision.network import Student
    from vd.vision.saved import StudentSpec

    student = Student(cfg.network, teacher.num_actions).to(kept["device"])
    if cfg.init is not None and begins:
        anew = begin_from(cfg.init, student, kept["device"])
        if anew:
            say(f"of {cfg.init} these do not fit, and begin anew: {', '.join(anew)}")
    torch.manual_seed(task.seed)
    spec = StudentSpec(
        network=cfg.network,
        num_actions=teacher.num_actions,
        stage=cfg.stage,
        teacher=policy_name(str(cfg.teacher)),
        camera=cfg.camera,
    )
    runner = _dagger(cfg, task, student, teacher, kept | {"spec": spec, "depth": to_dict(cfg.depth)})
    if begins and not cfg.dagger.reset:  # or all episodes would time out at once
        steps = runner.env.episode_length_buf
        runner.env.episode_length_buf = torch.randint_like(steps, runner.env.max_episode_length)
    return runner


def _dagger(
    cfg: StudentTrainCfg,
    task: ReorientCfg,
    student: "Student",
    teacher: "TrainedPolicy",
    kept: dict[str, Any],
) -> "Dagger":
    from vd.envs.reorient import ReorientEnv
    from vd.evaluate.agents import trained_task
    from vd.evaluate.student import StudentView
    from vd.frame_maps import FrameMaps
    from vd.train.student.dagger import Dagger, WorldTeacher
    from vd.train.vec_env import ReorientVecEnv

    simulation = ReorientEnv(task, kept["device"])
    if simulation.num_observations != teacher.num_observations:
        raise ValueError(
            f"the teacher observes {teacher.num_observations} values, its environments give "
            f"{simulation.num_observations}; take a policy of this version"
        )
    simulation.dump_dir = cfg.run.out
    view = StudentView(
        simulation,
        cfg.network,
        rendered=cfg.stage == RENDERED,
        depth=cfg.depth,
        camera=cfg.camera,
        noise=cfg.noise,
        batch=cfg.dagger.minibatch_envs * cfg.dagger.rollout_steps,
        seed=task.seed,
    )
    seen, maps = trained_task(teacher).observation, None
    if seen.view != "world":
        maps = FrameMaps(simulation.hand, seen, kept["device"])
    labels = WorldTeacher(teacher, maps)
    return Dagger(ReorientVecEnv(simulation), view, student, labels, cfg.dagger, cfg.run, **kept)
