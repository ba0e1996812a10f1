"""Run the suite: every condition with every policy, each into a folder of its own.

What a folder holds already, measured with the same settings and the same policy, is not run again.
"""

import hashlib
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from vd.config import to_dict
from vd.evaluate.agents import (
    BUILT_IN,
    find_policy,
    has_second_view,
    sees_clouds,
)
from vd.evaluate.cfg import EvalCfg, parse_groups
from vd.evaluate.compare import compare
from vd.evaluate.comparison import Comparison
from vd.evaluate.comparison_page import labels, shown_name
from vd.evaluate.suite import (
    CONDITIONS,
    OUT_OF_TIME,
    OWN_SETS,
    QUICK_EPISODES,
    QUICK_OBJECTS,
    QUICK_S,
    QUICK_STUDENT_EPISODES,
    Condition,
    Group,
)
from vd.evaluate.suite_page import write_suite
from vd.evaluate.suite_result import Objects, SuiteResult
from vd.files import make_folder, write_json
from vd.workers import run_tasks

SETTINGS_FILE = "settings.json"
"""Written last into a condition's folder: what it was run with."""
RESULT_FILE, PAGE_FILE = "paper.json", "paper.html"
PAGE_EVERY_S = 30.0
"""Time between two pages of what there is [s]: drawing one takes seconds."""
LOG_FILE = "log.txt"
"""Progress of an evaluation that ran beside others."""
# Settings that say where and how an evaluation runs, not what it measures.
_NOT_MEASURED = ("out", "device", "json", "num_envs", "jobs")


def run_suite(cfg: EvalCfg, *, say: Callable[[str], object] | None = None) -> SuiteResult:
    """Run what is not there yet, and write the page and its figures into ``cfg.out``.

    Args:
        cfg: Settings of the command line.
        say: Takes lines of progress; standard error by default.

    Raises:
        ValueError: A setting, object set or policy cannot be used.
        FileNotFoundError: There is no such policy.
    """
    say = say or (lambda line: print(line, file=sys.stderr, flush=True))
    stop_at = time.monotonic() + QUICK_S if cfg.quick else math.inf
    groups = object_groups(cfg.objects, quick=cfg.quick)
    conditions = tuple(c for c in CONDITIONS if (c.quick or not cfg.quick) and c.objects in groups)
    result = SuiteResult(cfg.agent_names, groups, conditions, cfg.quick)
    tasks = _tasks(cfg, result)
    if cfg.quick:  # what takes long comes last
        tasks.sort(key=lambda task: task.policy in result.students)
    progress = _Progress(say, len(tasks))
    try:
        waiting = []
        for task in tasks:
            there = _read(task.cfg.out, task.wanted)
            if there is None:
                waiting.append(task)
            else:
                result.found[task.condition, task.policy] = there
                progress.say(f"{task.text}, done before")
        if cfg.jobs > 1:
            _run_together(waiting, cfg, result, progress, stop_at)
        else:
            for task in waiting:
                if time.monotonic() <= stop_at:
                    progress.say(task.text)
                _keep(task, _measure(task, stop_at), result, progress)
                progress.show(result, cfg.out)
    finally:
        _write(result, cfg.out)
    return result


def _tasks(cfg: EvalCfg, result: SuiteResult) -> list["_Task"]:
    """Everything that is to be measured. All names are looked up here, before anything slow."""
    short = labels(result.policies)
    views = {name: has_second_view(name) for name in result.policies}
    prints = {name: fingerprint(name) for name in result.policies}
    tasks = []
    for condition in result.conditions:
        objects = result.objects[condition.objects]
        for name in result.policies:
            if not condition.concerns(student=name in result.students, views=views[name]):
                continue
            one = settings(cfg, condition, name, objects)
            one = replace(one, out=cfg.out / condition.name / short[name].replace("/", "-"))
            text = f"{condition.title}: {short[name]} ({objects.text})"
            tasks.append(_Task(condition.name, name, one, prints[name], text))
    return tasks


def _write(result: SuiteResult, folder: Path) -> None:
    """The page and its figures, of what there is."""
    write_json(folder / RESULT_FILE, result.summary())
    write_suite(result, folder / PAGE_FILE)


@dataclass(frozen=True)
class _Task:
    """One policy under one condition."""

    condition: str
    policy: str
    cfg: EvalCfg
    weights: str
    """Fingerprint of the policy."""
    text: str

    @property
    def wanted(self) -> dict[str, Any]:
        """What an evaluation that can stand for it was run with."""
        settings = {key: value for key, value in to_dict(self.cfg).items() if key not in _NOT_MEASURED}
        return {"policy": self.weights} | settings


class _Progress:
    """Lines with the number of the evaluation and the minutes since the beginning."""

    def __init__(self, say: Callable[[str], object], total: int):
        self.line, self._total, self._number = say, total, 0
        self._started = self._shown = time.monotonic()

    def say(self, text: str) -> None:
        self._number += 1
        minutes = (time.monotonic() - self._started) / 60.0
        self.line(f"[{self._number}/{self._total}, {minutes:.1f} min] {text}")

    def show(self, result: SuiteResult, folder: Path) -> None:
        """Write the page of what there is, should the rest not come; not if there was one just now."""
        if time.monotonic() > self._shown + PAGE_EVERY_S:
            _write(result, folder)
            self._shown = time.monotonic()


def _measure(task: _Task, stop_at: float = math.inf) -> str:
    """Evaluate into the task's folder until ``stop_at``; returns why that failed, or nothing."""
    if time.monotonic() > stop_at:  # the same clock in all processes
        return OUT_OF_TIME
    try:
        compare(task.cfg, stop_at)
    except TimeoutError:
        return OUT_OF_TIME
    except (RuntimeError, ValueError) as error:  # one world that flies off must not cost the others
        return str(error)
    return ""


def _measure_apart(task: _Task, stop_at: float = math.inf) -> str:
    """The same in a process of its own, whose progress goes to a file: several would mix."""
    make_folder(task.cfg.out)
    with (task.cfg.out / LOG_FILE).open("w") as log, redirect_stdout(log), redirect_stderr(log):
        try:
            return _measure(task, stop_at)
        except OSError as error:
            return str(error)


def _keep(task: _Task, failure: str, result: SuiteResult, progress: _Progress) -> None:
    """Take what an evaluation left, and mark it as whole."""
    if failure == OUT_OF_TIME:
        result.late.append((task.condition, task.policy))
        return
    if failure:
        result.failed[task.condition, task.policy] = failure
        progress.line(f"  failed: {failure}")
        return
    result.found[task.condition, task.policy] = Comparison.read(task.cfg.out / "eval.json")
    write_json(task.cfg.out / SETTINGS_FILE, task.wanted)


def _run_together(
    tasks: Sequence[_Task], cfg: EvalCfg, result: SuiteResult, progress: _Progress, stop_at: float
) -> None:
    """Evaluate in processes side by side, those of students first, which take longest."""
    import warp as wp

    devices = [cfg.device]
    if cfg.device == "auto" and wp.is_cuda_available():
        devices = [device.alias for device in wp.get_cuda_devices()]
    order = sorted(tasks, key=lambda task: task.policy not in result.students)
    spread = [
        replace(task, cfg=replace(task.cfg, device=devices[number % len(devices)]))
        for number, task in enumerate(order)
    ]

    def finished(task: _Task, failure: str | None, died: str) -> None:
        progress.say(task.text)
        _keep(task, died if failure is None else failure, result, progress)
        progress.show(result, cfg.out)

    run_tasks(
        partial(_measure_apart, stop_at=stop_at),
        spread,
        finished,
        jobs=cfg.jobs,
        limit_s=float("inf"),
        gpu=True,
    )


def settings(cfg: EvalCfg, condition: Condition, policy: str, objects: Objects) -> EvalCfg:
    """The evaluation of one policy under a condition: what ``vd-eval`` would be told."""
    episodes, most = condition.episodes, QUICK_EPISODES
    if sees_clouds(policy):
        episodes, most = condition.student_episodes, QUICK_STUDENT_EPISODES
    return replace(
        cfg,
        suite=None,
        quick=False,
        jobs=1,
        policies=() if policy in BUILT_IN else (policy,),
        agent=policy if policy in BUILT_IN else None,
        objects=tuple(f"{condition.objects}={item}" for item in objects.sets),
        episodes=min(episodes, most) if cfg.quick else episodes,
        at_rest=False,
        second_view=condition.second_view,
        no_at_rest=True,  # the paper's objects fall into the hand, whatever a policy was trained with
        in_air=condition.in_air,
        table_friction=condition.table_friction,
        goals=condition.goals,
        sensor_errors=condition.sensor_errors,
    )


def object_groups(objects: tuple[str, ...], *, quick: bool) -> dict[Group, Objects]:
    """The objects of each group: those given as ``GROUP=SET``, our procedural ones for the others.

    Raises:
        ValueError: There is no such group.
    """
    from vd.assets_usd.objects.model import object_files
    from vd.assets_usd.objects.sets import set_folder

    given = parse_groups(objects)
    if unknown := [name for name in given if name not in OWN_SETS]:
        raise ValueError(f"--objects: '{unknown[0]}' is no group of the suite; {', '.join(OWN_SETS)} are")
    groups: dict[Group, Objects] = {}
    for group, own in OWN_SETS.items():
        if group not in given and own is None:
            continue
        sets = given.get(group) or (str(own),)
        files: list[str] = []
        for entry in sets:
            path = Path(entry).expanduser()
            folder = path if path.is_dir() else None if path.is_file() else set_folder(entry)
            files += [entry] if folder is None else [str(file) for file in object_files(folder)]
        text = f"{len(files)} of {shown_name(', '.join(sets))}"
        if quick and len(files) > QUICK_OBJECTS:
            sets = tuple(files[i * len(files) // QUICK_OBJECTS] for i in range(QUICK_OBJECTS))
            text = f"{len(sets)} of the {text}"
        groups[group] = Objects(sets, text, group not in given)
    return groups


def fingerprint(name: str) -> str:
    """What tells the content of a policy from others: its file's SHA-256, or the name of a built-in agent.

    Raises:
        FileNotFoundError: There is no such policy.
    """
    if name in BUILT_IN:
        return name
    path = find_policy(name)
    digest = hashlib.sha256()
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if file.is_file():
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _read(folder: Path, wanted: dict[str, Any]) -> Comparison | None:
    """What an earlier call measured with the same settings; None: nothing."""
    try:
        if json.loads((folder / SETTINGS_FILE).read_text()) != json.loads(json.dumps(wanted)):
            return None
        return Comparison.read(folder / "eval.json")
    except (OSError, ValueError):  # not there, not whole, or of an older version: measure it
        return None
