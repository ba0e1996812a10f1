"""Stage 0: the encoder learns to read random scenes, without simulation (Supplementary, visual pre-training).

R clouds a batch, D joints, O objects, E the embedding. World frame: z up; quaternions xyzw.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import nn

from vd.assets_usd.hand_data import HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.clouds import HandKinematics, SceneClouds
from vd.paper import PAPER
from vd.quaternions import relative_rotation, rotation_distance
from vd.sim.scene import hand_mount
from vd.train.config import RunCfg
from vd.train.loop import check_update
from vd.train.student.config import PretrainCfg
from vd.train.student.rotations import angle_between, multiply, random_rotations, rotations_about, two_columns
from vd.train.student.runner import StudentRunner, scheduled
from vd.vision.cfg import NoiseCfg, StudentCfg
from vd.vision.network import Student
from vd.vision.sites import Sites
from vd.vision.voxels import Voxeliser

OBJECT_RANGE_M = ((-0.06, 0.06), (-0.06, 0.06), (0.02, 0.16))
"""Where objects are in random scenes, world frame: from the table to the palm, as wide as the claw opens."""
NEAR_SHARE = 0.5
"""Share of goals at an angle uniform in [0, pi] (ours). The others are uniform on SO(3), where near goals are
rare: 1 in 300 lies within 0.4 rad."""
HEAD_HIDDEN = PAPER.student.distance_hidden
"""Width of the prediction heads, as of the student's distance head."""
LOWER_RATES = "lower --pretrain.learning-rate, or take --pretrain.precision fp32"
"""Remedy for a network that diverges."""


class RandomScenes:
    """Draws scenes, which are seen whole: joints within their limits, any object at any pose, any goal.

    Args:
        hand: The hand.
        objects: The objects.
        network: What of the student concerns its clouds.
        scales: Sizes of objects, factors; each is as likely as the others.
        noise: Augmentation; none by default.
        batch: R.
        seed: Of the augmentation; scenes come from torch's generator.
        device: Warp device.
    """

    def __init__(
        self,
        hand: HandModel,
        objects: Sequence[ObjectModel],
        network: StudentCfg,
        *,
        scales: Sequence[float] = (1.0,),
        noise: NoiseCfg | None = None,
        batch: int,
        seed: int = 0,
        device: str,
    ) -> None:
        links = len(hand.link_names)
        self._objects, self._batch = len(objects), batch
        self._device = torch.device(wp.device_to_torch(device))
        self._scales, self._augment = len(scales), noise is not None
        # A "world" for each object in each size.
        self._clouds = SceneClouds(
            hand,
            objects,
            world_object=np.repeat(np.arange(len(objects)), len(scales)),
            world_scale=np.tile(scales, len(objects)),
            link_body=np.arange(links),
            object_body=links,
            device=device,
        )
        self._marks = self._clouds.ends if network.marked else ()
        self._kinematics = HandKinematics(hand, link_body=np.arange(links), base=hand_mount(), device=device)
        self._voxelise = Voxeliser(network.voxel_m, noise=noise, clouds=batch, seed=seed, device=device)
        self._body_q = wp.zeros((batch, links + 1), dtype=wp.transform, device=device)
        self._points = wp.full(
            (batch, self._clouds.item.stop), wp.vec3(math.nan), dtype=wp.vec3, device=device
        )
        self._lower = torch.as_tensor(hand.lower, dtype=torch.float32, device=self._device)
        self._span = torch.as_tensor(hand.upper, dtype=torch.float32, device=self._device) - self._lower
        low, high = np.array(OBJECT_RANGE_M).T
        self._box = torch.tensor(np.array([low, high - low]), dtype=torch.float32, device=self._device)
        self.joint_scale_rad = 0.5 * self._span
        """Radians of one unit of scaled joint positions [D]."""

    def draw(self) -> tuple[Sites, dict[str, torch.Tensor]]:
        """A batch of scenes.

        Returns:
            Voxels, and the targets: ``category`` [R], ``distance`` [R] [rad], ``rotation`` [R, 6] (first two
            columns of the matrix of q_object conj(q_goal)), ``joints`` [R, D] in [-1, 1].
        """
        count, device = self._batch, self._device
        share = torch.rand((count, len(self._lower)), device=device)
        envs = torch.randint(self._objects * self._scales, (count,), device=device)
        orientation = random_rotations(count, device)
        goal = random_rotations(count, device)
        near = torch.rand((count, 1), device=device) < NEAR_SHARE
        turn = rotations_about(goal[:, :3], math.pi * torch.rand(count, device=device))
        goal = torch.where(near, multiply(turn, orientation), goal)
        position = self._box[0] + self._box[1] * torch.rand((count, 3), device=device)
        self._kinematics.write(wp.from_torch((self._lower + share * self._span).contiguous()), self._body_q)
        wp.to_torch(self._body_q)[:, -1] = torch.cat([position, orientation], dim=1)
        self._clouds.write(
            self._points,
            self._body_q,
            wp.from_torch(goal.contiguous(), dtype=wp.quat),
            envs=wp.from_torch(envs.int()),
        )
        sites = self._voxelise(self._points, augment=self._augment, ends=self._marks)
        targets = {
            "category": envs // self._scales,
            "distance": rotation_distance(orientation, goal),
            "rotation": two_columns(relative_rotation(orientation, goal)),
            "joints": 2.0 * share - 1.0,
        }
        return sites, targets

    def state_dict(self) -> dict[str, Any]:
        """Random states of the augmentation."""
        return {"noise": self._voxelise.rng.numpy().copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore it."""
        self._voxelise.rng.assign(state["noise"])


class Pretrainer(StudentRunner):
    """Trains the encoder of a student on random scenes: which object, how it is turned, the joints.

    Each is read from the embedding by a head of the training alone. What follows the encoder keeps its random
    weights.

    Args:
        scenes: Where clouds and targets come from.
        student: The network.
        objects: Number of objects O.
        cfg: Settings.
        run: Run settings.
        **kept: What :class:`StudentRunner` keeps with the student, and its device and deadline.
    """

    def __init__(
        self,
        scenes: RandomScenes,
        student: Student,
        objects: int,
        cfg: PretrainCfg,
        run: RunCfg,
        **kept: Any,
    ) -> None:
        width, sizes = student.cfg.encoder.embedding, {"category": objects, "rotation": 6}
        heads: dict[str, nn.Module] = {
            name: nn.Sequential(nn.Linear(width, HEAD_HIDDEN), nn.GELU(), nn.Linear(HEAD_HIDDEN, outputs))
            for name, outputs in (sizes | {"joints": student.num_actions}).items()
        }
        super().__init__(student, heads, run, **kept)
        self.scenes, self.cfg = scenes, cfg

    def _samples(self) -> int:
        return self.cfg.batch * self.cfg.steps

    def _iterate(self) -> dict[str, Any] | None:
        self.student.train()
        rows = []
        for _ in range(self.cfg.steps):
            if self._stopping():
                return None
            rows.append(self._step())
        means = {name: torch.stack([row[name] for row in rows]).mean() for name in rows[0]}
        self._share_statistics()
        figures = self._read(means)
        check_update(figures, self.networks, LOWER_RATES)
        return dict(figures)

    def losses(
        self, sites: Sites, targets: dict[str, torch.Tensor]
    ) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
        """Losses of a batch by name, and figures to log."""
        embedding = self._encode(sites, self.cfg.precision)
        found = {name: head(embedding) for name, head in self.heads.items()}
        losses = {
            "category": nn.functional.cross_entropy(found["category"], targets["category"]),
            "rotation": (found["rotation"] - targets["rotation"]).square().mean(),
            "joints": (found["joints"] - targets["joints"]).square().mean(),
        }
        with torch.no_grad():
            right = found["category"].argmax(dim=1) == targets["category"]
            radians = (found["joints"] - targets["joints"]) * self.scenes.joint_scale_rad
            figures = {
                "student/category": right.float().mean(),
                "student/rotation_error": angle_between(found["rotation"], targets["rotation"]).mean(),
                "student/distance_error": (angle_between(found["rotation"]) - targets["distance"])
                .abs()
                .mean(),
                "student/joint_error": radians.square().mean().sqrt(),
            }
        return losses, figures

    def _own_state(self) -> dict[str, Any]:
        return {"scenes": self.scenes.state_dict()}

    def _load_own_state(self, state: dict[str, Any]) -> None:
        self.scenes.load_state_dict(state["scenes"])

    def _misfit(self, ranks: list[dict[str, Any]]) -> str:
        batches = {len(rank["scenes"]["noise"]) for rank in ranks}
        if batches == {self.cfg.batch}:
            return ""
        return f"it is of batches of {max(batches)} clouds, this run has {self.cfg.batch}"

    def _step(self) -> dict[str, torch.Tensor]:
        losses, figures = self.losses(*self.scenes.draw())
        cfg, total = self.cfg, torch.stack(tuple(losses.values())).sum()
        rate = scheduled(cfg.learning_rate, self._steps_done + 1, decay_after=cfg.decay_after_steps)
        norm = self._descend(total, rate=rate, grad_norm=PAPER.dagger.grad_norm)
        logged = {f"loss/{name}": loss.detach() for name, loss in losses.items()}
        return figures | logged | {"loss/grad_norm": norm}
