"""The gap report: what it must contain, what it must refuse, and a page that needs nothing else."""

import dataclasses
import html
import json
import math
import re

import numpy as np
import pytest

from vd.gap import words
from vd.gap.report import write_report
from vd.gap.result import (
    Alternative,
    Candidate,
    Closing,
    Estimate,
    Finding,
    Fit,
    HeldOut,
    JointGap,
    NamedEffect,
    Predictions,
    Report,
    Source,
    TrajectoryError,
    effect_values,
    parameter_columns,
)
from vd.kernels.servo import actuators
from vd.kernels.servo.effects import EFFECTS

JOINTS = ("f0_j1", "f0_j2", "f0_j3")
FILES = ("steps_1.csv", "sine_0.50hz.csv", "sine_1.00hz.csv")
FLOOR, DELAY, RATE, SECONDS = 1.5e-3, 0.04, 60.0, 12.0


def answer(time, command, delay, rng=None, bandwidth=14.0):
    """A first-order servo behind a delay, in closed loop with nothing."""
    late = command[np.clip(np.searchsorted(time, time - delay, side="right") - 1, 0, None)]
    position = np.zeros_like(late)
    for i in range(1, len(time)):
        step = time[i] - time[i - 1]
        position[i] = position[i - 1] + (late[i] - position[i - 1]) * (1.0 - math.exp(-bandwidth * step))
    return position if rng is None else position + rng.normal(0.0, FLOOR, len(time))


def sample_curves():
    """Curves of three joints under steps and sines, one of them with a delay."""
    rng = np.random.default_rng(0)
    time = np.arange(0.0, SECONDS, 1.0 / RATE)
    columns = {name: [] for name in ("command", "measured", "baseline", "identified")}
    for index in range(len(FILES)):
        if index == 0:
            command = 0.4 * np.sign(np.sin(2.0 * np.pi * 0.3 * time))
        else:
            command = 0.4 * np.sin(np.pi * index * time)
        late = [DELAY if joint == JOINTS[1] else 0.0 for joint in JOINTS]
        columns["command"].append(np.stack([command] * len(JOINTS), axis=1))
        columns["measured"].append(np.stack([answer(time, command, d, rng) for d in late], axis=1))
        columns["baseline"].append(np.stack([answer(time, command, 0.0)] * len(JOINTS), axis=1))
        columns["identified"].append(np.stack([answer(time, command, d) for d in late], axis=1))
    return Predictions(
        time=np.tile(time, len(FILES)),
        trajectory=np.repeat(np.arange(len(FILES)), len(time)),
        **{name: np.concatenate(parts) for name, parts in columns.items()},
        joints=JOINTS,
        files=FILES,
    )


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def sample_report(curves, **changes):
    """A report of the curves with a named delay."""
    before, after = curves.baseline - curves.measured, curves.identified - curves.measured
    rows = {i: curves.trajectory == i for i in range(len(FILES))}
    told = dict.fromkeys(JOINTS, ("no_gap", "the error is at the noise floor"))
    told[JOINTS[1]] = ("effects", "a delay removes nearly all of it")
    gap = [
        JointGap(joint, FLOOR, rms(before[:, j]), (0.0, 1.0), rms(after[:, j]), (0.0, 1.0), *told[joint])
        for j, joint in enumerate(JOINTS)
    ]
    tried = [
        ("command_delay", 1, 0.93, "named", "largest gain"),
        ("command_filter", 1, 0.6, "rejected", "worse than the delay by 7 mrad"),
        ("backlash", 1, 0.01, "rejected", "gain covers 0"),
        ("coulomb_friction", 2, 0.02, "rejected", "gain under 5 %"),
    ]
    evidence = [
        Candidate((JOINTS[1],), number, name, 9e-3, gain, (gain - 0.1, gain + 0.1), decision, reason)
        for name, number, gain, decision, reason in tried
    ]
    evidence.append(dataclasses.replace(evidence[0], gain=-0.1, decision="rejected", placebo=True))
    delay = NamedEffect(
        "command_delay",
        (JOINTS[1],),
        0.99,
        {"delay_s": Estimate(0.0402, (0.0391, 0.0413), "s")},
        (Alternative("command_filter", 9e-3, (5e-3, 9e-3)),),
    )
    base = {joint: {"kp": 3.0, "kd": 0.21, "velocity_limit": 7.1} for joint in JOINTS}
    values = {
        "verdict": "effects",
        "noise_floor_rad": FLOOR,
        "baseline": Fit(rms(before), {j: rms(before[:, i]) for i, j in enumerate(JOINTS)}, 0.01, base),
        "findings": (
            Finding(
                JOINTS[1],
                "the joint starts 40 ms after the simulation at every onset and reversal, the faster the "
                "worse",
                {"lag_s": 0.04},
            ),
        ),
        "effects": (delay,),
        "ambiguous": (),
        "identified": Fit(rms(after), {j: rms(after[:, i]) for i, j in enumerate(JOINTS)}, 0.002, base),
        "held_out": HeldOut(FILES, rms(before), rms(after), 1.0 - rms(after) / rms(before), (0.8, 0.95)),
        "next_experiment": "",
        "seconds": 41.0,
        "recording": Source("recordings/finger", "dclaw3", JOINTS, 3, len(curves.time), 3 * SECONDS, "XL430"),
        "hand": "dclaw3",
        "joints": tuple(gap),
        "evidence": tuple(evidence),
        "trajectories": tuple(
            TrajectoryError(
                FILES[i], FILES[i][:-4], joint, True, rms(before[rows[i], j]), rms(after[rows[i], j])
            )
            for i in range(len(FILES))
            for j, joint in enumerate(JOINTS)
        ),
        "closing": Closing("newton", "identified.usda", rms(before), rms(after), {JOINTS[1]: (0.02, 0.002)}),
        "rollouts": 120000,
        "rollouts_per_s": 4000.0,
        "command": "vd-gap run recordings/finger --out gap",
    }
    return Report(**{**values, **changes})


@pytest.fixture(scope="module")
def curves():
    return sample_curves()


@pytest.fixture(scope="module")
def report(curves):
    return sample_report(curves)


CONTRACT = {
    *("format", "verdict", "noise_floor_rad", "baseline", "findings", "effects", "ambiguous"),
    *("identified", "held_out", "next_experiment", "seconds"),
}


def test_json_has_the_keys_of_the_contract_and_comes_back_as_it_was(report, tmp_path):
    report.write(tmp_path / "report.json")
    assert Report.read(tmp_path / "report.json") == report
    values = json.loads((tmp_path / "report.json").read_text())
    assert set(values) >= CONTRACT
    assert values["format"] == "vd-gap-report/1"
    assert {"parameters", "rmse_rad", "mae_rad", "per_joint"} <= set(values["baseline"])
    assert {"rmse_rad", "per_joint"} <= set(values["identified"])
    assert {"joint", "where", "signature"} == set(values["findings"][0])
    effect = values["effects"][0]
    assert {"name", "joints", "confidence", "parameters", "alternatives"} <= set(effect)
    assert effect["parameters"]["delay_s"] == {"value": 0.0402, "ci95": [0.0391, 0.0413], "unit": "s"}
    assert {"name", "held_out_rmse_rad", "difference_ci95"} == set(effect["alternatives"][0])
    assert {"trajectories", "baseline_rmse_rad", "identified_rmse_rad", "reduction", "ci95"} <= set(
        values["held_out"]
    )


def test_numbers_that_are_not_known_come_back_as_nan(curves, tmp_path):
    report = sample_report(curves)
    report = dataclasses.replace(report, held_out=dataclasses.replace(report.held_out, ci95=(math.nan,) * 2))
    report.write(tmp_path / "report.json")
    read = Report.read(tmp_path / "report.json")
    assert all(math.isnan(x) for x in read.held_out.ci95)
    assert read.hand == "dclaw3" and read.hand_layer is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"verdict": "maybe"}, "verdict is 'maybe'"),
        ({"verdict": "no_gap"}, "effects names 1"),
        ({"effects": ()}, "effects names 0"),
        ({"verdict": "ambiguous", "effects": ()}, "ambiguous is empty"),
        ({"ambiguous": (("stiction",),)}, "no effects are called stiction"),
        ({"format": "vd-gap-report/0"}, "run vd-gap again"),
    ],
)
def test_contradictions_are_refused(report, changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(report, **changes).validate()


def test_a_file_that_is_no_report_is_named(tmp_path):
    path = tmp_path / "report.json"
    for text in ("{", "[]", '{"verdict": "effects"}'):
        path.write_text(text)
        with pytest.raises(ValueError, match=re.escape(str(path))):
            Report.read(path)


def test_curves_come_back_and_are_checked(curves, tmp_path):
    path = tmp_path / "predictions.npz"
    curves.write(path)
    read = Predictions.read(path)
    assert read.joints == curves.joints and read.files == curves.files
    np.testing.assert_array_equal(read.identified, curves.identified)
    dataclasses.replace(curves, measured=curves.measured[:-1]).write(path)
    with pytest.raises(ValueError, match="measured has shape"):
        Predictions.read(path)


def test_parameters_reach_their_columns(report):
    columns = parameter_columns(report, JOINTS[1])
    assert columns[actuators.COMMAND_DELAY] == 0.0402
    assert columns[actuators.KP] == 3.0
    assert actuators.COMMAND_DELAY not in parameter_columns(report, JOINTS[0])
    assert effect_values(report.effects, JOINTS[1]) == {
        "command_delay": {"delay_s": (0.0402, 0.0391, 0.0413)}
    }
    assert effect_values(report.effects, JOINTS[0]) == {}


def test_page_stands_alone_and_says_what_was_found(report, curves, tmp_path):
    files = write_report(report, curves, tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert not re.findall(r'(?:src|href)="(?!data:)', page), "the page must not need another file"
    assert "http" not in re.sub(r"base64,[^\"]*", "", page)
    text = html.unescape(re.sub(r"<[^>]+>", " ", re.sub(r"base64,[^\"]*", "", page)))
    assert "lacks command delay on f0_j2 (40.2 ms)" in text
    assert "vd-gap run recordings/finger --out gap" in text
    for row in report.evidence:
        assert row.reason in text
    for effect in EFFECTS.values():
        assert words.plain(effect.name) in text
        assert effect.meaning in text
    pngs = {path.name for path in files if path.suffix == ".png"}
    assert {"gap.png", "overlay_f0_j2_sine_1.00hz.png", "residual_f0_j2.png", "evidence_f0_j2.png"} <= pngs
    assert all((tmp_path / name).read_bytes().startswith(b"\x89PNG") for name in pngs)


OUTCOMES = {
    "no_gap": ({"effects": ()}, "No gap"),
    "ambiguous": (
        {"effects": (), "ambiguous": (("coulomb_friction", "backlash"),)},
        "one of {coulomb friction, backlash} explains it",
    ),
    "under_excited": ({"effects": (), "next_experiment": "Record a chirp."}, "do not determine"),
    "unknown": ({"effects": ()}, "no effect that is known here explains it"),
}


@pytest.mark.parametrize("verdict", OUTCOMES)
def test_every_verdict_has_its_sentence_and_its_page(curves, tmp_path, verdict):
    changes, sentence = OUTCOMES[verdict]
    report = sample_report(curves, verdict=verdict, closing=None, **changes).validate()
    assert sentence in words.verdict_sentence(report)
    assert words.next_step(report)
    write_report(report, None, tmp_path)
    page = html.unescape((tmp_path / "report.html").read_text())
    steps = words.sentences(report.next_experiment or words.next_step(report))
    assert all(step in page for step in steps) and steps[0].endswith(".")


def test_of_one_recorded_finger_the_layer_of_all_is_to_be_trained_with(report, tmp_path):
    assert "pass identified.usda with --hand-layer" in words.next_step(report)
    closing = dataclasses.replace(report.closing, whole_hand_layer="identified-all-fingers.usda")
    one = dataclasses.replace(report, closing=closing, hand="dclaw3")
    assert "pass identified-all-fingers.usda with --hand-layer" in words.next_step(one)
    write_report(one, None, tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert "vd-train teacher --hand dclaw3 --hand-layer identified-all-fingers.usda" in page
    assert "--hand-layer identified.usda --out DIR" in page, (
        "what was recorded is compared with the recording"
    )


@pytest.mark.parametrize("told", [True, False])
def test_torques_of_a_bare_servo_are_said_to_be_relative(report, tmp_path, told):
    source = dataclasses.replace(report.recording, model="servo", relative_torques=told)
    write_report(dataclasses.replace(report, recording=source), None, tmp_path)
    assert ("Torques are relative" in (tmp_path / "report.html").read_text()) == told
