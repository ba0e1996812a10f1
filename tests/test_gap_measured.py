"""Acceptance on real recordings (``measured/`` of the shared folder): what they are known to say.

Short lists of candidates and few joints: all of them take minutes.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vd.gap.chain import chains
from vd.gap.design import MAX_MOTION_S, design, pieces
from vd.gap.result import Report
from vd.gap.statistics import held
from vd.gap.workflow import explain
from vd.logs.recording import Recording, read_recording

FRICTION = ("coulomb_friction", "dead_zone", "backlash")
LOAD = ("coulomb_friction", "gravity_load", "encoder_bias", "asymmetric_friction")
LOSSES = ("load_friction", "torque_saturation", "supply_sag", "command_delay", "backlash")
MAE_RAD = 0.036
"""Goal for the pendulum at a gain that was left out [rad]."""


def measured(shared_dir: Path, name: str) -> Recording:
    folder = shared_dir / "measured" / name
    if not folder.is_dir():
        pytest.skip(f"no recording at {folder}")
    return read_recording(folder)


def only(recording: Recording, *joints: str) -> Recording:
    """The recording of some of its joints."""
    columns = [recording.joints.index(joint) for joint in joints]
    parts = []
    for t in recording.trajectories:
        if moved := tuple(joint for joint in joints if joint in t.joints):
            arrays = {
                name: getattr(t, name)[:, columns] for name in ("command", "position", "enabled")
            }
            parts.append(replace(t, joints=moved, current=None, **arrays))
    return replace(recording, joints=joints, trajectories=tuple(parts))


def names(report: Report, joint: str) -> set[str]:
    return {effect.name for effect in report.effects if joint in effect.joints}


@pytest.fixture(scope="module")
def pendulum(shared_dir, tmp_path_factory) -> Report:
    """Three of its four motions, at all gains.

    The fourth takes ten times as long and shows nothing else.
    """
    recording = measured(shared_dir, "xl330_pendulum")
    quick = tuple(t for t in recording.trajectories if t.excitation != "up_and_down")
    out = tmp_path_factory.mktemp("xl330")
    return explain(replace(recording, trajectories=quick), None, out, effects=LOSSES, workers=1)


def test_losses_of_the_pendulum_are_load_friction_and_a_set(pendulum):
    joint = pendulum.joints[0].joint
    assert "load_friction" in names(pendulum, joint)
    assert not {"torque_saturation", "supply_sag", "command_delay", "backlash"} & names(
        pendulum, joint
    )
    assert any("torque_saturation" in members for members in pendulum.ambiguous)
    # What hangs on the arm is known, not fitted, and belongs to the model all the same.
    assert pendulum.identified.parameters[joint]["tau_g_nm"] == pytest.approx(0.49 * 9.81 * 0.1)


def test_telemetry_speaks_against_sag_latency_and_backlash(pendulum):
    (reasons,) = pendulum.not_tried.values()
    assert "voltage falls by" in reasons["supply_sag"]
    assert "duty cycle" in reasons["command_delay"] and "duty cycle" in reasons["backlash"]


def test_the_pendulum_is_predicted_at_gains_left_out(pendulum):
    gains = [
        [row for row in pendulum.trajectories if f"_p{gain}." in row.file]
        for gain in (100, 400, 800)
    ]
    # Coulomb and viscous friction alone leave 63.9 mrad, a load-dependent Stribeck model 51.7.
    assert pendulum.held_out.identified_mae_rad < MAE_RAD
    for rows in gains:  # their motions are about equally long
        before, after = (
            np.mean([getattr(r, f"{m}_mae_rad") for r in rows]) for m in ("baseline", "identified")
        )
        assert after < 0.8 * before
    # It swings freely once the torque is off, and what damping is left then is not dry friction's.
    joint = pendulum.joints[0].joint
    parameters = pendulum.identified.parameters[joint]
    assert 0.005 < parameters["kd_off"] < 0.5 * parameters["kd"]


@pytest.mark.slow
def test_fits_of_all_candidates_leave_the_valley_of_a_smaller_model(shared_dir, tmp_path):
    """Fits that end in it leave 42 mrad."""
    recording = measured(shared_dir, "xl330_pendulum")
    own = tuple(t for t in recording.trajectories if t.conditions["p_gain"] == 400)
    report = explain(replace(recording, trajectories=own), None, tmp_path, workers=1)
    assert report.held_out.identified_mae_rad < 0.038


@pytest.fixture(scope="module")
def arm(shared_dir) -> Recording:
    return measured(shared_dir, "so101")


def test_long_recordings_are_analysed_in_pieces_from_rest(arm):
    for chain in chains(arm):
        trajectories, folds, _ = design(arm, chain, 0)
        parts = pieces(arm, chain, trajectories)
        column = int(chain.columns[0])
        assert len(trajectories) >= 9 and len(set(folds)) == 6
        chosen = [arm.trajectories[i] for i in trajectories]
        length = sum(
            t.time[end - 1] - t.time[first] for t, (first, end) in zip(chosen, parts, strict=True)
        )
        assert 0.9 * MAX_MOTION_S < length <= MAX_MOTION_S
        for t, (first, _) in zip(chosen, parts, strict=True):
            assert first == 0 or held(t, column, arm.encoder_resolution_rad)[first]


@pytest.mark.slow
def test_friction_dead_zone_and_backlash_tie_on_the_vertical_axis(arm, tmp_path):
    effects = (*FRICTION, "gravity_load")
    report = explain(only(arm, "Rotation"), None, tmp_path, effects=effects, workers=1)
    assert report.verdict == "ambiguous" and not report.effects
    assert set(report.ambiguous[0]) == set(FRICTION)
    assert report.held_out.reduction > 0.4


@pytest.mark.slow
def test_halves_of_the_elbow_agree_on_dry_friction(arm, tmp_path):
    """With a load, or in one direction more than in the other, the motions do not tell."""
    whole = only(arm, "Elbow")
    halves = [replace(whole, trajectories=whole.trajectories[first::2]) for first in (0, 1)]
    sets = []
    for number, recording in enumerate((whole, *halves)):
        report = explain(recording, None, tmp_path / str(number), effects=LOAD, workers=1)
        certain = [row.name for row in report.families if row.verdict == "certain"]
        assert certain == ["dry friction"]
        (elbow,) = report.joints
        assert elbow.identified_rmse_rad < 0.5 * elbow.baseline_rmse_rad
        sets.append({row.effects for row in report.models})
    assert set.intersection(*sets)
