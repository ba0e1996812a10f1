"""Convex decomposition of a mesh: CoACD in a child process with a limit of processor time."""

import os
import resource
import signal
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from vd.assets_usd.objects.geometry import (
    SLIVER_THICKNESS,
    Hull,
    Surface,
    convex_hull,
    hull_volume,
    sides_along_axes,
    simplify_hull,
)
from vd.assets_usd.objects.settings import LEAST_THRESHOLD, ImportSettings
from vd.command.interrupt import end_with_parent
from vd.command.workers import end_worker

HULL_VERTICES = 32
"""Most vertices of a part."""

SLIVER_VOLUME = 1e-3
"""A part smaller than this share of all parts is dropped: it costs a collision shape and holds
nothing.
"""

GOOD_ERROR = 0.15
"""Parts that differ from the mesh by at most this share of its volume are good: most shapes meet it
with few parts, and simplifying each part to 32 vertices alone takes 5 %."""

USUAL_HULLS = 8
"""Parts tried first: enough for most shapes, and each part is a collision shape in every world."""

FINE_THRESHOLD = 0.4
FINE_HULLS = 96
"""Factor on the threshold, and most parts, of the fine decomposition from which parts are merged
where the first is not good."""

MERGED_HULLS = (32, 24, 16, 12, 8)
"""Numbers of parts to which a fine decomposition is merged. What is thin or a ring needs 16 and
more.
"""

NEARLY = 1.1
"""More parts are not taken for an error less than a tenth smaller, unless it becomes good."""

RUNS = 2
"""Most runs of CoACD for one mesh."""


@dataclass(frozen=True)
class Decomposition:
    """Convex parts and how they came about.

    Attributes:
        hulls: The parts.
        method: ``coacd``, ``coacd, merged`` or ``one hull``.
        fallback: What fell back, and why; empty for a full result.
        error: :func:`vd.assets_usd.objects.bodies.error_of_parts`.
    """

    hulls: tuple[Hull, ...]
    method: str
    fallback: str = ""
    error: float = 0.0


def _coacd_parts(surface: Surface, settings: ImportSettings, max_vertices: int) -> list[np.ndarray]:
    """Vertices of CoACD's parts."""
    import coacd

    coacd.set_log_level("off")
    parts = coacd.run_coacd(
        coacd.Mesh(surface.vertices.astype(np.float64), surface.faces.astype(np.int32)),
        threshold=settings.threshold,
        max_convex_hull=settings.max_hulls,
        preprocess_mode="auto",
        mcts_iterations=settings.mcts_iterations,
        max_ch_vertex=max_vertices,
        seed=0,
    )
    return [vertices for vertices, _ in parts]


def _limited(parent: int, seconds: float) -> None:
    """Let this process end with its limit of processor time, or with its parent."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # at once: CoACD does not listen
    end_with_parent(parent)
    limit = int(time.process_time()) + max(1, round(seconds))
    resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # Threads that wait for each other take no processor time.
    os.environ["OMP_WAIT_POLICY"] = "passive"
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _parts_or_reason(seconds: float, *arguments: Any) -> list[np.ndarray] | str:
    """CoACD's parts, or why there are none, from a child process.

    It may take too long, or crash.
    """
    child = ProcessPoolExecutor(1, get_context("fork"), _limited, (os.getpid(), seconds))
    try:
        return child.submit(_coacd_parts, *arguments).result() or "CoACD returned no part"
    except BrokenProcessPool:
        return f"no result after {seconds:g} s of processor time (--time-limit), or it crashed"
    except Exception as error:  # whatever CoACD raises
        return f"{type(error).__name__}: {error}"
    finally:
        end_worker(child)


def tidy_hulls(parts: Sequence[np.ndarray], max_vertices: int) -> tuple[Hull, ...]:
    """Convex hulls of parts, without slivers, each of at most ``max_vertices`` vertices."""
    size = float(np.ptp(np.concatenate(parts), axis=0).max())
    volumes = np.array(list(map(hull_volume, parts)))
    kept = []
    for part, volume in zip(parts, volumes, strict=True):
        if volume > SLIVER_VOLUME * volumes.sum():
            hull = convex_hull(part)
            if sides_along_axes(hull.vertices).min() > SLIVER_THICKNESS * size:
                kept.append(simplify_hull(hull, max_vertices))
    return tuple(kept)


def decompose(
    surface: Surface, settings: ImportSettings, max_vertices: int = HULL_VERTICES
) -> Decomposition:
    """Split a mesh into convex parts: by CoACD in a child process, or its convex hull alone.

    Args:
        surface: The mesh [m].
        settings: Its limits.
        max_vertices: Most vertices of a part.
    """
    parts = _parts_or_reason(settings.time_limit, surface, settings, max_vertices)
    why = "it gave only slivers"
    if isinstance(parts, str):
        why = parts
    elif hulls := tidy_hulls(parts, max_vertices):
        return Decomposition(hulls, "coacd")
    hull = simplify_hull(convex_hull(surface.vertices), max_vertices)
    why = f"coacd failed: {why}; one convex hull stands for the whole mesh"
    return Decomposition((hull,), "one hull", why)


def merge_parts(parts: Sequence[np.ndarray], most: int) -> list[np.ndarray]:
    """Parts [V, 3] merged to at most ``most``.

    Each time the two are merged whose common hull adds the least volume.

    CoACD merges by the depth of concavities, and fills thin walls and rings more than it has to.
    """
    corners = dict(enumerate(parts))
    volume = {i: hull_volume(part) for i, part in corners.items()}
    together: dict[tuple[int, int], float] = {}

    def pair(i: int, others: Iterable[int]) -> None:
        for j in others:
            together[i, j] = hull_volume(np.concatenate([corners[i], corners[j]]))

    for i in corners:
        pair(i, range(i))
    while len(corners) > most:
        i, j = min(together, key=lambda key: together[key] - volume[key[0]] - volume[key[1]])
        new = max(corners) + 1
        others = [k for k in corners if k not in (i, j)]
        volume[new] = together[i, j]
        both = np.concatenate([corners.pop(i), corners.pop(j)])
        corners[new] = both[ConvexHull(both).vertices]
        for key in [key for key in together if i in key or j in key]:
            del together[key]
        pair(new, others)
    return list(corners.values())


def best_decomposition(
    surface: Surface,
    settings: ImportSettings,
    error_of: Callable[[Sequence[Hull]], float],
) -> Decomposition:
    """Few parts if these are good.

    Else parts merged from a fine decomposition, as many as are needed.

    Args:
        surface: The mesh [m].
        settings: Limits; its threshold is that of the first decomposition.
        error_of: Error of parts.
    """
    few = min(USUAL_HULLS, settings.max_hulls)
    first = decompose(surface, replace(settings, max_hulls=few))
    first = replace(first, error=error_of(first.hulls))
    if first.error <= GOOD_ERROR or first.fallback:
        return first
    threshold = max(FINE_THRESHOLD * settings.threshold, LEAST_THRESHOLD)
    limits = replace(settings, max_hulls=FINE_HULLS, threshold=threshold)
    fine = decompose(surface, limits, 2 * HULL_VERTICES)
    if fine.fallback:
        return replace(first, fallback=f"no finer parts; {fine.fallback}")
    candidates = [first]
    parts = [hull.vertices for hull in fine.hulls]
    for most in MERGED_HULLS:
        if most <= settings.max_hulls:
            parts = merge_parts(parts, most)
            hulls = tidy_hulls(parts, HULL_VERTICES)
            candidates.append(Decomposition(hulls, "coacd, merged", error=error_of(hulls)))
    enough = max(GOOD_ERROR, NEARLY * min(candidate.error for candidate in candidates))
    return min(candidates, key=lambda each: (each.error > enough, len(each.hulls), each.error))
