"""Saving an environment in the middle of its episodes, and going on from there."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from vd.envs.cfg import CurriculumCfg
from vd.envs.curriculum import Stage, first_stage
from vd.envs.task_state import TaskState


def save_state(
    task: TaskState, arrays: Mapping[str, wp.array], stage: Stage, steps: int
) -> dict[str, Any]:
    """Everything needed to continue exactly.

    Args:
        task: The task.
        arrays: What changes from step to step, by name.
        stage: Stage of the curriculum.
        steps: Control steps since the begin of the run.
    """
    return {
        "arrays": {name: array.numpy().copy() for name, array in arrays.items()},
        "difficulty": stage.difficulty,
        "tightening": task.cfg.curriculum.tightening.enabled,
        "tightness": stage.tightness,
        "steps": steps,
        "objects": _objects(task),
    }


def saved_stage(state: dict[str, Any], cfg: CurriculumCfg) -> Stage:
    """Stage at which a run goes on from what :func:`save_state` gave.

    The tightness is that of the saved run only if it had one and this run has one too.
    """
    first = first_stage(cfg)
    known = cfg.tightening.enabled and state["tightening"]
    tightness = float(state["tightness"]) if known else first.tightness
    return Stage(float(state["difficulty"]), tightness)


def load_arrays(task: TaskState, here: Mapping[str, wp.array], state: dict[str, Any]) -> None:
    """Write the arrays of :func:`save_state` into those of an environment.

    Args:
        task: The task.
        here: What changes from step to step, by name.
        state: What was saved.

    Raises:
        ValueError: If it belongs to another number of environments, other objects, another hand or
            servo
        model.
    """
    arrays = state["arrays"]
    if arrays.keys() != here.keys():
        raise ValueError(
            "the saved environment has other servos, frames, memory or latency; resume with "
            "hand_layer, observation, randomisation.effects and observation_latency_s, "
            "encoder_latency_s of the checkpoint, or from one without environments "
            "(vd-train export --resumable)"
        )
    for name, array in here.items():
        saved = arrays[name]
        if saved.shape != array.numpy().shape:
            raise ValueError(
                f"the saved environment has {name} of shape {saved.shape}, "
                f"this one {array.numpy().shape}; "
                "resume with the num_envs and hand of the checkpoint"
            )
    if state["objects"] != _objects(task):
        raise ValueError(
            "the saved environments hold other objects; resume with objects of the checkpoint, "
            "or from one without environments (vd-train export --resumable)"
        )
    for name, array in here.items():
        array.assign(arrays[name])


def _objects(task: TaskState) -> list[tuple[str, int]]:
    """Environments of each object, in the order of the environments."""
    counts = np.bincount(task.scene.world_object, minlength=len(task.objects))
    return [(item.name, int(count)) for item, count in zip(task.objects, counts, strict=True)]
