"""Command line of the student: ``vd-train student``."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from vd.command import interrupt
from vd.command.line import PRINT, ConfigFile, parse, say_same_as
from vd.policy.agents import DEFAULT_POLICY, check_names, find_policy, installed_policies
from vd.train.flags import machine_preset, normalise, saved_config, starting, value_of
from vd.train.student.build import build_student
from vd.train.student.config import ALIGNMENT_NAME, PRESETS, SIMULATED, StudentTrainCfg, smoke
from vd.train.teacher import is_main, run_folder, say_of_main

HELP = """Train the student: the network by which a teacher acts on what a camera sees, without a mesh.

Stage 0 learns to turn a goal's cloud onto what a camera sees, from clouds that are made; stage 1 also from
what it sees in simulation. Flags start from --preset and --stage, or with --resume from the run's
config.json; the network's sizes from --init. Short forms: --objects, --num-envs and --seed stand for
--task.objects and so on, --validate for --align.validation. Ctrl-C saves. vd-train tracker --alignment makes
a policy of what was learned."""

SHORT_FORMS = {name: f"task.{name}" for name in ("objects", "num-envs", "seed")} | {
    "validate": "align.validation"
}
"""Flags that are short for others."""


def parse_student(flags: Sequence[str]) -> StudentTrainCfg:
    """The configuration that command-line flags ask for.

    The first pass finds where to start from (``--preset`` and ``--stage``, the run's own
    configuration with ``--resume``, the network to begin from), as flags and ``--config`` say; the
    second reads every flag with those values, and over them those of the file, as defaults.

    Raises:
        FileNotFoundError: ``--resume`` or ``--init`` name what is not there.
        ValueError: What they name is not of this version, or nothing is installed to begin from.
    """
    arguments, file = starting(normalise(flags, SHORT_FORMS))
    if value_of(arguments, "--stage") == "2":
        raise ValueError("--stage 2: this student has 0 (made clouds) and 1 (what a camera sees)")
    # Wrong flags and names, and --help, do not wait for torch.
    asked = _parsed([word for word in arguments if word != PRINT], PRESETS["gpu"](0), file)
    preset = value_of(arguments, "--preset")
    if "--smoke" in arguments:
        base = smoke(asked.stage)
    else:
        base = PRESETS[preset or machine_preset(value_of(arguments, "--device"))](asked.stage)
    if "--resume" in arguments and (saved := saved_config(arguments, base)) is not None:
        return _parsed(arguments, saved, file)
    base = replace(base, teacher=asked.teacher or _teacher(base))
    init = value_of(arguments, "--init")
    if init is None and base.stage == SIMULATED:
        from vd.train.student.network import default_network

        init = default_network(_hand(str(base.teacher)), base.preset)
    return _parsed(arguments, base if init is None else _begun_from(base, init), file)


def student_command(arguments: list[str]) -> int:
    """``vd-train student``; the exit status."""
    cfg = parse_student(arguments)
    if is_main():
        words: list[object] = [
            "--stage",
            cfg.stage,
            "--preset",
            cfg.preset,
            "--teacher",
            cfg.teacher,
        ]
        words += [] if cfg.init is None else ["--init", cfg.init]
        say_same_as("vd-train", "student", *words, "--out", cfg.run.out)
    with run_folder(cfg) as own:
        return _train(own)


def _train(cfg: StudentTrainCfg) -> int:
    """Train as ``cfg`` says; the exit status."""
    folder, say = cfg.run.out, say_of_main()
    runner = build_student(cfg, say=say)
    if runner.iteration:
        say(f"resumed after iteration {runner.iteration} of {runner.total_iterations}")
    elif cfg.init is not None:
        say(f"begins with the weights of {cfg.init}")
    if not runner.run_to_end():
        if not cfg.smoke:
            say(f"saved in {folder}; go on with: vd-train student --out {folder} --resume")
        return interrupt.INTERRUPTED
    say(
        "done: everything runs, and the network is of no use"
        if cfg.smoke
        else f"done: {folder}/{ALIGNMENT_NAME} is the network, tensorboard --logdir {folder} draws "
        "the curves"
    )
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
    check_names(teacher, (*cfg.task.objects, *cfg.align.validation))
    return cfg


def _teacher(base: StudentTrainCfg) -> str:
    """The policy that acts where none is named: the preset's, if it is installed."""
    installed = base.teacher is not None and base.teacher in installed_policies()
    return str(base.teacher) if installed else DEFAULT_POLICY


def _hand(teacher: str) -> str:
    """The hand that a teacher moves."""
    from vd.policy.bundle import read_policy

    return read_policy(find_policy(teacher)).hand


def _begun_from(base: StudentTrainCfg, init: str) -> StudentTrainCfg:
    """``base`` with the network to begin from: its sizes, and its camera."""
    from vd.train.student.network import open_network

    sizes, camera = open_network(init)[1:]
    assert camera is None or len(camera) == 7
    align = replace(base.align, network=sizes)
    return replace(base, init=Path(init), align=align, camera=camera)
