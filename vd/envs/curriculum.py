"""How hard the task is while a policy learns it: levels that rise one after the other."""

from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from vd.envs.cfg import LevelCfg, ReorientCfg


@dataclass(frozen=True)
class Levels:
    """How far a run has come, each in [0, 1]; all ones is the task as configured.

    In the order in which they rise, see :class:`vd.envs.cfg.CurriculumCfg`.
    """

    goals: float = 1.0
    stillness: float = 1.0
    physics: float = 1.0
    air: float = 1.0


LEVELS = tuple(field.name for field in fields(Levels))
"""Names of the levels in the order in which they rise."""


def moving_levels(cfg: ReorientCfg) -> dict[str, LevelCfg]:
    """The levels that a task moves, in their order; others are 1: they change nothing in it."""
    table = cfg.table
    changes = {
        "goals": True,
        "stillness": True,
        "physics": cfg.randomisation.enabled,
        "air": table.away_share > 0.0 or table.lift_share > 0.0,
    }
    moving = {}
    for name in LEVELS:
        level: LevelCfg = getattr(cfg.curriculum, name)
        if changes[name] and level.rate > 0.0:
            moving[name] = level
    return moving


def next_levels(levels: Levels, success_rate: float, moving: dict[str, LevelCfg]) -> Levels:
    """The levels after an update: at most one of them moves.

    Args:
        levels: Now.
        success_rate: Goals reached among those ended since the last update, in [0, 1].
        moving: Those that move, see :func:`moving_levels`.
    """
    values = asdict(levels)
    for name, level in moving.items():
        if values[name] < 1.0:
            if success_rate > level.raise_at:
                return replace(levels, **{name: min(1.0, values[name] + level.rate)})
            break
    for name, level in reversed(moving.items()):
        if values[name] > 0.0:
            if success_rate < level.lower_at:
                return replace(levels, **{name: max(0.0, values[name] - level.rate)})
            break
    return levels


def blend(loose: Any, tight: Any, level: float) -> Any:
    """From ``loose`` to ``tight``, geometrically: each step of the level is the same factor."""
    return loose ** (1.0 - level) * tight**level
