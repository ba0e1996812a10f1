"""Self-contained HTML pages from the templates in ``vd/templates``: one file that needs no network.

A page extends ``base.html`` and takes its parts from ``macros.html``. Templates get plain data and
escape all text. Pictures and videos are embedded as base64, and there is no script: a page can be
mailed, opened from a disk, printed, and read in a light or dark browser.
"""

import base64
import io
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from vd.files import write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Dots per inch of embedded figures: sharp on a high-density screen at the width of the text.
FIGURE_DPI = 160
TEMPLATES = Path(__file__).parent / "templates"

_WITH_INTERVAL = re.compile(r"(-?[\d.]+(?: ?%| [a-z]+)?) (\([^()]+ to [^()]+\))")
"""A number and its interval."""
_KINDS = {".gif": "image/gif", ".mp4": "video/mp4"}


def render(template: str, **data: Any) -> str:
    """The HTML of a template.

    Args:
        template: Name of the file in ``vd/templates``.
        data: What the template asks for.

    Raises:
        jinja2.UndefinedError: The template asks for something that was not given.
    """
    return environment().get_template(template).render(data)


def write_html(path: Path, template: str, **data: Any) -> None:
    """Write the page of :func:`render` to ``path`` atomically."""
    write_text(path, render(template, **data))


@cache
def environment() -> Environment:
    """The templates, with the filters ``cell`` (a table's cell) and ``embed`` (a picture or video)."""
    found = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters |= {"cell": _cell, "embed": _embed}
    return found


def _cell(value: object) -> Markup:
    """A table's cell; an interval goes below its number, so that columns are narrow."""
    found = _WITH_INTERVAL.fullmatch(str(value))
    if found is None:
        return escape(value)
    number, interval = found.groups()
    return Markup("{} <small>{}</small>").format(number.replace(" ", "\N{NO-BREAK SPACE}"), interval)


def _embed(image: "Figure | bytes | Path") -> str:
    """A matplotlib figure, PNG bytes, or a PNG, GIF or MP4 file as an address that holds it."""
    kind = "image/png"
    if isinstance(image, Path):
        kind, data = _KINDS.get(image.suffix.lower(), kind), image.read_bytes()
    elif isinstance(image, bytes):
        data = image
    else:
        buffer = io.BytesIO()
        image.savefig(buffer, format="png", dpi=FIGURE_DPI, bbox_inches="tight")
        data = buffer.getvalue()
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


class Page:
    """A page built from top to bottom; all text is escaped.

    Args:
        title: Heading and window title.
        lead: One sentence under the heading.
    """

    def __init__(self, title: str, lead: str = ""):
        self._title, self._lead = title, lead
        self._parts: list[str] = []

    def section(self, title: str) -> None:
        """Start a section."""
        self._parts.append(f"<h2>{escape(title)}</h2>")

    def text(self, text: str, *, small: bool = False) -> None:
        """Add a paragraph."""
        self._parts.append(f'<p class="small">{escape(text)}</p>' if small else f"<p>{escape(text)}</p>")

    def code(self, text: str) -> None:
        """Add a line of code, such as a command."""
        self._parts.append(f"<p><code>{escape(text)}</code></p>")

    def link(self, text: str, target: str) -> None:
        """Add a line that leads to another file.

        Args:
            text: What is there.
            target: Path relative to the page.
        """
        self._parts.append(f'<p><a href="{escape(target)}">{escape(text)}</a></p>')

    def tiles(self, tiles: Sequence[tuple[str, str, str]]) -> None:
        """Add headline numbers: (value, what it is, small print such as its interval) each."""
        cells = "".join(
            f'<div class="tile"><span>{escape(label)}</span><b>{escape(value)}</b>'
            f"<span>{escape(note)}</span></div>"
            for value, label, note in tiles
        )
        self._parts.append(f'<div class="tiles">{cells}</div>')

    def table(
        self,
        header: Sequence[str],
        rows: Sequence[Sequence[object]],
        *,
        words: Sequence[int] = (),
        folded: str = "",
    ) -> None:
        """Add a table. The first column is text, the others are numbers already formatted.

        Args:
            header: Names of the columns.
            rows: Cells of each row.
            words: Further columns that hold text, which is set from the left and wrapped.
            folded: Heading under which the table is folded away; empty shows it.
        """
        kinds = [' class="words"' if column in words else "" for column in range(len(header))]
        head = "".join(f"<th{kind}>{escape(name)}</th>" for kind, name in zip(kinds, header, strict=True))
        body = "".join(
            "<tr>"
            + "".join(f"<td{kind}>{_cell(cell)}</td>" for kind, cell in zip(kinds, row, strict=True))
            + "</tr>"
            for row in rows
        )
        table = (
            f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
        )
        if folded:
            table = f"<details><summary>{escape(folded)}</summary>{table}</details>"
        self._parts.append(table)

    def points(self, texts: Sequence[str]) -> None:
        """Add a list with a bullet for each text."""
        self._parts.append(f"<ul>{''.join(f'<li>{escape(text)}</li>' for text in texts)}</ul>")

    def figure(self, image: "Figure | bytes | Path", caption: str) -> None:
        """Add a picture: a matplotlib figure, PNG bytes, or the path of a PNG or GIF file."""
        self._add_figure(f'<img alt="{escape(caption)}" src="{_embed(image)}">', caption)

    def video(self, path: Path, caption: str) -> None:
        """Add an MP4 file; it plays muted and in a loop."""
        source = _embed(path)
        self._add_figure(f'<video controls autoplay loop muted playsinline src="{source}"></video>', caption)

    def _add_figure(self, content: str, caption: str) -> None:
        self._parts.append(f"<figure>{content}<figcaption>{escape(caption)}</figcaption></figure>")

    def html(self) -> str:
        """The whole document."""
        return render("parts.html", title=self._title, lead=self._lead, parts=Markup("\n".join(self._parts)))

    def write(self, path: Path) -> None:
        """Write the page to ``path`` atomically."""
        write_text(path, self.html())
