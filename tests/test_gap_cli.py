"""``vd-gap`` on the command line: steps, resuming, exit statuses, the layer, the plan."""

import csv
import dataclasses
import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
from gap_reports import FRICTION, JOINT, base_columns, rubbing_servo, servo_report

from vd.assets_usd.hand_data import HandError
from vd.assets_usd.hand_layer import read_bare_layer
from vd.gap import cli, steps
from vd.gap.chain import chains
from vd.gap.close import simulate_again, write_identified
from vd.gap.plan import discard_plan, plan, write_plan
from vd.gap.result import Report
from vd.kernels.servo import actuators
from vd.logs.recording import read_recording


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A bare servo with friction."""
    return rubbing_servo(tmp_path_factory.mktemp("recordings") / "servo")


def test_a_recording_that_cannot_be_used_is_refused_before_warp_is_imported(recording, tmp_path):
    folder = shutil.copytree(recording, tmp_path / "r")
    table = sorted(folder.glob("*.csv"))[0]
    lines = table.read_text().splitlines()
    table.write_text("\n".join(lines[:200] + lines[300:]) + "\n")
    script = (
        "import sys; from vd.gap.cli import main; status = main(sys.argv[1:]); "
        "print(status, 'warp' in sys.modules, file=sys.stderr)"
    )
    arguments = [sys.executable, "-c", script, "run", str(folder), "--out", str(tmp_path / "out")]
    said = subprocess.run(arguments, capture_output=True, text=True, timeout=120).stderr
    assert "cut the file" in said and table.name in said
    assert said.endswith("2 False\n") and not (tmp_path / "out").exists()


@pytest.fixture
def fitted(monkeypatch, recording):
    """Stands for the fit, which has tests of its own; counts how often each step ran."""
    workflow = pytest.importorskip("vd.gap.workflow")
    calls = {"find": 0, "explain": 0, "options": []}

    def find(found, hand, out, **options):
        calls["find"] += 1
        calls["options"].append(options)
        (out / steps.FIND).write_text("{}")

    def explain(found, hand, out, **options):
        calls["explain"] += 1
        report, curves = servo_report(recording)
        curves.write(out / steps.CURVES)
        report.write(out / steps.EXPLAIN)

    monkeypatch.setattr(workflow, "find", find)
    monkeypatch.setattr(workflow, "explain", explain)
    return calls


def test_run_writes_everything_and_says_what_was_found(fitted, recording, tmp_path, capsys):
    out = tmp_path / "gap"
    assert cli.main(["run", str(recording), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "lacks coulomb friction on joint (150 mN m)" in printed
    assert str(out / "report.html") in printed
    report = Report.read(out / "report.json")
    assert report.closing is not None and report.closing.simulator == "rollout"
    assert report.closing.identified_rmse_rad < 0.5 * report.closing.baseline_rmse_rad
    assert report.command.startswith(f"vd-gap run {recording}")
    assert {path.name for path in out.iterdir()} >= {"identified.usda", "report.html"}


@pytest.fixture
def no_figures(monkeypatch):
    """The report as JSON alone: its page has a test of its own."""

    def write(report, curves, folder):
        report.write(folder / "report.json")
        (folder / "report.html").write_text("")

    monkeypatch.setattr("vd.gap.report.write_report", write)


def test_finished_steps_are_kept_until_something_changes(
    fitted, no_figures, recording, tmp_path, capsys
):
    out = str(tmp_path / "gap")
    arguments = ["run", str(recording), "--out", out]
    assert cli.main(arguments) == cli.main(arguments) == 0
    assert (fitted["find"], fitted["explain"]) == (1, 1)
    assert "nothing has changed" in capsys.readouterr().err
    (tmp_path / "gap" / "explain.json").unlink()
    assert cli.main(arguments) == 0
    assert (fitted["find"], fitted["explain"]) == (1, 2)
    assert cli.main([*arguments, "--seed", "5"]) == 0
    assert (fitted["find"], fitted["explain"]) == (2, 3)
    assert cli.main([*arguments, "--seed", "5", "--fresh"]) == 0
    assert (fitted["find"], fitted["explain"]) == (3, 4)


def test_steps_go_on_from_what_the_one_before_wrote(
    fitted, no_figures, recording, tmp_path, capsys
):
    said = [str(recording), "--out", str(tmp_path / "gap"), "--seed", "7"]
    assert cli.main(["explain", *said]) == 1
    assert "run vd-gap find" in capsys.readouterr().err
    for step in ("find", "explain", "close", "report"):
        assert cli.main([step, *said]) == 0, step
    assert (fitted["find"], fitted["explain"]) == (1, 1)
    assert "--seed 7" in Report.read(tmp_path / "gap" / "report.json").command
    assert cli.main(["close", *said[:-1], "8"]) == 1
    assert "run vd-gap find" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--effects", "coulomb_friction,stiction"], "stiction"),
        (["--device", "tpu"], "device is 'tpu'"),
        (["--model", "dclaw3"], "is of a bare servo, not of dclaw3"),
    ],
)
def test_wrong_flags_are_named(recording, tmp_path, capsys, flags, message):
    assert cli.main(["run", str(recording), "--out", str(tmp_path / "gap"), *flags]) == 1
    assert message in capsys.readouterr().err


def test_hide_writes_a_recording_and_the_truth(tmp_path, capsys):
    out = tmp_path / "rec"
    effect = "command_delay:delay_s=0.04"
    assert cli.main(["hide", "servo", "--effect", effect, "--out", str(out)]) == 0
    truth = json.loads((tmp_path / "rec.truth.json").read_text())
    assert truth["effects"]["command_delay"]["parameters"]["delay_s"] == {"joint": 0.04}
    assert len(read_recording(out).trajectories) == 8
    assert cli.main(["hide", "servo", "--effect", "stiction", "--out", str(out)]) == 1
    assert "unknown effect 'stiction'" in capsys.readouterr().err
    (tmp_path / "rec.truth.json").unlink()  # as a measured recording
    assert cli.main(["hide", "servo", "--out", str(out)]) == 1
    assert "holds a recording" in capsys.readouterr().err


def test_layer_of_a_bare_servo_reads_back_as_it_was_identified(recording, tmp_path):
    report, curves = servo_report(recording)
    layer = tmp_path / "identified.usda"
    found = read_recording(recording)
    write_identified(report, tmp_path, found, None, {})
    rows, intervals = read_bare_layer(layer, (JOINT,))
    for column, value in {**base_columns(), actuators.COULOMB_TORQUE: FRICTION}.items():
        assert rows[0, column] == pytest.approx(value, rel=1e-6)
    np.testing.assert_allclose(intervals[0, actuators.COULOMB_TORQUE], (0.14, 0.16), rtol=1e-6)
    closing, delivered, again = simulate_again(report, layer, found, None, None, curves)
    np.testing.assert_allclose(again.identified, curves.identified, atol=1e-5)
    assert closing.identified_rmse_rad == pytest.approx(
        report.held_out.identified_rmse_rad, rel=0.2
    )
    assert delivered is not None and delivered.trajectory == found.trajectories[-1].file
    error = again.identified[-len(found.trajectories[-1].time) :] - found.trajectories[-1].position
    assert delivered.rmse_rad == pytest.approx(float(np.sqrt(np.mean(error**2))))
    start = chains(found, None)[0].start_row[0].copy()
    start[actuators.COMMAND_DELAY] = 0.02
    write_identified(report, tmp_path, found, None, {JOINT: start})  # what was started from stays
    rows, _ = read_bare_layer(layer, (JOINT,))
    assert rows[0, actuators.COMMAND_DELAY] == pytest.approx(0.02)
    assert rows[0, actuators.COULOMB_TORQUE] == pytest.approx(FRICTION)
    with pytest.raises(HandError, match="no joint /servo/elbow"):
        read_bare_layer(layer, ("elbow",))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no such hand layer"),
        ("not USD", "x.usda"),
        ("#usda 1.0\n", "not an identified servo model"),
    ],
)
def test_layers_that_are_none_are_named(tmp_path, text, message):
    layer = tmp_path / "x.usda"
    if text is not None:
        layer.write_text(text)
    with pytest.raises(HandError, match=message):
        read_bare_layer(layer, (JOINT,))


def test_plan_takes_the_motions_of_the_families_that_are_tied(recording, tmp_path):
    report, _ = servo_report(
        recording, verdict="ambiguous", ambiguous=(("coulomb_friction", "backlash"),)
    )
    result = plan(report, read_recording(recording), None)
    assert result.families == {JOINT: ("dry friction", "play")}
    assert result.sets == ("slow_triangle", "gain_ladder")
    assert "to decide on dry friction and play" in result.sentence
    written = json.loads(write_plan(result, tmp_path).read_text())
    assert written["sets"] == [*result.sets]
    for entry in written["trajectories"]:
        with (tmp_path / entry["file"]).open() as file:
            rows = list(csv.DictReader(file))
        assert {"t", f"command.{JOINT}"} <= set(rows[0])
        time = [float(row["t"]) for row in rows]
        assert time[0] == 0.0 and np.all(np.diff(time) > 0.0)
        assert time[-1] == pytest.approx(entry["duration_s"], abs=1e-5)
    commands = {tmp_path / entry["file"] for entry in written["trajectories"]}
    shorter = dataclasses.replace(result, motions=result.motions[:1])
    write_plan(shorter, tmp_path)
    left = set((tmp_path / "next_experiment").iterdir())
    assert len(left) == 1 and left < commands, "of a plan before nothing is left"
    (tmp_path / "next_experiment" / "mine.csv").write_text("t\n")
    discard_plan(tmp_path)
    assert [path.name for path in (tmp_path / "next_experiment").iterdir()] == ["mine.csv"]
    assert not (tmp_path / "next_experiment.json").exists()


def test_plan_for_motions_that_show_too_little(recording):
    report, _ = servo_report(recording, verdict="under_excited")
    report = dataclasses.replace(report, families=())
    found = read_recording(recording)
    slow = dataclasses.replace(found, trajectories=found.trajectories[3:4])
    result = plan(report, slow, None)
    assert tuple(result.families) == (JOINT,) and result.sets == ("steps_and_sines",)
    assert "do not show" in result.sentence
