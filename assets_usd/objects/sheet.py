"""Contact sheets: every object of a set beside its convex parts, drawn on the CPU without a display.

A small z-buffer rasteriser in NumPy: all fragments of all triangles at once, 2 x 2 supersampling,
two lights and an outline where the depth jumps.
"""

import colorsys
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vd.assets_usd.objects.model import ObjectModel
from vd.files import atomic_path

BACKGROUND = np.array([0.965, 0.97, 0.98])
MESH_COLOUR = np.array([0.62, 0.68, 0.76])
INK = (34, 40, 49)
FAINT = (108, 116, 128)
WARNING = (190, 80, 20)

SUPERSAMPLE = 2
"""Samples per pixel and axis."""

VIEW_AZIMUTH, VIEW_ELEVATION = np.radians(-52.0), np.radians(24.0)
"""Direction of the camera from the object, seen from the front right and a little above."""

LIGHTS = ((np.array([-0.45, 0.65, 0.62]), 0.78), (np.array([0.8, 0.1, 0.4]), 0.22))
"""Directions in the camera frame (x right, y up, z to the camera) and weights: key and fill."""

AMBIENT = 0.30

SHARP_EDGE = np.cos(np.radians(35.0))
"""Normals are smoothed over edges flatter than this."""

MAX_FLAT_FACES = 1000
"""Meshes of at most so many faces are drawn with flat facets: they are polyhedra, not sampled curves."""


@dataclass(frozen=True)
class SheetStyle:
    """Look of a contact sheet.

    Attributes:
        tile: Side of one picture, pixels (each object takes two).
        columns: Objects per row; 0 chooses for a sheet about as wide as high.
        common_scale: Draw all objects at the same scale, in place of filling each tile.
    """

    tile: int = 170
    columns: int = 0
    common_scale: bool = False


def camera_axes(azimuth: float = VIEW_AZIMUTH, elevation: float = VIEW_ELEVATION) -> np.ndarray:
    """Rows: right, up and towards the camera, in the object frame, [3, 3]."""
    towards = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    right = np.cross([0.0, 0.0, 1.0], towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def corner_normals(vertices: np.ndarray, faces: np.ndarray, *, smooth: bool) -> np.ndarray:
    """Unit normal at each corner of each triangle, [T, 3, 3]; smooth ones except over sharp edges."""
    corner = vertices[faces]
    weighted = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    face = weighted / np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-30)
    if not smooth:
        return np.repeat(face[:, None], 3, axis=1)
    mean = np.stack(
        [np.bincount(faces.ravel(), np.repeat(weighted[:, i], 3), len(vertices)) for i in range(3)], axis=1
    )
    mean = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-30)
    normals = mean[faces]
    sharp = np.einsum("tcj,tj->tc", normals, face) < SHARP_EDGE
    normals[sharp] = np.broadcast_to(face[:, None], normals.shape)[sharp]
    return normals


def render(
    vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray, size: int, half_width: float
) -> np.ndarray:
    """Draw triangles in parallel projection, centred on the middle of their bounding box.

    Args:
        vertices: [V, 3], m.
        faces: [T, 3].
        colours: Colour of each triangle, [T, 3], 0-1.
        size: Side of the picture, pixels.
        half_width: Half the side of the picture, m.

    Returns:
        [size, size, 3], 0-1.
    """
    pixels = size * SUPERSAMPLE
    axes = camera_axes()
    seen = np.asarray(vertices, dtype=np.float64) @ axes.T
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2.0
    screen = (seen - middle) * (pixels / 2.0 / half_width) * np.array([1.0, -1.0, 1.0])
    screen[:, :2] += pixels / 2.0
    normals = corner_normals(seen, faces, smooth=len(faces) > MAX_FLAT_FACES)

    corner = screen[faces]
    edge1, edge2 = corner[:, 1, :2] - corner[:, 0, :2], corner[:, 2, :2] - corner[:, 0, :2]
    area = edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0]
    low = np.clip(np.ceil(corner[:, :, :2].min(axis=1) - 0.5), 0, pixels).astype(int)
    high = np.clip(np.ceil(corner[:, :, :2].max(axis=1) - 0.5), 0, pixels).astype(int)
    span = np.where(np.abs(area)[:, None] > 1e-9, high - low, 0)
    count = np.maximum(span, 0).prod(axis=1)

    # One row per (triangle, pixel of its bounding box).
    triangle = np.repeat(np.arange(len(faces)), count)
    within = np.arange(len(triangle)) - np.repeat(np.cumsum(count) - count, count)
    x = low[triangle, 0] + within % span[triangle, 0]
    y = low[triangle, 1] + within // span[triangle, 0]
    px, py = x + 0.5 - corner[triangle, 0, 0], y + 0.5 - corner[triangle, 0, 1]
    b1 = (px * edge2[triangle, 1] - py * edge2[triangle, 0]) / area[triangle]
    b2 = (edge1[triangle, 0] * py - edge1[triangle, 1] * px) / area[triangle]
    weights = np.stack([1.0 - b1 - b2, b1, b2], axis=1)
    hit = (weights >= -1e-9).all(axis=1)
    triangle, x, y, weights = triangle[hit], x[hit], y[hit], weights[hit]
    depth = np.einsum("nc,nc->n", weights, corner[triangle, :, 2])

    pixel = y * pixels + x
    buffer = np.full(pixels * pixels, -2.0 * pixels)
    np.maximum.at(buffer, pixel, depth)
    front = np.flatnonzero(depth == buffer[pixel])

    normal = np.einsum("nc,ncj->nj", weights[front], normals[triangle[front]])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    normal *= np.where(normal[:, 2:] < 0.0, -1.0, 1.0)
    light = np.full(len(front), AMBIENT)
    for direction, weight in LIGHTS:
        light += weight * np.maximum(normal @ (direction / np.linalg.norm(direction)), 0.0)
    image = np.tile(BACKGROUND, (pixels * pixels, 1))
    image[pixel[front]] = colours[triangle[front]] * light[:, None]
    image = _outlined(image.reshape(pixels, pixels, 3), buffer.reshape(pixels, pixels))
    return np.clip(image.reshape(size, SUPERSAMPLE, size, SUPERSAMPLE, 3).mean(axis=(1, 3)), 0.0, 1.0)


def _outlined(image: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Darken pixels that lie behind a depth jump of more than 4 % of the picture."""
    step = 0.04 * len(depth)
    behind = np.zeros_like(depth, dtype=bool)
    for axis in (0, 1):
        for shift in (-1, 1):
            behind |= np.roll(depth, shift, axis) - depth > step
    return np.where(behind[:, :, None], image * 0.55, image)


def hull_colours(count: int) -> np.ndarray:
    """Well separated colours, [count, 3]."""
    return np.array([colorsys.hsv_to_rgb((0.58 + i * 0.381966) % 1.0, 0.52, 0.97) for i in range(count)])


def draw_object(
    model: ObjectModel, size: int, half_width: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Pictures of the mesh and of the convex parts, each [size, size, 3]."""
    seen = model.vertices @ camera_axes()[:2].T
    half = half_width or 0.54 * float(np.ptp(seen, axis=0).max())
    plain = np.tile(MESH_COLOUR, (len(model.faces), 1))
    offsets = np.cumsum([0] + [len(h.vertices) for h in model.hulls])
    vertices = np.concatenate([h.vertices for h in model.hulls])
    faces = np.concatenate([h.faces + o for h, o in zip(model.hulls, offsets[:-1], strict=True)])
    colours = np.repeat(hull_colours(len(model.hulls)), [len(h.faces) for h in model.hulls], axis=0)
    return (
        render(model.vertices, model.faces, plain, size, half),
        render(vertices, faces, colours, size, half),
    )


def _shortened(words: str, width: float, font: Any) -> str:
    """As many of the words as fit a width in pixels."""
    if font.getlength(words) <= width:
        return words
    while words and font.getlength(words + " ...") > width:
        words = words[:-1]
    return words.rstrip() + " ..."


def contact_sheet(
    models: Sequence[ObjectModel],
    path: Path,
    *,
    title: str = "",
    style: SheetStyle | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Path:
    """Write a PNG with every object: mesh, parts, name, longest side, parts, volume error, warnings.

    Args:
        models: Objects.
        path: PNG to write.
        title: Headline.
        style: Look; the default if None.
        progress: Called with each name, the number done and the number of all.

    Returns:
        The path.
    """
    from PIL import Image, ImageDraw, ImageFont

    style = style or SheetStyle()
    tile, pad, head = style.tile, 12, 64
    caption = 58 if any(m.warnings for m in models) else 40
    columns = style.columns or max(1, round(np.sqrt(len(models) * (tile + caption) / (2 * tile))))
    columns = min(columns, len(models))
    rows = -(-len(models) // columns)
    cell_width, cell_height = 2 * tile + pad, tile + caption + pad
    paper = tuple(int(255 * c) for c in BACKGROUND)
    width = max(columns * cell_width + pad, 560)
    sheet = Image.new("RGB", (width, rows * cell_height + head + pad), paper)
    draw = ImageDraw.Draw(sheet)
    name_font, small_font, title_font = (ImageFont.load_default(size) for size in (14, 12, 22))
    errors = [m.volume_error for m in models]
    parts = [len(m.hulls) for m in models]
    draw.text((pad, 10), title or f"{len(models)} objects", fill=INK, font=title_font)
    summary = (
        f"{len(models)} objects, {np.mean(parts):.1f} convex parts on average, "
        f"volume error: median {np.median(errors):.1%}, worst {max(errors):.1%}"
    )
    if doubtful := sum(bool(m.warnings) for m in models):
        summary += f"; {doubtful} with warnings"
    draw.text((pad, 38), summary, fill=FAINT, font=small_font)
    half = None
    if style.common_scale:
        half = max(0.54 * float(np.ptp(m.vertices @ camera_axes()[:2].T, axis=0).max()) for m in models)
    for i, model in enumerate(models):
        left = pad + (i % columns) * cell_width
        top = head + (i // columns) * cell_height
        for k, image in enumerate(draw_object(model, tile, half)):
            sheet.paste(Image.fromarray((image * 255.0 + 0.5).astype(np.uint8)), (left + k * tile, top))
        below = top + tile + 3
        draw.text((left + 6, below), model.name, fill=INK, font=name_font)
        count = len(model.hulls)
        facts = f"{model.longest_side * 1e3:.0f} mm,  {count} part{'s' if count > 1 else ''},  volume "
        draw.text((left + 6, below + 18), facts, fill=FAINT, font=small_font)
        colour = WARNING if model.warnings else FAINT
        shift = draw.textlength(facts, font=small_font)
        draw.text((left + 6 + shift, below + 18), f"±{model.volume_error:.1%}", fill=colour, font=small_font)
        words = _shortened("; ".join(model.warnings), 2 * tile - 12, small_font)
        draw.text((left + 6, below + 35), words, fill=WARNING, font=small_font)
        if progress:
            progress(model.name, i + 1, len(models))
    with atomic_path(Path(path)) as temporary:
        sheet.save(temporary)
    return Path(path)


def pictures(models: Sequence[ObjectModel], *, tile: int = 104, columns: int = 10, most: int = 40) -> bytes:
    """PNG with the mesh of every object and its name; of more than ``most`` the first ones.

    Args:
        models: Objects.
        tile: Side of a picture, pixels.
        columns: Pictures in a row.
        most: Objects that are drawn.
    """
    from PIL import Image, ImageDraw, ImageFont

    shown, caption = models[:most], 18
    columns = min(columns, len(shown))
    paper = tuple(int(255 * c) for c in BACKGROUND)
    image = Image.new("RGB", (columns * tile, -(-len(shown) // columns) * (tile + caption)), paper)
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(11)
    for i, model in enumerate(shown):
        left, top = (i % columns) * tile, (i // columns) * (tile + caption)
        half = 0.54 * float(np.ptp(model.vertices @ camera_axes()[:2].T, axis=0).max())
        plain = np.tile(MESH_COLOUR, (len(model.faces), 1))
        drawn = render(model.vertices, model.faces, plain, tile, half)
        image.paste(Image.fromarray((drawn * 255.0 + 0.5).astype(np.uint8)), (left, top))
        name = model.name
        while draw.textlength(name, font=font) > tile - 6 and len(name) > 4:
            name = name[:-2].rstrip("_") + "…" if not name.endswith("…") else name[:-2] + "…"
        draw.text((left + 3, top + tile), name, fill=INK, font=font)
    buffer = io.BytesIO()
    image.save(buffer, format="png")
    return buffer.getvalue()
