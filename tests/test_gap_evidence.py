"""What decides, on made-up fits: gains on unseen motions, ties, bounds, and other joints."""

from dataclasses import replace

import numpy as np
import pytest
from gap_recordings import FLOOR, made_up

import vd.kernels.servo.actuators as servo
from vd.gap.coordinates import Coordinate
from vd.gap.evidence import Evidence
from vd.gap.explanation import Explanation
from vd.gap.joints import doubted
from vd.gap.statistics import resamples


@pytest.fixture
def judge() -> Evidence:
    return Evidence(noise=FLOOR, weights=resamples(10, np.random.default_rng(0)))


def test_a_gain_is_over_five_percent_over_the_noise_and_holds_over_trajectories(
    judge: Evidence,
) -> None:
    before, name = made_up((), 0.010), ("backlash",)
    assert judge.better(before, made_up(name, 0.005))[0]
    assert not judge.better(before, made_up(name, 0.0097))[0]
    # One trajectory gains much, others lose a little: the interval over trajectories covers 0.
    uneven = np.full(10, 0.0102)
    uneven[0] = 0.0
    assert not judge.better(before, made_up(name, uneven))[0]
    accepted, why = judge.better(made_up((), 1.15e-3), made_up(name, 1.05e-3))
    assert not accepted and "noise floor" in why


def test_a_tie_on_unseen_motions_is_a_set(judge: Evidence) -> None:
    noise = np.random.default_rng(1).normal(0.0, 1e-3, 10)
    winner = made_up(("coulomb_friction",), 0.004)
    assert judge.tied(winner, made_up(("dead_zone",), 0.004 + noise - noise.mean()))[0]
    assert not judge.tied(winner, made_up(("backlash",), 0.006))[0]


def test_the_simpler_of_nested_effects_wins_a_tie_and_a_bound_never_wins(judge: Evidence) -> None:
    simple = made_up(("coulomb_friction",), 1.000e-3)
    fuller = made_up(("stribeck_friction",), 0.970e-3, fitted=0.999e-3)
    assert judge.winner([fuller, simple]) is simple
    worse = made_up(("coulomb_friction",), 1.6e-3)
    assert judge.winner([fuller, worse]) is fuller
    end = Coordinate("backlash.width_rad", servo.BACKLASH_WIDTH, False, 1.0, 0.0, 9.0)
    stuck = made_up(("backlash",), 0.004)
    stuck = replace(
        stuck, coordinates=(*stuck.coordinates[:-1], end), x=np.array([0.0, 0.0, 0.0, 9.0])
    )
    inside = made_up(("dead_zone",), 0.005)
    assert stuck.at_bound == ("backlash.width_rad",) and judge.winner([stuck, inside]) is inside


def test_a_cause_outside_the_table_on_one_joint_of_a_finger_is_one_on_the_others() -> None:
    def explanation(*names: str, verdict: str = "effects") -> Explanation:
        return Explanation(made_up((), 0.02), made_up(names, 0.001), verdict, "")

    pair = ("gravity_load", "encoder_bias")
    spring, mine = explanation(*pair, verdict="unknown"), explanation(*pair)
    found = doubted([spring, mine, mine], [0, 0, 1])
    assert [e.verdict for e in found] == ["unknown", "unknown", "effects"]
    assert doubted([spring, explanation("backlash")], [0, 0])[1].verdict == "effects"
