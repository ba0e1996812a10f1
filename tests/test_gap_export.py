"""An identified servo moves alike in MuJoCo, and no format hides what it cannot hold."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from gap_recordings import TRUE, blank, true_row

import vd.kernels.servo.actuators as servo
from vd.assets_usd.hand_layer import write_layer
from vd.assets_usd.hands import load_hand
from vd.gap.chain import chains
from vd.gap.cli import main
from vd.gap.rollout import STEP_S, Rollouts

CAUSES = {
    "coulomb_friction": {"tau_c_nm": (0.1, 0.09, 0.11)},
    "command_delay": {"delay_s": (0.03, 0.028, 0.032)},
    "gravity_load": {"tau_g_nm": 0.3, "phase_rad": 0.4},
    "torque_limit": {"tau_max_nm": 1.0},
}
FREE = {**TRUE, servo.VELOCITY_LIMIT: 50.0}
"""MJCF has no limit of the speed: one that does not bind."""
COLUMNS = {
    **FREE,
    servo.COULOMB_TORQUE: 0.1,
    servo.COMMAND_DELAY: 0.03,
    servo.GRAVITY_TORQUE: 0.3,
    servo.GRAVITY_PHASE: 0.4,
    servo.TORQUE_LIMIT: 1.0,
}


def exported(folder, effects, *words):
    """Files that are written of a bare servo with some effects."""
    names = ("kp", "kd", "velocity_limit", "inertia")
    baseline = {"j": dict(zip(names, FREE.values(), strict=True))}
    layer = folder / "identified.usda"
    write_layer(
        layer, "servo", baseline=baseline, effects={"j": effects}, tool="a test", recording="none"
    )
    assert main(["export", str(layer), "--out", str(folder / "out"), *words]) == 0
    return {path.name: path for path in (folder / "out").iterdir()}


def in_mujoco(path, trajectory):
    """Positions of the exported servo at a trajectory's stamps [rad]."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    positions = []
    for time, command in zip(trajectory.time, trajectory.command[:, 0], strict=True):
        while data.time < time - 1e-9:
            mujoco.mj_step(model, data)
        positions.append(data.qpos[0])
        data.ctrl[0] = command
    return np.array(positions)


def difference(path, columns):
    """Between MuJoCo and our simulation, the largest of all motions, root mean square [rad]."""
    recording = blank()
    (chain,) = chains(recording)
    rollouts = Rollouts(chain, recording)
    ours = rollouts.predict(true_row(chain.start_row, columns)[None])[0, :, 0]
    errors = []
    for index, trajectory in enumerate(recording.trajectories):
        own = ours[rollouts.sample_trajectory == index]
        errors.append(np.sqrt(np.mean((in_mujoco(path, trajectory) - own) ** 2)))
    return max(errors)


@pytest.mark.parametrize("left_out", [None, *CAUSES])
def test_the_same_servo_moves_alike_in_mujoco(tmp_path, left_out):
    """Within what the joint goes at its largest speed in half a step, and not without a cause."""
    kept = {name: values for name, values in CAUSES.items() if name != left_out}
    far = difference(exported(tmp_path, kept)["identified.xml"], COLUMNS)
    half_step = 0.5 * STEP_S * 2.0 * np.pi * 1.5 * 0.6  # of the fastest sine
    assert far < half_step if left_out is None else far > 2.0 * half_step


def test_actuators_of_other_laboratories_hold_values_ranges_and_whole_delays(tmp_path):
    files = exported(tmp_path, CAUSES, "--step", "0.004")
    for name, module, friction, delays in (
        ("identified_mjlab.py", "mjlab", "frictionloss", ("delay_min_lag", "delay_max_lag")),
        ("identified_isaaclab.py", "isaaclab", "dynamic_friction", ("min_delay", "max_delay")),
    ):
        text = files[name].read_text()
        head, mark, body = text.partition("\nfrom ")
        line, _, code = body.partition("\n")
        assert mark and line.startswith(f"{module}.actuator")
        space = {line.split()[-1]: SimpleNamespace}
        exec(code, space)
        joint = vars(space["ACTUATORS"]["j"])
        assert joint["stiffness"] == pytest.approx(3.0) and joint[friction] == pytest.approx(0.1)
        assert [joint[key] for key in delays] == [7, 8]  # 28 to 32 ms
        assert space["RANGES"]["j"][friction] == pytest.approx((0.09, 0.11))
        assert "gravity_load.tau_g_nm = 0.3" in head


def test_what_a_format_cannot_hold_is_said(tmp_path, capsys):
    files = exported(tmp_path, {"backlash": {"width_rad": 0.02}})
    assert capsys.readouterr().out.count("j lacks backlash.width_rad = 0.02") == 3
    assert all("backlash.width_rad = 0.02" in path.read_text() for path in files.values())


def test_a_bare_servo_goes_into_a_hand_without_its_rig(tmp_path):
    files = exported(tmp_path, CAUSES, "--hand", "dclaw3")
    hand = load_hand("dclaw3", layer=files["identified-in-hand.usda"])
    plain = load_hand("dclaw3")
    assert hand.servo[:, servo.KP] == pytest.approx(3.0)
    assert hand.servo[:, servo.COULOMB_TORQUE] == pytest.approx(0.1)
    assert hand.servo_interval[:, servo.COMMAND_DELAY, 1] == pytest.approx(0.032)
    assert (hand.servo[:, servo.GRAVITY_TORQUE] == 0.0).all()
    assert hand.armature == pytest.approx(plain.armature)
