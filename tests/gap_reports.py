"""A servo with friction, a recording of it, and what a fit might say about that."""

from pathlib import Path

import numpy as np

from vd.gap.bench.hide import Hiding, hide
from vd.gap.chain import chains
from vd.gap.result import (
    AnalysedRecording,
    Candidate,
    Estimate,
    Fit,
    HeldOut,
    JointGap,
    NamedEffect,
    Predictions,
    Report,
    TrajectoryError,
)
from vd.gap.rollout import Rollouts
from vd.kernels.servo import actuators
from vd.logs.recording import read_recording

JOINT = "joint"
FLOOR = 1e-3
BASE = {"kp": 3.0, "kd": 0.3, "velocity_limit": 7.0, "inertia": 2e-3}
FRICTION = 0.15


def rubbing_servo(folder: Path, friction: float = FRICTION) -> Path:
    """Record a bare servo with friction."""
    hide(
        Hiding("servo", {"coulomb_friction": {"tau_c_nm": friction}}, seed=3, base_spread=0.0),
        folder,
    )
    return folder


def servo_curves(folder, rows):
    """Curves of rows (baseline, identified), each {column: value} on the fitted base."""
    found = read_recording(folder)
    (chain,) = chains(found, None)
    models = np.tile(chain.start_row, (2, 1, 1))
    for model, values in zip(models, rows, strict=True):
        for column, value in {**base_columns(), **values}.items():
            model[0, column] = value
    rollouts = Rollouts(chain, found)
    predicted = rollouts.predict(models)
    return Predictions.of(found, *predicted.astype(float))


def base_columns():
    return {
        actuators.KP: BASE["kp"],
        actuators.KD: BASE["kd"],
        actuators.VELOCITY_LIMIT: BASE["velocity_limit"],
        actuators.INERTIA: BASE["inertia"],
    }


def servo_report(folder, *, verdict="effects", ambiguous=(), friction=FRICTION):
    """What a fit might say about the recording, and its curves."""
    curves = servo_curves(folder, ({}, {actuators.COULOMB_TORQUE: friction}))
    before = float(np.sqrt(np.mean((curves.baseline - curves.measured) ** 2)))
    after = float(np.sqrt(np.mean((curves.identified - curves.measured) ** 2)))
    friction = NamedEffect(
        "coulomb_friction", (JOINT,), 0.98, {"tau_c_nm": Estimate(FRICTION, (0.14, 0.16), "N m")}
    )
    decision = "named" if verdict == "effects" else "tied"
    names = {"coulomb_friction": {"tau_c_nm": FRICTION}, "backlash": {"width_rad": 0.08}}
    report = Report(
        verdict=verdict,
        noise_floor_rad=FLOOR,
        baseline=Fit(before, {JOINT: before}, before, {JOINT: BASE}),
        findings=(),
        effects=(friction,) if verdict == "effects" else (),
        ambiguous=ambiguous,
        identified=Fit(after, {JOINT: after}, after, {JOINT: BASE}),
        held_out=HeldOut(curves.files, before, after, 1.0 - after / before, (0.5, 0.9)),
        next_experiment="",
        seconds=1.0,
        recording=AnalysedRecording(
            str(folder), "servo", (JOINT,), len(curves.files), len(curves.time), 40.0
        ),
        joints=(
            JointGap(
                JOINT, FLOOR, before, (0.0, 1.0), after, (0.0, 1.0), verdict, "made up", ambiguous
            ),
        ),
        evidence=tuple(
            Candidate((JOINT,), 1, name, after, 0.8, (0.7, 0.9), decision, "made up", values)
            for name, values in names.items()
        ),
        trajectories=tuple(
            TrajectoryError(file, file, JOINT, before, after) for file in curves.files
        ),
    )
    return report, curves
