"""A cube with an AprilTag on each face: where its tags are, and its pose from those in an image.

The object's frame has its origin in the middle of the cube and its axes along the edges. Pixels are
those of :class:`vd.assets_usd.hand_data.Intrinsics`.
"""

import threading
from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import Intrinsics
from vd.deploy.camera.camera import ImageSource, StaleCamera
from vd.deploy.camera.markers import find_markers, opencv
from vd.deploy.pose.source import StampedPose

DICTIONARY = "DICT_APRILTAG_36h11"
"""Not the one of the markers on fingertips, so that none is mistaken for another."""
CELLS = 8
"""Cells on a side of a tag, its black border included."""
MARGIN_CELLS = 1
"""White border that detection needs around the black one; the rest of a face is the tag."""
TAG_SHARE = CELLS / (CELLS + 2 * MARGIN_CELLS)
"""Side of a tag's black square over that of the cube."""
FACES = (
    ((1, 0, 0), (0, 0, 1)),
    ((0, 1, 0), (0, 0, 1)),
    ((-1, 0, 0), (0, 0, 1)),
    ((0, -1, 0), (0, 0, 1)),
    ((0, 0, 1), (-1, 0, 0)),
    ((0, 0, -1), (1, 0, 0)),
)
"""Outward normal of the face of each tag, and the direction of the tag's upper edge."""
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


def face_corners(side_m: float, cube_m: float) -> np.ndarray:
    """Corners of a square in the middle of each face, in the cube's frame [m] [6, 4, 3].

    From the top left on clockwise, as seen from outside.

    Args:
        side_m: Side of the squares.
        cube_m: Side of the cube.
    """
    faces = []
    for normal, up in np.asarray(FACES, dtype=float):
        right = np.cross(up, normal)
        middle = 0.5 * cube_m * normal
        corners = [up - right, up + right, right - up, -up - right]
        faces.append(middle + 0.5 * side_m * np.array(corners))
    return np.array(faces)


def find_tags(image: np.ndarray) -> dict[int, np.ndarray]:
    """Corners of each tag [px] [4, 2], by its number.

    Args:
        image: Brightness, uint8 [H, W].
    """
    roughly = find_markers(image, DICTIONARY)
    if not roughly:
        return {}
    corners = np.concatenate(list(roughly.values()))
    border = AROUND * np.ptp(corners, axis=0).max()
    left, top = np.maximum(corners.min(axis=0) - border, 0).astype(int)
    right, bottom = (corners.max(axis=0) + border).astype(int)
    exactly = find_markers(image[top:bottom, left:right], DICTIONARY, by_edges=True)
    return {number: found + np.array([left, top]) for number, found in exactly.items()}


def find_cube(
    corners: Mapping[int, np.ndarray],
    lens: Intrinsics,
    size_m: float,
    before: np.ndarray | None = None,
) -> tuple[np.ndarray | None, float]:
    """Pose of the cube in the camera's optical frame.

    One least squares over the corners of all tags. A single tag far away looks alike from two
    sides: then the pose is that nearer to where the cube was.

    Args:
        corners: Corners of each tag in the image [px] [4, 2], by its number.
        lens: The lens.
        size_m: Side of the cube [m].
        before: Where it was lately [7].

    Returns:
        The pose [7], None where there is none, and how well the corners fit [px].
    """
    tags = sorted(number for number in corners if 0 <= number < len(FACES))
    if not tags:
        return None, np.inf
    cv = opencv()
    points = face_corners(TAG_SHARE * size_m, size_m)[tags].reshape(-1, 3)
    pixels = np.concatenate([corners[number] for number in tags])
    if len(tags) == 1:
        guesses = _from_one(tags[0], pixels, lens, size_m)
    else:
        method = cv.SOLVEPNP_SQPNP
        _, turns, places, _ = cv.solvePnPGeneric(points, pixels, lens.matrix, None, flags=method)
        guesses = list(zip(turns, places, strict=True))
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


def _from_one(
    number: int, pixels: np.ndarray, lens: Intrinsics, size_m: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Both poses of the cube that show one tag alike: rotation vectors [3, 1] and places [3, 1].

    Args:
        number: The tag.
        pixels: Its corners [px] [4, 2].
        lens: The lens.
        size_m: Side of the cube [m].
    """
    cv = opencv()
    normal, up = np.asarray(FACES[number], dtype=float)
    face = np.stack([np.cross(up, normal), up, normal], axis=1)
    flat = face_corners(TAG_SHARE * size_m, size_m)[number] @ face
    flat[:, 2] = 0.0  # as the method has it
    method = cv.SOLVEPNP_IPPE
    _, turns, places, _ = cv.solvePnPGeneric(flat, pixels, lens.matrix, None, flags=method)
    poses = []
    for turn, place in zip(turns, places, strict=True):
        of_cube = Rotation.from_rotvec(turn.ravel()) * Rotation.from_matrix(face.T)
        middle = place.ravel() - of_cube.apply(0.5 * size_m * normal)
        poses.append((of_cube.as_rotvec()[:, None], middle[:, None]))
    return poses


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
