"""Put the explanations of all joints together.

Effects, sets, errors, one verdict, curves.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vd.gap import rules
from vd.gap.chain import relative_torques
from vd.gap.coordinates import GRAVITY, PARAMETERS, values_of
from vd.gap.fit import FINER, JointFit, JointSpec, Problems, intervals
from vd.gap.result import (
    Alternative,
    AnalysedRecording,
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
from vd.gap.words import LISTED
from vd.logs.recording import Recording

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


def curves(problems: Problems, specs: Sequence[JointSpec], fits: Sequence[JointFit]) -> np.ndarray:
    """Positions of all trajectories one after the other [S, J] [rad].

    NaN where no joint was fitted.

    They are simulated with the time step at which an estimate is finished.

    Args:
        problems: Of the recording.
        specs: The fitted joints.
        fits: Their models.
    """
    recording = problems.recording
    samples = sum(len(trajectory.time) for trajectory in recording.trajectories)
    result = np.full((samples, len(recording.joints)), np.nan)
    step = problems.dt / FINER[-1]
    for index, chain in enumerate(problems.chains):
        rows = chain.start_row.copy()
        fitted = False
        for spec, fit in zip(specs, fits, strict=True):
            if spec.chain == index:
                rows[spec.joint] = fit.rows[spec.joint]
                fitted = True
        if fitted:
            rollouts = Rollouts(chain, recording, dt=step, device=problems.device)
            result[:, chain.columns] = rollouts.predict(rows[None])[0]
    return result


def assemble(
    problems: Problems, joints: Sequence[AnalysedJoint], findings: Sequence[Misfit], seed: int
) -> tuple[Report, Predictions]:
    """The report of all joints, and the curves of its figures."""
    recording = problems.recording
    rng = np.random.default_rng(seed)
    specs: list[JointSpec] = []
    plain: list[JointFit] = []
    final: list[JointFit] = []
    errors: list[TrajectoryError] = []
    gaps: list[JointGap] = []
    effects: list[NamedEffect] = []
    provisional: list[NamedEffect] = []
    families: list[FamilyVerdict] = []
    models: list[WholeModel] = []
    compared: list[WholeModel] = []
    not_tried: dict[str, dict[str, str]] = {}
    aside: dict[str, str] = {}
    for joint in joints:
        specs.append(joint.spec)
        plain.append(joint.plain)
        final.append(joint.final)
        rows = _errors(joint, recording)
        errors += rows
        gaps.append(_gap(joint, rows))
        for name in joint.final.effects:
            entries = effects if name in joint.conclusion.names else provisional
            entries.append(_effect(name, joint))
        families += _families(joint)
        every = _models(joint)
        models += every[: min(LISTED, len(joint.conclusion.good))]
        compared += every
        not_tried[joint.name] = dict(joint.vetoes)
        if joint.spec.aside is not None:
            aside[joint.name] = recording.trajectories[joint.spec.aside].file
    floors = np.array([gap.noise_floor_rad for gap in gaps])
    before = curves(problems, specs, plain)
    predictions = Predictions.of(recording, before, curves(problems, specs, final))
    report = Report(
        verdict=rules.overall([gap.verdict for gap in gaps]),
        noise_floor_rad=float(np.sqrt(np.mean(floors**2))),
        baseline=_fitted(joints, plain),
        findings=tuple(findings),
        effects=tuple(effects),
        ambiguous=_sets(joints),
        identified=_fitted(joints, final),
        held_out=_held_out(errors, rng),
        next_experiment="",
        seconds=np.nan,
        recording=AnalysedRecording(
            path=str(recording.path),
            model=recording.model,
            joints=tuple(joint.name for joint in joints),
            trajectories=len(recording.trajectories),
            samples=len(predictions.time),
            seconds=sum(trajectory.duration for trajectory in recording.trajectories),
            servo=str(recording.servo.get("model", "")),
            relative_torques=relative_torques(recording),
        ),
        provisional=tuple(provisional),
        joints=tuple(gaps),
        families=tuple(families),
        models=tuple(models),
        compared=tuple(compared),
        not_tried=not_tried,
        trajectories=tuple(errors),
        aside=aside,
    )
    return report, predictions


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


def _fitted(joints: Sequence[AnalysedJoint], fits: Sequence[JointFit]) -> FittedModel:
    """Errors of a model of each joint on what it was fitted to, and its baseline's parameters."""
    squares = 0.0
    absolute = 0.0
    count = 0.0
    per_joint = {}
    parameters = {}
    for joint, fit in zip(joints, fits, strict=True):
        squares += fit.sse.sum()
        absolute += fit.absolute.sum()
        count += fit.count.sum()
        per_joint[joint.name] = fit.rmse
        parameters[joint.name] = _baseline_values(joint.spec, fit)
    return FittedModel(
        rmse_rad=float(np.sqrt(squares / count)),
        per_joint=per_joint,
        mae_rad=float(absolute / count),
        parameters=parameters,
    )


def _baseline_values(spec: JointSpec, fit: JointFit) -> dict[str, float]:
    """Parameters of the plain servo in a model."""
    row = fit.rows[spec.joint]
    names = ["kp", "kd", "velocity_limit"]
    names += sorted({"inertia", "kd_off"}.intersection(spec.baseline))
    # A pendulum's known load is not fitted, but without it the rest means nothing.
    if "gravity_load" not in fit.effects and row[GRAVITY.column] > 0.0:
        names.append(GRAVITY.name)
    return values_of(row, names)


def _table(rows: Sequence[TrajectoryError]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples [S], root-mean-square and mean absolute errors of both models [2, S] of trajectories."""
    table = []
    for row in rows:
        squared = (row.baseline_rmse_rad, row.identified_rmse_rad)
        table.append((row.samples, *squared, row.baseline_mae_rad, row.identified_mae_rad))
    columns = np.array(table, float).T
    return columns[0], columns[1:3], columns[3:]


def _held_out(rows: Sequence[TrajectoryError], rng: np.random.Generator) -> HeldOut:
    """Errors before and after, over trajectories of all joints."""
    count, errors, absolute = _table(rows)
    sse = count * errors**2
    old, new = rmse(sse, count, resamples(len(count), rng))
    before, after = rmse(sse, count).tolist()
    baseline_mae, identified_mae = np.average(absolute, axis=1, weights=count).tolist()
    return HeldOut(
        trajectories=tuple(dict.fromkeys(row.file for row in rows)),
        baseline_rmse_rad=before,
        identified_rmse_rad=after,
        reduction=1.0 - after / max(before, 1e-30),
        ci95=interval(1.0 - new / np.maximum(old, 1e-30)),
        baseline_mae_rad=baseline_mae,
        identified_mae_rad=identified_mae,
    )


def _gap(joint: AnalysedJoint, rows: Sequence[TrajectoryError]) -> JointGap:
    """The errors of a joint, and what is concluded."""
    count, errors, _ = _table(rows)
    before, after = rmse(count * errors**2, count).tolist()
    conclusion = joint.conclusion
    answer = conclusion.verdict in ANSWERS
    return JointGap(
        joint=joint.name,
        noise_floor_rad=joint.spec.floor,
        baseline_rmse_rad=before,
        identified_rmse_rad=after,
        verdict=conclusion.verdict,
        reason=conclusion.reason,
        open_sets=tuple(rules.open_sets(conclusion.good)) if answer else (),
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
