"""Shapes and goals known by points: 500 exact ones, or those of a scan, with noise and a side missing.

The paper's goals for household objects come from a tablet's scans, which are imperfect in ways it does not
quantify (its Figure 5). Here a scan errs as much as a cloud in training may, but lastingly: the same points
are wrong in every step. The surface behind them is laid as through those of a real scan
(:mod:`vd.assets_usd.objects.scans`); the true shape is the simulation's alone.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
import warp as wp

from vd.assets_usd.objects.geometry import surface_points
from vd.assets_usd.objects.model import ObjectModel
from vd.assets_usd.objects.scans import surface_of_scan
from vd.paper import PAPER
from vd.student.cfg import StudentCfg
from vd.student.clouds import SceneClouds
from vd.vision import StudentView

NOISE_M = PAPER.cloud.jitter_std_m
"""Standard deviation of a scanned point along each axis [m]."""
MISSING = PAPER.cloud.dropout_ratio[1]
"""Share of the points that are missing, all on one side."""


def scan(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Samples of a shape as a scan of it has them.

    Args:
        points: Samples [m], shape [K, 3], body frame.
        rng: Where randomness comes from.

    Returns:
        As many points: those of the missing side are replaced by others, and all are noisy.
    """
    side = rng.normal(size=3)
    seen = np.argsort(points @ side)[: round(len(points) * (1.0 - MISSING))]
    again = rng.choice(seen, len(points) - len(seen))
    noise = rng.normal(scale=NOISE_M, size=points.shape).astype(points.dtype)
    return points[np.concatenate([seen, again])] + noise


def known_by_points(item: ObjectModel, points: np.ndarray, device: str) -> ObjectModel:
    """An object as points of it tell: the surface through them and its samples, in the frame of the true one.

    Args:
        item: The object.
        points: Points [m], shape [K, 3], body frame.
        device: Warp device.
    """
    vertices, faces = surface_of_scan(points, device)
    samples = surface_points(vertices, faces, len(item.surface_points))
    return replace(
        item,
        vertices=vertices.astype(np.float32),
        faces=faces,
        surface_points=samples.astype(np.float32),
    )


class KnownByPoints(StudentView):
    """What a student sees that knows each object by one set of points."""

    def __init__(self, env: Any, network: StudentCfg, *, exact: bool, seed: int = 0, **settings: Any):
        """Lay surfaces through the points.

        Args:
            env: The environment.
            network: What of the student concerns its clouds.
            exact: Take the object's own samples, or a scan of them.
            seed: Of the scans, and of noise and camera.
            settings: Those of :class:`vd.vision.StudentView`.
        """
        rng = np.random.default_rng(seed)
        scanned = [
            known_by_points(
                item, item.surface_points if exact else scan(item.surface_points, rng), env.device
            )
            for item in env.objects
        ]
        super().__init__(env, network, seed=seed, known=scanned, **settings)
        scene = env.scene
        self._scanned = SceneClouds(
            env.hand,
            scanned,
            link_body=scene.link_body,
            object_body=scene.object_body,
            world_object=scene.world_object,
            world_scale=scene.world_scale,
            device=env.device,
        )

    def points(self, frame: Mapping[str, torch.Tensor], worlds: torch.Tensor | None = None) -> torch.Tensor:
        """Clouds as of the base class, with the scanned goal in its columns."""
        points = super().points(frame, worlds)
        goal = self._scanned.goal
        scanned = torch.empty((len(points), self._scanned.item.start, 3), device=self.device)
        self._scanned.write(
            wp.from_torch(scanned, dtype=wp.vec3),
            wp.from_torch(frame["body_q"].contiguous(), dtype=wp.transform),
            wp.from_torch(frame["goal_quat"].contiguous(), dtype=wp.quat),
            with_object=False,
            worlds=None if worlds is None else wp.from_torch(worlds.int()),
        )
        points[:, goal] = scanned[:, goal]
        return points
