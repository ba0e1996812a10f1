"""The hidden plant obeys closed forms and another engine; recordings of it hide what they hide."""

import numpy as np
import pytest

from vd.bench.gap_sizes import effect_at
from vd.bench.hidden_finger import FingerBody
from vd.bench.hidden_plant import OUTSIDE, STEP_S, Plant, Run, simulate
from vd.bench.hide import COUPLING, Hiding, machine
from vd.kernels.servo.effects import EFFECTS

KP, KD, INERTIA = 2.0, 0.1, 4.0e-3
STEP = 0.4


def servo(joints=1, gravity=0.0, limit=50.0, **effects) -> Plant:
    ones = np.ones(joints)
    return Plant(
        tuple(f"j{i}" for i in range(joints)),
        KP * ones,
        KD * ones,
        limit * ones,
        INERTIA * ones,
        gravity * ones,
        effects={name: {key: v * ones for key, v in values.items()} for name, values in effects.items()},
    )


def answer(plant, command, duration=2.0, rate=500.0, dt=4e-4, **run) -> tuple[np.ndarray, np.ndarray]:
    """Positions [T, J] at regular stamps to a command, a function of time."""
    time = np.arange(int(duration * rate) + 1) / rate
    values = np.stack([np.broadcast_to(command(time), time.shape)] * len(plant.joints), axis=1)
    enabled = run.pop("enabled", np.ones(values.shape, dtype=bool))
    return time, simulate([Run(plant, time, values, enabled, **run)], dt=dt)[0]


def step(time):
    return np.where(time < 0.1, 0.0, STEP)


def ramp(time):
    """Up at 0.2 rad/s for 2 s, then down."""
    return 0.2 * np.minimum(time, 4.0 - time)


def linear_step(time):
    """The plain servo's answer to the step, in closed form (two real or complex poles)."""
    poles = np.roots([INERTIA, KD, KP]).astype(complex)
    late = np.maximum(time - 0.1, 0.0)
    a, b = poles
    return STEP * np.real(1.0 + (b * np.exp(a * late) - a * np.exp(b * late)) / (a - b))


def test_the_plain_servo_is_a_linear_oscillator():
    time, path = answer(servo(), step)
    np.testing.assert_allclose(path[:, 0], linear_step(time), atol=2e-5)


def test_delays_and_bias_move_the_recording_and_nothing_else():
    time, plain = answer(servo(), step)
    for effect, inner in (("command_delay", 0.0137), ("read_delay", 0.0137)):
        _, late = answer(servo(**{effect: {"delay_s": inner}}), step)
        np.testing.assert_allclose(late[:, 0], linear_step(time - inner), atol=1e-4)
    _, biased = answer(servo(encoder_bias={"bias_rad": -0.03}), step)
    np.testing.assert_allclose(biased, plain - 0.03, atol=1e-12)


def test_a_filter_and_a_profile_shape_the_command():
    slow = servo(command_filter={"tau_s": 0.3})
    time, path = answer(slow, step, duration=3.0)
    # Three poles in a row: the servo's two and the filter's.
    poles = [*np.roots([INERTIA, KD, KP]).astype(complex), -1.0 / 0.3]
    total = np.ones(len(time), dtype=complex)
    for i, p in enumerate(poles):
        others = [q for k, q in enumerate(poles) if k != i]
        total -= np.exp(p * np.maximum(time - 0.1, 0.0)) * np.prod([q / (q - p) for q in others])
    np.testing.assert_allclose(path[:, 0], STEP * total.real, atol=2e-4)

    stiff = servo(acceleration_limit={"a_max_rad_s2": 2.0})
    time, path = answer(stiff, step, duration=2.0)
    # Half the way accelerating, half braking: 2 sqrt(d / a), and the servo's lag of KD / KP on top.
    arrived = time[np.argmax(path[:, 0] > 0.99 * STEP)]
    assert arrived == pytest.approx(0.1 + 2.0 * np.sqrt(STEP / 2.0), abs=0.06)
    assert np.abs(np.diff(path[:, 0], 2)).max() * 500.0**2 < 2.0 * 1.5


def test_jitter_delays_on_average_and_drops_hold_the_last_command():
    _, plain = answer(servo(), lambda t: 0.5 * t, rate=100.0)
    _, jittered = answer(
        servo(command_jitter={"sigma_s": 0.02, "p_drop": 0.0}), lambda t: 0.5 * t, rate=100.0
    )
    lag = (plain - jittered)[50:].mean() / 0.5
    assert 0.02 * np.sqrt(2.0 / np.pi) < lag < 0.045  # in order, hence later than the mean of |N|
    _, dropped = answer(servo(command_jitter={"sigma_s": 0.0, "p_drop": 0.5}), lambda t: 0.5 * t, rate=100.0)
    assert (plain - dropped)[50:].mean() / 0.5 == pytest.approx(0.01, abs=0.004)  # one write late on average


@pytest.mark.parametrize(
    ("effect", "up", "down"),
    [
        ({"coulomb_friction": {"tau_c_nm": 0.06}}, 0.06, 0.06),
        ({"asymmetric_friction": {"tau_plus_nm": 0.08, "tau_minus_nm": 0.02}}, 0.08, 0.02),
        ({"stribeck_friction": {"tau_s_nm": 0.2, "tau_c_nm": 0.05, "v_s_rad_s": 0.01}}, 0.05, 0.05),
        ({"temperature_friction": {"cold_nm": 0.05, "warm_nm": 0.05, "time_s": 9.0}}, 0.05, 0.05),
    ],
)
def test_friction_holds_the_joint_back_by_its_torque(effect, up, down):
    time, path = answer(servo(**effect), ramp, duration=4.0)
    lag = ramp(time) - path[:, 0]
    viscous = 0.2 * KD
    assert KP * lag[(time > 1.5) & (time < 1.9)].mean() == pytest.approx(viscous + up, rel=0.02)
    assert KP * lag[(time > 3.5) & (time < 3.9)].mean() == pytest.approx(-viscous - down, rel=0.02)


def test_dry_friction_sticks_where_stiction_says():
    friction = {"stribeck_friction": {"tau_s_nm": 0.2, "tau_c_nm": 0.05, "v_s_rad_s": 0.05}}
    time, path = answer(servo(**friction), lambda t: 0.05 * t, duration=4.0)
    breakaway = time[np.argmax(path[:, 0] > 1e-4)]
    assert KP * 0.05 * breakaway == pytest.approx(0.2, rel=0.03)
    assert np.ptp(path[time < breakaway - 0.05]) == 0.0


def test_load_friction_grows_with_the_torque_carried():
    # Lifting against gravity takes (1 + k) of the load, lowering 1 - k: hysteresis of 2 k load.
    plant = servo(gravity=0.5, load_friction={"k_load": 0.2})
    time, path = answer(plant, lambda t: 1.0 + 0.3 * np.minimum(t, 8.0 - t), duration=8.0, rate=200.0)
    command = 1.0 + 0.3 * np.minimum(time, 8.0 - time)
    motor = KP * (command - path[:, 0]) - KD * np.gradient(path[:, 0], time)
    load = 0.5 * np.sin(path[:, 0])
    up, down = (time > 2.5) & (time < 3.8), (time > 6.5) & (time < 7.8)
    np.testing.assert_allclose(motor[up] * 0.8, load[up], rtol=0.03)
    np.testing.assert_allclose(motor[down] * 1.2, load[down], rtol=0.03)


def test_backlash_and_dead_zone_leave_their_widths():
    time, path = answer(servo(backlash={"width_rad": 0.1}), ramp, duration=4.0)
    lag = ramp(time) - path[:, 0]
    apart = lag[(time > 1.5) & (time < 1.9)].mean() - lag[(time > 3.5) & (time < 3.9)].mean()
    assert apart == pytest.approx(0.1 + 2 * 0.2 * KD / KP, rel=0.01)
    _, still = answer(servo(dead_zone={"width_rad": 0.1}), lambda t: 0.0499 * np.minimum(t, 1.0))
    assert np.abs(still).max() == 0.0
    heavy = servo(dead_zone={"width_rad": 0.1}, coulomb_friction={"tau_c_nm": 1e-3})
    heavy = Plant(**{**vars(heavy), "kd": np.array([5.0])})
    assert 0.04 < STEP - answer(heavy, step, duration=25.0)[1][-1, 0] <= 0.0506


def test_gravity_droops_and_the_integral_creeps_back():
    weight = {"gravity_load": {"tau_g_nm": 0.3, "phase_rad": 0.5}}
    time, path = answer(servo(**weight), step)
    assert KP * (STEP - path[-1, 0]) == pytest.approx(0.3 * np.sin(path[-1, 0] + 0.5), abs=1e-3)
    assert KP * -path[0, 0] == pytest.approx(0.3 * np.sin(path[0, 0] + 0.5), abs=1e-6)  # from rest
    assert path[time < 0.1, 0].std() < 1e-9
    _, crept = answer(servo(**weight, integral_action={"k_i": 6.0}), step, duration=4.0)
    assert crept[-1, 0] == pytest.approx(STEP, abs=1e-4)


def test_motors_give_no_more_than_their_limits():
    for effect, most in (
        ({"torque_limit": {"tau_max_nm": 0.1}}, 0.1),
        ({"torque_saturation": {"tau_s_nm": 0.1}}, 0.1),
        ({"torque_speed_limit": {"tau_stall_nm": 0.1, "omega_0_rad_s": 3.0}}, 0.1),
        ({"supply_sag": {"relative": 1.0 / 0.1}}, 0.1),
    ):
        time, path = answer(servo(**effect), step, rate=1000.0)
        speed = np.gradient(path[:, 0], time)
        assert np.gradient(speed, time).max() * INERTIA < most * 1.05
        assert speed.max() > 0.5  # and it does move
    _, fast = answer(servo(torque_speed_limit={"tau_stall_nm": 9.0, "omega_0_rad_s": 1.0}), step)
    assert np.diff(fast[:, 0]).max() * 500.0 < 1.02
    _, capped = answer(servo(limit=0.7), step)
    assert np.diff(capped[:, 0]).max() * 500.0 == pytest.approx(0.7, rel=1e-3)


def test_a_motor_at_its_limit_acts_when_the_command_comes():
    """The answer to a step does not depend on where in a time step of the plant the command falls."""
    limited = {"torque_limit": {"tau_max_nm": 0.2}}
    paths = []
    for shift in (0.0, 0.5, 0.9):
        time = np.arange(0.0, 1.0, 0.01)
        time[1:] += shift * STEP_S
        command = np.where(np.arange(len(time)) < 20, 0.0, 0.8)[:, None]
        run = Run(servo(**limited), time, command, np.ones(command.shape, bool))
        paths.append(simulate([run])[0][:, 0])
    assert np.ptp(paths[0]) > 0.5
    assert max(np.abs(path - paths[0]).max() for path in paths[1:]) < 2e-4


def test_a_warming_motor_droops_more_as_time_goes():
    _, path = answer(
        servo(gravity=0.5, thermal_drift={"rate_per_s": 0.2}), lambda t: 1.0 + 0 * t, duration=4.0
    )
    for t in (1.0, 3.9):
        q = path[int(500 * t), 0]
        assert KP * np.exp(-0.2 * t) * (1.0 - q) == pytest.approx(0.5 * np.sin(q), rel=0.02)


def test_inertia_slows_and_a_second_mass_rings():
    time, heavy = answer(servo(payload_inertia={"j_kgm2": 3 * INERTIA}), step)
    poles = np.roots([4 * INERTIA, KD, KP]).astype(complex)
    late = np.maximum(time - 0.1, 0.0)
    a, b = poles
    closed = STEP * np.real(1.0 + (b * np.exp(a * late) - a * np.exp(b * late)) / (a - b))
    np.testing.assert_allclose(heavy[:, 0], closed, atol=5e-5)

    from scipy.signal import StateSpace, lsim

    k, c, j = 3.0, 5e-3, 2e-3
    elastic = {"elastic_transmission": {"k_nm_rad": k, "c_nms_rad": c, "j_kgm2": j}}
    time, path = answer(servo(**elastic), step)
    drive = [-(KP + k) / INERTIA, -(KD + c) / INERTIA, k / INERTIA, c / INERTIA]
    second = [k / j, c / j, -k / j, -c / j]
    system = StateSpace([[0, 1, 0, 0], drive, [0, 0, 0, 1], second], [[0], [KP / INERTIA], [0], [0]],
                        [[1, 0, 0, 0]], [[0]])  # fmt: skip
    _, exact, _ = lsim(system, np.where(time < 0.1, 0.0, STEP), time, interp=False)
    np.testing.assert_allclose(path[:, 0], exact, atol=3e-4)


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


def test_conditions_act():
    _, soft = answer(servo(gravity=0.5), step, conditions={"p_gain": 0.5})
    assert 0.5 * KP * (STEP - soft[-1, 0]) == pytest.approx(0.5 * np.sin(soft[-1, 0]), abs=1e-3)
    off = np.ones((1001, 1), dtype=bool)
    off[500:] = False
    _, released = answer(servo(gravity=0.5), lambda t: 1.0 + 0 * t, enabled=off)
    assert released[499, 0] > 0.7 and abs(released[-1, 0]) < 0.3


def test_the_time_step_does_not_show():
    names = [name for name in (*EFFECTS, *OUTSIDE) if name != COUPLING]  # which one joint cannot have
    time = np.arange(80) * 1e-2
    command = np.sin(4.0 * np.pi * time)[:, None]
    runs = []
    for name in names:
        hiding = Hiding("pendulum", {name: effect_at(name, 1.0)}, base_spread=0.0)
        _, plant = machine(hiding, np.random.default_rng(0))
        runs.append(Run(plant, time, command, np.ones(command.shape, dtype=bool), seed=3))
    for name, coarse, fine in zip(names, simulate(runs), simulate(runs, dt=1e-4), strict=True):
        # Under half the noise floor of 0.5 mrad.
        assert np.sqrt(np.mean((coarse - fine) ** 2)) < 2e-4, name


FINGER = FingerBody(
    mass=np.array([0.09, 0.08, 0.03]),
    com=np.array([0.05, 0.045, 0.04]),
    inertia=np.array([[1.3e-5, 2e-5, 1e-5], [1.5e-5, 1.2e-5, 0.9e-5], [1e-5, 8e-6, 5e-6]]),
    spacing=0.07,
    offset=0.066,
    tip=0.074,
)


@pytest.mark.parametrize("payload", [0.0, 0.05])
def test_the_finger_moves_as_in_another_engine(payload):
    """Also with a load at its tip [kg]."""
    import mujoco

    def link(number, axis, height, inner):
        m, c = FINGER.mass[number], FINGER.com[number]
        x, y, z = FINGER.inertia[number]
        return (
            f'<body pos="0 0 {height}"><joint axis="{axis}" armature="0.001"/>'
            f'<inertial pos="0 0 {c}" mass="{m}" diaginertia="{x} {y} {z}"/>{inner}</body>'
        )

    load = f'<body pos="0 0 {FINGER.tip}"><inertial pos="0 0 0" mass="{payload}" diaginertia="0 0 0"/></body>'
    chain = link(2, "0 1 0", FINGER.spacing, load if payload else "")
    chain = link(0, "1 0 0", 0, link(1, "0 1 0", FINGER.offset, chain))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="1e-4" gravity="0 0 9.81" integrator="RK4"/><worldbody>{chain}'
        "</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    start = np.array([0.8, -1.0, 1.4])
    data.qpos[:] = start
    expected = []
    for _ in range(100):
        expected.append(data.qpos.copy())
        mujoco.mj_step(model, data, 50)
    ones = np.ones(3)
    plant = Plant(("a", "b", "c"), ones, 0.02 * ones, 99 * ones, 1e-3 * ones, 0 * ones, body=FINGER)
    # Switched off at the start, and so without damping: it falls and swings, bends driving each other.
    time = np.arange(100) * 5e-3
    off = np.zeros((100, 3), dtype=bool)
    conditions = {"payload_kg": payload}
    (path,) = simulate([Run(plant, time, np.tile(start, (100, 1)), off, conditions)], dt=1e-4)
    assert np.ptp(path, axis=0).min() > 0.1
    np.testing.assert_allclose(path, np.array(expected), atol=2e-3)


def test_too_stiff_a_spring_is_refused():
    stiff = {"elastic_transmission": {"k_nm_rad": 900.0, "c_nms_rad": 0.0, "j_kgm2": 1e-6}}
    with pytest.raises(ValueError, match="too stiff"):
        answer(servo(**stiff), step)
