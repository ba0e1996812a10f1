"""The gap report: what it must contain, what it must refuse, and a page that needs nothing else."""

import dataclasses
import html
import json
import math
import re

import numpy as np
import pytest
from gap_reports import FRICTION, JOINT, model, rubbing_servo, servo_report

from vd.gap import words
from vd.gap.report import write_report
from vd.gap.result import (
    Alternative,
    Closing,
    Delivered,
    HeldOut,
    Misfit,
    Predictions,
    Report,
)
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
    *("families", "models", "delivered"),
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
    assert {"trajectory", "rmse_rad"} <= set(values["delivered"])
    assert {"name", "verdict"} <= set(values["families"][0])
    assert {"effects", "parameters", "rmse_rad", "held_out_rmse_rad"} <= set(values["models"][0])
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
    with pytest.raises(ValueError, match="not curves"):
        Predictions.read(path)


def test_page_stands_alone_and_says_what_was_found(report, curves, tmp_path):
    write_report(report, curves, tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert not re.findall(r'(?:src|href)="(?!data:)', page), "the page must not need another file"
    assert "http" not in re.sub(r"base64,[^\"]*", "", page)
    text = html.unescape(re.sub(r"<[^>]+>", " ", re.sub(r"base64,[^\"]*", "", page)))
    assert "lacks coulomb friction on joint (150 mN m)" in text
    assert "vd-gap run recordings/servo --out gap" in text
    for row in report.compared:
        assert words.plain(row.why) in text and words.model_text(row.effects) in text
    assert "placebo" not in text.lower()
    for effect in EFFECTS.values():
        assert words.plain(effect.name) in text
        assert effect.meaning in text
    pngs = {path.name for path in tmp_path.glob("*.png")}
    assert f"residual_{JOINT}.png" in pngs
    assert any(name.startswith(f"overlay_{JOINT}") for name in pngs)
    assert all((tmp_path / name).read_bytes().startswith(b"\x89PNG") for name in pngs)


OUTCOMES = {
    "no_gap": ({"effects": ()}, "No gap"),
    "ambiguous": (
        {"effects": (), "ambiguous": (("coulomb_friction", "backlash"),)},
        "2 models are as good: coulomb friction or backlash",
    ),
    "under_excited": ({"effects": (), "next_experiment": "Record a chirp."}, "do not determine"),
    "unknown": ({"effects": ()}, "No model that was tried explains half of it"),
}


@pytest.mark.parametrize("verdict", OUTCOMES)
def test_every_verdict_has_its_sentence_and_its_page(report, curves, tmp_path, verdict):
    changes, sentence = OUTCOMES[verdict]
    joint = dataclasses.replace(report.joints[0], open_sets=changes.get("ambiguous", ()))
    if verdict == "ambiguous":
        models = tuple(dataclasses.replace(each, why="") for each in report.compared[:2])
        changes = {**changes, "models": models}
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


def outcome(report: Report, **changes: object) -> str:
    """All sentences of a report with changes."""
    changed = dataclasses.replace(report, **changes)
    lines = [words.verdict_sentence(changed), words.next_step(changed)]
    return "\n".join([*lines, *words.open_questions(changed), *words.families_sentences(changed)])


def test_a_headline_that_its_proof_contradicts_says_so(report):
    """One motion held out makes the plain model extrapolate; fitted, and as delivered, little is won."""
    text = outcome(
        report,
        held_out=HeldOut(("a",), 0.0775, 0.0164, 0.79, (0.6, 0.9)),
        baseline=dataclasses.replace(report.baseline, rmse_rad=0.0161),
        identified=dataclasses.replace(report.identified, rmse_rad=0.0157),
        delivered=Delivered("b.csv", 0.0181, 0.0162),
    )
    assert "from 77.5 mrad to 16.4 mrad" in text and "from 16.1 mrad to 15.7 mrad" in text
    assert "b.csv, which no fit saw, the layer as written leaves 18.1 mrad" in text
    assert "no better there" in text


def test_an_error_that_rises_is_not_said_to_fall(report):
    text = outcome(report, held_out=HeldOut(("a",), 0.010, 0.012, -0.2, (-0.4, 0.1)))
    assert "rises from 10 mrad to 12 mrad" in text and "falls from 10" not in text


def test_credit_is_shared_between_the_effects_that_earn_it(report):
    friction = report.effects[0]
    saturation = dataclasses.replace(friction, name="torque_saturation")
    compared = (
        model(("coulomb_friction", "torque_saturation"), {}, 0.031),
        model(("torque_saturation",), {}, 0.094),
        model(("coulomb_friction",), {}, 0.065),
        model(("backlash",), {}, 0.033),
    )
    text = outcome(report, effects=(friction,), provisional=(saturation,), compared=compared)
    assert "coulomb friction and torque saturation" in text
    assert "94 mrad without coulomb friction and 65 mrad without torque saturation" in text


def test_sets_are_whole_models_with_their_errors(report):
    """Single effects of different models do not make another: no line offers them alone."""
    effects = (("torque_limit", "backlash"), ("elastic_transmission", "coulomb_friction"))
    models = tuple(
        model(names, {}, error) for names, error in zip(effects, (4e-3, 5e-3), strict=True)
    )
    sets = (("torque_limit", "elastic_transmission", "backlash", "coulomb_friction"),)
    joint = dataclasses.replace(report.joints[0], verdict="ambiguous", open_sets=sets)
    text = outcome(
        report, verdict="ambiguous", effects=(), models=models, ambiguous=sets, joints=(joint,)
    )
    assert "torque limit with backlash (4 mrad fitted, 4 mrad held out)" in text
    assert "elastic transmission with coulomb friction (5 mrad fitted, 5 mrad held out)" in text
    assert "torque limit, elastic" not in text and "torque limit or elastic" not in text


def test_what_is_not_closed_is_not_called_closed(report):
    text = outcome(report, identified=dataclasses.replace(report.identified, rmse_rad=0.038))
    assert "still 38 times the noise floor" in text
    nothing = outcome(report, verdict="unknown", effects=(), families=(), models=())
    assert "falls" not in nothing and "lacks" not in nothing


def test_sentences_take_their_figures_from_the_report(report):
    """Every number of the verdict is one of the report's."""
    shown = re.findall(r"([\d.]+) mrad", words.verdict_sentence(report))
    values = [report.held_out.baseline_rmse_rad, report.held_out.identified_rmse_rad]
    values += [report.baseline.rmse_rad, report.identified.rmse_rad]
    values += [report.delivered.rmse_rad, report.delivered.baseline_rmse_rad]
    assert len(shown) >= 4 and {*shown} <= {words.mrad(value).split()[0] for value in values}
