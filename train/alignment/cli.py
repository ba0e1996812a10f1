"""Command line of alignment: ``vd-train alignment``."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from vd.policy.agents import find_policy
from vd.train.alignment.config import ALIGNMENT_NAME, PRESETS, SIMULATED, AlignmentTrainCfg, smoke
from vd.train.stages import StagedTraining, run_stage

if TYPE_CHECKING:
    from vd.train.alignment.align import AlignTrainer

HELP = """Train alignment: the network by which a teacher acts on what a camera sees, without a mesh.

Stage 0 learns to turn a goal's cloud onto what a camera sees, from clouds that are made; stage 1 also from
what it sees in simulation. Flags start from --preset and --stage, or with --resume from the run's
config.json; the network's sizes from --init. Short forms: --objects, --num-envs and --seed stand for
--task.objects and so on, --validate for --task.validation. Ctrl-C saves. vd-train tracker --alignment makes
a policy of what was learned."""


def begin_from(base: AlignmentTrainCfg, init: str | None) -> AlignmentTrainCfg:
    """``base`` with the network to begin from: its sizes, and its camera."""
    from vd.policy.bundle import read_policy
    from vd.train.alignment.network import default_network, open_network

    if init is None:
        if base.stage != SIMULATED:
            return base
        teacher = read_policy(find_policy(str(base.teacher)))
        init = default_network(teacher.hand, base.preset)
    network, camera = open_network(init)
    assert camera is None or len(camera) == 7
    align = replace(base.align, network=network.cfg)
    return replace(base, init=Path(init), align=align, camera=camera)


def _build(cfg: AlignmentTrainCfg, say: Callable[[str], object]) -> "AlignTrainer":
    """The trainer; torch and the simulator are loaded only now."""
    from vd.train.alignment.build import build_alignment

    return build_alignment(cfg, say=say)


ALIGNMENT = StagedTraining(
    name="alignment",
    help=HELP,
    presets=PRESETS,
    smoke=smoke,
    begin_from=begin_from,
    build=_build,
    result=ALIGNMENT_NAME,
)
"""The command."""

alignment_command = partial(run_stage, ALIGNMENT)
"""``vd-train alignment``: takes its flags, returns the exit status."""
