"""Save the step in which a simulation went bad, and replay it on its own.

A dump is one JSON file: the task's configuration, the object, the state before the bad control step
and the joint targets in it.
"""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vd.config import from_dict, to_dict
from vd.files import write_json
from vd.sim.actuators import has_effects
from vd.sim.cfg import SimCfg
from vd.sim.simulator import Simulator


def save_failed_step(
    sim: Simulator,
    folder: Path,
    *,
    hand: str,
    fingertip: str,
    hand_layer: str | None,
    objects: tuple[str, ...],
) -> Path | None:
    """Save the first control step that failed, with what is needed to build its world again.

    Values that are not finite become null.

    Returns:
        The file; None if no step failed.
    """
    failed = np.flatnonzero(sim.failures.numpy())
    if not failed.size:
        return None
    world = int(failed[0])
    item = sim.scene.objects[sim.scene.world_object[world]].name
    path = folder / f"dump_{item}_{world}.json"
    record: dict[str, Any] = {
        "format": "vd-dump/1",
        "hand": hand,
        "fingertip": fingertip,
        "hand_layer": hand_layer,
        "objects": list(objects),
        "object": item,
        "world": world,
        "sim": to_dict(sim.cfg),
    }
    for name, array in sim.failed_from.items():
        record[name] = [float(v) if np.isfinite(v) else None for v in array.numpy()[world]]
    write_json(path, record)
    return path


def replay(path: Path, *, device: str = "cpu") -> Iterator[str]:
    """Simulate the dumped control step again, one line a physics step.

    Raises:
        ValueError: The file is not a dump; says what is missing.
    """
    from vd.assets_usd.hands import load_hand
    from vd.assets_usd.objects.sets import load_set
    from vd.sim.scene import build_scene

    try:
        record: dict[str, Any] = json.loads(Path(path).read_text())
        if record.get("format") != "vd-dump/1":
            raise KeyError("format vd-dump/1")
        sim = from_dict(SimCfg, record["sim"], where="sim")
        arrays = {
            name: np.array([np.nan if v is None else v for v in record[name]], dtype=np.float32)
            for name in ("joint_q", "joint_qd", "target")
        }
    except (KeyError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is not a dump of a stopped run: {error}") from error
    item = next((o for o in load_set(record["objects"]) if o.name == record["object"]), None)
    if item is None:
        raise ValueError(f"{path}: object {record['object']} is not in {record['objects']}; restore that set")
    hand = load_hand(record["hand"], record["fingertip"], record.get("hand_layer"))
    # One physics step a call: the control rate is raised to half the physics rate, an even multiple.
    cfg = dataclasses.replace(sim, control_hz=sim.physics_hz / 2.0)
    scene = build_scene(hand=hand, objects=[item], num_envs=1, cfg=cfg, device=device)
    # Servos start at rest: what they remembered is not in a dump.
    simulator = Simulator(scene, cfg, servo_rows=hand.servo if has_effects(hand.servo) else None)
    simulator.joint_q.assign(arrays["joint_q"][None])
    simulator.joint_qd.assign(arrays["joint_qd"][None])
    target = simulator.target.numpy().copy()
    target[0, : len(arrays["target"])] = arrays["target"]
    simulator.target.assign(target)
    simulator.forward_kinematics()
    yield f"{record['object']} with {record['hand']}, world {record['world']}"
    for step in range(1, round(sim.physics_hz / sim.control_hz) // 2 + 1):
        simulator.step()
        qd = simulator.joint_qd.numpy()[0]
        finite = bool(np.isfinite(qd).all() and np.isfinite(simulator.joint_q.numpy()).all())
        contacts = int(simulator.solver.mjw_data.nacon.numpy()[0])
        fastest = float(np.nanmax(np.abs(qd))) if np.isfinite(qd).any() else float("nan")
        yield (
            f"after {2 * step} physics steps: {'finite' if finite else 'NOT FINITE'}, "
            f"fastest {fastest:.3g} m/s or rad/s, {contacts} contacts"
        )
        if not finite:
            return
