"""The demo's hidden gap, really hidden and really found."""

import pytest

from vd.gap import cli
from vd.gap.result import Report
from vd.page import Page
from vd.train import demo_gap


@pytest.mark.slow
def test_hidden_backlash_is_found_named_and_closed(tmp_path):
    folder = tmp_path / "demo" / "run"
    demo_gap.find_hidden_gap(folder, 0, "cpu")
    report = demo_gap.read_gap(folder)
    assert report.verdict == "effects"
    (effect,) = report.effects
    assert effect.name == demo_gap.EFFECT
    assert effect.parameters[demo_gap.PARAMETER].value == pytest.approx(demo_gap.SIZE_RAD, rel=0.1)
    assert report.held_out.reduction > 0.8
    assert report.closing.identified_rmse_rad < 2.0 * report.noise_floor_rad

    layer = demo_gap.gap_report(folder).parent / "identified.usda"
    again = [
        "run",
        str(folder / demo_gap.RECORDING),
        "--hand-layer",
        str(layer),
        "--out",
        str(tmp_path / "again"),
    ]
    assert cli.main(again) == 0
    after = Report.read(tmp_path / "again" / "report.json")
    assert after.verdict == "no_gap" and after.hand_layer == str(layer)
    assert after.baseline.rmse_rad < 1.1 * after.noise_floor_rad, "the layer alone explains the recording"

    page = Page("demo")
    demo_gap.add_gap(page, folder, tmp_path / "demo")
    assert 'href="run/gap/report.html"' in page.html()
    assert "<img" in page.html() and "lacks backlash" in page.html()


def test_a_command_that_fails_stops_the_stage(tmp_path, monkeypatch):
    monkeypatch.setattr("vd.gap.cli.main", lambda arguments: 2)
    with pytest.raises(RuntimeError, match="vd-gap hide servo"):
        demo_gap.find_hidden_gap(tmp_path, 0, "cpu")
