"""Put the explanations of all joints together: shared effects, pooled numbers, one verdict, curves."""

import importlib.metadata
import platform
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vd.assets_usd.hand_data import HandModel
from vd.gap.coordinates import BASELINE_PARAMETERS, GRAVITY, Scales
from vd.gap.design import varied
from vd.gap.explanation import Accepted, Explanation
from vd.gap.fit import FINER
from vd.gap.recording import Recording
from vd.gap.result import (
    Alternative,
    Candidate,
    Estimate,
    Finding,
    Fit,
    HeldOut,
    JointGap,
    LeftOut,
    NamedEffect,
    Predictions,
    Report,
    Source,
    TrajectoryError,
    Verdict,
)
from vd.gap.rollout import Rollouts
from vd.gap.statistics import interval, resamples, rmse
from vd.gap.worker_pool import JointSpec, Problems
from vd.kernels.servo.effects import EFFECTS, TOGETHER, equivalent

CLOSE = 0.1
"""Values of one effect on two joints within this share of each other are one value."""
VERDICTS: tuple[Verdict, ...] = ("effects", "ambiguous", "unknown", "under_excited", "no_gap")
"""The verdict of a recording is the first that some joint has."""


@dataclass(frozen=True, eq=False)
class Analysed:
    """A joint, its data and its explanation."""

    name: str
    spec: JointSpec
    explanation: Explanation
    scales: Scales


@dataclass(frozen=True, eq=False)
class Errors:
    """Sums of squared and absolute errors of one joint in what was analysed of each trajectory [S]."""

    trajectories: np.ndarray
    count: np.ndarray
    baseline: np.ndarray
    identified: np.ndarray
    baseline_abs: np.ndarray
    identified_abs: np.ndarray


def curves(
    recording: Recording, problems: Problems, models: Sequence[tuple[str, JointSpec, np.ndarray]]
) -> np.ndarray:
    """Positions of all trajectories one after the other [S, J] [rad]; NaN where no joint was fitted.

    They are simulated with the time step at which an estimate is finished.

    Args:
        recording: The recording.
        problems: Its chains.
        models: Name, problem and parameter rows of each fitted joint.
    """
    total = sum(len(t.time) for t in recording.trajectories)
    result = np.full((total, len(recording.joints)), np.nan)
    for index, chain in enumerate(problems.chains):
        fitted = [(spec, rows) for _, spec, rows in models if spec.chain == index]
        if not fitted:
            continue
        rows = chain.start_row.copy()
        for spec, own in fitted:
            rows[spec.joint] = own[spec.joint]
        rollouts = Rollouts(chain, recording, dt=problems.dt / FINER[-1], device=problems.device)
        predicted = rollouts.predict(rows[None])[0]
        result[:, chain.columns] = predicted
    return result


def assemble(
    recording: Recording,
    hand: HandModel | None,
    problems: Problems,
    joints: Sequence[Analysed],
    findings: Sequence[Finding],
    *,
    seed: int,
    seconds: float,
    simulated: int,
) -> tuple[Report, Predictions]:
    """The report of all joints, and the curves of its figures."""
    before = curves(recording, problems, [(j.name, j.spec, j.explanation.baseline.rows) for j in joints])
    after = curves(recording, problems, [(j.name, j.spec, j.explanation.final.rows) for j in joints])
    predictions = _predictions(recording, before, after)
    rng = np.random.default_rng(seed)
    errors = {j.name: _errors(j, predictions) for j in joints}
    verdicts = [j.explanation.verdict for j in joints]
    named = _pool(joints, named=True)
    report = Report(
        verdict=next((v for v in VERDICTS if v in verdicts), "no_gap"),
        noise_floor_rad=float(np.sqrt(np.mean([j.spec.floor**2 for j in joints]))),
        baseline=_fit(joints, predictions, predictions.baseline, "baseline"),
        findings=tuple(findings),
        effects=named,
        ambiguous=_sets(joints),
        identified=_fit(joints, predictions, predictions.identified, "final"),
        held_out=_held_out(recording, list(errors.values()), rng),
        next_experiment=_next(joints, recording.model),
        seconds=seconds,
        recording=_source(recording, joints),
        provisional=_pool(joints, named=False),
        hand=None if hand is None else hand.name,
        hand_layer=None if hand is None or hand.layer is None else str(hand.layer),
        joints=tuple(_gap(j, errors[j.name], rng) for j in joints),
        evidence=tuple(c for j in joints for c in _evidence(j)),
        trajectories=tuple(e for j in joints for e in _trajectories(recording, j, errors[j.name])),
        rollouts=simulated,
        rollouts_per_s=simulated / max(seconds, 1e-9),
        seed=seed,
        software={
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in ("warp-lang", "newton", "cma", "numpy")},
        },
    )
    return report, predictions


def _predictions(recording: Recording, before: np.ndarray, after: np.ndarray) -> Predictions:
    parts = recording.trajectories
    return Predictions(
        time=np.concatenate([t.time for t in parts]),
        trajectory=np.repeat(np.arange(len(parts)), [len(t.time) for t in parts]),
        command=np.concatenate([t.command for t in parts]),
        measured=np.concatenate([t.position for t in parts]),
        baseline=before,
        identified=after,
        joints=recording.joints,
        files=tuple(t.file for t in parts),
    )


def _excited(joint: Analysed, predictions: Predictions) -> np.ndarray:
    """Indices of the trajectories that excite a joint."""
    column = predictions.joints.index(joint.name)
    own = []
    for index in range(len(predictions.files)):
        rows = predictions.trajectory == index
        others = np.ptp(predictions.command[rows], axis=0)
        if others[column] > 0.0:
            own.append(index)
    return np.array(own)


def _analysed(joint: Analysed, predictions: Predictions, index: int) -> np.ndarray:
    """The samples of a trajectory that were analysed for a joint, or all if none was fitted."""
    rows = np.flatnonzero(predictions.trajectory == index)
    parts = dict(zip(joint.spec.trajectories, joint.spec.pieces, strict=bool(joint.spec.pieces)))
    first, end = parts.get(index, (0, len(rows)))
    return rows[first:end]


def _errors(joint: Analysed, predictions: Predictions) -> Errors:
    """Held-out errors where the trajectory was in a fold, errors of the full fit where it was in no fit."""
    column = predictions.joints.index(joint.name)
    own = _excited(joint, predictions)
    samples = {int(i): _analysed(joint, predictions, int(i)) for i in own}
    count = np.array([len(rows) for rows in samples.values()], float)
    squares, absolutes = [], []
    for fit, curve in (
        (joint.explanation.baseline, predictions.baseline),
        (joint.explanation.final, predictions.identified),
    ):
        absolute = np.full(len(fit.held_out), np.nan) if fit.held_out_abs is None else fit.held_out_abs
        pairs = zip(fit.held_out, absolute, strict=True)
        known = dict(zip(joint.spec.trajectories, pairs, strict=True))
        sums = []
        for i, rows in samples.items():
            free = predictions.measured[rows, column] - curve[rows, column]
            sums.append(known.get(i, (float(free @ free), float(np.abs(free).sum()))))
        squares.append(np.array([pair[0] for pair in sums]))
        absolutes.append(np.array([pair[1] for pair in sums]))
    return Errors(own, count, *squares, *absolutes)


def _fit(joints: Sequence[Analysed], predictions: Predictions, curve: np.ndarray, which: str) -> Fit:
    """Errors on everything analysed, and the baseline's parameters, of one of the two models."""
    residuals = {}
    for joint in joints:
        column = predictions.joints.index(joint.name)
        rows = np.concatenate([_analysed(joint, predictions, int(i)) for i in _excited(joint, predictions)])
        residuals[joint.name] = predictions.measured[rows, column] - curve[rows, column]
    everything = np.concatenate(list(residuals.values()))
    return Fit(
        rmse_rad=float(np.sqrt(np.mean(everything**2))),
        per_joint={name: float(np.sqrt(np.mean(r**2))) for name, r in residuals.items()},
        mae_rad=float(np.mean(np.abs(everything))),
        parameters={j.name: _baseline_values(j, which) for j in joints},
    )


def _baseline_values(joint: Analysed, which: str) -> dict[str, float]:
    fit = getattr(joint.explanation, which)
    rows, names = fit.rows, ["kp", "kd", "velocity_limit"]
    names += [n for n in ("inertia", "kd_off") if n in joint.spec.baseline]
    # A pendulum's known load is not fitted, but without it the rest means nothing.
    if "gravity_load" not in fit.effects and rows[joint.spec.joint, GRAVITY.column] > 0.0:
        names.append(GRAVITY.name)
    return {name: float(rows[joint.spec.joint, BASELINE_PARAMETERS[name].column]) for name in names}


def _ratio(errors: Sequence[Errors], rng: np.random.Generator) -> tuple[float, float, float, np.ndarray]:
    """RMSE before and after, reduction, and its bootstrap samples, over trajectories of all joints."""
    count, old, new = (
        np.concatenate([getattr(e, name) for e in errors]) for name in ("count", "baseline", "identified")
    )
    weights = resamples(len(count), rng)
    samples = 1.0 - rmse(new, count, weights) / np.maximum(rmse(old, count, weights), 1e-30)
    before, after = float(rmse(old, count)), float(rmse(new, count))
    return before, after, 1.0 - after / max(before, 1e-30), samples


def _held_out(recording: Recording, errors: Sequence[Errors], rng: np.random.Generator) -> HeldOut:
    before, after, reduction, samples = _ratio(errors, rng)
    used = sorted({int(i) for e in errors for i in e.trajectories})
    files = tuple(recording.trajectories[i].file for i in used)
    count, old, new, where = (
        np.concatenate([getattr(e, name) for e in errors])
        for name in ("count", "baseline_abs", "identified_abs", "trajectories")
    )
    conditions = [recording.trajectories[int(i)].conditions for i in where]
    condition = varied([recording.trajectories[i] for i in used])
    values = [str(each.get(condition)) for each in conditions] if condition else []
    left_out = []
    for value in sorted(set(values)):
        of = np.array(values) == value
        total = float(count[of].sum())
        left_out.append(
            LeftOut(str(condition), value, float(old[of].sum()) / total, float(new[of].sum()) / total)
        )
    return HeldOut(
        files,
        before,
        after,
        reduction,
        interval(samples),
        baseline_mae_rad=float(old.sum() / count.sum()),
        identified_mae_rad=float(new.sum() / count.sum()),
        left_out=tuple(left_out),
    )


def _gap(joint: Analysed, errors: Errors, rng: np.random.Generator) -> JointGap:
    weights = resamples(len(errors.count), rng)
    return JointGap(
        joint=joint.name,
        noise_floor_rad=joint.spec.floor,
        baseline_rmse_rad=float(rmse(errors.baseline, errors.count)),
        baseline_ci95=interval(rmse(errors.baseline, errors.count, weights)),
        identified_rmse_rad=float(rmse(errors.identified, errors.count)),
        identified_ci95=interval(rmse(errors.identified, errors.count, weights)),
        verdict=joint.explanation.verdict,
        reason=joint.explanation.reason,
        open_sets=_open_sets(joint),
    )


def _pool(joints: Sequence[Analysed], *, named: bool) -> tuple[NamedEffect, ...]:
    """Named (or provisional) effects, those of several joints in one entry where their values agree."""
    result: list[NamedEffect] = []
    order = list(EFFECTS)
    found: dict[str, list[tuple[str, Accepted]]] = {}
    for joint in joints:
        if joint.explanation.verdict not in ("effects", "ambiguous"):
            continue
        for accepted in joint.explanation.accepted:
            if accepted.named == named:
                found.setdefault(accepted.name, []).append((joint.name, accepted))
    for name in sorted(found, key=lambda n: (-len(found[n]), order.index(n))):
        groups: list[list[tuple[str, Accepted]]] = []
        for item in found[name]:
            group = next((g for g in groups if all(_agree(item[1], other) for _, other in g)), None)
            if group is None:
                groups.append([item])
            else:
                group.append(item)
        result += [_entry(name, group) for group in groups]
    return tuple(result)


def _agree(one: Accepted, other: Accepted) -> bool:
    """Whether the values of an effect on two joints can be the same."""
    if one.estimates.keys() != other.estimates.keys():
        return False
    for key, (value, low, high) in one.estimates.items():
        theirs, their_low, their_high = other.estimates[key]
        overlap = low <= their_high and their_low <= high
        near = abs(value - theirs) <= CLOSE * max(abs(value), abs(theirs))
        if not (overlap or near):
            return False
    return True


def _entry(name: str, group: Sequence[tuple[str, Accepted]]) -> NamedEffect:
    """One effect of joints that agree, its numbers weighted by their precision."""
    units = {p.name: p.unit for p in EFFECTS[name].parameters}
    bounds = {p.name: -np.inf if p.signed else 0.0 for p in EFFECTS[name].parameters}
    parameters = {}
    for key in group[0][1].estimates:
        values = np.array([accepted.estimates[key] for _, accepted in group])
        width = np.maximum(0.5 * (values[:, 2] - values[:, 1]), 1e-12)
        weight = width**-2 / np.sum(width**-2)
        value = float(weight @ values[:, 0])
        below = float(np.sqrt(np.sum((weight * (values[:, 0] - values[:, 1])) ** 2)))
        above = float(np.sqrt(np.sum((weight * (values[:, 2] - values[:, 0])) ** 2)))
        # No narrower than the joints' own values lie apart from the pooled one.
        apart = float(np.sqrt(weight @ (values[:, 0] - value) ** 2 / max(len(group) - 1, 1)))
        below, above = max(below, 2.0 * apart), max(above, 2.0 * apart)
        parameters[key] = Estimate(value, (max(value - below, bounds[key]), value + above), units[key])
    best = max(group, key=lambda item: item[1].confidence)[1]
    return NamedEffect(
        name=name,
        joints=tuple(joint for joint, _ in group),
        confidence=float(np.mean([accepted.confidence for _, accepted in group])),
        parameters=parameters,
        alternatives=tuple(Alternative(other, error, ci) for other, error, ci in best.alternatives),
        at_bound=any(accepted.at_bound for _, accepted in group),
    )


def _sets(joints: Sequence[Analysed]) -> tuple[tuple[str, ...], ...]:
    """Sets of effects not told apart, each once."""
    result: list[tuple[str, ...]] = []
    for joint in joints:
        if joint.explanation.verdict not in ("effects", "ambiguous"):
            continue
        for accepted in joint.explanation.accepted:
            members = (accepted.name, *accepted.equivalent, *accepted.tied)
            open_ = accepted.tied and not accepted.named
            if (open_ or accepted.equivalent) and not any(set(members) == set(s) for s in result):
                result.append(members)
    return tuple(result)


def _open_sets(joint: Analysed) -> tuple[tuple[str, ...], ...]:
    """The sets of one joint that another recording can split."""
    if joint.explanation.verdict not in ("effects", "ambiguous"):
        return ()
    accepted = joint.explanation.accepted
    return tuple((one.name, *one.tied) for one in accepted if one.tied and not one.named)


def _next(joints: Sequence[Analysed], model: str) -> str:
    named = {a.name for j in joints for a in j.explanation.accepted if a.named}
    same = equivalent(model, named)
    closed = {n: {*same.get(n, ()), *(TOGETHER.get(n, ()) if n in named else ())} for n in EFFECTS}
    sets = [group for group in _sets(joints) if set(group[1:]) - closed[group[0]]]
    if sets:
        listed = " and ".join(name.replace("_", " ") for name in sets[0][:2])
        return (
            f"vd-gap plan writes the motion on which {listed} differ the most: record it and analyse again."
        )
    if any(j.explanation.verdict == "under_excited" for j in joints):
        return "Record larger and faster motions: steps, and sines up to 1.5 Hz, on every joint."
    return ""


def _source(recording: Recording, joints: Sequence[Analysed]) -> Source:
    parts = recording.trajectories
    return Source(
        path=str(recording.path),
        model=recording.model,
        joints=tuple(j.name for j in joints),
        trajectories=len(parts),
        samples=sum(len(t.time) for t in parts),
        seconds=float(sum(t.time[-1] for t in parts)),
        servo=str(recording.servo.get("model", "")),
    )


def _evidence(joint: Analysed) -> list[Candidate]:
    return [
        Candidate(
            joints=(joint.name,),
            round=trial.round,
            name=trial.name,
            held_out_rmse_rad=trial.fit.held_out_rmse,
            gain=trial.gain,
            gain_ci95=trial.gain_ci,
            decision=trial.decision,  # type: ignore[arg-type]
            reason=trial.reason,
            parameters={
                key.rpartition(".")[2]: value
                for key, value in trial.fit.values.items()
                if key.startswith(f"{trial.name}.")
            },
            placebo=trial.placebo,
            given=tuple(name for name in trial.fit.effects if name != trial.name),
        )
        for trial in joint.explanation.trials
    ]


def _trajectories(recording: Recording, joint: Analysed, errors: Errors) -> list[TrajectoryError]:
    sums = errors.baseline, errors.identified, errors.baseline_abs, errors.identified_abs
    rows = zip(errors.trajectories, errors.count, zip(*sums, strict=True), strict=True)
    return [
        TrajectoryError(
            file=recording.trajectories[int(i)].file,
            excitation=recording.trajectories[int(i)].excitation,
            joint=joint.name,
            held_out=True,
            baseline_rmse_rad=float(np.sqrt(old / count)),
            identified_rmse_rad=float(np.sqrt(new / count)),
            baseline_mae_rad=float(old_abs / count),
            identified_mae_rad=float(new_abs / count),
        )
        for i, count, (old, new, old_abs, new_abs) in rows
    ]
