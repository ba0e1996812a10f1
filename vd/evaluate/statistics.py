"""Orientation errors and confidence intervals.

Angles are radians in [0, pi], quaternions xyzw (unit), rotations world from body. K objects, M
episodes of each.

Rates have t intervals on the log odds, with the jackknife's standard error (Efron and Stein 1981).
Medians have the intervals of the share below them, turned into quantiles (Woodruff 1952). What the
jackknife leaves out one at a time decides what they speak about:

* ``object``: whole objects, each with all of its episodes. Episodes of one object are alike, so
  this is the honest choice for statements about objects of this kind; it needs some objects.
* ``episode``: episodes within each object (the objects are strata). The statement is then about
  these very objects, under new starts and goals.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import stats
from scipy.special import expit, logit

from vd.geometry.quaternions import product, rotation_distance

Unit = Literal["object", "episode"]

CONFIDENCE = 0.95
TOLERANCES_RAD = (0.1, 0.2, 0.4, 0.8)
"""Errors at which success is reported; the paper's figures use 0.1, 0.4 and 0.8."""
# How much objects differ is not known from fewer than this.
MIN_CLUSTERS = 8


@dataclass(frozen=True)
class Interval:
    """An estimate with its two-sided 95 % confidence interval."""

    value: float
    low: float
    high: float
    method: str
    """``logit-t``, ``clopper-pearson``, ``woodruff``, ``order-statistics`` or ``paired-t``: what
    gave the bounds."""


def symmetric_error(
    object_quat: np.ndarray, goal_quat: np.ndarray, symmetry: np.ndarray
) -> np.ndarray:
    """Orientation error [...] up to the object's symmetry: min over s of angle(q_object s, q_goal).

    Args:
        object_quat: Object orientations xyzw, shape [..., 4].
        goal_quat: Goal orientations xyzw, shape [..., 4].
        symmetry: The rotations of the object onto itself, body frame, xyzw, shape [S, 4].
    """
    turned = product(object_quat[..., None, :], symmetry)
    return np.asarray(rotation_distance(turned, goal_quat[..., None, :]).min(axis=-1))


def choose_unit(num_objects: int) -> Unit:
    """Objects where there are enough of them, else episodes within each object."""
    return "object" if num_objects >= MIN_CLUSTERS else "episode"


def share_among(of: np.ndarray, among: np.ndarray) -> float | None:
    """Mean of ``of`` where ``among`` holds; None where it does nowhere."""
    return float(of[among].mean()) if among.any() else None


def paired_difference(
    outcomes: np.ndarray, others: np.ndarray, unit: Unit | None = None
) -> Interval:
    """How much larger the rate of outcomes is than that of others on the same episodes [K, M]."""
    pairs = outcomes.astype(float) - others
    unit = unit or choose_unit(len(pairs))
    units = pairs.mean(axis=1)[None] if unit == "object" or pairs.shape[1] == 1 else pairs
    strata, n = units.shape
    half = np.inf
    if n > 1:
        error = np.sqrt(units.var(axis=1, ddof=1).sum() / n) / strata
        half = float(stats.t.ppf((1 + CONFIDENCE) / 2, strata * (n - 1)) * error)
    mean = float(pairs.mean())
    return Interval(mean, max(mean - half, -1.0), min(mean + half, 1.0), "paired-t")


def rate_intervals(outcomes: np.ndarray, unit: Unit | None = None) -> list[Interval]:
    """Rates of yes/no outcomes with 95 % intervals.

    Where all units are equal (no success at all, say), nothing is known of how they differ, and the
    interval is Clopper and Pearson's exact binomial one over all episodes, taken as independent.

    Args:
        outcomes: Booleans, or shares in [0, 1], shape [R, K, M] for R rates.
        unit: What the statement is about; by default as :func:`choose_unit` says.
    """
    outcomes = np.asarray(outcomes, dtype=float)
    lows, highs = _logit_t(outcomes, unit or choose_unit(outcomes.shape[1]))
    intervals = []
    for group, low, high in zip(outcomes, lows, highs, strict=True):
        rate = float(group.mean())
        method = "logit-t"
        if not np.isfinite(low):
            method = "clopper-pearson"
            test = stats.binomtest(round(group.sum()), group.size)
            low, high = test.proportion_ci(CONFIDENCE, "exact")
        intervals.append(Interval(rate, min(float(low), rate), max(float(high), rate), method))
    return intervals


def _logit_t(outcomes: np.ndarray, unit: Unit) -> tuple[np.ndarray, np.ndarray]:
    """Bounds [R] of t intervals on the log odds of rates [R, K, M]; NaN where all units are equal.

    The jackknife sees how the log odds bend: with 13 objects, few failures and objects that differ
    the plain standard error is too small. Half a success and half a failure are added, which keeps
    the odds finite.
    """
    rates, objects, episodes = outcomes.shape
    units = outcomes.mean(axis=2)[:, None] if unit == "object" else outcomes
    if unit == "episode" and episodes == 1:  # the episodes of all objects are one sample
        units = outcomes.reshape(rates, 1, objects)
    strata, n = units.shape[1:]
    if n < 2:
        return np.full(rates, np.nan), np.full(rates, np.nan)

    def odds(share: np.ndarray) -> np.ndarray:
        return np.asarray(logit((share * objects * episodes + 0.5) / (objects * episodes + 1.0)))

    total = units.mean(axis=(1, 2))
    without = total[:, None, None] + (units.mean(axis=2, keepdims=True) - units) / (
        (n - 1) * strata
    )
    moved = odds(without)
    variance = (n - 1) * moved.var(axis=2).sum(axis=1)
    half = stats.t.ppf((1 + CONFIDENCE) / 2, strata * (n - 1)) * np.sqrt(variance)
    half[np.ptp(units, axis=2).max(axis=1) == 0.0] = np.nan
    return expit(odds(total) - half), expit(odds(total) + half)


def median_interval(values: np.ndarray, unit: Unit | None = None) -> Interval:
    """Median of finite values [K, M] with its 95 % interval."""
    values = np.asarray(values, dtype=float)
    median = float(np.median(values))
    below = (values < median) + 0.5 * (values == median)
    (share,) = rate_intervals(below[None], unit)
    if share.method != "logit-t":
        return order_interval(values.ravel())
    low, high = np.quantile(values, (share.low, share.high))
    return Interval(median, min(float(low), median), max(float(high), median), "woodruff")


def order_interval(values: np.ndarray) -> Interval:
    """Median with the distribution-free interval between two order statistics.

    With fewer than six values no such interval reaches 95 %: the smallest and largest are given.
    Values are finite [n], n >= 1.
    """
    ordered = np.sort(np.asarray(values, dtype=float))
    rank = max(int(stats.binom.ppf((1 - CONFIDENCE) / 2, len(ordered), 0.5)), 1)
    return Interval(
        float(np.median(ordered)),
        float(ordered[rank - 1]),
        float(ordered[-rank]),
        "order-statistics",
    )
