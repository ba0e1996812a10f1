"""Saving an environment in the middle of its episodes, and going on from there."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from vd.envs.cfg import CurriculumCfg
from vd.envs.curriculum import Stage, first_stage
from vd.sim.replay import save_dump

if TYPE_CHECKING:
    from vd.envs.reorient import ReorientEnv


def save_state(env: "ReorientEnv") -> dict[str, Any]:
    """Everything needed to continue exactly: simulation, episodes, randomisation, curriculum, RNG."""
    arrays = {name: array.numpy().copy() for name, array in _arrays(env).items()}
    return {
        "arrays": arrays,
        "difficulty": env.stage.difficulty,
        "tightening": env.cfg.curriculum.tightening.enabled,
        "tightness": env.stage.tightness,
        "steps": env.steps,
        "objects": _objects(env),
    }


def saved_stage(state: dict[str, Any], cfg: CurriculumCfg) -> Stage:
    """Stage at which a run goes on from what :func:`save_state` gave.

    The tightness is that of the saved run only if it had one and this run has one too.
    """
    first = first_stage(cfg)
    known = cfg.tightening.enabled and state.get("tightening", False)
    tightness = float(state["tightness"]) if known else first.tightness
    return Stage(float(state["difficulty"]), tightness)


def load_state(env: "ReorientEnv", state: dict[str, Any]) -> None:
    """Continue from :func:`save_state`.

    Raises:
        ValueError: If it belongs to another number of worlds, other objects, another hand or servo model.
    """
    here = _arrays(env)
    # Checkpoints from before goals had an age: no goal is older than its episode.
    arrays = {"goal_steps": state["arrays"]["step_count"]} | state["arrays"]
    if arrays.keys() != here.keys():
        raise ValueError(
            "the saved environment has other servos, views, memory, latency or contacts; resume with "
            "hand_layer, observation, randomisation.effects, randomisation.restitution and "
            "randomisation.observation_latency_s of the checkpoint, or from one without worlds "
            "(vd-train export --resumable)"
        )
    for name, array in here.items():
        saved = arrays[name]
        if saved.shape != array.numpy().shape:
            raise ValueError(
                f"the saved environment has {name} of shape {saved.shape}, "
                f"this one {array.numpy().shape}; "
                "resume with the num_worlds and hand of the checkpoint"
            )
    if state.get("objects", _objects(env)) != _objects(env):
        raise ValueError(
            "the worlds of the saved environment hold other objects; resume with objects of the checkpoint, "
            "or from one without worlds (vd-train export --resumable)"
        )
    for name, array in here.items():
        array.assign(arrays[name])
    env.steps = int(state["steps"])
    env.set_stage(saved_stage(state, env.cfg.curriculum))
    env.randomiser.push()
    env.sim.forward_kinematics()


def save_failed_step(env: "ReorientEnv") -> Path | None:
    """Save the first control step that failed for ``vd-bench replay``; returns its file, None if none did."""
    dumps = env.sim.dumps()
    if not dumps:
        return None
    cfg, dump = env.cfg, dumps[0]
    return save_dump(
        env.dump_dir / f"dump_{dump.object_name}_{dump.world}.json",
        dump,
        hand=cfg.hand,
        fingertip=cfg.fingertip,
        hand_layer=cfg.hand_layer,
        objects=cfg.objects,
        sim=cfg.sim,
    )


def _objects(env: "ReorientEnv") -> list[tuple[str, int]]:
    """Worlds of each object, in the order of the worlds."""
    counts = np.bincount(env.world_object, minlength=len(env.objects))
    return [(item.name, int(count)) for item, count in zip(env.objects, counts, strict=True)]


def motion_arrays(env: "ReorientEnv") -> dict[str, wp.array]:
    """What the motion of every world goes on from, the last targets included: arrays with a row for each."""
    sim = env.sim
    return {
        "joint_q": sim.joint_q,
        "joint_qd": sim.joint_qd,
        "target": sim.target,
        "warm_start": sim.solver.mjw_data.qacc_warmstart,
        **({} if sim.servo is None else sim.servo.stateful()),
    }


def _arrays(env: "ReorientEnv") -> dict[str, wp.array]:
    sim = env.sim
    return {
        **motion_arrays(env),
        "smoothed": env.smoothed,
        "goal_quat": env.goal_quat,
        "step_count": env.step_count,
        "goal_steps": env.goal_steps,
        "goals_reached": env.goals_reached,
        "previous_error": env.previous_error,
        "goal_counts": env.goal_counts,
        "observation": env.observer.all_values,
        "rng": env.rng,
        **env.observer.stateful(),
        **env.randomiser.stateful(),
        **({} if sim.restitution is None else sim.restitution.stateful()),
    }
