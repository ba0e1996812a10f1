"""What a search need not try: it knows the answer, or that there is none."""

from dataclasses import replace

import numpy as np
import pytest
from test_gap_judge import COUNT, FLOOR, load_and_offset, made_up
from test_gap_select import searching

from vd.gap.candidates import FULL_ITERATIONS
from vd.gap.coordinates import Scales
from vd.gap.explanation import Trial
from vd.gap.joint_fit import JointFit


def test_what_does_nothing_is_not_fitted_to_the_end() -> None:
    """Half way one effect has removed a third of the error and another nothing; noise is far below both."""
    present, ended = made_up((), 0.010), []

    def run(calls: list) -> list:
        answers = []
        for name, call in calls:
            if name == "promise":
                answers.append(np.linspace(0.9, 0.1, len(call["starts"])))
                continue
            effect = call["effects"][-1]
            if call["iterations"] == FULL_ITERATIONS:
                ended.append(effect)
            answers.append(made_up(call["effects"], 0.007 if effect == "backlash" else 0.00995))
        return answers

    selection, _ = searching([])
    selection.run, selection.candidates = run, ("backlash", "dead_zone")
    selection.scales = Scales(1.0, 1.0, 2.0, 3.0, 10.0, 1e-3, 0.01, 6.0)
    fits = selection.fit_candidates(present)
    assert ended == ["backlash"] and set(fits) == {"backlash", "dead_zone"}
    ended.clear()
    selection.candidates = ("dead_zone",)
    selection.fit_candidates(present)
    assert ended == ["dead_zone"], "the best of a round is"


def test_what_was_tried_in_the_place_of_the_last_effect_is_not_tried_again() -> None:
    """An effect was chosen from those of a round; what stands in its place was fitted there."""
    asked: list[str] = []
    before, present = made_up(("backlash",), 0.010), made_up(("backlash", "coulomb_friction"), 0.004)
    other = made_up(("backlash", "command_delay"), 0.006)

    selection, _ = searching([])
    selection.refit = lambda fit, effects: made_up(tuple(effects), 0.010)  # type: ignore[method-assign]

    def fit_candidates(without: JointFit, **_: object) -> dict[str, JointFit]:
        asked.extend(without.effects)
        return {}

    selection.fit_candidates = fit_candidates  # type: ignore[method-assign, assignment]
    selection.added = {frozenset({"backlash"}): (before, other, present)}
    assert selection.rivals(present, "coulomb_friction") == [present, other]
    assert asked == []
    selection.rivals(present, "backlash")
    assert asked == ["coulomb_friction"], "but in the place of the one before it all are tried"
    asked.clear()
    selection.refit = lambda fit, effects: made_up(tuple(effects), 0.008)  # type: ignore[method-assign]
    selection.rivals(present, "coulomb_friction")
    assert asked == ["backlash"], "and all are tried beside a better fit than the round began with"


def searches_before_it_ends(found: JointFit, tried: str) -> int:
    """How often the others are searched from the beginning where every search finds the same fit."""
    beginnings = []

    def search(_: JointFit, start: JointFit) -> tuple:
        beginnings.append(start.effects)
        return found, {}, [Trial(1, tried, made_up((tried,), 6.0 * FLOOR), 0.2, (0.1, 0.3), "rejected")]

    class EndedError(Exception):
        pass

    def better(*_: JointFit) -> tuple[bool, str]:
        raise EndedError

    selection, _ = searching([])
    selection.run = lambda calls: [found for _ in calls]
    selection.search, selection.better = search, better  # type: ignore[method-assign, assignment]
    with pytest.raises(EndedError):
        selection.explain(made_up((), 10.0 * FLOOR))
    return len(beginnings)


@pytest.mark.parametrize(("structure", "searches"), [(0.0, 1), (0.5, 3)])
def test_a_model_that_leaves_structure_is_not_the_end(structure: float, searches: int) -> None:
    """It is within the noise floor, but one effect can stand for two there: another beginning is tried."""
    found = replace(
        made_up(("elastic_transmission",), 1.05 * FLOOR),
        structure=np.stack([structure * FLOOR**2 * COUNT, COUNT]),
    )
    assert searches_before_it_ends(found, "command_filter") == searches


@pytest.mark.parametrize(
    ("bias", "error", "searches"), [(-0.00457, 2.0, 1), (0.00457, 2.0, 3), (-0.00457, 5.0, 2)]
)
def test_a_spring_is_not_looked_for_among_all_others(bias: float, error: float, searches: int) -> None:
    """A load and an offset that cancel at rest are no answer, and no other search finds one."""
    found = load_and_offset(0.015, -1.15, bias, error * FLOOR)
    assert searches_before_it_ends(found, "coulomb_friction") == searches
