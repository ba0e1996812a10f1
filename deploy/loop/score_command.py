"""The command that scores a run by motion capture."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from vd.deploy.loop.goals import one_object
from vd.deploy.loop.mocap import read_mocap
from vd.deploy.loop.score import in_world, lines, score_run
from vd.hand_log import read_log


@dataclass(frozen=True)
class ScoreCfg:
    """Score a run by motion capture."""

    log: Annotated[Path, tyro.conf.Positional]
    """Folder that vd-deploy wrote."""
    mocap: Path
    """Export of the motion capture: CSV with time, x, y, z, qx, qy, qz, qw, tracked; or OptiTrack's."""
    body: str | None = None
    """Rigid body, of an export with several."""
    offset_s: float | None = None
    """Time of the motion capture at the log's beginning [s]. By default times are seconds since 1970; of a
    clock of its own the offset is found at which errors agree best with the policy's predictions."""
    up: Literal["z", "y"] = "z"
    """Axis of the motion capture that points up; OptiTrack's is y unless it is exported otherwise."""
    world: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """Turn from the motion capture's frame, made z up, to the hand's world frame, quaternion xyzw."""
    marker: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """The object's frame in that of its rigid body, quaternion xyzw: how the markers were defined on it."""
    page: Path | None = None
    """HTML page to write."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print JSON."""


def score(cfg: ScoreCfg) -> int:
    """Print the table; 1 if no trial could be scored."""
    log = read_log(cfg.log)
    symmetry = one_object(log.run["object"]["set"]).symmetry
    mocap = in_world(read_mocap(cfg.mocap, cfg.body), up=cfg.up, world=cfg.world, marker=cfg.marker)
    result = score_run(log, mocap, symmetry, offset_s=cfg.offset_s)
    if cfg.page is not None:
        from vd.deploy.loop.score_page import write_page

        write_page(cfg.page, result, symmetry)
    print(json.dumps(result.record(), indent=1) if cfg.json else "\n".join(lines(result)))
    return 0 if result.scored else 1
