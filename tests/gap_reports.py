"""A servo with friction, a recording of it, and what a fit might say about that."""

from pathlib import Path

import numpy as np

from vd.gap.bench.hide import Hiding, hide
from vd.gap.chain import chains
from vd.gap.result import (
    AnalysedRecording,
    Delivered,
    Estimate,
    FamilyVerdict,
    FittedModel,
    HeldOut,
    JointGap,
    NamedEffect,
    Predictions,
    Report,
    TrajectoryError,
    WholeModel,
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
    named = verdict == "effects"
    models = (
        model(("coulomb_friction",), {"coulomb_friction.tau_c_nm": FRICTION}, after),
        model(("backlash",), {"backlash.width_rad": 0.08}, after, "worse" if named else ""),
        model((), {}, before, "worse than coulomb_friction"),
    )
    certainty = {True: "certain", False: "untold"}[named]
    families = [FamilyVerdict(JOINT, "dry friction", certainty, ("coulomb_friction",), 0.6)]
    if not named:
        families.append(FamilyVerdict(JOINT, "play", certainty, ("backlash",), 0.4))
    report = Report(
        verdict=verdict,
        noise_floor_rad=FLOOR,
        baseline=FittedModel(before, {JOINT: before}, before, {JOINT: BASE}),
        findings=(),
        effects=(friction,) if named else (),
        provisional=() if named else (friction,),
        ambiguous=ambiguous,
        identified=FittedModel(after, {JOINT: after}, after, {JOINT: BASE}),
        held_out=HeldOut(curves.files, before, after, 1.0 - after / before, (0.5, 0.9)),
        next_experiment="",
        seconds=1.0,
        recording=AnalysedRecording(
            str(folder), "servo", (JOINT,), len(curves.files), len(curves.time), 40.0
        ),
        joints=(
            JointGap(
                joint=JOINT,
                noise_floor_rad=FLOOR,
                baseline_rmse_rad=before,
                identified_rmse_rad=after,
                verdict=verdict,
                reason="made up",
                open_sets=ambiguous,
            ),
        ),
        families=tuple(families),
        models=tuple(each for each in models if not each.why),
        compared=models,
        not_tried={JOINT: {"supply_sag": "the recorded voltage falls too little"}},
        aside={JOINT: curves.files[-1]},
        delivered=Delivered(curves.files[-1], after, before),
        trajectories=tuple(
            TrajectoryError(file, file, JOINT, before, after) for file in curves.files[:-1]
        ),
    )
    return report, curves


def model(
    effects: tuple[str, ...], values: dict[str, float], error: float, why: str = ""
) -> WholeModel:
    """A whole model with the same error fitted and held out."""
    return WholeModel(JOINT, effects, values, error, error, (0.0, 0.001), 0.5, why)
