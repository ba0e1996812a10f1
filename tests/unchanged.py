"""What a simplification must not change: numbers recorded on a CPU before it, compared after it bit by bit.

    python tests/unchanged.py record FOLDER
    python tests/unchanged.py compare FOLDER [--only teachers steps]

Times, paths and versions are left out. Faults run in real time: last, alone, and best on a quiet machine.
"""

import argparse
import json
import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get("VD_SHARED", ROOT.parent / "shared"))
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
# Evaluations by their name in the reference: what vd-eval is told.
TEACHERS = {
    "dclaw3": ("dclaw3",),
    "dclaw3, mixed": ("dclaw3", "--condition", "mixed"),
    "dclaw4": ("dclaw4",),
    "dclaw4-cube": ("dclaw4-cube",),
    "dclaw4, in the air": ("dclaw4", "--in-air"),
}
TRACKING = {
    "dclaw3-tracking": ("dclaw3-tracking", "dclaw3"),
    "dclaw4-tracking": ("dclaw4-tracking",),
    "dclaw4-vision": ("dclaw4-vision", "--goals", "points"),
}
EPISODES = {"teachers": 8, "tracking": 2}
"""Of each object; eight by camera would take half an hour."""
EPISODE_FIELDS = ("start_quat", "goal_quat", "error_rad", "exact_error_rad", "steps", "stopped", "fell")
# Recordings that are made, by what vd-gap hide is told, and measured ones where they are at hand.
HIDDEN = {
    "servo, friction": ("servo", "--effect", "coulomb_friction"),
    "servo, late": ("servo", "--effect", "command_delay", "--pwm"),
    "pendulum, backlash": ("pendulum", "--effect", "backlash"),
    "pendulum, nothing": ("pendulum",),
    "finger, friction": ("dclaw3", "--effect", "coulomb_friction"),
}
MEASURED = ("xl330_pendulum",)
ARRAYS = ("observation", "privileged", "reward", "reward_terms", "rotation_error", "success", "fell", "done")
STEPS, WORLDS = 18, 8
RETRIES = 2
"""Of a fault that ended otherwise: on a busy machine the twin's clock, or a start, may be late."""
TIMES = {"seconds", "elapsed_s", "steps_per_s", "collect_s", "learn_s", "detected_s", "safe_s", "own_s"}
# Threads that meet in the search for a gap make the same fit twice, and count it.
IGNORED = TIMES | {"rollouts", "rollouts_per_s", "command", "software", "path", "layer", "whole_hand_layer"}


def call(*words: object, log: Path, status: tuple[int, ...] = (0,)) -> None:
    """Run a module or file of Python with one thread of linear algebra; its last words if it fails."""
    command = [sys.executable, *map(str, words)]
    with log.open("w") as said:
        done = subprocess.run(command, stdout=said, stderr=subprocess.STDOUT, env=os.environ | ONE_THREAD)
    if done.returncode not in status:
        raise RuntimeError(f"{' '.join(command)}: status {done.returncode}\n{log.read_text()[-2000:]}")


def packed(array: Any) -> str:
    """An array as text, exactly."""
    array = np.ascontiguousarray(array)
    return f"{array.dtype.str}:{array.tobytes().hex()}"


def evaluated(part: str, items: dict[str, tuple[str, ...]], work: Path, objects: Path) -> dict[str, Any]:
    """Every episode of every policy, by each rule that stops it."""
    from vd.evaluate.result import SUCCESS

    found = {}
    for name, words in items.items():
        out = work / name.replace(" ", "-")
        flags = ["--objects", objects, "--episodes", EPISODES[part], "--seed", 1, "--device", "cpu"]
        call("-m", "vd.evaluate.cli", *words, *flags, "--out", out, log=out.with_suffix(".log"))
        for row in json.loads((out / "eval.json").read_text())["rows"]:
            label = [row[key] for key in ("policy", "stopped_by", "ours") if row[key]]
            label += [f"{bound:g}" for bound in row["rule"].values()]
            if row["stopped_by"] == SUCCESS:  # once an evaluation by itself
                label = []
            columns = {field: [e[field] for e in row["episodes"]] for field in EPISODE_FIELDS}
            found[", ".join([name, *label])] = columns | {"held": row["held"]}
    return found


def teachers(work: Path, objects: Path) -> dict[str, Any]:
    """Policies that see the simulator's state."""
    return evaluated("teachers", TEACHERS, work, objects)


def tracking(work: Path, objects: Path) -> dict[str, Any]:
    """Policies that see by cameras."""
    return evaluated("tracking", TRACKING, work, objects)


def tasks() -> dict[str, Any]:
    """Every task that ships, of presets, policies and conditions, and options that none of them has."""
    from vd.assets_usd.hands import HANDS
    from vd.envs.cfg import ReorientCfg
    from vd.evaluate.agents import open_teacher
    from vd.evaluate.conditions import CONDITIONS
    from vd.train.presets import PRESETS

    presets = {f"preset {name}": preset().env for name, preset in PRESETS.items()}
    found = {name: env for name, env in presets.items() if env.hand in HANDS}  # others have to be imported
    teachers = {words[0] for words in TEACHERS.values()}
    found |= {f"policy {name}": ReorientCfg.of(open_teacher(name, "cpu")) for name in teachers}
    table, four = found["policy dclaw3"], found["policy dclaw4"]
    found |= {f"condition {name}": replace(table, randomisation=drawn) for name, drawn in CONDITIONS.items()}
    for view, base in (("world", table), ("mirrored", table)):
        found[f"view {view} {base.hand}"] = replace(base, observation=replace(base.observation, view=view))
    known = replace(table.observation, dynamics="critic", file_axes=False)
    found["dynamics"] = replace(found["condition mixed"], observation=known)
    found["soft"] = replace(four, fingertip="soft")
    loose = replace(table.success, rotation_rad=0.8, joint_speed_rad_s=0, object_speed_m_s=0, action_norm=0)
    fixed = replace(table.curriculum, enabled=False, tightening=type(table.curriculum.tightening)())
    near = replace(table.goal, max_angle_rad=1.0)
    found["near goals"] = replace(table, success=loose, goal=near, curriculum=fixed)
    return found


def step_tasks(objects: Path, out: Path) -> None:
    """Observation, reward and ends of episodes under random actions, in every task."""
    import warp as wp

    from vd.envs.reorient import ReorientEnv

    files = tuple(str(path) for path in sorted(objects.glob("*.usd"))[:2])
    found: dict[str, Any] = {}
    for name, task in sorted(tasks().items()):
        env = ReorientEnv(replace(task, num_envs=WORLDS, objects=files, seed=5, episode_s=1.0), "cpu")
        rng, found[name] = np.random.default_rng(7), []
        for _ in range(STEPS):
            action = rng.uniform(-1.0, 1.0, (WORLDS, env.num_actions)).astype(np.float32)
            env.step(wp.array(action, dtype=float, device="cpu"))
            found[name].append({array: packed(getattr(env, array).numpy()) for array in ARRAYS})
        env.close()
    out.write_text(json.dumps(found))


def steps(work: Path, objects: Path) -> dict[str, Any]:
    """The environment's step in every task, in a process of its own."""
    call(__file__, "steps", work / "steps.json", "--objects", objects, log=work / "steps.log")
    return json.loads((work / "steps.json").read_text())


def gap(work: Path, objects: Path) -> dict[str, Any]:
    """Reports of what a simulation lacks beside a recording."""
    recordings = {name: SHARED / "measured" / name for name in MEASURED}
    recordings = {name: folder for name, folder in recordings.items() if folder.is_dir()}
    for name, words in HIDDEN.items():
        recordings[name] = work / name.replace(", ", "-")
        call(
            "-m", "vd.gap.cli", "hide", *words, "--seed", 2, "--out", recordings[name], log=work / "hide.log"
        )
    found = {}
    for name, recording in recordings.items():
        out = work / f"gap-{recording.name}"
        call("-m", "vd.gap.cli", "run", recording, "--out", out, log=out.with_suffix(".log"))
        found[name] = json.loads((out / "report.json").read_text())
    return found


def training(work: Path, objects: Path) -> dict[str, Any]:
    """Weights and curve of a run that stops after three iterations and goes on for three."""
    from vd.policy import load_policy
    from vd.train.metrics import read_progress

    run, command = work / "run", ("-m", "vd.train.cli", "teacher", "--smoke", "--out", work / "run")
    call(*command, "--max-steps", 384, log=work / "first.log")
    call(*command, "--resume", "--max-steps", 768, log=work / "second.log")
    weights = load_policy(run / "policy.pt", "cpu").weights
    arrays = {name: packed(value.numpy()) for name, value in weights.items()}
    return {"weights": arrays, "progress": read_progress(run / "progress.jsonl")}


def faults(work: Path, objects: Path, only: str = "") -> dict[str, Any]:
    """How every fault of the twin ends, or one, without the figures that its words tell."""
    file = work / "faults.json"
    # Status 1 is of a fault that ended otherwise than it has to: its row says so.
    call(
        "-m", "vd.deploy.twin.faults", "--json", file, "--only", only, log=work / "faults.log", status=(0, 1)
    )
    rows = json.loads(file.read_text())
    return {row["fault"]: row | {"happened": re.sub(r"[\d.]+", "#", row["happened"])} for row in rows}


Part = Callable[[Path, Path], dict[str, Any]]
PARTS: dict[str, Part] = {f.__name__: f for f in (tracking, gap, teachers, steps, training, faults)}
"""The longest first."""


def measure(names: list[str], objects: Path, jobs: int) -> Iterator[tuple[str, dict[str, Any], float]]:
    """Every part, what it found and how long it took [s]."""

    def one(name: str) -> tuple[str, dict[str, Any], float]:
        began = time.monotonic()
        with TemporaryDirectory() as work:
            return name, PARTS[name](Path(work), objects), time.monotonic() - began

    with ThreadPoolExecutor(jobs) as pool:
        yield from pool.map(one, [name for name in names if name != "faults"])
    yield from (one(name) for name in names if name == "faults")


def leaves(value: Any, where: str = "") -> Iterator[tuple[str, Any]]:
    """Every number, text and array with its place, but what is ignored."""
    if not isinstance(value, (dict, list)):
        yield where, value
        return
    for key, item in value.items() if isinstance(value, dict) else enumerate(value):
        if key not in IGNORED:
            yield from leaves(item, f"{where}/{key}")


def distance(a: Any, b: Any) -> float:
    """Largest difference of two numbers or arrays; infinite where there is none."""
    if isinstance(a, str) and isinstance(b, str) and a[:1] == "<" and a[:4] == b[:4] and len(a) == len(b):
        arrays = [np.frombuffer(bytes.fromhex(text[4:]), text[:3]).astype(float) for text in (a, b)]
        return float(np.nanmax(np.abs(arrays[0] - arrays[1])))
    return abs(a - b) if all(isinstance(x, (int, float)) for x in (a, b)) else math.inf


def differences(reference: Any, found: Any) -> dict[str, tuple[float, str]]:
    """By item of a part: the largest difference, and the first place that differs."""
    before, now = dict(leaves(reference)), dict(leaves(found))
    differing: dict[str, tuple[float, str]] = {}
    for where in dict.fromkeys([*before, *now]):
        a, b = before.get(where), now.get(where)
        if a != b and not (a != a and b != b):  # NaN is equal to NaN here
            item = where.split("/")[1]
            first = f"{where}: {str(a)[:40]} became {str(b)[:40]}"
            largest, first = differing.get(item, (0.0, first))
            differing[item] = max(largest, distance(a, b)), first
    return differing


def try_again(differing: dict[str, tuple[float, str]], reference: dict[str, Any]) -> None:
    """Take out of ``differing`` the faults that end as in the reference when they are tried again."""
    for fault in list(differing) * RETRIES:
        if fault in differing:
            with TemporaryDirectory() as work:
                found = faults(Path(work), ROOT, fault)
            if fault not in differences({fault: reference.get(fault)}, found):
                del differing[fault]


def main() -> int:
    """Record or compare; 1 if anything differs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("record", "compare", "steps"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS), help="parts")
    parser.add_argument(
        "--objects", type=Path, default=ROOT / "build" / "unchanged", help="folder of their USD"
    )
    parser.add_argument("--jobs", type=int, default=2, help="parts side by side")
    args = parser.parse_args()
    if not args.objects.is_dir():
        words = ("import", SHARED / "objects" / "test", "--out", args.objects)
        call("-m", "vd.assets_usd.cli", *words, log=args.objects.with_suffix(".log"))
    if args.what == "steps":
        step_tasks(args.objects, args.folder)
        return 0
    args.folder.mkdir(parents=True, exist_ok=True)
    changed = False
    for name, found, seconds in measure(args.only, args.objects.resolve(), args.jobs):
        file = args.folder / f"{name}.json"
        if args.what == "record":
            file.write_text(json.dumps(found))
            print(f"{name:9} recorded in {seconds:.0f} s", flush=True)
            continue
        reference, found = json.loads(file.read_text()), json.loads(json.dumps(found))
        known = {item: value for item, value in found.items() if item in reference}
        differing = differences(reference, known)
        if name == "faults":
            try_again(differing, reference)
        verdict = f"{len(differing)} items differ" if differing else "equal"
        print(f"{name:9} {verdict} ({seconds:.0f} s)", flush=True)
        for item, (largest, first) in differing.items():
            print(f"  {item}: by up to {largest:.3g}; first {first}", flush=True)
        changed |= bool(differing)
    return int(changed)


if __name__ == "__main__":
    sys.exit(main())
