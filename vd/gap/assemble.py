"""Put the explanations of all joints together.

Effects, sets, errors, one verdict, curves.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vd.gap import rules
from vd.gap.coordinates import GRAVITY, PARAMETERS
from vd.gap.fit import FINER, JointFit, JointSpec, Problems, intervals
from vd.gap.result import (
    Alternative,
    AnalysedRecording,
    Credit,
    Estimate,
    FamilyVerdict,
    FittedModel,
    HeldOut,
    JointGap,
    Misfit,
    NamedEffect,
    Predictions,
    Report,
    TrajectoryError,
    WholeModel,
)
from vd.gap.rollout import Rollouts
from vd.gap.statistics import interval, resamples, rmse
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
        own = {}
        for spec, rows in models:
            if spec.chain == index:
                own[spec.joint] = rows[spec.joint]
        if own:
            rows = np.array([own.get(joint, row) for joint, row in enumerate(chain.start_row)])
            rollouts = Rollouts(
                chain, recording, dt=problems.dt / FINER[-1], device=problems.device
            )
            result[:, chain.columns] = rollouts.predict(rows[None])[0]
    return result


def assemble(
    problems: Problems, joints: Sequence[AnalysedJoint], findings: Sequence[Misfit], seed: int
) -> tuple[Report, Predictions]:
    """The report of all joints, and the curves of its figures."""
    recording = problems.recording
    before = curves(problems, [(joint.spec, joint.plain.rows) for joint in joints])
    after = curves(problems, [(joint.spec, joint.final.rows) for joint in joints])
    rng = np.random.default_rng(seed)
    errors: list[TrajectoryError] = []
    gaps: list[JointGap] = []
    effects: list[NamedEffect] = []
    provisional: list[NamedEffect] = []
    families: list[FamilyVerdict] = []
    models: list[WholeModel] = []
    compared: list[WholeModel] = []
    credits: list[Credit] = []
    aside: dict[str, str] = {}
    for joint in joints:
        rows = _errors(joint, recording)
        errors += rows
        gaps.append(_gap(joint, rows, rng))
        for name in joint.final.effects:
            entries = effects if name in joint.conclusion.names else provisional
            entries.append(_effect(name, joint))
        families += _families(joint)
        every = _models(joint)
        models += every[: min(LISTED, len(joint.conclusion.good))]
        compared += every
        credits += _credits(joint)
        if joint.spec.aside is not None:
            aside[joint.name] = recording.trajectories[joint.spec.aside].file
    report = Report(
        verdict=rules.overall([joint.conclusion.verdict for joint in joints]),
        noise_floor_rad=float(np.sqrt(np.mean([joint.spec.floor**2 for joint in joints]))),
        baseline=_fit(joints, [joint.plain for joint in joints]),
        findings=tuple(findings),
        effects=tuple(effects),
        ambiguous=_sets(joints),
        identified=_fit(joints, [joint.final for joint in joints]),
        held_out=_held_out(errors, rng),
        next_experiment="",
        seconds=np.nan,
        recording=AnalysedRecording(
            path=str(recording.path),
            model=recording.model,
            joints=tuple(joint.name for joint in joints),
            trajectories=len(recording.trajectories),
            samples=sum(len(t.time) for t in recording.trajectories),
            seconds=float(sum(t.time[-1] for t in recording.trajectories)),
            servo=str(recording.servo.get("model", "")),
        ),
        provisional=tuple(provisional),
        joints=tuple(gaps),
        families=tuple(families),
        models=tuple(models),
        compared=tuple(compared),
        credits=tuple(credits),
        not_tried={joint.name: dict(joint.vetoes) for joint in joints},
        trajectories=tuple(errors),
        aside=aside,
        seed=seed,
    )
    return report, Predictions.of(recording, before, after)


def _errors(joint: AnalysedJoint, recording: Recording) -> list[TrajectoryError]:
    """Held-out errors of the motions that move a joint."""
    column = recording.joints.index(joint.name)
    rows = []
    for place, index in enumerate(joint.spec.trajectories):
        trajectory = recording.trajectories[index]
        if np.ptp(trajectory.command[:, column]) > 0.0:
            rows.append(
                TrajectoryError(
                    file=trajectory.file,
                    excitation=trajectory.excitation,
                    joint=joint.name,
                    baseline_rmse_rad=float(np.sqrt(joint.plain.mean_square[place])),
                    identified_rmse_rad=float(np.sqrt(joint.final.mean_square[place])),
                    baseline_mae_rad=float(joint.plain.mean_absolute[place]),
                    identified_mae_rad=float(joint.final.mean_absolute[place]),
                    samples=int(joint.plain.count[place]),
                )
            )
    return rows


def _fit(joints: Sequence[AnalysedJoint], fits: Sequence[JointFit]) -> FittedModel:
    """Errors of a model of each joint on what it was fitted to, and its baseline's parameters."""
    count = sum(fit.count.sum() for fit in fits)
    parameters = {}
    for joint, fit in zip(joints, fits, strict=True):
        parameters[joint.name] = _baseline_values(joint.spec, fit)
    return FittedModel(
        rmse_rad=float(np.sqrt(sum(fit.sse.sum() for fit in fits) / count)),
        per_joint={joint.name: fit.rmse for joint, fit in zip(joints, fits, strict=True)},
        mae_rad=float(sum(fit.absolute.sum() for fit in fits) / count),
        parameters=parameters,
    )


def _baseline_values(spec: JointSpec, fit: JointFit) -> dict[str, float]:
    """Parameters of the plain servo in a model."""
    row = fit.rows[spec.joint]
    names = ["kp", "kd", "velocity_limit"]
    names += [name for name in ("inertia", "kd_off") if name in spec.baseline]
    # A pendulum's known load is not fitted, but without it the rest means nothing.
    if "gravity_load" not in fit.effects and row[GRAVITY.column] > 0.0:
        names.append(GRAVITY.name)
    result = {}
    for name in names:
        result[name] = float(row[PARAMETERS[name].column])
    return result


def _sums(rows: Sequence[TrajectoryError]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples, and sums of squared errors of both models, of each trajectory [S]."""
    count = np.array([row.samples for row in rows], float)
    before = np.array([row.baseline_rmse_rad for row in rows])
    after = np.array([row.identified_rmse_rad for row in rows])
    return count, count * before**2, count * after**2


def _held_out(rows: Sequence[TrajectoryError], rng: np.random.Generator) -> HeldOut:
    """Errors before and after, over trajectories of all joints."""
    count, old, new = _sums(rows)
    weights = resamples(len(count), rng)
    ratio = rmse(new, count, weights) / np.maximum(rmse(old, count, weights), 1e-30)
    before = float(rmse(old, count))
    after = float(rmse(new, count))
    baseline_mae = np.average([row.baseline_mae_rad for row in rows], weights=count)
    identified_mae = np.average([row.identified_mae_rad for row in rows], weights=count)
    return HeldOut(
        trajectories=tuple(dict.fromkeys(row.file for row in rows)),
        baseline_rmse_rad=before,
        identified_rmse_rad=after,
        reduction=1.0 - after / max(before, 1e-30),
        ci95=interval(1.0 - ratio),
        baseline_mae_rad=float(baseline_mae),
        identified_mae_rad=float(identified_mae),
    )


def _gap(
    joint: AnalysedJoint, rows: Sequence[TrajectoryError], rng: np.random.Generator
) -> JointGap:
    """The errors of a joint, and what is concluded."""
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


def _effect(name: str, joint: AnalysedJoint) -> NamedEffect:
    """One effect of the delivered model of a joint."""
    spread = intervals(joint.final, joint.evidence.floor)
    parameters = {}
    for key, value in joint.final.values.items():
        effect, _, parameter = key.rpartition(".")
        if effect == name:
            parameters[parameter] = Estimate(value, spread[key], PARAMETERS[key].unit)
    having = [name in fit.effects for fit in joint.conclusion.good]
    return NamedEffect(
        name=name,
        joints=(joint.name,),
        confidence=float(joint.conclusion.shares @ having),
        parameters=parameters,
        alternatives=_alternatives(name, joint),
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
            rows.append(Alternative(others.pop(), fit.held_out_rmse, difference))
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
    good = joint.conclusion.good
    shares = joint.conclusion.shares
    for name, verdict in joint.conclusion.families.items():
        members: dict[str, None] = {}
        share = 0.0
        for fit, weight in zip(good, shares, strict=True):
            inside = [effect for effect in fit.effects if effect in rules.FAMILIES[name].effects]
            members |= dict.fromkeys(inside)
            share += float(weight) * bool(inside)
        rows.append(FamilyVerdict(joint.name, name, verdict, tuple(members), share))
    return rows


def _models(joint: AnalysedJoint) -> list[WholeModel]:
    """All models of a joint, the good ones and the best first; the delivered one as it is finished."""
    good = list(joint.conclusion.good)
    rows = []
    for fit in sorted(joint.fits, key=lambda fit: (fit not in good, fit.held_out_rmse)):
        finished = joint.final if fit.effects == joint.final.effects else fit
        share = 0.0
        why = ""
        if fit in good:
            share = float(joint.conclusion.shares[good.index(fit)])
        else:
            why = rules.against(joint.evidence, joint.fits, good, fit)
        rows.append(
            WholeModel(
                joint=joint.name,
                effects=fit.effects,
                parameters={key: x for key, x in finished.values.items() if "." in key},
                rmse_rad=finished.rmse,
                held_out_rmse_rad=fit.held_out_rmse,
                difference_ci95=rules.difference(joint.evidence, good[0], fit),
                share=share,
                why=why,
            )
        )
    return rows


def _credits(joint: AnalysedJoint) -> list[Credit]:
    """What each effect of a joint's delivered model brings, where the model without it was fitted."""
    by_effects = {}
    for fit in joint.fits:
        by_effects[frozenset(fit.effects)] = fit
    rows = []
    for name in joint.final.effects:
        without = by_effects.get(frozenset(joint.final.effects) - {name})
        if without is not None:
            rows.append(Credit(joint.name, name, without.rmse, without.held_out_rmse))
    return rows
