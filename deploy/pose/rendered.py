"""Images of a cube of tags as a camera would take them: each visible face is a homography."""

import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import Intrinsics
from vd.deploy.camera.markers import opencv, picture_of
from vd.deploy.pose.tags import CELLS, DICTIONARY, FACES, MARGIN_CELLS, face_corners

FINE = 2
"""Pixels a side that are drawn for one, and averaged."""
BACKGROUND, HAND = 90, 50
"""Brightness of what lies behind, and of the hand."""
DOT_M = 0.003
"""Radius of a sample of the hand's surface: half the distance to the next one, about."""


def render_cube(
    pose: np.ndarray, lens: Intrinsics, size_m: float, before: np.ndarray | None = None
) -> np.ndarray:
    """A cube of tags before an even background.

    Args:
        pose: The cube in the camera's optical frame [7].
        lens: The lens.
        size_m: Side of the cube [m].
        before: Points of a surface that may hide it, in the optical frame [m] [K, 3].

    Returns:
        Brightness, float [H, W].
    """
    cv = opencv()
    turn = Rotation.from_quat(pose[3:])
    image = np.full((FINE * lens.height, FINE * lens.width), BACKGROUND, dtype=np.uint8)
    size = (image.shape[1], image.shape[0])
    for number, corners in enumerate(face_corners(size_m, size_m)):
        there = turn.apply(corners) + pose[:3]
        normal = turn.apply(FACES[number][0])
        if there[:, 2].min() <= 0.0 or normal @ there[0] >= 0.0:
            continue  # behind the camera, or its back
        face = picture_of(number, DICTIONARY, CELLS, MARGIN_CELLS)
        side = face.shape[0]
        # Centres of pixels are at whole numbers in OpenCV.
        square = np.array([[0, 0], [side, 0], [side, side], [0, side]]) - 0.5
        pixels = FINE * _pixels(there, lens) - 0.5
        warp = cv.getPerspectiveTransform(square.astype(np.float32), pixels.astype(np.float32))
        drawn = cv.warpPerspective(face, warp, size, flags=cv.INTER_AREA)
        inside = cv.warpPerspective(np.full_like(face, 255), warp, size) > 127
        image[inside] = drawn[inside]
    if before is not None:
        image[_hidden(before, pose, lens, size_m)] = HAND
    fine = image.reshape(lens.height, FINE, lens.width, FINE)
    return np.asarray(fine.mean(axis=(1, 3)))


def _pixels(points: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """Where points of the optical frame [K, 3] are in the image [px] [K, 2]."""
    scale = np.array([lens.fx, lens.fy])
    return points[:, :2] / points[:, 2:] * scale + np.array([lens.cx, lens.cy])


def _hidden(points: np.ndarray, pose: np.ndarray, lens: Intrinsics, size_m: float) -> np.ndarray:
    """Fine pixels that show a surface's points [K, 3], where the cube is not nearer, bool."""
    cv = opencv()
    turn = Rotation.from_quat(pose[3:]).inv()
    eye = turn.apply(-pose[:3])
    ray = turn.apply(points)
    # The ray enters the cube after it has entered all three slabs.
    with np.errstate(divide="ignore"):
        first = (-0.5 * size_m - eye) / ray
        last = (0.5 * size_m - eye) / ray
    enters = np.minimum(first, last).max(axis=1)
    leaves = np.maximum(first, last).min(axis=1)
    behind = (enters < leaves) & (enters < 1.0)
    shown = points[~behind & (points[:, 2] > 0.0)]
    mask = np.zeros((FINE * lens.height, FINE * lens.width), dtype=np.uint8)
    if not len(shown):
        return mask > 0
    columns, rows = np.floor(FINE * _pixels(shown, lens)).astype(int).T
    inside = (columns >= 0) & (columns < mask.shape[1]) & (rows >= 0) & (rows < mask.shape[0])
    mask[rows[inside], columns[inside]] = 1
    radius = round(FINE * lens.fx * DOT_M / float(np.median(shown[:, 2])))
    disc = cv.getStructuringElement(cv.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(cv.dilate(mask, disc) > 0)
