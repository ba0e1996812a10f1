"""Newton replays a recording as the rollouts predict it."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from test_hand_import import MIMIC, PARTS, link, write_urdf
from test_hand_import import joint as a_joint

from vd.assets_usd.hand_data import HandModel
from vd.assets_usd.hand_import.importer import import_hand
from vd.assets_usd.hands import load_hand
from vd.gap.chain import chains
from vd.gap.close import counterparts
from vd.gap.rollout import STEP_S, Rollouts
from vd.kernels.servo import actuators as servo
from vd.logs.excitations import JointRange, excitation_set
from vd.logs.recording import Recording
from vd.sim.replay import simulate_hand

HAND = load_hand("dclaw3")
EFFECTS: dict[str, dict[str, float]] = {
    "plain": {},
    "late": {
        "COMMAND_DELAY": 0.013,
        "READ_DELAY": 0.021,
        "ENCODER_BIAS": 0.02,
        "JITTER_SIGMA": 0.01,
    },
    "shaped": {"FILTER_TAU": 0.03, "ACCELERATION_LIMIT": 40.0, "BACKLASH_WIDTH": 0.03},
    "rubbing": {"COULOMB_TORQUE": 0.1, "LOAD_FRICTION": 0.15},
    "weak": {"TORQUE_LIMIT": 0.5, "THERMAL_RATE": 0.1, "SUPPLY_SAG": 0.3},
    "loaded": {
        "PAYLOAD_INERTIA": 2e-3,
        "GRAVITY_TORQUE": 0.05,
        "INTEGRAL_GAIN": 2.0,
        "DEAD_ZONE_WIDTH": 0.02,
    },
    "elastic": {"ELASTIC_STIFFNESS": 3.0, "ELASTIC_DAMPING": 5e-3, "ELASTIC_INERTIA": 2e-3},
}


@cache
def motions(
    kind: str, joints: tuple[str, ...], seconds: float, hand: HandModel = HAND
) -> Recording:
    """The start of one of the paper's excitations on some joints, with the commands as positions."""
    reach = JointRange(hand.joint_names, hand.lower, hand.upper)
    trajectories = []
    for motion in excitation_set(reach):
        if motion.excitation == kind and motion.joints[0] in joints:
            short = motion.piece(0, int(np.searchsorted(motion.time, seconds, side="right")))
            start = np.broadcast_to(short.command[0], short.command.shape)
            trajectories.append(replace(short, file=f"{motion.joints[0]}.csv", position=start))
    return Recording(Path("unsaved"), hand.name, hand.joint_names, {}, 1e-4, tuple(trajectories))


def rows(**columns: float) -> np.ndarray:
    """The hand's servo rows with columns, by the names of their constants, set for all joints."""
    values = HAND.servo.copy()
    for name, value in columns.items():
        values[:, getattr(servo, name)] = value
    return values


def test_newton_agrees_with_the_rollouts_under_every_kind_of_effect():
    recording = motions("sine_0.50hz", ("f0_j1", "f0_j2"), 0.9)
    each = np.stack([rows(**columns) for columns in EFFECTS.values()])
    newton = simulate_hand(recording, HAND, each, dt=STEP_S)[..., :3]
    predicted = Rollouts(chains(recording, HAND)[0], recording).predict(each[:, :3])
    error = np.sqrt(np.mean((newton - predicted) ** 2, axis=(1, 2)))
    moved = np.sqrt(np.mean((predicted - predicted[0]) ** 2, axis=(1, 2)))
    for name, rmse, effect in zip(EFFECTS, error, moved, strict=True):
        assert rmse < 1e-3, f"{name}: {rmse:.2e} rad"
        assert name == "plain" or effect > 3.0 * rmse, f"{name} changes nothing: {effect:.2e} rad"


def test_newton_agrees_on_fingers_that_differ(tmp_path):
    """Fingers of two and of six joints, which couple within themselves."""
    longer = [link("b_5", 0.03), a_joint("b5", "b_4", "b_5", 'xyz="0 0 0.03"', "1 0 0")]
    longer += [link("b_6", 0.03), a_joint("b6", "b_5", "b_6", 'xyz="0 0 0.03"')]
    parts = [part.replace(MIMIC, "") for part in PARTS]
    hand = import_hand(write_urdf(tmp_path, [*parts, *longer]), tmp_path / "out").hand
    recording = motions("sine_0.50hz", ("f0_j2", "f1_j1", "f1_j5"), 0.9, hand)
    each = np.stack([hand.servo, hand.servo, hand.servo])
    each[1, :, [servo.COULOMB_TORQUE, servo.COMMAND_DELAY]] = [[0.05], [0.013]]
    each[2, 2, servo.COUPLING_0 + 5], each[2, 7, servo.COUPLING_0 + 4] = 0.3, 0.4
    newton = simulate_hand(recording, hand, each, dt=STEP_S)
    short, long = chains(recording, hand)
    assert (len(short.joints), len(long.joints)) == (2, 6)
    for chain in (short, long):
        predicted = Rollouts(chain, recording).predict(each[:, chain.columns])
        error = np.sqrt(np.mean((newton[:, :, chain.columns] - predicted) ** 2, axis=(1, 2)))
        assert error.max() < 1e-3
    assert np.abs(predicted[1:] - predicted[0]).max(axis=(1, 2)).min() > 0.02, "what was set shows"
    assert counterparts(hand, ("f0_j1", "f0_j2")) == {}, "no finger is like it"


def test_commands_act_from_when_they_were_sent():
    """Sent 7 ms after the rows' stamps they act as those that are late by as much do."""
    recording = motions("sine_0.50hz", ("f0_j1",), 0.5)
    (motion,) = recording.trajectories
    sent = replace(recording, trajectories=(replace(motion, command_time=motion.time + 0.007),))
    got = simulate_hand(sent, HAND, rows()[None], dt=STEP_S)[0]
    np.testing.assert_allclose(
        got,
        simulate_hand(recording, HAND, rows(COMMAND_DELAY=0.007)[None], dt=STEP_S)[0],
        atol=1e-5,
    )
    assert np.abs(got - simulate_hand(recording, HAND, rows()[None], dt=STEP_S)[0]).max() > 1e-3


def test_load_friction_follows_what_the_drive_gives_not_what_its_controller_wants():
    """Steps so large that the drive is at its limit, which the solver keeps."""
    recording = motions("step_large", ("f0_j2",), 3.0)
    command = recording.trajectories[0].command[:, 1]
    assert np.ptp(command) * HAND.kp[1] > 1.5 * HAND.effort[1]
    each = np.stack([rows(), rows(LOAD_FRICTION=0.3)])
    newton = simulate_hand(recording, HAND, each, dt=STEP_S)[..., 1]
    predicted = Rollouts(chains(recording, HAND)[0], recording).predict(each[:, :3], joint=1)
    assert np.sqrt(np.mean((newton - predicted) ** 2, axis=1)).max() < 2e-3


def test_torque_off_lets_a_finger_hang():
    recording = motions("step_large", ("f0_j2",), 1.0)
    (trajectory,) = recording.trajectories
    enabled = np.zeros_like(trajectory.enabled)
    limp = replace(recording, trajectories=(replace(trajectory, enabled=enabled),))
    held = simulate_hand(recording, HAND, rows()[None], dt=1.0 / 240.0)[0]
    free = simulate_hand(limp, HAND, rows()[None], dt=1.0 / 240.0)[0]
    assert np.ptp(held[:, 1]) > 0.3 and np.abs(free[:, 1] - held[:, 1]).max() > 0.3
