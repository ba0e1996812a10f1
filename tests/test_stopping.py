"""The stopping rule: what it stops, and how its bounds are chosen."""

import dataclasses
import itertools

import numpy as np
import pytest

from vd.policy.stopping import StoppingRule, StoppingRules, calibrate

TOLERANCE = 0.4


def outcome(predicted, norm, true, steps, distance, limit):
    """Shares of episodes that stop right and wrong, step by step."""
    right = wrong = 0
    for episode, end in enumerate(steps):
        for step in range(1, end):
            if predicted[episode, step] < distance and norm[episode, step] < limit:
                right += true[episode, step] <= TOLERANCE
                wrong += true[episode, step] > TOLERANCE
                break
    return right / len(true), wrong / len(true)


def episodes(seed, *, bias=0.0, noise=0.1, length=41, count=60):
    """Objects that near the goal while the action calms down, seen with an error.

    NaN after their ends.
    """
    rng = np.random.default_rng(seed)
    start, floor = rng.uniform(1.0, 3.0, (count, 1)), rng.uniform(0.0, 0.8, (count, 1))
    decay = np.exp(-np.arange(length) / 8.0)
    true = floor + (start - floor) * decay + 0.05 * rng.random((count, length))
    norm = 0.2 + 2.0 * decay * rng.random((count, length))
    predicted = np.clip(true + bias + noise * rng.standard_normal((count, length)), 0.0, None)
    steps = np.minimum(rng.integers(5, 80, count), length - 1)
    ends = np.arange(length) >= steps[:, None]
    return *(np.where(ends, np.nan, values) for values in (predicted, norm, true)), steps


def test_both_bounds_have_to_hold():
    rule = StoppingRule(distance_rad=0.3, action_norm=1.0)
    stops = rule.stops(np.array([0.2, 0.2, 0.4, 0.3]), np.array([0.7, 2.0, 0.1, 0.0]))
    assert stops.tolist() == [True, False, False, False]


@pytest.mark.parametrize(
    ("seed", "bias", "louder"), [(0, 0.0, 0.0), (1, 0.25, 0.0), (2, -0.25, 0.0), (6, 0.2, 1.0)]
)
def test_the_rule_gives_what_it_says_and_nothing_on_a_grid_is_better(seed, bias, louder):
    """Hands that are never as still as the paper asks get both bounds together."""
    predicted, norm, true, steps = episodes(seed, bias=bias)
    data = predicted, norm + louder, true, steps
    found = calibrate(*data, tolerance_rad=TOLERANCE)
    right, wrong = outcome(*data, found.rule.distance_rad, found.rule.action_norm)
    assert (found.success, found.wrong) == (pytest.approx(right), pytest.approx(wrong))
    assert found.success <= found.reachable and found.episodes == 60
    distances, limits = np.arange(1, 25) / 24 * 0.8, louder + np.linspace(0.3, 2.2, 6)
    if louder:
        assert found.rule.action_norm > 1.0
        grid = itertools.product(distances, limits)
    else:
        as_the_paper = outcome(*data, found.rule.distance_rad, 1.0)[0]
        assert max(outcome(*data, distance, 1.0)[0] for distance in distances) <= as_the_paper
        grid = itertools.product([found.rule.distance_rad], limits)
    # this grid has no action bounds in common: allow for what lies between two of them
    assert max(outcome(*data, *bounds)[0] for bounds in grid) <= found.success + 2 / 60


def test_a_small_tolerance_has_a_small_bound_and_nothing_to_calibrate_on_is_an_error():
    near = calibrate(*episodes(7, noise=0.03), tolerance_rad=0.1)
    assert near.rule.distance_rad < 0.1 and near.success > 0.0
    predicted, norm, true, steps = episodes(5)
    with pytest.raises(ValueError, match="no episode"):
        calibrate(predicted, norm, true, np.ones_like(steps))
    with pytest.raises(ValueError, match="any of 60 episodes"):
        calibrate(predicted, norm, true + 2.0, steps)


def test_each_tolerance_has_the_rule_that_was_calibrated_for_it():
    spec = StoppingRules(stopping=StoppingRule(0.3, 2.0))
    assert spec.rule_for(TOLERANCE) == spec.stopping
    assert spec.rule_for(0.1) == StoppingRule(0.1, 2.0), "nothing better is known"
    precise = dataclasses.replace(spec, precise=StoppingRule(0.07, 1.0))
    assert precise.rule_for(0.1) == precise.precise and precise.rule_for(0.4) == spec.stopping
    assert precise.rule_for(0.2) == StoppingRule(0.2, 2.0)
    other = dataclasses.replace(precise, tolerance_rad=0.2)
    assert other.rule_for(0.2) == other.stopping and other.rule_for(0.4) == StoppingRule(0.4, 2.0)
    known = dataclasses.replace(other, calibrated_on="cube: 8 episodes")
    assert known.calibrated_for(0.2) and known.calibrated_for(0.1) and not known.calibrated_for(0.4)
    assert not spec.calibrated_for(TOLERANCE), "the paper's bounds are of no episodes"
