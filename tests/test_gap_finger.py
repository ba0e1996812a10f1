"""Joints of a finger: one cause on all of them is named once, beside links of other mass too."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vd.kernels.servo.actuators as servo
from vd.assets_usd.hands import load_hand
from vd.gap.chain import chains
from vd.gap.rollout import Rollouts
from vd.gap.workflow import explain, find
from vd.logs.recording import Recording, Trajectory

JOINTS = ("f0_j1", "f0_j2", "f0_j3")
NOISE = 3e-4


def blank() -> Recording:
    """Steps and sines of each joint of a finger, one after the other."""
    time = np.arange(0.0, 2.0, 0.01)
    step = np.where(time > 0.3, 0.7, 0.0) - np.where(time > 1.1, 1.2, 0.0)
    shapes = {
        "step": step,
        "slow": 0.7 * np.sin(np.pi * time),
        "fast": 0.6 * np.sin(3.0 * np.pi * time),
    }
    parts = []
    for column, joint in enumerate(JOINTS):
        for name, shape in shapes.items():
            command = np.zeros((len(time), 3))
            command[:, column] = shape
            still, on = np.zeros_like(command), np.ones(command.shape, bool)
            file = f"{joint}_{name}.csv"
            parts.append(Trajectory(file, name, (joint,), {}, time, command, still, on))
    return Recording(Path("made up"), "dclaw3", JOINTS, {}, 1e-5, tuple(parts))


def recorded(factors: tuple[float, float, float], friction: float) -> Recording:
    """What a finger with links of other mass, as shares of the model's, and friction would have answered."""
    recording = blank()
    (chain,) = chains(recording, load_hand("dclaw3"))
    scale = np.array(factors)
    true = replace(chain, mass=chain.mass * scale, inertia=chain.inertia * scale[:, None, None])
    rows = chain.start_row.copy()
    rows[:, servo.COULOMB_TORQUE] = friction
    rollouts = Rollouts(true, recording, dt=1.0 / 960.0)
    path = rollouts.predict(rows[None])[0]
    path = path + np.random.default_rng(0).normal(0.0, NOISE, path.shape)
    parts = [
        replace(t, position=path[rollouts.sample_trajectory == i].astype(float))
        for i, t in enumerate(recording.trajectories)
    ]
    return replace(recording, trajectories=tuple(parts))


def test_no_line_of_progress_is_that_of_another(tmp_path: Path) -> None:
    lines: list[str] = []
    hand = load_hand("dclaw3")
    find(recorded((1.0, 1.0, 1.0), 0.0), hand, tmp_path, workers=1, progress=lines.append)
    fitted = [line.partition(": baseline")[0] for line in lines if ": baseline" in line]
    assert len(fitted) >= len(JOINTS) and len({*fitted}) == len(fitted)


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.0, 0.03])
def test_links_of_other_mass_are_no_friction_and_friction_beside_them_is_named(
    friction: float, tmp_path: Path
) -> None:
    recording = recorded((0.86, 1.14, 0.9), friction)
    effects = ("coulomb_friction", "gravity_load")
    report = explain(recording, load_hand("dclaw3"), tmp_path, effects=effects, workers=1)
    joints = [effect.joints for effect in report.effects if effect.name == "coulomb_friction"]
    assert joints == ([(joint,) for joint in JOINTS] if friction else [])
    for effect in report.effects:
        if effect.name == "coulomb_friction":
            assert effect.parameters["tau_c_nm"].value == pytest.approx(friction, rel=0.1)
