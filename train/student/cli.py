"""Command line of the student: ``vd-train student``."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import tyro

from vd import interrupt
from vd.train.flags import normalise, saved_config, value_of
from vd.train.student.build import build_student
from vd.train.student.config import (
    ALIGNING,
    ALIGNMENT_NAME,
    PRESETS,
    STUDENT_NAME,
    Stage,
    StudentTrainCfg,
)
from vd.train.teacher import say_of_main

HELP = """Train the student: imitate the teacher from point clouds.

Stage 0 learns to turn a goal's cloud onto what a camera sees, stage 1 imitates on complete synthetic clouds,
stage 2 on those of a depth camera. Flags start from --preset and --stage, or with --resume from
the run's config.json; the network from --init. Short forms: --objects, --num-envs and --seed stand for
--task.objects and so on, --validate for --align.validation. Ctrl-C saves."""

SHORT_FORMS = {name: f"task.{name}" for name in ("objects", "num-envs", "seed")} | {
    "validate": "align.validation"
}
"""Flags that are short for others."""


def parse_student(flags: Sequence[str]) -> StudentTrainCfg:
    """The configuration that command-line flags ask for.

    The first pass finds where to start from (``--preset`` and ``--stage``, the run's own configuration with
    ``--resume``, the network of ``--init``), the second reads every flag with those values as defaults.

    Raises:
        FileNotFoundError: ``--resume`` or ``--init`` name what is not there.
        ValueError: What they name is not of this version.
    """
    arguments = normalise(flags, SHORT_FORMS)
    preset, stage = value_of(arguments, "--preset") or "gpu", value_of(arguments, "--stage") or "1"
    # The second pass refuses unknown names.
    number = cast(Stage, int(stage)) if stage in ("0", "1", "2") else 1
    base = PRESETS.get(preset, PRESETS["gpu"])(number)
    if "--resume" in arguments:
        base = saved_config(arguments, base) or _with_init(arguments, base)
    elif "--help" not in arguments and "-h" not in arguments:
        base = _with_init(arguments, base)
    return tyro.cli(StudentTrainCfg, args=arguments, default=base, prog="vd-train student", description=HELP)


def student_command(arguments: list[str], started: float) -> int:
    """``vd-train student``; the exit status."""
    cfg = parse_student(arguments)

    from vd.evaluate.agents import check_names

    check_names([] if cfg.teacher is None else [cfg.teacher], (*cfg.task.objects, *cfg.align.validation))
    folder, say = cfg.run.out, say_of_main()
    runner = build_student(cfg, started=started, say=say)
    if runner.iteration:
        say(f"resumed after iteration {runner.iteration} of {runner.total_iterations}")
        if runner.new_episodes:
            say(f"episodes start anew, the checkpoint does not fit the environments: {runner.new_episodes}")
    elif cfg.init is not None:
        say(f"begins with the weights of {cfg.init}")
    if not runner.run_to_end():
        say(f"saved in {folder}; go on with: vd-train student --out {folder} --resume")
        return interrupt.INTERRUPTED
    name, what = (ALIGNMENT_NAME, "network") if cfg.stage == ALIGNING else (STUDENT_NAME, "student")
    say(f"done: {folder}/{name} is the {what}, vd-train curves {folder} draws the curves")
    return 0


def _with_init(arguments: list[str], base: StudentTrainCfg) -> StudentTrainCfg:
    """``base`` with the student to begin from, its network, and for stage 2 its camera.

    A pre-trained one has an encoder to give, whatever else it needed to be trained.
    """
    given = value_of(arguments, "--init")
    if given is None:
        return base
    path = Path(given)
    from vd.vision.saved import read_student, saved_spec

    spec = saved_spec(read_student(path), path)
    camera = None if spec.camera is None or base.stage != 2 else spec.camera
    assert camera is None or len(camera) == 7
    network = spec.network
    if spec.stage == ALIGNING:
        network = replace(base.network, encoder=network.encoder, voxel_m=network.voxel_m)
    return replace(
        base, init=path, network=network, camera=camera, teacher=base.teacher or spec.teacher or None
    )
