"""What decides, on made-up fits: gains on unseen motions, ties, bounds, and other joints."""

from dataclasses import replace

import numpy as np
import pytest
from gap_recordings import FLOOR, made_up

import vd.kernels.servo.actuators as servo
from vd.gap.coordinates import Coordinate
from vd.gap.models import Explanation
from vd.gap.rules import Evidence, at_bound, doubted, refused, tied, winner
from vd.gap.statistics import resamples


@pytest.fixture
def evidence() -> Evidence:
    return Evidence(noise=FLOOR, weights=resamples(10, np.random.default_rng(0)))


def test_a_gain_is_over_five_percent_over_the_noise_and_holds_over_trajectories(
    evidence: Evidence,
) -> None:
    before, name = made_up((), 0.010), ("backlash",)
    assert refused(evidence, before, made_up(name, 0.005)) == ""
    assert "less than 5 %" in refused(evidence, before, made_up(name, 0.0097))
    # One trajectory gains much, others lose a little: the interval over trajectories covers 0.
    uneven = np.full(10, 0.0102)
    uneven[0] = 0.0
    assert "not distinguishable" in refused(evidence, before, made_up(name, uneven))
    why = refused(evidence, made_up((), 1.15e-3), made_up(name, 1.05e-3))
    assert "noise floor" in why


def test_a_tie_on_unseen_motions_is_a_set(evidence: Evidence) -> None:
    noise = np.random.default_rng(1).normal(0.0, 1e-3, 10)
    best = made_up(("coulomb_friction",), 0.004)
    assert tied(evidence, best, made_up(("dead_zone",), 0.004 + noise - noise.mean()))
    assert not tied(evidence, best, made_up(("backlash",), 0.006))


def test_the_simpler_of_nested_effects_wins_a_tie_and_a_bound_never_wins(
    evidence: Evidence,
) -> None:
    simple = made_up(("coulomb_friction",), 1.000e-3)
    fuller = made_up(("stribeck_friction",), 0.970e-3, fitted=0.999e-3)
    assert winner(evidence, [fuller, simple]) is simple
    worse = made_up(("coulomb_friction",), 1.6e-3)
    assert winner(evidence, [fuller, worse]) is fuller
    end = Coordinate("backlash.width_rad", servo.BACKLASH_WIDTH, False, 1.0, 0.0, 9.0)
    stuck = made_up(("backlash",), 0.004)
    stuck = replace(
        stuck, coordinates=(*stuck.coordinates[:-1], end), x=np.array([0.0, 0.0, 0.0, 9.0])
    )
    inside = made_up(("dead_zone",), 0.005)
    assert at_bound(stuck) == ("backlash.width_rad",)
    assert winner(evidence, [stuck, inside]) is inside


def test_a_cause_outside_the_table_on_one_joint_of_a_finger_is_one_on_the_others() -> None:
    def explanation(*names: str, verdict: str = "effects") -> Explanation:
        return Explanation(made_up((), 0.02), made_up(names, 0.001), verdict, "")

    pair = ("gravity_load", "encoder_bias")
    spring, mine = explanation(*pair, verdict="unknown"), explanation(*pair)
    found = doubted([spring, mine, mine], [0, 0, 1])
    assert [e.verdict for e in found] == ["unknown", "unknown", "effects"]
    assert doubted([spring, explanation("backlash")], [0, 0])[1].verdict == "effects"
