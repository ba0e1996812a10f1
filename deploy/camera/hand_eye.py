"""Where a camera is, from markers on the fingertips of a hand that it looks at (hand-eye calibration).

With the fingertip's pose t_i in the hand's base (forward kinematics), a marker stuck to it at M,
and the wanted pose X of the camera in the base, view i shows the marker at ``X^-1 t_i M``. Least
squares over the corners in the images find X and every M together, from where the camera is thought
to be; a robust loss keeps wrong views out. Their curvature and the scatter from view to view give
the intervals.

Poses are [7], position [m] and quaternion xyzw; pixels as in
:class:`vd.assets_usd.hand_data.Intrinsics`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import Intrinsics, compose, invert

CONFIDENCE = 0.95
LEAST_VIEWS = 6
"""Views below which nothing is solved: 12 unknowns with one marker, and some views to judge by."""
LEAST_OF_FINGER = 4
"""Views of one finger below which its marker only costs unknowns."""
INLIER_PX = 6.0
"""Mean distance of a view's corners from where the others put them, from which it is an outlier
[px]: joints off by a degree make less."""
ROBUST_PX = 2.0
"""Distance in the image from which the robust loss grows with its first power [px]."""
BEHIND_PX = 1e4
"""Distance that counts for a corner behind the camera [px]."""


class HandEyeError(ValueError):
    """Views from which no camera can be found; names the remedy."""


@dataclass(frozen=True, eq=False)
class Views:
    """N views of markers."""

    tip: np.ndarray
    """Pose of the fingertip in the hand's base [N, 7]."""
    finger: np.ndarray
    """Finger that has the marker, [N]."""
    corners: np.ndarray
    """Corners of the marker in the image, from the top left on clockwise as printed [px], shape [N,
    4, 2].
    """
    lens: Intrinsics
    side_m: float
    """Side of the markers [m]."""

    def __len__(self) -> int:
        return len(self.tip)

    def chosen(self, rows: np.ndarray) -> "Views":
        """Some of the views."""
        return replace(
            self, tip=self.tip[rows], finger=self.finger[rows], corners=self.corners[rows]
        )


@dataclass(frozen=True, eq=False)
class HandEye:
    """A camera that was found."""

    camera: np.ndarray
    """Pose of its optical frame in the hand's base [7]."""
    markers: dict[int, np.ndarray]
    """Pose of each finger's marker in the frame of its tip [7]."""
    inliers: np.ndarray
    """Rows of the views that agree."""
    residual_px: np.ndarray
    """Differences in the image, those views' [n, 4, 2]."""
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
        """Half of the 95 % interval of where the camera puts a point of the base [3], in the worst direction.

        Metres.
        """
        turn = Rotation.from_quat(self.camera[3:])
        x, y, z = turn.inv().apply(np.asarray(point) - self.camera[:3])
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        jacobian = np.hstack([np.eye(3), -turn.as_matrix() @ cross])
        return self.factor * float(
            np.sqrt(np.linalg.eigvalsh(jacobian @ self.covariance @ jacobian.T)[-1])
        )


def solve(views: Views, camera: np.ndarray, markers: Mapping[int, np.ndarray]) -> HandEye:
    """Find the camera.

    Args:
        views: What was seen.
        camera: Where the camera is thought to be [7]: some centimetres and ten degrees off do no
            harm.
        markers: Where each finger's marker is thought to be in its tip's frame [7]; it may have
            been stuck on turned in its plane.

    Raises:
        HandEyeError: Too few views agree, or the fingers turned about too few directions.
    """
    rows = _enough(views.finger, np.arange(len(views)))
    if len(rows) < LEAST_VIEWS:
        raise HandEyeError(f"{len(rows)} views of a marker; take at least {LEAST_VIEWS}, better 30")
    views = views.chosen(rows)
    turned = {}
    for finger in np.unique(views.finger):
        options = [_turned(markers[int(finger)], quarter) for quarter in range(4)]
        mine = views.chosen(np.flatnonzero(views.finger == finger))
        turned[int(finger)] = min(options, key=lambda marker: np.median(_off(mine, camera, marker)))
    estimate = refine(views, camera, turned, robust=True)
    for _ in range(2):
        off = _off(
            views, estimate.camera, np.stack([estimate.markers[int(f)] for f in views.finger])
        )
        rows = _enough(views.finger, np.flatnonzero(off < INLIER_PX))
        if len(rows) < max(LEAST_VIEWS, len(views) / 2):
            raise HandEyeError(
                f"only {len(rows)} of {len(views)} views agree with each other; check the marker's "
                "side, that it sits firmly, that fingers and motors are numbered as in the "
                "calibration, light, and that the camera is roughly where the hand's file has it"
            )
        again = refine(views.chosen(rows), estimate.camera, estimate.markers)
        estimate = replace(again, markers=estimate.markers | again.markers, inliers=rows)
    return estimate


def _enough(finger: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Those of some rows whose finger [N] has enough of them."""
    return rows[np.bincount(finger[rows], minlength=1)[finger[rows]] >= LEAST_OF_FINGER]


def refine(
    views: Views, camera: np.ndarray, markers: Mapping[int, np.ndarray], *, robust: bool = False
) -> HandEye:
    """Least squares over the corners in the images.

    Args:
        views: Views that agree with each other, but where it is robust.
        camera: Where to begin [7].
        markers: And for each finger's marker in its tip's frame [7].
        robust: Whether some views may be wrong; intervals mean nothing then.

    Raises:
        HandEyeError: The views do not determine the camera.
    """
    fingers = [int(f) for f in np.unique(views.finger)]
    start = np.stack([camera, *(markers[f] for f in fingers)])
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
        markers={finger: now[1 + i] for i, finger in enumerate(fingers)},
        inliers=np.arange(count),
        residual_px=result.fun.reshape(count, 4, 2),
        covariance=covariance[:6, :6],
        freedom=freedom,
    )


def _scatter(jacobian: np.ndarray, residual: np.ndarray, views: int) -> tuple[np.ndarray, int]:
    """Covariance of all parameters and its degrees of freedom, from the scatter between views.

    The four corners of a view err together (joints, the marker's seat, light), so the views are
    what is
    independent: the sandwich of Bell and McCaffrey (2002) with residuals as if their view had been
    left out.
    """
    rows = jacobian.shape[0] // views
    normal = jacobian.T @ jacobian
    scale = np.sqrt(np.diag(normal))
    if not scale.all() or np.linalg.cond(normal / np.outer(scale, scale)) > 1e12:
        raise HandEyeError(
            "the views do not determine the camera; move more joints, over more of their range"
        )
    inverse = np.linalg.inv(normal)
    middle = np.zeros_like(normal)
    for view in range(views):
        part = slice(rows * view, rows * (view + 1))
        block = jacobian[part]
        score = block.T @ np.linalg.solve(np.eye(rows) - block @ inverse @ block.T, residual[part])
        middle += np.outer(score, score)
    freedom = max(1, round(views - jacobian.shape[1] / rows))
    return inverse @ middle @ inverse * (views - 1) / views, freedom


def _turned(marker: np.ndarray, quarters: int) -> np.ndarray:
    """A marker [7] that was stuck on with another side up."""
    turn = Rotation.from_euler("z", 90 * quarters, degrees=True).as_quat()
    return compose(marker, np.array([0.0, 0.0, 0.0, *turn]))


def square(side_m: float) -> np.ndarray:
    """Corners of a marker in its own frame (x right, y up, z out of the print) [m], shape [4, 3]."""
    half = side_m / 2
    return np.array(
        [[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]]
    )


def marker_corners(pose: np.ndarray, lens: Intrinsics, side_m: float) -> np.ndarray:
    """Where the corners of markers at poses in the camera [N, 7] are in the image [px], [N, 4, 2].

    NaN behind the camera.
    """
    turn = Rotation.from_quat(pose[:, 3:]).as_matrix()
    points = np.einsum("nij,kj->nki", turn, square(side_m)) + pose[:, None, :3]
    depth = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
    return points[..., :2] / depth[..., None] * [lens.fx, lens.fy] + [lens.cx, lens.cy]


def _differences(views: Views, camera: np.ndarray, marker: np.ndarray) -> np.ndarray:
    """Where corners should be less where they are [px] [N, 4, 2].

    Markers are in the tips' frames [7].
    """
    pose = compose(invert(camera), compose(views.tip, marker))
    return np.nan_to_num(
        marker_corners(pose, views.lens, views.side_m) - views.corners, nan=BEHIND_PX
    )


def _off(views: Views, camera: np.ndarray, marker: np.ndarray) -> np.ndarray:
    """Mean distance of each view's corners from where they should be [px] [N]."""
    return np.linalg.norm(_differences(views, camera, marker), axis=2).mean(axis=1)
