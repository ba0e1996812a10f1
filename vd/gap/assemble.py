"""Put the explanations of all joints together.

Shared effects, pooled numbers, one verdict, curves.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vd.gap.coordinates import BASELINE_PARAMETERS, GRAVITY
from vd.gap.fit import FINER, JointSpec, Problems
from vd.gap.models import Accepted, Explanation
from vd.gap.result import (
    Alternative,
    AnalysedRecording,
    Candidate,
    Estimate,
    Fit,
    HeldOut,
    JointGap,
    Misfit,
    NamedEffect,
    Predictions,
    Report,
    TrajectoryError,
    parameters_of,
)
from vd.gap.rollout import Rollouts
from vd.gap.rules import agree, answered, named, overall
from vd.gap.statistics import half_width, interval, resamples, rmse
from vd.kernels.servo.effects import EFFECTS
from vd.logs.recording import Recording


@dataclass(frozen=True, eq=False)
class Analysed:
    """A joint, its data and its explanation."""

    name: str
    spec: JointSpec
    explanation: Explanation


def curves(problems: Problems, models: Sequence[tuple[JointSpec, np.ndarray]]) -> np.ndarray:
    """Positions of all trajectories one after the other [S, J] [rad].

    NaN where no joint was fitted.

    They are simulated with the time step at which an estimate is finished.

    Args:
        problems: Of the recording.
        models: Problem and parameter rows of each fitted joint.
    """
    recording = problems.recording
    total = sum(len(t.time) for t in recording.trajectories)
    result = np.full((total, len(recording.joints)), np.nan)
    for index, chain in enumerate(problems.chains):
        own = {spec.joint: rows[spec.joint] for spec, rows in models if spec.chain == index}
        if own:
            rows = np.array([own.get(joint, row) for joint, row in enumerate(chain.start_row)])
            rollouts = Rollouts(
                chain, recording, dt=problems.dt / FINER[-1], device=problems.device
            )
            result[:, chain.columns] = rollouts.predict(rows[None])[0]
    return result


def assemble(
    problems: Problems,
    joints: Sequence[Analysed],
    findings: Sequence[Misfit],
    *,
    seed: int,
) -> tuple[Report, Predictions]:
    """The report of all joints, and the curves of its figures."""
    recording = problems.recording
    before = curves(problems, [(j.spec, j.explanation.baseline.rows) for j in joints])
    after = curves(problems, [(j.spec, j.explanation.final.rows) for j in joints])
    predictions = Predictions.of(recording, before, after)
    rng = np.random.default_rng(seed)
    residuals = {j.name: _residuals(j, predictions) for j in joints}
    rows = {j.name: _errors(j, residuals[j.name], recording) for j in joints}
    every = [row for j in joints for row in rows[j.name]]
    report = Report(
        verdict=overall([j.explanation.verdict for j in joints]),
        noise_floor_rad=float(np.sqrt(np.mean([j.spec.floor**2 for j in joints]))),
        baseline=_fit(joints, residuals, 0),
        findings=tuple(findings),
        effects=_pool(joints, True),
        ambiguous=_sets(joints),
        identified=_fit(joints, residuals, 1),
        held_out=_held_out(predictions.files, every, rng),
        next_experiment="",
        seconds=np.nan,
        recording=AnalysedRecording(
            path=str(recording.path),
            model=recording.model,
            joints=tuple(j.name for j in joints),
            trajectories=len(recording.trajectories),
            samples=len(predictions.time),
            seconds=float(sum(t.time[-1] for t in recording.trajectories)),
            servo=str(recording.servo.get("model", "")),
        ),
        provisional=_pool(joints, False),
        joints=tuple(_gap(j, rows[j.name], rng) for j in joints),
        evidence=tuple(c for j in joints for c in _evidence(j)),
        trajectories=tuple(every),
        seed=seed,
    )
    return report, predictions


def _residuals(joint: Analysed, predictions: Predictions) -> dict[int, np.ndarray]:
    """Measured minus simulated in what was analysed of each trajectory that moves a joint.

    Returns:
        By trajectory, shape [samples, 2] [rad]: of baseline and identified model, everything
            fitted.
    """
    spec, column = joint.spec, predictions.joints.index(joint.name)
    models = np.stack([predictions.baseline[:, column], predictions.identified[:, column]], axis=1)
    parts = dict(zip(spec.trajectories, spec.pieces, strict=True)) if spec.pieces else {}
    result = {}
    for index in range(len(predictions.files)):
        rows = np.flatnonzero(predictions.trajectory == index)
        if np.ptp(predictions.command[rows, column]) > 0.0:
            rows = rows[slice(*parts.get(index, (None,)))]
            result[index] = predictions.measured[rows, column, None] - models[rows]
    return result


def _errors(
    joint: Analysed, residuals: dict[int, np.ndarray], recording: Recording
) -> list[TrajectoryError]:
    """Held-out errors where the trajectory was in a fold, errors of the full fit where it was in no fit."""
    fits, result = (joint.explanation.baseline, joint.explanation.final), []
    for index, left in residuals.items():
        squares, absolutes = (left**2).mean(axis=0), np.abs(left).mean(axis=0)
        if index in joint.spec.trajectories:
            place = joint.spec.trajectories.index(index)
            squares = np.array([fit.held_out[place] for fit in fits]) / len(left)
            sums = [np.nan if fit.held_out_abs is None else fit.held_out_abs[place] for fit in fits]
            absolutes = np.array(sums) / len(left)
        part, (old, new), (old_abs, new_abs) = (
            recording.trajectories[index],
            np.sqrt(squares),
            absolutes,
        )
        errors = float(old), float(new), float(old_abs), float(new_abs)
        result.append(
            TrajectoryError(part.file, part.excitation, joint.name, *errors, samples=len(left))
        )
    return result


def _fit(
    joints: Sequence[Analysed], residuals: dict[str, dict[int, np.ndarray]], model: int
) -> Fit:
    """Errors on everything analysed, and the baseline's parameters, of one of the two models."""
    left = {name: np.concatenate([*of.values()])[:, model] for name, of in residuals.items()}
    everything = np.concatenate([*left.values()])
    return Fit(
        rmse_rad=float(np.sqrt(np.mean(everything**2))),
        per_joint={name: float(np.sqrt(np.mean(of**2))) for name, of in left.items()},
        mae_rad=float(np.mean(np.abs(everything))),
        parameters={j.name: _baseline_values(j, model) for j in joints},
    )


def _baseline_values(joint: Analysed, model: int) -> dict[str, float]:
    fit = (joint.explanation.baseline, joint.explanation.final)[model]
    row, names = fit.rows[joint.spec.joint], ["kp", "kd", "velocity_limit"]
    names += [n for n in ("inertia", "kd_off") if n in joint.spec.baseline]
    # A pendulum's known load is not fitted, but without it the rest means nothing.
    if "gravity_load" not in fit.effects and row[GRAVITY.column] > 0.0:
        names.append(GRAVITY.name)
    return {name: float(row[BASELINE_PARAMETERS[name].column]) for name in names}


def _sums(rows: Sequence[TrajectoryError]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples, and sums of squared errors of both models, of each trajectory [S]."""
    count = np.array([row.samples for row in rows], float)
    before, after = np.array([(row.baseline_rmse_rad, row.identified_rmse_rad) for row in rows]).T
    return count, count * before**2, count * after**2


def _held_out(
    files: Sequence[str], rows: Sequence[TrajectoryError], rng: np.random.Generator
) -> HeldOut:
    """Errors before and after, over trajectories of all joints."""
    count, old, new = _sums(rows)
    weights = resamples(len(count), rng)
    samples = 1.0 - rmse(new, count, weights) / np.maximum(rmse(old, count, weights), 1e-30)
    before, after = float(rmse(old, count)), float(rmse(new, count))
    used = {row.file for row in rows}
    return HeldOut(
        trajectories=tuple(file for file in files if file in used),
        baseline_rmse_rad=before,
        identified_rmse_rad=after,
        reduction=1.0 - after / max(before, 1e-30),
        ci95=interval(samples),
        baseline_mae_rad=float(np.average([row.baseline_mae_rad for row in rows], weights=count)),
        identified_mae_rad=float(
            np.average([row.identified_mae_rad for row in rows], weights=count)
        ),
    )


def _gap(joint: Analysed, rows: Sequence[TrajectoryError], rng: np.random.Generator) -> JointGap:
    count, old, new = _sums(rows)
    weights = resamples(len(count), rng)
    return JointGap(
        joint=joint.name,
        noise_floor_rad=joint.spec.floor,
        baseline_rmse_rad=float(rmse(old, count)),
        baseline_ci95=interval(rmse(old, count, weights)),
        identified_rmse_rad=float(rmse(new, count)),
        identified_ci95=interval(rmse(new, count, weights)),
        verdict=joint.explanation.verdict,
        reason=joint.explanation.reason,
        open_sets=tuple(
            _unique(one.name, *one.tied)
            for one in answered(joint.explanation)
            if one.tied and not named(one)
        ),
    )


def _pool(joints: Sequence[Analysed], as_named: bool) -> tuple[NamedEffect, ...]:
    """Named (or provisional) effects, those of several joints in one entry where their values agree."""
    groups: dict[str, list[dict[str, Accepted]]] = {}
    often: Counter[str] = Counter()
    for joint in joints:
        for accepted in answered(joint.explanation):
            if named(accepted) == as_named:
                often[accepted.name] += 1
                _put(groups.setdefault(accepted.name, []), joint.name, accepted)
    order = list(EFFECTS)
    names = sorted(groups, key=lambda name: (-often[name], order.index(name)))
    return tuple(_entry(name, group) for name in names for group in groups[name])


def _put(groups: list[dict[str, Accepted]], joint: str, accepted: Accepted) -> None:
    """Add a joint's effect to the joints with which it agrees, or to a group of its own."""
    for group in groups:
        if all(agree(accepted, other) for other in group.values()):
            group[joint] = accepted
            return
    groups.append({joint: accepted})


def _entry(name: str, group: dict[str, Accepted]) -> NamedEffect:
    """One effect of joints that agree, its numbers weighted by their precision."""
    known, every = parameters_of(name), list(group.values())
    parameters = {}
    for key in every[0].estimates:
        values, lows, highs = np.array([accepted.estimates[key] for accepted in every]).T
        weight = np.maximum(0.5 * (highs - lows), 1e-12) ** -2
        weight /= weight.sum()
        value = float(weight @ values)
        # No narrower than the joints' own, whose errors are one model's, nor than their values lie
        # apart.
        apart = half_width(weight @ (values - value) ** 2 / max(len(every) - 1, 1), len(every))
        below, above = (
            float(np.maximum(weight @ d, apart)) for d in (values - lows, highs - values)
        )
        low = max(value - below, -np.inf if known[key].signed else 0.0)
        parameters[key] = Estimate(value, (float(low), float(value + above)), known[key].unit)
    return NamedEffect(
        name=name,
        joints=tuple(group),
        confidence=float(np.mean([accepted.confidence for accepted in every])),
        parameters=parameters,
        alternatives=tuple(
            Alternative(*other)
            for other in max(every, key=lambda accepted: accepted.confidence).alternatives
        ),
    )


def _sets(joints: Sequence[Analysed]) -> tuple[tuple[str, ...], ...]:
    """Sets of effects not told apart, each once."""
    sets: dict[frozenset[str], tuple[str, ...]] = {}
    for joint in joints:
        for one in answered(joint.explanation):
            if (one.tied and not named(one)) or one.equivalent:
                members = _unique(one.name, *one.equivalent, *one.tied)
                sets.setdefault(frozenset(members), members)
    return tuple(sets.values())


def _unique(*names: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(names))


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
                key.partition(".")[2]: value
                for key, value in trial.fit.values.items()
                if key.startswith(f"{trial.name}.")
            },
            given=tuple(name for name in trial.fit.effects if name != trial.name),
        )
        for trial in joint.explanation.trials
    ]
