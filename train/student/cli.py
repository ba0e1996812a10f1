"""Command lines of the student: ``vd-train student`` and ``vd-train calibrate``."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, cast

import tyro

from vd import interrupt
from vd.device import resolve_device
from vd.files import check_file
from vd.paper import PAPER
from vd.train.student.build import build_student, default_init
from vd.train.student.config import PRESETS, PRETRAINING, Stage, StudentTrainCfg

HELP = """Train the student: imitate the teacher from point clouds.

Stage 0 pre-trains the encoder on random scenes, stage 1 imitates on complete synthetic clouds, stage 2 on
those of a depth camera. Flags start from --preset and --stage, or with --resume from the run's config.json;
the network from --init. Short forms: --objects, --num-worlds and --seed stand for --task.objects and so on.
Ctrl-C saves."""

SHORT_FORMS = ("objects", "num-worlds", "seed")
"""Fields of the task that are flags without the ``--task.`` prefix too."""


@dataclass
class CalibrateCfg:
    """Choose when a student stops, on episodes with validation objects, and store it in its file."""

    student: Annotated[Path, tyro.conf.Positional]
    """student.pt of vd-train student."""
    objects: tuple[str, ...] = ()
    """Object sets to calibrate on, not those of the training; the training's by default."""
    episodes: int = 256
    """Episodes, all side by side; rounded up to as many of each object."""
    tolerance_rad: float = PAPER.success.rotation_rad
    """Largest true distance that counts as right [rad]; a rule for 0.1 rad is always chosen too."""
    episode_s: float | None = None
    """Length of an episode [s]; that of the paper's tests by default: 10, with --in-air 15."""
    randomise: bool = False
    """Domain randomisation and disturbances."""
    in_air: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Take the table away, as vd-eval --in-air does: the rule of a student that is to hold its object."""
    aim: Literal["kept", "on", "off"] = "kept"
    """Whether it aims past the goal while the object is near it, from now on: more stops within 0.1 rad."""
    second_view: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Look again at goals that are not reached in 3 s, as vd-eval --second-view does: the rule of a student
    that is to fly so."""
    seed: int = 1000
    """Of starts, goals and sensor errors."""
    device: str = "auto"
    """cpu, cuda:0, ... or auto."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the outcome as JSON."""


@dataclass
class FollowCfg:
    """Give a student the layers of its teacher as it is now, without training.

    For a teacher that has gone on with training (vd-train teacher --init). Calibrate the student afterwards.
    """

    student: Annotated[str, tyro.conf.Positional]
    """student.pt, a run's folder, or the name of an installed student; it stays as it is."""
    teacher: Annotated[str, tyro.conf.Positional]
    """The teacher: a policy.pt, a run's folder, or the name of an installed one."""
    output: Annotated[Path, tyro.conf.Positional] = Path("student.pt")
    """File to write."""


def parse_student(arguments: Sequence[str]) -> StudentTrainCfg:
    """The configuration that command-line flags ask for.

    The first pass finds where to start from (``--preset`` and ``--stage``, the run's own configuration with
    ``--resume``, the network of ``--init``), the second reads every flag with those values as defaults.

    Raises:
        FileNotFoundError: ``--resume`` or ``--init`` name what is not there.
        ValueError: What they name is not of this version.
    """
    from vd.train.flags import normalise, saved_config, value_of

    arguments = normalise(arguments, SHORT_FORMS, "task")
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

    check_names([] if cfg.teacher is None else [cfg.teacher], cfg.task.objects)
    from vd.train.cli import print_damaged
    from vd.train.ending import finished
    from vd.train.progress import waiting

    main_process = os.environ.get("RANK", "0") == "0"
    with waiting("building the worlds (the first start compiles the kernels: a minute or two)", main_process):
        runner = build_student(cfg, started=started)
    folder = cfg.run.run_dir
    if main_process:
        print_damaged(runner.damaged)
    if main_process and runner.iteration:
        print(f"resumed after iteration {runner.iteration} of {runner.total_iterations}")
        if runner.new_episodes:
            print(f"episodes start anew, since the checkpoint does not fit the worlds: {runner.new_episodes}")
    elif main_process and cfg.init is not None:
        print(f"begins with the weights of {cfg.init}")
    whole = finished(runner.learn, runner.learner.close, distributed=runner.is_distributed)
    runner.shutdown()
    if not whole:
        if main_process:
            print(f"saved in {folder}; go on with: vd-train student --run-dir {folder} --resume")
        return interrupt.INTERRUPTED
    if main_process:
        print(f"done: {folder}/student.pt is the student, vd-train curves {folder} draws the curves")
    return 0


def calibrate_command(arguments: list[str], _started: float) -> int:
    """``vd-train calibrate``; the exit status."""
    cfg = tyro.cli(CalibrateCfg, args=arguments, prog="vd-train calibrate")
    check_file(cfg.student)

    from vd.config import to_dict
    from vd.train.progress import waiting
    from vd.train.student.calibrate import calibrate_student

    with waiting("running the episodes", not cfg.json):
        found, precise = calibrate_student(
            cfg.student,
            objects=cfg.objects,
            episodes=cfg.episodes,
            tolerance_rad=cfg.tolerance_rad,
            episode_s=cfg.episode_s,
            randomise=cfg.randomise,
            in_air=cfg.in_air,
            aim=None if cfg.aim == "kept" else cfg.aim == "on",
            second_view=cfg.second_view,
            seed=cfg.seed,
            device=resolve_device(cfg.device),
        )
    if cfg.json:
        print(json.dumps(to_dict(found) | {"precise": precise and to_dict(precise)}, indent=1))
        return 0
    for result in (found, precise):
        if result is None:
            print(f"{cfg.student}: no rule stops any within {PAPER.success.precise_rad:g} rad: none for it")
            continue
        rule = result.rule
        print(
            f"{cfg.student}: stop below {rule.distance_rad:.3f} rad predicted and an action norm of "
            f"{rule.action_norm:.3f}. Of {result.episodes} episodes {result.success:.1%} stop within "
            f"{result.tolerance_rad:g} rad, {result.wrong:.1%} outside; {result.reachable:.1%} came that near"
        )
    return 0


def follow_command(arguments: list[str], _started: float) -> int:
    """``vd-train follow``; the exit status."""
    cfg = tyro.cli(FollowCfg, args=arguments, prog="vd-train follow")
    check_file(cfg.output)

    from vd.train.student.follow import follow_teacher

    other = follow_teacher(cfg.student, cfg.teacher, cfg.output)
    print(
        f"{cfg.output}: {cfg.student} with the layers of {cfg.teacher}"
        + ("" if other else ", which are those it had")
        + f"; next, choose when it stops: vd-train calibrate {cfg.output}"
    )
    return 0


def _with_init(arguments: list[str], base: StudentTrainCfg) -> StudentTrainCfg:
    """``base`` with the student to begin from, its network, and for stage 2 its camera.

    A pre-trained one has an encoder to give, whatever else it needed to be trained.
    """
    from vd.train.flags import value_of

    given, run_dir = value_of(arguments, "--init"), value_of(arguments, "--run-dir")
    if given is None and "--from-scratch" in arguments:
        return base
    path = Path(given) if given else default_init(base.stage, Path(run_dir) if run_dir else base.run.run_dir)
    if path is None:
        return base
    from vd.student.saved import read_student, saved_spec

    spec = saved_spec(read_student(path), path)
    camera = None if spec.camera is None or base.stage != 2 else spec.camera
    assert camera is None or len(camera) == 7
    network = spec.network
    if spec.stage == PRETRAINING:
        sees = {name: getattr(network, name) for name in ("encoder", "voxel_m", "goal")}
        network = replace(base.network, **sees)
    return replace(
        base, init=path, network=network, camera=camera, teacher=base.teacher or spec.teacher or None
    )
