"""What nothing else explains can be chance: when it is named, and the search for what there is beside it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_gap_judge import FLOOR, made_up
from test_gap_select import searching

from vd.gap import chance
from vd.gap.chance import DROP, SIGMA, with_random
from vd.gap.coordinates import Coordinate
from vd.gap.explanation import Accepted, Explanation, Trial
from vd.gap.joint_fit import JointFit
from vd.gap.judge import Judge
from vd.gap.select import Selection
from vd.gap.statistics import resamples
from vd.gap.veil import Veil


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
