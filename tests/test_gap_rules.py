"""What decides, on made-up fits: which models are good, what they share, bounds, and other joints."""

from dataclasses import replace

import numpy as np
import pytest
from gap_recordings import FLOOR, made_up

import vd.kernels.servo.actuators as servo
from vd.gap.coordinates import Coordinate
from vd.gap.rules import (
    FAMILIES,
    Evidence,
    at_bound,
    changes,
    conclude,
    contains,
    contradicted,
    difference,
    good_models,
    not_earned,
    open_sets,
    overall,
    shown,
)
from vd.gap.telemetry import Telemetry
from vd.kernels.servo.effects import EFFECTS

PLAIN = made_up((), 0.020)
NOISE = np.random.default_rng(1).normal(0.0, 1e-3, 10)


@pytest.fixture
def evidence() -> Evidence:
    return Evidence(FLOOR, range(10), whole=0.0)


def test_an_addition_earns_its_place_in_fitted_and_held_out_errors(evidence: Evidence) -> None:
    before, name = made_up((), 0.010), ("backlash",)
    assert not_earned(evidence, before, made_up(name, 0.005)) == ""
    assert "less than 5 %" in not_earned(evidence, before, made_up(name, 0.0097))
    # A motion held out makes the smaller one extrapolate: fitted errors are about the same.
    assert "less than 5 %" in not_earned(
        evidence, made_up((), 0.077, fitted=0.0161), made_up(name, 0.016, fitted=0.0157)
    )
    # Two trajectories gain much, others lose a little: the interval over trajectories covers 0.
    uneven = np.full(10, 0.0104)
    uneven[:2] = 0.0
    assert "not distinguishable" in not_earned(evidence, before, made_up(name, uneven))
    small = made_up(name, 1.05e-3), made_up((), 1.15e-3)
    assert "noise floor" in not_earned(evidence, *reversed(small))


def test_a_gap_that_refitting_alone_closes_is_no_effect(evidence: Evidence) -> None:
    """The plain model extrapolates to one motion held out, and fits it all the same."""
    plain = made_up((), 0.0775, fitted=0.0161)
    better = made_up(("backlash",), 0.0164, fitted=0.0157)
    conclusion = conclude(evidence, plain, [plain, better], "")
    assert conclusion.verdict == "unknown" and not conclusion.names
    assert conclusion.final is plain
    quiet = made_up((), 0.0775, fitted=1.0e-3)
    assert conclude(evidence, quiet, [quiet, better], "").verdict == "no_gap"


def test_names_are_what_all_good_models_share(evidence: Evidence) -> None:
    limit = made_up(("load_friction", "torque_limit"), 0.004)
    saturation = made_up(("load_friction", "torque_saturation"), 0.004 + NOISE - NOISE.mean())
    alone = made_up(("load_friction",), 0.012)
    conclusion = conclude(evidence, PLAIN, [PLAIN, limit, saturation, alone], "")
    assert conclusion.verdict == "effects" and conclusion.names == ("load_friction",)
    assert conclusion.families["dry friction"] == "certain"
    assert conclusion.families["torque ceiling"] == "certain"
    assert [{*group} for group in open_sets(conclusion.good)] == [
        {"torque_limit", "torque_saturation"}
    ]
    assert conclusion.shares.sum() == pytest.approx(1.0) and len(conclusion.shares) == 2


def test_what_few_motions_show_is_delivered_and_not_named(evidence: Evidence) -> None:
    """Two motions of ten gain: more than one standard error, within the 95 % interval."""
    uneven = np.full(10, 0.004)
    uneven[:2] = 0.012
    alone = made_up(("load_friction",), uneven)
    both = made_up(("load_friction", "torque_saturation"), 0.004)
    conclusion = conclude(evidence, PLAIN, [PLAIN, alone, both], "")
    assert conclusion.final is both and conclusion.names == ("load_friction",)
    assert conclusion.families["torque ceiling"] == "untold"
    assert open_sets(conclusion.good) == [("torque_saturation",)]


def test_a_family_is_likely_if_more_motions_speak_for_it_than_luck_has(evidence: Evidence) -> None:
    """Nine of ten motions are, six are not; a tenth keeps the other model among the good ones."""
    friction = made_up(("coulomb_friction",), np.array([0.005] * 9 + [0.004]))
    for won, verdict in ((9, "likely"), (6, "untold")):
        play = made_up(("backlash",), np.array([0.004] * won + [0.0055] * (9 - won) + [0.008]))
        conclusion = conclude(evidence, PLAIN, [PLAIN, friction, play], "")
        assert conclusion.families["play"] == verdict and len(conclusion.good) == 2


def test_what_no_use_would_notice_makes_no_model_worse(evidence: Evidence) -> None:
    """Each motion is 0.5 % worse, without doubt, or 10 % worse."""
    best = made_up(("dead_zone",), 0.0040)
    close = made_up(("coulomb_friction",), 0.00402)
    far = made_up(("load_friction",), 0.0044)
    assert difference(evidence, best, close)[0] > 0.0
    assert good_models(evidence, [PLAIN, best, close, far]) == [best, close]
    conclusion = conclude(evidence, PLAIN, [PLAIN, best, close, far], "")
    assert {*conclusion.families.values()} == {"untold"}
    assert conclusion.shares == pytest.approx([0.5, 0.5])


def test_intervals_are_wider_over_fewer_blocks_of_motions(evidence: Evidence) -> None:
    best, other = made_up(("backlash",), 0.004), made_up(("dead_zone",), 0.006 + NOISE)
    width = np.ptp(difference(evidence, best, other))
    paired = replace(evidence, folds=[0, 0, 1, 1, 2, 2, 3, 3, 4, 4])
    few = replace(evidence, folds=[0] * 5 + [1] * 5)
    assert len(paired.without) == 5 and len(few.without) == 10
    alike = made_up(("dead_zone",), np.repeat((0.006 + NOISE)[:5], 2))
    assert np.ptp(difference(paired, best, alike)) > 1.2 * np.ptp(difference(few, best, alike))
    assert np.ptp(difference(few, best, other)) == pytest.approx(width)


def test_a_family_is_certain_before_its_member_is(evidence: Evidence) -> None:
    coulomb = made_up(("coulomb_friction",), 0.004)
    load = made_up(("load_friction",), 0.004 + NOISE - NOISE.mean())
    zone = made_up(("dead_zone",), 0.009)
    conclusion = conclude(evidence, PLAIN, [PLAIN, coulomb, load, zone], "")
    assert conclusion.verdict == "ambiguous" and not conclusion.names
    assert conclusion.families == {"dry friction": "certain"}
    close = made_up(("dead_zone",), 0.004 + NOISE[::-1] - NOISE.mean())
    conclusion = conclude(evidence, PLAIN, [PLAIN, coulomb, load, close], "")
    assert {*conclusion.families.values()} <= {"likely", "untold"}


def test_a_family_is_excluded_only_if_the_best_model_was_fitted_with_it(evidence: Evidence) -> None:
    """Coulomb friction is the best; nothing is said of a dead zone that was tried alone."""
    coulomb = made_up(("coulomb_friction",), 0.004)
    zone = made_up(("dead_zone",), 0.009)
    both = made_up(("coulomb_friction", "dead_zone"), 0.004)
    assert "play" not in conclude(evidence, PLAIN, [PLAIN, coulomb, zone], "").families
    tried = conclude(evidence, PLAIN, [PLAIN, coulomb, zone, both], "")
    assert tried.families == {"dry friction": "certain", "play": "excluded"}


def test_a_family_that_the_best_model_imitates_is_not_excluded(evidence: Evidence) -> None:
    """Friction that differs between the directions is Coulomb friction beside an offset."""
    direction = made_up(("asymmetric_friction",), 0.004)
    bias = made_up(("asymmetric_friction", "encoder_bias"), 0.004)
    delay = made_up(("asymmetric_friction", "command_delay"), 0.004)
    conclusion = conclude(evidence, PLAIN, [PLAIN, direction, bias, delay], "")
    assert conclusion.families == {
        "dry friction": "certain",
        "delay": "excluded",
        "load or offset": "untold",
    }


def test_a_larger_model_is_good_only_if_none_that_it_contains_is(evidence: Evidence) -> None:
    simple = made_up(("coulomb_friction",), 0.0040)
    for names in (("stribeck_friction",), ("coulomb_friction", "encoder_bias")):
        assert good_models(evidence, [PLAIN, made_up(names, 0.0039), simple]) == [simple]
        larger = made_up(names, 0.0020)
        assert good_models(evidence, [PLAIN, larger, simple]) == [larger]


def test_of_two_models_that_can_do_the_same_neither_has_to_earn_its_place_beside_the_other() -> (
    None
):
    direction = made_up(("asymmetric_friction",), 0.004)
    offset = made_up(("coulomb_friction", "encoder_bias"), 0.004)
    both = made_up(("asymmetric_friction", "encoder_bias"), 0.004)
    assert contains(offset, direction) and contains(both, direction)
    assert not contains(offset, both) and not contains(both, offset)


def test_samples_tell_models_apart_once_one_leaves_noise(evidence: Evidence) -> None:
    """One motion of ten shows the difference, and no held-out error of the better one is sure."""
    errors = np.full(10, 1.0e-3)
    errors[0] = 2.0e-3
    best = made_up(("torque_limit",), 0.003, fitted=1.0e-3)
    other = made_up(("torque_saturation",), errors)
    assert good_models(evidence, [PLAIN, best, other]) == [best]


def test_samples_do_not_tell_less_than_the_best_itself_leaves(evidence: Evidence) -> None:
    best = made_up(("torque_limit",), 1.10e-3)
    close, far = made_up(("torque_saturation",), 1.15e-3), made_up(("supply_sag",), 1.25e-3)
    assert good_models(evidence, [PLAIN, best, close, far]) == [best, close]


def test_a_bound_and_what_can_be_nothing_explain_nothing(evidence: Evidence) -> None:
    end = Coordinate("backlash.width_rad", servo.BACKLASH_WIDTH, False, 1.0, 0.0, 9.0)
    stuck = made_up(("backlash",), 0.004)
    x = np.array([0.0, 0.0, 0.0, 9.0])
    stuck = replace(stuck, coordinates=(*stuck.coordinates[:-1], end), x=x)
    inside = made_up(("dead_zone",), 0.005)
    assert "backlash" in at_bound(stuck) and not at_bound(inside)
    assert good_models(evidence, [PLAIN, stuck, inside]) == [inside]
    loose = replace(inside, refits=np.array([[0.0] * 4, [0.0, 0.0, 0.0, 9.0]]))
    assert good_models(evidence, [PLAIN, loose]) == [PLAIN]


def test_less_than_half_of_the_gap_is_unknown(evidence: Evidence) -> None:
    half = made_up(("backlash",), 0.017)
    conclusion = conclude(evidence, PLAIN, [PLAIN, half], "")
    assert conclusion.verdict == "unknown" and "less than half" in conclusion.reason
    assert conclusion.final is PLAIN and not conclusion.families


def test_motions_that_leave_the_baseline_open_are_said(evidence: Evidence) -> None:
    quiet = made_up((), FLOOR)
    assert conclude(evidence, quiet, [quiet], "kd is open").verdict == "under_excited"
    two = replace(quiet, sse=quiet.sse[:2])
    assert conclude(evidence, two, [two], "").verdict == "under_excited"


def test_models_differ_in_one_family_and_have_one_member_of_each() -> None:
    models = changes(("coulomb_friction", "backlash"), EFFECTS)
    assert frozenset({"backlash"}) in models and frozenset({"coulomb_friction"}) in models
    assert frozenset({"stribeck_friction", "backlash"}) in models
    assert frozenset({"coulomb_friction", "dead_zone"}) in models
    assert frozenset({"coulomb_friction", "backlash", "dead_zone"}) not in models
    assert all("joint_coupling" not in model for model in changes((), ["backlash"]))


def test_every_effect_but_jitter_is_in_one_family() -> None:
    members = [name for family in FAMILIES.values() for name in family.effects]
    assert sorted(members) == sorted({*EFFECTS} - {"command_jitter"})


def test_telemetry_rules_out_what_it_would_show() -> None:
    assert contradicted(Telemetry(fall=None, follows=0.0)) == {}
    assert set(contradicted(Telemetry(fall=(0.3, 12.0), follows=0.0))) == {"supply_sag"}
    assert contradicted(Telemetry(fall=(3.0, 12.0), follows=0.9)) == {}
    downstream = contradicted(Telemetry(fall=None, follows=0.999))
    assert {"command_delay", "backlash"} <= set(downstream) and "supply_sag" not in downstream


@pytest.mark.parametrize(
    ("name", "estimate", "is_shown"),
    [
        ("backlash", (0.03, 0.02, 0.04), True),
        ("encoder_bias", (0.03, -0.01, 0.07), False),
        ("torque_limit", (1.0, 0.8, 1.2), True),  # no limit is an infinite one
        ("torque_limit", (1.0, 0.2, 5.0), False),
    ],
)
def test_the_size_of_an_effect_is_not_nothing(
    name: str, estimate: tuple[float, float, float], is_shown: bool
) -> None:
    key = f"{name}.{EFFECTS[name].parameters[0].name}"
    value, low, high = estimate
    assert shown(name, {key: value}, {key: (low, high)}) == is_shown


def test_a_recording_has_the_first_verdict_in_the_order_of_importance() -> None:
    assert overall(["no_gap", "unknown", "ambiguous"]) == "ambiguous"
    assert overall(["under_excited", "effects"]) == "effects" and overall([]) == "no_gap"
