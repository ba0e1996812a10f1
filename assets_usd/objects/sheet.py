"""Contact sheets: every object of a set beside its convex parts, drawn without a display."""

import colorsys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from vd.assets_usd.objects.model import ObjectModel
from vd.files import atomic_path

MESH_COLOUR = (0.62, 0.68, 0.76)
WARNING_COLOUR = "#be5014"

VIEW = {"elev": 24.0, "azim": -52.0}
"""Where the camera is [degrees]: at the front right and a little above."""

ZOOM = 1.6
"""Of matplotlib's boxes, so that a ball around the object fills its axes."""

TILE_IN, CAPTION_IN = 1.7, 0.55
"""Side of a picture, and height of what is written below it [inch]; 100 pixels each."""


def _draw(
    axes: Any, parts: Sequence[tuple[np.ndarray, np.ndarray]], colours: Sequence[Any]
) -> None:
    """Draw meshes so that they fill the axes."""
    corners = np.concatenate([vertices[faces] for vertices, faces in parts])
    colour = np.repeat(np.array(colours), [len(faces) for _, faces in parts], axis=0)
    surface = Poly3DCollection(
        corners, facecolors=colour, edgecolors=colour, linewidths=0.3, shade=True
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
    errors = [model.volume_error for model in models]
    title = f"{title}, objects: {len(models)}\nvolume error {np.median(errors):.1%}, worst {max(errors):.1%}"
    columns = max(1, round(np.sqrt(len(models) / 2)))
    rows = -(-len(models) // columns)
    size = (columns * 2 * TILE_IN, rows * (TILE_IN + CAPTION_IN) + 0.5)
    figure = Figure(size, dpi=100)
    for i, model in enumerate(models):
        left, top = (i % columns) * 2 * TILE_IN, (rows - i // columns) * (TILE_IN + CAPTION_IN)
        hulls = [(hull.vertices, hull.faces) for hull in model.hulls]
        hues = [part_colour(k, 0.52, 0.97) for k in range(len(hulls))]
        for k, (drawn, colours) in enumerate(
            [([(model.vertices, model.faces)], [MESH_COLOUR]), (hulls, hues)]
        ):
            place = np.divide((left + k * TILE_IN, top - TILE_IN, TILE_IN, TILE_IN), (*size, *size))
            _draw(figure.add_axes(tuple(place), projection="3d"), drawn, colours)
        said = [
            f"{model.longest_side * 1e3:.0f} mm, parts: {len(hulls)}, ±{model.volume_error:.1%}"
        ]
        said += ["; ".join(model.warnings)[:50]] if model.warnings else []
        at = ((left + 0.05) / size[0], (top - TILE_IN) / size[1])
        colour = WARNING_COLOUR if model.warnings else "black"
        figure.text(*at, "\n".join([model.name, *said]), fontsize=7, va="top", color=colour)
    figure.text(0.01, 1.0 - 0.1 / size[1], title, fontsize=11, va="top")
    return save_figure(figure, path)
