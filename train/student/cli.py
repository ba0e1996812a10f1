"""Command line of the student: ``vd-train student``."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from vd.policy.agents import find_policy
from vd.train.stages import StagedTraining, run_stage
from vd.train.student.config import COMPLETE, MADE, PRESETS, Stage, StudentTrainCfg, smoke

if TYPE_CHECKING:
    from vd.train.student.trainer import StudentTrainer

STAGES = """Train the student: a network that acts on what a camera sees, and remembers.

Stage 0 learns where objects are, from clouds that are made; stage 1 learns to act from a teacher, in
simulation, by beliefs that are drawn, and to see complete clouds; stage 2 by a depth camera with its
errors."""


def _as_in(base: StudentTrainCfg, init: str) -> StudentTrainCfg:
    """``base`` with a student's sizes, and its camera if that looks at the same hand."""
    from vd.policy.bundle import read_policy
    from vd.train.student.build import open_student

    policy = open_student(init)
    hand = read_policy(find_policy(str(base.teacher))).hand
    camera = policy.spec.camera if policy.hand == hand else base.camera
    assert camera is None or len(camera) == 7
    return replace(base, student=policy.spec.network, camera=camera)


def _stage_before(base: StudentTrainCfg) -> str | None:
    """The folder of the last stage before that was trained for this teacher's hand, if any."""
    from vd.policy.bundle import read_contract, read_policy

    if base.smoke:
        return None
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
    stages=STAGES,
    presets=PRESETS,
    smoke=smoke,
    stage_before=_stage_before,
    as_in=_as_in,
    build=_build,
    result="policy.safetensors",
)
"""The command."""

student_command = partial(run_stage, STUDENT)
"""``vd-train student``: takes its flags, returns the exit status."""
