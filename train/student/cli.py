"""Command line of the student: ``vd-train student``."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from vd.policy.agents import find_policy
from vd.train.stages import StagedTraining, run_stage
from vd.train.student.config import COMPLETE, MADE, PRESETS, Stage, StudentTrainCfg, smoke

if TYPE_CHECKING:
    from vd.train.student.trainer import StudentTrainer

HELP = """Train the student: a network that acts on what a camera sees, and remembers.

Stage 0 learns where objects are, from clouds that are made; stage 1 learns to act from a teacher, in
simulation with complete clouds; stage 2 by a depth camera with its errors. Flags start from --preset and
--stage, or with --resume from the run's config.json; the network's sizes from --init. Short forms:
--objects, --num-envs and --seed stand for --task.objects and so on, --validate for --task.validation.
Ctrl-C saves."""


def begin_from(base: StudentTrainCfg, init: str | None) -> StudentTrainCfg:
    """``base`` with the student to begin from: its sizes, and its camera."""
    if init is None and not base.smoke:
        init = _stage_before(base)
    if init is None:
        return base
    from vd.train.student.build import open_student

    spec = open_student(init).spec
    camera = base.camera if spec.camera is None else spec.camera
    assert camera is None or len(camera) == 7
    return replace(base, init=Path(init), student=spec.network, camera=camera)


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


def _build(cfg: StudentTrainCfg, say: Callable[[str], object]) -> "StudentTrainer":
    """The trainer; torch and the simulator are loaded only now."""
    from vd.train.student.build import build_student

    return build_student(cfg, say=say)


STUDENT = StagedTraining(
    name="student",
    help=HELP,
    presets=PRESETS,
    smoke=smoke,
    begin_from=begin_from,
    build=_build,
    result="policy.safetensors",
)
"""The command."""

student_command = partial(run_stage, STUDENT)
"""``vd-train student``: takes its flags, returns the exit status."""
