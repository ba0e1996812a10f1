"""Where a camera is, from a cube of tags on a hand that it looks at (hand-eye calibration).

With the fingertip's pose t_i in the hand's base (forward kinematics), the cube fixed to it at M,
and the wanted pose X of the camera in the base, view i shows the cube at ``C_i = X^-1 t_i M``. From
the motions between views, ``t_i t_j^-1 X = X C_i C_j^-1`` (Park and Martin, 1994), least squares
over the cube's corners in the images begin, which find X and the M of every finger together; a
robust loss keeps wrong views out. Their curvature and the scatter from view to view give the
intervals.

Poses are [7], position [m] and quaternion xyzw; pixels as in
:class:`vd.assets_usd.hand_data.Intrinsics`.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import Intrinsics, compose, invert

CONFIDENCE = 0.95
LEAST_VIEWS = 6
"""Views below which nothing is solved: 12 unknowns with one finger, and some views to judge by."""
LEAST_TURN_RAD = 0.1
"""Root mean square turn between views, about the second of their axes, below which they determine
no camera."""
INLIER_PX = 6.0
"""Mean distance of a view's corners from where the others put them, from which it is an outlier
[px]: joints off by a degree make less."""
ROBUST_PX = 2.0
"""Distance in the image from which the robust loss grows with its first power [px]."""
UNDETERMINED = "the views do not determine the camera; move more joints, over more of their range"
BEHIND_PX = 1e4
"""Distance that counts for a corner behind the camera [px]."""


class HandEyeError(ValueError):
    """Views from which no camera can be found; names the remedy."""


@dataclass(frozen=True, eq=False)
class Views:
    """N views of a cube of tags."""

    tip: np.ndarray
    """Pose of the fingertip in the hand's base [N, 7]."""
    finger: np.ndarray
    """Finger that has the cube, [N]."""
    cube: np.ndarray
    """Pose of the cube in the camera's optical frame [N, 7]."""
    lens: Intrinsics
    size_m: float
    """Side of the cube [m]."""

    def __len__(self) -> int:
        return len(self.tip)

    def chosen(self, rows: np.ndarray) -> "Views":
        """Some of the views."""
        return replace(self, tip=self.tip[rows], finger=self.finger[rows], cube=self.cube[rows])


@dataclass(frozen=True, eq=False)
class HandEye:
    """A camera that was found."""

    camera: np.ndarray
    """Pose of its optical frame in the hand's base [7]."""
    cubes: dict[int, np.ndarray]
    """Pose of the cube in the frame of each finger's tip [7]."""
    inliers: np.ndarray
    """Rows of the views that agree."""
    residual_px: np.ndarray
    """Differences in the image, those views' [n, 8, 2]."""
    covariance: np.ndarray
    """Of the camera: position in the base [m], then turn about the camera's own axes [rad], [6,
    6].
    """
    freedom: int
    """Degrees of freedom of the intervals: views less what they determine."""

    @property
    def rms_px(self) -> float:
        """Root of the mean square of the differences in the image [px]."""
        return float(np.sqrt(np.mean(np.sum(self.residual_px**2, axis=2))))

    @property
    def factor(self) -> float:
        """Half an interval over a standard deviation."""
        return float(stats.t.ppf(0.5 + CONFIDENCE / 2, self.freedom))

    @property
    def half_width(self) -> np.ndarray:
        """Half of the 95 % interval of each component: position [m], turn [rad], shape [6]."""
        return self.factor * np.sqrt(np.diag(self.covariance))

    def point_error(self, point: np.ndarray) -> float:
        """Half of the 95 % interval of where the camera puts a point [3], in the worst direction.

        Metres.
        """
        turn = Rotation.from_quat(self.camera[3:])
        x, y, z = turn.inv().apply(np.asarray(point) - self.camera[:3])
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        jacobian = np.hstack([np.eye(3), -turn.as_matrix() @ cross])
        return self.factor * float(
            np.sqrt(np.linalg.eigvalsh(jacobian @ self.covariance @ jacobian.T)[-1])
        )


def solve(views: Views) -> HandEye:
    """Find the camera.

    Args:
        views: What was seen.

    Raises:
        HandEyeError: Too few views agree, or the fingers turned about too few directions.
    """
    if len(views) < LEAST_VIEWS:
        raise HandEyeError(f"{len(views)} views of the cube; take {LEAST_VIEWS}, better 30")
    camera = _by_motions(views)
    begin = {}
    for finger in np.unique(views.finger):
        mine = views.chosen(np.flatnonzero(views.finger == finger))
        places = compose(_inverse(mine.tip), compose(camera, mine.cube))
        median_px = [np.median(_off(mine, camera, place)) for place in places]
        begin[int(finger)] = places[np.argmin(median_px)]
    estimate = refine(views, camera, begin, robust=True)
    for _ in range(2):
        off = _off(views, estimate.camera, np.stack([estimate.cubes[int(f)] for f in views.finger]))
        rows = np.flatnonzero(off < INLIER_PX)
        if len(rows) < max(LEAST_VIEWS, len(views) / 2):
            raise HandEyeError(
                f"only {len(rows)} of {len(views)} views agree with each other; check the cube's "
                "side, that it sits firmly, that fingers and motors are numbered as in the "
                "calibration, and light"
            )
        again = refine(views.chosen(rows), estimate.camera, estimate.cubes)
        estimate = replace(again, cubes=estimate.cubes | again.cubes, inliers=rows)
    return estimate


def _by_motions(views: Views) -> np.ndarray:
    """The camera's pose [7] from the motions between two views of a finger.

    Raises:
        HandEyeError: The fingers turned about too few directions.
    """
    first, second = np.triu_indices(len(views), 1)
    same = views.finger[first] == views.finger[second]
    first = first[same]
    second = second[same]
    in_base = compose(views.tip[first], _inverse(views.tip[second]))
    in_camera = compose(views.cube[first], _inverse(views.cube[second]))
    turns = Rotation.from_quat(in_base[:, 3:])
    spread_rad = np.linalg.svd(turns.as_rotvec(), compute_uv=False) / np.sqrt(len(turns))
    if spread_rad[1] < LEAST_TURN_RAD:
        raise HandEyeError(UNDETERMINED)
    seen = Rotation.from_quat(in_camera[:, 3:])
    turn, _ = Rotation.align_vectors(turns.as_rotvec(), seen.as_rotvec())
    left = turns.as_matrix() - np.eye(3)
    right = turn.apply(in_camera[:, :3]) - in_base[:, :3]
    place, *_ = np.linalg.lstsq(left.reshape(-1, 3), right.ravel())
    return np.concatenate([place, turn.as_quat()])


def _inverse(poses: np.ndarray) -> np.ndarray:
    """The inverse of each pose [N, 7]."""
    return np.array(list(map(invert, poses)))


def refine(
    views: Views, camera: np.ndarray, cubes: Mapping[int, np.ndarray], *, robust: bool = False
) -> HandEye:
    """Least squares over the corners in the images.

    Args:
        views: Views that agree with each other, but where it is robust.
        camera: Where to begin [7].
        cubes: And with the cube, in each finger's tip's frame [7].
        robust: Whether some views may be wrong; intervals mean nothing then.

    Raises:
        HandEyeError: The views do not determine the camera.
    """
    fingers = list(map(int, np.unique(views.finger)))
    start = np.stack([camera, *(cubes[f] for f in fingers)])
    place = np.searchsorted(fingers, views.finger)

    def poses(x: np.ndarray) -> np.ndarray:
        step = x.reshape(-1, 6)
        turn = Rotation.from_quat(start[:, 3:]) * Rotation.from_rotvec(step[:, 3:])
        return np.concatenate([start[:, :3] + step[:, :3], turn.as_quat()], axis=1)

    def residual(x: np.ndarray) -> np.ndarray:
        now = poses(x)
        return _differences(views, now[0], now[1:][place]).ravel()

    loss = {"loss": "soft_l1", "f_scale": ROBUST_PX} if robust else {}
    result = least_squares(residual, np.zeros(6 * len(start)), x_scale="jac", **loss)
    now = poses(result.x)
    count = len(views)
    covariance, freedom = _scatter(result.jac, result.fun, count)
    # Steps of the camera's place are in the base, turns about its own axes: as HandEye has them.
    return HandEye(
        camera=now[0],
        cubes={finger: now[1 + i] for i, finger in enumerate(fingers)},
        inliers=np.arange(count),
        residual_px=result.fun.reshape(count, -1, 2),
        covariance=covariance[:6, :6],
        freedom=freedom,
    )


def _scatter(jacobian: np.ndarray, residual: np.ndarray, views: int) -> tuple[np.ndarray, int]:
    """Covariance of all parameters and its degrees of freedom, from the scatter between views.

    The corners of a view err together (joints, the cube's seat, light), so the views are what is
    independent: the sandwich of Bell and McCaffrey (2002) with residuals as if their view had been
    left out.
    """
    rows = jacobian.shape[0] // views
    normal = jacobian.T @ jacobian
    scale = np.sqrt(np.diag(normal))
    if not scale.all() or np.linalg.cond(normal / np.outer(scale, scale)) > 1e12:
        raise HandEyeError(UNDETERMINED)
    inverse = np.linalg.inv(normal)
    middle = np.zeros_like(normal)
    for view in range(views):
        part = slice(rows * view, rows * (view + 1))
        block = jacobian[part]
        score = block.T @ np.linalg.solve(np.eye(rows) - block @ inverse @ block.T, residual[part])
        middle += np.outer(score, score)
    freedom = max(1, round(views - jacobian.shape[1] / rows))
    return inverse @ middle @ inverse * (views - 1) / views, freedom


def cube_corners(pose: np.ndarray, lens: Intrinsics, size_m: float) -> np.ndarray:
    """Where the corners of cubes at poses in the camera [N, 7] are in the image [px], [N, 8, 2].

    NaN behind the camera.
    """
    corners = 0.5 * size_m * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    turn = Rotation.from_quat(pose[:, 3:]).as_matrix()
    points = np.einsum("nij,kj->nki", turn, corners) + pose[:, None, :3]
    depth = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
    return points[..., :2] / depth[..., None] * [lens.fx, lens.fy] + [lens.cx, lens.cy]


def _differences(views: Views, camera: np.ndarray, cube: np.ndarray) -> np.ndarray:
    """Where corners should be less where they are [px] [N, 8, 2].

    Cubes are in the tips' frames, [7] or [N, 7].
    """
    pose = compose(invert(camera), compose(views.tip, cube))
    there = cube_corners(pose, views.lens, views.size_m)
    seen = cube_corners(views.cube, views.lens, views.size_m)
    return np.nan_to_num(there - seen, nan=BEHIND_PX)


def _off(views: Views, camera: np.ndarray, cube: np.ndarray) -> np.ndarray:
    """Mean distance of each view's corners from where they should be [px] [N]."""
    return np.linalg.norm(_differences(views, camera, cube), axis=2).mean(axis=1)
