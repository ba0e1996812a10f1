"""A cube with ArUco tags on each face: where its tags are, and its pose from those in an image.

The object's frame has its origin in the middle of the cube and its axes along the edges. Pixels are
those of :class:`vd.assets_usd.hand_data.Intrinsics`.
"""

import threading
from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import Intrinsics
from vd.deploy.camera.camera import ImageSource, StaleCamera
from vd.deploy.camera.markers import CELLS, find_markers, marker_cells, opencv
from vd.deploy.pose.source import StampedPose

TAGS = 2
"""Tags on a side of a face: a finger before one leaves the others."""
FACE_CELLS = TAGS * (CELLS + 1) + 1
"""Cells on a side of a face: a white one, which detection needs, around each tag."""
FACES = (
    ((1, 0, 0), (0, 0, 1)),
    ((0, 1, 0), (0, 0, 1)),
    ((-1, 0, 0), (0, 0, 1)),
    ((0, -1, 0), (0, 0, 1)),
    ((0, 0, 1), (-1, 0, 0)),
    ((0, 0, -1), (1, 0, 0)),
)
"""Outward normal of each face, and the direction of its tags' upper edges."""
CELL_PX = 32
"""Side of a cell in the picture of a face."""
SIZE_M = 0.07
"""Side of a cube that hands hold [m]: that of the built-in object ``cube``."""
MOST_PX = 2.0
"""Root mean square of the corners' distances from a cube's, above which there is no cube [px]."""
ALIKE_PX = 1.0
"""Difference of that between two poses below which the image does not say which one it is [px]."""
RECENT_S = 0.5
"""Age of a last pose that tells which of two like poses it is [s]."""
AROUND = 0.2
"""Width of what is looked at around the tags that were found, as a share of their extent."""
WAIT_S = 0.2
"""Longest wait for an image [s]."""


def face_corners(size_m: float) -> np.ndarray:
    """Corners of each face in the cube's frame [m] [6, 4, 3].

    From the top left on clockwise, as seen from outside.

    Args:
        size_m: Side of the cube.
    """
    return _on_faces(np.array([[0, 0], [1, 0], [1, 1], [0, 1]]), size_m)


def tag_corners(size_m: float) -> np.ndarray:
    """Corners of each tag's black square in the cube's frame [m] [6 * TAGS * TAGS, 4, 3].

    Each as :func:`face_corners`. Tags are numbered by faces, then rows, then columns.

    Args:
        size_m: Side of the cube.
    """
    square = CELLS * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    squares = np.array([square + corner for corner in _tag_places()]) / FACE_CELLS
    return _on_faces(squares, size_m).reshape(-1, 4, 3)


def face_picture(face: int) -> np.ndarray:
    """A face as printed, brightness uint8 [S, S]."""
    cells = np.full((FACE_CELLS, FACE_CELLS), 255, dtype=np.uint8)
    for place, (left, top) in enumerate(_tag_places()):
        number = face * TAGS**2 + place
        cells[top : top + CELLS, left : left + CELLS] = marker_cells(number)
    return np.kron(cells, np.ones((CELL_PX, CELL_PX), dtype=np.uint8))


def _tag_places() -> list[tuple[int, int]]:
    """Cells left of and above each tag of a face."""
    steps = range(1, FACE_CELLS - 1, CELLS + 1)
    return [(left, top) for top in steps for left in steps]


def _on_faces(places: np.ndarray, size_m: float) -> np.ndarray:
    """Places on a print, from its top left, right and down, as shares of its side [.., 2].

    In the cube's frame [m], on each face [6, .., 3].
    """
    right_up = (places - 0.5) * [size_m, -size_m]
    faces = []
    for normal, up in np.asarray(FACES, dtype=float):
        axes = np.stack([np.cross(up, normal), up])
        faces.append(right_up @ axes + 0.5 * size_m * normal)
    return np.array(faces)


def find_tags(image: np.ndarray) -> dict[int, np.ndarray]:
    """Corners of each tag [px] [4, 2], by its number.

    Args:
        image: Brightness, uint8 [H, W].
    """
    roughly = find_markers(image)
    if not roughly:
        return {}
    corners = np.concatenate(list(roughly.values()))
    border = AROUND * np.ptp(corners, axis=0).max()
    left, top = np.maximum(corners.min(axis=0) - border, 0).astype(int)
    right, bottom = (corners.max(axis=0) + border).astype(int)
    exactly = find_markers(image[top:bottom, left:right], by_edges=True)
    return {number: found + np.array([left, top]) for number, found in exactly.items()}


def find_cube(
    corners: Mapping[int, np.ndarray],
    lens: Intrinsics,
    size_m: float,
    before: np.ndarray | None = None,
) -> tuple[np.ndarray | None, float]:
    """Pose of the cube in the camera's optical frame.

    One least squares over the corners of all tags. A single face far away looks alike from two
    sides: then the pose is that nearer to where the cube was.

    Args:
        corners: Corners of each tag in the image [px] [4, 2], by its number.
        lens: The lens.
        size_m: Side of the cube [m].
        before: Where it was lately [7].

    Returns:
        The pose [7], None where there is none, and how well the corners fit [px].
    """
    everywhere = tag_corners(size_m)
    tags = sorted(number for number in corners if 0 <= number < len(everywhere))
    if not tags:
        return None, np.inf
    cv = opencv()
    points = everywhere[tags].reshape(-1, 3)
    pixels = np.concatenate([corners[number] for number in tags])
    method = cv.SOLVEPNP_SQPNP
    _, turns, places, _ = cv.solvePnPGeneric(points, pixels, lens.matrix, None, flags=method)
    guesses = list(zip(turns, places, strict=True))
    if before is not None:
        guesses.append((Rotation.from_quat(before[3:]).as_rotvec()[:, None], before[:3, None]))
    fitting = []
    for guess in guesses:
        turn, place = cv.solvePnPRefineLM(points, pixels, lens.matrix, None, *guess)
        there, _ = cv.projectPoints(points, turn, place, lens.matrix, None)
        off_px = float(np.sqrt(np.mean(np.sum((there[:, 0] - pixels) ** 2, axis=1))))
        quaternion = Rotation.from_rotvec(turn.ravel()).as_quat()
        fitting.append((off_px, np.concatenate([place.ravel(), quaternion])))
    best_px, pose = min(fitting, key=lambda fit: fit[0])
    if best_px > MOST_PX:
        return None, best_px
    if before is not None:
        alike = [fit for off_px, fit in fitting if off_px < best_px + ALIKE_PX]
        pose = min(alike, key=lambda fit: _angle(fit, before))
    return pose, best_px


def _angle(pose: np.ndarray, other: np.ndarray) -> float:
    """Angle between two poses [7] [rad]."""
    turn = Rotation.from_quat(pose[3:]) * Rotation.from_quat(other[3:]).inv()
    return float(turn.magnitude())


class TagPoses:
    """Poses of a cube of tags in a camera's images, in its optical frame.

    A thread looks at images, which takes much of a control step, from :meth:`start` on.

    Args:
        camera: Images of brightness, uint8 [H, W].
        size_m: Side of the cube [m].
    """

    def __init__(self, camera: ImageSource, size_m: float = SIZE_M):
        self.name = "tags"
        self.trouble = ""
        self._camera = camera
        self._size_m = size_m
        self._newest: StampedPose | None = None
        self._error: Exception | None = None
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._work, name="tags", daemon=True)

    def start(self) -> "TagPoses":
        """Look at images from now on."""
        self._thread.start()
        return self

    def read(self) -> StampedPose | None:
        """The pose in the newest image that showed one; None before the first.

        Raises:
            CameraError: The camera does not serve.
        """
        if self._error is not None:
            raise self._error
        return self._newest

    def close(self) -> None:
        """Look no more, and close the camera."""
        self._end.set()
        if self._thread.is_alive():
            self._thread.join()
        self._camera.close()

    def look(self) -> None:
        """Take an image, and find the cube in it.

        Raises:
            CameraError: The camera does not serve.
        """
        try:
            frame = self._camera.read(WAIT_S)
        except StaleCamera as error:
            self.trouble = str(error)
            return
        tags = find_tags(frame.image)
        last, before = self._newest, None
        if last is not None and frame.time_s < last.time_s + RECENT_S:
            before = last.pose
        pose, off_px = find_cube(tags, self._camera.intrinsics, self._size_m, before)
        if pose is not None:
            self.trouble = ""
            self._newest = StampedPose(frame.time_s, pose)
        elif np.isinf(off_px):
            self.trouble = "no tag of the cube is seen: turn it to the camera, and give it light"
        else:
            self.trouble = (
                f"the tags fit no cube of {self._size_m:g} m ({off_px:.1f} pixels off): name its "
                f"side, tags:{self._size_m:g}, and glue its faces as vd-deploy tags prints them"
            )

    def _work(self) -> None:
        """What the thread does."""
        try:
            while not self._end.is_set():
                self.look()
        except Exception as error:
            self._error = error
