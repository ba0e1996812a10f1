"""Plan the next experiment: the motions on which the models that are still possible disagree most.

Every set of motions of the menu is simulated under every model in question, together with what has been
recorded. Two models differ by what refitting cannot absorb: the part of their difference along small changes
of their parameters is taken out, as far as each goes on explaining the recording, and so is what one of them
explains worse of it. The set of motions that tells most pairs of models apart is proposed.
"""

import contextlib
import csv
import io
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import vd.kernels.servo.actuators as servo
from vd.files import write_json, write_text
from vd.gap.chain import Chain, chains
from vd.gap.excitations import MENU, Excitation, JointRange
from vd.gap.recording import BARE_MODELS, Recording, Trajectory
from vd.gap.result import Report, parameter_columns, parameter_of
from vd.gap.rollout import STEP_S, Rollouts
from vd.gap.words import joints_text, listing, plain
from vd.kernels.servo.effects import BASELINE, EFFECTS

if TYPE_CHECKING:
    from vd.assets_usd.hand_model import HandModel

FORMAT = "vd-experiment/1"
PLAN_JSON = "next_experiment.json"
PLAN_FOLDER = "next_experiment"
UNCERTAINTY = 0.1
"""Relative standard deviation that the parameters of a model are given: what old data leave open."""
STEP = 0.05
"""Relative change of a parameter by which its influence is computed."""
KNOWN_S = 60.0
"""Recorded time that refits are held to [s]."""
FINE_STEP_S = 1.0 / 2400.0
"""Time step [s]: rivals differ by less than a delay of the fit's own step."""
VISIBLE = 1.5
"""Disagreement, in noise floors, from which a recording is expected to decide: who is wrong leaves 1.8 floors
there, noise included, and 1.3 are the most that an accepted model may leave."""
PLAIN = "plain servo"
"""The model without any further effect."""
PAYLOAD_SET = "second_payload"
"""Set that changes the load; only a pendulum's load is modelled."""
PAYLOAD_FACTORS = (1.0, 2.0)
"""Loads of that set in units of the one that was recorded."""
CONCLUSIONS = {
    "steps_and_sines": "steps and sines",
    "slow_triangle": "a slow triangle",
    "gain_ladder": "the same motions at three P gains",
    "second_payload": "the same motion with a second payload",
    "torque_release": "lifting and then switching the torque off",
    "long_holds": "levels held for several seconds",
    "reversal_staircase": "a staircase of small steps with many reversals",
    "chirp": "a small sine of rising frequency",
}
"""Sets of motions in words."""


@dataclass(frozen=True)
class Score:
    """What a set of motions would show."""

    name: str
    """Key of :data:`vd.gap.excitations.MENU`."""
    told: int
    """Pairs of models in question that differ by more than :data:`VISIBLE` noise floors."""
    pairs: int
    """Pairs in question."""
    floors: float
    """RMS difference of two models in noise floors of the joint, refitting taken into account: the median."""
    seconds: float
    """Length of all its motions."""


@dataclass(frozen=True)
class Plan:
    """The next experiment."""

    model: str
    joints: tuple[str, ...]
    """All joints of the recording; commands name every one of them."""
    competing: dict[str, tuple[tuple[str, ...], ...]]
    """Sets of models in question, by joint."""
    ranking: tuple[Score, ...]
    """Best first."""
    motions: tuple[Excitation, ...]
    """Of the best set."""
    sentence: str


def plan(
    report: Report,
    recording: Recording,
    hand: "HandModel | None",
    start: Mapping[str, np.ndarray] | None = None,
    *,
    device: str = "cpu",
) -> Plan:
    """Choose the next experiment.

    Args:
        report: What is known so far.
        recording: From what.
        hand: The hand; None for a bare servo or pendulum.
        start: Parameter row of each joint that the analysis started from.
        device: Warp device.

    Raises:
        ValueError: The recording has no joint with a model to compare.
    """
    targets, floors = _targets(report), {one.joint: one.noise_floor_rad for one in report.joints}
    reach = _reach(recording, hand)
    pairs: dict[str, list[float]] = {}
    motions: dict[str, list[Excitation]] = {}
    competing: dict[str, list[tuple[str, ...]]] = {}
    for chain in chains(recording, hand):
        base = _base(chain, report, start or {})
        for joint in (name for name in chain.joints if name in targets):
            menu = {name: found for name in MENU if (found := _motions(name, reach, recording, joint))}
            for name, found in menu.items():
                motions.setdefault(name, []).extend(found)
            for group in targets[joint] or ((),):
                models = _models(report, chain, joint, base, group)
                competing.setdefault(joint, []).append(tuple(models))
                step, floor = FINE_STEP_S if group else STEP_S, floors.get(joint, report.noise_floor_rad)
                differences = _disagreements(chain, recording, menu, joint, models, floor, step, device)
                for name, values in differences.items():
                    pairs.setdefault(name, []).extend(value / floor for value in values)
    if not pairs:
        raise ValueError(
            f"{recording.path}: no joint has a fitted model to plan from, or every motion of the menu has "
            "been recorded; run vd-gap explain first"
        )
    total = max(map(len, pairs.values()))
    scores = [
        Score(
            name,
            sum(value > VISIBLE for value in values),
            total,
            float(np.median(values)),
            sum(motion.duration for motion in motions[name]),
        )
        for name, values in pairs.items()
    ]
    ranking = sorted(scores, key=lambda score: (-score.told, -score.floors))
    return Plan(
        model=recording.model,
        joints=recording.joints,
        competing={joint: tuple(groups) for joint, groups in competing.items()},
        ranking=tuple(ranking),
        motions=tuple(motions[ranking[0].name]),
        sentence=_sentence(ranking[0], report, tuple(competing)),
    )


def write_plan(result: Plan, folder: Path) -> Path:
    """Write ``next_experiment.json`` and its commands, one CSV file per motion.

    A CSV has the header of a recording without what is measured: ``t``, ``command.<joint>`` for every joint
    and, where the torque is switched off, ``enabled.<joint>``.

    Returns:
        The JSON file.
    """
    discard_plan(folder)
    entries = []
    for index, motion in enumerate(result.motions):
        name = f"{index:03d}_{motion.joints[0]}_{motion.name}.csv"
        write_text(Path(folder) / PLAN_FOLDER / name, _csv(motion, result.joints))
        entries.append(
            {
                "file": f"{PLAN_FOLDER}/{name}",
                "excitation": motion.name,
                "joints": list(motion.joints),
                "conditions": motion.conditions,
                "duration_s": motion.duration,
            }
        )
    path = Path(folder) / PLAN_JSON
    write_json(
        path,
        {
            "format": FORMAT,
            "model": result.model,
            "joints": list(result.joints),
            "sentence": result.sentence,
            "excitation": result.ranking[0].name,
            "competing": {joint: [list(names) for names in sets] for joint, sets in result.competing.items()},
            "ranking": [vars(score) for score in result.ranking],
            "trajectories": entries,
        },
    )
    return path


def discard_plan(folder: Path) -> None:
    """Remove a plan that :func:`write_plan` wrote, and no other file."""
    path = Path(folder) / PLAN_JSON
    try:
        files = [entry["file"] for entry in json.loads(path.read_text())["trajectories"]]
    except (OSError, ValueError, KeyError, TypeError):
        files = []  # none, or not of this program
    for file in files:
        (Path(folder) / PLAN_FOLDER / Path(file).name).unlink(missing_ok=True)
    path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # something else is in it, or it is not there
        (Path(folder) / PLAN_FOLDER).rmdir()


def _targets(report: Report) -> dict[str, tuple[tuple[str, ...], ...]]:
    """Joints in question with the sets of effects that compete on each; none means that all do."""
    targets = {one.joint: one.open_sets for one in report.joints if one.open_sets}
    if not targets:
        shaky = [
            one.joint for one in report.joints if one.verdict in ("under_excited", "ambiguous", "unknown")
        ]
        targets = {joint: () for joint in shaky or report.recording.joints}
    return {joint: groups for joint, groups in targets.items() if joint in report.identified.parameters}


def _base(chain: Chain, report: Report, start: Mapping[str, np.ndarray]) -> np.ndarray:
    """Parameter rows of the chain as identified so far, shape [n, P]."""
    rows = np.array(chain.start_row, dtype=float)
    for index, joint in enumerate(chain.joints):
        rows[index] = start.get(joint, rows[index])
        for column, value in parameter_columns(report, joint).items():
            rows[index, column] = value
    return rows


def _models(
    report: Report, chain: Chain, joint: str, base: np.ndarray, group: Sequence[str]
) -> dict[str, np.ndarray]:
    """Parameter rows [n, P] of every model in question, by name."""
    index = chain.joints.index(joint)
    models = {}
    base = base.copy()
    for name in group:  # one of them stands in the identified model for all
        for parameter in EFFECTS[name].parameters:
            base[index, parameter.column] = parameter.neutral
    held = {e.name for e in (*report.effects, *report.provisional) if joint in e.joints}
    for name in group:
        values = {p.column: p.typical for p in EFFECTS[name].parameters}
        for key, value in _fitted(report, joint, name, held - set(group)).items():
            values[parameter_of(key, name).column] = value
        models[name] = base.copy()
        for column, value in values.items():
            models[name][index, column] = value
    if len(models) >= 2:
        return models
    # Nothing in particular competes: which motion would show the most of everything?
    models = {PLAIN: base}
    for effect in EFFECTS.values():
        if effect.name == "joint_coupling" and len(chain.joints) == 1:
            continue
        models[effect.name] = base.copy()
        for parameter in effect.parameters:
            models[effect.name][index, parameter.column] = parameter.typical
    return models


def _fitted(report: Report, joint: str, name: str, given: set[str]) -> dict[str, float]:
    """Parameters of an effect on a joint as they were fitted beside the effects given, or else last."""
    found = [
        row
        for row in report.evidence
        if row.name == name and joint in row.joints and row.parameters and not row.placebo
    ]
    beside = [row for row in found if set(row.given) == given]
    return (beside or found)[-1].parameters if found else {}


def _reach(recording: Recording, hand: "HandModel | None") -> JointRange:
    """Range of motion of the recorded joints: the hand's, or what was commanded before."""
    gains = [float(t.conditions["p_gain"]) for t in recording.trajectories if "p_gain" in t.conditions]
    p_gain = max(gains, default=1.0)
    if hand is not None:
        index = [hand.joint_names.index(name) for name in recording.joints]
        return JointRange(recording.joints, hand.lower[index], hand.upper[index], p_gain)
    commands = np.concatenate([t.command for t in recording.trajectories])
    return JointRange(recording.joints, commands.min(axis=0), commands.max(axis=0), p_gain)


def _motions(name: str, reach: JointRange, recording: Recording, joint: str) -> list[Excitation]:
    """Motions of a set that move the joint; none if the set cannot be predicted for this machine."""
    common = _common(recording)
    recorded = {
        (t.excitation, t.conditions.get("p_gain")) for t in recording.trajectories if joint in t.joints
    }
    motions = [
        motion
        for motion in MENU[name](reach)
        if motion.joints == (joint,)
        and (motion.name, motion.conditions.get("p_gain", common.get("p_gain"))) not in recorded
    ]
    if name == PAYLOAD_SET:
        mass = common.get("payload_kg")
        if recording.model not in BARE_MODELS or not isinstance(mass, float) or "arm_length_m" not in common:
            return []
        motions = [
            replace(motion, conditions={**motion.conditions, "payload_kg": factor * mass})
            for motion, factor in zip(motions, PAYLOAD_FACTORS, strict=False)
        ]
    return [replace(motion, conditions={**common, **motion.conditions}) for motion in motions]


def _common(recording: Recording) -> dict[str, float | str]:
    """Conditions that were the same in all recorded motions, and the full gain."""
    first = dict(recording.trajectories[0].conditions)
    return {
        key: float(value) if isinstance(value, int) else value
        for key, value in first.items()
        if all(t.conditions.get(key) == value for t in recording.trajectories)
    }


def _disagreements(
    chain: Chain,
    recording: Recording,
    menu: Mapping[str, Sequence[Excitation]],
    joint: str,
    models: Mapping[str, np.ndarray],
    floor: float,
    dt: float,
    device: str,
) -> dict[str, list[float]]:
    """What every two rivals, or each and the plain servo, say differently about each set of motions [rad]."""
    known = _known(recording, joint)
    motions = [(name, motion) for name, found in menu.items() for motion in found]
    imagined = replace(
        recording,
        trajectories=known
        + tuple(
            Trajectory(
                file=f"{index}_{name}",
                excitation=motion.name,
                joints=motion.joints,
                conditions=motion.conditions,
                time=motion.time,
                command=motion.command,
                position=motion.command,
                enabled=motion.enabled,
            )
            for index, (name, motion) in enumerate(motions)
        ),
    )
    rollouts = Rollouts(chain, imagined, dt=dt, device=device)
    old = np.arange(len(rollouts.sample_trajectory)) < sum(len(trajectory.time) for trajectory in known)
    owner = np.array([""] * len(known) + [name for name, _ in motions])[rollouts.sample_trajectory]
    index = chain.joints.index(joint)
    rows, free = [], []
    for model in models.values():
        columns = _free(chain, model, index)
        free.append(columns)
        rows.append(model)
        for column in columns:
            changed = model.copy()
            changed[index, column] *= 1.0 + STEP
            rows.append(changed)
    predicted = rollouts.predict(np.array(rows))[:, :, index].astype(float)
    curves, slopes, place = [], [], 0
    for columns in free:
        curves.append(predicted[place])
        slopes.append((predicted[place + 1 : place + 1 + len(columns)] - predicted[place]) / STEP)
        place += 1 + len(columns)
    left = rollouts.measured[old, index]
    count = len(models)
    plain_first = PLAIN in models  # then every effect is one of many, and is compared with none
    pairs = (
        [(0, b) for b in range(1, count)] if plain_first else list(itertools.combinations(range(count), 2))
    )
    result: dict[str, list[float]] = {}
    for name in menu:
        new = owner == name
        rivals = [
            _Rival(left - curve[old], curve[new], np.concatenate([slope[:, old], slope[:, new]], axis=1))
            for curve, slope in zip(curves, slopes, strict=True)
        ]
        result[name] = [_left_over(rivals[a], rivals[b], floor) for a, b in pairs]
    return result


def _free(chain: Chain, rows: np.ndarray, joint: int) -> list[int]:
    """Columns that a fit of the model could change: the baseline's and those of effects that act."""
    columns = [p.column for p in BASELINE if p.name in chain.baseline_free]
    for effect in EFFECTS.values():
        columns += [p.column for p in effect.parameters if rows[joint, p.column] != p.neutral]
    if servo.GRAVITY_TORQUE not in columns and "tau_g_nm" in chain.baseline_free:
        columns.append(servo.GRAVITY_TORQUE)
    return [column for column in columns if rows[joint, column] != 0.0]


def _known(recording: Recording, joint: str) -> tuple[Trajectory, ...]:
    """Recorded motions of the joint that a refit has to go on explaining, the shortest first."""
    own = sorted((t for t in recording.trajectories if joint in t.joints), key=lambda t: t.time[-1])
    ends = np.cumsum([t.time[-1] for t in own])
    return tuple(own[: max(int(np.searchsorted(ends, KNOWN_S, side="right")), 1)])


@dataclass(frozen=True)
class _Rival:
    """A model in question: K samples that are recorded, then M imagined ones, P parameters."""

    recorded: np.ndarray
    """What it leaves of the recording [K] [rad]."""
    imagined: np.ndarray
    """What it predicts of new motions [M] [rad]."""
    slopes: np.ndarray
    """Change of its predictions with the logarithm of each parameter [P, K + M] [rad]."""


def _left_over(a: _Rival, b: _Rival, floor: float) -> float:
    """What two models say differently about new motions once both have been refitted.

    Each may change its parameters as far as it goes on explaining what is recorded; the changes are those
    that bring the two together. What one explains worse of the recording is known, and tells nothing new.

    Args:
        a: A model.
        b: Its rival.
        floor: Noise floor [rad].

    Returns:
        RMS of their difference [rad].
    """
    known, new, count = len(a.recorded), len(a.imagined), len(a.slopes)
    blank = np.zeros((known, count)), np.zeros((known, len(b.slopes)))
    # One sigma of a parameter weighs as one floor on all samples.
    ridge = math.sqrt(new) * floor / UNCERTAINTY
    system = np.block(
        [
            [a.slopes[:, :known].T, blank[1]],
            [blank[0], b.slopes[:, :known].T],
            [a.slopes[:, known:].T, -b.slopes[:, known:].T],
        ]
    )
    target = np.concatenate([a.recorded, b.recorded, b.imagined - a.imagined])
    free = count + len(b.slopes)
    bounded = np.concatenate([system, ridge * np.eye(free)]), np.concatenate([target, np.zeros(free)])
    left = target - system @ np.linalg.lstsq(*bounded, rcond=None)[0]
    worse = abs(float(np.sum(left[:known] ** 2) - np.sum(left[known : 2 * known] ** 2))) / max(known, 1)
    return math.sqrt(max(float(np.mean(left[2 * known :] ** 2)) - worse, 0.0))


def _sentence(best: Score, report: Report, joints: tuple[str, ...]) -> str:
    sets = [list(dict.fromkeys(map(plain, group))) for group in report.open_sets]
    one = listing(sets[0]) if len(sets) == 1 else ""  # several are listed by themselves
    if best.told == 0:
        goal = f"decide between {one}" if one else "decide" if sets else "show more than these do"
        return (
            f"No motion of the menu would {goal}: on all of them the models in question differ by less than "
            f"{VISIBLE:g} times the noise floor, so either serves in simulation. To decide, record another "
            f"quantity, such as current or an external sensor. The best of the menu is in {PLAN_FOLDER}/."
        )
    goal = f" to decide between {one}" if one else "" if sets else " to see what these motions do not show"
    shows = f"there the models in question differ by {best.floors:.1f} times the noise floor"
    if best.pairs > 1:
        shows = f"that tells {best.told} of {best.pairs} pairs of possible models apart"
    return (
        f"Record {CONCLUSIONS[best.name]} on {joints_text(joints)} ({best.seconds:.0f} s){goal}: {shows}. "
        f"The commands are in {PLAN_FOLDER}/; add what was measured to the recording and run vd-gap again."
    )


def _csv(motion: Excitation, joints: Sequence[str]) -> str:
    off = not motion.enabled.all()
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["t", *(f"command.{j}" for j in joints), *(f"enabled.{j}" for j in joints if off)])
    for row, time in enumerate(motion.time):
        cells = [f"{time:.6f}", *(f"{value:.6f}" for value in motion.command[row])]
        writer.writerow(cells + ([str(int(on)) for on in motion.enabled[row]] if off else []))
    return text.getvalue()
