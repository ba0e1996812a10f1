"""ArUco markers: printed, found in images, and drawn into images as a camera would see them.

A marker's own frame has x right and y up on the print, z out of it, its origin in the middle. Pixels are
those of :class:`vd.assets_usd.hand_data.Intrinsics`: the first one's centre is at (0.5, 0.5), not at 0 as
OpenCV has it.
"""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from vd.assets_usd.hand_data import Intrinsics
from vd.deploy.camera.camera import CameraError
from vd.deploy.camera.hand_eye import marker_corners
from vd.files import atomic_path

DICTIONARY = "DICT_4X4_50"
"""Few and large cells, since markers on fingertips are small in the image."""
CELLS = 6
"""Cells on a side of such a marker, its black border included."""
MARGIN_CELLS = 1
"""White border that detection needs around the black one."""
PRINT_DPI = 600
CELL_PX = 32
"""Side of a cell in the picture of a marker."""
SUPERSAMPLING = 4
"""Rays a side of a pixel, of drawn images."""
WHITE = 230
"""Brightness of a drawn marker's white, of 255."""


def opencv() -> ModuleType:
    """OpenCV.

    Raises:
        CameraError: It is not installed.
    """
    try:
        import cv2
    except ImportError as error:
        raise CameraError(f"OpenCV cannot be imported ({error}); pip install -e '.[hardware]'") from error
    return cv2


def find_markers(image: np.ndarray) -> dict[int, np.ndarray]:
    """Corners of each marker [px], [4, 2], by its number: from the print's top left on, clockwise.

    Args:
        image: Brightness, uint8 [H, W].

    Raises:
        CameraError: OpenCV is not installed.
    """
    cv = opencv()
    parameters = cv.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv.aruco.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementWinSize = 3
    parameters.minMarkerPerimeterRate = 0.02
    detector = cv.aruco.ArucoDetector(_dictionary(cv), parameters)
    corners, numbers, _ = detector.detectMarkers(np.ascontiguousarray(image))
    rows = [] if numbers is None else zip(numbers.ravel(), corners, strict=True)
    return {int(number): found.reshape(4, 2).astype(float) + 0.5 for number, found in rows}


def save_marker(path: Path, number: int, side_m: float) -> None:
    """Write a marker with its white border as a PNG to print at its true size (600 dots per inch).

    Args:
        path: The picture.
        number: Number of the marker, 0 to 49.
        side_m: Side of its black square [m].

    Raises:
        CameraError: OpenCV is not installed.
    """
    from PIL import Image

    inches = side_m * (CELLS + 2 * MARGIN_CELLS) / CELLS / 0.0254
    size = round(inches * PRINT_DPI)
    image = Image.fromarray(_picture(number)).resize((size, size), Image.Resampling.NEAREST)
    with atomic_path(path) as temporary:
        image.save(temporary, dpi=(PRINT_DPI, PRINT_DPI))


def draw(image: np.ndarray, number: int, pose: np.ndarray, lens: Intrinsics, side_m: float) -> np.ndarray:
    """An image with a marker in it, each pixel the mean of rays through it.

    Args:
        image: Brightness of what is behind, uint8 [H, W].
        number: Number of the marker.
        pose: Pose of the marker in the camera [7].
        lens: Of the camera.
        side_m: Side of its black square [m].
    """
    cv = opencv()
    rim = marker_corners(pose[None], lens, side_m * (CELLS + 2 * MARGIN_CELLS) / CELLS)[0]
    first, second = rim[1] - rim[0], rim[3] - rim[0]
    if not np.isfinite(rim).all() or first[0] * second[1] <= first[1] * second[0]:  # behind, or its back
        return image
    low = np.clip(np.floor(rim.min(axis=0)).astype(int), 0, (lens.width, lens.height))
    high = np.clip(np.ceil(rim.max(axis=0)).astype(int), 0, (lens.width, lens.height))
    width, height = (int(side) for side in (high - low))
    if width < 1 or height < 1:
        return image
    n, picture = SUPERSAMPLING, np.minimum(_picture(number), WHITE)
    side = len(picture)
    source = np.array([[0, 0], [side, 0], [side, side], [0, side]], dtype=np.float32) - 0.5
    warp = cv.getPerspectiveTransform(source, (n * (rim - low) - 0.5).astype(np.float32))
    size = (n * width, n * height)
    ink = cv.warpPerspective(picture, warp, size, flags=cv.INTER_NEAREST)
    inside = cv.warpPerspective(np.ones_like(picture), warp, size, flags=cv.INTER_NEAREST) > 0
    behind = image[low[1] : high[1], low[0] : high[0]].repeat(n, axis=0).repeat(n, axis=1)
    seen = np.where(inside, ink, behind).reshape(height, n, width, n).mean(axis=(1, 3))
    result = image.copy()
    result[low[1] : high[1], low[0] : high[0]] = np.rint(seen).astype(np.uint8)
    return result


def _picture(number: int) -> np.ndarray:
    """A marker with its white border, brightness uint8 [S, S]."""
    cv = opencv()
    marker = cv.aruco.generateImageMarker(_dictionary(cv), number, CELLS)
    cells = np.pad(np.asarray(marker, dtype=np.uint8), MARGIN_CELLS, constant_values=255)
    return np.kron(cells, np.ones((CELL_PX, CELL_PX), dtype=np.uint8))


def _dictionary(cv: ModuleType) -> Any:
    return cv.aruco.getPredefinedDictionary(getattr(cv.aruco, DICTIONARY))
