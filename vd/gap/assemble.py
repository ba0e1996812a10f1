"""Put the explanations of all joints together.

Shared effects, pooled numbers, one verdict, curves.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vd.gap import rules
from vd.gap.coordinates import BASELINE_PARAMETERS, GRAVITY
from vd.gap.fit import FINER, JointFit, JointSpec, Problems, intervals
from vd.gap.result import (
    Alternative,
    AnalysedRecording,
    Credit,
    Estimate,
    FamilyVerdict,
    Fit,
    HeldOut,
    JointGap,
    Misfit,
    NamedEffect,
    Predictions,
    Report,
    TrajectoryError,
    WholeModel,
    parameters_of,
)
from vd.gap.rollout import Rollouts
from vd.gap.statistics import half_width, interval, resamples, rmse
from vd.kernels.servo.effects import EFFECTS
from vd.logs.recording import Recording


LISTED = 5
"""Good models of a joint that a report lists at most: the contract's."""
ANSWERS = ("effects", "ambiguous")
"""Verdicts that name something."""


@dataclass(frozen=True, eq=False)
class AnalysedJoint:
    """A joint and what came of it.

    Attributes:
        name: Its name.
        spec: Its data.
        plain: The plain model.
        conclusion: What is concluded.
        evidence: What its models were judged by.
        fits: All models that were fitted.
        vetoes: Effects that were not tried, with the reason.
        means: Effects that stand for others, and for which.
    """

    name: str
    spec: JointSpec
    plain: JointFit
    conclusion: rules.Conclusion
    evidence: rules.Evidence
    fits: Sequence[JointFit]
    vetoes: Mapping[str, str]
    means: Mapping[str, tuple[str, ...]]

    @property
    def final(self) -> JointFit:
        """The model that is delivered."""
        return self.conclusion.final

    @property
    def estimates(self) -> dict[str, dict[str, tuple[float, float, float]]]:
        """Value and interval of every parameter of every effect of the delivered model."""
        spread = intervals(self.final, self.evidence.floor)
        result: dict[str, dict[str, tuple[float, float, float]]] = {}
        for key, value in self.final.values.items():
            effect, _, name = key.rpartition(".")
            if effect:
                result.setdefault(effect, {})[name] = (value, *spread[key])
        return result


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
    joints: Sequence[AnalysedJoint],
    findings: Sequence[Misfit],
    *,
    seed: int,
) -> tuple[Report, Predictions]:
    """The report of all joints, and the curves of its figures."""
    recording = problems.recording
    before = curves(problems, [(joint.spec, joint.plain.rows) for joint in joints])
    after = curves(problems, [(joint.spec, joint.final.rows) for joint in joints])
    predictions = Predictions.of(recording, before, after)
    rng = np.random.default_rng(seed)
    residuals = {j.name: _residuals(j, predictions) for j in joints}
    rows = {j.name: _errors(j, residuals[j.name], recording) for j in joints}
    every = [row for j in joints for row in rows[j.name]]
    report = Report(
        verdict=rules.overall([joint.conclusion.verdict for joint in joints]),
        noise_floor_rad=float(np.sqrt(np.mean([j.spec.floor**2 for j in joints]))),
        baseline=_fit(joints, residuals, 0),
        findings=tuple(findings),
        effects=_pool(joints, named=True),
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
        provisional=_pool(joints, named=False),
        joints=tuple(_gap(j, rows[j.name], rng) for j in joints),
        families=tuple(row for joint in joints for row in _families(joint)),
        models=tuple(row for joint in joints for row in _models(joint, joint.conclusion.good[:LISTED])),
        compared=tuple(row for joint in joints for row in _models(joint, joint.fits)),
        credits=tuple(row for joint in joints for row in _credits(joint)),
        not_tried={joint.name: dict(joint.vetoes) for joint in joints},
        trajectories=tuple(every),
        aside={
            joint.name: recording.trajectories[joint.spec.aside].file
            for joint in joints
            if joint.spec.aside is not None
        },
        seed=seed,
    )
    return report, predictions


def _residuals(joint: AnalysedJoint, predictions: Predictions) -> dict[int, np.ndarray]:
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
        if index != spec.aside and np.ptp(predictions.command[rows, column]) > 0.0:
            rows = rows[slice(*parts.get(index, (None,)))]
            result[index] = predictions.measured[rows, column, None] - models[rows]
    return result


def _errors(
    joint: AnalysedJoint, residuals: dict[int, np.ndarray], recording: Recording
) -> list[TrajectoryError]:
    """Held-out errors where the trajectory was in a fold, errors of the full fit where it was in no fit."""
    fits, result = (joint.plain, joint.final), []
    for index, left in residuals.items():
        squares, absolutes = (left**2).mean(axis=0), np.abs(left).mean(axis=0)
        if index in joint.spec.trajectories:
            place = joint.spec.trajectories.index(index)
            squares = np.array([fit.held_out[place] for fit in fits]) / len(left)
            sums = [fit.held_out_abs[place] for fit in fits]
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
    joints: Sequence[AnalysedJoint], residuals: dict[str, dict[int, np.ndarray]], model: int
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


def _baseline_values(joint: AnalysedJoint, model: int) -> dict[str, float]:
    fit = (joint.plain, joint.final)[model]
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


def _gap(joint: AnalysedJoint, rows: Sequence[TrajectoryError], rng: np.random.Generator) -> JointGap:
    count, old, new = _sums(rows)
    weights = resamples(len(count), rng)
    conclusion = joint.conclusion
    answer = conclusion.verdict in ANSWERS
    return JointGap(
        joint=joint.name,
        noise_floor_rad=joint.spec.floor,
        baseline_rmse_rad=float(rmse(old, count)),
        baseline_ci95=interval(rmse(old, count, weights)),
        identified_rmse_rad=float(rmse(new, count)),
        identified_ci95=interval(rmse(new, count, weights)),
        verdict=conclusion.verdict,
        reason=conclusion.reason,
        open_sets=tuple(rules.open_sets(conclusion.good)) if answer else (),
        baseline_fitted_rmse_rad=joint.plain.rmse,
        identified_fitted_rmse_rad=joint.final.rmse,
    )


def _pool(joints: Sequence[AnalysedJoint], *, named: bool) -> tuple[NamedEffect, ...]:
    """Named effects, or the others of delivered models; joints whose values agree in one entry."""
    groups: list[tuple[str, list[AnalysedJoint]]] = []
    for name in EFFECTS:
        for joint in joints:
            if name in joint.final.effects and (name in joint.conclusion.names) == named:
                _put(groups, name, joint)
    often = {name: sum(len(group) for other, group in groups if other == name) for name, _ in groups}
    groups.sort(key=lambda item: -often[item[0]])
    return tuple(_entry(name, group) for name, group in groups)


def _put(
    groups: list[tuple[str, list[AnalysedJoint]]], name: str, joint: AnalysedJoint
) -> None:
    """Add a joint to those with which its values of an effect agree, or to a group of its own."""
    mine = joint.estimates[name]
    for other, group in groups:
        if other == name and all(rules.agree(mine, each.estimates[name]) for each in group):
            group.append(joint)
            return
    groups.append((name, [joint]))


def _entry(name: str, group: Sequence[AnalysedJoint]) -> NamedEffect:
    """One effect of joints that agree, its numbers weighted by their precision."""
    units = parameters_of(name)
    estimates = [joint.estimates[name] for joint in group]
    parameters = {}
    for key in estimates[0]:
        values, lows, highs = np.array([estimate[key] for estimate in estimates]).T
        weight = np.maximum(0.5 * (highs - lows), 1e-12) ** -2
        weight /= weight.sum()
        value = float(weight @ values)
        # No narrower than the joints' own, whose errors are one model's, nor than their values lie
        # apart.
        apart = half_width(weight @ (values - value) ** 2 / max(len(group) - 1, 1), len(group))
        below = float(np.maximum(weight @ (values - lows), apart))
        above = float(np.maximum(weight @ (highs - values), apart))
        low = max(value - below, -np.inf if units[key].signed else 0.0)
        parameters[key] = Estimate(value, (low, value + above), units[key].unit)
    confidence = []
    for joint in group:
        having = [name in fit.effects for fit in joint.conclusion.good]
        confidence.append(float(joint.conclusion.shares @ having))
    return NamedEffect(
        name=name,
        joints=tuple(joint.name for joint in group),
        confidence=float(np.mean(confidence)),
        parameters=parameters,
        alternatives=_alternatives(name, group[0]),
    )


def _alternatives(name: str, joint: AnalysedJoint) -> tuple[Alternative, ...]:
    """The models of a joint that have another effect in the place of one, the best first."""
    rest = {*joint.final.effects} - {name}
    best = joint.conclusion.good[0]
    rows = []
    for fit in sorted(joint.fits, key=lambda fit: fit.held_out_rmse):
        others = {*fit.effects} - rest
        if rest <= {*fit.effects} and len(others) == 1 and name not in others:
            difference = rules.difference(joint.evidence, best, fit)
            rows.append(Alternative(*others, fit.held_out_rmse, difference))
    return tuple(rows)


def _sets(joints: Sequence[AnalysedJoint]) -> tuple[tuple[str, ...], ...]:
    """Sets of effects not told apart, each once: by the motions, or by any motion."""
    sets: dict[frozenset[str], tuple[str, ...]] = {}
    for joint in joints:
        if joint.conclusion.verdict not in ANSWERS:
            continue
        for group in rules.open_sets(joint.conclusion.good):
            sets.setdefault(frozenset(group), group)
        for name in joint.conclusion.names:
            if name in joint.means:
                group = (name, *joint.means[name])
                sets.setdefault(frozenset(group), group)
    return tuple(sets.values())


def _families(joint: AnalysedJoint) -> list[FamilyVerdict]:
    """What is known of each family on a joint."""
    rows = []
    good, shares = joint.conclusion.good, joint.conclusion.shares
    for name, verdict in joint.conclusion.families.items():
        members: list[str] = []
        share = 0.0
        for fit, weight in zip(good, shares, strict=True):
            inside = [effect for effect in fit.effects if effect in rules.FAMILIES[name].effects]
            members += [effect for effect in inside if effect not in members]
            share += float(weight) if inside else 0.0
        rows.append(FamilyVerdict(joint.name, name, verdict, tuple(members), share))
    return rows


def _models(joint: AnalysedJoint, fits: Sequence[JointFit]) -> list[WholeModel]:
    """Rows of models of a joint, the best first; the delivered one with its final values."""
    good = list(joint.conclusion.good)
    rows = []
    for fit in sorted(fits, key=lambda fit: (fit not in good, fit.held_out_rmse)):
        same = fit.effects == joint.final.effects
        values = joint.final.values if same else fit.values
        rows.append(
            WholeModel(
                joint=joint.name,
                effects=fit.effects,
                parameters={key: value for key, value in values.items() if "." in key},
                rmse_rad=joint.final.rmse if same else fit.rmse,
                held_out_rmse_rad=fit.held_out_rmse,
                difference_ci95=rules.difference(joint.evidence, good[0], fit),
                share=float(joint.conclusion.shares[good.index(fit)]) if fit in good else 0.0,
                why="" if fit in good else rules.against(joint.evidence, fits, good, fit),
            )
        )
    return rows


def _credits(joint: AnalysedJoint) -> list[Credit]:
    """What each effect of a joint's delivered model brings, where the model without it was fitted."""
    rows = []
    for name in joint.final.effects:
        rest = {*joint.final.effects} - {name}
        for fit in joint.fits:
            if {*fit.effects} == rest:
                rows.append(Credit(joint.name, name, fit.rmse, fit.held_out_rmse))
    return rows
