"""Command line of the student: ``vd-train student``."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from vd.command import interrupt
from vd.command.line import PRINT, ConfigFile, parse, say_same_as
from vd.policy.agents import check_names, find_policy
from vd.train.flags import (
    installed_teacher,
    machine_preset,
    normalise,
    saved_config,
    starting,
    value_of,
)
from vd.train.student.build import build_student, open_student
from vd.train.student.config import COMPLETE, MADE, PRESETS, Stage, StudentTrainCfg, smoke
from vd.train.teacher import is_main, run_folder, say_of_main

HELP = """Train the student: a network that acts on what a camera sees, and remembers.

Stage 0 learns where objects are, from clouds that are made; stage 1 learns to act from a teacher, in
simulation with complete clouds; stage 2 by a depth camera with its errors. Flags start from --preset and
--stage, or with --resume from the run's config.json; the network's sizes from --init. Short forms:
--objects, --num-envs and --seed stand for --task.objects and so on, --validate for --clouds.validation.
Ctrl-C saves."""

SHORT_FORMS = {name: f"task.{name}" for name in ("objects", "num-envs", "seed")} | {
    "validate": "clouds.validation"
}
"""Flags that are short for others."""


def parse_student(flags: Sequence[str]) -> StudentTrainCfg:
    """The configuration that command-line flags ask for.

    The first pass finds where to start from (``--preset`` and ``--stage``, the run's own
    configuration with ``--resume``, the student to begin from); the second reads every flag with
    those values as defaults.

    Raises:
        FileNotFoundError: ``--resume`` or ``--init`` name what is not there.
        ValueError: What they name is not of this version.
    """
    arguments, file = starting(normalise(flags, SHORT_FORMS))
    # Wrong flags and names, and --help, do not wait for torch.
    asked = _parsed([word for word in arguments if word != PRINT], PRESETS["gpu"](0), file)
    preset = value_of(arguments, "--preset") or machine_preset(value_of(arguments, "--device"))
    base = smoke(asked.stage) if "--smoke" in arguments else PRESETS[preset](asked.stage)
    if "--resume" in arguments:
        saved = saved_config(arguments, base)
        if saved is not None:
            return _parsed(arguments, saved, file)
    base = replace(base, teacher=asked.teacher or installed_teacher(base.teacher))
    init = value_of(arguments, "--init")
    if init is None and not base.smoke:
        init = _stage_before(base)
    if init is not None:
        spec = open_student(init).spec
        base = replace(base, init=Path(init), student=spec.network)
        if spec.camera is not None:
            x, y, z, qx, qy, qz, qw = spec.camera
            base = replace(base, camera=(x, y, z, qx, qy, qz, qw))
    return _parsed(arguments, base, file)


def student_command(arguments: list[str]) -> int:
    """``vd-train student``; the exit status."""
    cfg = parse_student(arguments)
    if is_main():
        words: list[object] = ["--stage", cfg.stage, "--preset", cfg.preset]
        words += ["--teacher", cfg.teacher]
        words += [] if cfg.init is None else ["--init", cfg.init]
        say_same_as("vd-train", "student", *words, "--out", cfg.run.out)
    with run_folder(cfg) as own:
        return _train(own)


def _train(cfg: StudentTrainCfg) -> int:
    """Train as ``cfg`` says; the exit status."""
    folder = cfg.run.out
    say = say_of_main()
    trainer = build_student(cfg, say=say)
    if trainer.iteration:
        say(f"resumed after iteration {trainer.iteration} of {trainer.total_iterations}")
    elif cfg.init is not None:
        say(f"begins with the weights of {cfg.init}")
    elif cfg.stage:
        say(f"begins from nothing: stage {cfg.stage - 1} was not trained; --init names a student")
    if not trainer.run_to_end():
        if not cfg.smoke:
            say(f"saved in {folder}; go on with: vd-train student --out {folder} --resume")
        return interrupt.INTERRUPTED
    if cfg.smoke:
        say("done: everything runs, and the network is of no use")
    else:
        say(f"done: {folder} is the student, tensorboard --logdir {folder} draws the curves")
    return 0


def _parsed(
    arguments: list[str], base: StudentTrainCfg, file: ConfigFile | None
) -> StudentTrainCfg:
    """Every flag, with the values of ``file`` and ``base`` for the others."""
    base = base if file is None else file.over(base)
    cfg: StudentTrainCfg = parse(
        StudentTrainCfg, arguments, default=base, prog="vd-train student", description=HELP
    )
    teacher = [] if cfg.teacher is None else [cfg.teacher]
    check_names(teacher, (*cfg.task.objects, *cfg.clouds.validation))
    return cfg


def _stage_before(base: StudentTrainCfg) -> str | None:
    """The folder of the last stage before that was trained for this teacher's hand, if any."""
    from vd.policy.bundle import read_contract, read_policy

    hand = read_policy(find_policy(str(base.teacher))).hand
    stages: tuple[Stage, ...] = (COMPLETE, MADE)
    for stage in stages[-base.stage :] if base.stage else ():
        folder = PRESETS[base.preset](stage).run.out
        try:
            contract = read_contract(find_policy(folder))
        except FileNotFoundError:
            continue
        if contract.kind == "student" and contract.task["hand"] == hand:
            return str(folder)
    return None
