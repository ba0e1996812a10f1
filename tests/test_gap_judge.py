"""Rules of evidence and verdicts, on made-up fits."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

import vd.kernels.servo.actuators as servo
from vd.gap.consensus import agree, no_spring, share
from vd.gap.coordinates import Coordinate
from vd.gap.explanation import Accepted, Explanation, intervals
from vd.gap.joint_fit import JointFit
from vd.gap.result import Verdict
from vd.gap.statistics import resamples
from vd.gap.verdict import Verdicts, cancelled

FLOOR = 1e-3
COUNT = np.full(10, 500.0)


def made_up(effects: tuple[str, ...], errors: np.ndarray | float, fitted: float | None = None) -> JointFit:
    """A fit with given held-out RMSE of each trajectory [rad]."""
    held_out = COUNT * np.broadcast_to(errors, COUNT.shape) ** 2
    size = 3 + len(effects)
    return JointFit(
        effects=effects,
        coordinates=tuple(Coordinate(f"p{i}", i, False, 1.0, -9.0, 9.0) for i in range(size)),
        x=np.zeros(size),
        rows=np.zeros((1, servo.PARAMETER_COLUMNS)),
        sse=held_out if fitted is None else COUNT * fitted**2,
        held_out=held_out,
        count=COUNT,
        gram=np.tile(np.eye(size), (10, 1, 1)),
        gradient=np.zeros((10, size)),
    )


@pytest.fixture
def judge() -> Verdicts:
    return Verdicts(floor=FLOOR, weights=resamples(10, np.random.default_rng(0)))


def test_gain_must_hold_over_trajectories(judge: Verdicts) -> None:
    before = made_up((), 0.010)
    assert judge.better(before, made_up(("backlash",), 0.005))[0]
    assert not judge.better(before, made_up(("backlash",), 0.0097))[0]
    # One trajectory gains much, others lose a little: the interval over trajectories covers 0.
    uneven = np.full(10, 0.0102)
    uneven[0] = 0.0
    assert not judge.better(before, made_up(("backlash",), uneven))[0]


def test_what_is_under_the_noise_floor_is_no_gain(judge: Verdicts) -> None:
    accepted, why = judge.better(made_up((), 1.15e-3), made_up(("backlash",), 1.05e-3))
    assert not accepted and "noise floor" in why


def test_a_tie_is_a_set(judge: Verdicts) -> None:
    rng = np.random.default_rng(1)
    winner = made_up(("coulomb_friction",), 0.004)
    noise = rng.normal(0.0, 1e-3, 10)
    assert judge.tied(winner, made_up(("dead_zone",), 0.004 + noise - noise.mean()))[0]
    assert not judge.tied(winner, made_up(("backlash",), 0.006))[0]


def test_at_the_floor_samples_decide(judge: Verdicts) -> None:
    """An explained recording tells candidates apart even if one motion alone shows the difference."""
    errors = np.full(10, FLOOR)
    winner = made_up(("coulomb_friction",), errors)
    errors = errors.copy()
    errors[3] = 1.5 * FLOOR
    assert not judge.tied(winner, made_up(("dead_zone",), errors))[0]
    assert judge.tied(winner, made_up(("dead_zone",), FLOOR))[0]


def test_the_simpler_of_nested_effects_wins_a_tie(judge: Verdicts) -> None:
    simple = made_up(("coulomb_friction",), 1.000e-3)
    complex_ = made_up(("stribeck_friction",), 0.970e-3, fitted=0.999e-3)
    assert judge.winner([complex_, simple]) is simple
    better = made_up(("stribeck_friction",), 1.0e-3)
    worse = made_up(("coulomb_friction",), 1.6e-3)
    assert judge.winner([better, worse]) is better


def test_at_the_floor_the_samples_choose_not_the_luck_of_a_motion(judge: Verdicts) -> None:
    right = made_up(("coulomb_friction",), 1.06 * FLOOR, fitted=1.00 * FLOOR)
    lucky = made_up(("dead_zone",), 1.01 * FLOOR, fitted=1.02 * FLOOR)
    assert judge.winner([lucky, right]) is right
    far = made_up(("dead_zone",), 5.0 * FLOOR, fitted=6.0 * FLOOR)
    farther = made_up(("coulomb_friction",), 5.5 * FLOOR, fitted=5.0 * FLOOR)
    assert judge.winner([far, farther]) is far, "away from it unseen motions do"


def test_a_small_excess_tells_apart_only_if_most_motions_show_it(judge: Verdicts) -> None:
    winner = made_up(("coulomb_friction",), FLOOR)
    everywhere = np.full(10, np.sqrt(1.01) * FLOOR)
    assert not judge.tied(winner, made_up(("dead_zone",), everywhere))[0]
    assert judge.tied(winner, made_up(("dead_zone",), everywhere), loose=True)[0]
    somewhere = np.full(10, np.sqrt(0.998) * FLOOR)
    somewhere[:2] = np.sqrt(1.03) * FLOOR  # half as much in all, but most motions say the opposite
    assert judge.tied(winner, made_up(("dead_zone",), somewhere))[0]
    slightly = made_up(("dead_zone",), np.sqrt(1.002) * FLOOR)
    assert judge.tied(winner, slightly)[0], "what models leave"
    richer = replace(slightly, x=np.zeros(len(slightly.x) + 2))
    assert not judge.tied(winner, richer)[0], "more parameters that do worse"
    assert judge.tied(winner, replace(richer, sse=0.999 * winner.sse))[0]


def test_a_fuller_form_that_is_a_little_better_makes_a_set(judge: Verdicts) -> None:
    limit = made_up(("torque_limit",), FLOOR)
    for excess, tied in ((0.993, ("torque_speed_limit",)), (0.999, ()), (1.01, ())):
        line = made_up(("torque_speed_limit",), np.sqrt(excess) * FLOOR)
        assert judge.accept(limit, "torque_limit", [limit, line], {}, limit).tied == tied
    friction = made_up(("coulomb_friction",), FLOOR)
    fuller = made_up(("stribeck_friction",), np.sqrt(0.993) * FLOOR)
    assert judge.accept(friction, "coulomb_friction", [friction, fuller], {}, friction).tied == ()


def load_and_offset(torque: float, phase: float, bias: float, error: float = FLOOR) -> JointFit:
    """A made-up fit with a load and an encoder's offset."""
    plain = made_up(("gravity_load", "encoder_bias"), error)
    keys = ("gravity_load.tau_g_nm", "gravity_load.phase_rad", "encoder_bias.bias_rad")
    some = tuple(Coordinate(key, 0, False, 1.0, -9.0, 9.0) for key in keys)
    rows = plain.rows.copy()
    rows[0, servo.KP] = 3.0
    x = np.array([0.0, 0.0, torque, phase, bias])
    return replace(plain, coordinates=(*plain.coordinates[:2], *some), x=x, rows=rows)


def test_a_load_and_an_offset_that_cancel_at_rest_are_a_spring() -> None:
    fit = load_and_offset

    assert "spring" in cancelled(fit(0.015, -1.15, -0.00457), 0, 0.0)
    assert cancelled(fit(0.015, -1.15, 0.00457), 0, 0.0) == "", "together they hold it off"
    assert cancelled(fit(0.015, -1.15, -0.0065), 0, 0.0) == ""
    assert cancelled(fit(0.015, -1.15, -0.00457), 0, 0.8) == "", "and elsewhere it rests elsewhere"
    assert cancelled(made_up(("gravity_load",), FLOOR), 0, 0.0) == ""


def test_a_bound_is_no_estimate(judge: Verdicts) -> None:
    stuck = made_up(("backlash",), 0.004)
    end = Coordinate("backlash.width_rad", servo.BACKLASH_WIDTH, False, 1.0, 0.0, 9.0)
    stuck = replace(stuck, coordinates=(*stuck.coordinates[:-1], end), x=np.array([0.0, 0.0, 0.0, 9.0]))
    inside = made_up(("dead_zone",), 0.005)
    assert stuck.at_bound == ("backlash.width_rad",)
    assert judge.winner([stuck, inside]) is inside


def test_sets_of_several_joints_meet_in_one_name() -> None:
    def explanation(name: str, *tied: str) -> Explanation:
        accepted = Accepted(name, 0.6 if tied else 1.0, {}, (), tied, False)
        fits = [made_up((other,), 0.01) for other in (name, *tied)]
        verdict = "ambiguous" if tied else "effects"
        return Explanation(made_up((), 0.02), fits[0], verdict, "", (accepted,), (), {name: fits})

    def names(*explanations: Explanation, groups: list[int] | None = None) -> list[str]:
        shared = share(explanations, [FLOOR] * len(explanations), groups)
        return [e.accepted[0].name if e.accepted[0].named else "?" for e in shared]

    one, other = explanation("backlash", "dead_zone"), explanation("backlash", "coulomb_friction")
    assert names(one, other) == ["backlash", "backlash"]
    assert names(one, explanation("backlash")) == ["backlash", "backlash"]
    assert names(one, explanation("dead_zone")) == ["dead_zone", "dead_zone"]
    assert names(one, explanation("thermal_drift")) == ["?", "thermal_drift"]
    assert names(one) == ["?"]
    # Separate servos share gravity, not the play of one gear.
    assert names(one, explanation("backlash"), groups=[0, 1]) == ["?", "backlash"]
    # What is worse by more than an effect must gain is not adopted, unless it was not fitted to the end.
    poor = explanation("dead_zone", "backlash")
    poor.rivals["dead_zone"][1] = made_up(("backlash",), 0.013)  # type: ignore[index]
    assert names(poor, explanation("backlash")) == ["?", "backlash"]
    ended = [lambda fit: made_up(fit.effects, 0.0102)] * 2
    shared = share([poor, explanation("backlash")], [FLOOR] * 2, polish=ended)
    assert [e.accepted[0].name for e in shared] == ["backlash"] * 2 and shared[0].accepted[0].named
    assert shared[0].final.held_out_rmse == pytest.approx(0.0102)
    loaded = explanation("encoder_bias", "gravity_load")
    assert names(loaded, explanation("gravity_load"), groups=[0, 1]) == ["gravity_load", "gravity_load"]
    # What another joint adds to a name is said, too.
    dry = explanation("coulomb_friction").accepted
    both = replace(
        loaded, verdict="effects", accepted=(*dry, *loaded.accepted), reason="friction explains it"
    )
    adopted = share([both, explanation("gravity_load")], [FLOOR] * 2, [0, 1])[0]
    assert adopted.reason == "coulomb_friction and gravity_load explain it, as on the other joints"


def test_what_comes_nearest_to_an_unknown_cause_is_no_name_by_other_joints() -> None:
    """Beside a torque ripple joints came with sets that share play, all refused, and ended with its name."""

    def explanation(verdict: Verdict, name: str, *tied: str) -> Explanation:
        accepted = Accepted(name, 0.6 if tied else 1.0, {}, (), tied, False)
        fits = [made_up((other,), 0.01) for other in (name, *tied)]
        return Explanation(made_up((), 0.011), fits[0], verdict, "refused", (accepted,), (), {name: fits})

    refused = explanation("unknown", "backlash", "dead_zone")
    again = explanation("unknown", "backlash", "coulomb_friction")
    sure = explanation("unknown", "backlash")
    for joints in ([refused, again, sure], [refused, explanation("effects", "backlash")]):
        assert share(joints, [FLOOR] * len(joints)) == joints
    open_set = explanation("ambiguous", "backlash", "dead_zone")
    assert share([open_set, sure, again], [FLOOR] * 3) == [open_set, sure, again], "nor do they settle sets"
    assert share([open_set, explanation("effects", "backlash")], [FLOOR] * 2)[0].verdict == "effects"


@pytest.mark.parametrize(("error", "named"), [(1.03, "coulomb_friction"), (1.08, "asymmetric_friction")])
def test_a_fuller_form_of_what_the_others_have_must_gain_as_an_effect_does(error: float, named: str) -> None:
    """A right model leaves more than the floor where times are rounded; two sides of friction do a little."""

    def explanation(name: str, left: float = FLOOR) -> Explanation:
        accepted = (Accepted(name, 1.0, {}, (), (), False),)
        return Explanation(made_up((), 0.02), made_up((name,), left), "effects", "", accepted)

    three = [explanation("asymmetric_friction", 1.1 * FLOOR), *[explanation("coulomb_friction")] * 2]
    fits = [lambda effects, starts: made_up(effects, 1.1 * error * FLOOR)] * 3
    assert agree(three, [FLOOR] * 3, [0, 0, 0], fits)[0].accepted[0].name == named


@pytest.mark.parametrize(
    ("error", "own", "adopted"),
    [
        (1.0, ("command_filter", "gravity_load"), True),
        (1.2, ("command_filter", "gravity_load"), False),  # worse by more than chance
        (1.0, ("gravity_load",), False),  # more effects than the joint's own
        (1.0, (), False),  # nothing to explain
    ],
)
def test_a_joint_takes_the_model_of_all_others_where_it_is_as_good(
    error: float, own: tuple[str, ...], adopted: bool
) -> None:
    def explanation(*names: str) -> Explanation:
        accepted = tuple(Accepted(name, 1.0, {}, (), (), False) for name in names)
        verdict = "effects" if names else "no_gap"
        return Explanation(made_up((), 0.02), made_up(names, FLOOR), verdict, "", accepted)

    def fit(effects: tuple[str, ...], starts: Sequence[Mapping[str, float]]) -> JointFit:
        assert all(start for start in starts)
        return made_up(effects, (error if effects == both else 9.0) * FLOOR)

    both = ("command_delay", "gravity_load")
    three = [explanation(*own), explanation(*both), explanation(*both)]
    found = agree(three, [FLOOR] * 3, [0, 0, 0], [fit] * 3)
    assert {a.name for a in found[0].accepted} == {*(both if adopted else own)}
    assert found[1:] == three[1:]
    fits = [fit, *[lambda effects, _: made_up(effects, 9.0 * FLOOR)] * 2]
    part = [three[0], explanation("gravity_load"), three[2]]
    shown = agree(part, [FLOOR] * 3, [0, 0, 0], fits)[0]
    assert shown.accepted == found[0].accepted, "one of the two shows the load only"
    apart = [three[0], explanation("backlash"), three[2]]
    far = [lambda effects, _: made_up(effects, 9.0 * FLOOR if "backlash" in effects else FLOOR)] * 3
    assert agree(apart, [FLOOR] * 3, [0, 0, 0], far)[0] == three[0], "they do not agree"
    assert agree(three, [FLOOR] * 3, [0, 1, 2], [fit] * 3) == three, "of other fingers"
    assert agree(three[:2], [FLOOR] * 2, [0, 0], [fit] * 2) == three[:2], "one other is no agreement"


@pytest.mark.parametrize(
    ("own", "fit", "adopted"),
    [
        (3.0, 1.0, True),
        (1.1, 1.0, False),  # closes less than an effect must
        (3.0, 1.2, False),  # leaves more than noise
    ],
)
def test_a_joint_takes_a_larger_model_of_all_others_where_it_alone_leaves_noise(
    own: float, fit: float, adopted: bool
) -> None:
    """Chance stood for a filter and a limit that a search had missed and the other joints had."""

    def explanation(left: float, *names: str) -> Explanation:
        accepted = tuple(Accepted(name, 1.0, {}, (), (), False) for name in names)
        return Explanation(made_up((), 0.02), made_up(names, left * FLOOR), "effects", "", accepted)

    both = ("command_filter", "torque_limit")
    three = [explanation(own, "command_delay"), explanation(1.0, *both), explanation(1.0, *both)]
    found = agree(three, [FLOOR] * 3, [0, 0, 0], [lambda effects, _: made_up(effects, fit * FLOOR)] * 3)
    assert [a.name for a in found[0].accepted] == ([*both] if adopted else ["command_delay"])


@pytest.mark.parametrize(
    ("verdict", "left", "adopted"),
    [
        ("effects", 1.0, True),
        ("effects", 1.08, True),  # the joint's own gains less over it than an effect must
        ("effects", 1.2, False),  # it leaves more than noise
        ("unknown", 1.0, False),  # what nothing explains is not explained by less
    ],
)
def test_a_joint_takes_the_model_of_fewer_effects_that_one_other_is_sure_of(
    verdict: Verdict, left: float, adopted: bool
) -> None:
    """A load and a coupling stood for a limit that the first of three joints showed."""

    def explanation(verdict: Verdict, *names: str) -> Explanation:
        accepted = tuple(Accepted(name, 1.0, {}, (), (), False) for name in names)
        return Explanation(made_up((), 0.02), made_up(names, FLOOR), verdict, "", accepted)

    few, many = ("payload_inertia", "torque_limit"), ("payload_inertia", "gravity_load", "joint_coupling")
    three = [explanation("effects", *few), explanation(verdict, *many), explanation("effects", *many)]
    found = agree(three, [FLOOR] * 3, [0, 0, 0], [lambda effects, _: made_up(effects, left * FLOOR)] * 3)
    assert found[0] == three[0], "more effects have to be earned"
    assert [a.name for a in found[1].accepted] == [*(few if adopted else many)]
    assert [a.name for a in found[2].accepted] == [*(few if left < 1.1 else many)]
    unsure, never = replace(three[0], verdict="ambiguous"), lambda *_: pytest.fail("tried")
    fits = [lambda effects, _: made_up(effects, 9.0 * FLOOR), never, never]
    assert agree([unsure, *three[1:]], [FLOOR] * 3, [0, 0, 0], fits) == [unsure, *three[1:]]


def test_a_load_and_an_offset_are_no_names_where_another_joint_shows_a_spring() -> None:
    def explanation(verdict: Verdict, *names: str) -> Explanation:
        accepted = tuple(Accepted(name, 1.0, {}, (), (), False) for name in names)
        return Explanation(made_up((), 0.02), made_up(names, FLOOR), verdict, "", accepted)

    both = ("gravity_load", "encoder_bias")
    here = explanation("effects", *both[::-1])
    refused, other = explanation("unknown", *both), explanation("unknown", "backlash")
    found = no_spring([here, refused, other], [0, 0, 0])
    assert [e.verdict for e in found] == ["unknown"] * 3 and "spring" in found[0].reason
    assert found[1:] == [refused, other]
    named = [here, explanation("effects", *both), other]
    assert no_spring(named, [0, 0, 0]) == named, "no joint refuses them"
    assert no_spring([here, refused], [0, 1]) == [here, refused], "of other fingers"
    more = explanation("effects", *both, "backlash")
    assert no_spring([more, refused], [0, 0]) == [more, refused], "more than the two"


@pytest.mark.parametrize(("floor", "tied"), [(FLOOR, ("supply_sag",)), (10.0 * FLOOR, ())])
def test_forms_of_one_loss_are_a_set_only_far_from_the_floor(floor: float, tied: tuple[str, ...]) -> None:
    judge = Verdicts(floor=floor, weights=resamples(10, np.random.default_rng(0)))
    judge.without["torque_saturation"] = 0.040
    soft, sag, delay, limit = (
        made_up((name,), error)
        for name, error in (
            ("torque_saturation", 0.012),
            ("supply_sag", 0.020),
            ("command_delay", 0.020),
            ("torque_limit", 0.035),
        )
    )
    accepted = judge.accept(soft, "torque_saturation", [soft, sag, delay, limit], {}, soft)
    assert accepted.tied == tied


def concluded(judge: Verdicts, left: float = FLOOR, **options: object) -> Explanation:
    """A conclusion about Coulomb friction that is beyond doubt but for ``options``."""
    baseline, final = made_up((), 0.010), made_up(("coulomb_friction",), left)
    simpler = made_up(("stribeck_friction",), left)  # a form of it is no rival
    rivals = {"coulomb_friction": [final, simpler, made_up(("backlash",), 0.004)]}
    return judge.conclude(baseline, final, rivals, [], "", **options)  # type: ignore[arg-type]


def test_two_searches_that_disagree_by_more_than_the_gain_give_no_name(judge: Verdicts) -> None:
    assert [a.named for a in concluded(judge).accepted] == [True]
    left = 1.5 * FLOOR
    # Its gain is what the next best leaves: 4 - 1.5 mrad.
    near = concluded(judge, left, again=made_up(("coulomb_friction",), 0.0035))
    assert near.verdict == "effects" and near.accepted[0].named
    far = concluded(judge, left, again=made_up(("coulomb_friction",), 0.0045))
    assert far.verdict == "unknown" and not far.accepted[0].named
    assert "two searches" in far.reason and "3.00 mrad" in far.reason


def test_a_worse_optimum_says_nothing_against_a_model_at_the_noise_floor(judge: Verdicts) -> None:
    worse = concluded(judge, FLOOR, again=made_up(("coulomb_friction",), 0.0095))
    assert worse.verdict == "effects" and worse.accepted[0].named


def test_what_has_structure_is_not_explained(judge: Verdicts) -> None:
    final = made_up(("coulomb_friction",), FLOOR)
    pairs = np.full(10, 400.0)

    def with_structure(share: float | np.ndarray, rms: float = 1.1 * FLOOR) -> Explanation:
        left = replace(final, sse=COUNT * rms**2, structure=np.stack([share * FLOOR**2 * pairs, pairs]))
        return concluded(judge, refined=left)

    assert with_structure(0.03).verdict == "effects", "what the right models leave"
    lacking = with_structure(0.3)
    assert lacking.verdict == "unknown" and "structure" in lacking.reason
    once = np.zeros(10)
    once[0] = 3.0  # a single motion is no rule
    assert with_structure(once).verdict == "effects"
    # Far from the floor a real machine's repeatability is not known.
    assert with_structure(8.0, rms=5.0 * FLOOR).verdict == "effects"


def test_a_motion_that_alone_shows_an_effect_does_not_unname_it(judge: Verdicts) -> None:
    unseen = np.full(10, FLOOR)
    unseen[2] = 30.0 * FLOOR
    baseline = made_up((), 0.010)

    def verdict(fitted: float) -> Verdict:
        final = made_up(("load_friction",), unseen, fitted=fitted)
        return judge.conclude(baseline, final, {"load_friction": [final]}, [], "").verdict

    assert made_up((), unseen).held_out_rmse > 0.9 * baseline.held_out_rmse
    assert verdict(FLOOR) == "effects" and verdict(2.0 * FLOOR) == "unknown"


def test_what_the_time_step_leaves_open_widens_the_interval(judge: Verdicts) -> None:
    fit = made_up((), FLOOR)
    plain = intervals(fit, FLOOR)["p0"]
    wide = intervals(replace(fit, step_error=np.full(3, 0.5)), FLOOR)["p0"]
    half = 0.5 * (plain[1] - plain[0])
    assert 0.5 * (wide[1] - wide[0]) == pytest.approx(np.hypot(half, 0.5))
    given = replace(fit, extents={"p0": (-1.0, 3.0)})
    assert intervals(given, FLOOR)["p0"] == (-1.0, 3.0)


def test_a_model_with_chance_in_it_is_judged_by_its_likelihood(judge: Verdicts) -> None:
    """A few motions hold most of the squared error; what matters is how surely all are known."""
    errors = np.full(10, 1e-3)
    errors[:2] = 6e-3
    before = made_up((), errors)
    spread = errors.copy()
    spread[0] *= 1.05  # one motion a little worse
    after = made_up(("command_jitter",), 0.9 * spread)
    assert judge.better(before, after)[0]
    assert not judge.better(before, made_up(("command_jitter",), errors.mean() * 2.0))[0]
    # A motion that is predicted badly without it, but fits, is no sign of chance.
    fits_well = replace(before, sse=COUNT * (0.9 * spread) ** 2)
    assert not judge.better(fits_well, after)[0]


def test_white_residuals_are_judged_on_all_samples(judge: Verdicts) -> None:
    """One motion that no fit without it predicts neither speaks against an effect nor for one."""
    judge.whole = 260 * FLOOR
    unseen = np.full(10, FLOOR)
    unseen[7] = 30.0 * FLOOR
    before = made_up(("acceleration_limit",), 6.0 * FLOOR, fitted=5.0 * FLOOR)
    after = made_up(("acceleration_limit", "coulomb_friction"), unseen, fitted=FLOOR)
    assert judge.better(before, after)[0] and judge.best([before, after]) is after
    assert not judge.better(before, replace(after, sse=COUNT * (1.2 * FLOOR) ** 2))[0], "away from the floor"
    white = made_up(("acceleration_limit",), unseen, fitted=1.02 * FLOOR)
    lucky = made_up(("acceleration_limit", "load_friction"), FLOOR, fitted=FLOOR)
    assert not judge.better(white, lucky)[0]


def test_beside_a_sharp_optimum_that_was_not_found_nothing_else_is_named(judge: Verdicts) -> None:
    final = made_up(("acceleration_limit", "stribeck_friction"), 9.0 * FLOOR)
    judge.without = {"acceleration_limit": 0.3, "stribeck_friction": 0.012}
    assert "acceleration_limit" in judge.beside_sharp(final, "stribeck_friction")
    assert judge.beside_sharp(final, "acceleration_limit") == ""
    assert judge.beside_sharp(made_up(final.effects, FLOOR), "stribeck_friction") == "", "found"
    judge.without["acceleration_limit"] = 0.03
    assert judge.beside_sharp(final, "stribeck_friction") == "", "not sharp"


def test_behind_chance_samples_tell_less(judge: Verdicts) -> None:
    winner, other = made_up(("dead_zone",), FLOOR), made_up(("coulomb_friction",), 1.008 * FLOOR)
    assert not judge.tied(winner, other)[0]
    veiled = replace(judge, veiled=True)
    assert veiled.tied(winner, other)[0] and not veiled.tied(winner, made_up(("backlash",), 1.2 * FLOOR))[0]
    assert judge.no_gap(winner) and not veiled.no_gap(winner), (
        "an effect of six floors leaves half of one there"
    )
    assert (
        veiled.better(made_up((), 1.1 * FLOOR), winner)[0]
        and not judge.better(made_up((), 1.1 * FLOOR), winner)[0]
    )


def test_beside_a_gap_of_hundreds_of_floors_a_small_excess_tells_nothing(judge: Verdicts) -> None:
    winner, other = (
        made_up(("stribeck_friction",), 1.02 * FLOOR),
        made_up(("coulomb_friction",), 1.09 * FLOOR),
    )
    assert not judge.tied(winner, other)[0] and judge.winner([winner, other]) is winner
    sharp = replace(judge, whole=280.0 * FLOOR)
    assert sharp.tied(winner, other)[0] and sharp.winner([winner, other]) is other
    assert not sharp.tied(winner, made_up(("backlash",), 1.5 * FLOOR))[0]
