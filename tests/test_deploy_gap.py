"""An effect hidden in the twin is named by vd-gap from a recording, exactly: on a simulated clock."""

import contextlib
import json
from dataclasses import replace

import pytest

pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")

from simulated_hand import simulated_bus

from vd.assets_usd.hands import load_hand
from vd.deploy import record
from vd.deploy.connect import Connection
from vd.deploy.joints import uncalibrated
from vd.deploy.newton_hand import NewtonHand
from vd.gap import cli as gap
from vd.sim.cfg import SimCfg

DELAY_S = 0.04
LAYER = """#usda 1.0
(
    defaultPrim = "dclaw4"
)
over "dclaw4"
{
    over "f0_j1"
    {
        custom double vd:command_delay:delay_s = 0.04
    }
}
"""
KINDS = ("step_medium", "step_large", "sine_0.50hz", "sine_1.00hz")


@pytest.mark.slow
def test_a_late_command_of_the_twin_is_named(tmp_path, monkeypatch):
    """Four motions of one joint, and three candidates: the whole of it is in docs/results/deploy.md."""
    layer = tmp_path / "late.usda"
    layer.write_text(LAYER)
    hand = load_hand("dclaw4")
    joints = uncalibrated(hand)
    motions = record.motions_of(hand, (0,), ("steps_and_sines",))
    chosen = [m for m in motions if m.excitation.joints == ("f0_j1",) and m.excitation.name in KINDS]

    @contextlib.contextmanager
    def connect(_):
        plant = NewtonHand(load_hand("dclaw4", layer=layer), joints, SimCfg(physics_hz=3840.0))
        with simulated_bus(hand, joints, plant) as (_, bus):
            yield Connection(hand, joints, bus)

    monkeypatch.setattr(record, "connect", connect)
    monkeypatch.setattr(record, "motions_of", lambda *_: chosen)
    cfg = record.RecordCfg(hand="dclaw4", port="simulated", out=tmp_path / "rec", fingers=(0,))
    assert record.record(replace(cfg, yes=True, realtime="off")) == 0
    candidates = "command_delay,coulomb_friction,backlash"
    out = tmp_path / "gap"
    assert gap.main(["run", str(tmp_path / "rec"), "--out", str(out), "--effects", candidates]) == 0
    report = json.loads((out / "report.json").read_text())
    found = {effect["name"]: effect for effect in report["effects"] if "f0_j1" in effect["joints"]}
    assert set(found) == {"command_delay"}
    assert found["command_delay"]["parameters"]["delay_s"]["value"] == pytest.approx(DELAY_S, abs=0.001)
