"""What vd-gap makes of a recording of the twin and of the log of a run, exactly.

On a simulated clock.
"""

import contextlib
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("dynamixel_sdk", reason="needs the extra `hardware`")

from motor_plant import NewtonPlant
from simulated_hand import simulated_bus
from test_hand_import import MIMIC, PARTS, write_urdf

from vd.assets_usd.hand_import.importer import import_hand
from vd.assets_usd.hands import load_hand
from vd.deploy.clock import Pacer
from vd.deploy.hardware import record
from vd.deploy.hardware.connect import Connection
from vd.deploy.hardware.control_table import TICK_MODULUS
from vd.deploy.hardware.joints import read_joints
from vd.deploy.loop.action import ActionFilter
from vd.deploy.loop.log import LogWriter
from vd.deploy.loop.loop import ControlLoop
from vd.deploy.loop.policy_runner import PolicyDecision, PolicyRunner
from vd.deploy.safety.safety import SafeHand
from vd.envs.cfg import ReorientCfg
from vd.gap.chain import chains
from vd.gap.rollout import Rollouts
from vd.gap.steps import Analysis, Settings
from vd.kernels.servo.actuators import COMMAND_DELAY
from vd.logs.recording import read_recording
from vd.policy.stopping import StoppingRule
from vd.sim.cfg import SimCfg

DELAY_S = 0.04
LAYER = """#usda 1.0
(
    defaultPrim = "toy"
)
over "toy"
{
    over "f1_j4"
    {
        custom double vd:command_delay:delay_s = 0.04
    }
}
"""
THINKING_S = 0.03
"""Time that a policy takes to decide."""
KINDS = ("step_medium", "step_large", "sine_0.50hz", "sine_1.00hz")


@given(seed=st.integers(0, 2**32 - 1), rate=st.floats(-1e-4, 1e-4), begin=st.floats(0.0, 60.0))
def test_late_packets_do_not_move_the_times_of_states(seed, rate, begin):
    """The motors' own clocks time them."""
    rng = np.random.default_rng(seed)
    true = 1000.0 + 0.01 * np.arange(300) + rng.uniform(0.0, 0.002, 300)
    phase = begin + rng.uniform(0.0, 1e-3, 9)
    ticks = (1e3 * ((true[:, None] - 1000.0) * (1.0 + rate) + phase)).astype(int) % TICK_MODULUS
    waited = np.where(
        rng.random(300) < 0.25, rng.uniform(0.0, 0.02, 300), rng.uniform(0.0, 1e-4, 300)
    )
    found = record.measured_at(true - waited, ticks)
    # A clock of whole milliseconds says no more; 2100 random draws stay below 0.55 ms.
    assert np.abs(found - true).max() < 1e-3


@pytest.mark.slow
def test_a_late_command_of_the_twin_is_named(tmp_path, monkeypatch):
    """Four motions of the last joint of four, and three candidates: enough for one effect."""
    layer, said = tmp_path / "late.usda", tmp_path / "said.yaml"
    layer.write_text(LAYER)
    ids = dict(zip(("a1", "a2", "b1", "b2", "b3", "b4"), (5, 1, 2, 4, 3, 9), strict=True))
    motors = {
        name: {"model": "XL330-M288", "id": id, "sign": (-1) ** id} for name, id in ids.items()
    }
    said.write_text(json.dumps({"motors": motors}))
    parts = [part.replace(MIMIC, "") for part in PARTS]
    hand = import_hand(write_urdf(tmp_path, parts), tmp_path / "out", str(said)).hand
    joints = read_joints(hand)
    motions = record.motions_of(joints, (1,), ("steps_and_sines",))
    chosen = [m for m in motions if m.joints == ("f1_j4",) and m.excitation in KINDS]

    @contextlib.contextmanager
    def connect(_, **twin_options):
        late = read_joints(load_hand(str(hand.path), layer=layer))
        plant = NewtonPlant(late, SimCfg(physics_hz=960.0))
        with simulated_bus(hand, joints, plant) as (_, bus):
            yield Connection(joints, bus)

    monkeypatch.setattr(record, "connect", connect)
    monkeypatch.setattr(record, "motions_of", lambda *_: chosen)
    cfg = record.RecordCfg(
        hand=str(hand.path), port="simulated", out=tmp_path / "rec", fingers=(1,)
    )
    assert record.record(replace(cfg, yes=True, realtime=False)) == 0
    candidates = ("command_delay", "coulomb_friction", "backlash")
    analysis = Analysis(Settings(tmp_path / "rec", effects=candidates), tmp_path / "gap")
    analysis.run("close")
    (found,) = analysis.explained().effects
    assert found.name == "command_delay" and found.joints == ("f1_j4",)
    assert found.parameters["delay_s"].value == pytest.approx(DELAY_S, abs=0.001)
    closed = json.loads((tmp_path / "gap" / "close.json").read_text())["closing"]
    assert closed["identified_rmse_rad"] < 0.1 * closed["baseline_rmse_rad"]
    again = load_hand(str(hand.path), layer=tmp_path / "gap" / "identified.usda")
    assert again.servo[5, COMMAND_DELAY] == pytest.approx(DELAY_S, abs=0.001)


class Waving(PolicyRunner):
    """A policy that moves all joints of dclaw3 back and forth, each in its own time."""

    def __init__(self, clock):
        super().__init__(ReorientCfg(), StoppingRule())
        self._clock, self._step = clock, 0

    def decide(self, sensed):
        """After a while."""
        self._clock.sleep(THINKING_S)
        self._step += 1
        return PolicyDecision(0.8 * np.sin(0.4 * self._step + np.arange(9.0)), float("nan"))


def rollout(folder, plant_hand, episode_s):
    """The log of a run without an object."""
    hand = load_hand("dclaw3")
    joints = read_joints(hand)
    plant = NewtonPlant(read_joints(plant_hand), SimCfg(physics_hz=960.0))
    with simulated_bus(hand, joints, plant) as (_, bus):
        run = {"goals": [[0.0, 0.0, 0.0, 1.0]]}
        with SafeHand(bus, joints) as safe:
            safe.arm()
            safe.move(np.tile([0.0, 0.3, -0.5], 3), 0.5)
            log = LogWriter(folder, hand, run, servo={}, clock=bus.clock)
            pacer, actions = Pacer(12.0, bus.clock), ActionFilter(hand, ReorientCfg())
            loop = ControlLoop(
                safe, Waving(bus.clock), actions, pacer, log, episode_s=episode_s, hold_s=0.0
            )
            loop.run([np.array([0.0, 0.0, 0.0, 1.0])])
        log.finish("done")
    return folder


def test_a_run_tells_when_its_goals_were_sent(tmp_path):
    """The true model follows them; with the times of the states it would be early."""
    hand = load_hand("dclaw3")
    run = read_recording(rollout(tmp_path / "log", hand, 4.0))
    (motion,) = run.trajectories
    stamped = replace(run, trajectories=(replace(motion, command_time=None),))

    def error(recording):
        chain = chains(recording, hand)[0]
        rollouts = Rollouts(chain, recording)
        return np.median(np.abs(rollouts.predict(chain.start_row[None])[0] - rollouts.measured))

    assert error(run) < 0.001 < 0.01 < error(stamped)
