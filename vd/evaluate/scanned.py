"""Shapes and goals known by points.

500 exact ones, or those of a scan, with noise and a side missing.

The paper's goals for household objects come from a tablet's scans, which are imperfect in ways it
does not quantify (its Figure 5). Here a scan errs as much as a cloud in training may, but
lastingly: the same points are wrong in every step. The true shape is the simulation's alone.
"""

from collections.abc import Sequence

import numpy as np

from vd.assets_usd.objects.model import ObjectModel
from vd.evaluate.goals import Goals
from vd.paper import PAPER

NOISE_M = PAPER.cloud.jitter_std_m
"""Standard deviation of a scanned point along each axis [m]."""
MISSING = PAPER.cloud.dropout_ratio[1]
"""Share of the points that are missing, all on one side."""


def scan(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Samples [m] of a shape [K, 3], body frame, as a scan has them.

    Noisy, one side replaced by others.
    """
    order = np.argsort(points @ rng.normal(size=3))
    visible = order[: round(len(points) * (1.0 - MISSING))]
    repeated = rng.choice(visible, len(points) - len(visible))
    noise = rng.normal(scale=NOISE_M, size=points.shape).astype(points.dtype)
    scanned = np.empty_like(points)
    scanned[order] = points[np.concatenate([visible, repeated])] + noise  # in the points' own order
    return scanned


def known_points(objects: Sequence[ObjectModel], goals: Goals, *, seed: int) -> np.ndarray:
    """What a policy knows of objects: their samples, or a scan of these [m] [O, P, 3], body frame."""
    rng = np.random.default_rng(seed)
    known = [item.surface_points for item in objects]
    if goals == "scan":
        known = [scan(points, rng) for points in known]
    return np.stack(known)
