"""Self-contained HTML pages: text, tables, figures and videos in one file that needs no network.

Pictures and videos are embedded as base64, the style is a few lines of CSS, and there is no script, so a
page can be mailed, opened from a disk, printed, and read in a light or dark browser.
"""

import base64
import io
import re
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vd.files import write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Dots per inch of embedded figures: sharp on a high-density screen at the width of the text.
FIGURE_DPI = 160

_STYLE = """
:root{color-scheme:light dark;--ink:#1c2330;--soft:#5c6675;--line:#d8dde5;--ground:#fff;--tint:#f3f5f8;
--lead:#1f5fbf}
@media(prefers-color-scheme:dark){
:root{--ink:#e7eaf0;--soft:#9aa5b5;--line:#343c49;--ground:#12161d;--tint:#1b212b;--lead:#7fb0ff}}
*{box-sizing:border-box}
body{margin:0;background:var(--ground);color:var(--ink);
font:16px/1.55 system-ui,-apple-system,"Segoe UI",sans-serif}
main{max-width:72rem;margin:0 auto;padding:2rem 1.25rem 4rem}
h1{font-size:1.9rem;line-height:1.2;margin:0 0 .25rem}h2{font-size:1.3rem;margin:2.5rem 0 .75rem}
.lead,figcaption,.small{color:var(--soft)}p{margin:.6rem 0;max-width:46rem}
ul{margin:.6rem 0;padding-left:1.3rem;max-width:46rem}li{margin:.25rem 0}
.scroll{overflow-x:auto;margin:1rem 0}details{margin:1rem 0}summary{cursor:pointer;font-weight:600}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums;font-size:.92rem}
th,td{padding:.4rem .7rem;border-bottom:1px solid var(--line);text-align:right}
td small{display:block;color:var(--soft);white-space:nowrap}
th:first-child,td:first-child,.words{text-align:left}td.words{min-width:7rem;overflow-wrap:anywhere}
thead th{color:var(--soft);font-weight:600;border-bottom:2px solid var(--line)}
figure{margin:1.2rem 0}figure img,figure video{display:block;max-width:100%;height:auto;border-radius:.5rem}
figure img{background:#fff}figcaption{font-size:.88rem;margin-top:.4rem;max-width:46rem}
a{color:var(--lead)}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(11rem,1fr));gap:.75rem;margin:1.25rem 0}
.tile{background:var(--tint);border-radius:.6rem;padding:.8rem 1rem}
.tile b{display:block;font-size:1.55rem;line-height:1.25;color:var(--lead);font-variant-numeric:tabular-nums}
.tile span{font-size:.85rem;color:var(--soft)}
code{background:var(--tint);border-radius:.25rem;padding:.1rem .3rem;font-size:.88em;overflow-wrap:anywhere}
@media print{.tile,figure,tr{break-inside:avoid}main{max-width:none;padding:0}}
"""


class Page:
    """A page built from top to bottom; all text is escaped.

    Args:
        title: Heading and window title.
        lead: One sentence under the heading.
    """

    def __init__(self, title: str, lead: str = ""):
        self._title = title
        self._parts = [f"<h1>{escape(title)}</h1>"]
        if lead:
            self._parts.append(f'<p class="lead">{escape(lead)}</p>')

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
            + "".join(f"<td{kind}>{_cell(str(cell))}</td>" for kind, cell in zip(kinds, row, strict=True))
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
        kind = "image/png"
        if isinstance(image, Path):
            kind = "image/gif" if image.suffix.lower() == ".gif" else kind
            data = image.read_bytes()
        else:
            data = image if isinstance(image, bytes) else _png(image)
        self._add_figure(f'<img alt="{escape(caption)}" src="{_data_url(data, kind)}">', caption)

    def video(self, path: Path, caption: str) -> None:
        """Add an MP4 file; it plays muted and in a loop."""
        source = _data_url(Path(path).read_bytes(), "video/mp4")
        self._add_figure(f'<video controls autoplay loop muted playsinline src="{source}"></video>', caption)

    def _add_figure(self, content: str, caption: str) -> None:
        self._parts.append(f"<figure>{content}<figcaption>{escape(caption)}</figcaption></figure>")

    def html(self) -> str:
        """The whole document."""
        return (
            '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width,initial-scale=1">'
            f"<title>{escape(self._title)}</title><style>{_STYLE}</style></head>\n"
            f"<body><main>\n{chr(10).join(self._parts)}\n</main></body></html>\n"
        )

    def write(self, path: Path) -> None:
        """Write the page to ``path`` atomically."""
        write_text(path, self.html())


_WITH_INTERVAL = re.compile(r"(-?[\d.]+(?: ?%| [a-z]+)?) (\([^()]+ to [^()]+\))")
"""A number and its interval."""


def _cell(text: str) -> str:
    """A cell's text; an interval goes below its number, so that columns are narrow."""
    found = _WITH_INTERVAL.fullmatch(text)
    if found is None:
        return escape(text)
    value, interval = (escape(part) for part in found.groups())
    return f"{value.replace(' ', '&nbsp;')} <small>{interval}</small>"


def _png(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=FIGURE_DPI, bbox_inches="tight")
    return buffer.getvalue()


def _data_url(data: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
