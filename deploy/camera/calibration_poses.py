"""Poses of a hand in which a camera sees the markers on its fingertips, chosen to tell much of the camera.

One finger moves, the others are spread out of its way. Of random poses that are free and in view, those are
taken whose fingertips are turned most from each other.
"""

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import BASE_IN_WORLD, HandModel, Intrinsics, compose, invert
from vd.deploy.camera.camera import CameraError
from vd.deploy.camera.hand_eye import marker_corners
from vd.deploy.hardware.motion import reset_pose

DRAWS = 400
"""Random poses of a finger."""
STRIDE = 5
"""Every so many-th sample of the hand's surface is looked at: 100 of a link."""
JOINT_MARGIN_RAD = 0.05
"""Distance from the ends of the joints' ranges."""
SPREAD_RAD = 0.6
"""How much further out than at the start the fingers that wait are bent, at their second joint."""
CLEAR_M = 0.012
"""Least distance between the moving finger and everything else."""
TABLE_CLEAR_M = 0.008
"""Least height over the table."""
SIGHT_M = 0.012
"""Least distance of everything from the line of sight to the marker's middle."""
SLANT_RAD = np.radians(60.0)
"""Largest angle between a marker's normal and the line of sight at which it is still read."""
BORDER_PX = 12.0
"""Distance of a marker from the border of the image."""
SEAT_M = 0.012
"""Distance of a marker from the middle of its link."""
PATH_STEPS = 6
"""Poses between two views that have to be free as well."""


def seat(hand: HandModel, finger: int, camera: np.ndarray) -> np.ndarray:
    """Pose in the tip's frame [7] of a marker that faces a camera [7] when the hand is at its start."""
    tip = hand.tip_poses(reset_pose(hand.num_fingers))[finger]
    normal = camera[:3] - tip[:3]
    normal /= np.linalg.norm(normal)
    right = Rotation.from_quat(camera[3:]).apply([1.0, 0.0, 0.0])
    right -= normal * (right @ normal)
    right /= np.linalg.norm(right)
    turn = Rotation.from_matrix(np.stack([right, np.cross(normal, right), normal], axis=1))
    return compose(invert(tip), np.concatenate([tip[:3] + SEAT_M * normal, turn.as_quat()]))


def plan(
    hand: HandModel,
    lens: Intrinsics,
    fingers: tuple[int, ...],
    count: int,
    *,
    side_m: float,
    seed: int = 0,
) -> list[np.ndarray]:
    """Poses [D] in the order in which to take them, finger by finger; between fingers all are spread.

    Args:
        hand: The hand; its camera is where the real one is thought to be.
        lens: Of the pictures.
        fingers: Fingers with markers.
        count: Views.
        side_m: Side of the markers [m].
        seed: Of the poses.

    Raises:
        CameraError: From where the camera is thought to be, a marker is hardly ever in view.
    """
    generator = np.random.default_rng(seed)
    camera = np.concatenate([hand.camera.position, hand.camera.quaternion])
    shares = [len(part) for part in np.array_split(np.arange(count), len(fingers))]
    waiting = reset_pose(hand.num_fingers)
    waiting[1::3] += SPREAD_RAD
    waiting = np.clip(waiting, hand.lower, hand.upper)
    poses: list[np.ndarray] = []
    for finger, share in zip(fingers, shares, strict=True):
        options = _visible(hand, lens, finger, camera, waiting, side_m, generator)
        if len(options) < share:
            raise CameraError(
                f"only {len(options)} of {DRAWS} poses of finger {finger} show its marker to the camera at "
                f"{np.round(camera[:3], 2)} m of the base; choose other --fingers, or mend the hand's camera"
            )
        turns = Rotation.from_quat(hand.tip_poses(options)[:, finger, 3:])
        chosen = options[_apart(turns, share)]
        # From the waiting pose, always on to the nearest one, along free ways only.
        here = waiting
        while len(chosen):
            nearest = int(np.argmin(np.abs(chosen - here).max(axis=1)))
            there, chosen = chosen[nearest], np.delete(chosen, nearest, axis=0)
            if _way_free(hand, finger, waiting, here, there):
                poses.append(there)
                here = there
        poses.append(waiting)
    return poses


def _visible(
    hand: HandModel,
    lens: Intrinsics,
    finger: int,
    camera: np.ndarray,
    waiting: np.ndarray,
    side_m: float,
    generator: np.random.Generator,
) -> np.ndarray:
    """Random poses [n, D] of one finger that are free and show its marker."""
    axes = slice(3 * finger, 3 * finger + 3)
    low, high = hand.lower[axes] + JOINT_MARGIN_RAD, hand.upper[axes] - JOINT_MARGIN_RAD
    poses = np.tile(waiting, (DRAWS, 1))
    poses[:, axes] = generator.uniform(low, high, (DRAWS, 3))
    marker = seat(hand, finger, camera)
    seen = compose(invert(camera), compose(hand.tip_poses(poses)[:, finger], marker))
    normal = Rotation.from_quat(seen[:, 3:]).apply([0.0, 0.0, 1.0])
    sight = seen[:, :3] / np.linalg.norm(seen[:, :3], axis=1, keepdims=True)
    facing = -np.sum(normal * sight, axis=1) > np.cos(SLANT_RAD)
    pixels = marker_corners(seen, lens, side_m)
    border = np.array([lens.width, lens.height]) - BORDER_PX
    inside = ((pixels > BORDER_PX) & (pixels < border)).all(axis=(1, 2))
    still = cKDTree(_points(hand, waiting, without=finger))
    good = [
        row
        for row in np.flatnonzero(facing & inside)
        if _free(hand, finger, poses[row], still) and _in_sight(hand, finger, poses[row], camera, marker)
    ]
    return poses[good]


def _points(
    hand: HandModel, q: np.ndarray, *, only: int | None = None, without: int | None = None
) -> np.ndarray:
    """Samples of the hand's surface in the base [m], of one finger or of all but one."""
    links = hand.forward_kinematics(q)
    finger = np.array([_finger(hand.link_names[link]) for link in hand.point_link])
    keep = np.ones(len(finger), dtype=bool) if only is None else finger == only
    if without is not None:
        keep &= finger != without
    rows = np.flatnonzero(keep)
    turn = Rotation.from_quat(links[hand.point_link[rows], 3:]).as_matrix()
    moved = (
        np.einsum("lij,lpj->lpi", turn, hand.link_points[rows, ::STRIDE])
        + links[hand.point_link[rows], None, :3]
    )
    return moved.reshape(-1, 3)


def _finger(link: str) -> int:
    """Finger of a link by its name, -1 for the base."""
    return int(link[1 : link.index("_")]) if link.startswith("f") else -1


def _free(hand: HandModel, finger: int, q: np.ndarray, still: cKDTree) -> bool:
    """Whether a finger touches neither the table nor another one. Its first link is mounted on the base."""
    points = _points(hand, q, only=finger)
    height = BASE_IN_WORLD[2] + Rotation.from_quat(BASE_IN_WORLD[3:]).apply(points)[:, 2]
    moving = points[len(points) // 3 :]
    return height.min() > TABLE_CLEAR_M and still.query(moving)[0].min() > CLEAR_M


def _in_sight(hand: HandModel, finger: int, q: np.ndarray, camera: np.ndarray, marker: np.ndarray) -> bool:
    """Whether nothing of the hand is between the camera and a marker."""
    middle = compose(hand.tip_poses(q)[finger], marker)[:3]
    way = middle - camera[:3]
    length = np.linalg.norm(way)
    points = _points(hand, q) - camera[:3]
    along = points @ way / length
    aside = np.linalg.norm(points - along[:, None] * way / length, axis=1)
    return not np.any((aside < SIGHT_M) & (along < length - 2.0 * SEAT_M))


def _way_free(hand: HandModel, finger: int, waiting: np.ndarray, here: np.ndarray, there: np.ndarray) -> bool:
    still = cKDTree(_points(hand, waiting, without=finger))
    shares = np.linspace(0.0, 1.0, PATH_STEPS + 2)[1:-1]
    return all(_free(hand, finger, here + share * (there - here), still) for share in shares)


def _apart(turns: Rotation, count: int) -> list[int]:
    """So many of some orientations, each as far from those before as there is any."""
    chosen, nearest = [0], np.full(len(turns), np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, (turns[chosen[-1]].inv() * turns).magnitude())
        chosen.append(int(np.argmax(nearest)))
    return chosen
