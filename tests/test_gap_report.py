"""The gap report: what it must contain, what it must refuse, and a page that needs nothing else."""

import dataclasses
import html
import json
import math
import re

import numpy as np
import pytest
from gap_reports import FRICTION, JOINT, rubbing_servo, servo_report

from vd.gap import words
from vd.gap.plan import parameter_columns
from vd.gap.report import write_report
from vd.gap.result import (
    Alternative,
    Closing,
    Misfit,
    Predictions,
    Report,
    effect_values,
)
from vd.kernels.servo import actuators
from vd.kernels.servo.effects import EFFECTS


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A report with a named friction, and its curves."""
    report, curves = servo_report(rubbing_servo(tmp_path_factory.mktemp("recordings") / "servo"))
    (friction,) = report.effects
    rival = Alternative("backlash", 9e-3, (5e-3, 9e-3))
    whole = dataclasses.replace(
        report,
        effects=(dataclasses.replace(friction, alternatives=(rival,)),),
        findings=(Misfit(JOINT, "joint: it sticks at every reversal", {"lag_s": 0.04}),),
        closing=Closing("rollout", "identified.usda", 0.02, 0.002, {JOINT: (0.02, 0.002)}),
        command="vd-gap run recordings/servo --out gap",
    )
    return whole, curves


@pytest.fixture
def report(made):
    return made[0]


@pytest.fixture
def curves(made):
    return made[1]


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
    assert effect["parameters"]["tau_c_nm"] == {
        "value": FRICTION,
        "ci95": [0.14, 0.16],
        "unit": "N m",
    }
    assert {"name", "held_out_rmse_rad", "difference_ci95"} == set(effect["alternatives"][0])
    assert {"trajectories", "baseline_rmse_rad", "identified_rmse_rad", "reduction", "ci95"} <= set(
        values["held_out"]
    )


def test_numbers_that_are_not_known_come_back_as_nan(report, tmp_path):
    report = dataclasses.replace(
        report, held_out=dataclasses.replace(report.held_out, ci95=(math.nan,) * 2)
    )
    report.write(tmp_path / "report.json")
    read = Report.read(tmp_path / "report.json")
    assert all(math.isnan(x) for x in read.held_out.ci95)


def test_a_file_that_is_no_report_is_named(tmp_path):
    path = tmp_path / "report.json"
    for text in ("{", "[]", '{"verdict": "effects"}', '{"format": "vd-gap-report/0"}'):
        path.write_text(text)
        with pytest.raises(ValueError, match=re.escape(str(path))):
            Report.read(path)


def test_curves_come_back(curves, tmp_path):
    path = tmp_path / "predictions.npz"
    curves.write(path)
    read = Predictions.read(path)
    assert read.joints == curves.joints and read.files == curves.files
    np.testing.assert_array_equal(read.identified, curves.identified)
    path.write_text("t")
    with pytest.raises(ValueError, match="not curves of vd-gap"):
        Predictions.read(path)


def test_parameters_reach_their_columns(report):
    columns = parameter_columns(report, JOINT)
    assert columns[actuators.COULOMB_TORQUE] == FRICTION and columns[actuators.KP] == 3.0
    assert effect_values(report.effects, JOINT) == {
        "coulomb_friction": {"tau_c_nm": (FRICTION, 0.14, 0.16)}
    }
    assert effect_values(report.effects, "another") == {}


def test_page_stands_alone_and_says_what_was_found(report, curves, tmp_path):
    write_report(report, curves, tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert not re.findall(r'(?:src|href)="(?!data:)', page), "the page must not need another file"
    assert "http" not in re.sub(r"base64,[^\"]*", "", page)
    text = html.unescape(re.sub(r"<[^>]+>", " ", re.sub(r"base64,[^\"]*", "", page)))
    assert "lacks coulomb friction on joint (150 mN m)" in text
    assert "vd-gap run recordings/servo --out gap" in text
    for row in report.evidence:
        assert words.plain(row.reason) in text
    for effect in EFFECTS.values():
        assert words.plain(effect.name) in text
        assert effect.meaning in text
    pngs = {path.name for path in tmp_path.glob("*.png")}
    assert {"gap.png", f"residual_{JOINT}.png"} <= pngs
    assert any(name.startswith(f"overlay_{JOINT}") for name in pngs)
    assert all((tmp_path / name).read_bytes().startswith(b"\x89PNG") for name in pngs)


OUTCOMES = {
    "no_gap": ({"effects": ()}, "No gap"),
    "ambiguous": (
        {"effects": (), "ambiguous": (("coulomb_friction", "backlash"),)},
        "It is coulomb friction or backlash",
    ),
    "under_excited": ({"effects": (), "next_experiment": "Record a chirp."}, "do not determine"),
    "unknown": ({"effects": ()}, "No effect that was tried explains it"),
}


@pytest.mark.parametrize("verdict", OUTCOMES)
def test_every_verdict_has_its_sentence_and_its_page(report, curves, tmp_path, verdict):
    changes, sentence = OUTCOMES[verdict]
    joint = dataclasses.replace(report.joints[0], open_sets=changes.get("ambiguous", ()))
    report = dataclasses.replace(report, verdict=verdict, joints=(joint,), closing=None, **changes)
    assert sentence in words.verdict_sentence(report)
    assert words.next_step(report)
    write_report(report, curves, tmp_path)
    page = html.unescape((tmp_path / "report.html").read_text())
    assert words.next_step(report) in page


def test_of_one_recorded_finger_the_layer_of_all_is_to_be_trained_with(report, curves, tmp_path):
    source = dataclasses.replace(report.recording, model="dclaw3")
    closing = dataclasses.replace(report.closing, whole_hand_layer="identified-all-fingers.usda")
    one = dataclasses.replace(report, recording=source, closing=closing, hand="dclaw3")
    plain = dataclasses.replace(one, closing=report.closing)
    assert "--hand-layer identified.usda goes on" in words.next_step(plain)
    assert "--hand-layer identified-all-fingers.usda goes on" in words.next_step(one)
    write_report(one, curves, tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert "vd-train adapt POLICY --hand-layer identified-all-fingers.usda" in page
    assert "--hand-layer identified.usda --out DIR" in page, (
        "what was recorded is compared with the recording"
    )


@pytest.mark.parametrize("told", [True, False])
def test_torques_of_a_bare_servo_are_said_to_be_relative(report, curves, tmp_path, told):
    source = dataclasses.replace(report.recording, model="servo", relative_torques=told)
    write_report(dataclasses.replace(report, recording=source), curves, tmp_path)
    assert ("Torques are relative" in (tmp_path / "report.html").read_text()) == told
