"""Images of a cube of tags as a camera would take them: each visible face is a homography."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import Intrinsics
from vd.deploy.camera.markers import opencv
from vd.deploy.pose.tags import FACES, face_corners, face_picture

FINE = 2
"""Pixels a side that are drawn for one, and averaged."""
BACKGROUND, HAND = 90, 50
"""Brightness of what lies behind, and of the hand."""
BORDER_PX = 8
"""Width of what is drawn around the cube."""
DOT_M = 0.003
"""Radius of a sample of the hand's surface: half the distance to the next one, about."""


def render_cube(
    pose: np.ndarray, lens: Intrinsics, size_m: float, before: np.ndarray | None = None
) -> np.ndarray:
    """A cube of tags before an even background; only around the cube anything is drawn.

    Args:
        pose: The cube in the camera's optical frame [7].
        lens: The lens.
        size_m: Side of the cube [m].
        before: Points of a surface that may hide it, in the optical frame [m] [K, 3].

    Returns:
        Brightness, uint8 [H, W].
    """
    turn = Rotation.from_quat(pose[3:])
    corners = turn.apply(face_corners(size_m).reshape(-1, 3)).reshape(-1, 4, 3) + pose[:3]
    image = np.full((lens.height, lens.width), BACKGROUND, dtype=np.uint8)
    if corners[..., 2].min() <= 0.0:
        return image  # behind the camera
    pixels = _pixels(corners.reshape(-1, 3), lens)
    whole = np.array([lens.width, lens.height])
    low = np.clip(np.floor(pixels.min(axis=0)) - BORDER_PX, 0, whole).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)) + BORDER_PX, low, whole).astype(int)
    if (high <= low).any():
        return image
    part = replace(
        lens,
        width=int(high[0] - low[0]) * FINE,
        height=int(high[1] - low[1]) * FINE,
        fx=lens.fx * FINE,
        fy=lens.fy * FINE,
        cx=(lens.cx - low[0]) * FINE,
        cy=(lens.cy - low[1]) * FINE,
    )
    fine = _faces(corners, turn, part)
    if before is not None:
        fine[_hidden(before, pose, part, size_m)] = HAND
    coarse = fine.reshape(high[1] - low[1], FINE, high[0] - low[0], FINE).mean(axis=(1, 3))
    image[low[1] : high[1], low[0] : high[0]] = coarse
    return image


def _faces(corners: np.ndarray, turn: Rotation, lens: Intrinsics) -> np.ndarray:
    """The faces of a cube that a camera sees, uint8 [H, W].

    Args:
        corners: Corners of each face in the optical frame [m] [6, 4, 3].
        turn: The cube's rotation.
        lens: The lens.
    """
    cv = opencv()
    image = np.full((lens.height, lens.width), BACKGROUND, dtype=np.uint8)
    size = (lens.width, lens.height)
    for number, there in enumerate(corners):
        if turn.apply(FACES[number][0]) @ there[0] >= 0.0:
            continue  # its back
        face = face_picture(number)
        side = face.shape[0]
        # Centres of pixels are at whole numbers in OpenCV.
        square = np.array([[0, 0], [side, 0], [side, side], [0, side]]) - 0.5
        pixels = _pixels(there, lens) - 0.5
        warp = cv.getPerspectiveTransform(square.astype(np.float32), pixels.astype(np.float32))
        drawn = cv.warpPerspective(face, warp, size, flags=cv.INTER_AREA)
        inside = cv.warpPerspective(np.full_like(face, 255), warp, size) > 127
        image[inside] = drawn[inside]
    return image


def _pixels(points: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """Where points of the optical frame [K, 3] are in the image [px] [K, 2]."""
    scale = np.array([lens.fx, lens.fy])
    return points[:, :2] / points[:, 2:] * scale + np.array([lens.cx, lens.cy])


def _hidden(points: np.ndarray, pose: np.ndarray, lens: Intrinsics, size_m: float) -> np.ndarray:
    """Pixels that show a surface's points [K, 3], where the cube is not nearer, bool [H, W]."""
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
    mask = np.zeros((lens.height, lens.width), dtype=np.uint8)
    if not len(shown):
        return mask > 0
    columns, rows = np.floor(_pixels(shown, lens)).astype(int).T
    inside = (columns >= 0) & (columns < mask.shape[1]) & (rows >= 0) & (rows < mask.shape[0])
    mask[rows[inside], columns[inside]] = 1
    radius = round(lens.fx * DOT_M / float(np.median(shown[:, 2])))
    disc = cv.getStructuringElement(cv.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(cv.dilate(mask, disc) > 0)
