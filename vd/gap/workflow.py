"""Find and explain a gap: from a recording to a :class:`vd.gap.result.Report` without a closing.

``find`` identifies the baseline and says where it fails (``DIR/find.json``); ``explain`` compares
whole models (``DIR/explain.json``, ``DIR/predictions.npz``).
"""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vd.assets_usd.hand_data import HandModel
from vd.command.files import write_json
from vd.gap import rules
from vd.gap.assemble import AnalysedJoint, assemble, curves
from vd.gap.chain import Chain, chains, others_in
from vd.gap.coordinates import values_of
from vd.gap.design import design, pieces
from vd.gap.find import findings
from vd.gap.fit import JointFit, JointProblem, JointSpec, Problems
from vd.gap.ladder import FitCall, Ladder
from vd.gap.result import Misfit, Report
from vd.gap.rollout import STEP_S
from vd.gap.statistics import noise_floor
from vd.gap.telemetry import telemetry_of
from vd.gap.worker_pool import WorkerPool
from vd.kernels.servo.effects import EFFECTS, TOGETHER
from vd.logs.recording import Recording, read_recording

FIND_FORMAT = "vd-gap-find/1"
Progress = Callable[[str], None]


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
    with _workers(problems, chosen) as pool:
        fits = _identify(pool, problems.chains, specs, chosen)
    floors = {}
    rows = {}
    for spec, fit in zip(specs, fits, strict=True):
        name = problems.chains[spec.chain].joints[spec.joint]
        floors[name] = spec.floor
        rows[name] = {"rows": fit.rows.tolist()}
    misfits = findings(problems.recording, curves(problems, specs, fits), floors)
    value = {
        "format": FIND_FORMAT,
        "findings": [asdict(misfit) for misfit in misfits],
        "joints": rows,
    }
    write_json(Path(out) / "find.json", value)
    for misfit in misfits:
        chosen.progress(f"  {misfit.where}")
    return misfits


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
    chosen = Options(**options)
    out = Path(out)
    if not (out / "find.json").is_file():
        find(recording, hand, out, **options)
    before = json.loads((out / "find.json").read_text())
    problems, specs = _problems(recording, hand, chosen)
    analysed: dict[JointSpec, AnalysedJoint] = {}
    with _workers(problems, chosen) as pool:
        # Of each finger from its tip on, as a joint's motion shakes those before it.
        for number, spec in enumerate(sorted(specs, key=lambda spec: (spec.chain, -spec.joint)), 1):
            name = problems.chains[spec.chain].joints[spec.joint]
            rows = np.array(before["joints"][name]["rows"])
            place = f"{name} ({number} of {len(specs)})"
            analysis = _JointAnalysis(pool, problems, spec, chosen, name, place)
            analysed[spec] = analysis.run(rows, list(analysed.values()))
    misfits = [Misfit(**misfit) for misfit in before["findings"]]
    joints = [*map(analysed.__getitem__, specs)]
    report, predictions = assemble(problems, joints, misfits, chosen.seed)
    predictions.write(out / "predictions.npz")
    report.write(out / "explain.json")
    return report


@dataclass
class _JointAnalysis:
    """What is done with one joint.

    Attributes:
        pool: Who fits.
        problems: Of the recording.
        spec: Of the joint.
        options: How to analyse.
        name: Name of the joint.
        place: Name and number of the joint, in words.
        done: Calls that were answered. How many there will be is not known.
    """

    pool: WorkerPool
    problems: Problems
    spec: JointSpec
    options: Options
    name: str
    place: str
    done: int = 0

    def ask(self, calls: Sequence[FitCall]) -> list[Any]:
        """Results of calls of the joint's problem, with a line of progress."""
        result = self.pool.run(self.spec, calls)
        self.done += len(calls)
        self.options.progress(f"explain: {self.place}: fits done: {self.done}")
        return result

    def run(self, rows: np.ndarray, others: Sequence[AnalysedJoint]) -> AnalysedJoint:
        """Fit the ladder of the joint, and conclude.

        Args:
            rows: Plain models of the joint's chain [n, PARAMETER_COLUMNS].
            others: Joints that are analysed already.
        """
        spec = self.spec
        chain = self.problems.chains[self.spec.chain]
        base = rows.copy()
        for other in others:
            if other.spec.chain == spec.chain:
                base[other.spec.joint] = other.conclusion.final.rows[other.spec.joint]
        base[spec.joint] = chain.start_row[spec.joint]
        start = values_of(rows[spec.joint], spec.baseline)
        ((plain, scales),) = self.ask([partial(JointProblem.plain, base=base, start=start)])
        evidence = rules.Evidence(spec.floor, spec.folds, plain.rmse)
        loose = rules.undetermined(evidence, plain)
        allowed, vetoes, means = self.candidates()
        ladder = Ladder(
            run=self.ask,
            base=base,
            candidates=allowed,
            scales=scales,
            others=others_in(chain, spec.joint),
            nominal=values_of(chain.start_row[spec.joint], spec.baseline),
            evidence=evidence,
            models={frozenset(): plain},
        )
        if not rules.too_few(plain) and not rules.white(evidence, plain):
            ladder.climb()
        plain = ladder.models[frozenset()]
        fits = list(ladder.models.values())
        conclusion = rules.conclude(evidence, plain, fits, loose)
        if conclusion.final.effects:
            (refined,) = self.ask([partial(JointProblem.refine, fit=conclusion.final)])
            conclusion = replace(conclusion, final=refined)
        self.options.progress(f"explain: {self.name}: {conclusion.verdict}: {conclusion.reason}")
        return AnalysedJoint(self.name, spec, plain, conclusion, evidence, fits, vetoes, means)

    def candidates(self) -> tuple[list[str], dict[str, str], dict[str, tuple[str, ...]]]:
        """Effects that models may have; those that are not tried, with the reason; what effects stand for."""
        recording = self.problems.recording
        chain = self.problems.chains[self.spec.chain]
        spec = self.spec
        telemetry = telemetry_of(recording, chain, spec.joint, spec.trajectories)
        vetoes = rules.contradicted(telemetry)
        means = {}
        for name, others in rules.alike(self.options.effects, recording.model).items():
            if not vetoes.keys() & {name, *others}:
                means[name] = others
                for other in others:
                    vetoes[other] = f"leaves the same positions as {name}, which stands for both"
        allowed = rules.candidates(chain, self.options.effects)
        names = [name for name in allowed if name not in vetoes]
        return names, vetoes, {**means, **TOGETHER}


def _workers(problems: Problems, options: Options) -> WorkerPool:
    """Who fits."""
    cores = len(os.sched_getaffinity(0)) if options.device == "cpu" else 1
    return WorkerPool(problems.of, options.workers or cores)


def _problems(
    recording: Recording | Path, hand: HandModel | None, options: Options
) -> tuple[Problems, list[JointSpec]]:
    """The problems of a recording, and of which joints: all excited ones."""
    recording = recording if isinstance(recording, Recording) else read_recording(recording)
    parts = []
    specs = []
    dt = STEP_S
    for index, chain in enumerate(chains(recording, hand)):
        rows = chain.start_row.astype(float)
        parts.append(replace(chain, start_row=rows))
        for joint, name in enumerate(chain.joints):
            rows[joint] = options.start.get(name, rows[joint])
            trajectories, folds, aside = design(recording, chain, joint)
            if trajectories:
                spec = JointSpec(
                    chain=index,
                    joint=joint,
                    trajectories=trajectories,
                    folds=folds,
                    floor=noise_floor(recording, int(chain.columns[joint])),
                    baseline=baseline_of(chain),
                    pieces=pieces(recording, chain, trajectories),
                    aside=aside,
                )
                specs.append(spec)
                if spec.pieces:
                    # A recording so long that pieces of it are analysed would take minutes a joint.
                    dt = 2.0 * STEP_S
    return Problems(recording, parts, dt, options.device), specs


def baseline_of(chain: Chain) -> tuple[str, ...]:
    """What the baseline fits: all that the chain lets free but one anchor of a free torque scale.

    Without known masses, torques are known up to a factor: a pendulum's load holds it if known, the
    nominal stiffness if not.
    """
    if chain.bodies:
        return chain.baseline_free
    anchor = "tau_g_nm" if chain.reference_load is not None else "kp"
    return tuple(name for name in chain.baseline_free if name != anchor)


def _identify(
    pool: WorkerPool, chains: Sequence[Chain], specs: Sequence[JointSpec], options: Options
) -> list[JointFit]:
    """Plain models of all joints; the joints of a chain once more beside the others' plain models."""
    starts = [chains[spec.chain].start_row for spec in specs]
    fits = _plain(pool, chains, specs, starts, options)
    if not chains[0].bodies:
        return fits
    beside = []
    for spec, fit in zip(specs, fits, strict=True):
        rows = fit.rows.copy()
        for other, its in zip(specs, fits, strict=True):
            if other.chain == spec.chain:
                rows[other.joint] = its.rows[other.joint]
        beside.append(rows)
    return _plain(pool, chains, specs, beside, options, " beside the others")


def _plain(
    pool: WorkerPool,
    chains: Sequence[Chain],
    specs: Sequence[JointSpec],
    bases: Sequence[np.ndarray],
    options: Options,
    how: str = "",
) -> list[JointFit]:
    """Plain models of joints, each beside the rows of its chain [n, PARAMETER_COLUMNS].

    ``how`` is told behind the name of each.
    """
    fits = []
    for spec, base in zip(specs, bases, strict=True):
        ((fit, _),) = pool.run(spec, [partial(JointProblem.plain, base=base)])
        fits.append(fit)
        name = f"{chains[spec.chain].joints[spec.joint]}{how} ({len(fits)} of {len(specs)})"
        line = f"baseline {1e3 * fit.rmse:.2f} mrad, noise floor {1e3 * spec.floor:.2f}"
        options.progress(f"find: {name}: {line}")
    return fits
