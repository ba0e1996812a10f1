"""Which columns of an observation hold what, and which of them the actor reads."""

from vd.envs.cfg import ObservationCfg
from vd.kernels.columns import consecutive
from vd.kernels.task.dynamics import dynamics_size
from vd.kernels.task.observations import teacher_observation_size, teacher_observation_slices
from vd.kernels.task.shapes import shape_observation_size, shape_observation_slices


def observation_parts(cfg: ObservationCfg, fingers: int, joints: int) -> dict[str, slice]:
    """Columns of the parts of an observation, in order, those included that only the critic reads.

    history, state, shape, terms (own values), dynamics, present (state and shape without latency
    and noise), critic_terms; parts that are off are missing.
    """
    told = cfg.dynamics != "none"
    state = teacher_observation_size(fingers, joints)
    shape = shape_observation_size(fingers) if cfg.shape != "none" else 0
    sizes = {
        "history": 2 * joints * cfg.history,
        "state": state,
        "shape": shape,
        "terms": sum(cfg.terms.values()),
        "dynamics": dynamics_size(joints) if told else 0,
        "present": state + shape if told else 0,
        # Last, where a critic that goes on is widened.
        "critic_terms": sum(cfg.critic_terms.values()),
    }
    return consecutive({name: size for name, size in sizes.items() if size})


def observation_columns(cfg: ObservationCfg, fingers: int, joints: int) -> dict[str, slice]:
    """The same by single quantities: those of state and shape by their names, own terms by theirs.

    Names of what only the critic reads begin with ``critic/``.
    """
    columns: dict[str, slice] = {}
    parts = observation_parts(cfg, fingers, joints)
    inside = {
        "state": teacher_observation_slices(fingers, joints),
        "shape": shape_observation_slices(fingers),
        "terms": consecutive(dict(cfg.terms)),
        "critic_terms": consecutive(dict(cfg.critic_terms)),
    }
    for part, where in parts.items():
        for name, within in inside.get(part, {part: slice(0, where.stop - where.start)}).items():
            told = "critic/" if where.start >= actor_size(parts) else ""
            columns[told + name] = slice(where.start + within.start, where.start + within.stop)
    return columns


CRITIC_ALONE = ("dynamics", "present", "critic_terms")
"""Parts that the actor does not read, the last of all. With a history it reads nothing else."""


def actor_size(parts: dict[str, slice]) -> int:
    """Values that the actor reads, the first of all."""
    if "history" in parts:
        return parts["history"].stop
    return max(columns.stop for name, columns in parts.items() if name not in CRITIC_ALONE)
