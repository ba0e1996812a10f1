"""Run the suite: every condition with every policy, each into a folder of its own.

What a folder holds already, measured with the same settings and the same policy, is not run again.
"""

import hashlib
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vd.config import to_dict
from vd.evaluate.agents import BUILT_IN, find_policy, sees_clouds
from vd.evaluate.compare import compare, parse_groups
from vd.evaluate.comparison import Comparison
from vd.evaluate.comparison_page import labels
from vd.evaluate.statistics import Interval
from vd.evaluate.suite import (
    CLAIMS,
    CONDITIONS,
    NO_STUDENT,
    OWN_SETS,
    QUICK_EPISODES,
    QUICK_OBJECTS,
    Claim,
    Condition,
    Group,
)
from vd.evaluate.suite_page import write_suite
from vd.files import write_json
from vd.paper import PAPER

if TYPE_CHECKING:
    from vd.evaluate.cli import EvalCfg

SETTINGS_FILE = "settings.json"
"""Written last into a condition's folder: what it was run with."""
RESULT_FILE, PAGE_FILE = "paper.json", "paper.html"
# Settings that say where and how an evaluation runs, not what it measures.
_NOT_MEASURED = ("output", "device", "json", "num_worlds")


@dataclass(frozen=True)
class Objects:
    """The objects of one group.

    Attributes:
        sets: What vd-eval is given: sets, or chosen files of them.
        text: The same for a reader.
        own: Whether they are our procedural ones, since no others were given.
    """

    sets: tuple[str, ...]
    text: str
    own: bool


@dataclass
class SuiteResult:
    """What the suite measured.

    Attributes:
        policies: Names, in order.
        objects: By group.
        conditions: Those that were asked for.
        quick: Whether this is the reduced suite.
        found: Comparison of one policy by the names of condition and policy.
        failed: Why a condition could not be measured, likewise.
    """

    policies: tuple[str, ...]
    objects: dict[Group, Objects]
    conditions: tuple[Condition, ...]
    quick: bool
    found: dict[tuple[str, str], Comparison] = field(default_factory=dict)
    failed: dict[tuple[str, str], str] = field(default_factory=dict)

    @property
    def students(self) -> tuple[str, ...]:
        """Those of the policies that are students."""
        return tuple(name for name in self.policies if sees_clouds(name))

    def merged(self, *conditions: str) -> Comparison | None:
        """The comparisons of conditions as one of all policies and groups; None if there is none."""
        parts = [
            self.found[condition, policy]
            for condition in conditions
            for policy in self.policies
            if (condition, policy) in self.found
        ]
        if not parts:
            return None
        return Comparison(
            rows=tuple(row for part in parts for row in part.rows),
            predictions=tuple(entry for part in parts for entry in part.predictions),
            software=parts[0].software,
        )

    def summary(self) -> dict[str, Any]:
        """The paper's figures beside ours, as JSON."""
        names = {condition.name for condition in self.conditions}
        return {
            "quick": self.quick,
            "objects": {group: to_dict(objects) for group, objects in self.objects.items()},
            "students": list(self.students) or NO_STUDENT,
            "figures": [self._figure(claim) for claim in CLAIMS if claim.condition in names],
            "failed": [
                {"condition": condition, "policy": policy, "why": why}
                for (condition, policy), why in self.failed.items()
            ],
        }

    def _figure(self, claim: Claim) -> dict[str, Any]:
        def value(comparison: Comparison) -> Any:
            found = claim.of(comparison)
            return to_dict(found) if isinstance(found, Interval) else found

        return {
            "figure": claim.text,
            "condition": claim.condition,
            "unit": claim.unit,
            "stopped_by": claim.stopped_by,
            "paper": None if claim.paper is None else list(getattr(PAPER.results, claim.paper)),
            "source": claim.source,
            "ours": {
                policy: value(self.found[claim.condition, policy])
                for policy in self.policies
                if (claim.condition, policy) in self.found
            },
        }


def run_suite(cfg: "EvalCfg", *, say: Callable[[str], object] | None = None) -> SuiteResult:
    """Run what is not there yet, and write the page and its figures into ``cfg.output``.

    Args:
        cfg: Settings of the command line.
        say: Takes lines of progress; standard error by default.

    Raises:
        ValueError: A setting, object set or policy cannot be used.
        FileNotFoundError: There is no such policy.
    """
    say = say or (lambda line: print(line, file=sys.stderr, flush=True))
    conditions = tuple(c for c in CONDITIONS if c.quick or not cfg.quick)
    result = SuiteResult(cfg.agent_names, object_groups(cfg.objects, quick=cfg.quick), conditions, cfg.quick)
    prints = {name: fingerprint(name) for name in result.policies}  # every name, before anything slow
    short = labels(result.policies)
    jobs = [
        (condition, name)
        for condition in conditions
        for name in result.policies
        if name in result.students or not condition.scanned_goals
    ]
    started = time.monotonic()
    try:
        for number, (condition, name) in enumerate(jobs, start=1):
            one = settings(cfg, condition, name, result.objects[condition.objects])
            one = replace(one, output=cfg.output / condition.name / short[name].replace("/", "-"))
            wanted = {"policy": prints[name]} | {
                key: value for key, value in to_dict(one).items() if key not in _NOT_MEASURED
            }
            there = _read(one.output, wanted)
            note = "done before" if there else result.objects[condition.objects].text
            minutes = (time.monotonic() - started) / 60.0
            say(f"[{number}/{len(jobs)}, {minutes:.1f} min] {condition.title}: {short[name]} ({note})")
            try:
                result.found[condition.name, name] = there or compare(one)
            except RuntimeError as error:  # one world that flies off must not cost the others
                result.failed[condition.name, name] = str(error)
                say(f"  failed: {error}")
            else:
                write_json(one.output / SETTINGS_FILE, wanted)
    finally:
        if result.found:
            write_json(cfg.output / RESULT_FILE, result.summary())
            write_suite(result, cfg.output / PAGE_FILE)
    return result


def settings(cfg: "EvalCfg", condition: Condition, policy: str, objects: Objects) -> "EvalCfg":
    """The evaluation of one policy under a condition: what ``vd-eval`` would be told."""
    return replace(
        cfg,
        suite=None,
        quick=False,
        policies=() if policy in BUILT_IN else (policy,),
        agent=policy if policy in BUILT_IN else None,
        objects=tuple(f"{condition.objects}={item}" for item in objects.sets),
        episodes=min(condition.episodes, QUICK_EPISODES) if cfg.quick else condition.episodes,
        at_rest=False,
        no_at_rest=True,  # the paper's objects fall into the hand, whatever a policy was trained with
        in_air=condition.in_air,
        table_friction=condition.table_friction,
        scanned_goals=condition.scanned_goals,
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
        sets = given.get(group, (own,))
        files: list[str] = []
        for entry in sets:
            path = Path(entry).expanduser()
            folder = path if path.is_dir() else None if path.is_file() else set_folder(entry)
            files += [entry] if folder is None else [str(file) for file in object_files(folder)]
        text = f"{len(files)} of {', '.join(sets)}"
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
