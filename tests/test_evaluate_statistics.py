"""Errors, chance and intervals of the evaluation, against what is known of them."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vd.evaluate.statistics import (
    chance_cdf,
    choose_unit,
    median_interval,
    order_interval,
    paired_difference,
    quat_multiply,
    rate_intervals,
    rotation_angle,
    symmetric_error,
)

IDENTITY = np.array([[0.0, 0.0, 0.0, 1.0]])
CUBE = Rotation.create_group("O").as_quat()


def test_angle_agrees_with_scipy_at_every_size():
    rng = np.random.default_rng(0)
    a = Rotation.random(200, rng=rng)
    axis = Rotation.random(200, rng=rng).apply([0.0, 0.0, 1.0])
    angle = np.concatenate([10.0 ** rng.uniform(-9, 0, 100), rng.uniform(0, np.pi, 99), [np.pi]])
    b = a * Rotation.from_rotvec(axis * angle[:, None])
    np.testing.assert_allclose(rotation_angle(a.as_quat(), b.as_quat()), angle, atol=1e-14, rtol=1e-6)
    np.testing.assert_allclose(rotation_angle(a.as_quat(), -b.as_quat()), angle, atol=1e-14, rtol=1e-6)
    np.testing.assert_allclose(
        quat_multiply(a.as_quat(), b.as_quat()), (a * b).as_quat(canonical=False), atol=1e-12
    )


def test_cube_error_is_the_least_over_its_24_rotations():
    rng = np.random.default_rng(1)
    goal = Rotation.random(50, rng=rng)
    offset = Rotation.from_rotvec(Rotation.random(50, rng=rng).apply([0.0, 0.0, 0.2]))
    assert len(CUBE) == 24
    for symmetry in Rotation.from_quat(CUBE):
        turned = (offset * goal * symmetry).as_quat()
        np.testing.assert_allclose(symmetric_error(turned, goal.as_quat(), CUBE), 0.2, atol=1e-9)
    # Nothing is farther from a cube's symmetries than 62.8 degrees.
    far = symmetric_error(Rotation.random(5000, rng=rng).as_quat(), IDENTITY, CUBE)
    assert far.max() < np.deg2rad(62.81)
    quarter_turn = Rotation.from_euler("x", 90, degrees=True).as_quat()
    assert symmetric_error(quarter_turn, IDENTITY[0], CUBE) == pytest.approx(0.0, abs=1e-9)
    assert symmetric_error(quarter_turn, IDENTITY[0], IDENTITY) == pytest.approx(np.pi / 2)


def test_chance_matches_random_rotations():
    errors = rotation_angle(Rotation.random(200_000, rng=np.random.default_rng(2)).as_quat(), IDENTITY)
    for angle in (0.1, 0.4, 0.8, 2.0):
        assert (errors <= angle).mean() == pytest.approx(chance_cdf(angle), abs=0.003)
    assert chance_cdf(0.4) == pytest.approx(0.0034, abs=5e-5)
    # Small balls around 24 equivalent goals do not meet: 24 times the chance.
    assert chance_cdf(0.4, CUBE) == pytest.approx(24 * chance_cdf(0.4), rel=0.05)
    assert chance_cdf(np.pi, CUBE) == 1.0


def covers(interval, truth):
    return interval.low <= truth <= interval.high


@pytest.mark.parametrize(("objects", "episodes", "runs"), [(13, 20, 3000), (13, 100, 2000), (159, 20, 1000)])
@pytest.mark.parametrize("rate", [0.5, 0.9, 0.97])
def test_intervals_over_objects_that_differ_cover_as_often_as_they_say(objects, episodes, runs, rate):
    """Rates of objects spread by 0.22 of the widest spread possible: 0.07 about 0.9, 0.04 about 0.97."""
    rng = np.random.default_rng(objects + episodes)
    each = rng.beta(20.0 * rate, 20.0 * (1.0 - rate), size=(runs, objects, 1))
    intervals = rate_intervals(rng.random((runs, objects, episodes)) < each, "object")
    assert 0.93 <= np.mean([covers(i, rate) for i in intervals]) <= 0.975


@pytest.mark.parametrize("rate", [0.3, 0.95])
@pytest.mark.parametrize("objects", [1, 5])
def test_intervals_over_episodes_cover_a_known_rate(rate, objects):
    rng = np.random.default_rng(3)
    intervals = rate_intervals(rng.random((2000, objects, 100)) < rate, "episode")
    assert {i.method for i in intervals} <= {"logit-t", "clopper-pearson"}
    assert 0.93 <= np.mean([covers(i, rate) for i in intervals]) <= 0.975


def test_intervals_cover_a_known_skewed_median():
    rng = np.random.default_rng(4)
    medians = [median_interval(rng.exponential(size=(1, 60)), "episode") for _ in range(1000)]
    assert 0.93 <= np.mean([covers(i, np.log(2)) for i in medians]) <= 0.975
    scales = rng.lognormal(sigma=0.5, size=(1000, 13, 1))
    drawn = scales * rng.exponential(size=(1000, 13, 20))
    truth = np.median(rng.lognormal(sigma=0.5, size=10**6) * rng.exponential(size=10**6))
    assert 0.93 <= np.mean([covers(median_interval(v, "object"), truth) for v in drawn]) <= 0.975


def test_intervals_over_objects_cover_new_objects_and_those_over_episodes_do_not():
    rng = np.random.default_rng(5)
    rates = rng.beta(0.5, 0.5, size=(100, 20))  # objects differ strongly; mean rate 1/2
    outcomes = rng.random((100, 20, 20)) < rates[..., None]
    by_object = rate_intervals(outcomes, "object")
    by_episode = rate_intervals(outcomes, "episode")
    assert np.mean([covers(i, 0.5) for i in by_object]) >= 0.93
    assert np.mean([covers(i, 0.5) for i in by_episode]) <= 0.7
    # For these very objects the stratified interval is right, and narrower.
    covered = [covers(i, truth) for i, truth in zip(by_episode, rates.mean(axis=1), strict=True)]
    assert np.mean(covered) >= 0.9
    assert all(i.value == pytest.approx(j.value) for i, j in zip(by_object, by_episode, strict=True))


@pytest.mark.parametrize("unit", ["object", "episode"])
@pytest.mark.parametrize("outcome", [False, True])
def test_a_sample_without_spread_has_an_exact_interval(unit, outcome):
    (interval,) = rate_intervals(np.full((1, 10, 30), outcome), unit)
    width = 1 - 0.025 ** (1 / 300)
    assert interval.method == "clopper-pearson"
    assert (interval.low, interval.high) == pytest.approx((1 - width, 1.0) if outcome else (0.0, width))


def test_one_success_is_never_less_certain_than_none():
    """The exact interval without a success joins the one with one."""
    none, one = np.zeros((2, 1, 10, 6), dtype=bool)
    one[0, 3, 2] = True
    (without,), (with_one,) = rate_intervals(none, "object"), rate_intervals(one, "object")
    assert without.high < with_one.high + 0.02


@pytest.mark.parametrize("shape", list(itertools.product([1, 2, 9], [1, 2, 7])))
@pytest.mark.parametrize("unit", ["object", "episode"])
def test_small_samples_give_finite_intervals(shape, unit):
    rng = np.random.default_rng(6)
    intervals = [
        *rate_intervals(rng.random((3, *shape)) < 0.5, unit),
        median_interval(rng.random(shape), unit),
    ]
    for interval in intervals:
        assert np.isfinite([interval.value, interval.low, interval.high]).all()
        assert interval.low <= interval.value <= interval.high


def test_median_of_objects_is_wider_where_objects_differ():
    rng = np.random.default_rng(7)
    values = rng.uniform(0, 3, size=(12, 1)) + 0.5 * rng.random((12, 50))
    by_object, by_episode = median_interval(values, "object"), median_interval(values, "episode")
    assert by_object.value == by_episode.value == pytest.approx(np.median(values))
    assert by_object.high - by_object.low > 5 * (by_episode.high - by_episode.low)


def test_order_interval_covers():
    rng = np.random.default_rng(8)
    covered = [covers(order_interval(rng.exponential(size=25)), np.log(2)) for _ in range(400)]
    assert np.mean(covered) >= 0.94


def test_the_unit_is_objects_once_there_are_enough():
    assert choose_unit(3) == "episode"
    assert choose_unit(24) == "object"


@pytest.mark.parametrize("unit", ["object", "episode"])
def test_paired_differences_cover_and_are_narrower_than_rates(unit):
    """Two policies on the same objects, of which some are hard for both; one succeeds 0.1 more often."""
    rng = np.random.default_rng(9)
    each = rng.uniform(0.2, 0.8, size=(500, 13, 1))
    luck = rng.random((500, 13, 20))
    found = [paired_difference(d < e + 0.1, d < e, unit) for d, e in zip(luck, each, strict=True)]
    assert np.mean([i.low <= 0.1 <= i.high for i in found]) >= 0.93
    (rate,) = rate_intervals((luck[0] < each[0])[None], unit)
    assert found[0].high - found[0].low < rate.high - rate.low
