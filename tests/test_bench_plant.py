"""The hidden plant obeys closed forms and another engine; recordings of it hide what they hide."""

from dataclasses import replace
from functools import partial

import mujoco
import numpy as np
import pytest
from test_hand_import import MESH, MIMIC, PARTS, write_urdf

from vd.assets_usd.hand_import.importer import import_hand
from vd.assets_usd.hands import load_hand
from vd.gap.bench.hidden_finger import finger_of
from vd.gap.bench.hidden_plant import HiddenPlant, Physics, PlantRun, simulate
from vd.gap.bench.hide import (
    COUPLING,
    ENCODER_COUNT,
    NOISE_RAD,
    Hiding,
    machine,
    reading_noise,
    simulate_hidden,
)
from vd.gap.bench.sizes import effect_at
from vd.gap.chain import chains
from vd.gap.rollout import Rollouts
from vd.kernels.servo import actuators as kernel
from vd.kernels.servo.effects import EFFECTS

KP, KD, INERTIA = 2.0, 0.1, 4.0e-3
STEP = 0.4


def servo(joints=1, gravity=0.0, limit=50.0, **effects) -> HiddenPlant:
    ones = np.ones(joints)
    return HiddenPlant(
        tuple(f"j{i}" for i in range(joints)),
        KP * ones,
        KD * ones,
        limit * ones,
        INERTIA * ones,
        gravity * ones,
        effects={
            name: {key: v * ones for key, v in values.items()} for name, values in effects.items()
        },
    )


def answer(
    plant, command, duration=2.0, rate=500.0, dt=4e-4, **run
) -> tuple[np.ndarray, np.ndarray]:
    """Positions [T, J] at regular stamps to a command, a function of time."""
    time = np.arange(int(duration * rate) + 1) / rate
    values = np.stack([np.broadcast_to(command(time), time.shape)] * len(plant.joints), axis=1)
    enabled = run.pop("enabled", np.ones(values.shape, dtype=bool))
    return time, simulate([PlantRun(plant, time, values, enabled, **run)], dt=dt)[0]


def step(time):
    return np.where(time < 0.1, 0.0, STEP)


def ramp(time):
    """Up at 0.2 rad/s for 2 s, then down."""
    return 0.2 * np.minimum(time, 4.0 - time)


BASE = {
    "kp": kernel.KP,
    "kd": kernel.KD,
    "velocity_limit": kernel.VELOCITY_LIMIT,
    "inertia": kernel.INERTIA,
}

SMALL = ("thermal_drift", "load_friction", "supply_sag", "torque_saturation")
"""Effects that show little at the size of the others."""


def test_it_and_the_rollouts_of_the_analysis_agree_on_every_effect():
    """They share no code; both are rounded to encoder counts, of 0.44 mrad root mean square."""
    exact = Hiding("servo", seed=1, base_spread=0.0, excitations=("gain_ladder",))
    made = simulate_hidden(exact)
    motions = made.recording.trajectories
    sizes, runs = {}, []
    for name in EFFECTS:
        if name in (COUPLING, "command_jitter"):
            continue
        sizes[name] = effect_at(name, 3.0 if name in SMALL else 1.0)
        hiding = replace(exact, effects={name: sizes[name]})
        _, plant = machine(hiding, np.random.default_rng(exact.seed))
        runs += [PlantRun(plant, m.time, m.command, m.enabled, m.conditions) for m in motions]
    moved = iter(simulate(runs))  # at once: a step costs the same for one run and for many
    for name, parameters in sizes.items():
        measured = []
        for motion in motions:
            position = np.round(next(moved) / ENCODER_COUNT) * ENCODER_COUNT
            measured.append(replace(motion, position=position))
        recording = replace(made.recording, trajectories=tuple(measured))
        (chain,) = chains(recording)
        rows = np.stack([chain.start_row] * 2)
        for key, column in BASE.items():
            rows[:, 0, column] = made.truth["base"][key]["joint"]
        for parameter in EFFECTS[name].parameters:
            rows[0, 0, parameter.column] = parameters[parameter.name]
        predicted = Rollouts(chain, recording).predict(rows)
        positions = np.concatenate([motion.position for motion in measured])
        true, without = np.sqrt(np.mean((predicted - positions) ** 2, axis=(1, 2)))
        assert true < 0.7e-3 and without > 1.2 * true, (
            f"{name}: {true:.1e} rad, without it {without:.1e}"
        )


def test_another_joint_pulls_through_the_coupling():
    plant = servo(2, joint_coupling={"from_1": np.array([0.3, 0.3])})
    _, path = answer(plant, step, duration=3.0)
    np.testing.assert_allclose(path[-1], [STEP, 1.3 * STEP], atol=1e-3)  # the own entry is ignored


def test_effects_outside_the_table_act():
    _, path = answer(servo(cogging={"amplitude_nm": 0.2, "per_turn": 20.0}), step)
    assert KP * (STEP - path[-1, 0]) == pytest.approx(-0.2 * np.sin(20 * path[-1, 0]), abs=1e-3)
    _, path = answer(servo(cable_spring={"k_nm_rad": 1.0, "slack_rad": 0.1}), step)
    assert path[-1, 0] == pytest.approx((KP * STEP + 0.1) / (KP + 1.0), abs=1e-3)
    warm = {"temperature_friction": {"cold_nm": 0.2, "warm_nm": 0.0, "time_s": 10.0}}
    _, early = answer(servo(**warm), ramp)
    _, late = answer(servo(**warm), ramp, session_s=100.0)
    assert np.abs(late - early).max() > 0.05


def test_dry_friction_builds_up_over_a_travel_and_stays_within_its_bounds():
    """Below it a joint bends and comes back, as on the spring that friction over the travel is."""
    friction, travel = 0.2, 2.0e-3
    stiff = replace(
        servo(coulomb_friction={"tau_c_nm": friction}), physics=Physics(presliding_rad=travel)
    )
    time, path = answer(stiff, lambda time: np.where((time > 0.1) & (time < 1.0), 0.05, 0.0))
    held = KP * 0.05 / (KP + friction / travel)
    assert path[time < 1.0][-1, 0] == pytest.approx(held, rel=0.02) and abs(path[-1, 0]) < 1e-5
    _, path = answer(stiff, step, duration=4.0)
    assert KP * (STEP - path[-1, 0]) <= friction * 1.001


def test_gears_ripple_and_noise_has_a_colour_but_no_other_size():
    geared = replace(servo(), physics=Physics(ripple_nm=0.2, ripple_per_turn=20.0))
    _, path = answer(geared, step)
    assert KP * (STEP - path[-1, 0]) == pytest.approx(-0.2 * np.sin(20 * path[-1, 0]), abs=1e-3)
    rng = np.random.default_rng(0)
    time = np.arange(9999) * 0.01
    white, coloured = (reading_noise(noise_s, (9999, 1), time, rng) for noise_s in (0.0, 0.02))
    for noise, memory in ((white, 0.0), (coloured, np.exp(-0.5))):
        assert noise.std() == pytest.approx(NOISE_RAD, rel=0.1)
        assert np.corrcoef(noise[1:, 0], noise[:-1, 0])[0, 1] == pytest.approx(memory, abs=0.05)


@pytest.mark.parametrize("payload", [0.0, 0.05])
def test_a_finger_moves_as_by_the_steps_of_another_integrator(payload):
    """Also with a load at its tip [kg]."""
    body = partial(finger_of, load_hand("dclaw3"), 0, np.ones(3))
    model = body(payload)
    model.opt.timestep, model.opt.integrator = 1e-4, mujoco.mjtIntegrator.mjINT_RK4
    model.dof_armature[:] = 1e-3
    data = mujoco.MjData(model)
    start = np.array([0.8, -1.0, 1.4])
    data.qpos[:] = start
    expected = []
    for _ in range(100):
        expected.append(data.qpos.copy())
        mujoco.mj_step(model, data, 50)
    ones = np.ones(3)
    plant = HiddenPlant(
        ("a", "b", "c"), ones, 0.02 * ones, 99 * ones, 1e-3 * ones, 0 * ones, body=body
    )
    # Switched off at the start, and so without damping: it falls and swings, bends driving each
    # other.
    time = np.arange(100) * 5e-3
    off = np.zeros((100, 3), dtype=bool)
    conditions = {"payload_kg": payload}
    (moved,) = simulate([PlantRun(plant, time, np.tile(start, (100, 1)), off, conditions)], dt=1e-4)
    assert np.ptp(moved, axis=0).min() > 0.1
    np.testing.assert_allclose(moved, np.array(expected), atol=2e-3)


def test_a_finger_of_any_hand_moves_as_the_rollouts_say(tmp_path, monkeypatch):
    """Four joints about skewed axes, links off them, and dry friction.

    Rounded to encoder counts.
    """
    monkeypatch.setattr("vd.gap.bench.hide.NOISE_RAD", 0.0)
    parts = [part.replace(MIMIC, "").replace(MESH, '<sphere radius="0.01"/>') for part in PARTS]
    hand = import_hand(write_urdf(tmp_path, parts), tmp_path / "out").hand
    names = hand.joint_names[hand.fingers[1]]
    friction = {"coulomb_friction": {"tau_c_nm": 0.02}}
    exact = {"joints": names, "base_spread": 0.0, "excitations": ("torque_release",)}
    made = simulate_hidden(Hiding(str(hand.path), friction, seed=1, **exact))
    (chain,) = chains(made.recording, hand)
    rows = np.stack([chain.start_row] * 2)
    rows[0, :, kernel.COULOMB_TORQUE] = 0.02
    measured = np.concatenate([t.position for t in made.recording.trajectories])
    predicted = Rollouts(chain, made.recording, dt=1.0 / 1920.0).predict(rows)
    true, without = np.sqrt(np.mean((predicted - measured) ** 2, axis=(1, 2)))
    assert len(names) == 4 and true < 1.5e-3 and without > 3.0 * true, (
        f"{true:.1e}, {without:.1e} rad"
    )


def test_too_stiff_a_spring_is_refused():
    stiff = {"elastic_transmission": {"k_nm_rad": 900.0, "c_nms_rad": 0.0, "j_kgm2": 1e-6}}
    with pytest.raises(ValueError, match="too stiff"):
        answer(servo(**stiff), step)
