"""Find and explain a gap: from a recording to a :class:`vd.gap.result.Report` without a closing.

``find`` identifies the baseline and says where it fails (``DIR/find.json``); ``explain`` selects
the effects (``DIR/explain.json``, ``DIR/predictions.npz``).
"""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vd.assets_usd.hand_data import HandModel
from vd.command.files import write_json
from vd.gap.assemble import Analysed, assemble, curves
from vd.gap.chain import Chain, chains, relative_torques
from vd.gap.coordinates import FREE_SPEED, Scales
from vd.gap.design import design, pieces
from vd.gap.explain import ExcitedJoint, Progress, explain_joints
from vd.gap.find import findings
from vd.gap.fit import JointProblem, JointSpec, Problems
from vd.gap.result import Misfit, Report
from vd.gap.rollout import STEP_S
from vd.gap.statistics import noise_floor
from vd.gap.worker_pool import WorkerPool, parallel
from vd.kernels.servo.effects import EFFECTS
from vd.logs.recording import Recording, read_recording

FIND_FORMAT = "vd-gap-find/1"


@dataclass(frozen=True)
class Options:
    """How to analyse.

    Attributes:
        effects: Effects to consider.
        seed: Of everything random.
        device: Warp device.
        workers: Processes; the machine's cores by default, one on a GPU.
        start: Parameter rows [PARAMETER_COLUMNS] of joints by name, of an identified model to start
            from: its effects are part of the baseline, and what is named comes on top.
        progress: Called with lines of progress.
    """

    effects: tuple[str, ...] = tuple(EFFECTS)
    seed: int = 0
    device: str = "cpu"
    workers: int | None = None
    start: Mapping[str, np.ndarray] = field(default_factory=dict)
    progress: Progress = lambda line: None


def find(
    recording: Recording | Path, hand: HandModel | None, out: Path, **options: Any
) -> list[Misfit]:
    """Identify the baseline of every excited joint, and say where it and the measurement disagree.

    Args:
        recording: The recording or its folder.
        hand: The hand, for a recording of one.
        out: Folder for ``find.json``.
        options: Fields of :class:`Options`.

    Returns:
        The findings, as in ``find.json``.

    Raises:
        RecordingError: The recording cannot be used.
        ValueError: A recording that is not of this hand.
    """
    chosen = Options(**options)
    problems, specs = _problems(recording, hand, chosen)
    recording = problems.recording
    with _workers(problems, chosen) as pool:
        joints = _identify(pool, problems.chains, specs, chosen)
        predicted = curves(problems, [(j.spec, j.fit.rows) for j in joints])
        found = findings(recording, predicted, {j.name: j.spec.floor for j in joints})
        value = {
            "format": FIND_FORMAT,
            "findings": [asdict(f) for f in found],
            "joints": {
                j.name: {"rows": j.fit.rows.tolist(), "rmse_rad": j.fit.rmse} for j in joints
            },
        }
        write_json(Path(out) / "find.json", value)
    for finding in found:
        chosen.progress(f"  {finding.where}")
    return found


def explain(
    recording: Recording | Path, hand: HandModel | None, out: Path, **options: Any
) -> Report:
    """Name what the baseline lacks; runs :func:`find` first where the folder has no ``find.json``.

    Args:
        recording: The recording or its folder.
        hand: The hand, for a recording of one.
        out: Folder for ``explain.json`` and ``predictions.npz``.
        options: Fields of :class:`Options`.

    Returns:
        The report, as in ``explain.json``.

    Raises:
        RecordingError: The recording cannot be used.
        ValueError: A recording that is not of this hand.
    """
    chosen, out = Options(**options), Path(out)
    if not (out / "find.json").is_file():
        find(recording, hand, out, **options)
    known = json.loads((out / "find.json").read_text())
    problems, specs = _problems(recording, hand, chosen)
    recording = problems.recording
    with _workers(problems, chosen) as pool:
        joints = _resume(pool, problems.chains, specs, known["joints"])
        explained = explain_joints(
            pool, problems, joints, chosen.effects, chosen.seed, chosen.progress
        )
        analysed = [
            Analysed(j.name, j.spec, replace(e, baseline=j.fit))
            for j, e in zip(joints, explained, strict=True)
        ]
        report, predictions = assemble(
            problems,
            analysed,
            [Misfit(**f) for f in known["findings"]],
            seed=chosen.seed,
        )
        source = replace(report.recording, relative_torques=relative_torques(recording))
        report = replace(report, recording=source)
        predictions.write(out / "predictions.npz")
        report.write(out / "explain.json")
    chosen.progress(f"explain: {report.verdict}")
    return report


def _workers(problems: Problems, options: Options) -> WorkerPool:
    """Who fits."""
    cores = len(os.sched_getaffinity(0)) if options.device == "cpu" else 1
    return WorkerPool(problems.of, options.workers or cores)


def _problems(
    recording: Recording | Path, hand: HandModel | None, options: Options
) -> tuple[Problems, list[JointSpec]]:
    """The problems of a recording, and of which joints: all excited ones."""
    recording = recording if isinstance(recording, Recording) else read_recording(recording)
    parts, specs = [], []
    for index, chain in enumerate(chains(recording, hand)):
        rows = [
            options.start.get(name, row)
            for name, row in zip(chain.joints, chain.start_row, strict=True)
        ]
        parts.append(replace(chain, start_row=np.array(rows, dtype=float)))
        for joint, column in enumerate(chain.columns):
            trajectories, folds = design(recording, chain, joint)
            if trajectories:
                floor, analysed = (
                    noise_floor(recording, int(column)),
                    pieces(recording, chain, trajectories),
                )
                free = baseline_of(chain)
                specs.append(JointSpec(index, joint, trajectories, folds, floor, free, analysed))
    # A recording so long that pieces of it are analysed would take minutes a joint with the usual
    # step.
    dt = STEP_S * (2.0 if any(spec.pieces for spec in specs) else 1.0)
    return Problems(recording, parts, dt, options.device), specs


def baseline_of(chain: Chain) -> tuple[str, ...]:
    """What the baseline fits: all that the chain lets free but one anchor of a free torque scale.

    Without known masses, torques are known up to a factor: a pendulum's load holds it if known, the
    nominal stiffness if not.
    """
    anchor = ""
    if not chain.bodies:
        anchor = "tau_g_nm" if chain.reference_load is not None else "kp"
    return tuple(name for name in chain.baseline_free if name != anchor)


def _identify(
    pool: WorkerPool, chains: Sequence[Chain], specs: Sequence[JointSpec], options: Options
) -> list[ExcitedJoint]:
    """Baselines of all joints; the joints of a chain once more with the others' baselines."""

    def first(spec: JointSpec) -> ExcitedJoint:
        rows = chains[spec.chain].start_row.copy()
        scales = _scales(pool, spec, rows, spec.floor)
        # One limit that binds, one that does not.
        starts = [{}, *({"velocity_limit": factor * scales.speed} for factor in (1.0, FREE_SPEED))]
        joint = _fitted(pool, chains, spec, rows, scales, starts=starts)
        error, floor = 1e3 * joint.fit.rmse, 1e3 * spec.floor
        options.progress(f"find: {joint.name}: baseline {error:.2f} mrad, noise floor {floor:.2f}")
        return joint

    def again(joint: ExcitedJoint) -> ExcitedJoint:
        rows = joint.fit.rows.copy()
        for other in joints:
            if other.spec.chain == joint.spec.chain:
                rows[other.spec.joint] = other.fit.rows[other.spec.joint]
        return _fitted(pool, chains, joint.spec, rows, joint.scales)

    joints = parallel(first, specs)
    single = all(len(chain.joints) == 1 for chain in chains)
    return joints if single else parallel(again, joints)


def _resume(
    pool: WorkerPool,
    chains: Sequence[Chain],
    specs: Sequence[JointSpec],
    known: dict[str, Any],
) -> list[ExcitedJoint]:
    """The joints of an earlier ``find``, their fits recomputed from its rows."""

    def again(spec: JointSpec) -> ExcitedJoint:
        found = known[chains[spec.chain].joints[spec.joint]]
        rows = np.array(found["rows"])
        scales = _scales(pool, spec, rows, found["rmse_rad"])
        return replace(_fitted(pool, chains, spec, rows, scales, iterations=1), scales=scales)

    return parallel(again, specs)


def _scales(pool: WorkerPool, spec: JointSpec, rows: np.ndarray, residual: float) -> Scales:
    call = partial(JointProblem.scales, row=rows[spec.joint], residual=residual)
    return pool.run(spec, [call])[0]


def _fitted(
    pool: WorkerPool,
    chains: Sequence[Chain],
    spec: JointSpec,
    base: np.ndarray,
    scales: Scales,
    *,
    starts: Sequence[Mapping[str, float]] = ({},),
    **options: Any,
) -> ExcitedJoint:
    """A joint's plain model, fitted from rows of its chain, and the sizes of its motion with that."""
    call = partial(JointProblem.fit, base=base, effects=(), starts=starts, scales=scales, **options)
    fit = pool.run(spec, [call])[0]
    name = chains[spec.chain].joints[spec.joint]
    return ExcitedJoint(name, spec, _scales(pool, spec, fit.rows, fit.rmse), fit)
