"""From a configuration to a runner: teacher, environments, network, and where a student begins."""

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vd.config import to_dict
from vd.envs.cfg import ReorientCfg
from vd.files import check_folder, write_json
from vd.paper import PAPER
from vd.train.student.config import (
    PRETRAINING,
    RENDERED,
    STUDENT_NAME,
    SYNTHETIC,
    StudentTrainCfg,
    validate,
)
from vd.warp_quiet import quiet_warp

if TYPE_CHECKING:
    from vd.policy import TrainedPolicy
    from vd.train.student.runner import Learner, StudentRunner
    from vd.vision.cfg import StateCfg
    from vd.vision.network import Student

CONFIG_NAME = "config.json"
"""The resolved configuration, in the run's folder, written before the first iteration."""


def default_init(stage: int, run_dir: Path) -> Path | None:
    """The student of stage 1 beside a folder of stage 2 (``.../stage1/student.pt``), if there is one."""
    if stage != RENDERED:
        return None
    name = run_dir.name.replace(f"stage{RENDERED}", f"stage{SYNTHETIC}")
    path = run_dir.with_name(name) / STUDENT_NAME
    return path if name != run_dir.name and path.is_file() else None


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
        max_goal_angle_rad=chosen.max_goal_angle_rad,
        episode_s=trained.episode_s,
        randomised=trained.randomisation.enabled if chosen.randomise is None else chosen.randomise,
        success_ends_episode=False,
        at_rest=chosen.at_rest,
    )
    exact = replace(
        task.randomisation,
        observation_noise_mean=0.0,
        observation_noise_std=0.0,
        observation_offset_std=0.0,
    )
    return replace(task, randomisation=exact)


def build_student(cfg: StudentTrainCfg, *, started: float | None = None) -> "StudentRunner":
    """Build environments, student and learner as ``cfg`` says, save the configuration, and resume if asked.

    Args:
        cfg: Configuration.
        started: ``time.monotonic()`` from which ``max_minutes`` counts; now by default.

    Raises:
        FileExistsError: The run folder holds another run and ``resume`` is not set.
        FileNotFoundError: There is no such teacher, student or checkpoint.
        ValueError: The settings do not fit each other, or the student to begin from.
    """
    from vd.device import resolve_device
    from vd.train.checkpoint import find_checkpoint

    validate(cfg)
    rank, folder = int(os.environ.get("RANK", "0")), cfg.run.out
    check_folder(folder)
    cfg = replace(cfg, run=replace(cfg.run, device=resolve_device(cfg.run.device)))
    checkpoint = find_checkpoint(folder, cfg.resume, "student")
    if cfg.teacher is None:
        raise ValueError(
            "--teacher is missing; give the policy to imitate: a policy.pt, a run's folder, or a name"
        )
    if checkpoint is None:
        check_start(cfg)

    import torch

    # A line for each of some hundred kernels would scroll the progress away.
    quiet_warp()
    from vd.evaluate.agents import find_policy, policy_name
    from vd.policy import load_policy
    from vd.train.distributed import Processes, join_processes
    from vd.train.student.runner import StudentRunner
    from vd.vision.network import Student
    from vd.vision.saved import StudentSpec
    from vd.workers import one_thread_without_gpu

    device = cfg.run.device
    teacher = load_policy(find_policy(cfg.teacher), device)
    task = student_task(teacher, cfg)
    if checkpoint is None:
        cfg = replace(cfg, network=replace(cfg.network, state=state_head(cfg, teacher)))
    if cfg.network.state.views:
        # The teacher's views are the student's to choose.
        task = replace(task, observation=replace(task.observation, view="world"))
    one_thread_without_gpu(device)
    # The network is the same in all processes, what they draw is not.
    torch.manual_seed(cfg.task.seed)
    torch.set_float32_matmul_precision("high")
    student = Student(cfg.network, teacher.num_actions).to(device)
    if cfg.init is not None and checkpoint is None:
        anew = begin_from(cfg.init, student, device)
        if anew and rank == 0:
            print(f"of {cfg.init} these do not fit, and begin anew: {', '.join(anew)}")
    torch.manual_seed(cfg.task.seed + rank)
    world_size = int(os.environ.get("WORLD_SIZE", "1"))
    own_task = replace(task, seed=cfg.task.seed + rank)
    if cfg.stage == PRETRAINING:
        learner: Learner = _pretrainer(cfg, own_task, student, world_size)
    else:
        learner = _dagger(cfg, own_task, student, teacher, world_size, fresh=checkpoint is None)
    spec = StudentSpec(
        network=cfg.network,
        num_actions=teacher.num_actions,
        stage=cfg.stage,
        teacher=policy_name(str(cfg.teacher)),
        camera=cfg.camera,
    )
    runner = StudentRunner(
        learner,
        cfg.run,
        spec=spec,
        task=to_dict(task),
        depth=to_dict(cfg.depth),
        device=device,
        processes=join_processes(device) if world_size > 1 else Processes(0, 0, 1),
        deadline=cfg.run.deadline(started),
    )
    if checkpoint is not None:
        runner.load(checkpoint)
    if rank == 0:
        # After all that can refuse: settings that a run cannot have must not take the place of its own.
        _take_folder(cfg, runner, checkpoint)
    return runner


def _take_folder(cfg: StudentTrainCfg, runner: "StudentRunner", checkpoint: Path | None) -> None:
    """Save the configuration in the run's folder, and set aside what is damaged after the checkpoint."""
    from vd.train.checkpoint import damaged_after, set_aside

    folder = cfg.run.out
    saved = to_dict(replace(cfg, resume=None))
    saved["run"]["device"] = "auto"  # a resumed run may find itself on another machine
    write_json(folder / CONFIG_NAME, saved)
    runner.damaged = damaged_after(folder, checkpoint, "student")
    set_aside(runner.damaged)


def check_start(cfg: StudentTrainCfg) -> None:
    """Refuse to begin stage 2 from random weights without being told to.

    Raises:
        FileNotFoundError: ``--init`` is no file.
        ValueError: There is nothing to begin from, or only a pre-trained encoder.
    """
    if cfg.init is None:
        if cfg.stage == RENDERED and not cfg.from_scratch:
            raise ValueError(
                "stage 2 begins from a student of stage 1: give it as --init, or as student.pt in "
                f"{cfg.run.out.with_name(f'stage{SYNTHETIC}')}; --from-scratch begins without one"
            )
        return
    from vd.vision.saved import read_student, saved_spec

    stage = saved_spec(read_student(cfg.init), cfg.init).stage
    if cfg.stage == RENDERED and stage == PRETRAINING and not cfg.from_scratch:
        raise ValueError(
            f"--init {cfg.init} is of stage 0: its encoder is trained, its policy is not. Give a student of "
            "stage 1, or add --from-scratch"
        )


def state_head(cfg: StudentTrainCfg, teacher: "TrainedPolicy") -> "StateCfg":
    """The head for what the teacher observes: a student that acts already keeps to having one, or none."""
    from vd.vision.cfg import StateCfg
    from vd.vision.saved import read_student, saved_spec

    wanted = cfg.dagger.state_weight > 0.0
    if cfg.init is not None and saved_spec(read_student(cfg.init), cfg.init).stage != PRETRAINING:
        wanted = cfg.network.state.values > 0
    if not wanted:
        return StateCfg()
    return head_of(teacher)


def head_of(teacher: "TrainedPolicy") -> "StateCfg":
    """The head that estimates what a teacher observes, in the views that it was trained in."""
    from vd.evaluate.agents import trained_task
    from vd.kernels.task.observations import JOINTS_PER_FINGER
    from vd.vision.state import state_cfg

    observation = trained_task(teacher).observation
    return state_cfg(teacher.spec, views=observation.views(teacher.num_actions // JOINTS_PER_FINGER))


def begin_from(path: Path, student: "Student", device: str) -> list[str]:
    """Take over the weights of another student, as far as they fit.

    Of one that acts, only the layers for what its teacher observes may be of other sizes. Of a pre-trained
    one the encoder is what counts: all else may be of another hand, or another network.

    Returns:
        Parts of the network that begin anew, wholly or in part.

    Raises:
        ValueError: It is of another network, or has learned to move another hand.
    """
    from vd.vision.saved import read_student, saved_spec

    state = read_student(path, device)
    spec = saved_spec(state, path)
    acts = spec.stage != PRETRAINING
    if acts and spec.num_actions != student.num_actions:
        raise ValueError(
            f"{path} moves {spec.num_actions} joints, the teacher {student.num_actions}; "
            "give a student of the same hand, or one of stage 0"
        )
    other = to_dict(replace(spec.network, state=student.cfg.state)) != to_dict(student.cfg)
    own, theirs = student.state_dict(), state["student_state_dict"]
    if spec.network.state != student.cfg.state:
        # Actions were read from the memory alone, or added to those of another teacher.
        theirs = {name: value for name, value in theirs.items() if not name.startswith(("state.", "mean."))}
    fits = {key: value for key, value in theirs.items() if key in own and own[key].shape == value.shape}
    anew = sorted({name.split(".")[0] for name in own.keys() - fits.keys()})
    if other and (acts or "encoder" in anew):
        raise ValueError(f"{path} is of another network than --network says; leave those flags out")
    student.load_state_dict(fits, strict=False)
    return anew


def _pretrainer(cfg: StudentTrainCfg, task: ReorientCfg, student: "Student", world_size: int) -> Any:
    from vd.assets_usd.hands import load_hand
    from vd.assets_usd.objects.sets import load_set
    from vd.envs.setup import object_scales
    from vd.train.student.pretrain import Pretrainer, RandomScenes

    objects = load_set(list(task.objects))
    scenes = RandomScenes(
        load_hand(task.hand, task.fingertip, task.hand_layer),
        objects,
        cfg.network,
        scales=object_scales(task.randomisation),
        near_share=cfg.pretrain.near_share,
        noise=cfg.noise,
        rendered_share=cfg.pretrain.rendered_share,
        depth=cfg.depth,
        batch=cfg.pretrain.batch,
        seed=task.seed,
        device=cfg.run.device,
    )
    return Pretrainer(scenes, student, len(objects), cfg.pretrain, world_size=world_size)


def _dagger(
    cfg: StudentTrainCfg,
    task: ReorientCfg,
    student: "Student",
    teacher: "TrainedPolicy",
    world_size: int,
    *,
    fresh: bool,
) -> Any:
    import torch

    from vd.envs.reorient import ReorientEnv
    from vd.envs.symmetry import WorldOrder
    from vd.envs.view_tables import view_tables
    from vd.evaluate.agents import trained_task
    from vd.evaluate.student import StudentView
    from vd.train.student.dagger import Dagger
    from vd.train.student.every_view import EveryView
    from vd.train.vec_env import ReorientVecEnv

    simulation = ReorientEnv(task, cfg.run.device)
    if simulation.num_observations != teacher.num_observations:
        raise ValueError(
            f"the teacher observes {teacher.num_observations} values, its environments give "
            f"{simulation.num_observations}; take a policy of this version"
        )
    simulation.dump_dir = cfg.run.out
    env = ReorientVecEnv(simulation)
    if fresh and not cfg.dagger.reset:
        steps = env.episode_length_buf
        env.episode_length_buf = torch.randint_like(steps, high=int(env.max_episode_length))
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
    labels: Any = WorldOrder(teacher, simulation.views)
    state = student.state
    if state is not None:
        seen_in = trained_task(teacher).observation.view
        tables = (
            view_tables(simulation.hand, simulation.cfg.observation, seen_in)
            if state.views is not None
            else None
        )
        if fresh and state.adopt(teacher.network, tables):
            # What is added to the actions of another teacher's layers is of no use to these.
            student.forget_correction()
        if state.views is not None:
            labels = EveryView(teacher, state.views)
    return Dagger(env, view, student, labels, cfg.dagger, world_size=world_size)
