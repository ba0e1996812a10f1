"""Where a camera is, from markers on the fingertips of a hand that it looks at (hand-eye calibration).

With the fingertip's pose t_i in the hand's base (forward kinematics), a marker stuck to it in an unknown way
M, the marker's pose c_i in the camera, and the wanted pose X of the camera in the base, ``t_i M = X c_i`` in
every view i. Two views of a finger give ``A X = X B`` with ``A = t_i t_j^-1`` and ``B = c_i c_j^-1``, which
dual quaternions solve for rotation and translation at once (Daniilidis, 1999). From there, least squares over
the corners in the images refine X and every M together; their curvature and the scatter from view to view
give the intervals.

Poses are [7], position [m] and quaternion xyzw; pixels as in :class:`vd.assets_usd.hand_data.Intrinsics`.
"""

from collections.abc import Sequence
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
LEAST_TURN_RAD = np.radians(8.0)
"""Motions that turn less than this say nothing of the rotation."""
LARGEST_TURN_RAD = np.radians(170.0)
"""Motions near half a turn leave the sign of a quaternion to chance."""
INLIER_PX = 6.0
"""Mean distance of a view's corners from where the others put them, from which it is an outlier [px]: with a
marker mistaken for its mirror image it is more, with joints off by a degree it is less."""
ROUGH_PX = 20.0
"""The same for the rough camera of three views."""
DRAWS = 150
"""Triples of views that are tried: one view in two seen from the wrong side, and one in four wrong, leave one
triple in twenty, and all miss once in 2000."""
REFINED = 6
"""Of those, how many are refined."""


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
    """Corners of the marker in the image, from the top left on clockwise as printed [px], shape [N, 4, 2]."""
    candidates: tuple[np.ndarray, ...]
    """Poses of the marker in the camera that fit the corners, the best first: [K, 7] with K = 1 or 2. A small
    square looks much the same from two sides."""
    lens: Intrinsics
    side_m: float
    """Side of the markers [m]."""

    def __len__(self) -> int:
        return len(self.tip)

    def chosen(self, rows: np.ndarray) -> "Views":
        """Some of the views."""
        return Views(
            self.tip[rows],
            self.finger[rows],
            self.corners[rows],
            tuple(self.candidates[i] for i in rows),
            self.lens,
            self.side_m,
        )


@dataclass(frozen=True, eq=False)
class HandEye:
    """A camera that was found."""

    camera: np.ndarray
    """Pose of its optical frame in the hand's base [7]."""
    markers: dict[int, np.ndarray]
    """Pose of each finger's marker in the frame of its tip [7]."""
    linear: np.ndarray
    """Pose of the camera by dual quaternions, before it was refined [7]."""
    inliers: np.ndarray
    """Rows of the views that agree."""
    residual_px: np.ndarray
    """Differences in the image, those views' [n, 4, 2]."""
    covariance: np.ndarray
    """Of the camera: position in the base [m], then turn about the camera's own axes [rad], [6, 6]."""
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

    def point_covariance(self, point: np.ndarray) -> np.ndarray:
        """Of where the camera puts what is at a point of the base [3] [m], shape [3, 3]."""
        turn = Rotation.from_quat(self.camera[3:])
        seen = turn.inv().apply(np.asarray(point) - self.camera[:3])
        jacobian = np.hstack([np.eye(3), -turn.as_matrix() @ _cross(seen)])
        return jacobian @ self.covariance @ jacobian.T

    def point_error(self, point: np.ndarray) -> float:
        """Half of the 95 % interval of a point's place along the direction that is known worst [m]."""
        return self.factor * float(np.sqrt(np.linalg.eigvalsh(self.point_covariance(point))[-1]))

    def condition(self, point: np.ndarray) -> float:
        """How much worse the worst direction is known than the best, turns counted as arcs at a point."""
        distance = np.linalg.norm(np.asarray(point) - self.camera[:3])
        scale = np.diag([1.0] * 3 + [distance] * 3)
        values = np.linalg.eigvalsh(scale @ self.covariance @ scale)
        return float(np.sqrt(values[-1] / values[0]))


def solve(views: Views, *, seed: int = 0) -> HandEye:
    """Find the camera.

    Args:
        views: What was seen.
        seed: Of the triples that are tried.

    Raises:
        HandEyeError: Too few views agree, or the fingers turned about too few directions.
    """
    rough, rows = consensus(views, seed=seed)
    linear = dual_quaternions(*_sides(views, rows, rough))
    result = refine(views.chosen(rows), rough.camera)
    return replace(result, linear=linear, inliers=rows)


def dual_quaternions(tips: Sequence[np.ndarray], markers: Sequence[np.ndarray]) -> np.ndarray:
    """The camera's pose [7] from motions of fingers: A X = X B by dual quaternions.

    Args:
        tips: For each finger poses of its tip in the base [n, 7].
        markers: For each finger poses of its marker in the camera [n, 7].

    Raises:
        HandEyeError: The motions do not turn about two directions.
    """
    a = np.concatenate([_motions(t) for t in tips])
    b = np.concatenate([_motions(m) for m in markers])
    if not len(a):
        raise HandEyeError("no two views of the same marker; take more")
    angle = 2.0 * np.arccos(np.clip(np.abs(a[:, 6]), 0.0, 1.0))
    useful = (angle > LEAST_TURN_RAD) & (angle < LARGEST_TURN_RAD)
    if np.count_nonzero(useful) < 2:
        raise HandEyeError("the fingertip hardly turns from view to view; bend and swing the finger further")
    a, b = a[useful], b[useful]
    # Lengths are measured in units in which they are as large as the quaternions.
    unit = float(np.median(np.linalg.norm(np.concatenate([a[:, :3], b[:, :3]]), axis=1)))
    (ar, ad), (br, bd) = _dual(a, unit), _dual(b, unit)
    zero = np.zeros((len(a), 3, 1))
    low = np.concatenate([(ar - br)[:, :3, None], _cross(ar[:, :3] + br[:, :3])], axis=2)
    high = np.concatenate([(ad - bd)[:, :3, None], _cross(ad[:, :3] + bd[:, :3])], axis=2)
    blank = np.concatenate([zero, np.zeros((len(a), 3, 3))], axis=2)
    system = np.concatenate(
        [np.concatenate([low, blank], axis=2), np.concatenate([high, low], axis=2)], axis=1
    ).reshape(-1, 8)
    _, values, rows = np.linalg.svd(system)
    if values[5] < 1e-6 * values[0]:
        raise HandEyeError(
            "the fingertip turned about one direction only; swing the finger sideways (its first joint) too"
        )
    u1, v1, u2, v2 = rows[6, :4], rows[6, 4:], rows[7, :4], rows[7, 4:]
    # A combination of the two null vectors that is a unit dual quaternion: u.v = 0, u.u = 1.
    roots = _ratios(u1 @ v1, u1 @ v2 + u2 @ v1, u2 @ v2)
    first, second = max(
        roots, key=lambda r: r[0] ** 2 * (u1 @ u1) + 2 * r[0] * r[1] * (u1 @ u2) + r[1] ** 2 * (u2 @ u2)
    )
    real, dual = first * u1 + second * u2, first * v1 + second * v2
    size = np.linalg.norm(real)
    return _from_dual(real / size, dual / size, unit)


def consensus(views: Views, *, seed: int = 0) -> tuple[HandEye, np.ndarray]:
    """The camera on which most views agree: of triples of views, each marker from one of its sides.

    Three noisy views make a rough camera, so the best of them are refined, on ever more views, before they
    are compared.

    Returns:
        The camera, and the rows of the views that agree with it.

    Raises:
        HandEyeError: Too few views agree, or the fingers turned about too few directions.
    """
    if len(views) < LEAST_VIEWS:
        raise HandEyeError(f"{len(views)} views of a marker; take at least {LEAST_VIEWS}, better 30")
    generator = np.random.default_rng(seed)
    crowded = [rows for rows in _groups(views).values() if len(rows) >= LEAST_OF_FINGER]
    if not crowded:
        raise HandEyeError(f"no finger has {LEAST_OF_FINGER} views of its marker; take more")
    rough, why = _rough(views, crowded, generator)
    best: tuple[HandEye, np.ndarray] | None = None
    for camera in rough[:REFINED]:
        rows = np.flatnonzero(_judge(views, camera, ROUGH_PX)[1])
        try:
            for limit in (ROUGH_PX, INLIER_PX, INLIER_PX):
                found = refine(views.chosen(rows), camera)
                camera, rows = found.camera, _agreeing(views, found, limit)
        except (HandEyeError, ValueError):  # too few views, or some behind the camera
            continue
        if best is None or len(rows) > len(best[1]):
            best = (found, rows)
    if best is None:
        raise HandEyeError(why)
    if len(best[1]) < max(LEAST_VIEWS, len(views) / 2):
        raise HandEyeError(
            f"only {len(best[1])} of {len(views)} views agree with each other; check the marker's side, "
            "that it sits firmly, that fingers and their motors are numbered as in the calibration, and light"
        )
    return best


def _rough(
    views: Views, crowded: list[np.ndarray], generator: np.random.Generator
) -> tuple[list[np.ndarray], str]:
    """Cameras of triples of views of one finger, the best first, and why there are none if there are none."""
    rough: list[tuple[float, np.ndarray]] = []
    why = "the views do not determine the camera; move more joints, over more of their range"
    for _ in range(DRAWS):
        rows = generator.choice(crowded[generator.integers(len(crowded))], 3, replace=False)
        sides = [views.candidates[row][generator.integers(len(views.candidates[row]))] for row in rows]
        try:
            camera = dual_quaternions([views.tip[rows]], [np.stack(sides)])
        except HandEyeError as error:
            why = str(error)
            continue
        rough.append((_judge(views, camera, ROUGH_PX)[2], camera))
    return [camera for _, camera in sorted(rough, key=lambda option: option[0])], why


def _sides(views: Views, rows: np.ndarray, found: HandEye) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """For each finger poses of its tip, and of its marker in the camera from the side on which it is."""
    tips, seen = [], []
    for finger, marker in found.markers.items():
        mine = rows[views.finger[rows] == finger]
        if len(mine):
            tips.append(views.tip[mine])
            seen.append(np.stack([_nearest(views, row, found.camera, marker) for row in mine]))
    return tips, seen


def refine(views: Views, camera: np.ndarray) -> HandEye:
    """Least squares over the corners in the images, from a first camera.

    Args:
        views: Views that agree with it.
        camera: Its pose [7].

    Raises:
        HandEyeError: The views do not determine the camera.
    """
    fingers = [int(f) for f in np.unique(views.finger)]
    markers, _, _ = _judge(views, camera, ROUGH_PX)
    start = np.stack([camera, *(markers[f] for f in fingers)])
    place = np.searchsorted(fingers, views.finger)

    def poses(x: np.ndarray) -> np.ndarray:
        step = x.reshape(-1, 6)
        turn = Rotation.from_quat(start[:, 3:]) * Rotation.from_rotvec(step[:, 3:])
        return np.concatenate([start[:, :3] + step[:, :3], turn.as_quat()], axis=1)

    def residual(x: np.ndarray) -> np.ndarray:
        now = poses(x)
        return (_corners(views, now[0], now[1:][place]) - views.corners).ravel()

    result = least_squares(residual, np.zeros(start.size // 7 * 6), x_scale="jac", method="trf")
    now, count = poses(result.x), len(views)
    covariance, freedom = _scatter(result.jac, result.fun, count)
    # Steps of the camera's place are in the base, turns about its own axes: as HandEye has them.
    return HandEye(
        camera=now[0],
        markers={finger: now[1 + i] for i, finger in enumerate(fingers)},
        linear=camera,
        inliers=np.arange(count),
        residual_px=result.fun.reshape(count, 4, 2),
        covariance=covariance[:6, :6],
        freedom=freedom,
    )


def _scatter(jacobian: np.ndarray, residual: np.ndarray, views: int) -> tuple[np.ndarray, int]:
    """Covariance of all parameters and its degrees of freedom, from the scatter between views.

    The four corners of a view err together (joints, the marker's seat, light), so the views are what is
    independent: the sandwich of Bell and McCaffrey (2002) with residuals as if their view had been left out.
    """
    rows = jacobian.shape[0] // views
    normal = jacobian.T @ jacobian
    if np.linalg.cond(normal / np.sqrt(np.outer(np.diag(normal), np.diag(normal)))) > 1e12:
        raise HandEyeError(
            "the views do not determine the camera; move more joints, over more of their range"
        )
    inverse = np.linalg.inv(normal)
    middle = np.zeros_like(normal)
    for view in range(views):
        part = slice(rows * view, rows * (view + 1))
        own = jacobian[part]
        left_out = np.linalg.solve(np.eye(rows) - own @ inverse @ own.T, residual[part])
        score = own.T @ left_out
        middle += np.outer(score, score)
    freedom = max(1, round(views - jacobian.shape[1] / rows))
    return inverse @ middle @ inverse * (views - 1) / views, freedom


def _groups(views: Views) -> dict[int, np.ndarray]:
    """Rows of each finger's views."""
    return {int(f): np.flatnonzero(views.finger == f) for f in np.unique(views.finger)}


def _judge(
    views: Views, camera: np.ndarray, limit_px: float
) -> tuple[dict[int, np.ndarray], np.ndarray, float]:
    """Markers that suit a camera best, which views agree with them, and how far all are off [px]."""
    markers, agree, total = {}, np.zeros(len(views), dtype=bool), 0.0
    for finger, rows in _groups(views).items():
        mine = views.chosen(rows)
        options = np.concatenate(
            [compose(compose(invert(views.tip[row]), camera), views.candidates[row]) for row in rows]
        )
        seen = _corners(mine, camera, options[:, None])
        off = np.linalg.norm(seen - mine.corners, axis=3).mean(axis=2)
        off = np.minimum(np.where(np.isfinite(off), off, np.inf), limit_px)
        pick = int(np.argmin(off.sum(axis=1)))
        markers[finger] = options[pick]
        agree[rows] = off[pick] < limit_px
        total += float(off[pick].sum())
    return markers, agree, total


def _agreeing(views: Views, found: HandEye, limit_px: float) -> np.ndarray:
    """Rows of the views that agree with a camera, of fingers that have enough of them."""
    markers = {**_judge(views, found.camera, limit_px)[0], **found.markers}
    marker = np.stack([markers[int(finger)] for finger in views.finger])
    off = np.linalg.norm(_corners(views, found.camera, marker) - views.corners, axis=2).mean(axis=1)
    agree = off < limit_px
    count = {finger: int(agree[rows].sum()) for finger, rows in _groups(views).items()}
    return np.flatnonzero(agree & [count[int(finger)] >= LEAST_OF_FINGER for finger in views.finger])


def _nearest(views: Views, row: int, camera: np.ndarray, marker: np.ndarray) -> np.ndarray:
    """The candidate of a view [7] that is nearest to where the camera should see the marker."""
    expected = compose(invert(camera), compose(views.tip[row], marker))
    turn = Rotation.from_quat(expected[3:])
    away = (turn.inv() * Rotation.from_quat(views.candidates[row][:, 3:])).magnitude()
    return views.candidates[row][int(np.argmin(away))]


def square(side_m: float) -> np.ndarray:
    """Corners of a marker in its own frame (x right, y up, z out of the print) [m], shape [4, 3]."""
    half = side_m / 2
    return np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])


def _corners(views: Views, camera: np.ndarray, marker: np.ndarray) -> np.ndarray:
    """Where the corners should be [px], [..., N, 4, 2], with markers in the tips' frames [..., N or 1, 7]."""
    pose = compose(invert(camera), compose(views.tip, marker))
    turn = Rotation.from_quat(pose[..., 3:].reshape(-1, 4)).as_matrix().reshape(*pose.shape[:-1], 3, 3)
    points = np.einsum("...ij,kj->...ki", turn, square(views.side_m)) + pose[..., None, :3]
    return project(points, views.lens)


def project(points: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """Pixels of points of the optical frame, [..., 3] to [..., 2]; NaN behind the camera."""
    depth = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
    return np.stack(
        [lens.fx * points[..., 0] / depth + lens.cx, lens.fy * points[..., 1] / depth + lens.cy], axis=-1
    )


def _motions(poses: np.ndarray) -> np.ndarray:
    """``p_i p_j^-1`` for all pairs i < j, the quaternion's w not negative, [n (n - 1) / 2, 7]."""
    i, j = np.triu_indices(len(poses), 1)
    inverse = np.stack([invert(pose) for pose in poses])
    motion = compose(poses[i], inverse[j])
    motion[:, 3:] *= np.where(motion[:, 6:] < 0.0, -1.0, 1.0)
    return motion


def _dual(poses: np.ndarray, unit: float) -> tuple[np.ndarray, np.ndarray]:
    """Real and dual parts xyzw [n, 4] of poses [n, 7]: q and t q / 2."""
    t, v, w = poses[:, :3] / unit, poses[:, 3:6], poses[:, 6:]
    dual = np.concatenate([w * t + np.cross(t, v), -np.sum(t * v, axis=1, keepdims=True)], axis=1) / 2
    return poses[:, 3:], dual


def _from_dual(real: np.ndarray, dual: np.ndarray, unit: float) -> np.ndarray:
    """Pose of a unit dual quaternion whose parts are wxyz: t = 2 dual conj(real)."""
    w, v, e, d = real[0], real[1:], dual[0], dual[1:]
    return np.concatenate([2.0 * unit * (w * d - e * v - np.cross(d, v)), v, [w]])


def _ratios(a: float, b: float, c: float) -> list[tuple[float, float]]:
    """Pairs (x, y), not both zero, with a x^2 + b x y + c y^2 = 0; the nearest real ones."""
    root = np.sqrt(max(b * b - 4.0 * a * c, 0.0))
    # Along the stable formula: the larger of the two sums is never a difference of equals.
    large = -0.5 * (b + np.copysign(root, b))
    pairs = [(large, a), (c, large)]
    return [(x / n, y / n) for x, y in pairs if (n := float(np.hypot(x, y))) > 0.0] or [
        (1.0, 0.0),
        (0.0, 1.0),
    ]


def _cross(v: np.ndarray) -> np.ndarray:
    """Matrices of the cross product with vectors [..., 3], shape [..., 3, 3]."""
    zero = np.zeros_like(v[..., 0])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*v.shape[:-1], 3, 3)
