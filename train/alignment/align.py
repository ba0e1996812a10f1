"""A network learns to turn a goal's cloud onto what a camera sees of an object, on ever new shapes.

Clouds are made from shapes (:mod:`.shapes`) and from what hides them (:mod:`.views`), without
simulation. In stage 1 others are what a camera saw in simulation while the policy acted
(:mod:`.looks`).
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vd.command.config import to_dict
from vd.paper import PAPER
from vd.train.alignment.config import ALIGNMENT_NAME, AlignCfg
from vd.train.alignment.looks import SimulatedLooks
from vd.train.checkpoint import save_checkpoint
from vd.train.config import RunCfg
from vd.train.student.bank import ShapeBank
from vd.train.student.views import Hands, Pairs, draw_pairs, joined
from vd.train.supervised import SupervisedLoop
from vd.vision.alignment import Aligner, AlignmentNetwork, Residual
from vd.vision.rotations import chord, turn_angle
from vd.vision.saved import AlignmentSpec, alignment_export

CLOUDS = 5
"""Points of a shape, in clouds: one is the goal's, of the others the camera sees a part."""
OFFSET_WEIGHT = 10.0
"""Of the offset [1/m]: a centimetre counts as 0.1 rad, which moves the surface by about as much."""
WITHIN_RAD = (PAPER.success.rotation_rad, PAPER.success.precise_rad)
"""Errors within which the paper counts a goal as reached."""
NEAR_SHARE = 0.5
"""Share of pairs that are less than 0.9 rad apart, as in later passes; others are anywhere."""
SCAN_SHARE = 0.25
"""Share of goals as from scans: 4 mm of noise, and a fifth of the surface missing."""
SEARCHED_SHARE = 0.5
"""Share of pairs whose goals are first turned as the network says, half of them twice, as later
passes meet them."""
SIMULATED_SHARE = 0.5
"""Stage 1: share of pairs that are of what was seen in simulation; others are made."""


def alignment_losses(residual: Residual, pairs: Pairs) -> tuple[dict[str, Tensor], Tensor]:
    """Losses by name, means over the batch, and errors of the rotations [rad] [B]."""
    wrong = residual.rotation.detach().mT @ pairs.rotation
    error = turn_angle(wrong)
    losses = {
        "rotation": chord(residual.rotation, pairs.rotation).mean(),
        "offset": OFFSET_WEIGHT * (residual.offset - pairs.offset).norm(dim=-1).mean(),
    }
    return losses, error


class AlignTrainer(SupervisedLoop):
    """Trains the network of alignment.

    A run that goes on has its weights, optimiser and random state; its shapes, episodes and looks
    are begun anew.

    Args:
        bank: Shapes to learn from.
        held_out: Shapes that are only measured, by name of the set: points [m] and normals
            [O, P, 6].
        hands: What hides shapes.
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
        bank: ShapeBank,
        held_out: dict[str, Tensor],
        hands: Hands,
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
            cfg,
            measure_every=cfg.validate_every,
            task=task,
            device=device,
        )
        self.bank = bank
        self.held_out = held_out
        self.hands = hands
        self.cfg = cfg
        self.looks = looks
        self.spec = spec
        self._half = torch.autocast(
            torch.device(self.device).type, torch.bfloat16, enabled=cfg.precision == "bf16"
        )

    def _samples(self) -> int:
        return self.cfg.batch * self.cfg.steps

    def _iterate(self) -> dict[str, Any] | None:
        acted: dict[str, float] = {}
        if self.looks is not None:
            collected = self.looks.collect(self._stopping)
            if collected is None:
                return None
            acted = self._read(collected)
        if self.iteration:
            self.bank.renew(self.cfg.fresh_shapes)
        done = self._done()
        steps = []
        for _ in range(self.cfg.steps):
            if self._stopping():
                return None
            steps.append(self._step(done))
        return self._figures(steps) | acted

    def pairs(self) -> Pairs:
        """A batch to learn from."""
        points = self.cfg.points
        shares = {"near": NEAR_SHARE, "scans": SCAN_SHARE}
        simulated = 0 if self.looks is None else round(SIMULATED_SHARE * self.cfg.batch)
        shapes = self.bank.draw(self.cfg.batch - simulated)
        made = draw_pairs(self.hands, shapes, points, **shares)
        if self.looks is None:
            return made
        return joined(made, self.looks.pairs(simulated, points, **shares))

    @torch.no_grad()
    def searched(self, pairs: Pairs, near: Sequence[Tensor]) -> Pairs:
        """Pairs of which some goals are turned as the network says, once or twice.

        As a search meets them.

        The neighbours of both clouds, ``near``, stay.
        """
        goal = pairs.goal.clone()
        rotation = pairs.rotation.clone()
        surface = pairs.surface.clone()
        order = torch.randperm(len(goal), device=goal.device)
        rows = order[: round(SEARCHED_SHARE * len(goal))]
        most = math.ceil(0.75 * len(rows))  # of both passes: half of the rows take both
        for some in (rows[:most], rows[len(rows) - most :]):
            neighbours = [index[some] for index in near]
            with self._half:
                residual = self.network(goal[some], pairs.seen[some], neighbours)
            back = residual.rotation.mT
            for turned in (goal, rotation, surface):
                turned[some] = turned[some] @ back
        return replace(pairs, goal=goal, rotation=rotation, surface=surface)

    def _step(self, done: float) -> dict[str, Tensor]:
        pairs = self.pairs()
        near = list(map(self.network.neighbours, (pairs.goal, pairs.seen)))
        pairs = self.searched(pairs, near)
        with self._half:
            residual = self.network(pairs.goal, pairs.seen, near)
        losses, error = alignment_losses(residual, pairs)
        logged = self._descend(losses, done, list(self.network.parameters()))
        return logged | {"alignment/rotation_error": error.median()}

    @torch.no_grad()
    def measure(self) -> dict[str, Tensor]:
        """Figures of first looks at shapes not learned from, whole goals and scans.

        Processes share them.

        Medians are means of the processes' medians.
        """
        figures = {}
        for name, shapes in self.held_out.items():
            processes = self.world_size * (4 if name == "made" else 1)
            views = shapes.repeat(max(1, self.cfg.views // processes), 1, 1)
            for kind, scans in (("", 0.0), ("_scans", 1.0)):
                error, offset = self._errors(views, scans)
                figures[f"{name}{kind}/rotation_error"] = error.median()
                figures[f"{name}{kind}/offset_error"] = offset.median()
                for bound in WITHIN_RAD:
                    figures[f"{name}{kind}/within_{bound:g}"] = (error < bound).float().mean()
        return figures

    def _errors(self, shapes: Tensor, scans: float) -> tuple[Tensor, Tensor]:
        """Errors of first looks: angles [rad] and distances [m] [S]."""
        errors = []
        offsets = []
        for some in shapes.split(max(1, self.cfg.batch // 8)):
            pairs = draw_pairs(self.hands, some, self.cfg.points, scans=scans)
            alignment = Aligner(self.network, pairs.goal).look(pairs.seen)
            errors.append(turn_angle(alignment.rotation.mT @ pairs.rotation))
            offsets.append((alignment.position - pairs.offset).norm(dim=-1))
        return torch.cat(errors), torch.cat(offsets)

    def _shared_state(self) -> dict[str, Any]:
        return super()._shared_state() | {"spec": to_dict(self.spec)}

    def close(self) -> None:
        """Free the environments."""
        if self.looks is not None:
            self.looks.close()

    def _save_policy(self, path: Path, state: dict[str, Any]) -> None:
        save_checkpoint(self.run.out / ALIGNMENT_NAME, alignment_export(state))
