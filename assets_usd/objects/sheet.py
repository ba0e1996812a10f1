"""Contact sheets: every object of a set beside its convex parts, drawn without a display."""

import colorsys
import textwrap
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from vd.assets_usd.objects.model import ObjectModel
from vd.command.files import atomic_path

MESH_COLOUR = (0.62, 0.68, 0.76)
WARNING_COLOUR = "#be5014"

VIEW = {"elev": 24.0, "azim": -52.0}
"""Where the camera is [degrees]: at the front right and a little above."""

ZOOM = 1.6
"""Of matplotlib's boxes, so that a ball around the object fills its axes."""

TILE_IN = 1.7
MARGIN_IN = 0.1
"""Side of a picture, and what is left free about texts [inch]; 100 pixels each."""

CAPTION_POINTS = 7
TITLE_POINTS = 11
"""Sizes of the font."""

LETTER = 0.6
LINE = 1.25
"""Width of a usual letter and height of a line, as shares of the font's size."""


def _draw(axes: Any, corners: np.ndarray, colours: Any) -> None:
    """Draw triangles [T, 3, 3] so that they fill the axes."""
    surface = Poly3DCollection(
        corners, facecolors=colours, edgecolors=colours, linewidths=0.3, shade=True
    )
    axes.add_collection3d(surface)
    middle = (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1))) / 2
    look_at(axes, middle, np.linalg.norm(corners - middle, axis=2).max(), ZOOM)
    axes.view_init(**VIEW)


def look_at(axes: Any, middle: np.ndarray, radius: float, zoom: float) -> None:
    """Show what is within a radius about a point [3], without perspective."""
    limits = np.stack([middle - radius, middle + radius], axis=1)
    axes.set(xlim=limits[0], ylim=limits[1], zlim=limits[2], proj_type="ortho")
    axes.set_box_aspect((1, 1, 1), zoom=zoom)
    axes.set_axis_off()


def part_colour(number: int, saturation: float, value: float) -> tuple[float, float, float]:
    """A colour for each part that differs from those of the parts before."""
    return colorsys.hsv_to_rgb((0.58 + number * 0.381966) % 1.0, saturation, value)


def _lines(text: str, points: float, width_in: float) -> list[str]:
    """A text in lines that fit into a width."""
    return textwrap.wrap(text, int(72.0 * (width_in - 2.0 * MARGIN_IN) / (LETTER * points)))


def _height_in(lines: int, points: float) -> float:
    """Height of lines of text and of a margin below them."""
    return lines * LINE * points / 72.0 + MARGIN_IN


def _caption(model: ObjectModel) -> list[str]:
    """Lines below an object: name, size, parts, error, warnings."""
    facts = (
        f"{model.longest_side * 1e3:.0f} mm, parts: {len(model.hulls)}, ±{model.volume_error:.1%}"
    )
    lines: list[str] = []
    for text in (model.name, facts, *model.warnings):
        lines += _lines(text, CAPTION_POINTS, 2 * TILE_IN)
    return lines


def save_figure(figure: Any, path: Path) -> Path:
    """Write a figure, atomically; the suffix says which format."""
    with atomic_path(Path(path)) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of characters that its font lacks
        figure.savefig(temporary)
    return Path(path)


def contact_sheet(models: Sequence[ObjectModel], path: Path, title: str) -> Path:
    """Write a picture with every object.

    Mesh, parts, name, longest side, parts, volume error, warnings.

    Args:
        models: Objects.
        path: File to write; its suffix says which format.
        title: Headline.

    Returns:
        The path.
    """
    columns = max(1, round(np.sqrt(len(models) / 2)))
    rows = -(-len(models) // columns)
    width = columns * 2 * TILE_IN
    errors = [model.volume_error for model in models]
    summary = f"volume error {np.median(errors):.1%}, worst {max(errors):.1%}"
    head = _lines(f"{title}, objects: {len(models)}", TITLE_POINTS, width)
    head += _lines(summary, TITLE_POINTS, width)
    captions = list(map(_caption, models))
    caption_in = _height_in(max(map(len, captions)), CAPTION_POINTS)
    head_in = _height_in(len(head), TITLE_POINTS) + MARGIN_IN
    height = rows * (TILE_IN + caption_in) + head_in
    figure = Figure((width, height), dpi=100)
    side = TILE_IN / width
    tall = TILE_IN / height
    for i, model in enumerate(models):
        row, column = divmod(i, columns)
        left = 2 * column * side
        bottom = 1.0 - (head_in + row * (TILE_IN + caption_in)) / height - tall
        drawing = figure.add_axes((left, bottom, side, tall), projection="3d")
        _draw(drawing, model.vertices[model.faces], [MESH_COLOUR])
        corners: list[np.ndarray] = []
        hues: list[Any] = []
        for number, hull in enumerate(model.hulls):
            corners.extend(hull.vertices[hull.faces])
            hues += [part_colour(number, 0.52, 0.97)] * len(hull.faces)
        drawing = figure.add_axes((left + side, bottom, side, tall), projection="3d")
        _draw(drawing, np.stack(corners), hues)
        colour = WARNING_COLOUR if model.warnings else "black"
        left += MARGIN_IN / width
        caption = "\n".join(captions[i])
        figure.text(left, bottom, caption, fontsize=CAPTION_POINTS, va="top", color=colour)
    corner = (MARGIN_IN / width, 1.0 - MARGIN_IN / height)
    figure.text(*corner, "\n".join(head), fontsize=TITLE_POINTS, va="top")
    return save_figure(figure, path)
