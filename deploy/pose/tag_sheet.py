"""Print a cube of tags: cut out six faces and glue them onto a cube.

Each edge says which face lies next to it. Print at 100 %, and measure the bar.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from vd.command.files import atomic_path, check_file
from vd.deploy.pose.tags import FACE_CELLS, FACES, SIZE_M, face_picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MM_PER_INCH = 25.4
PAGE_MM = {"A4": (297.0, 210.0), "A3": (420.0, 297.0)}
"""Pages, lying."""
GAP_MM, BORDER_MM, TEXT_MM = 3.0, 8.0, 22.0
"""Between faces, around them, and the height of what stands below them."""
COLUMNS, ROWS = 3, 2
BAR_MM = 100.0
"""Length of the bar that shows whether the print is true."""


@dataclass(frozen=True)
class TagsCfg:
    """Print a cube of tags (ArUco 4x4_50, four a face, 0 to 23) for --pose tags and calibrate."""

    out: Annotated[Path, tyro.conf.Positional]
    """File to write: .pdf, or .png, .svg."""
    size: float = SIZE_M
    """Side of the cube [m]."""


def tags(cfg: TagsCfg) -> int:
    """Write the sheet."""
    figure, page = make_sheet(cfg.size)
    check_file(cfg.out)
    with atomic_path(cfg.out) as temporary:
        figure.savefig(temporary, format=cfg.out.suffix.lstrip(".") or "pdf")
    print(
        f"{cfg.out}: six faces of {1e3 * cfg.size:g} mm on {page}. Print at 100 %, and measure the "
        f"bar. Glue face 4 on top of 0 to 3, 5 below: each edge names the next face. Then --pose "
        f"tags:{cfg.size:g}"
    )
    return 0


def make_sheet(size_m: float) -> "tuple[Figure, str]":
    """The page in its true size, and its name.

    Args:
        size_m: Side of the cube [m].

    Raises:
        ValueError: No page holds its faces, or no camera sees them.
    """
    from matplotlib.figure import Figure

    size = 1e3 * size_m
    width = COLUMNS * size + (COLUMNS - 1) * GAP_MM + 2 * BORDER_MM
    height = ROWS * size + (ROWS - 1) * GAP_MM + 2 * BORDER_MM + TEXT_MM
    fitting = [name for name, (w, h) in PAGE_MM.items() if width <= w and height <= h]
    if not fitting or not size >= 20.0:
        raise ValueError(f"--size {size_m:g}: give the side of the cube in metres, 0.02 to 0.12")
    page = fitting[0]
    wide, high = PAGE_MM[page]
    figure = Figure(figsize=(wide / MM_PER_INCH, high / MM_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    for number in range(len(FACES)):
        column, row = number % COLUMNS, number // COLUMNS
        left = BORDER_MM + column * (size + GAP_MM)
        top = high - BORDER_MM - row * (size + GAP_MM)
        _draw_face(axes, number, left, top - size, size)
    axes.set(xlim=(0.0, wide), ylim=(0.0, high))
    axes.plot([BORDER_MM, BORDER_MM + BAR_MM], [BORDER_MM + 4.0] * 2, color="black", linewidth=1.0)
    axes.text(BORDER_MM, BORDER_MM + 6.0, f"{BAR_MM:g} mm: print at 100 %", fontsize=8)
    return figure, page


def _draw_face(axes: "Axes", number: int, left: float, bottom: float, size: float) -> None:
    """A face with its lower left corner at a place of the page [mm]."""
    from matplotlib.patches import Rectangle

    outline = Rectangle((left, bottom), size, size, fill=False, edgecolor="0.7", linewidth=0.3)
    axes.add_patch(outline)
    extent = (left, left + size, bottom, bottom + size)
    axes.imshow(face_picture(number), cmap="gray", interpolation="none", extent=extent, zorder=-1)
    cell = size / FACE_CELLS
    middle = (left + size / 2, bottom + size / 2)
    away = size / 2 - 0.5 * cell
    for neighbour, direction, turn in neighbours(number):
        x, y = np.array(middle) + away * np.array(direction)
        label = f"{neighbour}" if direction != (0, -1) else f"{neighbour} (this is {number})"
        axes.text(x, y, label, fontsize=4, color="0.6", rotation=turn, ha="center", va="center")


def neighbours(number: int) -> list[tuple[int, tuple[int, int], float]]:
    """The faces beside a face: number, direction on the print (x right, y up), turn of the text."""
    normal, up = np.asarray(FACES[number])
    right = np.cross(up, normal)
    normals = [face[0] for face in FACES]
    sides = [
        ((0, 1), up, 0.0),
        ((1, 0), right, -90.0),
        ((0, -1), -up, 0.0),
        ((-1, 0), -right, 90.0),
    ]
    return [(normals.index(tuple(axis)), direction, turn) for direction, axis, turn in sides]
