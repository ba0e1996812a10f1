"""The page of an evaluation holds its figure, reaches for nothing outside itself, and says what was asked."""

import re
from html.parser import HTMLParser

import pytest
from fake_env import FakeObject
from test_evaluate_trace import CUBE, compared, rows_of

from vd.evaluate.page import labels, terminal_text, write_page
from vd.evaluate.result import Result


class References(HTMLParser):
    """Collects every address a page refers to, and whether its tags close in order."""

    def __init__(self):
        super().__init__()
        self.addresses, self.tags, self.stack = [], [], []

    def handle_starttag(self, tag, attrs):
        """Keep the tag and its addresses."""
        self.tags.append(tag)
        self.addresses += [
            value for name, value in attrs if name in ("src", "href", "poster", "data")
        ]
        if tag not in ("meta", "img", "br", "link"):
            self.stack.append(tag)

    def handle_endtag(self, tag):
        """Close the tag that was opened last."""
        assert self.stack.pop() == tag


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
    assert not references.addresses
    assert not {"script", "link", "iframe", "i"} & set(references.tags)
    heads = re.findall(r"<thead>(.*?)</thead>", text)
    assert heads and all(head.count("<th") <= 7 for head in heads), "a table that nobody reads"
    assert not re.search(r"(https?:)?//[a-z]|@import|url\(", text)
    lost = found.rows[0].overall.outcomes["object falls"]
    interval = f"({100 * lost.low:.1f} to {100 * lost.high:.1f})"
    assert f"{100 * lost.value:.1f}\N{NO-BREAK SPACE}% <small>{interval}</small>" in text
    assert "Objects with warnings" in text and "b&lt;i&gt;" in text and "open: a sheet" in text
    assert "over the episodes of each object" in text and "over whole objects" not in text
    assert "warning b<i>: open: a sheet" in terminal_text(found)
    assert "Predicted distance" not in text
    write_page(Result(tuple(compared())), tmp_path / "camera.html")
    text, _ = read_page(tmp_path / "camera.html")
    assert (
        "Predicted distance" in text
        and "complete clouds" in text
        and "500 exact points" not in text
    )


def test_names_are_as_short_as_they_can_be():
    names = ("runs/a/stage1/policy.safetensors", "runs/a/stage2/policy.safetensors", "dclaw3")
    assert list(labels(names).values()) == ["stage1", "stage2", "dclaw3"]
    assert labels(("runs/a/policy.safetensors",)) == {"runs/a/policy.safetensors": "a"}
