"""Stage 0: the encoder learns to read random scenes, without simulation (Supplementary, visual pre-training).

R clouds a batch, D joints, O objects, E the embedding. World frame: z up; quaternions xyzw.
"""

import math
from collections.abc import Callable, Sequence
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
from vd.sensors.cfg import DepthCameraCfg
from vd.sensors.depth_camera import DepthCamera
from vd.sensors.surfaces import hand_surfaces
from vd.sim.scene import hand_mount
from vd.train.ending import TrainingDivergedError
from vd.train.student.config import PretrainCfg
from vd.train.student.losses import match_loss
from vd.train.student.optimise import all_finite, autocast, descend, make_optimizer, scheduled
from vd.train.student.rotations import angle_between, multiply, random_rotations, rotations_about, two_columns
from vd.vision.cfg import NoiseCfg, StudentCfg
from vd.vision.network import Student
from vd.vision.sight import voxels
from vd.vision.sites import Sites
from vd.vision.voxels import Voxeliser

OBJECT_RANGE_M = ((-0.06, 0.06), (-0.06, 0.06), (0.02, 0.16))
"""Where objects are in random scenes, world frame: from the table to the palm, as wide as the claw opens."""
HEAD_HIDDEN = PAPER.student.distance_hidden
"""Width of the prediction heads, as of the student's distance head."""
LOWER_RATES = "lower --pretrain.learning-rate or --pretrain.grad-norm, or take --pretrain.precision fp32"
"""Remedy for a network that diverges."""
EMBEDDING_PARTS = 3
"""Parts of a split embedding: object, goal, hand."""


class RandomScenes:
    """Draws scenes: joints within their limits, any object at any pose, any goal.

    The first rows of a batch may be seen by a depth camera, the others whole. What the camera sees of is
    copied to the device once: these rows keep their objects, and have new poses in every batch.

    Args:
        hand: The hand.
        objects: The objects.
        network: What of the student concerns its clouds.
        scales: Sizes of objects, factors; each is as likely as the others.
        near_share: Share of goals at an angle uniform in [0, pi].
        noise: Augmentation; none by default.
        rendered_share: Share of the rows that are seen by a depth camera.
        depth: Its settings.
        batch: R.
        seed: Of the augmentation; scenes come from torch's generator.
        device: Warp device.

    Raises:
        ValueError: There are fewer rows for the camera than objects in their sizes.
    """

    def __init__(
        self,
        hand: HandModel,
        objects: Sequence[ObjectModel],
        network: StudentCfg,
        *,
        scales: Sequence[float] = (1.0,),
        near_share: float = 0.0,
        noise: NoiseCfg | None = None,
        rendered_share: float = 0.0,
        depth: DepthCameraCfg | None = None,
        batch: int,
        seed: int = 0,
        device: str,
    ) -> None:
        links = len(hand.link_names)
        self._objects, self._batch, self._near_share = len(objects), batch, near_share
        self._device, self._network = torch.device(wp.device_to_torch(device)), network
        self._scales, self._augment = len(scales), noise is not None
        # A "world" for each object in each size.
        world_object = np.repeat(np.arange(len(objects)), len(scales))
        world_scale = np.tile(scales, len(objects))
        placed: dict[str, Any] = {"link_body": np.arange(links), "object_body": links, "device": device}
        self._clouds = SceneClouds(
            hand, objects, world_object=world_object, world_scale=world_scale, **placed
        )
        self._kinematics = HandKinematics(hand, link_body=np.arange(links), base=hand_mount(), device=device)
        self._voxelise = Voxeliser(network.voxel_m, noise=noise, clouds=batch, seed=seed, device=device)
        self._body_q = wp.zeros((batch, links + 1), dtype=wp.transform, device=device)
        self._seen = torch.arange(round(rendered_share * batch), device=self._device) % len(world_object)
        self._camera: DepthCamera | None = None
        stop = self._clouds.item.stop
        if len(self._seen):
            if len(self._seen) < len(world_object):
                raise ValueError(
                    f"a camera sees {len(self._seen)} scenes of a batch, but there are {len(world_object)} "
                    "objects in their sizes; raise --pretrain.batch or --pretrain.rendered-share"
                )
            envs = self._seen.cpu().numpy()
            self._camera = DepthCamera(
                hand_surfaces(
                    hand,
                    objects,
                    world_object=world_object[envs],
                    world_scale=world_scale[envs],
                    **placed,
                ),
                hand.camera,
                self._body_q[: len(envs)],
                cfg=depth,
                camera_body=0,
                seed=seed,
            )
            stop = max(stop, self._clouds.item.start + self._camera.points.shape[1])
        self._points = wp.full((batch, stop), wp.vec3(math.nan), dtype=wp.vec3, device=device)
        self._lower = torch.as_tensor(hand.lower, dtype=torch.float32, device=self._device)
        self._span = torch.as_tensor(hand.upper, dtype=torch.float32, device=self._device) - self._lower
        low, high = np.array(OBJECT_RANGE_M).T
        self._box = torch.tensor(np.array([low, high - low]), dtype=torch.float32, device=self._device)
        self.joint_scale_rad = 0.5 * self._span
        """Radians of one unit of scaled joint positions [D]."""

    def draw(self) -> tuple[tuple[Sites, ...], dict[str, torch.Tensor]]:
        """A batch of scenes.

        Returns:
            Voxels, and the targets: ``category`` [R], ``distance`` [R] [rad], ``rotation`` [R, 6] (first two
            columns of the matrix of q_object conj(q_goal)), ``joints`` [R, D] in [-1, 1]; and what they are
            of, ``body_q`` [R, B, 7], the object last, and ``goal`` [R, 4], until the next batch.
        """
        count, device = self._batch, self._device
        share = torch.rand((count, len(self._lower)), device=device)
        envs = torch.randint(self._objects * self._scales, (count,), device=device)
        envs[: len(self._seen)] = self._seen
        orientation = random_rotations(count, device)
        goal = random_rotations(count, device)
        near = torch.rand((count, 1), device=device) < self._near_share
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
        if self._camera is not None:
            self._camera.capture()
            # Without a pixel in the crop the cloud is one false point: it counts for nothing.
            unseen = wp.to_torch(self._camera.count) == 0
            rows, first = wp.to_torch(self._points)[: len(self._seen)], self._clouds.item.start
            rows[:, first:] = torch.nan
            seen = wp.to_torch(self._camera.points)
            rows[:, first : first + seen.shape[1]] = seen.masked_fill(unseen[:, None, None], torch.nan)
        sites = voxels(
            wp.to_torch(self._points),
            self._clouds.ends,
            self._voxelise,
            network=self._network,
            augment=self._augment,
            complete=self._camera is None,
        )
        targets = {
            "category": envs // self._scales,
            "distance": rotation_distance(orientation, goal),
            "rotation": two_columns(relative_rotation(orientation, goal)),
            "joints": 2.0 * share - 1.0,
            "body_q": wp.to_torch(self._body_q),
            "goal": goal,
        }
        return sites, targets

    def state_dict(self) -> dict[str, Any]:
        """Random states of augmentation and camera."""
        return {name: array.numpy().copy() for name, array in self._stateful().items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore it."""
        for name, array in self._stateful().items():
            array.assign(state[name])

    def _stateful(self) -> dict[str, wp.array]:
        return {"noise": self._voxelise.rng} | ({} if self._camera is None else self._camera.stateful())


class PretrainHeads(nn.Module):
    """Predictions from an embedding, or from its parts; heads whose weight in the loss is 0 are left out.

    The scalar distance from a whole embedding is predicted by the student's own head, if it has one before
    its memory, which then is trained already when imitation begins.

    Args:
        student: The student.
        cfg: Which predictions, from what.
        objects: O.
    """

    def __init__(self, student: Student, cfg: PretrainCfg, objects: int) -> None:
        super().__init__()
        width = student.cfg.encoder.embedding
        self._split = cfg.embedding == "split"
        part = width // EMBEDDING_PARTS if self._split else width
        own = "before" in student.distance and cfg.distance == "scalar" and not self._split
        sizes = {
            "category": (part, objects, cfg.category_weight),
            "joints": (width - 2 * part if self._split else width, student.num_actions, cfg.joint_weight),
            "distance": (2 * part if self._split else width, 1, cfg.distance_weight),
        }
        if cfg.distance == "6d":
            sizes["rotation"] = (sizes["distance"][0], 6, cfg.distance_weight)
        if own or cfg.distance == "6d":
            del sizes["distance"]
        self._student_head = own and cfg.distance_weight > 0.0
        self._part = part
        self.heads = nn.ModuleDict(
            {
                name: nn.Sequential(
                    nn.Linear(inputs, HEAD_HIDDEN), nn.GELU(), nn.Linear(HEAD_HIDDEN, outputs)
                )
                for name, (inputs, outputs, weight) in sizes.items()
                if weight > 0.0
            }
        )

    def forward(self, embedding: torch.Tensor, student: Student) -> dict[str, torch.Tensor]:
        """Predictions by name for embeddings [R, E]."""
        part = self._part
        inputs = {name: embedding for name in ("category", "distance", "rotation", "joints")}
        if self._split:
            pair = embedding[:, : 2 * part]
            inputs = {
                "category": embedding[:, :part],
                "distance": pair,
                "rotation": pair,
                "joints": embedding[:, 2 * part :],
            }
        predictions = {name: head(inputs[name]) for name, head in self.heads.items()}
        if self._student_head:
            predictions["distance"] = student.distance["before"](embedding)
        return predictions


class Pretrainer:
    """Trains the encoder of a student on random scenes.

    Args:
        scenes: Where clouds and targets come from.
        student: The network; what follows its encoder keeps its random weights, a head apart.
        objects: Number of objects O.
        cfg: Settings.
        world_size: Processes of the run.
    """

    def __init__(
        self, scenes: RandomScenes, student: Student, objects: int, cfg: PretrainCfg, *, world_size: int = 1
    ) -> None:
        self.scenes, self.student, self.cfg = scenes, student, cfg
        self.heads = PretrainHeads(student, cfg, objects).to(student.mean.weight.device)
        self.network = nn.ModuleList([student, self.heads])
        self.optimizer = make_optimizer(self.network, cfg.learning_rate, amsgrad=cfg.amsgrad)
        self.samples_per_iteration = cfg.batch * cfg.steps
        self._world_size = world_size
        self._steps_done = 0

    def iterate(self, stopping: Callable[[], bool]) -> dict[str, float | None] | None:
        """Some optimiser steps, a new batch each.

        Args:
            stopping: Asked before every step whether to give up.

        Returns:
            Means over the steps, or ``None`` if it was given up.

        Raises:
            TrainingDivergedError: Something is not finite any more.
        """
        self.student.train()
        rows = []
        for _ in range(self.cfg.steps):
            if stopping():
                return None
            rows.append(self._step())
        means = torch.stack([torch.stack(tuple(row.values())) for row in rows]).mean(dim=0)
        if self._world_size > 1:
            torch.distributed.all_reduce(means)
            means = means / self._world_size
            for buffer in self.student.buffers():
                torch.distributed.broadcast(buffer, 0)
        figures: dict[str, float | None] = dict(zip(rows[0], means.tolist(), strict=True))
        bad = [name for name, value in figures.items() if value is None or not math.isfinite(value)]
        if bad or not all_finite(self.network):
            raise TrainingDivergedError(f"{', '.join(bad) or 'weights'} not finite; {LOWER_RATES}")
        return figures

    def losses(
        self, sites: tuple[Sites, ...], targets: dict[str, torch.Tensor]
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Weighted loss of a batch, and figures to log."""
        cfg = self.cfg
        with autocast(sites[0].device, cfg.precision):
            embedding, matches = self.student.look(*sites)
        predictions = self.heads(embedding.float(), self.student)
        total = targets["distance"].new_zeros(())
        figures: dict[str, torch.Tensor] = {}
        if "category" in predictions:
            loss = nn.functional.cross_entropy(predictions["category"], targets["category"])
            total = total + cfg.category_weight * loss
            right = predictions["category"].argmax(dim=1) == targets["category"]
            figures |= {"student/category": right.float().mean(), "loss/category": loss.detach()}
        if "distance" in predictions:
            distance = predictions["distance"][:, 0]
            loss = (distance - targets["distance"]).square().mean()
        elif "rotation" in predictions:
            loss = (predictions["rotation"] - targets["rotation"]).square().mean()
            rotation = predictions["rotation"].detach()
            distance = angle_between(rotation)
            figures["student/rotation_error"] = angle_between(rotation, targets["rotation"]).mean()
        if "distance" in predictions or "rotation" in predictions:
            total = total + cfg.distance_weight * loss
            error = (distance.detach() - targets["distance"]).abs().mean()
            figures |= {"student/distance_error": error, "loss/distance": loss.detach()}
        if "joints" in predictions:
            error = predictions["joints"] - targets["joints"]
            total = total + cfg.joint_weight * error.square().mean()
            radians = (error.detach() * self.scenes.joint_scale_rad).square().mean().sqrt()
            figures |= {"student/joint_error": radians, "loss/joints": error.detach().square().mean()}
        if matches is not None and cfg.match_weight > 0.0:
            loss = match_loss(matches, targets["body_q"], targets["goal"])
            total = total + cfg.match_weight * loss
            figures |= {"loss/match": loss.detach()}
        return total, figures

    def state_dict(self) -> dict[str, Any]:
        """Heads and optimiser."""
        return {
            "optimizer": self.optimizer.state_dict(),
            "steps": self._steps_done,
            "heads": self.heads.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any], iteration: int) -> None:
        """Restore what :meth:`state_dict` gave."""
        self.heads.load_state_dict(state["heads"])
        self.optimizer.load_state_dict(state["optimizer"])
        self._steps_done = state["steps"]

    def local_state(self) -> dict[str, Any]:
        """Random state of the augmentation."""
        return {"scenes": self.scenes.state_dict()}

    def load_local_state(self, state: dict[str, Any]) -> None:
        """Restore it."""
        self.scenes.load_state_dict(state["scenes"])

    def fits(self, ranks: list[dict[str, Any]]) -> str:
        """Why the random states of a checkpoint cannot be restored; empty if they can."""
        if len(ranks) != self._world_size:
            return f"it is of {len(ranks)} processes, this run has {self._world_size}"
        saved = {len(rank["local"]["scenes"]["noise"]) for rank in ranks}
        if saved != {self.cfg.batch}:
            return f"it is of batches of {max(saved)} clouds, this run has {self.cfg.batch}"
        return ""

    def close(self) -> None:
        """Nothing to release."""

    def _step(self) -> dict[str, torch.Tensor]:
        sites, targets = self.scenes.draw()
        loss, figures = self.losses(sites, targets)
        self._steps_done += 1
        for group in self.optimizer.param_groups:
            group["lr"] = scheduled(
                self.cfg.learning_rate, self._steps_done, decay_after=self.cfg.decay_after_steps
            )
        norm = descend(self.network, self.optimizer, loss, self.cfg.grad_norm, self._world_size)
        return {**figures, "loss/total": loss.detach(), "loss/grad_norm": norm}
