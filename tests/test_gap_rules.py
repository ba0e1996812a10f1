"""What decides, on made-up fits: gains on unseen motions, ties, bounds, and other joints."""

from dataclasses import replace

import numpy as np
import pytest
from gap_recordings import FLOOR, made_up

import vd.kernels.servo.actuators as servo
from vd.gap.coordinates import Coordinate
from vd.gap.models import Accepted, Explanation, Telemetry
from vd.gap.rules import (
    Evidence,
    agree,
    at_bound,
    contradicted,
    doubted,
    exchanged,
    late_side,
    named,
    overall,
    refused,
    refused_jitter,
    refused_step,
    tied,
    winner,
    without_jitter,
)
from vd.gap.statistics import resamples
from vd.kernels.servo.effects import EFFECTS


@pytest.fixture
def evidence() -> Evidence:
    return Evidence(noise=FLOOR, weights=resamples(10, np.random.default_rng(0)))


def test_a_gain_is_over_five_percent_over_the_noise_and_holds_over_trajectories(
    evidence: Evidence,
) -> None:
    before, name = made_up((), 0.010), ("backlash",)
    assert refused(evidence, before, made_up(name, 0.005)) == ""
    assert "less than 5 %" in refused(evidence, before, made_up(name, 0.0097))
    # Two trajectories gain much, others lose a little: the interval over trajectories covers 0.
    uneven = np.full(10, 0.0104)
    uneven[:2] = 0.0
    assert "not distinguishable" in refused(evidence, before, made_up(name, uneven))
    assert refused_step(evidence, before, made_up(name, uneven)) == ""  # as one of two causes may
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


def told(
    follows: float = 0.0,
    left: tuple[float, float] = (1.0, 1.0),
    fall: tuple[float, float] | None = None,
) -> Telemetry:
    """What telemetry says, with 20 ms as the best delay of command and reading."""
    late = {"command_delay": (0.02, left[0]), "read_delay": (0.02, left[1])}
    return Telemetry(fall, follows, late, sample_s=0.01)


def test_telemetry_rules_out_what_it_would_show() -> None:
    assert contradicted(told()) == {}
    assert set(contradicted(told(fall=(0.3, 12.0)))) == {"supply_sag"}
    assert contradicted(told(fall=(3.0, 12.0))) == {}
    downstream = contradicted(told(follows=0.999))
    assert {"command_delay", "backlash"} <= set(downstream) and "supply_sag" not in downstream
    late = told(follows=0.9, left=(0.001, 0.02))
    assert late_side(late) == "command_delay"
    assert "read_delay" in contradicted(late) and "command_delay" not in contradicted(late)
    assert late_side(told(left=(0.001, 0.003))) == ""  # both fit


def test_an_exchange_needs_a_better_effect_that_nothing_contradicts(evidence: Evidence) -> None:
    present, better = made_up(("dead_zone",), 0.006), made_up(("backlash",), 0.003)
    assert exchanged(evidence, present, [present, better], ()) is better
    assert exchanged(evidence, present, [present, better], ("backlash",)) is None
    assert exchanged(evidence, present, [present, made_up(("backlash",), 0.0061)], ()) is None


def test_random_delays_have_to_be_likelier_and_to_leave_noise(evidence: Evidence) -> None:
    present, random = made_up((), 0.010), made_up(("command_jitter",), 0.005)
    assert refused_jitter(evidence, present, random, left=FLOOR) == ""
    assert "noise floors besides" in refused_jitter(evidence, present, random, left=3.0 * FLOOR)
    hardly = made_up(("command_jitter",), 0.0098)
    assert "narrows what is left by 2.0 %" in refused_jitter(evidence, present, hardly, left=FLOOR)


def test_random_delays_are_none_where_another_joint_of_the_finger_shows_none() -> None:
    fit, plain = made_up(("backlash",), 0.5 * FLOOR), made_up((), 0.02)
    clear = Explanation(plain, fit, "effects", "")
    late = Explanation(plain, made_up(("command_delay",), 0.5 * FLOOR), "effects", "")
    assert without_jitter([(FLOOR, clear)]) and not without_jitter([(FLOOR, late)])
    assert not without_jitter([])


def accepted(name: str, estimate: tuple[float, float, float], **known) -> Accepted:
    """An effect of one parameter that every resample chooses."""
    parameter = EFFECTS[name].parameters[0].name
    values = {"confidence": 1.0, "alternatives": (), "tied": (), "at_bound": False, **known}
    return Accepted(name=name, estimates={parameter: estimate}, **values)


def test_a_name_is_chosen_often_alone_and_of_a_size_that_is_not_nothing() -> None:
    sure = (0.03, 0.02, 0.04)
    assert named(accepted("backlash", sure))
    assert not named(accepted("backlash", sure, confidence=0.8))
    assert not named(accepted("backlash", sure, tied=("dead_zone",)))
    assert not named(accepted("backlash", sure, at_bound=True))
    assert not named(accepted("encoder_bias", (0.03, -0.01, 0.07)))
    # No limit is an infinite one.
    assert named(accepted("torque_limit", (1.0, 0.8, 1.2)))
    assert not named(accepted("torque_limit", (1.0, 0.2, 5.0)))


def test_joints_share_an_effect_if_their_values_can_be_the_same() -> None:
    here = accepted("backlash", (0.030, 0.029, 0.031))
    assert agree(here, accepted("backlash", (0.0325, 0.032, 0.033)))  # within a tenth
    assert agree(here, accepted("backlash", (0.040, 0.030, 0.050)))  # intervals overlap
    assert not agree(here, accepted("backlash", (0.040, 0.039, 0.041)))


def test_a_recording_has_the_first_verdict_in_the_order_of_importance() -> None:
    assert overall(["no_gap", "unknown", "ambiguous"]) == "ambiguous"
    assert overall(["under_excited", "effects"]) == "effects" and overall([]) == "no_gap"
