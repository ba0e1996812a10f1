"""Saving an environment in the middle of its episodes, and going on from there."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import warp as wp

from vd.envs.cfg import LevelCfg
from vd.envs.curriculum import Levels
from vd.envs.task_state import TaskState


def save_state(
    task: TaskState, arrays: Mapping[str, wp.array], levels: Levels, steps: int
) -> dict[str, Any]:
    """Everything needed to continue exactly.

    Args:
        task: The task.
        arrays: What changes from step to step, by name.
        levels: How far the curriculum has come.
        steps: Control steps since the begin of the run.
    """
    return {
        "arrays": {name: array.numpy().copy() for name, array in arrays.items()},
        "levels": asdict(levels),
        "steps": steps,
        "objects": _objects(task),
    }


def saved_levels(state: dict[str, Any], moving: Mapping[str, LevelCfg]) -> Levels:
    """Levels at which a run goes on from what :func:`save_state` gave.

    Those that it does not move are 1, as are those that the saved run did not have.
    """
    saved = state.get("levels", {})
    return Levels(**{name: float(saved.get(name, 1.0)) for name in moving})


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
                f"the saved environment has {name} of shape {saved.shape}, this one "
                f"{array.numpy().shape}; resume with the num_envs and hand of the checkpoint"
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
