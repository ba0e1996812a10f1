"""The page of an evaluation holds its figure, reaches for nothing outside itself, and says what was asked."""

import re
from dataclasses import replace

import numpy as np
import pytest
from fake_env import FakeObject
from test_evaluate_trace import CUBE, compared, rows_of
from test_page import References

from vd.evaluate.page import ecdf_figure, labels, terminal_text, write_page
from vd.evaluate.result import Result


def read_page(path):
    """Text of a page on one line, as templates wrap theirs, and what it refers to."""
    references = References()
    text = re.sub(r"\s*\n\s*", " ", path.read_text())
    references.feed(text)
    assert references.stack == []
    return text, references


@pytest.fixture(scope="module")
def found():
    """One policy."""
    objects = [FakeObject("a"), FakeObject("b<i>", CUBE, ("open: a sheet",)), FakeObject("c")]
    return Result(tuple(rows_of(objects, episodes=12, fall_at={0: 1})), software={"torch": "2"})


def test_the_page_is_one_offline_file_with_rates_intervals_and_warnings(tmp_path, found):
    write_page(found, tmp_path / "eval.html")
    text, references = read_page(tmp_path / "eval.html")
    (figure,) = references.addresses
    assert figure.startswith("data:image/png;base64,")
    assert not {"script", "link", "iframe", "i"} & set(references.tags)
    heads = re.findall(r"<thead>(.*?)</thead>", text)
    assert heads and all(head.count("<th") <= 7 for head in heads), "a table that nobody reads"
    assert not re.search(r"(https?:)?//[a-z]|@import|url\(", re.sub(r"base64,[^\"]*", "", text))
    lost = found.rows[0].overall.outcomes["object falls"]
    interval = f"({100 * lost.low:.1f} to {100 * lost.high:.1f})"
    assert f"{100 * lost.value:.1f}\N{NO-BREAK SPACE}% <small>{interval}</small>" in text
    assert "Objects with warnings" in text and "b&lt;i&gt;" in text and "open: a sheet" in text
    assert "over the episodes of each object" in text and "over whole objects" not in text
    assert "warning b<i>: open: a sheet" in terminal_text(found)
    assert "Predicted distance" not in text
    write_page(Result(tuple(compared())), tmp_path / "camera.html")
    text, _ = read_page(tmp_path / "camera.html")
    assert "Predicted distance" in text and "complete clouds" in text and "500 exact points" not in text


def test_the_page_says_which_task_it_was(tmp_path, found):
    def text_of(policy="zero", **changes):
        rows = (replace(row, policy=policy, protocol=replace(row.protocol, **changes)) for row in found.rows)
        write_page(replace(found, rows=tuple(rows)), tmp_path / "task.html")
        return read_page(tmp_path / "task.html")[0]

    dropped = text_of()
    assert "dropped into the hand" in dropped and "at rest" not in dropped
    resting = text_of(at_rest=True, max_goal_angle_rad=1.0)
    assert "at rest on the table" in resting and "within 1 rad of the start" in resting
    turned = text_of(at_rest=True, max_goal_angle_rad=1.0, goals_about_vertical=True)
    assert "turned about the vertical by at most 1 rad" in turned
    assert "randomisation mixed" in text_of(randomisation="mixed")
    away = text_of(policy="/home/me/a/policy.pt", objects="/data/mugs, cube", hand="/opt/my/hand.usda")
    assert not any(root in away for root in ("/home", "/data", "/opt"))


def test_curves_end_at_one_minus_the_share_of_lost_objects(found):
    line = ecdf_figure(found, {"zero": "zero"}).axes[0].lines[0]
    assert line.get_label() == "zero" and line.get_ydata()[-1] == pytest.approx(1 - 1 / 36)
    assert np.all(np.diff(line.get_ydata()) >= 0)


def test_the_terminal_shows_every_rule_every_object_of_a_single_policy_and_every_hand(found):
    ways, beside, objects, *_ = terminal_text(found).split("\n\n")
    assert len(ways.splitlines()) == len(beside.splitlines()) == 1 + 2
    heading, *lines = objects.splitlines()
    assert heading == "zero, training, stopped by true distance"
    assert len({len(line) for line in lines}) == 1 and len(lines) == 1 + 1 + 3
    others = (
        replace(row, policy="random", protocol=replace(row.protocol, hand="other-hand")) for row in found.rows
    )
    two = terminal_text(replace(found, rows=(*found.rows, *others)))
    assert heading not in two and ", other-hand on the table" in two
    assert "random over zero" in two and "+0.0 points" in two


def test_names_are_as_short_as_they_can_be():
    names = ("runs/a/stage1/policy.pt", "runs/a/stage2/policy.pt", "dclaw3")
    assert list(labels(names).values()) == ["stage1", "stage2", "dclaw3"]
    assert labels(("runs/a/policy.pt",)) == {"runs/a/policy.pt": "a"}
