"""Recordings of the hidden plant: they hide what they hide, and are what the hidden machine did."""

import json

import numpy as np
import pytest

from vd.gap.bench.hidden_plant import OUTSIDE
from vd.gap.bench.hide import (
    ENCODER_COUNT,
    Hiding,
    hide,
    parse_effect,
    simulate_hidden,
    truth_path,
)
from vd.kernels.servo.effects import EFFECTS
from vd.logs.excitations import MENU, JointRange, excitation_set
from vd.logs.recording import read_recording


def test_the_recording_tells_nothing_and_the_truth_lies_beside_it(tmp_path):
    out = tmp_path / "r"
    hidden = hide(Hiding("servo", {"backlash": {"width_rad": 0.05}}, seed=4), out)
    text = (out / "recording.json").read_text() + " ".join(p.name for p in out.iterdir())
    assert not any(name in text for name in (*EFFECTS, *OUTSIDE, "seed", "truth"))
    truth = json.loads(truth_path(out).read_text())
    assert truth_path(out).parent == tmp_path
    assert truth["effects"]["backlash"] == {
        "joints": ["joint"],
        "parameters": {"width_rad": {"joint": 0.05}},
    }
    assert 2.4 <= truth["base"]["kp"]["joint"] <= 3.6
    recording = read_recording(out)
    trajectory, made = recording.trajectories[3], hidden.recording.trajectories[3]
    np.testing.assert_allclose(trajectory.position, made.position, atol=1e-6)
    np.testing.assert_allclose(trajectory.time, made.time, atol=1e-9)
    counts = trajectory.position / ENCODER_COUNT
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-2)
    assert 0.5e-3 < np.diff(trajectory.time).std() < 2.5e-3


def test_seeds_repeat_and_differ():
    effects = {"command_jitter": {"sigma_s": 0.01}}
    one, two, other = (simulate_hidden(Hiding("servo", effects, seed=s)) for s in (1, 1, 2))
    for a, b in zip(one.recording.trajectories, two.recording.trajectories, strict=True):
        np.testing.assert_array_equal(a.position, b.position)
    assert one.truth["base"] != other.truth["base"]


def test_a_finger_is_recorded_by_name():
    motion = {"excitations": ("torque_release",)}
    rubbing = Hiding("dclaw3", {"coulomb_friction": {"tau_c_nm": 0.05}}, **motion)
    hidden = simulate_hidden(rubbing)
    first = hidden.recording
    other = Hiding("dclaw4", joints=("f1_j1", "f1_j2", "f1_j3"), **motion)
    second = simulate_hidden(other).recording
    assert first.joints == ("f0_j1", "f0_j2", "f0_j3") and second.joints[0] == "f1_j1"
    assert hidden.truth["effects"]["coulomb_friction"]["parameters"]["tau_c_nm"] == {
        "f0_j1": 0.05, "f0_j2": 0.05, "f0_j3": 0.05}  # fmt: skip
    falling = first.trajectories[1]
    assert falling.joints == ("f0_j2",) and not falling.enabled[-1, 1] and falling.enabled[-1, 0]
    assert falling.position[150, 1] - falling.position[-1, 1] > 0.02


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"model": "dclaw9"}, "dclaw9"),
        ({"model": "dclaw3", "joints": ("f0_j1", "f1_j2", "f0_j3")}, "one finger"),
        ({"model": "servo", "effects": {"gremlins": {}}}, "gremlins"),
        ({"model": "servo", "effects": {"backlash": {"depth": 1.0}}}, "depth"),
        ({"model": "servo", "effects": {"backlash": {"width_rad": np.nan}}}, "finite"),
        ({"model": "servo", "effects": {"backlash": {"width_rad": -0.04}}}, "negative"),
        ({"model": "servo", "effects": {"joint_coupling": {}}}, "one joint"),
        ({"model": "servo", "excitations": ("dance",)}, "dance"),
    ],
)
def test_what_cannot_be_hidden_is_refused(options, words):
    with pytest.raises(ValueError, match=words):
        simulate_hidden(Hiding(**options))


def test_effects_are_read_from_the_command_line():
    assert parse_effect("command_delay") == ("command_delay", {})
    assert parse_effect("stribeck_friction:tau_s_nm=0.2, v_s_rad_s=1e-1") == (
        "stribeck_friction",
        {"tau_s_nm": 0.2, "v_s_rad_s": 0.1},
    )
    for text in ("backlash:width_rad", "backlash:width_rad=wide"):
        with pytest.raises(ValueError, match="width_rad=NUMBER"):
            parse_effect(text)


def test_excitations_stay_within_the_joints_and_excite_one_each():
    reach = JointRange(("a", "b"), np.array([-0.5, -2.0]), np.array([1.5, 2.0]), p_gain=800.0)
    for name in MENU:
        for motion in excitation_set(reach, (name,)):
            still = [j for j, joint in enumerate(reach.joints) if joint not in motion.joints]
            assert len(still) == 1 and np.ptp(motion.command[:, still]) == 0.0
            assert (motion.command > reach.lower).all() and (motion.command < reach.upper).all()
            assert motion.time[0] == 0.0 and np.allclose(np.diff(motion.time), 0.01)
    paper = excitation_set(reach)
    assert 40.0 < sum(m.duration for m in paper) / 2 < 60.0 and len(paper) == 16
    assert {m.conditions["p_gain"] for m in excitation_set(reach, ("gain_ladder",))} == {
        200.0,
        400.0,
        800.0,
    }
