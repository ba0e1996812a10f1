"""Command line of alignment: ``vd-train alignment``."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from vd.policy.agents import find_policy
from vd.train.alignment.config import ALIGNMENT_NAME, PRESETS, SIMULATED, AlignmentTrainCfg, smoke
from vd.train.stages import StagedTraining, run_stage

if TYPE_CHECKING:
    from vd.train.alignment.align import AlignTrainer

STAGES = """Train alignment: the network by which a teacher acts on what a camera sees, without a mesh.

Stage 0 learns to turn a goal's cloud onto what a camera sees, from clouds that are made; stage 1 also from
what it sees in simulation. vd-train tracker --alignment makes a policy of what was learned."""


def _stage_before(base: AlignmentTrainCfg) -> str | None:
    """The network of stage 0, or the installed one, for stage 1."""
    from vd.policy.bundle import read_policy
    from vd.train.alignment.network import default_network

    if base.stage != SIMULATED:
        return None
    teacher = read_policy(find_policy(str(base.teacher)))
    return default_network(teacher.hand, base.preset)


def _as_in(base: AlignmentTrainCfg, init: str) -> AlignmentTrainCfg:
    """``base`` with a network's sizes and camera."""
    from vd.train.alignment.network import open_network

    network, camera = open_network(init)
    assert camera is None or len(camera) == 7
    return replace(base, align=replace(base.align, network=network.cfg), camera=camera)


def _build(cfg: AlignmentTrainCfg, say: Callable[[str], object]) -> "AlignTrainer":
    """The trainer; torch and the simulator are loaded only now."""
    from vd.train.alignment.build import build_alignment

    return build_alignment(cfg, say=say)


ALIGNMENT = StagedTraining(
    name="alignment",
    stages=STAGES,
    presets=PRESETS,
    smoke=smoke,
    stage_before=_stage_before,
    as_in=_as_in,
    build=_build,
    result=ALIGNMENT_NAME,
)
"""The command."""

alignment_command = partial(run_stage, ALIGNMENT)
"""``vd-train alignment``: takes its flags, returns the exit status."""
