"""Pages hold their figures and reach for nothing outside themselves."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from fake_env import FakeObject
from test_evaluate_rollout import CUBE, result_of

from vd.evaluate.plots import MAX_OBJECTS_DRAWN, ecdf_figure, violin_figure
from vd.evaluate.report import terminal_table, warning_lines, write_report
from vd.evaluate.result import EvalResult

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
def result():
    return result_of(
        [FakeObject("a"), FakeObject("b<i>", CUBE), FakeObject("c")], episodes=12, fall_at={0: 1}
    )


def test_objects_with_warnings_are_listed(tmp_path, result):
    doubtful = replace(result, warnings={"b<i>": "open: a sheet"})
    doubtful.write(tmp_path / "eval.json")
    write_report(EvalResult.read(tmp_path / "eval.json"), tmp_path / "report.html")
    text, _ = read_page(tmp_path / "report.html")
    assert "Objects with warnings" in text and "b&lt;i&gt;" in text and "open: a sheet" in text
    assert warning_lines(doubtful.warnings) == ["warning b<i>: open: a sheet"]
    write_report(result, tmp_path / "report.html")
    assert "with warnings" not in read_page(tmp_path / "report.html")[0]


def test_report_is_one_offline_file_with_three_figures(tmp_path, result):
    write_report(result, tmp_path / "report.html")
    text, references = read_page(tmp_path / "report.html")
    assert references.tags.count("img") == 3
    assert not {"script", "link", "iframe"} & set(references.tags)
    assert all(address.startswith("data:image/png;base64,") for address in references.addresses)
    for address in references.addresses:
        assert base64.b64decode(address.split(",")[1]).startswith(PNG)
    assert not re.search(r"(https?:)?//[a-z]", re.sub(r"base64,[^\"]*", "", text))
    assert "@import" not in text and "url(" not in text


def test_report_prints_rates_with_their_intervals_and_escapes_names(tmp_path, result):
    write_report(result, tmp_path / "report.html")
    text, _ = read_page(tmp_path / "report.html")
    drop = result.overall.drop_rate
    interval = f"({100 * drop.low:.1f} to {100 * drop.high:.1f})"
    assert f"{100 * drop.value:.1f}\N{NO-BREAK SPACE}% <small>{interval}</small>" in text
    assert "b&lt;i&gt;" in text and "<i>" not in text
    assert f"chance {100 * result.overall.chance['0.4']:.2f}" in text
    assert "over the episodes of each object" in text


def test_report_says_which_task_it_was(tmp_path, result):
    def text_of(**changes):
        changed = replace(result, protocol=replace(result.protocol, **changes))
        write_report(changed, tmp_path / "task.html")
        return read_page(tmp_path / "task.html")[0]

    dropped = text_of()
    assert "dropped into the hand" in dropped and "at rest" not in dropped
    resting = text_of(at_rest=True, max_goal_angle_rad=1.0)
    assert "at rest on the table" in resting and "within 1 rad of the start" in resting
    turned = text_of(at_rest=True, max_goal_angle_rad=1.0, goals_about_vertical=True)
    assert "turned about the vertical by at most 1 rad" in turned


def test_ecdf_ends_at_one_minus_the_drop_rate(result):
    axes = ecdf_figure(result).axes[0]
    pooled = next(line for line in axes.lines if line.get_label() == "all episodes")
    assert pooled.get_ydata()[-1] == pytest.approx(1 - 1 / 36)
    assert np.all(np.diff(pooled.get_ydata()) >= 0)


def test_many_objects_are_thinned_to_a_readable_number():
    many = result_of([FakeObject(f"o{i}") for i in range(MAX_OBJECTS_DRAWN + 12)], episodes=3)
    assert len(violin_figure(many).axes[0].get_yticks()) == MAX_OBJECTS_DRAWN
    assert many.overall.unit == "object"


def test_terminal_table_is_aligned(result):
    lines = terminal_table(result).splitlines()
    assert len({len(line) for line in lines}) == 1
    assert len(lines) == 1 + 1 + 3


def test_pages_print_no_absolute_paths(tmp_path, result):
    where = dict(
        policy="/home/me/runs/a/policy.pt", objects="/data/meshes/mugs, cube", hand="/opt/my/hand.usda"
    )
    write_report(
        replace(result, protocol=replace(result.protocol, **where)), tmp_path / "r.html", pictures=PNG
    )
    text, references = read_page(tmp_path / "r.html")
    assert not any(root in text for root in ("/home", "/data", "/opt"))
    assert "a/policy.pt" in text and "meshes/mugs, cube" in text and "my/hand.usda" in text
    assert references.tags.count("img") == 4, "the objects too"
