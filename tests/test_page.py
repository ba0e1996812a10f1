"""Pages are single files that hold their pictures, escape what they are given, and ask for all they show."""

from html.parser import HTMLParser

from matplotlib.figure import Figure

from vd.page import environment

PNG = b"\x89PNG\r\n\x1a\n"
PAGE = """
{% extends "base.html" %}
{% from "macros.html" import figure, object_warnings, points, table, tiles, video %}
{% block title %}{{ name }}{% endblock %}
{% block content %}
{{ tiles([("1 <m>", "far & wide", "95 %")]) }}
{{ points([name]) }}
{{ table(("a", "b"), rows, words=(1,), folded=name) }}
{{ object_warnings({name: "open"}) }}
{% call figure(image) %}The \"{{ name }}\"{% endcall %}
{% call video(clip) %}a clip{% endcall %}
{% endblock %}
"""


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


def rendered(tmp_path, **changes):
    (tmp_path / "clip.mp4").write_bytes(b"\0\0\0\x18ftypmp42")
    data = {"name": "T & <i>", "rows": [(3, "<b>")], "image": PNG, "clip": tmp_path / "clip.mp4"} | changes
    text = environment().from_string(PAGE).render(data)
    references = References()
    references.feed(text)
    assert references.stack == []
    return text, references


def test_a_page_escapes_all_it_is_given(tmp_path):
    text, references = rendered(tmp_path)
    assert not {"i", "m"} & set(references.tags)
    assert text.lstrip().startswith("<!doctype html>")
    assert "<title>T &amp; &lt;i&gt;</title>" in text and "<h1>T &amp; &lt;i&gt;</h1>" in text
    assert '<td class="words">&lt;b&gt;</td>' in text and "far &amp; wide" in text
    assert 'alt="The &#34;T &amp; &lt;i&gt;&#34;"' in text


def test_pictures_and_videos_are_embedded(tmp_path):
    (tmp_path / "loop.gif").write_bytes(b"GIF89a")
    for image, kind in ((PNG, "png"), (tmp_path / "loop.gif", "gif"), (Figure(), "png")):
        _, references = rendered(tmp_path, image=image)
        assert [a.split(";")[0] for a in references.addresses] == [f"data:image/{kind}", "data:video/mp4"]
