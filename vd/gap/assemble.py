"""Put the explanations of all joints together: shared effects, pooled numbers, one verdict, curves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np

from vd.gap.coordinates import BASELINE_PARAMETERS, GRAVITY
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
    NamedEffect,
    Predictions,
    Report,
    Source,
    TrajectoryError,
    Verdict,
    parameters_of,
)
from vd.gap.rollout import Rollouts
from vd.gap.statistics import interval, resamples, rmse
from vd.gap.worker_pool import JointSpec, Problems
from vd.kernels.servo.effects import EFFECTS

CLOSE = 0.1
"""Values of one effect on two joints within this share of each other are one value."""


@dataclass(frozen=True, eq=False)
class Analysed:
    """A joint, its data and its explanation."""

    name: str
    spec: JointSpec
    explanation: Explanation

    @property
    def found(self) -> tuple[Accepted, ...]:
        """Effects of its final model, where that is an answer."""
        answers = self.explanation.verdict in ("effects", "ambiguous")
        return self.explanation.accepted if answers else ()


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of one joint in what was analysed of each trajectory that moves it, S in all."""

    trajectories: tuple[int, ...]
    residuals: np.ndarray
    """Measured minus simulated with everything fitted [K, 2] [rad]; columns are baseline and identified."""
    count: np.ndarray
    """Samples [S]."""
    squares: np.ndarray
    """Sums of squared errors [S, 2] by models that have not seen the trajectory [rad^2]."""
    absolutes: np.ndarray
    """Sums of their absolute errors [S, 2] [rad]."""


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
        rows, fitted = chain.start_row.copy(), False
        for _, spec, own in models:
            if spec.chain == index:
                rows[spec.joint], fitted = own[spec.joint], True
        if fitted:
            rollouts = Rollouts(chain, recording, dt=problems.dt / FINER[-1], device=problems.device)
            result[:, chain.columns] = rollouts.predict(rows[None])[0]
    return result


def assemble(
    recording: Recording,
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
    predictions = Predictions.of(recording, before, after)
    rng = np.random.default_rng(seed)
    errors = {j.name: _errors(j, predictions) for j in joints}
    verdicts = [j.explanation.verdict for j in joints]
    report = Report(
        verdict=next((v for v in get_args(Verdict) if v in verdicts), "no_gap"),
        noise_floor_rad=float(np.sqrt(np.mean([j.spec.floor**2 for j in joints]))),
        baseline=_fit(joints, errors, 0),
        findings=tuple(findings),
        effects=_pool(joints, named=True),
        ambiguous=_sets(joints),
        identified=_fit(joints, errors, 1),
        held_out=_held_out(predictions.files, list(errors.values()), rng),
        next_experiment="",
        seconds=seconds,
        recording=Source(
            path=str(recording.path),
            model=recording.model,
            joints=tuple(j.name for j in joints),
            trajectories=len(recording.trajectories),
            samples=len(predictions.time),
            seconds=float(sum(t.time[-1] for t in recording.trajectories)),
            servo=str(recording.servo.get("model", "")),
        ),
        provisional=_pool(joints, named=False),
        joints=tuple(_gap(j, errors[j.name], rng) for j in joints),
        evidence=tuple(c for j in joints for c in _evidence(j)),
        trajectories=tuple(e for j in joints for e in _trajectories(recording, j.name, errors[j.name])),
        rollouts=simulated,
        seed=seed,
    )
    return report, predictions


def _errors(joint: Analysed, predictions: Predictions) -> Errors:
    """Held-out errors where the trajectory was in a fold, errors of the full fit where it was in no fit."""
    spec, column = joint.spec, predictions.joints.index(joint.name)
    models = np.stack([predictions.baseline[:, column], predictions.identified[:, column]], axis=1)
    residuals = predictions.measured[:, column, None] - models
    parts = dict(zip(spec.trajectories, spec.pieces, strict=True)) if spec.pieces else {}
    own, pieces = [], []
    for index in range(len(predictions.files)):
        rows = predictions.trajectory == index
        if np.ptp(predictions.command[rows, column]) > 0.0:
            own.append(index)
            pieces.append(residuals[rows][slice(*parts.get(index, (None,)))])
    squares = np.array([np.sum(piece**2, axis=0) for piece in pieces])
    absolutes = np.array([np.sum(np.abs(piece), axis=0) for piece in pieces])
    for model, fit in enumerate((joint.explanation.baseline, joint.explanation.final)):
        absolute = np.full(len(fit.held_out), np.nan) if fit.held_out_abs is None else fit.held_out_abs
        for index, *sums in zip(spec.trajectories, fit.held_out, absolute, strict=True):
            if index in own:
                squares[own.index(index), model], absolutes[own.index(index), model] = sums
    count = np.array([len(piece) for piece in pieces], float)
    return Errors(tuple(own), np.concatenate(pieces), count, squares, absolutes)


def _fit(joints: Sequence[Analysed], errors: dict[str, Errors], model: int) -> Fit:
    """Errors on everything analysed, and the baseline's parameters, of one of the two models."""
    everything = np.concatenate([errors[j.name].residuals[:, model] for j in joints])
    return Fit(
        rmse_rad=float(np.sqrt(np.mean(everything**2))),
        per_joint={j.name: float(np.sqrt(np.mean(errors[j.name].residuals[:, model] ** 2))) for j in joints},
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


def _held_out(files: Sequence[str], errors: Sequence[Errors], rng: np.random.Generator) -> HeldOut:
    """Errors before and after, over trajectories of all joints."""
    count = np.concatenate([e.count for e in errors])
    old, new = np.concatenate([e.squares for e in errors]).T
    weights = resamples(len(count), rng)
    samples = 1.0 - rmse(new, count, weights) / np.maximum(rmse(old, count, weights), 1e-30)
    before, after = float(rmse(old, count)), float(rmse(new, count))
    means = np.concatenate([e.absolutes for e in errors]).sum(axis=0) / count.sum()
    return HeldOut(
        trajectories=tuple(files[i] for i in sorted({i for e in errors for i in e.trajectories})),
        baseline_rmse_rad=before,
        identified_rmse_rad=after,
        reduction=1.0 - after / max(before, 1e-30),
        ci95=interval(samples),
        baseline_mae_rad=float(means[0]),
        identified_mae_rad=float(means[1]),
    )


def _gap(joint: Analysed, errors: Errors, rng: np.random.Generator) -> JointGap:
    weights = resamples(len(errors.count), rng)
    (old, new), count = errors.squares.T, errors.count
    return JointGap(
        joint=joint.name,
        noise_floor_rad=joint.spec.floor,
        baseline_rmse_rad=float(rmse(old, count)),
        baseline_ci95=interval(rmse(old, count, weights)),
        identified_rmse_rad=float(rmse(new, count)),
        identified_ci95=interval(rmse(new, count, weights)),
        verdict=joint.explanation.verdict,
        reason=joint.explanation.reason,
        open_sets=tuple((one.name, *one.tied) for one in joint.found if one.tied and not one.named),
    )


def _pool(joints: Sequence[Analysed], *, named: bool) -> tuple[NamedEffect, ...]:
    """Named (or provisional) effects, those of several joints in one entry where their values agree."""
    groups: dict[str, list[dict[str, Accepted]]] = {}
    for joint in joints:
        for accepted in joint.found:
            if accepted.named == named:
                alike = groups.setdefault(accepted.name, [])
                group = next((g for g in alike if all(_agree(accepted, a) for a in g.values())), None)
                if group is None:
                    alike.append(group := {})
                group[joint.name] = accepted
    order, often = list(EFFECTS), {name: sum(map(len, alike)) for name, alike in groups.items()}
    names = sorted(groups, key=lambda name: (-often[name], order.index(name)))
    return tuple(_entry(name, group) for name in names for group in groups[name])


def _agree(one: Accepted, other: Accepted) -> bool:
    """Whether the values of an effect on two joints can be the same."""
    if one.estimates.keys() != other.estimates.keys():
        return False
    for key, (value, low, high) in one.estimates.items():
        theirs, their_low, their_high = other.estimates[key]
        near = abs(value - theirs) <= CLOSE * max(abs(value), abs(theirs))
        if not near and not (low <= their_high and their_low <= high):
            return False
    return True


def _entry(name: str, group: dict[str, Accepted]) -> NamedEffect:
    """One effect of joints that agree, its numbers weighted by their precision."""
    known, every = parameters_of(name), list(group.values())
    parameters = {}
    for key in every[0].estimates:
        values, lows, highs = np.array([accepted.estimates[key] for accepted in every]).T
        weight = np.maximum(0.5 * (highs - lows), 1e-12) ** -2
        weight /= weight.sum()
        value = float(weight @ values)
        # No narrower than the joints' own values lie apart from the pooled one.
        apart = 2.0 * np.sqrt(weight @ (values - value) ** 2 / max(len(every) - 1, 1))
        below, above = (max(np.linalg.norm(weight * d), apart) for d in (values - lows, highs - values))
        low = max(value - below, -np.inf if known[key].signed else 0.0)
        parameters[key] = Estimate(value, (float(low), float(value + above)), known[key].unit)
    return NamedEffect(
        name=name,
        joints=tuple(group),
        confidence=float(np.mean([accepted.confidence for accepted in every])),
        parameters=parameters,
        alternatives=tuple(
            Alternative(*other) for other in max(every, key=lambda accepted: accepted.confidence).alternatives
        ),
    )


def _sets(joints: Sequence[Analysed]) -> tuple[tuple[str, ...], ...]:
    """Sets of effects not told apart, each once."""
    sets: dict[frozenset[str], tuple[str, ...]] = {}
    for accepted in (one for joint in joints for one in joint.found):
        if (accepted.tied and not accepted.named) or accepted.equivalent:
            members = (accepted.name, *accepted.equivalent, *accepted.tied)
            sets.setdefault(frozenset(members), members)
    return tuple(sets.values())


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
            placebo=trial.placebo,
            given=tuple(name for name in trial.fit.effects if name != trial.name),
        )
        for trial in joint.explanation.trials
    ]


def _trajectories(recording: Recording, joint: str, errors: Errors) -> list[TrajectoryError]:
    roots = np.sqrt(errors.squares / errors.count[:, None])
    means = errors.absolutes / errors.count[:, None]
    rows = zip(errors.trajectories, roots.tolist(), means.tolist(), strict=True)
    parts = recording.trajectories
    return [TrajectoryError(parts[i].file, parts[i].excitation, joint, True, *r, *m) for i, r, m in rows]
