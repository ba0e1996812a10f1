"""What ``vd-train student`` and ``alignment`` share: command line, task, how a run begins."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from vd.command.device import resolve_device
from vd.command.files import check_folder
from vd.command.line import PRINT, ConfigFile, flags_of, parse, say_same_as
from vd.command.warp_quiet import quiet_warp
from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.paper import PAPER
from vd.policy.agents import check_names
from vd.train.config import StageTaskCfg
from vd.train.flags import (
    installed_teacher,
    is_on,
    machine_preset,
    normalise,
    saved_config,
    starting,
    value_of,
    write_config,
)
from vd.train.teacher import BUILDING, is_main, run_folder, say_of_main, train_to_end

if TYPE_CHECKING:
    from vd.policy.actor import TrainedPolicy
    from vd.train.alignment.config import AlignmentTrainCfg
    from vd.train.student.config import StudentTrainCfg
    from vd.train.supervised import SupervisedLoop

Cfg = TypeVar("Cfg", "AlignmentTrainCfg", "StudentTrainCfg")
Network = TypeVar("Network")
Trainer = TypeVar("Trainer", bound="SupervisedLoop")

HELP = """Flags start from --preset and --stage, or with --resume from the run's config.json; the network's
sizes from --init. Short forms: --objects, --num-envs and --seed stand for --task.objects and so on,
--validate for --task.validation. Ctrl-C saves."""
"""What ``--help`` says of each."""

SHORT_FORMS = {
    "objects": "task.objects",
    "num-envs": "task.num-envs",
    "seed": "task.seed",
    "validate": "task.validation",
}
"""Flags that are short for others."""


@dataclass(frozen=True)
class StagedTraining(Generic[Cfg]):
    """A command of ``vd-train`` that trains in stages."""

    name: str
    """Its name."""
    stages: str
    """What ``--help`` says first."""
    presets: Mapping[str, Callable[[Any], Cfg]]
    """Settings of a stage, by the name of the preset."""
    smoke: Callable[[Any], Cfg]
    """Settings of a stage's smoke test."""
    stage_before: Callable[[Cfg], str | None]
    """What such settings begin from where ``--init`` names nothing; None: from nothing."""
    as_in: Callable[[Cfg, str], Cfg]
    """Settings with the sizes and the camera of the network that is named."""
    build: Callable[[Cfg, Callable[[str], object]], "SupervisedLoop"]
    """From settings to a trainer."""
    result: str
    """File in the run's folder that holds what was learned."""


def parse_stage(
    training: StagedTraining[Cfg],
    flags: Sequence[str],
    *,
    say: Callable[..., object] | None = None,
) -> Cfg:
    """The configuration that command-line flags ask for.

    ``say`` (:func:`vd.command.line.say_same_as`) is told it.

    The first pass finds where to start from (``--preset`` and ``--stage``, the run's own
    configuration with ``--resume``, the network to begin from), as flags and ``--config`` say; the
    second reads every flag with those values, and over them those of the file, as defaults.

    Raises:
        FileNotFoundError: ``--resume`` or ``--init`` name what is not there.
        ValueError: What they name is not of this version, or nothing is installed to begin from.
    """
    arguments, file = starting(normalise(flags, SHORT_FORMS))
    # Wrong flags and names, and --help, do not wait for torch.
    words = [word for word in arguments if word != PRINT]
    asked = _parsed(training, words, training.presets["gpu"](0), file)
    preset = value_of(arguments, "--preset") or machine_preset(value_of(arguments, "--device"))
    start = training.smoke if is_on(arguments, "smoke") else training.presets[preset]
    base = start(asked.stage)
    saved = saved_config(arguments, base) if value_of(arguments, "--resume") else None
    if saved is None:
        base = replace(base, teacher=asked.teacher or installed_teacher(base.teacher))
        if init := value_of(arguments, "--init") or training.stage_before(base):
            quiet_warp()  # a student that is opened starts it
            base = replace(training.as_in(base, init), init=Path(init))
    else:
        base = saved
    cfg = _parsed(training, arguments, base, file)
    if say is not None:
        over = replace(base, init=None, smoke=False)
        said = flags_of(cfg, "run", always=("preset", "stage", "teacher"), over=over)
        said += flags_of(cfg.run, always=("out",), over=base.run)
        say("vd-train", training.name, *said)
    return cfg


def _parsed(
    training: StagedTraining[Cfg], arguments: list[str], base: Cfg, file: ConfigFile | None
) -> Cfg:
    """Every flag, with the values of ``file`` and ``base`` for the others."""
    base = base if file is None else file.over(base)
    prog = f"vd-train {training.name}"
    cfg: Cfg = parse(
        type(base), arguments, default=base, prog=prog, description=f"{training.stages} {HELP}"
    )
    teacher = [] if cfg.teacher is None else [cfg.teacher]
    check_names(teacher, (*cfg.task.objects, *cfg.task.validation))
    return cfg


def run_stage(training: StagedTraining[Cfg], arguments: list[str]) -> int:
    """The command; its exit status."""
    cfg = parse_stage(training, arguments, say=say_same_as if is_main() else None)
    with run_folder(cfg) as own:
        return train_stage(own, training)


def train_stage(cfg: Cfg, training: StagedTraining[Cfg]) -> int:
    """Train as ``cfg`` says; the exit status."""
    say = say_of_main()
    cfg.validate()
    trainer = training.build(cfg, say)
    if trainer.iteration:
        say(f"resumed after iteration {trainer.iteration} of {trainer.total_iterations}")
    elif cfg.init is not None:
        say(f"begins from {cfg.init}")
    elif cfg.stage:
        say(f"begins from nothing: stage {cfg.stage - 1} was not trained; --init names a network")
    return train_to_end(cfg, trainer, training.name, training.result, say)


def task_of_teacher(
    teacher: "TrainedPolicy", chosen: StageTaskCfg, condition: RandomisationCfg | None = None
) -> ReorientCfg:
    """The environments of a teacher's training, randomised so or as ``condition`` says.

    Raises:
        ValueError: No objects are named, and those of its training are not here.
    """
    from vd.assets_usd.objects.sets import check_sets
    from vd.policy.agents import task_for

    trained = ReorientCfg.of(teacher)
    if not chosen.objects:
        try:
            check_sets(trained.objects)
        except ValueError as error:
            message = f"the teacher's own objects are not here; name --objects\n{error}"
            raise ValueError(message) from error
    return task_for(
        teacher,
        objects=chosen.objects or trained.objects,
        num_envs=chosen.num_envs,
        seed=chosen.seed,
        stop_tolerance_rad=PAPER.success.rotation_rad,
        episode_s=trained.episode_s,
        randomised=trained.randomisation.enabled,
        condition=condition,
        success_ends_episode=False,
    )


def build_stage(
    cfg: Cfg,
    kind: str,
    *,
    network_of: Callable[[Cfg, "TrainedPolicy", str], Network],
    trainer_of: Callable[[Cfg, "TrainedPolicy", Network, str], Trainer],
    say: Callable[[str], object],
) -> Trainer:
    """Build a trainer as ``cfg`` says, save the configuration, and resume if asked.

    Args:
        cfg: Configuration.
        kind: Of its network, in checkpoints.
        network_of: Makes the network of settings and teacher on a device; it begins from ``init``
            if there is one, of which a run that goes on has none.
        trainer_of: Makes the trainer of settings, teacher, network and device.
        say: Is told when the slow part begins.

    Raises:
        FileExistsError: The run folder holds another run and ``resume`` is not set.
        FileNotFoundError: There is no such teacher, network or checkpoint.
        ValueError: The settings do not fit each other, or the network to begin from.
    """
    from vd.train.checkpoint import find_checkpoint

    check_folder(cfg.run.out)
    device = resolve_device(cfg.run.device)
    checkpoint = find_checkpoint(cfg.run.out, cfg.resume, kind)
    if cfg.teacher is None:
        raise ValueError(
            "--teacher is missing; give a policy.safetensors, a run's folder or a name"
        )
    say(BUILDING)

    import torch

    quiet_warp()  # a line for each of some hundred kernels would scroll the progress away
    from vd.command.workers import one_thread_without_gpu
    from vd.evaluate.spin import spins
    from vd.policy.agents import open_teacher

    teacher = open_teacher(cfg.teacher, device)
    if teacher is None:
        raise ValueError(f"--teacher {cfg.teacher} has no layers; give a trained teacher")
    if spins(teacher):
        raise ValueError(f"--teacher {cfg.teacher} has no goals; give one that reaches them")
    one_thread_without_gpu(device)
    torch.set_float32_matmul_precision("high")
    # The network is the same in all processes, what they draw is not.
    torch.manual_seed(cfg.task.seed)
    begun = cfg if checkpoint is None else replace(cfg, init=None)
    network = network_of(begun, teacher, device)
    own_seed = cfg.task.seed + int(os.environ.get("RANK", "0"))
    torch.manual_seed(own_seed)
    own = replace(cfg, task=replace(cfg.task, seed=own_seed))
    trainer = trainer_of(own, teacher, network, device)
    if checkpoint is not None:
        trainer.load(checkpoint)
    if is_main():
        # After all that can refuse: settings that a run cannot have must not take the place of its
        # own.
        write_config(cfg)
    return trainer
