"""How hard the task is while a policy learns it.

Nearer goals first, then success thresholds that tighten.
"""

from dataclasses import dataclass

from vd.envs.cfg import CurriculumCfg


@dataclass(frozen=True)
class Stage:
    """How far a run has come; all ones is the task as configured."""

    difficulty: float = 1.0
    """Of goals and stillness (:class:`vd.envs.cfg.CurriculumCfg`), in [0, 1]."""
    tightness: float = 1.0
    """Of stillness, once the difficulty is 1 (:class:`vd.envs.cfg.TighteningCfg`), in [0, 1]."""


def first_stage(cfg: CurriculumCfg) -> Stage:
    """Where a run begins."""
    return Stage(
        difficulty=0.0 if cfg.enabled else 1.0, tightness=0.0 if cfg.tightening.enabled else 1.0
    )


def next_stage(stage: Stage, success_rate: float, cfg: CurriculumCfg) -> Stage:
    """The stage after an update of the curriculum.

    Only one of the two moves: the tightness where the difficulty is 1, else the difficulty. So
    goals come nearer again only where stillness is as loose as it gets.

    Args:
        stage: Now.
        success_rate: Goals reached among those ended since the last update, in [0, 1].
        cfg: How fast to move, and at which rates.
    """
    tightening = cfg.tightening
    if tightening.enabled and stage.difficulty == 1.0:
        step = _step(success_rate, tightening.raise_at, tightening.lower_at, tightening.rate)
        tightness = _within_one(stage.tightness + step)
        if tightness != stage.tightness:
            return Stage(stage.difficulty, tightness)
    if cfg.enabled and (stage.tightness == 0.0 or not tightening.enabled):
        step = _step(success_rate, cfg.raise_at, cfg.lower_at, cfg.rate)
        return Stage(_within_one(stage.difficulty + step), stage.tightness)
    return stage


def blend(loose: float, tight: float, tightness: float) -> float:
    """From ``loose`` to ``tight``, geometrically: each step of the tightness is the same factor."""
    return loose ** (1.0 - tightness) * tight**tightness


def _step(success_rate: float, raise_at: float, lower_at: float, rate: float) -> float:
    return rate if success_rate > raise_at else -rate if success_rate < lower_at else 0.0


def _within_one(value: float) -> float:
    return min(1.0, max(0.0, value))
