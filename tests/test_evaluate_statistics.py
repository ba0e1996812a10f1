"""Errors and intervals of the evaluation, against what is known of them."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vd.evaluate.statistics import (
    median_interval,
    order_interval,
    paired_difference,
    rate_intervals,
    symmetric_error,
)
from vd.geometry.quaternions import product, rotation_distance

IDENTITY = np.array([[0.0, 0.0, 0.0, 1.0]])
CUBE = Rotation.create_group("O").as_quat()


def test_angle_and_product_agree_with_scipy_at_every_size():
    rng = np.random.default_rng(0)
    a = Rotation.random(200, rng=rng)
    axis = Rotation.random(200, rng=rng).apply([0.0, 0.0, 1.0])
    angle = np.concatenate([10.0 ** rng.uniform(-9, 0, 100), rng.uniform(0, np.pi, 99), [np.pi]])
    b = a * Rotation.from_rotvec(axis * angle[:, None])
    for sign in (1.0, -1.0):
        found = rotation_distance(a.as_quat(), sign * b.as_quat())
        np.testing.assert_allclose(found, angle, atol=1e-14, rtol=1e-6)
    turned = product(a.as_quat(), b.as_quat())
    np.testing.assert_allclose(turned, (a * b).as_quat(canonical=False), atol=1e-12)


def test_cube_error_is_the_least_over_its_24_rotations():
    rng = np.random.default_rng(1)
    goal = Rotation.random(50, rng=rng)
    offset = Rotation.from_rotvec(Rotation.random(50, rng=rng).apply([0.0, 0.0, 0.2]))
    for symmetry in Rotation.from_quat(CUBE):
        turned = (offset * goal * symmetry).as_quat()
        np.testing.assert_allclose(symmetric_error(turned, goal.as_quat(), CUBE), 0.2, atol=1e-9)
    # Nothing is farther from a cube's symmetries than 62.8 degrees.
    far = symmetric_error(Rotation.random(5000, rng=rng).as_quat(), IDENTITY, CUBE)
    assert far.max() < np.deg2rad(62.81)
    quarter_turn = Rotation.from_euler("x", 90, degrees=True).as_quat()
    assert symmetric_error(quarter_turn, IDENTITY[0], IDENTITY) == pytest.approx(np.pi / 2)


def coverage(intervals, truth):
    """Share of intervals that hold the truth, or each its own."""
    pairs = zip(intervals, np.broadcast_to(truth, len(intervals)), strict=True)
    return np.mean([interval.low <= value <= interval.high for interval, value in pairs])


@pytest.mark.parametrize(
    ("objects", "episodes", "runs"), [(13, 20, 3000), (13, 100, 2000), (159, 20, 1000)]
)
@pytest.mark.parametrize("rate", [0.5, 0.9, 0.97])
def test_intervals_over_objects_that_differ_cover_as_often_as_they_say(
    objects, episodes, runs, rate
):
    """Rates of objects spread by 0.22 of the widest spread possible.

    0.07 about 0.9, 0.04 about 0.97. Few objects near a rate of one get wider intervals than need be.
    """
    rng = np.random.default_rng(objects + episodes)
    each = rng.beta(20.0 * rate, 20.0 * (1.0 - rate), size=(runs, objects, 1))
    intervals = rate_intervals(rng.random((runs, objects, episodes)) < each, "object")
    assert 0.93 <= coverage(intervals, rate) <= 0.985


@pytest.mark.parametrize("rate", [0.3, 0.95])
@pytest.mark.parametrize("objects", [1, 5])
def test_intervals_over_episodes_cover_a_known_rate(rate, objects):
    rng = np.random.default_rng(3)
    intervals = rate_intervals(rng.random((2000, objects, 100)) < rate, "episode")
    assert {i.method for i in intervals} <= {"logit-t", "clopper-pearson"}
    assert 0.93 <= coverage(intervals, rate) <= 0.975


def test_intervals_cover_a_known_skewed_median():
    rng = np.random.default_rng(4)
    medians = [median_interval(rng.exponential(size=(1, 60)), "episode") for _ in range(1000)]
    assert 0.93 <= coverage(medians, np.log(2)) <= 0.975
    ordered = [order_interval(rng.exponential(size=25)) for _ in range(400)]
    assert coverage(ordered, np.log(2)) >= 0.94
    drawn = rng.lognormal(sigma=0.5, size=(1000, 13, 1)) * rng.exponential(size=(1000, 13, 20))
    truth = np.median(rng.lognormal(sigma=0.5, size=10**6) * rng.exponential(size=10**6))
    assert 0.93 <= coverage([median_interval(values, "object") for values in drawn], truth) <= 0.975


def test_intervals_over_objects_cover_new_objects_and_those_over_episodes_do_not():
    rng = np.random.default_rng(5)
    rates = rng.beta(0.5, 0.5, size=(100, 20))  # objects differ strongly; mean rate 1/2
    outcomes = rng.random((100, 20, 20)) < rates[..., None]
    by_object, by_episode = (rate_intervals(outcomes, unit) for unit in ("object", "episode"))
    assert coverage(by_object, 0.5) >= 0.93 and coverage(by_episode, 0.5) <= 0.7
    # For these very objects the stratified interval is right, and narrower.
    assert coverage(by_episode, rates.mean(axis=1)) >= 0.9
    assert [i.value for i in by_object] == pytest.approx([i.value for i in by_episode])


@pytest.mark.parametrize("unit", ["object", "episode"])
def test_a_sample_without_spread_has_an_exact_interval(unit):
    none, every = rate_intervals(np.stack([np.zeros((10, 30)), np.ones((10, 30))]), unit)
    width = 1 - 0.025 ** (1 / 300)
    assert none.method == every.method == "clopper-pearson"
    assert (none.low, none.high, every.low, every.high) == pytest.approx(
        (0.0, width, 1 - width, 1.0)
    )


@pytest.mark.parametrize("shape", list(itertools.product([1, 2, 9], [1, 2, 7])))
@pytest.mark.parametrize("unit", ["object", "episode"])
def test_small_samples_give_finite_intervals(shape, unit):
    rng = np.random.default_rng(6)
    rates = rate_intervals(rng.random((3, *shape)) < 0.5, unit)
    for interval in (*rates, median_interval(rng.random(shape), unit)):
        assert 0.0 <= interval.low <= interval.value <= interval.high <= 1.0


@pytest.mark.parametrize("unit", ["object", "episode"])
def test_paired_differences_cover_and_are_narrower_than_rates(unit):
    """Two policies on the same objects, of which some are hard for both.

    One succeeds 0.1 more often.
    """
    rng = np.random.default_rng(9)
    each = rng.uniform(0.2, 0.8, size=(500, 13, 1))
    luck = rng.random((500, 13, 20))
    found = [paired_difference(d < e + 0.1, d < e, unit) for d, e in zip(luck, each, strict=True)]
    assert coverage(found, 0.1) >= 0.93
    (rate,) = rate_intervals((luck[0] < each[0])[None], unit)
    assert found[0].high - found[0].low < rate.high - rate.low
