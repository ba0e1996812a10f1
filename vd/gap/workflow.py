"""Find and explain a gap: from a recording to a :class:`vd.gap.result.Report` without a closing.

``find`` identifies the baseline and says where it fails (``DIR/find.json``); ``explain`` selects the
effects (``DIR/explain.json``, ``DIR/predictions.npz``). With a key, a step that was interrupted goes on from
the fits that it had made under that key.
"""

import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from vd.assets_usd.hand_data import HandModel
from vd.files import write_json
from vd.gap.assemble import Analysed, assemble, curves
from vd.gap.chain import Chain, chains
from vd.gap.coordinates import BASELINE_PARAMETERS, Scales
from vd.gap.design import design, pieces
from vd.gap.explain import POLISH_ITERATIONS, REFITS, Explainer, Joint, Progress
from vd.gap.find import findings
from vd.gap.fit_cache import FOLDER, FitCache
from vd.gap.joint_fit import JointFit
from vd.gap.joints import explain_joints
from vd.gap.launch_batch import LaunchBatch
from vd.gap.recording import Recording, read_recording
from vd.gap.result import Finding, Report
from vd.gap.rollout import STEP_S
from vd.gap.statistics import noise_floor
from vd.gap.worker_pool import JointSpec, Problems, WorkerPool, parallel
from vd.kernels.servo.effects import EFFECTS

FIND_FORMAT = "vd-gap-find/1"
CMA_GENERATIONS = 20
BASELINE_ITERATIONS = 15
LONG_STEP_S = 1.0 / 240.0
"""Time step [s] for recordings so long that the usual step would take minutes a joint."""
LONG_S = 600.0
"""Total motion [s] above which a recording counts as long."""
SPEED_STARTS = (1.05, 3.0)
"""Starts of the velocity limit, in largest speeds seen: one that binds, one that does not."""


def _silent(_: str) -> None:
    pass


@dataclass(frozen=True)
class Options:
    """How to analyse.

    Attributes:
        effects: Effects to consider.
        seed: Of everything random.
        device: Warp device.
        workers: Processes; the machine's cores by default, one on a GPU.
        start: Parameter rows [PARAMETER_COLUMNS] of joints by name, of an identified model to start from:
            its effects are part of the baseline, and what is named comes on top.
    """

    effects: tuple[str, ...] = tuple(EFFECTS)
    seed: int = 0
    device: str = "cpu"
    workers: int | None = None
    start: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        unknown = sorted(set(self.effects) - set(EFFECTS))
        if unknown:
            raise ValueError(f"no effects are called {', '.join(unknown)}; choose from {', '.join(EFFECTS)}")

    @property
    def processes(self) -> int:
        """Worker processes."""
        if self.workers is not None:
            return self.workers
        return len(os.sched_getaffinity(0)) if self.device == "cpu" else 1


def find(
    recording: Recording | Path,
    hand: HandModel | None,
    out: Path,
    *,
    key: str = "",
    progress: Progress = _silent,
    **options: Any,
) -> list[Finding]:
    """Identify the baseline of every excited joint, and say where it and the measurement disagree.

    Args:
        recording: The recording or its folder.
        hand: The hand, for a recording of one.
        out: Folder for ``find.json``.
        key: Of all that the fits depend on, under which they are kept while this runs; without, they are not.
        progress: Called with lines of progress.
        options: Fields of :class:`Options`.

    Returns:
        The findings, as in ``find.json``.

    Raises:
        RecordingError: The recording cannot be used.
        ValueError: An unknown effect, or a recording that is not of this hand.
    """
    chosen = Options(**options)
    recording = read_recording(recording) if isinstance(recording, Path | str) else recording
    out = Path(out)
    begin = time.perf_counter()
    cache = FitCache(out / FOLDER if key else None, key)
    with _workers(recording, hand, chosen, cache) as pool:
        joints = _identify(pool, _specs(recording, pool.problems.chains), chosen, progress)
        predicted = curves(recording, pool.problems, [(j.name, j.spec, j.fit.rows) for j in joints])
        floors = {j.name: j.spec.floor for j in joints}
        found = findings(recording, predicted, floors)
        value = {
            "format": FIND_FORMAT,
            "findings": [asdict(f) for f in found],
            "joints": {j.name: {"rows": j.fit.rows.tolist(), "rmse_rad": j.fit.rmse} for j in joints},
            "simulated": pool.simulated,
            "seconds": time.perf_counter() - begin,
        }
        progress(f"find: {pool.summary}")
    write_json(out / "find.json", value)
    cache.forget()
    for finding in found:
        progress(f"  {finding.where}")
    return found


def explain(
    recording: Recording | Path,
    hand: HandModel | None,
    out: Path,
    *,
    key: str = "",
    progress: Progress = _silent,
    **options: Any,
) -> Report:
    """Name what the baseline lacks; runs :func:`find` first where the folder has no ``find.json``.

    Args:
        recording: The recording or its folder.
        hand: The hand, for a recording of one.
        out: Folder for ``explain.json`` and ``predictions.npz``.
        key: As of :func:`find`.
        progress: Called with lines of progress.
        options: Fields of :class:`Options`.

    Returns:
        The report, as in ``explain.json``.

    Raises:
        RecordingError: The recording cannot be used.
        ValueError: An unknown effect, or a recording that is not of this hand.
    """
    chosen = Options(**options)
    recording = read_recording(recording) if isinstance(recording, Path | str) else recording
    out = Path(out)
    if not (out / "find.json").is_file():
        find(recording, hand, out, key=key, progress=progress, **options)
    known = json.loads((out / "find.json").read_text())
    begin = time.perf_counter()
    cache = FitCache(out / FOLDER if key else None, key)
    with _workers(recording, hand, chosen, cache) as pool:
        joints = _resume(pool, _specs(recording, pool.problems.chains), known["joints"])
        explained = explain_joints(Explainer(pool, joints, chosen.effects, chosen.seed, progress))
        analysed = [
            Analysed(j.name, j.spec, replace(e, baseline=j.fit))
            for j, e in zip(joints, explained, strict=True)
        ]
        seconds = known["seconds"] + time.perf_counter() - begin
        simulated = known["simulated"] + pool.simulated
        report, predictions = assemble(
            recording,
            pool.problems,
            analysed,
            [Finding(**f) for f in known["findings"]],
            seed=chosen.seed,
            seconds=seconds,
            simulated=simulated,
        )
        progress(f"explain: {pool.summary}")
    predictions.write(out / "predictions.npz")
    report.write(out / "explain.json")
    cache.forget()
    progress(f"explain: {report.verdict} after {seconds:.0f} s")
    return report


def _workers(recording: Recording, hand: HandModel | None, options: Options, cache: FitCache) -> WorkerPool:
    length = sum(float(t.time[-1]) for t in recording.trajectories)
    dt = LONG_STEP_S if length > LONG_S else STEP_S
    parts = [_started(chain, options.start) for chain in chains(recording, hand)]
    batch = None if options.device == "cpu" else LaunchBatch()
    return WorkerPool(Problems(recording, parts, dt, options.device, batch), options.processes, cache)


def _started(chain: Chain, start: Mapping[str, np.ndarray]) -> Chain:
    """The chain with the joints of an identified model as they were identified."""
    rows = [start.get(joint, row) for joint, row in zip(chain.joints, chain.start_row, strict=True)]
    return replace(chain, start_row=np.array(rows, dtype=float))


def _specs(recording: Recording, parts: Sequence[Chain]) -> list[JointSpec]:
    """The problems of all excited joints."""
    specs = []
    for index, chain in enumerate(parts):
        for joint in range(len(chain.joints)):
            trajectories, folds = design(recording, chain, joint)
            if trajectories:
                floor = noise_floor(recording, int(chain.columns[joint]))
                analysed = pieces(recording, chain, trajectories)
                specs.append(
                    JointSpec(index, joint, trajectories, folds, floor, baseline_of(chain), analysed)
                )
    return specs


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
    pool: WorkerPool, specs: Sequence[JointSpec], options: Options, progress: Progress
) -> list[Joint]:
    """Baselines of all joints; the joints of a chain once more with the others' baselines."""

    def first(spec: JointSpec) -> Joint:
        chain = pool.problems.chains[spec.chain]
        rows = chain.start_row.copy()
        scales = pool.run(spec, [("scales", {"row": rows[spec.joint], "residual": spec.floor})])[0]
        start = {"base": rows, "scales": scales, "seed": options.seed, "generations": CMA_GENERATIONS}
        searched = pool.run(spec, [("start_baseline", start)])[0]
        starts = [{}, *({"velocity_limit": f * scales.speed} for f in SPEED_STARTS)]
        # A short search can end where the inertia is too small to show, from where no descent comes back.
        nominal = {key: float(rows[spec.joint, BASELINE_PARAMETERS[key].column]) for key in spec.baseline}
        starts += [nominal, {**nominal, "velocity_limit": SPEED_STARTS[0] * scales.speed}]
        call = {"base": searched, "effects": (), "starts": starts, "scales": scales}
        fit = pool.run(spec, [("fit", {**call, "iterations": BASELINE_ITERATIONS})])[0]
        name = chain.joints[spec.joint]
        progress(f"find: {name}: baseline {1e3 * fit.rmse:.2f} mrad, noise floor {1e3 * spec.floor:.2f}")
        return Joint(name, spec, _scales(pool, spec, fit), fit)

    joints = parallel(first, specs)
    if all(len(chain.joints) == 1 for chain in pool.problems.chains):
        return joints
    return _together(pool, joints)


def _together(pool: WorkerPool, joints: Sequence[Joint]) -> list[Joint]:
    """Refit each joint with the other joints of its chain as they were found."""

    def again(joint: Joint) -> Joint:
        rows = joint.fit.rows.copy()
        for other in joints:
            if other.spec.chain == joint.spec.chain:
                rows[other.spec.joint] = other.fit.rows[other.spec.joint]
        call = {"base": rows, "effects": joint.fit.effects, "starts": [{}], "scales": joint.scales}
        fit = pool.run(joint.spec, [("fit", {**call, "iterations": POLISH_ITERATIONS})])[0]
        return replace(joint, fit=fit, scales=_scales(pool, joint.spec, fit))

    return parallel(again, joints)


def _scales(pool: WorkerPool, spec: JointSpec, fit: JointFit) -> Scales:
    call = {"row": fit.rows[spec.joint], "residual": fit.rmse}
    return pool.run(spec, [("scales", call)])[0]


def _resume(pool: WorkerPool, specs: Sequence[JointSpec], known: dict[str, Any]) -> list[Joint]:
    """The joints of an earlier ``find``, their fits recomputed from its rows."""

    def one(spec: JointSpec) -> Joint:
        name = pool.problems.chains[spec.chain].joints[spec.joint]
        rows = np.array(known[name]["rows"])
        scales = pool.run(spec, [("scales", {"row": rows[spec.joint], "residual": known[name]["rmse_rad"]})])[
            0
        ]
        call = {"base": rows, "effects": (), "starts": [{}], "scales": scales, "iterations": 1}
        return Joint(name, spec, scales, pool.run(spec, [("fit", {**call, "refits": REFITS})])[0])

    return parallel(one, specs)
