"""Command line of the student: ``vd-train student``."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

from vd import interrupt
from vd.command_line import parse
from vd.train.flags import normalise, saved_config, starting, value_of
from vd.train.student.build import build_student
from vd.train.student.config import ALIGNMENT_NAME, PRESETS, Stage, StudentTrainCfg
from vd.train.teacher import say_of_main

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
    configuration with ``--resume``, the network of ``--init``), as flags and ``--config`` say; the
    second reads every flag with those values, and over them those of the file, as defaults.

    Raises:
        FileNotFoundError: ``--resume`` or ``--init`` name what is not there.
        ValueError: What they name is not of this version.
    """
    arguments, file = starting(normalise(flags, SHORT_FORMS))
    preset, stage = value_of(arguments, "--preset") or "gpu", value_of(arguments, "--stage") or "0"
    # The second pass refuses unknown names.
    number = cast(Stage, int(stage)) if stage in ("0", "1") else 0
    base = PRESETS.get(preset, PRESETS["gpu"])(number)
    if "--resume" in arguments:
        base = saved_config(arguments, base) or _with_init(arguments, base)
    elif "--help" not in arguments and "-h" not in arguments:
        base = _with_init(arguments, base)
    base = base if file is None else file.over(base)
    cfg: StudentTrainCfg = parse(
        StudentTrainCfg, arguments, default=base, prog="vd-train student", description=HELP
    )
    return cfg


def student_command(arguments: list[str], started: float) -> int:
    """``vd-train student``; the exit status."""
    cfg = parse_student(arguments)

    from vd.evaluate.agents import check_names

    check_names(
        [] if cfg.teacher is None else [cfg.teacher], (*cfg.task.objects, *cfg.align.validation)
    )
    folder, say = cfg.run.out, say_of_main()
    runner = build_student(cfg, started=started, say=say)
    if runner.iteration:
        say(f"resumed after iteration {runner.iteration} of {runner.total_iterations}")
    elif cfg.init is not None:
        say(f"begins with the weights of {cfg.init}")
    if not runner.run_to_end():
        say(f"saved in {folder}; go on with: vd-train student --out {folder} --resume")
        return interrupt.INTERRUPTED
    say(
        f"done: {folder}/{ALIGNMENT_NAME} is the network, tensorboard --logdir {folder} draws the "
        f"curves"
    )
    return 0


def _with_init(arguments: list[str], base: StudentTrainCfg) -> StudentTrainCfg:
    """``base`` with the network to begin from: its sizes, and its camera."""
    given = value_of(arguments, "--init")
    if given is None:
        return base
    from vd.vision.saved import load_alignment

    spec = load_alignment(given)[1]
    assert spec.camera is None or len(spec.camera) == 7
    align = replace(base.align, network=spec.network, points=spec.points)
    return replace(base, init=Path(given), align=align, camera=spec.camera)
