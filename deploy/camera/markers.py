"""ArUco markers: their cells, and where they are in images.

Pixels are those of :class:`vd.assets_usd.hand_data.Intrinsics`: the first one's centre is at (0.5,
0.5), not at 0 as OpenCV has it.
"""

from types import ModuleType
from typing import Any

import numpy as np

from vd.command import interrupt
from vd.deploy.camera.camera import CameraError

CELLS = 6
"""Cells on a side of a marker, its black border included."""


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


def find_markers(image: np.ndarray, *, by_edges: bool = False) -> dict[int, np.ndarray]:
    """Corners of each marker [px], [4, 2], by its number: from the print's top left on, clockwise.

    Args:
        image: Brightness, uint8 [H, W].
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
    detector = cv.aruco.ArucoDetector(_dictionary(cv), parameters)
    corners, numbers, _ = detector.detectMarkers(np.ascontiguousarray(image))
    rows = [] if numbers is None else zip(numbers.ravel(), corners, strict=True)
    return {int(number): square.reshape(4, 2).astype(float) + 0.5 for number, square in rows}


def marker_cells(number: int) -> np.ndarray:
    """Brightness of a marker's cells, 0 or 255, uint8 [CELLS, CELLS]."""
    cv = opencv()
    return np.asarray(cv.aruco.generateImageMarker(_dictionary(cv), number, CELLS), dtype=np.uint8)


def _dictionary(cv: ModuleType) -> Any:
    """Few and large cells, since tags are small in the image."""
    return cv.aruco.getPredefinedDictionary(cv.aruco.DICT_4X4_50)
