"""A network learns to turn a goal's cloud onto what a camera sees of an object, on ever new shapes.

Clouds are made from shapes (:mod:`.shapes`) and from what hides them (:mod:`.views`), without
simulation. In stage 1 others are what a camera saw in simulation while the policy acted
(:mod:`.looks`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import nn

from vd.assets_usd.objects.model import ObjectModel
from vd.command.config import to_dict
from vd.paper import PAPER
from vd.train.alignment.config import ALIGNMENT_NAME, AlignCfg
from vd.train.alignment.looks import SimulatedLooks
from vd.train.checkpoint import save_checkpoint
from vd.train.config import RunCfg
from vd.train.loop import check_update
from vd.train.student.bank import ShapeBank, centred, mesh_points
from vd.train.student.shapes import made_shapes
from vd.train.student.views import Hands, Pairs, draw_pairs, joined
from vd.train.supervised import SupervisedLoop
from vd.vision.alignment import Aligner, AlignmentNetwork, Residual
from vd.vision.rotations import chord, turn_angle
from vd.vision.saved import AlignmentSpec, alignment_export

MESH_POINTS = 6000
"""Points kept of a mesh: of them each deformed copy draws its own."""
CLOUDS = 5
"""Points of a shape, in clouds: one is the goal's, of the others the camera sees a part."""
OFFSET_WEIGHT = 10.0
"""Of the offset [1/m]: a centimetre counts as 0.1 rad, which moves the surface by about as much."""
WITHIN_RAD = (PAPER.success.rotation_rad, PAPER.success.precise_rad)
"""Errors within which the paper counts a goal as reached."""
SAME_SURFACE_M = 0.004
"""Mean distance of the turned goal to the wanted surface within which both look alike: of a
symmetric object they do in several orientations."""
UNSEEN_SHAPES = 64
"""Made shapes that are never trained on."""
LOWER_RATES = "lower --align.learning-rate, or take --align.precision fp32"
"""Remedy for a network that diverges."""


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
        sets["validation"] = centred(mesh_points(held_out, points, device))
    meshes = centred(mesh_points(objects, max(MESH_POINTS, points), device))
    return Scenes(ShapeBank(meshes, cfg.shapes, points), hands, sets)


def alignment_losses(found: Residual, pairs: Pairs) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Losses by name, means over the batch, and the angles by which rotations are wrong [rad] [B]."""
    wrong = found.rotation.detach().transpose(-1, -2) @ pairs.rotation
    error = turn_angle(wrong)
    losses = {
        "rotation": chord(found.rotation, pairs.rotation).mean(),
        "offset": OFFSET_WEIGHT * (found.offset - pairs.offset).norm(dim=-1).mean(),
    }
    return losses, error


class AlignTrainer(SupervisedLoop):
    """Trains the network of alignment.

    A run that goes on has its weights, optimiser and random state; its shapes, episodes and looks
    are begun anew.

    Args:
        scenes: Where made pairs come from.
        network: The network.
        cfg: Settings.
        run: Run settings.
        spec: Description of the network, kept with it.
        task: The environment's configuration as a dictionary, kept with it.
        looks: What is seen in simulation; None: all pairs are made.
        device: Torch device.
    """

    kind = "alignment"
    network: AlignmentNetwork

    def __init__(
        self,
        scenes: Scenes,
        network: AlignmentNetwork,
        cfg: AlignCfg,
        run: RunCfg,
        *,
        spec: AlignmentSpec,
        task: dict[str, Any],
        looks: SimulatedLooks | None = None,
        device: str,
    ) -> None:
        super().__init__(
            network,
            run,
            learning_rate=cfg.learning_rate,
            warmup_steps=cfg.warmup_steps,
            task=task,
            device=device,
        )
        self.scenes = scenes
        self.cfg = cfg
        self.looks = looks
        self.spec = spec
        self._compare: nn.Module | Any = network
        if cfg.compile:  # for each size on its own: that of all, and that of the searched ones
            self._compare = torch.compile(network, dynamic=False)
        self._half = torch.autocast(
            torch.device(self.device).type, torch.bfloat16, enabled=cfg.precision == "bf16"
        )

    def _samples(self) -> int:
        return self.cfg.batch * self.cfg.steps

    def _iterate(self) -> dict[str, Any] | None:
        cfg, seen = self.cfg, dict[str, float]()
        if self.looks is not None:
            if (collected := self.looks.collect(self._stopping)) is None:
                return None
            seen = self._read(collected)
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
        check_update(figures, self.network, LOWER_RATES)
        return figures | seen

    def pairs(self) -> Pairs:
        """A batch to learn from."""
        cfg = self.cfg
        shares = {"near": cfg.near_share, "scans": cfg.scan_share}
        simulated = 0 if self.looks is None else round(self.looks.cfg.share * cfg.batch)
        made = self.scenes.bank.draw(cfg.batch - simulated)
        pairs = draw_pairs(self.scenes.hands, made, cfg.points, **shares)
        if self.looks is None:
            return pairs
        return joined(pairs, self.looks.pairs(simulated, cfg.points, **shares))

    @torch.no_grad()
    def searched(self, pairs: Pairs, near: Sequence[torch.Tensor]) -> Pairs:
        """Pairs of which some goals are turned as the network says, once or twice.

        As a search meets them.

        The neighbours of both clouds, ``near``, stay.
        """
        goal, rotation, surface = pairs.goal.clone(), pairs.rotation.clone(), pairs.surface.clone()
        rows = torch.randperm(len(goal), device=goal.device)[
            : round(self.cfg.searched_share * len(goal))
        ]
        most = math.ceil(0.75 * len(rows))  # of both passes: half of the rows take both
        for some in (rows[:most], rows[len(rows) - most :]):
            with self._half:
                found = self._compare(goal[some], pairs.seen[some], [index[some] for index in near])
            back = found.rotation.transpose(-1, -2)
            for turned in (goal, rotation, surface):
                turned[some] = turned[some] @ back
        return replace(pairs, goal=goal, rotation=rotation, surface=surface)

    def _step(self, done: float) -> dict[str, torch.Tensor]:
        pairs = self.pairs()
        near = [self.network.neighbours(cloud) for cloud in (pairs.goal, pairs.seen)]
        if self.cfg.searched_share > 0.0:
            pairs = self.searched(pairs, near)
        with self._half:
            found = self._compare(pairs.goal, pairs.seen, near)
        losses, error = alignment_losses(found, pairs)
        norm = self._descend(torch.stack(tuple(losses.values())).sum(), done)
        logged = {f"loss/{name}": loss.detach() for name, loss in losses.items()}
        return logged | {"loss/grad_norm": norm, "alignment/rotation_error": error.median()}

    @torch.no_grad()
    def measure(self) -> dict[str, torch.Tensor]:
        """Figures of first looks at shapes not learned from, whole goals and scans.

        Processes share them.

        Medians are means of the processes' medians.
        """
        figures = {}
        for (name, shapes), kind in product(self.scenes.held_out.items(), ("", "_scans")):
            views = max(1, self.cfg.views // (self.world_size * (4 if name == "made" else 1)))
            error, offset, surface = self._errors(
                shapes.repeat(views, 1, 1), scans=float(kind != "")
            )
            name += kind
            figures[f"{name}/rotation_error"] = error.median()
            for bound in WITHIN_RAD:
                figures[f"{name}/within_{bound:g}"] = (error < bound).float().mean()
            figures[f"{name}/same_surface"] = (surface < SAME_SURFACE_M).float().mean()
            figures[f"{name}/offset_error"] = offset.median()
        return figures

    def _errors(
        self, shapes: torch.Tensor, *, scans: float
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Errors of a first look.

        Rotation [rad], place [m], distance of the surfaces [m], [B] each.
        """
        parts = []
        for some in shapes.split(max(1, self.cfg.batch // 8)):
            pairs = draw_pairs(self.scenes.hands, some, self.cfg.points, scans=scans)
            found = Aligner(self.network, pairs.goal).look(pairs.seen)
            wrong = found.rotation.transpose(-1, -2) @ pairs.rotation
            apart = torch.cdist(pairs.goal @ wrong, pairs.surface).amin(dim=-1).mean(dim=-1)
            parts.append((turn_angle(wrong), (found.position - pairs.offset).norm(dim=-1), apart))
        error, offset, surface = (torch.cat(values) for values in zip(*parts, strict=True))
        return error, offset, surface

    def _shared_state(self) -> dict[str, Any]:
        return super()._shared_state() | {"spec": to_dict(self.spec)}

    def _close(self) -> None:
        if self.looks is not None:
            self.looks.close()

    def _save_policy(self, path: Path, state: dict[str, Any]) -> None:
        save_checkpoint(self.run.out / ALIGNMENT_NAME, alignment_export(state))
