"""Pages hold their figures and reach for nothing outside themselves."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from fake_env import FakeObject
from test_evaluate_rollout import CUBE, rows_of

from vd.evaluate.comparison import Comparison
from vd.evaluate.comparison_page import ecdf_figure, terminal_text, write_comparison
from vd.evaluate.plots import MAX_OBJECTS_DRAWN, violin_figure

PNG = b"\x89PNG\r\n\x1a\n"


class References(HTMLParser):
    """Collects every address a page refers to, and whether its tags close in order."""

    def __init__(self):
        super().__init__()
        self.addresses, self.tags, self.stack = [], [], []

    def handle_starttag(self, tag, attrs):
        """Keep the tag and its addresses."""
        self.tags.append(tag)
        self.addresses += [value for name, value in attrs if name in ("src", "href", "poster", "data")]
        if tag not in ("meta", "img", "br", "link"):
            self.stack.append(tag)

    def handle_endtag(self, tag):
        """Close the tag that was opened last."""
        assert self.stack.pop() == tag


def read_page(path):
    references = References()
    text = re.sub(r"\s*\n\s*", " ", path.read_text())  # templates wrap their lines
    references.feed(text)
    assert references.stack == []
    return text, references


@pytest.fixture(scope="module")
def found():
    """One policy."""
    objects = [FakeObject("a"), FakeObject("b<i>", CUBE, ("open: a sheet",)), FakeObject("c")]
    return Comparison(tuple(rows_of(objects, episodes=12, fall_at={0: 1})), (), software={"torch": "2"})


def page_of(found, path, **changes):
    """The page of an evaluation whose protocol is changed."""
    rows = (
        replace(row, result=replace(row.result, protocol=replace(row.result.protocol, **changes)))
        for row in found.rows
    )
    write_comparison(replace(found, rows=tuple(rows)), path, pictures=PNG)
    return read_page(path)


def test_objects_with_warnings_are_listed(tmp_path, found):
    text, _ = page_of(found, tmp_path / "eval.html")
    assert "Objects with warnings" in text and "b&lt;i&gt;" in text and "open: a sheet" in text
    assert "warning b<i>: open: a sheet" in terminal_text(found)
    without = replace(
        found, rows=tuple(replace(r, result=replace(r.result, warnings={})) for r in found.rows)
    )
    assert "with warnings" not in page_of(without, tmp_path / "eval.html")[0]


def test_the_page_is_one_offline_file_with_figures(tmp_path, found):
    text, references = page_of(found, tmp_path / "eval.html")
    assert references.tags.count("img") == 4, "outcomes, objects, all errors, those of each object"
    assert not {"script", "link", "iframe"} & set(references.tags)
    assert all(address.startswith("data:image/png;base64,") for address in references.addresses)
    for address in references.addresses:
        assert base64.b64decode(address.split(",")[1]).startswith(PNG)
    assert not re.search(r"(https?:)?//[a-z]", re.sub(r"base64,[^\"]*", "", text))
    assert "@import" not in text and "url(" not in text


def test_the_page_prints_rates_with_their_intervals_and_escapes_names(tmp_path, found):
    text, _ = page_of(found, tmp_path / "eval.html")
    drop = found.rows[0].result.overall.drop_rate
    interval = f"({100 * drop.low:.1f} to {100 * drop.high:.1f})"
    assert f"{100 * drop.value:.1f}\N{NO-BREAK SPACE}% <small>{interval}</small>" in text
    assert "b&lt;i&gt;" in text and "<i>" not in text
    assert "over the episodes of each object" in text and "over whole objects" not in text
    assert "0.4 rad in 0.34 %" in text, "by chance"
    assert "Evaluation of zero" in text and "success criteria of training" in text


def test_the_page_says_which_task_it_was(tmp_path, found):
    def text_of(**changes):
        return page_of(found, tmp_path / "task.html", **changes)[0]

    dropped = text_of()
    assert "dropped into the hand" in dropped and "at rest" not in dropped
    resting = text_of(at_rest=True, max_goal_angle_rad=1.0)
    assert "at rest on the table" in resting and "within 1 rad of the start" in resting
    turned = text_of(at_rest=True, max_goal_angle_rad=1.0, goals_about_vertical=True)
    assert "turned about the vertical by at most 1 rad" in turned
    assert "randomisation mixed" in text_of(condition="mixed", randomised=True)


def test_ecdf_ends_at_one_minus_the_drop_rate(found):
    own = ecdf_figure(found).axes[0].lines[0]
    assert own.get_label() == "zero"
    assert own.get_ydata()[-1] == pytest.approx(1 - 1 / 36)
    assert np.all(np.diff(own.get_ydata()) >= 0)


def test_many_objects_are_thinned_to_a_readable_number():
    many = rows_of([FakeObject(f"o{i}") for i in range(MAX_OBJECTS_DRAWN + 12)], episodes=3)[0].result
    assert len(violin_figure(many).axes[0].get_yticks()) == MAX_OBJECTS_DRAWN
    assert many.overall.unit == "object"


def test_the_terminal_shows_every_rule_and_every_object_of_a_single_policy(found):
    ways, objects, *_ = terminal_text(found).split("\n\n")
    assert len(ways.splitlines()) == 1 + 2
    heading, *lines = objects.splitlines()
    assert heading == "zero, objects, stopped by true distance"
    assert len({len(line) for line in lines}) == 1 and len(lines) == 1 + 1 + 3
    two = replace(found, rows=found.rows + tuple(replace(row, policy="random") for row in found.rows))
    assert "<= 0.8 rad" not in terminal_text(two)


def test_pages_print_no_absolute_paths(tmp_path, found):
    rows = tuple(replace(row, policy="/home/me/runs/a/policy.pt") for row in found.rows)
    where = dict(
        policy="/home/me/runs/a/policy.pt", objects="/data/meshes/mugs, cube", hand="/opt/my/hand.usda"
    )
    text, _ = page_of(replace(found, rows=rows), tmp_path / "r.html", **where)
    assert not any(root in text for root in ("/home", "/data", "/opt"))
    assert "a/policy.pt" in text and "meshes/mugs, cube" in text and "my/hand.usda" in text
