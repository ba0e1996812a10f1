"""Orientation errors, chance levels and confidence intervals.

Angles are radians in [0, pi], quaternions xyzw (unit), rotations world from body.

Intervals are bias-corrected and accelerated (BCa) bootstrap intervals (Efron 1987, as implemented by
``scipy.stats.bootstrap``). What is resampled decides what they speak about:

* ``object``: whole objects, each with all of its episodes (a cluster bootstrap). Episodes of one object
  are alike, so this is the honest choice for statements about objects of this kind; it needs some objects.
* ``episode``: episodes within each object (a stratified bootstrap). The statement is then about these
  very objects, under new starts and goals.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation

Unit = Literal["object", "episode"]

CONFIDENCE = 0.95
RESAMPLES = 9999
# Resampled values held at once: keeps the bootstrap of a large set under a few hundred megabytes.
RESAMPLE_BATCH_VALUES = 8_000_000
# A cluster bootstrap over fewer clusters than this has too few distinct resamples for a 95 % interval.
MIN_CLUSTERS = 8
# Draws for chance on a symmetric object, for which no closed form is used: 0.5 % at a rate of one half.
CHANCE_DRAWS = 40_000

CHANCE_MEAN_RAD = np.pi / 2 + 2 / np.pi
"""Mean angle between two uniform rotations: 2.2074 rad."""


@dataclass(frozen=True)
class Interval:
    """An estimate with its two-sided 95 % confidence interval."""

    value: float
    low: float
    high: float
    method: str
    """``bca``, ``clopper-pearson``, ``order-statistics``: which of them gave ``low`` and ``high``."""


def rotation_angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle between two rotations [rad].

    Args:
        a: Quaternions xyzw, shape [..., 4].
        b: Quaternions xyzw, shape [..., 4], broadcast against ``a``.

    Returns:
        Angles in [0, pi], the broadcast shape without the last axis.
    """
    # |a - b| and |a + b| stay exact for small angles, where the arc cosine of a dot product does not.
    minus = np.linalg.norm(a - b, axis=-1)
    plus = np.linalg.norm(a + b, axis=-1)
    return 4.0 * np.arctan2(np.minimum(minus, plus), np.maximum(minus, plus))


def quat_multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product ``a b`` of quaternions xyzw, shapes [..., 4], broadcast."""
    av, aw, bv, bw = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    vector = aw * bv + bw * av + np.cross(av, bv)
    scalar = aw * bw - np.sum(av * bv, axis=-1, keepdims=True)
    return np.concatenate([vector, scalar], axis=-1)


def symmetric_error(object_quat: np.ndarray, goal_quat: np.ndarray, symmetry: np.ndarray) -> np.ndarray:
    """Orientation error up to the object's symmetry: min over s of angle(q_object s, q_goal).

    Args:
        object_quat: Object orientations xyzw, shape [..., 4].
        goal_quat: Goal orientations xyzw, shape [..., 4].
        symmetry: The rotations of the object onto itself, body frame, xyzw, shape [S, 4]; the identity
            alone for an asymmetric object.

    Returns:
        Errors [rad], shape [...].
    """
    turned = quat_multiply(np.asarray(object_quat)[..., None, :], np.asarray(symmetry))
    return rotation_angle(turned, np.asarray(goal_quat)[..., None, :]).min(axis=-1)


def chance_cdf(angle: np.ndarray | float, symmetry: np.ndarray | None = None) -> np.ndarray:
    """Probability that a uniformly random orientation is within ``angle`` of the goal.

    Args:
        angle: Angles [rad], any shape.
        symmetry: The object's symmetry rotations xyzw, shape [S, 4]; None for an asymmetric object, which
            has the closed form (angle - sin angle) / pi (0.34 % at 0.4 rad).

    Returns:
        Probabilities, the shape of ``angle``.
    """
    angle = np.clip(np.asarray(angle, dtype=float), 0.0, np.pi)
    if symmetry is None or len(symmetry) == 1:
        return (angle - np.sin(angle)) / np.pi
    draws = Rotation.random(CHANCE_DRAWS, rng=np.random.default_rng(0)).as_quat()
    errors = np.sort(symmetric_error(draws, np.array([0.0, 0.0, 0.0, 1.0]), symmetry))
    return np.searchsorted(errors, angle, side="right") / CHANCE_DRAWS


def choose_unit(num_objects: int, requested: Literal["auto", "object", "episode"] = "auto") -> Unit:
    """Resample objects where there are enough of them, else episodes within each object."""
    if requested != "auto":
        return requested
    return "object" if num_objects >= MIN_CLUSTERS else "episode"


def rate_intervals(outcomes: np.ndarray, unit: Unit, *, seed: int = 0) -> list[Interval]:
    """Rates of yes/no outcomes with 95 % intervals.

    Where the bootstrap cannot say anything, since every resample is equal (no success at all, say), nothing
    is known of how objects differ, and the interval is Clopper and Pearson's exact binomial one over all
    episodes, taken as independent.

    Args:
        outcomes: Booleans, shape [R, K, M]: R rates, K objects, M episodes each.
        unit: What is resampled.
        seed: Of the bootstrap.

    Returns:
        R intervals.
    """
    outcomes = np.asarray(outcomes, dtype=float)
    units = outcomes.mean(axis=2)[:, None, :] if unit == "object" else outcomes
    low, high = _bca(units, _mean, seed)
    intervals = []
    for group, lower, upper in zip(outcomes, low, high, strict=True):
        rate = group.mean()
        if np.isfinite(lower) and np.isfinite(upper):
            intervals.append(Interval(float(rate), float(lower), float(upper), "bca"))
        else:
            exact = stats.binomtest(round(group.sum()), group.size).proportion_ci(CONFIDENCE, "exact")
            intervals.append(Interval(float(rate), float(exact.low), float(exact.high), "clopper-pearson"))
    return intervals


def median_interval(values: np.ndarray, unit: Unit, *, seed: int = 0) -> Interval:
    """Median over all objects and episodes with its 95 % interval.

    Args:
        values: Shape [K, M]: K objects, M episodes each; finite.
        unit: What is resampled.
        seed: Of the bootstrap.
    """
    values = np.asarray(values, dtype=float)
    if unit == "object":
        # Resample indices of objects: the statistic is the median over all episodes of the drawn objects.
        def of_objects(index: np.ndarray, axis: int = -1) -> np.ndarray:
            drawn = values[index.astype(int)]
            return np.median(drawn.reshape(*drawn.shape[:-2], -1), axis=-1)

        low, high = _bca(
            np.arange(len(values), dtype=float)[None, None, :], of_objects, seed, values.shape[1]
        )
    else:
        low, high = _bca(values[None], _median, seed)
    if np.isfinite(low[0]) and np.isfinite(high[0]):
        return Interval(float(np.median(values)), float(low[0]), float(high[0]), "bca")
    return order_interval(values.ravel())


def order_interval(values: np.ndarray) -> Interval:
    """Median with the distribution-free interval between two order statistics.

    With fewer than six values no such interval reaches 95 %: the smallest and largest are given.

    Args:
        values: Shape [n], n >= 1, finite.
    """
    ordered = np.sort(np.asarray(values, dtype=float))
    rank = max(int(stats.binom.ppf((1 - CONFIDENCE) / 2, len(ordered), 0.5)), 1)
    return Interval(
        float(np.median(ordered)), float(ordered[rank - 1]), float(ordered[-rank]), "order-statistics"
    )


def _mean(*samples: np.ndarray, axis: int = -1) -> np.ndarray:
    return _joined(samples).mean(axis=axis)


def _median(*samples: np.ndarray, axis: int = -1) -> np.ndarray:
    return np.median(_joined(samples), axis=axis)


def _joined(samples: Sequence[np.ndarray]) -> np.ndarray:
    """Concatenate strata on the last axis; the jackknife hands over strata that only broadcast."""
    shape = np.broadcast_shapes(*(s.shape[:-1] for s in samples))
    return np.concatenate([np.broadcast_to(s, (*shape, s.shape[-1])) for s in samples], axis=-1)


def _bca(
    values: np.ndarray, statistic: Callable[..., np.ndarray], seed: int, values_per_unit: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """BCa bounds of ``statistic`` for values [R, strata, n]: two arrays [R], NaN where degenerate.

    Args:
        values: R samples, each of ``strata`` groups that are resampled separately.
        statistic: Called with one array per stratum and ``axis=-1``.
        seed: Of the resampling.
        values_per_unit: Numbers behind each resampled unit, to bound the memory.
    """
    rates, strata, n = values.shape
    if n < 2:  # one episode of each object: the episodes of all objects are one sample
        values = values.reshape(rates, 1, strata * n)
        strata, n = 1, strata * n
    nothing = np.full(rates, np.nan)
    if n < 2:
        return nothing, nothing
    batch = max(1, RESAMPLE_BATCH_VALUES // (rates * strata * n * values_per_unit))
    with warnings.catch_warnings(), np.errstate(invalid="ignore", divide="ignore"):
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        result: Any = stats.bootstrap(
            tuple(values[:, s] for s in range(strata)),
            statistic,
            n_resamples=RESAMPLES,
            batch=batch,
            vectorized=True,
            axis=-1,
            confidence_level=CONFIDENCE,
            method="BCa",
            rng=np.random.default_rng(seed),
        )
    low = np.atleast_1d(result.confidence_interval.low)
    high = np.atleast_1d(result.confidence_interval.high)
    # Equal bounds are the sign of a sample without spread; NaN, of a failed correction.
    degenerate = ~(high > low)
    return np.where(degenerate, np.nan, low), np.where(degenerate, np.nan, high)
