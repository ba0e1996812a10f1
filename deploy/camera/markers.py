"""ArUco markers: printed, and found in images.

Pixels are those of :class:`vd.assets_usd.hand_data.Intrinsics`: the first one's centre is at (0.5,
0.5), not at 0 as OpenCV has it.
"""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from vd.command import interrupt
from vd.command.files import atomic_path
from vd.deploy.camera.camera import CameraError

DICTIONARY = "DICT_4X4_50"
"""Few and large cells, since markers on fingertips are small in the image."""
CELLS = 6
"""Cells on a side of such a marker, its black border included."""
MARGIN_CELLS = 1
"""White border that detection needs around the black one."""
PRINT_DPI = 600
CELL_PX = 32
"""Side of a cell in the picture of a marker."""


def opencv() -> ModuleType:
    """OpenCV.

    Raises:
        CameraError: It is not installed.
    """
    try:
        import cv2
    except ImportError as error:
        raise CameraError(
            f"OpenCV cannot be imported ({error}); {interrupt.remedy('cv2')}"
        ) from error
    return cv2


def find_markers(
    image: np.ndarray, dictionary: str = DICTIONARY, *, by_edges: bool = False
) -> dict[int, np.ndarray]:
    """Corners of each marker [px], [4, 2], by its number: from the print's top left on, clockwise.

    Args:
        image: Brightness, uint8 [H, W].
        dictionary: OpenCV's name of the markers.
        by_edges: Lay lines through the edges, whose crossings are the corners: several times as
            exact as corners alone, and twenty times as slow.

    Raises:
        CameraError: OpenCV is not installed.
    """
    cv = opencv()
    parameters = cv.aruco.DetectorParameters()
    refined_by = cv.aruco.CORNER_REFINE_APRILTAG if by_edges else cv.aruco.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementMethod = refined_by
    parameters.cornerRefinementWinSize = 3
    parameters.minMarkerPerimeterRate = 0.02
    detector = cv.aruco.ArucoDetector(_dictionary(cv, dictionary), parameters)
    corners, numbers, _ = detector.detectMarkers(np.ascontiguousarray(image))
    rows = [] if numbers is None else zip(numbers.ravel(), corners, strict=True)
    return {int(number): square.reshape(4, 2).astype(float) + 0.5 for number, square in rows}


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
    image = Image.fromarray(picture_of(number)).resize((size, size), Image.Resampling.NEAREST)
    with atomic_path(path) as temporary:
        image.save(temporary, dpi=(PRINT_DPI, PRINT_DPI))


def picture_of(
    number: int, dictionary: str = DICTIONARY, cells: int = CELLS, margin_cells: int = MARGIN_CELLS
) -> np.ndarray:
    """A marker with its white border, brightness uint8 [S, S].

    Args:
        number: Number of the marker.
        dictionary: OpenCV's name of the markers.
        cells: Cells on a side of them.
        margin_cells: Width of the white border.
    """
    marked = marker_cells(number, dictionary, cells)
    padded = np.pad(marked, margin_cells, constant_values=255)
    return np.kron(padded, np.ones((CELL_PX, CELL_PX), dtype=np.uint8))


def marker_cells(number: int, dictionary: str = DICTIONARY, cells: int = CELLS) -> np.ndarray:
    """Brightness of a marker's cells, 0 or 255, uint8 [C, C]."""
    cv = opencv()
    drawn = cv.aruco.generateImageMarker(_dictionary(cv, dictionary), number, cells)
    return np.asarray(drawn, dtype=np.uint8)


def _dictionary(cv: ModuleType, name: str) -> Any:
    return cv.aruco.getPredefinedDictionary(getattr(cv.aruco, name))
