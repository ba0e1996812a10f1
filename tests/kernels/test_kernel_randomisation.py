import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import ALPHA, EXAMPLES, device_array, launch, streams
from scipy import stats

from vd.kernels.rng import next_stream
from vd.kernels.servo.actuators import COMMAND_DELAY, PARAMETER_COLUMNS, READ_DELAY
from vd.kernels.task.randomisation import (
    disturbance_force_kernel,
    draw_dynamics_kernel,
    draw_masses_kernel,
    draw_servo_kernel,
    scale_masses_kernel,
)
from vd.paper import PAPER

DR = PAPER.randomisation
RANGES = {
    "friction": wp.vec2(*DR.friction),
    "link_mass_scale": wp.vec2(*DR.link_mass_scale),
    "action_offset_std": DR.action_offset_std_code,
    "observation_offset_std": PAPER.observation.noise_offset_std_code,
}
KP, KD = [2.772, 3.559, 3.559], [0.2739, 0.3824, 0.3824]
OUTPUTS = (
    "kp",
    "kd",
    "hand_friction",
    "object_friction",
    "table_friction",
    "action_offset",
    "observation_offset",
)


def draw_dynamics(device, mask, fingers=3, seed=0, observation_size=87):
    """Launch; returns every output and the streams by name."""
    worlds, joints = len(mask), 3 * fingers
    shapes = [(worlds, joints)] * 2 + [worlds] * 3 + [(worlds, joints), (worlds, observation_size)]
    inputs = [np.tile(KP, fingers), np.tile(KD, fingers)]
    inputs += [
        np.broadcast_to(scale, (joints, 2)) for scale in (DR.stiffness_scale, DR.damping_scale)
    ]
    inputs += [
        np.broadcast_to(DR.table_friction, (worlds, 2)),
        RANGES,
        mask,
        rng := streams(worlds, seed, device),
    ]
    drawn = launch(draw_dynamics_kernel, worlds, inputs, device, *shapes)
    return {**dict(zip(OUTPUTS, drawn, strict=True)), "rng": rng.numpy()}


def draw_masses(device, mask, links=9, seed=0):
    """Launch; returns link scales, object masses and streams."""
    worlds = len(mask)
    masses = np.broadcast_to(DR.object_mass_kg, (worlds, 2))
    inputs = [masses, RANGES, mask, rng := streams(worlds, seed, device)]
    return *launch(draw_masses_kernel, worlds, inputs, device, (worlds, links), worlds), rng.numpy()


def assert_uniform(values, bounds):
    low, high = np.float32(bounds[0]), np.float32(bounds[1])
    assert values.min() >= low - 1e-6
    assert values.max() <= high + 1e-6
    assert stats.kstest(np.ravel(values), stats.uniform(low, high - low).cdf).pvalue > ALPHA


def assert_uncorrelated(columns, bound):
    """Columns [N, K] that no pair of shares anything linear."""
    correlation = np.corrcoef(np.asarray(columns, float).T)
    assert np.abs(correlation - np.eye(len(correlation))).max() < bound


def test_dynamics_have_the_ranges_of_table_s3(device):
    worlds = 20_000
    drawn = draw_dynamics(device, np.ones(worlds, int), fingers=4, seed=1, observation_size=109)
    kp_scale, kd_scale = drawn["kp"] / np.tile(KP, 4), drawn["kd"] / np.tile(KD, 4)
    for joint in range(12):
        assert_uniform(kp_scale[:, joint], DR.stiffness_scale)
        assert_uniform(kd_scale[:, joint], DR.damping_scale)
    assert_uniform(drawn["hand_friction"], DR.friction)
    assert_uniform(drawn["object_friction"], DR.friction)
    assert_uniform(drawn["table_friction"], DR.table_friction)
    for name, std in (
        ("action_offset", DR.action_offset_std_code),
        ("observation_offset", PAPER.observation.noise_offset_std_code),
    ):
        assert stats.kstest(np.ravel(drawn[name]) / std, stats.norm.cdf).pvalue > ALPHA
    frictions = np.stack(
        [drawn["hand_friction"], drawn["object_friction"], drawn["table_friction"]], axis=1
    )
    offset = drawn["action_offset"]
    # Squares too: a normal made from a number drawn before hides that from linear correlation.
    assert_uncorrelated(np.hstack([kp_scale, kd_scale, frictions, offset, offset**2]), 0.05)


def draw_servo(device, mask, ranges, gains, seed=0):
    """Launch; returns rows [N, D, P] and streams."""
    worlds, (joints, columns, _) = len(mask), ranges.shape
    inputs = [ranges, mask, *gains, rng := streams(worlds, seed, device)]
    (out,) = launch(draw_servo_kernel, worlds, inputs, device, (worlds * joints, columns))
    return out.reshape(worlds, joints, columns), rng.numpy()


def test_servos_are_drawn_from_their_ranges_and_carry_the_gains_of_their_world(device):
    rng = np.random.default_rng(0)
    worlds, joints = 4000, 3
    mask = np.arange(worlds) % 2
    ranges = np.repeat(rng.uniform(0.1, 1.0, (joints, PARAMETER_COLUMNS, 1)), 2, axis=2).astype(
        np.float32
    )
    drawn = [(0, 4), (0, 23), (2, 16)]
    for joint, column in drawn:
        ranges[joint, column] = (0.01 * column, 0.02 * column)
    gains = rng.uniform(1.0, 2.0, (2, worlds, joints)).astype(np.float32)
    rows, after = draw_servo(device, mask, ranges, gains, seed=8)
    assert np.isnan(rows[mask == 0]).all()
    np.testing.assert_array_equal(after[mask == 0], streams(worlds, 8, device).numpy()[mask == 0])
    rows, gains = rows[mask == 1], gains[:, mask == 1]
    np.testing.assert_array_equal(rows[:, :, :2], np.moveaxis(gains, 0, -1))
    for joint in range(joints):
        for column in range(2, PARAMETER_COLUMNS):
            if (joint, column) in drawn:
                assert_uniform(rows[:, joint, column], ranges[joint, column])
            else:
                assert (rows[:, joint, column] == ranges[joint, column, 0]).all()
    assert_uncorrelated(np.stack([rows[:, j, c] for j, c in drawn], axis=1), 0.1)


def test_delays_are_the_same_share_of_every_joint_s_range(device):
    worlds, joints = 4000, 3
    ranges = np.zeros((joints, PARAMETER_COLUMNS, 2), dtype=np.float32)
    for column in (COMMAND_DELAY, READ_DELAY):
        ranges[:, column] = [(0.0, 0.04), (0.01, 0.03), (0.02, 0.02)]
    gains = np.ones((2, worlds, joints), dtype=np.float32)
    rows, _ = draw_servo(device, np.ones(worlds, int), ranges, gains, seed=8)
    shares = rows[:, 0, [COMMAND_DELAY, READ_DELAY]] / 0.04
    for k, column in enumerate((COMMAND_DELAY, READ_DELAY)):
        assert_uniform(shares[:, k], (0.0, 1.0))
        np.testing.assert_allclose(rows[:, 1, column], 0.01 + 0.02 * shares[:, k], atol=1e-6)
        assert (rows[:, 2, column] == np.float32(0.02)).all()
    assert_uncorrelated(shares, 0.1)


def test_masses_have_the_ranges_of_table_s3(device):
    scale, mass, _ = draw_masses(device, np.ones(20_000, int), links=12, seed=2)
    for link in range(12):
        assert_uniform(scale[:, link], DR.link_mass_scale)
    assert_uniform(mass, DR.object_mass_kg)
    assert_uncorrelated(np.column_stack([scale, mass]), 0.05)


@pytest.mark.parametrize("level", [0.0, 0.3, 1.0])
def test_masses_and_inertias_scale_geometrically_and_what_does_not_move_stays_so(device, level):
    rng, bodies = np.random.default_rng(6), 50
    factor = rng.uniform(0.05, 20.0, bodies)
    mass = rng.uniform(0.001, 1.0, bodies)
    inertia = rng.normal(size=(bodies, 3, 3))
    moves = np.arange(bodies) % 5 > 0
    inverse_mass = np.where(moves, 1.0 / mass, 0.0)
    inverse = np.where(moves[:, None, None], np.linalg.inv(inertia), 0.0)
    own = [factor, mass, inverse_mass, inertia, inverse]
    scaled = launch(scale_masses_kernel, bodies, [level, *own], device, *[bodies] * 4)
    scale = factor**level
    squares = scale[:, None, None]
    expected = [mass * scale, inverse_mass / scale, inertia * squares, inverse / squares]
    for found, wanted in zip(scaled, expected, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=2e-5)


@EXAMPLES
@given(mask=st.lists(st.integers(0, 1), min_size=1, max_size=8), fingers=st.sampled_from([3, 4]))
def test_only_masked_worlds_are_drawn(device, mask, fingers):
    mask = np.array(mask)
    drawn = draw_dynamics(device, mask, fingers, seed=3)
    scale, mass, rng = draw_masses(device, mask, seed=3)
    before = streams(len(mask), 3, device).numpy()
    for array in (*(drawn[name] for name in OUTPUTS), scale, mass):
        assert np.isnan(array[mask == 0]).all()
        assert np.isfinite(array[mask == 1]).all()
    for after in (drawn["rng"], rng):
        np.testing.assert_array_equal(after[mask == 0], before[mask == 0])
        assert np.all(after[mask == 1] != before[mask == 1])


@wp.kernel(enable_backward=False)
def walk_kernel(rng: wp.array[wp.uint32], out: wp.array[float]):
    world = wp.tid()
    state = rng[world]
    out[world] = wp.randf(state)
    rng[world] = next_stream(state, world)


def walk(device, rng, steps):
    """Draw one number per world and step; returns [steps, N]."""
    return np.array(
        [launch(walk_kernel, len(rng), [rng], device, len(rng))[0] for _ in range(steps)]
    )


def test_streams_of_different_worlds_never_walk_together(device):
    numbers = walk(device, streams(300, 6, device), 400)
    assert stats.kstest(np.ravel(numbers), stats.uniform.cdf).pvalue > ALPHA
    assert_uncorrelated(numbers, 0.35)  # between worlds, 400 steps
    assert_uncorrelated(numbers[:100].T, 0.4)  # between steps, 300 worlds
    # Even from one and the same state the worlds part after their first draw.
    same = device_array(np.full(50, 12345), wp.uint32, device)
    numbers = walk(device, same, 20)
    assert len(np.unique(numbers[0])) == 1
    assert all(len(np.unique(row)) == 50 for row in numbers[1:])


def force_array(device, force, mass, seed, **changes):
    """Launch one step; returns forces."""
    values = {
        "probability": DR.force_probability,
        "force_per_mass": DR.force_n_per_kg,
        "decay": 0.0,
    }
    inputs = [mass, values | changes, array := device_array(force, wp.vec3, device)]
    launch(disturbance_force_kernel, len(mass), [*inputs, streams(len(mass), seed, device)], device)
    return array.numpy().astype(float)


@pytest.mark.parametrize("decay", [0.0, 0.998])
def test_disturbance_has_the_paper_s_rate_and_magnitude_and_any_direction(device, decay):
    worlds = 50_000
    rng = np.random.default_rng(0)
    mass = rng.uniform(*DR.object_mass_kg, worlds).astype(np.float32)
    before = rng.normal(size=(worlds, 3)).astype(np.float32)
    force = force_array(device, before, mass, 11, decay=decay)
    old = np.all(np.abs(force - decay * before) < 1e-6, axis=1)
    drawn = force[~old]
    assert len(drawn) / worlds == pytest.approx(DR.force_probability, abs=0.01)
    magnitude = np.linalg.norm(drawn, axis=1)
    np.testing.assert_allclose(magnitude, DR.force_n_per_kg * mass[~old], rtol=1e-5)
    direction = drawn / magnitude[:, None]
    for axis in range(3):  # Archimedes: each coordinate of a uniform direction is uniform
        assert stats.kstest(direction[:, axis], stats.uniform(-1, 2).cdf).pvalue > ALPHA
    np.testing.assert_allclose(direction.T @ direction / len(direction), np.eye(3) / 3, atol=0.02)
