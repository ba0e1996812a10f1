"""Self-contained HTML pages, each one file, from the templates in ``vd/command/templates``.

A page extends ``base.html`` and takes its parts from ``macros.html``. Templates get plain data and
escape all text. Pictures and videos are embedded as base64, and there is no script: a page can be
mailed, opened from a disk, printed, and read in a light or dark browser.
"""

import base64
import io
import re
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from vd.command.files import write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Dots per inch of embedded figures: sharp on a high-density screen at the width of the text.
FIGURE_DPI = 160
TEMPLATES = Path(__file__).parent / "templates"

_WITH_INTERVAL = re.compile(r"(-?[\d.]+(?: ?%| [a-z]+)?) (\([^()]+ to [^()]+\))")
"""A number and its interval."""
_KINDS = {".gif": "image/gif", ".mp4": "video/mp4"}


def write_html(path: Path, template: str, **data: Any) -> None:
    """Write a page from a file of ``vd/command/templates``, atomically.

    Raises:
        jinja2.UndefinedError: The template asks for something that was not given.
    """
    write_text(path, environment().get_template(template).render(data))


@cache
def environment() -> Environment:
    """The templates, with filters ``cell`` (a table's cell) and ``embed`` (a picture, a video)."""
    templates = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters |= {"cell": _cell, "embed": _embed}
    return templates


def _cell(value: object) -> Markup:
    """A table's cell; an interval goes below its number, so that columns are narrow."""
    parts = _WITH_INTERVAL.fullmatch(str(value))
    if parts is None:
        return escape(value)
    number, interval = parts.groups()
    return Markup("{} <small>{}</small>").format(
        number.replace(" ", "\N{NO-BREAK SPACE}"), interval
    )


def _embed(image: "Figure | bytes | Path") -> str:
    """A matplotlib figure, PNG bytes, or a PNG, GIF or MP4 file as an address that holds it."""
    kind = "image/png"
    if isinstance(image, Path):
        kind = _KINDS.get(image.suffix.lower(), kind)
        data = image.read_bytes()
    elif isinstance(image, bytes):
        data = image
    else:
        buffer = io.BytesIO()
        image.savefig(buffer, format="png", dpi=FIGURE_DPI, bbox_inches="tight")
        data = buffer.getvalue()
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
