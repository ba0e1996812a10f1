"""What nothing else explains can be chance: when it is named, and the search for what there is beside it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_gap_judge import FLOOR, made_up
from test_gap_select import searching

from vd.gap import chance
from vd.gap.chance import DROP, SIGMA, behind, with_random
from vd.gap.coordinates import Coordinate, Scales
from vd.gap.explanation import Accepted, Explanation, Trial, added, by_chance
from vd.gap.joint_fit import JointFit
from vd.gap.judge import Judge
from vd.gap.result import Verdict
from vd.gap.select import Selection
from vd.gap.statistics import resamples
from vd.gap.veil import Veil

SCALES = Scales(3.0, 0.5, 2.0, 6.0, 70.0, 1e-3, 1e-3, 12.0)


@pytest.mark.parametrize(
    ("left", "found"), [(2.5, (True, True)), (2.75, (False, True)), (3.0, (False, False))]
)
def test_chance_is_judged_where_a_command_moves(left: float, found: tuple[bool, bool]) -> None:
    """A joint that rests is nearer than the floor, which says nothing against chance: it has none there."""
    moves = np.arange(10) % 2 == 0
    resting = 0.3
    before = made_up(("command_delay",), np.where(moves, 3.0, resting) * FLOOR)
    likelihood = np.exp(0.5 * (resting**2 - 1.0))  # of a width that is the floor, as of one without chance
    after = made_up(("command_jitter",), np.where(moves, left, likelihood) * FLOOR)
    judge = Judge(floor=FLOOR, weights=resamples(10, np.random.default_rng(0)))
    told = [one.better(before, after)[0] for one in (judge, replace(judge, moves=moves))]
    assert tuple(told) == found, "all motions alike, and those that can tell"


@pytest.mark.parametrize(("left", "named"), [(1.2, True), (5.0, False)])
def test_what_leaves_more_than_chance_does_is_no_chance(left: float, named: bool) -> None:
    present, random = made_up(("backlash",), 0.02), made_up(("command_jitter",), 0.01)
    selection = replace(searching([])[0], candidates=("backlash", "command_jitter"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chance, "with_random", lambda *_: (random, (), [], left * FLOOR))
        patch.setattr(chance, "bounded", lambda _, fit: fit)
        patch.setattr(Selection, "refit", lambda *_: made_up((), 0.02))
        found, _, (row,) = chance.try_random(selection, made_up((), 0.03), present)
    assert (found is random) == named and (found is present) != named
    assert named or "more than chance" in row.reason


def test_beside_chance_the_search_goes_on_until_the_spread_stays() -> None:
    baseline, asked = made_up((), 0.010), []
    spreads = iter([0.007, 0.0072, 0.5])
    veil = Veil(np.zeros(3), np.ones(3))

    def run(calls: list[tuple[str, dict[str, Any]]]) -> list[object]:
        ((name, options),) = calls
        asked.append((name, options.get("veil") is veil))
        if name == "look":
            return [((0.003, 0.1), veil)]
        if name == "fit":
            return [made_up((), 0.005)]
        random = replace(
            made_up((*options["fit"].effects, "command_jitter"), 0.005),
            coordinates=tuple(Coordinate(key, 0, False, 1.0, 0.0, 9.0) for key in (SIGMA, DROP)),
            x=np.array([next(spreads), 0.1]),
        )
        return [(random, veil)]

    selection = replace(searching([])[0], run=run, candidates=("encoder_bias", "command_jitter"))
    searched: list[Selection] = []

    def explain(inner: Selection, plain: JointFit) -> Explanation:
        searched.append(inner)
        final = made_up(("encoder_bias",), FLOOR)
        one = Accepted("encoder_bias", 1.0, {}, (), (), False)
        return Explanation(
            plain, final, "effects", "", (one,), (Trial(1, one.name, final, 0.5, (0.4, 0.6), "named"),)
        )

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Selection, "explain", explain)
        fit, beside, rows, left = with_random(selection, baseline, made_up(("backlash",), 0.02))
    assert fit.effects == ("encoder_bias", "command_jitter") and [one.name for one in beside] == [
        "encoder_bias"
    ]
    assert [(row.name, row.fit.effects) for row in rows] == [
        ("encoder_bias", ("command_jitter", "encoder_bias"))
    ]
    assert left == pytest.approx(FLOOR)
    assert [name for name, _ in asked] == ["look", *2 * ["fit", "fit_jitter"]]
    assert all(seen == (name == "fit") for name, seen in asked), "the rest is fitted through the veil"
    assert all(inner.veiled and "command_jitter" not in inner.candidates for inner in searched)


@pytest.mark.parametrize(("sigmas", "found"), [(1.0, True), (1.6, False)])
def test_chance_replaces_a_fixed_delay_where_its_spread_is_the_one_that_is_there(
    sigmas: float, found: bool
) -> None:
    """Errors that grow as chance says are chance: with a width for each motion, no model is much likelier."""
    moves, fast = np.arange(10) % 2 == 0, np.linspace(1.0, 4.0, 10)
    left = np.where(moves, fast, 0.7)
    width = np.where(moves, np.hypot(1.0, sigmas * np.sqrt(fast**2 - 1.0)), 1.0)  # of the right size, or more
    likelihood = width * np.exp(0.5 * ((left / width) ** 2 - 1.0))
    before = made_up(("command_delay",), left * FLOOR)
    after = made_up(("command_jitter",), likelihood * FLOOR)
    judge = Judge(floor=FLOOR, weights=resamples(10, np.random.default_rng(0)), moves=moves)
    assert not judge.better(before, after)[0], "as a further effect it is not earned"
    assert judge.likelier(before, after) == found


@pytest.mark.parametrize(
    ("fixed", "through", "found"),
    [(0.4, 0.9, True), (0.4, 1.4, False), (0.1, 0.9, False), (0.98, 0.9, False)],
)
def test_chance_alone_leaves_noise_where_a_fixed_delay_leaves_more(
    fixed: float, through: float, found: bool
) -> None:
    baseline, veil = made_up((), 10.0 * FLOOR), Veil(np.zeros(3), np.ones(3))

    def run(calls: list[tuple[str, dict[str, Any]]]) -> list[object]:
        ((name, options),) = calls
        if name == "look":
            return [((0.003, 0.1), veil)]
        if name == "fit_jitter":
            random = replace(
                made_up(("command_jitter",), FLOOR),
                coordinates=tuple(Coordinate(key, 0, False, 1.0, 0.0, 9.0) for key in (SIGMA, DROP)),
                x=np.array([0.003, 0.1]),
            )
            return [(random, veil)]
        return [made_up(options["effects"], through * FLOOR if "veil" in options else fixed * 10.0 * FLOOR)]

    names = ("command_delay", "command_jitter")
    selection = replace(searching([])[0], run=run, candidates=names, scales=SCALES)
    assert (chance.at_once(selection, baseline) is not None) == found
    vetoed = replace(selection, vetoes={"command_jitter": "told otherwise"})
    assert (
        chance.at_once(vetoed, baseline) is None and chance.at_once(behind(selection, veil), baseline) is None
    )


@pytest.mark.parametrize(("limited", "ends"), [(1.5, False), (2.5, True), (3.1, True)])
def test_chance_ends_no_search_where_a_limit_from_every_start_is_likelier(limited: float, ends: bool) -> None:
    """A torque-speed line beside a delay leaves 1.5 floors from the best of its starts, chance 2."""
    asked: list[tuple[str, int, int]] = []

    def run(calls: list[tuple[str, dict[str, Any]]]) -> list[object]:
        asked.extend((o["effects"][-1], len(o["starts"]), o["iterations"]) for _, o in calls)
        return [made_up(o["effects"], limited * FLOOR) for _, o in calls]

    names = ("torque_speed_limit", "torque_limit", "supply_sag", "backlash", "command_jitter")
    selection = replace(searching([])[0], run=run, candidates=names, scales=SCALES)
    selection = replace(selection, vetoes={"torque_limit": "told otherwise"})
    late, random = (
        made_up((name,), n * FLOOR) for name, n in (("command_delay", 3.0), ("command_jitter", 2.0))
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Selection, "likelier", lambda _, before, after: after.rmse < before.rmse)
        assert chance.unlimited(selection, late, random) == ends
    screened = {name: starts for name, starts, _ in asked[:2]}
    assert screened == {"torque_speed_limit": 5, "supply_sag": 4}, "every start of what may be a limit"
    assert len(asked) == (2 if limited > 3.0 else 4), "what gains nothing is not fitted to the end"


@pytest.mark.parametrize(
    ("present", "through", "found"),
    [
        (("coulomb_friction", "command_delay"), 0.9, True),
        (("coulomb_friction", "command_delay"), 1.4, False),
        (("command_filter", "coulomb_friction"), 0.9, True),
        (("backlash", "coulomb_friction"), 0.9, False),
        (("command_delay",), 0.9, False),
    ],
)
def test_chance_takes_the_place_of_what_is_late_beside_another_effect(
    present: tuple[str, ...], through: float, found: bool
) -> None:
    veil = Veil(np.zeros(3), np.ones(3))

    def run(calls: list[tuple[str, dict[str, Any]]]) -> list[object]:
        ((name, options),) = calls
        if name == "look":
            assert options["fit"].effects == ("coulomb_friction",)
            return [((0.003, 0.1), veil)]
        if name == "fit_jitter":
            random = replace(
                made_up((*options["fit"].effects, "command_jitter"), FLOOR),
                coordinates=tuple(Coordinate(key, 0, False, 1.0, 0.0, 9.0) for key in (SIGMA, DROP)),
                x=np.array([0.003, 0.1]),
            )
            return [(random, veil)]
        return [made_up(options["effects"], through * FLOOR if "veil" in options else 8.0 * FLOOR)]

    names = ("backlash", "command_delay", "command_filter", "coulomb_friction", "command_jitter")
    selection = replace(searching([])[0], run=run, candidates=names, scales=SCALES)
    told = chance.in_place(selection, made_up(present, 4.0 * FLOOR))
    assert (told is not None) == found
    if told is not None:
        assert told[0].effects == ("coulomb_friction", "command_jitter") and told[1] is veil
    assert chance.in_place(behind(selection, veil), made_up(present, 4.0 * FLOOR)) is None, "not behind it"


def test_beside_the_chance_of_another_joint_what_that_joint_lacks_is_tried_first() -> None:
    baseline, started, searched = made_up((), 0.010), [], []
    veil = Veil(np.zeros(3), np.ones(3))
    keys = ("coulomb_friction.tau_c_nm", SIGMA, DROP)
    other = replace(
        made_up(("coulomb_friction", "command_jitter"), FLOOR),
        coordinates=tuple(Coordinate(key, 0, False, 1.0, 0.0, 9.0) for key in keys),
        x=np.array([0.02, 0.003, 0.1]),
    )

    def run(calls: list[tuple[str, dict[str, Any]]]) -> list[object]:
        ((name, options),) = calls
        if name == "look":
            started.append(options["start"])
            return [(options["start"], veil)]
        return [(other, veil)] if name == "fit_jitter" else [made_up((), 0.005)]

    def explain(inner: Selection, plain: JointFit) -> Explanation:
        searched.append(inner.like)
        return Explanation(plain, made_up(("coulomb_friction",), FLOOR), "effects", "")

    selection = replace(searching([])[0], run=run, candidates=("coulomb_friction", "command_jitter"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Selection, "explain", explain)
        with_random(replace(selection, random=added(other)), baseline, baseline)
    assert started == [(0.003, 0.1)], "commands of a finger go out together"
    assert searched == [(("coulomb_friction",), {"coulomb_friction.tau_c_nm": 0.02})]


@pytest.mark.parametrize(
    ("tied", "verdict", "beside"),
    [
        ((), "effects", True),
        (("encoder_bias",), "effects", False),
        ((), "ambiguous", False),
    ],
    ids=["named", "one of a set", "ambiguous"],
)
def test_another_joint_takes_beside_chance_only_what_is_sure(
    tied: tuple[str, ...], verdict: Verdict, beside: bool
) -> None:
    keys = ("coulomb_friction.tau_c_nm", SIGMA, DROP)
    final = replace(
        made_up(("coulomb_friction", "command_jitter"), FLOOR),
        coordinates=tuple(Coordinate(key, 0, False, 1.0, 0.0, 9.0) for key in keys),
        x=np.array([0.02, 0.003, 0.1]),
    )
    accepted = (
        Accepted("command_jitter", 1.0, {}, (), (), False),
        Accepted("coulomb_friction", 1.0, {}, (), tied, False),
    )
    effects, values = by_chance(Explanation(made_up((), 0.02), final, verdict, "", accepted))
    assert {SIGMA: 0.003, DROP: 0.1}.items() <= values.items(), "commands of a finger go out together"
    assert ("coulomb_friction" in effects) == ("coulomb_friction.tau_c_nm" in values) == beside
    assert "command_jitter" in effects
    steady = replace(final, effects=("coulomb_friction",))
    assert by_chance(Explanation(steady, steady, "effects", "", accepted[1:])) == ((), {})


@pytest.mark.parametrize(("left", "found"), [(1.0, True), (1.4, False)])
def test_what_is_chance_on_one_joint_is_chance_on_another(left: float, found: bool) -> None:
    random = replace(
        made_up(("command_jitter",), 2.0 * FLOOR),
        coordinates=tuple(Coordinate(key, 0, False, 1.0, 0.0, 9.0) for key in (SIGMA, DROP)),
        x=np.array([0.003, 0.1]),
        gram=np.tile(np.eye(2), (10, 1, 1)),
        gradient=np.zeros((10, 2)),
    )
    selection = replace(searching([])[0], candidates=("backlash", "command_jitter"), random=added(random))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chance, "with_random", lambda *_: (random, (), [], left * FLOOR))
        patch.setattr(chance, "bounded", lambda _, fit: fit)
        told = chance.as_random(selection, made_up((), 4.0 * FLOOR), "")
        nobody = chance.as_random(replace(selection, random=((), {})), made_up((), 4.0 * FLOOR), "")
    assert nobody is None and (told is not None) == found
    if told is not None:
        assert told.verdict == "effects" and [one.name for one in told.accepted] == ["command_jitter"]


@pytest.mark.parametrize("sure", [True, False])
def test_what_is_late_beside_chance_is_not_taken_for_its_spread(sure: bool) -> None:
    """Where all motions are sure of a mean of its own beside chance, the spread is the one beside that."""
    judge = Judge(floor=FLOOR, weights=resamples(10, np.random.default_rng(0)))
    alone = made_up(("command_jitter",), 3.0 * FLOOR)
    errors = np.full(10, 2.5) if sure else np.where(np.arange(10) < 2, 1.0, 3.1)
    assert judge.sure(alone, made_up(("command_delay", "command_jitter"), errors * FLOOR)) == sure
