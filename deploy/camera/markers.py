"""ArUco markers: printed, found in images, and drawn into images as a camera would see them.

A marker's own frame has x right and y up on the print, z out of it, its origin in the middle. Pixels are
those of :class:`vd.assets_usd.hand_data.Intrinsics`: the first one's centre is at (0.5, 0.5), not at 0 as
OpenCV has it.
"""

from pathlib import Path
from types import ModuleType

import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import Intrinsics
from vd.deploy.camera.camera import CameraError
from vd.deploy.camera.hand_eye import project, square
from vd.files import atomic_path

DICTIONARY = "DICT_4X4_50"
"""Few and large cells, since markers on fingertips are small in the image."""
CELLS = 6
"""Cells on a side of such a marker, its black border included."""
MARGIN_CELLS = 1
"""White border that detection needs around the black one."""
PRINT_DPI = 600
SUPERSAMPLING = 4
"""Rays a side of a pixel, of drawn images."""
AMBIGUOUS = 5.0
"""Mean error in the image of the second pose over that of the first, from which it can be left out."""


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


class MarkerFinder:
    """Finds markers in images and the poses in which they can be."""

    def __init__(self, lens: Intrinsics, side_m: float):
        """Prepare.

        Args:
            lens: Of the images.
            side_m: Side of the markers' black square [m].

        Raises:
            CameraError: OpenCV is not installed.
        """
        self._cv = cv = opencv()
        self.lens, self.side_m = lens, side_m
        parameters = cv.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv.aruco.CORNER_REFINE_SUBPIX
        parameters.cornerRefinementWinSize = 3
        parameters.minMarkerPerimeterRate = 0.02
        self._detector = cv.aruco.ArucoDetector(_dictionary(cv), parameters)

    def find(self, image: np.ndarray) -> dict[int, np.ndarray]:
        """Corners of each marker [px], [4, 2], by its number: from the print's top left on, clockwise.

        Args:
            image: Brightness, uint8 [H, W].
        """
        corners, numbers, _ = self._detector.detectMarkers(np.ascontiguousarray(image))
        if numbers is None:
            return {}
        rows = zip(numbers.ravel(), corners, strict=True)
        return {int(number): square.reshape(4, 2).astype(float) + 0.5 for number, square in rows}

    def poses(self, corners: np.ndarray) -> np.ndarray:
        """Poses of a marker in the camera that fit its corners, the best first, [1 or 2, 7].

        A small square that is seen nearly straight on looks alike from two sides (Collins and Bartoli, 2014).
        """
        cv = self._cv
        matrix = self.lens.matrix
        _, turns, places, errors = cv.solvePnPGeneric(
            square(self.side_m), np.asarray(corners, dtype=float), matrix, None, flags=cv.SOLVEPNP_IPPE_SQUARE
        )
        found = [
            np.concatenate([place.ravel(), Rotation.from_rotvec(turn.ravel()).as_quat()])
            for turn, place in zip(turns, places, strict=True)
        ]
        off = np.ravel(errors)
        return np.stack([pose for pose, e in zip(found, off, strict=True) if e <= AMBIGUOUS * off[0] + 0.05])


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

    picture = np.kron(cells(number, white=MARGIN_CELLS), np.ones((64, 64), dtype=np.uint8))
    inches = side_m * (CELLS + 2 * MARGIN_CELLS) / CELLS / 0.0254
    size = round(inches * PRINT_DPI)
    image = Image.fromarray(picture).resize((size, size), Image.Resampling.NEAREST)
    with atomic_path(path) as temporary:
        image.save(temporary, dpi=(PRINT_DPI, PRINT_DPI))


def cells(number: int, *, white: int = 0) -> np.ndarray:
    """Brightness of a marker's cells, 0 or 255, uint8 [CELLS + 2 white, CELLS + 2 white], top row first."""
    cv = opencv()
    marker = cv.aruco.generateImageMarker(_dictionary(cv), number, CELLS)
    return np.pad(np.asarray(marker, dtype=np.uint8), white, constant_values=255)


def draw(
    image: np.ndarray, number: int, pose: np.ndarray, lens: Intrinsics, side_m: float, *, bright: float = 0.9
) -> np.ndarray:
    """An image with a marker in it, each pixel the mean of rays through it.

    Args:
        image: Brightness of what is behind, uint8 [H, W].
        number: Number of the marker.
        pose: Pose of the marker in the camera [7].
        lens: Of the camera.
        side_m: Side of its black square [m].
        bright: Brightness of its white, of 255.
    """
    picture = cells(number, white=MARGIN_CELLS)
    reach = side_m * (0.5 + MARGIN_CELLS / CELLS)
    turn, place = Rotation.from_quat(pose[3:]).as_matrix(), np.asarray(pose[:3])
    rim = project(square(2 * reach) @ turn.T + place, lens)
    if not np.isfinite(rim).all() or turn[:, 2] @ place >= 0.0:  # behind, or seen from its back
        return image.copy()
    low = np.clip(np.floor(rim.min(axis=0)).astype(int), 0, (lens.width, lens.height))
    high = np.clip(np.ceil(rim.max(axis=0)).astype(int), 0, (lens.width, lens.height))
    n = SUPERSAMPLING
    u = low[0] + (np.arange((high[0] - low[0]) * n) + 0.5) / n
    v = low[1] + (np.arange((high[1] - low[1]) * n) + 0.5) / n
    rays = np.stack([*np.meshgrid((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy)], axis=-1)
    rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2)
    far = (turn[:, 2] @ place) / (rays @ turn[:, 2])
    on = (rays * far[..., None] - place) @ turn[:, :2]
    column, row = ((on * [1, -1] + reach) / (2 * reach) * len(picture)).transpose(2, 0, 1)
    inside = (abs(on) < reach).all(axis=2)
    last = len(picture) - 1
    ink = picture[np.clip(row.astype(int), 0, last), np.clip(column.astype(int), 0, last)] * bright
    behind = image[low[1] : high[1], low[0] : high[0]].repeat(n, axis=0).repeat(n, axis=1)
    seen = np.where(inside, ink, behind).reshape(high[1] - low[1], n, high[0] - low[0], n).mean(axis=(1, 3))
    result = image.copy()
    result[low[1] : high[1], low[0] : high[0]] = np.rint(seen).astype(np.uint8)
    return result


def _dictionary(cv: ModuleType) -> object:
    return cv.aruco.getPredefinedDictionary(getattr(cv.aruco, DICTIONARY))
