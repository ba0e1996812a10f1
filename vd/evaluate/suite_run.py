"""Run a suite: every command line with every policy, each into a folder of its own.

What a folder holds already, measured with the same settings and the same policy, is not run again.
"""

import hashlib
import json
import math
import shlex
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np

from vd.command.config import to_dict
from vd.command.files import make_folder, write_json
from vd.command.line import parse
from vd.command.versions import MEASURING, SEEING, code_fingerprint
from vd.command.workers import run_tasks, shard
from vd.evaluate.cfg import PASSED_ON, EvalCfg, parse_groups
from vd.evaluate.claims import claimed
from vd.evaluate.compare import compare
from vd.evaluate.conditions import CHANGED
from vd.evaluate.page import (
    NOTHING,
    labels,
    number,
    percent,
    points,
    shortened,
    shown_name,
    write_page,
)
from vd.evaluate.result import SUCCESS, Result, Row
from vd.evaluate.statistics import Interval, paired_difference
from vd.evaluate.suite import OWN_SETS, Claim, Suite, SuiteEntry, read_suite
from vd.paper import PAPER
from vd.policy.agents import find_policy, has_no_file, open_policy, sees_clouds

SETTINGS_FILE = "settings.json"
"""Written last into a condition's folder: what it was run with."""
LOG_FILE = "log.txt"
"""Progress of an evaluation that ran beside others."""
ASPECTS = (1.0, 2.0, 4.0, math.inf)
"""Bounds of the classes of aspect ratio (ours)."""
NOT_RUN = "not run; the same command goes on from here"
# Settings that say where and how an evaluation runs, not what it measures.
_NOT_MEASURED = ("out", "device", "num_envs", "jobs", "shard")


@dataclass(frozen=True)
class ObjectGroup:
    """The objects of a group."""

    sets: tuple[str, ...]
    """What vd-eval is given: sets, or files of them."""
    text: str
    """The same for a reader."""


@dataclass(frozen=True)
class SuiteTask:
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
    def settings(self) -> dict[str, Any]:
        """All that decides what is measured."""
        settings = to_dict(self.cfg)
        for name in _NOT_MEASURED:
            del settings[name]
        return {"policy": self.weights, "code": code_of(self.policy)} | settings

    def measured(self) -> Result | None:
        """What an earlier call measured with the same settings; None: nothing."""
        try:
            settings = json.loads((self.cfg.out / SETTINGS_FILE).read_text())
            if settings == self.settings:
                return Result.read(self.cfg.out / "eval.json")
        except (OSError, ValueError):  # not there, not whole, or of an older version
            pass
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
    groups = object_groups(cfg.objects, wanted, suite.members)
    entries = [entry for entry in suite.lines if groups.keys() >= set(groups_of([entry]))]
    tasks = shard(make_tasks(cfg, entries, groups), cfg.shard)
    results: dict[tuple[str, str], Result] = {}
    missing: dict[tuple[str, str], str] = {}
    waiting = []
    for task in tasks:
        result = task.measured()
        if result is None:
            waiting.append(task)
            missing[task.key] = NOT_RUN
        else:
            results[task.key] = result
    print(f"{len(results)} of {len(tasks)} evaluations were done before", file=sys.stderr)

    def finished(task: SuiteTask, failure: str | None, died: str) -> None:
        why = died if failure is None else failure
        minutes = (time.monotonic() - begun) / 60.0
        outcome = why or "done"
        print(f"[{minutes:.1f} min] {task.condition}: {task.policy} {outcome}", file=sys.stderr)
        if why:
            missing[task.key] = why
            return
        del missing[task.key]
        results[task.key] = Result.read(task.cfg.out / "eval.json")
        write_json(task.cfg.out / SETTINGS_FILE, task.settings)

    try:
        _run(cfg, waiting, finished)
    finally:
        rows = []
        software: dict[str, str] = {}
        for task in tasks:
            if task.key in results:
                result = results[task.key]
                software = software or result.software
                rows += [row for row in result.rows if row.stopped_by != SUCCESS]
        left = tuple((*key, why) for key, why in missing.items())
        whole = Result(tuple(rows), software, left)
        if cfg.shard is None:
            _write(whole, cfg, replace(suite, lines=tuple(entries)), groups)
    return whole


def _run(
    cfg: EvalCfg,
    waiting: list[SuiteTask],
    finished: Callable[[SuiteTask, str | None, str], None],
) -> None:
    """Evaluate one after the other, or in processes side by side."""
    if cfg.jobs == 1:
        for task in waiting:
            finished(task, measure(task), "")
        return
    import warp as wp

    devices = [cfg.device]
    if cfg.device == "auto" and wp.is_cuda_available():
        devices = [device.alias for device in wp.get_cuda_devices()]
    spread = []
    for turn, task in enumerate(waiting):
        device = devices[turn % len(devices)]
        spread.append(replace(task, cfg=replace(task.cfg, device=device)))
    run_tasks(_measure_apart, spread, finished, jobs=cfg.jobs, limit_s=math.inf, gpu=True)


def measure(task: SuiteTask) -> str:
    """Evaluate into the task's folder; why that failed, or nothing."""
    try:
        compare(task.cfg, task.condition)
    except (RuntimeError, ValueError) as error:  # one that fails must not cost the others
        return str(error)
    return ""


def _measure_apart(task: SuiteTask) -> str:
    """The same in a process of its own, whose progress goes to a file: several would mix."""
    make_folder(task.cfg.out)
    with (task.cfg.out / LOG_FILE).open("w") as log, redirect_stdout(log), redirect_stderr(log):
        try:
            return measure(task)
        except OSError as error:
            return str(error)


def make_tasks(
    cfg: EvalCfg, entries: Sequence[SuiteEntry], groups: dict[str, ObjectGroup]
) -> list[SuiteTask]:
    """Everything that is to be measured, camera policies first, since they take longest.

    All names are looked up here, before anything slow.
    """
    from vd.evaluate.spin import spins

    for name in cfg.agent_names:
        if spins(open_policy(name, "cpu")):
            raise ValueError(f"{name} turns objects without a goal; evaluate it without --suite")
    short = labels(cfg.agent_names)
    by_camera: list[SuiteTask] = []
    others: list[SuiteTask] = []
    for entry in entries:
        for line in entry.lines:
            for name in _policies(cfg, entry, line):
                folder = cfg.out / entry.name / short.get(name, name).replace("/", "-")
                asked = replace(settings(cfg, line, name, groups), out=folder)
                task = SuiteTask(entry.name, name, asked, fingerprint(name))
                (by_camera if _by_camera(name) else others).append(task)
    return by_camera + others


def _policies(cfg: EvalCfg, entry: SuiteEntry, line: str) -> list[str]:
    """The policies that a line is for: those that it names, or all of its kind that are asked for.

    Raises:
        ValueError: It names one of the other kind.
    """
    named = _parsed(line).agent_names
    for_camera = line == entry.camera
    if named == ("POLICY",):
        return [name for name in cfg.agent_names if _by_camera(name) == for_camera]
    wrong = [name for name in named if _by_camera(name) != for_camera]
    if wrong:
        raise ValueError(
            f"--suite: {entry.name} has {', '.join(wrong)} in the wrong line; "
            "'camera' is for policies that see by one, 'teacher' for others"
        )
    return list(named)


@cache
def _parsed(line: str) -> EvalCfg:
    """What a line of a suite asks for."""
    return cast(EvalCfg, parse(EvalCfg, shlex.split(line)[1:], prog="vd-eval"))


@cache
def _by_camera(name: str) -> bool:
    return sees_clouds(open_policy(name, "cpu"))


def code_of(policy: str) -> str:
    """The fingerprint of the code that decides what an evaluation of a policy gives."""
    return code_fingerprint(SEEING if _by_camera(policy) else MEASURING)


def groups_of(entries: Sequence[SuiteEntry]) -> list[str]:
    """The groups of objects that lines name."""
    groups: list[str] = []
    for entry in entries:
        for line in entry.lines:
            for item in _parsed(line).objects:
                group, _, name = item.partition("=")
                if name == "SET":
                    groups.append(group)
    return list(dict.fromkeys(groups))


def settings(cfg: EvalCfg, line: str, policy: str, groups: dict[str, ObjectGroup]) -> EvalCfg:
    """The evaluation of one policy by a line of a suite: what ``vd-eval`` would be told.

    Flags beside ``--suite`` change it.
    """
    asked = _parsed(line)
    objects: list[str] = []
    for item in asked.objects:
        group, _, name = item.partition("=")
        if name == "SET":
            objects += [f"{group}={each}" for each in groups[group].sets]
        else:
            objects.append(item)
    changes: dict[str, Any] = {}
    for name in PASSED_ON:
        value = getattr(cfg, name)
        if value != getattr(EvalCfg, name):
            changes[name] = value
    asked = replace(asked, policies=(policy,), objects=tuple(objects), **changes)
    asked.validate()
    return asked


def shown(entry: SuiteEntry) -> str:
    """Where the paper shows what an entry measures, or what it changes."""
    return entry.shown or CHANGED.get(_parsed(entry.lines[0]).condition or "", "")


def object_groups(
    objects: Sequence[str], wanted: Sequence[str], members: Mapping[str, Sequence[str]]
) -> dict[str, ObjectGroup]:
    """The objects of each wanted group.

    Those given as ``GROUP=SET``, our procedural ones for the others. Of a group with ``members``
    only the objects of these names.

    Raises:
        ValueError: No such group is wanted, or a set lacks one of the members.
    """
    from vd.assets_usd.objects.sets import set_files

    given = parse_groups(objects)
    for name in given:
        if name not in wanted:
            raise ValueError(
                f"--objects: '{name}' is no group of the suite; {', '.join(wanted)} are"
            )
    groups: dict[str, ObjectGroup] = {}
    for group in wanted:
        sets = given.get(group) or OWN_SETS.get(group)
        if not sets:
            print(f"left out: {group}; give --objects {group}=SET", file=sys.stderr)
            continue
        files = set_files(sets)
        if group in members:
            files = _members(group, files, members[group])
            sets = tuple(map(str, files))
        text = f"{len(files)} of {shown_name(', '.join(given.get(group, sets)))}"
        if group not in given and group != "symmetric":
            text += ", our own, since no others were given: they stand for the paper's meshes"
        groups[group] = ObjectGroup(sets, text)
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


def _write(result: Result, cfg: EvalCfg, suite: Suite, groups: dict[str, ObjectGroup]) -> None:
    """The page and its figures, of what there is."""
    of_paper = bool(suite.claims)
    short = shortened(result)
    if of_paper:
        figures = paper_figures(short, suite)
    elif suite.by_aspect:
        figures = aspect_table(short, groups)
    else:
        figures = robust_table(short, suite.lines)
    summary = result.summary() | {"figures": figures}
    write_json(cfg.out / f"{cfg.suite_name}.json", summary)
    notes = [f"Objects, {name}: {group.text}." for name, group in groups.items()]
    notes.append("Held-out objects judge, and nothing is chosen on them.")
    if cfg.engine != "newton":
        notes.append("Physics by MuJoCo's own engine.")
    lead = ", ".join(short.policies)
    if of_paper:
        lead += " beside the paper"
    table = None
    if figures:
        table = (list(figures[0]), [list(figure.values()) for figure in figures])
    write_page(
        result,
        cfg.out / f"{cfg.suite_name}.html",
        title=suite.title,
        lead=lead,
        figures=table,
        notes=notes,
        conditions=[(entry.name, shown(entry), "\n".join(entry.lines)) for entry in suite.lines],
        of_paper=of_paper,
    )


def _are_paired(row: Row, other: Row) -> bool:
    """Whether two rows are of the same episodes."""
    if row.in_air is not None or row.object_names != other.object_names:
        return False
    return row.successes.shape == other.successes.shape


def robust_table(result: Result, entries: Sequence[SuiteEntry]) -> list[dict[str, str]]:
    """A line for each entry and policy: what it changes, and how much success it costs."""
    row_of: dict[tuple[str, str], Row] = {}
    for row in result.rows:
        if row.headline:
            row_of[row.condition, row.policy] = row
    first = entries[0].name
    table = []
    for entry in entries:
        for policy in result.policies:
            if (entry.name, policy) not in row_of:
                continue
            row = row_of[entry.name, policy]
            change = NOTHING
            nominal = row_of.get((first, policy))
            if entry.name != first and nominal is not None and _are_paired(row, nominal):
                change = points(paired_difference(row.successes, nominal.successes))
            table.append(
                {
                    "condition": entry.name,
                    "changed": shown(entry),
                    "policy": policy,
                    "success": percent(row.overall.outcomes["success"]),
                    f"points from {first}": change,
                    "within 0.1 rad": percent(row.precise),
                    "lost": percent(row.overall.outcomes["object falls"]),
                }
            )
    return table


def aspect_table(result: Result, groups: dict[str, ObjectGroup]) -> list[dict[str, str]]:
    """A line for each entry and policy: success of all objects, and of each class of aspect ratio.

    It is the longest by the shortest extent of an object along its principal axes.
    """
    from vd.assets_usd.objects.geometry import sides_along_axes
    from vd.assets_usd.objects.sets import load_set

    aspects: dict[tuple[str, str], float] = {}
    for name, group in groups.items():
        for item in load_set(group.sets):
            extents = sides_along_axes(item.surface_points)
            aspects[name, item.name] = float(extents.max() / extents.min())
    table = []
    for row in result.rows:
        if not row.headline:
            continue
        line = {"condition": row.condition, "policy": row.policy}
        line["success"] = percent(row.overall.outcomes["success"])
        for low, high in pairwise(ASPECTS):
            rates = [
                item.outcomes["success"].value
                for item in row.per_object
                if low <= aspects[row.group, item.name] < high
            ]
            mean = percent(float(np.mean(rates))) if rates else NOTHING
            line[f"aspect {low:g} to {high:g}"] = f"{mean} of {len(rates)}" if rates else mean
        table.append(line)
    return table


def paper_figures(result: Result, suite: Suite) -> list[dict[str, str]]:
    """The paper's figures, each beside that of every policy."""
    figures = []
    for entry in suite.lines:
        for claim in suite.claims:
            if entry.name not in claim.entries:
                continue
            figure = {
                "figure": claim.text,
                "condition": entry.name,
                "paper": paper_text(claim),
            }
            for policy in result.policies:
                rows = [r for r in result.rows if (r.condition, r.policy) == (entry.name, policy)]
                value = claimed(claim, rows)
                in_unit = claim.unit != "share" and isinstance(value, Interval)
                figure[policy] = number(value) if in_unit else percent(value)
            figures.append(figure)
    return figures


def paper_text(claim: Claim) -> str:
    """What the paper says: ``96.0 % (94.0 to 97.0)``, ``0.12 to 0.13``, ``below 7``."""
    if claim.paper is None:
        return NOTHING
    values: tuple[float, ...] = getattr(PAPER.results, claim.paper)
    if claim.unit == "rad":
        low, high = values
        return f"{low:.2f} to {high:.2f}"
    if claim.unit == "s":
        return f"below {values[0]:g}"
    if len(values) == 1:
        return percent(values[0])
    value, low, high = values
    return percent(Interval(value, low, high, ""))
