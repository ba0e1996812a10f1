"""The next experiment: a menu of motions by the families of causes that are not told apart."""

import contextlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vd.command.config import to_dict
from vd.command.files import write_json
from vd.gap.result import Report
from vd.gap.rules import FAMILIES
from vd.gap.words import joints_text, listing
from vd.logs.excitations import JointRange, excitation_set, numbered
from vd.logs.recording import Recording, Trajectory, entry_of, write_table

if TYPE_CHECKING:
    from vd.assets_usd.hand_model import HandModel

FORMAT = "vd-experiment/1"
PLAN_JSON = "next_experiment.json"
PLAN_FOLDER = "next_experiment"
BASIC = "steps_and_sines"
"""What shows the plain model."""
UNKNOWN = ("gain_ladder", "slow_triangle", "chirp")
"""What shows most of what a recording of steps and sines does not."""
SETS = 2
"""Sets of motions that are proposed at once, of the joints' tied families. Not tuned."""


@dataclass(frozen=True)
class Experiment:
    """The next experiment."""

    model: str
    joints: tuple[str, ...]
    """All joints of the recording; commands name every one of them."""
    families: dict[str, tuple[str, ...]]
    """Families in question, by joint."""
    sets: tuple[str, ...]
    """Names of the sets of motions."""
    motions: tuple[Trajectory, ...]
    sentence: str


def plan(report: Report, recording: Recording, hand: "HandModel | None") -> Experiment:
    """Choose the next experiment.

    Args:
        report: What is known so far.
        recording: From what.
        hand: The hand; None for a bare servo or pendulum.
    """
    families = tied(report)
    if families:
        names = itertools.chain.from_iterable(families.values())
        sets = tuple(dict.fromkeys(FAMILIES[name].motions for name in names))[:SETS]
    else:
        shaky = [row.joint for row in report.joints if row.verdict not in ("effects", "no_gap")]
        families = dict.fromkeys(shaky or report.recording.joints, ())
        sets = (BASIC,) if report.verdict == "under_excited" else UNKNOWN
    common = _common(recording)
    motions = []
    seconds = 0.0
    for motion in excitation_set(_reach(recording, hand), sets):
        if motion.joints[0] in families:
            motions.append(replace(motion, conditions={**common, **motion.conditions}))
            seconds += motion.duration
    sentence = _sentence(families, sets, seconds)
    return Experiment(recording.model, recording.joints, families, sets, tuple(motions), sentence)


def tied(report: Report) -> dict[str, tuple[str, ...]]:
    """Families that are not certain, or whose member is not, of each joint that has such."""
    tied = set().union(*report.open_sets)
    result: dict[str, tuple[str, ...]] = {}
    for row in report.families:
        several = len(row.effects) > 1 and tied.intersection(row.effects)
        if row.verdict in ("likely", "untold") or several:
            result[row.joint] = (*result.get(row.joint, ()), row.name)
    return result


def write_plan(experiment: Experiment, folder: Path) -> Path:
    """Write ``next_experiment.json`` and its commands, one CSV file per motion.

    A CSV has the header of a recording without what is measured: ``t``, ``command.<joint>`` for
    every joint and, where the torque is switched off, ``enabled.<joint>``.

    Returns:
        The JSON file.
    """
    discard_plan(folder)
    path = Path(folder) / PLAN_JSON
    entries = []
    for motion in numbered(experiment.motions):
        entry = entry_of(replace(motion, file=f"{PLAN_FOLDER}/{motion.file}"))
        write_table(Path(folder) / entry["file"], motion, experiment.joints, ("command", "enabled"))
        entries.append(entry)
    contents = {**vars(experiment), "format": FORMAT, "trajectories": entries}
    del contents["motions"]
    write_json(path, to_dict(contents))
    return path


def discard_plan(folder: Path) -> None:
    """Remove a plan that :func:`write_plan` wrote, and no other file."""
    (Path(folder) / PLAN_JSON).unlink(missing_ok=True)
    for file in (Path(folder) / PLAN_FOLDER).glob("[0-9][0-9][0-9]_*.csv"):
        file.unlink()
    with contextlib.suppress(OSError):  # something else is in it, or it is not there
        (Path(folder) / PLAN_FOLDER).rmdir()


def _common(recording: Recording) -> dict[str, float | str]:
    """The conditions that a recording has throughout."""
    first, *others = recording.trajectories
    shared = {*first.conditions.items()}
    for trajectory in others:
        shared.intersection_update(trajectory.conditions.items())
    result = {}
    for key, value in first.conditions.items():
        if (key, value) in shared:
            result[key] = float(value) if isinstance(value, int) else value
    return result


def _reach(recording: Recording, hand: "HandModel | None") -> JointRange:
    """How far joints may move: in the hand's range, or in that of the commands before."""
    commands = []
    gain = 0.0
    for trajectory in recording.trajectories:
        commands.append(trajectory.command)
        gain = max(gain, float(trajectory.conditions.get("p_gain", 0.0)))
    lower = np.concatenate(commands).min(axis=0)
    upper = np.concatenate(commands).max(axis=0)
    if hand is not None:
        index = [*map(hand.joint_names.index, recording.joints)]
        lower = hand.lower[index]
        upper = hand.upper[index]
    return JointRange(recording.joints, lower, upper, gain or 1.0, (0.0, 0.0))


def _sentence(families: Mapping[str, Sequence[str]], sets: Sequence[str], seconds: float) -> str:
    """What to record, and for what."""
    names = list(dict.fromkeys(itertools.chain.from_iterable(families.values())))
    goal = f"to decide on {listing(names)}" if names else "to see what these motions do not show"
    return (
        f"Record the motions {listing(sets)} on {joints_text(tuple(families))}, {seconds:.0f} s, "
        f"{goal}. The commands are in {PLAN_FOLDER}/; add what was measured to the recording and "
        "run vd-gap again."
    )
