"""Convex decomposition of a mesh: CoACD in a child process, with a time limit and fallbacks."""

import multiprocessing
import os
import queue
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vd.assets_usd.objects.geometry import (
    Hull,
    convex_hull,
    mesh_volume,
    simplify_hull,
    solid_of_hulls,
)

SLIVER_VOLUME = 1e-3
"""A part smaller than this share of all parts is dropped: it costs a collision shape and holds nothing."""

SLIVER_THICKNESS = 2e-3
"""So is a part thinner than this share of the object's longest side (0.25 mm of 12 cm)."""


@dataclass(frozen=True)
class DecomposeSettings:
    """Settings of the convex decomposition.

    Attributes:
        max_hulls: Most convex parts per object; each is a collision shape in every world.
        threshold: CoACD's concavity threshold (0.01-1; smaller is finer and slower).
        mcts_iterations: CoACD's search effort; its default of 150 is several times slower.
        max_hull_vertices: Most vertices per part.
        time_limit_s: After this, a mesh falls back to a coarser decomposition.
        seed: Seed of CoACD's search.
    """

    max_hulls: int = 8
    threshold: float = 0.08
    mcts_iterations: int = 20
    max_hull_vertices: int = 32
    time_limit_s: float = 120.0
    seed: int = 0


@dataclass(frozen=True)
class Decomposition:
    """Convex parts and how they came about.

    Attributes:
        hulls: The parts.
        method: ``coacd``, ``coacd, remeshed`` or ``one hull``.
        notes: What fell back, and why.
    """

    hulls: tuple[Hull, ...]
    method: str
    notes: tuple[str, ...]


def _coacd_child(
    answer: Any, vertices: np.ndarray, faces: np.ndarray, settings: DecomposeSettings, preprocess: str
) -> None:
    """Run CoACD and put its parts, or the reason for none, into ``answer``."""
    # The parent may be gone (killed, interrupted): never outlive the time limit.
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(int(settings.time_limit_s) + 1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    try:
        import coacd

        coacd.set_log_level("off")
        parts = coacd.run_coacd(
            coacd.Mesh(vertices, faces),
            threshold=settings.threshold,
            max_convex_hull=settings.max_hulls,
            preprocess_mode=preprocess,
            mcts_iterations=settings.mcts_iterations,
            max_ch_vertex=settings.max_hull_vertices,
            seed=settings.seed,
        )
        answer.put([np.asarray(v, dtype=np.float64) for v, _ in parts])
    except Exception as error:  # the reason travels to the parent
        answer.put(f"{type(error).__name__}: {error}")


def run_coacd(
    vertices: np.ndarray, faces: np.ndarray, settings: DecomposeSettings, preprocess: str = "auto"
) -> list[np.ndarray] | str:
    """CoACD in a child process, so that a bad mesh can neither hang nor crash the caller.

    Args:
        vertices: [V, 3].
        faces: [T, 3].
        settings: Limits.
        preprocess: CoACD's remeshing to a manifold: ``auto``, ``on`` or ``off``.

    Returns:
        The vertices of each part, or the reason why there are none.
    """
    context = multiprocessing.get_context("fork")
    answer = context.Queue()
    arguments = (answer, vertices.astype(np.float64), faces.astype(np.int32), settings, preprocess)
    child = context.Process(target=_coacd_child, args=arguments, daemon=True)
    child.start()
    waited = 0.0
    step = 0.2
    result: list[np.ndarray] | str
    try:
        while True:
            try:
                result = answer.get(timeout=step)
                break
            except queue.Empty:
                waited += step
                if waited > settings.time_limit_s:
                    return f"no result after {settings.time_limit_s:g} s"
                if not child.is_alive() and answer.empty():
                    return f"CoACD ended with exit code {child.exitcode}"
    finally:
        child.kill()
        child.join()
    if not isinstance(result, str) and not result:
        return "CoACD returned no part"
    return result


def tidy_hulls(parts: Sequence[np.ndarray], max_vertices: int) -> tuple[Hull, ...]:
    """Convex hulls of parts, without slivers, each of at most ``max_vertices`` vertices."""
    size = float(np.ptp(np.concatenate(parts), axis=0).max())
    hulls = []
    for part in parts:
        try:
            hulls.append(convex_hull(part))
        except ValueError:
            continue
    volumes = np.array([mesh_volume(*h) for h in hulls])
    kept = []
    for hull, volume in zip(hulls, volumes, strict=True):
        spread = hull.vertices - hull.vertices.mean(axis=0)
        thickness = np.ptp(spread @ np.linalg.svd(spread, full_matrices=False)[2].T, axis=0).min()
        if volume > SLIVER_VOLUME * volumes.sum() and thickness > SLIVER_THICKNESS * size:
            kept.append(simplify_hull(hull, max_vertices))
    return tuple(kept)


def decompose(vertices: np.ndarray, faces: np.ndarray, settings: DecomposeSettings) -> Decomposition:
    """Split a mesh into convex parts.

    CoACD as the mesh is; then CoACD on a remeshed copy; then the convex hull alone. Each fallback is
    noted.

    Args:
        vertices: [V, 3], m.
        faces: [T, 3].
        settings: Limits.
    """
    notes = []
    for preprocess, method in (("auto", "coacd"), ("on", "coacd, remeshed")):
        parts = run_coacd(vertices, faces, settings, preprocess)
        if isinstance(parts, str):
            notes.append(f"{method} failed: {parts}")
            continue
        hulls = tidy_hulls(parts, settings.max_hull_vertices)
        if hulls:
            return Decomposition(hulls, method, tuple(notes))
        notes.append(f"{method} gave only slivers")
    hull = simplify_hull(convex_hull(vertices), settings.max_hull_vertices)
    return Decomposition((hull,), "one hull", (*notes, "one convex hull stands for the whole mesh"))


def relative_volume_error(hulls: Sequence[Hull], volume: float) -> float:
    """|volume of the union of hulls - volume| / volume; the union by voxels (:func:`solid_of_hulls`)."""
    return abs(solid_of_hulls(hulls).volume - volume) / volume
