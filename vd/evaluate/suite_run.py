"""Run a suite: every command line with every policy, each into a folder of its own.

What a folder holds already, measured with the same settings and the same policy, is not run again.
"""

import hashlib
import json
import math
import re
import shlex
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np

from vd.command.config import to_dict
from vd.command.files import make_folder, write_json
from vd.command.line import parse
from vd.command.versions import code_fingerprint
from vd.command.workers import run_tasks, shard
from vd.evaluate.agents import find_policy, has_no_file, open_policy, sees_clouds
from vd.evaluate.cfg import EvalCfg, parse_groups
from vd.evaluate.claims import ours
from vd.evaluate.compare import compare
from vd.evaluate.conditions import CHANGED
from vd.evaluate.page import NOTHING, labels, number, points, shown_name, write_page
from vd.evaluate.result import SUCCESS, Result, Row
from vd.evaluate.statistics import Interval, paired_difference
from vd.evaluate.suite import (
    OWN_SETS,
    QUICK_CAMERA_EPISODES,
    QUICK_EPISODES,
    QUICK_OBJECTS,
    QUICK_S,
    Claim,
    Suite,
    SuiteEntry,
    read_suite,
    share_text,
)

SETTINGS_FILE = "settings.json"
"""Written last into a condition's folder: what it was run with."""
LOG_FILE = "log.txt"
"""Progress of an evaluation that ran beside others."""
OUT_OF_TIME = "out of time; the same command goes on from here"
"""Why evaluations of the reduced suite were not run."""
ASPECTS = (1.0, 2.0, 4.0, math.inf)
"""Bounds of the classes of aspect ratio (ours)."""
NOT_RUN = "not run; the same command goes on from here"
# Settings that say where and how an evaluation runs, not what it measures.
_NOT_MEASURED = ("out", "device", "json", "num_envs", "jobs", "shard")
_PASSED_ON = ("seed", "device", "num_envs", "hand", "hand_layer", "engine", "randomise")
"""Flags beside ``--suite`` that every line gets."""
_GROUP = re.compile(r"([\w-]+)=SET\b")

Objects = tuple[tuple[str, ...], str]
"""The objects of a group: what vd-eval is given, sets or chosen files of them, and the same for a
reader.
"""


@dataclass(frozen=True)
class Task:
    """One policy under one condition."""

    condition: str
    policy: str
    cfg: EvalCfg
    weights: str
    """Fingerprint of the policy."""

    @property
    def key(self) -> tuple[str, str]:
        """Condition and policy."""
        return self.condition, self.policy

    @property
    def wanted(self) -> dict[str, Any]:
        """What an evaluation that can stand for it was run with."""
        settings = {
            key: value for key, value in to_dict(self.cfg).items() if key not in _NOT_MEASURED
        }
        return {"policy": self.weights, "code": code_fingerprint()} | settings

    def there(self) -> Result | None:
        """What an earlier call measured with the same settings; None: nothing."""
        try:
            if json.loads((self.cfg.out / SETTINGS_FILE).read_text()) != self.wanted:
                return None
            return Result.read(self.cfg.out / "eval.json")
        except (OSError, ValueError):  # not there, not whole, or of an older version: measure it
            return None


def run_suite(cfg: EvalCfg) -> Result:
    """Run what is not there yet, and write the page and its figures into ``cfg.out``.

    Raises:
        ValueError: A setting, object set or policy cannot be used.
        FileNotFoundError: There is no such policy.
    """
    begun = time.monotonic()
    assert cfg.suite is not None
    suite = read_suite(cfg.suite)
    wanted = groups_of(suite.lines)
    groups = object_groups(cfg.objects, wanted, quick=cfg.quick, members=suite.members)
    entries = tuple(
        entry
        for entry in suite.lines
        if (entry.quick or not cfg.quick) and groups.keys() >= set(groups_of([entry]))
    )
    tasks = shard(make_tasks(cfg, entries, groups), cfg.shard)
    found: dict[tuple[str, str], Result | str] = {
        task.key: task.there() or NOT_RUN for task in tasks
    }
    waiting = [task for task in tasks if isinstance(found[task.key], str)]
    print(
        f"{len(tasks) - len(waiting)} of {len(tasks)} evaluations were done before", file=sys.stderr
    )

    def finished(task: Task, failure: str | None, died: str) -> None:
        why, minutes = died if failure is None else failure, (time.monotonic() - begun) / 60.0
        print(
            f"[{minutes:.1f} min] {task.condition}: {task.policy} {why or 'done'}", file=sys.stderr
        )
        found[task.key] = why or Result.read(task.cfg.out / "eval.json")
        if not why:
            write_json(task.cfg.out / SETTINGS_FILE, task.wanted)

    try:
        _run(cfg, waiting, finished, begun + QUICK_S if cfg.quick else math.inf)
    finally:
        measured = [one for one in found.values() if isinstance(one, Result)]
        rows = tuple(row for one in measured for row in one.rows if row.stopped_by != SUCCESS)
        left = tuple((*key, why) for key, why in found.items() if isinstance(why, str))
        result = Result(rows, measured[0].software if measured else {}, left)
        if cfg.shard is None:
            _write(result, cfg, replace(suite, lines=entries), groups)
    return result


def _run(
    cfg: EvalCfg,
    waiting: list[Task],
    finished: Callable[[Task, str | None, str], None],
    stop_at: float,
) -> None:
    """Evaluate one after the other, or in processes side by side."""
    if cfg.jobs == 1:
        for task in waiting:
            finished(task, measure(task, stop_at), "")
        return
    import warp as wp

    devices = [cfg.device]
    if cfg.device == "auto" and wp.is_cuda_available():
        devices = [device.alias for device in wp.get_cuda_devices()]
    spread = [
        replace(task, cfg=replace(task.cfg, device=devices[turn % len(devices)]))
        for turn, task in enumerate(waiting)
    ]
    work = partial(_measure_apart, stop_at=stop_at)
    run_tasks(work, spread, finished, jobs=cfg.jobs, limit_s=math.inf, gpu=True)


def measure(task: Task, stop_at: float) -> str:
    """Evaluate into the task's folder, if it is not later than ``stop_at``.

    Why that failed, or nothing.
    """
    if time.monotonic() > stop_at:  # the same clock in all processes
        return OUT_OF_TIME
    try:
        compare(task.cfg, task.condition)
    except (
        RuntimeError,
        ValueError,
    ) as error:  # one environment that fails must not cost the others
        return str(error)
    return ""


def _measure_apart(task: Task, stop_at: float) -> str:
    """The same in a process of its own, whose progress goes to a file: several would mix."""
    make_folder(task.cfg.out)
    with (task.cfg.out / LOG_FILE).open("w") as log, redirect_stdout(log), redirect_stderr(log):
        try:
            return measure(task, stop_at)
        except OSError as error:
            return str(error)


def make_tasks(
    cfg: EvalCfg, entries: Sequence[SuiteEntry], groups: dict[str, Objects]
) -> list[Task]:
    """Everything that is to be measured, camera policies at the end if time is short, else first.

    All names are looked up here, before anything slow.
    """
    short = labels(cfg.agent_names)
    tasks = []
    for entry in entries:
        for line in entry.lines:
            for name in _policies(cfg, entry, line):
                folder = cfg.out / entry.name / short.get(name, name).replace("/", "-")
                one = replace(settings(cfg, line, name, groups), out=folder)
                tasks.append(Task(entry.name, name, one, fingerprint(name)))
    return sorted(tasks, key=lambda task: _by_camera(task.policy) == cfg.quick)


def _policies(cfg: EvalCfg, entry: SuiteEntry, line: str) -> list[str]:
    """The policies that a line is for: those that it names, or all of its kind that are asked for.

    Raises:
        ValueError: It names one of the other kind.
    """
    named = _asked(line).agent_names
    names = cfg.agent_names if named == ("POLICY",) else named
    right = [name for name in names if _by_camera(name) == (line == entry.camera)]
    if names == named != tuple(right):
        raise ValueError(
            f"--suite: {entry.name} has {', '.join(set(named) - set(right))} in the wrong line; "
            "'camera' is for policies that see by one, 'teacher' for others"
        )
    return right


@cache
def _asked(line: str) -> EvalCfg:
    """What a line of a suite asks for."""
    return cast(EvalCfg, parse(EvalCfg, shlex.split(line)[1:], prog="vd-eval"))


@cache
def _by_camera(name: str) -> bool:
    return sees_clouds(open_policy(name, "cpu"))


def groups_of(entries: Sequence[SuiteEntry]) -> list[str]:
    """The groups of objects that lines name."""
    lines = " ".join(line for entry in entries for line in entry.lines)
    return list(dict.fromkeys(_GROUP.findall(lines)))


def settings(cfg: EvalCfg, line: str, policy: str, groups: dict[str, Objects]) -> EvalCfg:
    """The evaluation of one policy by a line of a suite: what ``vd-eval`` would be told.

    Flags beside ``--suite`` change it.
    """
    asked = _asked(line)
    objects: list[str] = []
    for item in asked.objects:
        group, _, name = item.partition("=")
        objects += [f"{group}={each}" for each in groups[group][0]] if name == "SET" else [item]
    default = EvalCfg()
    passed: dict[str, Any] = {
        name: getattr(cfg, name)
        for name in _PASSED_ON
        if getattr(cfg, name) != getattr(default, name)
    }
    episodes = asked.episodes
    if cfg.quick:
        episodes = min(episodes, QUICK_CAMERA_EPISODES if _by_camera(policy) else QUICK_EPISODES)
    one = replace(asked, policies=(policy,), objects=tuple(objects), episodes=episodes, **passed)
    one.validate()
    return one


def shown(entry: SuiteEntry) -> str:
    """Where the paper shows what an entry measures, or what it changes."""
    return entry.shown or CHANGED.get(_asked(entry.lines[0]).condition or "", "")


def object_groups(
    objects: Sequence[str],
    wanted: Sequence[str],
    *,
    quick: bool,
    members: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, Objects]:
    """The objects of each wanted group.

    Those given as ``GROUP=SET``, our procedural ones for the others. Of a group with ``members``
    only the objects of these names.

    Raises:
        ValueError: No such group is wanted, or a set lacks one of the members.
    """
    from vd.assets_usd.objects.sets import set_files

    given = parse_groups(objects)
    own_sets = {group: OWN_SETS.get(group) for group in wanted}
    if unknown := [name for name in given if name not in own_sets]:
        raise ValueError(
            f"--objects: '{unknown[0]}' is no group of the suite; {', '.join(own_sets)} are"
        )
    groups: dict[str, Objects] = {}
    for group, own in own_sets.items():
        sets = given.get(group) or (() if own is None else (own,))
        if not sets:
            print(f"left out: {group}; give --objects {group}=SET", file=sys.stderr)
            continue
        files = set_files(sets)
        if names := (members or {}).get(group):
            files = _members(group, files, names)
            sets = tuple(map(str, files))
        text = f"{len(files)} of {shown_name(', '.join(given.get(group, sets)))}"
        if quick and len(files) > QUICK_OBJECTS:
            sets = tuple(str(files[i * len(files) // QUICK_OBJECTS]) for i in range(QUICK_OBJECTS))
            text = f"{len(sets)} of the {text}"
        if group not in given and group != "symmetric":
            text += ", our own, since no others were given: they stand for the paper's meshes"
        groups[group] = sets, text
    return groups


def _members(group: str, files: Sequence[Path], names: Sequence[str]) -> list[Path]:
    """The files of the objects of these names, in their order."""
    by_name = {file.stem: file for file in files}
    missing = [name for name in names if name not in by_name]
    if missing:
        raise ValueError(
            f"--objects {group}: there is no {', '.join(missing)}; import all meshes of the suite"
        )
    return [by_name[name] for name in names]


def fingerprint(name: str) -> str:
    """What tells the content of a policy from others.

    A SHA-256, or the name of an agent without a file.
    """
    if has_no_file(name):
        return name
    return hashlib.sha256(find_policy(name).read_bytes()).hexdigest()


def _write(result: Result, cfg: EvalCfg, suite: Suite, groups: dict[str, Objects]) -> None:
    """The page and its figures, of what there is."""
    short = labels(result.policies)
    of_paper = bool(suite.claims)
    if of_paper:
        figures = paper_figures(result, suite)
        table = [
            {
                "figure": row["figure"],
                "condition": row["condition"],
                "paper": row["paper"] or NOTHING,
            }
            | {short[policy]: text for policy, text in row["ours"].items()}
            for row in figures
        ]
    elif suite.by_aspect:
        figures = aspect_table(result, groups, short)
        table = figures
    else:
        figures = robust_table(result, suite.lines, short)
        table = figures
    summary = result.summary() | {"quick": cfg.quick, "figures": figures}
    write_json(cfg.out / f"{cfg.suite_name}.json", summary)
    notes = [f"Objects, {group}: {text}." for group, (_, text) in groups.items()]
    notes += ["Held-out objects judge, and nothing is chosen on them."]
    notes += [] if cfg.engine == "newton" else ["Physics by MuJoCo's own engine."]
    beside = " beside the paper" if of_paper else ""
    write_page(
        result,
        cfg.out / f"{cfg.suite_name}.html",
        title=suite.title,
        lead=f"{', '.join(short.values())}{beside}{', the reduced suite' if cfg.quick else ''}",
        figures=(list(table[0]), [list(row.values()) for row in table]) if table else None,
        notes=notes,
        conditions=[(one.name, shown(one), "\n".join(one.lines)) for one in suite.lines],
        of_paper=of_paper,
    )


def robust_table(
    result: Result, entries: Sequence[SuiteEntry], short: dict[str, str]
) -> list[dict[str, str]]:
    """A line for each entry and policy: what it changes, and how much success it costs."""
    by_name: dict[tuple[str, str], Row] = {}
    for (condition, _), rows in result.headlines().items():
        by_name |= {(condition, policy): row for policy, row in rows.items()}
    first = entries[0].name
    table = []
    for entry in entries:
        for policy in result.policies:
            row = by_name.get((entry.name, policy))
            nominal = by_name.get((first, policy))
            if row is None:
                continue
            change = NOTHING
            if nominal not in (None, row) and row.in_air is None:
                change = points(
                    paired_difference(row.successes, nominal.successes, row.overall.unit)
                )
            table.append(
                {
                    "condition": entry.name,
                    "changed": shown(entry),
                    "policy": short[policy],
                    "success": _share(row.overall.outcomes["success"]),
                    f"points from {first}": change,
                    "within 0.1 rad": _share(row.precise),
                    "lost": _share(row.overall.outcomes["object falls"]),
                }
            )
    return table


def aspect_table(
    result: Result, groups: dict[str, Objects], short: dict[str, str]
) -> list[dict[str, str]]:
    """A line for each entry and policy: success of all objects, and of each class of aspect ratio."""
    from vd.assets_usd.objects.sets import load_set

    aspects: dict[tuple[str, str], float] = {}
    for group, (sets, _) in groups.items():
        for item in load_set(sets):
            aspects[group, item.name] = aspect_ratio(item.surface_points)
    table = []
    for (condition, group), rows in result.headlines().items():
        for policy, row in rows.items():
            line = {"condition": condition, "policy": short[policy]}
            line["success"] = _share(row.overall.outcomes["success"])
            for low, high in pairwise(ASPECTS):
                rates = [
                    one.outcomes["success"].value
                    for one in row.per_object
                    if low <= aspects[group, one.name] < high
                ]
                mean = share_text(float(np.mean(rates))) if rates else NOTHING
                line[f"aspect {low:g} to {high:g}"] = f"{mean} of {len(rates)}" if rates else mean
            table.append(line)
    return table


def aspect_ratio(points: np.ndarray) -> float:
    """Longest by shortest extent of points [P, 3] along their principal axes."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    extents = np.ptp(centred @ axes.T, axis=0)
    return float(extents.max() / extents.min())


def _share(rate: Interval | None) -> str:
    return NOTHING if rate is None else share_text(rate.value, rate.low, rate.high)


def paper_figures(result: Result, suite: Suite) -> list[dict[str, Any]]:
    """The paper's figures beside ours, as text."""
    figures = []
    for entry in suite.lines:
        for claim in suite.claims:
            if entry.name in claim.entries:
                own = {
                    policy: _ours(result, claim, entry.name, policy) for policy in result.policies
                }
                paper = claim.paper_text()
                figure = {
                    "figure": claim.text,
                    "condition": entry.name,
                    "paper": paper,
                    "ours": own,
                }
                figures.append(figure)
    return figures


def _ours(result: Result, claim: Claim, condition: str, policy: str) -> str:
    rows = [row for row in result.rows if (row.condition, row.policy) == (condition, policy)]
    value = ours(claim, rows)
    if isinstance(value, Interval):
        return number(value) if claim.unit != "share" else _share(value)
    return NOTHING if value is None else share_text(value)
