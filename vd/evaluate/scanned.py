"""Shapes and goals known by points.

500 exact ones, or those of a scan, with noise and a side missing.

The paper's goals for household objects come from a tablet's scans, which are imperfect in ways it
does not quantify (its Figure 5). Here a scan errs as much as a cloud in training may, but
lastingly: the same points are wrong in every step. The surface behind them is laid as through those
of a real scan (:mod:`vd.assets_usd.objects.scans`); the true shape is the simulation's alone.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vd.assets_usd.objects.geometry import surface_points
from vd.assets_usd.objects.model import ObjectModel
from vd.assets_usd.objects.scans import surface_of_scan
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


def known_by_points(item: ObjectModel, points: np.ndarray, device: str) -> ObjectModel:
    """An object as points of it [m] [K, 3], body frame, tell.

    The surface through them, and its samples.
    """
    surface = surface_of_scan(points, device)
    samples = surface_points(surface, len(item.surface_points))
    return replace(
        item,
        vertices=surface.vertices.astype(np.float32),
        faces=surface.faces,
        surface_points=samples.astype(np.float32),
    )


def known_objects(
    objects: Sequence[ObjectModel], goals: Goals, *, seed: int, device: str, surfaces: bool = True
) -> Sequence[ObjectModel]:
    """Objects as a policy knows them: as they are, by their samples, or by a scan of these.

    Without ``surfaces`` none is laid through the points: they are all that is known.
    """
    if goals == "mesh":
        return objects
    rng = np.random.default_rng(seed)
    known = []
    for item in objects:
        points = item.surface_points
        if goals == "scan":
            points = scan(points, rng)
        if surfaces:
            known.append(known_by_points(item, points, device))
        else:
            known.append(replace(item, surface_points=points))
    return known
