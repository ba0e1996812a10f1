"""The servo in the simulator.

Off it is not there, on it delays, rubs, measures and forgets as it should.
"""

import dataclasses

import numpy as np
import pytest
import warp as wp

from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.kernels.servo import actuators as servo
from vd.sim.cfg import SimCfg
from vd.sim.scene import build_scene
from vd.sim.simulator import Simulator

CFG = dataclasses.replace(SimCfg(), control_hz=60.0)
HAND = load_hand("dclaw3")
D = HAND.num_joints
START = HAND.start.astype(np.float32)
STEPS = 10


@pytest.fixture(autouse=True)
def on_device(device: str):
    """Every test of this file on every device."""
    with wp.ScopedDevice(device):
        yield


def rows(**columns: float) -> np.ndarray:
    """The hand's servo rows with columns, by the names of their constants, set for all joints."""
    values = HAND.servo.copy()
    for name, value in columns.items():
        values[:, getattr(servo, name)] = value
    return values


def simulator(servo_rows: np.ndarray | None, worlds: int = 1) -> Simulator:
    """Environments at rest at the task's start, commands at the present positions."""
    scene = build_scene(
        hand=HAND,
        objects=load_set("cube")[:1],
        num_envs=worlds,
        cfg=CFG,
        device=wp.get_device().alias,
    )
    sim = Simulator(scene, CFG, servo_rows=servo_rows)
    state = sim.joint_q.numpy()
    state[:, :D] = START
    sim.joint_q.assign(state)
    command(sim, 0.0)
    if sim.servo is not None:
        sim.servo.reset(wp.ones(worlds, dtype=wp.int32))
    return sim


def command(sim: Simulator, offset: float) -> None:
    """Command all joints to their start plus ``offset`` [rad]."""
    target = sim.target.numpy()
    target[:, :D] = START + offset
    sim.target.assign(target)


def response(
    sim: Simulator, offset: float = 0.2, steps: int = STEPS
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and measured positions after each control step of a step command, [steps, N, D]."""
    command(sim, offset)
    true, measured = [], []
    for _ in range(steps):
        sim.step()
        true.append(sim.joint_q.numpy()[:, :D].copy())
        measured.append(true[-1] if sim.servo is None else sim.servo.measured_q.numpy().copy())
    return np.array(true), np.array(measured)


def test_a_servo_without_effects_moves_as_the_plain_drive():
    plain, _ = response(simulator(None))
    with_servo, measured = response(simulator(rows()))
    # The drive's damping is late by half a physics step, the servo's is not.
    assert np.abs(with_servo - plain).max() < 0.01 and np.abs(plain[-1] - START).min() > 0.1
    assert np.array_equal(measured, with_servo)


def test_dry_friction_holds_what_it_can_and_no_more():
    """The drive's torque is kp times the offset; gravity on a finger is below 0.1 N m."""
    hold, _ = response(simulator(rows(COULOMB_TORQUE=0.5)), offset=0.05, steps=30)
    assert np.abs(hold - START).max() < 1e-3
    free, _ = response(simulator(rows(COULOMB_TORQUE=0.5)), offset=0.4, steps=60)
    # It comes to rest within friction / kp of the command.
    left = np.abs(START + 0.4 - free[-1, 0])
    assert np.all(left < (0.5 + 0.1) / HAND.kp) and np.all(left > 1e-3)


def test_velocity_limit_and_inertia_are_per_world():
    each = np.stack([rows(VELOCITY_LIMIT=0.5), rows(PAYLOAD_INERTIA=0.02)])
    sim = simulator(each, worlds=2)
    armature = sim.solver.mjw_model.dof_armature.numpy()[:, :D]
    assert np.allclose(armature[1] - armature[0], 0.02)
    true, _ = response(sim)
    speed = np.abs(np.diff(true, axis=0)) / CFG.control_dt
    assert speed[:, 0].max() <= 0.5 + 1e-4 < speed[:, 1].max()


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (rows(COMMAND_DELAY=0.5), "command_delay:delay_s"),
        (rows(TORQUE_LIMIT=np.nan), "torque_limit:tau_max_nm"),
    ],
)
def test_rows_that_cannot_be_simulated_are_refused(bad, message):
    with pytest.raises(ValueError, match=message):
        simulator(bad)
