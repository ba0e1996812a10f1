"""Stage 0: a network learns to turn a goal's cloud onto what a camera sees of an object, on ever new shapes.

No simulation: clouds are made from shapes (:mod:`.shapes`) and from what hides them (:mod:`.views`).
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import trimesh
from torch import nn

from vd.assets_usd.objects.model import ObjectModel
from vd.train.checkpoint import save_checkpoint
from vd.train.config import RunCfg
from vd.train.loop import check_update
from vd.train.student.config import ALIGNMENT_NAME, AlignCfg
from vd.train.student.runner import StudentRunner
from vd.train.student.shapes import made_shapes, mesh_shapes
from vd.train.student.views import Hands, Pairs, draw_pairs
from vd.vision.alignment import Aligner, AlignmentNetwork, Residual
from vd.vision.rotations import turn_angle
from vd.vision.saved import alignment_export

MESH_POINTS = 6000
"""Points kept of a mesh: of them each deformed copy draws its own."""
CLOUDS = 5
"""Points of a shape, in clouds: one is the goal's, of the others the camera sees a part."""
SHAPES_AT_ONCE = 128
"""Shapes made at a time: their bodies' points take 0.5 GB."""
ERROR_WEIGHT = 0.3
"""Of the predicted error [1/rad] against the chord of the rotation: it is read from the same summary, and
chooses among hypotheses only."""
OFFSET_WEIGHT = 10.0
"""Of the offset [1/m]: a centimetre counts as 0.1 rad, which moves the surface by about as much."""
GRAD_NORM = 1.0
"""Gradient norm is clipped to this."""
LEAST_RATE = 0.02
"""Of the learning rate, at the end of the run."""
WITHIN_RAD = (0.4, 0.1)
"""Errors within which the paper counts a goal as reached."""
SAME_SURFACE_M = 0.004
"""Mean distance of the turned goal to the wanted surface within which both look alike: of a symmetric object
they do in several orientations."""
UNSEEN_SHAPES = 64
"""Made shapes that are never trained on."""
LOWER_RATES = "lower --align.learning-rate, or take --align.precision fp32"
"""Remedy for a network that diverges."""


def mesh_points(objects: Sequence[ObjectModel], count: int, device: torch.device) -> torch.Tensor:
    """Points [m] and normals of objects' surfaces, even in area [O, count, 6]."""
    rows = []
    for item in objects:
        mesh = trimesh.Trimesh(item.vertices, item.faces, process=False)
        points, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
        both = [torch.as_tensor(x, dtype=torch.float32) for x in (points, mesh.face_normals[faces])]
        rows.append(torch.cat(both, dim=1))
    shapes = torch.stack(rows)
    shapes[..., :3] -= shapes[..., :3].mean(dim=1, keepdim=True)
    return shapes.to(device)


class ShapeBank:
    """Shapes in memory, half of them made, half of them meshes deformed; some are replaced every so often.

    Args:
        meshes: Points and normals of objects [O, P', 6].
        count: K.
        points: P, points of each.
    """

    def __init__(self, meshes: torch.Tensor, count: int, points: int) -> None:
        self._meshes, self._oldest = meshes, 0
        self._shapes = torch.empty((count, points, 6), dtype=torch.half, device=meshes.device)
        self.renew(count)

    def renew(self, count: int) -> None:
        """Replace the oldest ``count`` shapes."""
        size, points = self._shapes.shape[:2]
        while count > 0:
            some = min(SHAPES_AT_ONCE, count)
            half = (some + 1) // 2
            made = made_shapes(half, points, self._meshes.device)
            shapes = torch.cat([made, mesh_shapes(self._meshes, some - half, points)])
            rows = (self._oldest + torch.arange(some, device=shapes.device)) % size
            self._shapes[rows] = shapes.half()
            self._oldest, count = (self._oldest + some) % size, count - some

    def draw(self, count: int) -> torch.Tensor:
        """Points [m] and normals of shapes drawn at random [count, P, 6]."""
        return self._shapes[torch.randint(len(self._shapes), (count,), device=self._shapes.device)]


@dataclass(frozen=True)
class Scenes:
    """Where pairs come from."""

    bank: ShapeBank
    """What is learned from."""
    hands: Hands
    """What hides it."""
    held_out: dict[str, torch.Tensor]
    """Shapes that are only measured, by name of the set: points [m] and normals [O, P, 6]."""


def make_scenes(
    objects: Sequence[ObjectModel], held_out: Sequence[ObjectModel], hands: Hands, cfg: AlignCfg
) -> Scenes:
    """Shapes to learn from and shapes to measure on.

    Args:
        objects: Objects to learn from, deformed.
        held_out: Objects to measure on, as they are; may be none.
        hands: What hides shapes.
        cfg: Settings.
    """
    device, points = hands.eye.device, CLOUDS * cfg.points
    sets = {"made": made_shapes(UNSEEN_SHAPES, points, device)}
    if held_out:
        sets["validation"] = mesh_points(held_out, points, device)
    meshes = mesh_points(objects, max(MESH_POINTS, points), device)
    return Scenes(ShapeBank(meshes, cfg.shapes, points), hands, sets)


def alignment_losses(found: Residual, pairs: Pairs) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Losses by name, means over the batch, and the angles by which rotations are wrong [rad] [B].

    The chord between rotations is robust: of goals that look alike it chooses one, and gives no mean of them.
    """
    wrong = found.rotation.detach().transpose(-1, -2) @ pairs.rotation
    error = turn_angle(wrong)
    chord = ((found.rotation - pairs.rotation).square().sum((-1, -2)) + 1e-6).sqrt()
    losses = {
        "rotation": chord.mean(),
        "error": ERROR_WEIGHT * (found.error - error).abs().mean(),
        "offset": OFFSET_WEIGHT * (found.offset - pairs.offset).norm(dim=-1).mean(),
    }
    return losses, error


class AlignTrainer(StudentRunner):
    """Trains the network of alignment.

    A run that goes on has its weights, optimiser and random state; its shapes are made anew.

    Args:
        scenes: Where pairs come from.
        network: The network.
        cfg: Settings.
        run: Run settings.
        **kept: What :class:`StudentRunner` keeps with the network, and its device and deadline.
    """

    def __init__(
        self, scenes: Scenes, network: AlignmentNetwork, cfg: AlignCfg, run: RunCfg, **kept: Any
    ) -> None:
        super().__init__(network, {}, run, **kept)
        self.scenes, self.cfg, self.network = scenes, cfg, network
        self._compare: nn.Module | Any = torch.compile(network) if cfg.compile else network
        self._half = torch.autocast(
            torch.device(self.device).type, torch.bfloat16, enabled=cfg.precision == "bf16"
        )
        self._started = time.monotonic()

    def _samples(self) -> int:
        return self.cfg.batch * self.cfg.steps

    def _begin(self) -> None:
        super()._begin()
        self._started = time.monotonic()

    def _iterate(self) -> dict[str, Any] | None:
        cfg = self.cfg
        self.network.train()
        if self.iteration:
            self.scenes.bank.renew(cfg.fresh_shapes)
        done, rows = self._done(), []
        for _ in range(cfg.steps):
            if self._stopping():
                return None
            rows.append(self._step(done))
        means = {name: torch.stack([row[name] for row in rows]).mean() for name in rows[0]}
        count = self.iteration + 1
        if count % cfg.validate_every == 0 or count == self.total_iterations:
            means |= self.measure()
        figures = self._read(means)
        check_update(figures, self.networks, LOWER_RATES)
        return dict(figures)

    def pairs(self) -> Pairs:
        """A batch to learn from."""
        cfg = self.cfg
        shapes = self.scenes.bank.draw(cfg.batch)
        return draw_pairs(self.scenes.hands, shapes, cfg.points, near=cfg.near_share, scans=cfg.scan_share)

    def _step(self, done: float) -> dict[str, torch.Tensor]:
        pairs = self.pairs()
        with self._half:
            found = self._compare(pairs.goal, pairs.seen)
        losses, error = alignment_losses(found, pairs)
        warm = min(1.0, (self._steps_done + 1) / max(1, self.cfg.warmup_steps))
        rate = self.cfg.learning_rate * warm * max(LEAST_RATE, 0.5 * (1.0 + math.cos(math.pi * done)))
        norm = self._descend(torch.stack(tuple(losses.values())).sum(), rate=rate, grad_norm=GRAD_NORM)
        logged = {f"loss/{name}": loss.detach() for name, loss in losses.items()}
        return logged | {"loss/grad_norm": norm, "student/rotation_error": error.median()}

    def _done(self) -> float:
        """Share of the run that is done, by clouds or by time, whichever is more; all processes agree."""
        share = self.env_steps / max(1, self.run.max_steps)
        if self._deadline is not None:
            length = max(1e-3, self._deadline - self._started)
            share = max(share, (time.monotonic() - self._started) / length)
        if self.is_distributed:
            agreed = torch.tensor(share, device=self.device)
            torch.distributed.all_reduce(agreed, op=torch.distributed.ReduceOp.MAX)
            share = float(agreed)
        return min(1.0, share)

    @torch.no_grad()
    def measure(self) -> dict[str, torch.Tensor]:
        """Figures of first looks at whole goals of shapes not learned from; processes share the views.

        Medians are means of the processes' medians.
        """
        self.network.eval()
        figures = {}
        for name, shapes in self.scenes.held_out.items():
            views = max(1, self.cfg.views // (self.world_size * (4 if name == "made" else 1)))
            error, offset, surface = self._errors(shapes.repeat(views, 1, 1))
            figures[f"{name}/rotation_error"] = error.median()
            for bound in WITHIN_RAD:
                figures[f"{name}/within_{bound:g}"] = (error < bound).float().mean()
            figures[f"{name}/same_surface"] = (surface < SAME_SURFACE_M).float().mean()
            figures[f"{name}/offset_error"] = offset.median()
        return figures

    def _errors(self, shapes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Errors of a first look: rotation [rad], place [m], distance of the surfaces [m], [B] each."""
        parts = []
        for some in shapes.split(max(1, self.cfg.batch // 8)):
            pairs = draw_pairs(self.scenes.hands, some, self.cfg.points)
            found = Aligner(self.network, pairs.goal, self.cfg.search).look(pairs.seen)
            wrong = found.rotation.transpose(-1, -2) @ pairs.rotation
            apart = torch.cdist(pairs.goal @ wrong, pairs.surface).amin(dim=-1).mean(dim=-1)
            parts.append((turn_angle(wrong), (found.position - pairs.offset).norm(dim=-1), apart))
        error, offset, surface = (torch.cat(values) for values in zip(*parts, strict=True))
        return error, offset, surface

    def _own_state(self) -> dict[str, Any]:
        return {}

    def _load_own_state(self, state: dict[str, Any]) -> None:
        """Nothing: shapes are made anew."""

    def _misfit(self, ranks: list[dict[str, Any]]) -> str:
        return ""

    def _save_policy(self, path: Path, state: dict[str, Any]) -> None:
        save_checkpoint(self.run.out / ALIGNMENT_NAME, alignment_export(state))
