"""Experiment the next experiment: the motions on which the models that are still possible disagree most.

Every set of motions of the menu is simulated under every model in question. The disagreement of two
models is the criterion of Buzzi-Ferraris and Forzatti (1983) for telling rivals apart: the
difference of their predictions in units of the noise, less what the uncertainty of their parameters
explains, which the recorded motions bound. Noise is all that the identified model leaves of them.
The set of motions on which the models disagree most is proposed.
"""

import contextlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vd.command.config import to_dict
from vd.command.files import write_json
from vd.gap.chain import Chain, chains
from vd.gap.coordinates import BASELINE_PARAMETERS
from vd.gap.design import design, pieces
from vd.gap.fit import FINER
from vd.gap.result import Report, effect_values, parameters_of
from vd.gap.rollout import STEP_S, Rollouts
from vd.gap.rules import candidates
from vd.gap.statistics import REPEATABLE
from vd.gap.words import causes, joints_text
from vd.kernels.servo.effects import EFFECTS
from vd.logs.excitations import MENU, JointRange, excitation_set, numbered
from vd.logs.recording import BARE_MODELS, Recording, Trajectory, entry_of, write_table
from vd.logs.recording_checks import MIN_KINDS

if TYPE_CHECKING:
    from vd.assets_usd.hand_model import HandModel

FORMAT = "vd-experiment/1"
PLAN_JSON = "next_experiment.json"
PLAN_FOLDER = "next_experiment"
UNCERTAINTY = 0.1
"""Relative standard deviation of the parameters of a model before any data. Not tuned."""
PLAIN = "plain servo"
"""The model without any further effect."""


@dataclass(frozen=True)
class MenuScore:
    """What a set of motions would show."""

    name: str
    """Key of :data:`vd.logs.excitations.MENU`."""
    disagreement: float
    """Of two models, RMS in units of the noise; of several pairs the one at which as much is
    learnt, which is log(1 + disagreement^2) in the mean."""
    seconds: float
    """Length of all its motions."""


@dataclass(frozen=True)
class Experiment:
    """The next experiment."""

    model: str
    joints: tuple[str, ...]
    """All joints of the recording; commands name every one of them."""
    competing: dict[str, tuple[tuple[str, ...], ...]]
    """Sets of models in question, by joint."""
    ranking: tuple[MenuScore, ...]
    """Best first."""
    motions: tuple[Trajectory, ...]
    """Of the best set."""
    sentence: str


def plan(
    report: Report,
    recording: Recording,
    hand: "HandModel | None",
    start: Mapping[str, np.ndarray] | None = None,
    *,
    device: str = "cpu",
) -> Experiment:
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
    targets, menu = _targets(report), _menu(recording, hand)
    noise = {one.joint: max(one.noise_floor_rad, one.identified_rmse_rad) for one in report.joints}
    found: dict[str, list[float]] = {name: [] for name in menu}
    competing: dict[str, tuple[tuple[str, ...], ...]] = {}
    for chain in chains(recording, hand):
        base = _base(chain, report, start or {})
        for joint, group in (
            (name, group) for name in chain.joints for group in targets.get(name, ())
        ):
            models = _models(report, chain, joint, base, group)
            competing[joint] = (*competing.get(joint, ()), tuple(models))
            own = {
                name: [m for m in motions if m.joints == (joint,)] for name, motions in menu.items()
            }
            for name, values in _compare(
                chain, recording, own, joint, models, noise[joint], device
            ).items():
                found[name] += values
    if not competing:
        raise ValueError(f"{recording.path}: no joint has a fitted model; run vd-gap explain first")
    motions = {name: [m for m in every if m.joints[0] in competing] for name, every in menu.items()}
    scores = [
        MenuScore(
            name,
            disagreement=float(np.sqrt(np.expm1(np.mean(np.log1p(np.square(values)))))),
            seconds=sum(motion.duration for motion in motions[name]),
        )
        for name, values in found.items()
    ]
    ranking = tuple(sorted(scores, key=lambda score: -score.disagreement))
    kinds = len({t.excitation for t in recording.trajectories})
    sentence = _sentence(ranking[0], report, tuple(competing), kinds)
    chosen = tuple(motions[ranking[0].name])
    return Experiment(recording.model, recording.joints, competing, ranking, chosen, sentence)


def write_plan(result: Experiment, folder: Path) -> Path:
    """Write ``next_experiment.json`` and its commands, one CSV file per motion.

    A CSV has the header of a recording without what is measured: ``t``, ``command.<joint>`` for
    every joint and, where the torque is switched off, ``enabled.<joint>``.

    Returns:
        The JSON file.
    """
    discard_plan(folder)
    path, entries = Path(folder) / PLAN_JSON, []
    for motion in numbered(result.motions):
        entries.append(entry_of(replace(motion, file=f"{PLAN_FOLDER}/{motion.file}")))
        write_table(
            Path(folder) / entries[-1]["file"], motion, result.joints, ("command", "enabled")
        )
    contents = {name: value for name, value in vars(result).items() if name != "motions"}
    contents |= {"format": FORMAT, "excitation": result.ranking[0].name, "trajectories": entries}
    write_json(path, to_dict(contents))
    return path


def discard_plan(folder: Path) -> None:
    """Remove a plan that :func:`write_plan` wrote, and no other file."""
    for file in (
        Path(folder) / PLAN_JSON,
        *(Path(folder) / PLAN_FOLDER).glob("[0-9][0-9][0-9]_*.csv"),
    ):
        file.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # something else is in it, or it is not there
        (Path(folder) / PLAN_FOLDER).rmdir()


def _targets(report: Report) -> dict[str, tuple[tuple[str, ...], ...]]:
    """Fitted joints in question with the sets of effects that compete on each.

    An empty set is of all.
    """
    targets = {one.joint: one.open_sets for one in report.joints if one.open_sets}
    if not targets:
        shaky = [one.joint for one in report.joints if one.verdict not in ("effects", "no_gap")]
        targets = {joint: ((),) for joint in shaky or report.recording.joints}
    return {
        joint: groups for joint, groups in targets.items() if joint in report.identified.parameters
    }


def _menu(recording: Recording, hand: "HandModel | None") -> dict[str, list[Trajectory]]:
    """The menu for this machine, under the conditions that its recording has throughout.

    Joints move in the hand's range, or in that of the commands before. Only a pendulum's load is
    modelled.
    """
    parts = recording.trajectories
    common = {
        key: float(value) if isinstance(value, int) else value
        for key, value in parts[0].conditions.items()
        if all(t.conditions.get(key) == value for t in parts)
    }
    commands = np.concatenate([t.command for t in parts])
    lower, upper = commands.min(axis=0), commands.max(axis=0)
    if hand is not None:
        index = [hand.joint_names.index(name) for name in recording.joints]
        lower, upper = hand.lower[index], hand.upper[index]
    gain = max(
        (float(t.conditions["p_gain"]) for t in parts if "p_gain" in t.conditions), default=1.0
    )
    load, names = common.get("payload_kg"), list(MENU)
    if (
        recording.model not in BARE_MODELS
        or not isinstance(load, float)
        or "arm_length_m" not in common
    ):
        load = 0.0
        names.remove("second_payload")
    reach = JointRange(recording.joints, lower, upper, gain, (load, 2.0 * load))
    return {
        name: [
            replace(m, conditions={**common, **m.conditions})
            for m in excitation_set(reach, (name,))
        ]
        for name in names
    }


def _base(chain: Chain, report: Report, start: Mapping[str, np.ndarray]) -> np.ndarray:
    """Parameter rows of the chain as identified so far, shape [n, P]."""
    given = [start.get(name, row) for name, row in zip(chain.joints, chain.start_row, strict=True)]
    rows = np.array(given, dtype=float)
    for row, joint in zip(rows, chain.joints, strict=True):
        for column, value in parameter_columns(report, joint).items():
            row[column] = value
    return rows


def parameter_columns(report: Report, joint: str) -> dict[int, float]:
    """Columns of the joint's parameter row (:mod:`vd.kernels.servo.actuators`) that the report identified."""
    baseline = report.identified.parameters.get(joint, {})
    columns = {BASELINE_PARAMETERS[name].column: value for name, value in baseline.items()}
    for effect, values in effect_values((*report.effects, *report.provisional), joint).items():
        columns |= {
            parameters_of(effect)[name].column: value for name, (value, *_) in values.items()
        }
    return columns


def _models(
    report: Report, chain: Chain, joint: str, base: np.ndarray, group: Sequence[str]
) -> dict[str, np.ndarray]:
    """Parameter rows [n, P] of every model in question, by name."""
    index, base = chain.joints.index(joint), base.copy()

    def having(name: str, values: Mapping[str, float]) -> np.ndarray:
        rows = base.copy()
        for key, parameter in parameters_of(name).items():
            rows[index, parameter.column] = values.get(key, parameter.typical)
        return rows

    if (
        len(group) < 2
    ):  # nothing in particular competes: which motion would show the most of everything?
        return {
            PLAIN: base,
            **{name: having(name, {}) for name in candidates(chain, tuple(EFFECTS))},
        }
    for parameter in (p for name in group for p in EFFECTS[name].parameters):
        base[index, parameter.column] = parameter.neutral  # one of them stands in the model for all
    held = {e.name for e in (*report.effects, *report.provisional) if joint in e.joints} - {*group}
    return {name: having(name, _fitted(report, joint, name, held)) for name in group}


def _fitted(report: Report, joint: str, name: str, given: set[str]) -> dict[str, float]:
    """Parameters of an effect on a joint as they were fitted beside the effects given, or else last."""
    rows = [
        row
        for row in report.evidence
        if row.name == name and joint in row.joints and row.parameters
    ]
    beside = [row for row in rows if {*row.given} == given]
    return (beside or rows)[-1].parameters if rows else {}


def _compare(
    chain: Chain,
    recording: Recording,
    menu: Mapping[str, Sequence[Trajectory]],
    joint: str,
    models: Mapping[str, np.ndarray],
    noise: float,
    device: str,
) -> dict[str, list[float]]:
    """Disagreement of every two rivals, or of each and the plain servo, on each set of motions."""
    index = chain.joints.index(joint)
    known = _analysed(recording, chain, index)
    owner = [""] * len(known) + [name for name, new in menu.items() for _ in new]
    everything = replace(recording, trajectories=(*known, *itertools.chain(*menu.values())))
    # Rivals of a set differ by less than a delay of the fit's own step.
    step = STEP_S if PLAIN in models else STEP_S / FINER[-1]
    rollouts = Rollouts(chain, everything, dt=step, device=device)
    of = np.array(owner)[rollouts.sample_trajectory]
    varied = [_varied(chain, rows, index) for rows in models.values()]
    predicted = rollouts.predict(np.concatenate(varied))[:, :, index].astype(float) / noise
    ends = np.cumsum([len(rows) for rows in varied])[:-1]
    measured = rollouts.measured[:, index] / noise
    rivals = [
        Rival.of(curves, measured, of == "", len(known)) for curves in np.split(predicted, ends)
    ]
    pairs = list(itertools.combinations(rivals, 2))
    if PLAIN in models:  # then every effect is one of many
        pairs = [(rivals[0], other) for other in rivals[1:]]
    return {name: [disagreement(a, b, of == name) for a, b in pairs] for name in menu}


def _analysed(recording: Recording, chain: Chain, joint: int) -> tuple[Trajectory, ...]:
    """What the joint was fitted to."""
    chosen, _ = design(recording, chain, joint)
    parts = pieces(recording, chain, chosen)
    cut = recording.cut(dict(zip(chosen, parts, strict=True)) if parts else {})
    return tuple(cut.trajectories[i] for i in chosen)


def _varied(chain: Chain, rows: np.ndarray, joint: int) -> np.ndarray:
    """A model, and it with each parameter that a fit could change one standard deviation up [1 + P, n, C]."""
    columns = [BASELINE_PARAMETERS[name].column for name in chain.baseline_free]
    effects = (p for effect in EFFECTS.values() for p in effect.parameters)
    columns += [p.column for p in effects if rows[joint, p.column] != p.neutral]
    columns = [column for column in dict.fromkeys(columns) if rows[joint, column] != 0.0]
    result = np.tile(rows, (1 + len(columns), 1, 1))
    result[np.arange(1, len(result)), joint, columns] *= 1.0 + UNCERTAINTY
    return result


@dataclass(frozen=True, eq=False)
class Rival:
    """A model in question, refitted to what is recorded.

    S samples, recorded and imagined, P parameters.

    Errors within a motion are correlated: each recorded motion counts as one observation.

    Attributes:
        curve: Its positions [S] [noise].
        slopes: Their change with each parameter, one prior standard deviation [P, S] [noise].
        precision: Of the parameters, in those standard deviations, by prior and recording [P, P].
    """

    curve: np.ndarray
    slopes: np.ndarray
    precision: np.ndarray

    @staticmethod
    def of(curves: np.ndarray, measured: np.ndarray, recorded: np.ndarray, motions: int) -> "Rival":
        """From curves of the model and of it with each parameter changed [1 + P, S]."""
        slopes = curves[1:] - curves[0]
        left, own = (measured - curves[0])[recorded], slopes[:, recorded]
        weight = motions / len(left)
        precision = np.eye(len(own)) + weight * own @ own.T
        step = np.linalg.solve(precision, weight * own @ left)
        return Rival(curves[0] + step @ slopes, slopes, precision)


def disagreement(one: Rival, other: Rival, new: np.ndarray) -> float:
    """What two models say differently about new motions, their parameters adapted to each other's.

    Args:
        one: A model.
        other: Its rival.
        new: Samples of the new motions [S] bool; together they count as one observation.

    Returns:
        RMS of the difference, and how far the parameters had to go for it [noise].
    """
    apart = (other.curve - one.curve)[new]
    slopes = np.concatenate([one.slopes[:, new], -other.slopes[:, new]])
    pull = slopes @ apart / len(apart)
    stiffness = slopes @ slopes.T / len(apart)
    count = len(one.slopes)
    stiffness[:count, :count] += one.precision
    stiffness[count:, count:] += other.precision
    return float(
        np.sqrt(max(apart @ apart / len(apart) - pull @ np.linalg.solve(stiffness, pull), 0.0))
    )


def _sentence(best: MenuScore, report: Report, joints: tuple[str, ...], kinds: int) -> str:
    """What to record, and what it would show."""
    sets = report.open_sets
    between = f" between {causes(sets[0], 'and')}" if len(sets) == 1 else ""
    if best.disagreement < REPEATABLE:
        decide = "so either serves in simulation; another quantity may decide, current or an external sensor"
        if kinds < MIN_KINDS:
            decide = f"but here are {kinds} kinds of motion: record {MIN_KINDS} at least"
        return (
            f"No motion of the menu would decide{between}: on all of them the models in question "
            f"differ by less than {REPEATABLE:g} times the noise, {decide}. The best of the menu "
            f"is in {PLAN_FOLDER}/."
        )
    goal = f"to decide{between}" if sets else "to see what these motions do not show"
    return (
        f"Record the motions {best.name} on {joints_text(joints)}, {best.seconds:.0f} s, {goal}: "
        f"there the models in question differ by {best.disagreement:.1f} times the noise. The "
        f"commands are in {PLAN_FOLDER}/; add what was measured to the recording and run vd-gap "
        "again."
    )
