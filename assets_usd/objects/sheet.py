"""Contact sheets: every object of a set, alone or beside its convex parts, drawn without a display."""

import colorsys
import io
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vd.assets_usd.objects.geometry import triangle_normals
from vd.assets_usd.objects.model import ObjectModel
from vd.files import atomic_path

MESH_COLOUR = (0.62, 0.68, 0.76)
WARNING_COLOUR = "#be5014"

VIEW_AZIMUTH, VIEW_ELEVATION = np.radians(-52.0), np.radians(24.0)
"""Direction of the camera from the object, seen from the front right and a little above."""

LIGHT = np.array([-0.45, 0.65, 0.62]) / np.linalg.norm([-0.45, 0.65, 0.62])
"""Direction of the light in the camera frame: x right, y up, z to the camera."""

AMBIENT = 0.4

TILE_IN, CAPTION_IN = 1.7, 0.55
"""Side of a picture, and height of what is written below it [inch]; 100 pixels each."""


def _camera_axes() -> np.ndarray:
    """Rows: right, up and towards the camera, in the object frame, [3, 3]."""
    azimuth, up = VIEW_AZIMUTH, VIEW_ELEVATION
    towards = np.array([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)])
    right = np.cross([0.0, 0.0, 1.0], towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def _draw(axes: Any, parts: Sequence[tuple[np.ndarray, np.ndarray]], colours: Sequence[Any]) -> None:
    """Draw meshes, far triangles first, so that they fill the axes."""
    from matplotlib.collections import PolyCollection

    camera = _camera_axes()
    seen = [np.asarray(vertices, dtype=float) @ camera.T for vertices, _ in parts]
    corners = np.concatenate([points[faces] for points, (_, faces) in zip(seen, parts, strict=True)])
    colour = np.repeat(np.array(colours), [len(faces) for _, faces in parts], axis=0)
    light = AMBIENT + (1.0 - AMBIENT) * np.maximum(triangle_normals(corners) @ LIGHT, 0.0)
    order = np.argsort(corners[:, :, 2].mean(axis=1))
    shaded = (colour * light[:, None])[order]
    axes.add_collection(
        PolyCollection(list(corners[order, :, :2]), facecolors=shaded, edgecolors=shaded, linewidths=0.3)
    )
    low, high = corners[:, :, :2].min(axis=(0, 1)), corners[:, :, :2].max(axis=(0, 1))
    middle, half = (low + high) / 2, 0.54 * (high - low).max()
    axes.set(xlim=middle[0] + np.array([-half, half]), ylim=middle[1] + np.array([-half, half]))


def _sheet(models: Sequence[ObjectModel], columns: int, *, parts: bool, title: str = "") -> Any:
    """A figure with each object, its name, and with its parts what is to be said of them."""
    from matplotlib.figure import Figure

    wide = 2 if parts else 1
    rows = -(-len(models) // columns)
    caption = CAPTION_IN if parts else CAPTION_IN / 2
    size = (columns * wide * TILE_IN, rows * (TILE_IN + caption) + (0.5 if title else 0.0))
    figure = Figure(size, dpi=100)
    for i, model in enumerate(models):
        left, top = (i % columns) * wide * TILE_IN, (rows - i // columns) * (TILE_IN + caption)
        hulls = [(hull.vertices, hull.faces) for hull in model.hulls]
        hues = [colorsys.hsv_to_rgb((0.58 + k * 0.381966) % 1.0, 0.52, 0.97) for k in range(len(hulls))]
        meshes = [([(model.vertices, model.faces)], [MESH_COLOUR]), (hulls, hues)]
        for k, (drawn, colours) in enumerate(meshes[:wide]):
            place = (left + k * TILE_IN, top - TILE_IN, TILE_IN, TILE_IN)
            axes = figure.add_axes(tuple(np.divide(place, (*size, *size))))
            axes.set_axis_off()
            _draw(axes, drawn, colours)
        lines = [model.name]
        if parts:
            lines.append(f"{model.longest_side * 1e3:.0f} mm, parts: {len(hulls)}, ±{model.volume_error:.1%}")
            lines += ["; ".join(model.warnings)[:50]] if model.warnings else []
        at = ((left + 0.05) / size[0], (top - TILE_IN) / size[1])
        colour = WARNING_COLOUR if parts and model.warnings else "black"
        figure.text(*at, "\n".join(lines), fontsize=7, va="top", color=colour)
    if title:
        figure.text(0.01, 1.0 - 0.1 / size[1], title, fontsize=11, va="top")
    return figure


def contact_sheet(models: Sequence[ObjectModel], path: Path, title: str) -> Path:
    """Write a picture with every object: mesh, parts, name, longest side, parts, volume error, warnings.

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
    with atomic_path(Path(path)) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of characters that its font lacks
        _sheet(models, columns, parts=True, title=title).savefig(temporary)
    return Path(path)


def pictures(models: Sequence[ObjectModel], *, columns: int = 10, most: int = 40) -> bytes:
    """PNG with the mesh of every object and its name; of more than ``most`` the first ones.

    Args:
        models: Objects.
        columns: Pictures in a row.
        most: Objects that are drawn.
    """
    shown = models[:most]
    buffer = io.BytesIO()
    _sheet(shown, min(columns, len(shown)), parts=False).savefig(buffer, format="png", dpi=60)
    return buffer.getvalue()
