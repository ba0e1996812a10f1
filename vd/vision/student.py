"""The student: a network that turns what a camera sees, joints and a goal's cloud into an action.

One sparse tensor holds what the camera sees, the hand's own points by its joints, and the goal's
cloud, each kind in channels of its own. The goal's cloud is laid where the object is believed to
be, so what is wrong with the belief shows as a small shift between two surfaces, wherever the
object is. The network predicts by how much the belief is to be turned and shifted, and acts on the
better one. A GRU carries over steps what one look does not show.

The voxels of a step depend on the belief that the step before left. So a sequence can only be
encoded at once if its beliefs are those of the rollout: training stores them beside the rest of a
:class:`StudentInput`, as data through which no gradient flows, and teaches the residual from each stored
belief to the truth.

N environments, T steps, D joints and actions, E the embedding, G the memory. Base frame of the
hand; metres, radians.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
import torch
import warp as wp
from torch import Tensor, nn

from vd.assets_usd.hand_data import HandModel
from vd.geometry.arrays import as_warp
from vd.geometry.clouds import HandCloud
from vd.paper import PAPER
from vd.policy.senses import Senses
from vd.vision.cfg import StudentCfg
from vd.vision.rotations import first_columns, matrices, quaternion_matrices, quaternions
from vd.vision.sparse import ResidualBlock, SparseTensor, StridedConv, global_pool, voxelise

KINDS = 3
"""Kinds of points: of the camera, of the hand, of the goal."""
PLACE_M = 0.1
"""Unit of places and offsets [m]: about the size of the scene."""
LOG_STD = (-4.0, 0.0)
"""Least and largest logarithm of an action's standard deviation, as wide as teachers' are."""
UNSURE = 2.2
"""Bias of the deviation at first: near the largest, or the gradient were the first actions' alone."""
UNTURNED = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
"""The identity as two columns: what a network that predicts zeros turns by."""

Step = TypeVar("Step", "StudentInput", "StudentOutput", "Belief", Senses)


@dataclass(frozen=True)
class Belief:
    """Where a goal's cloud is believed to lie on the object; leading axes [N] or [T, N]."""

    rotation: Tensor
    """From the cloud's own axes to the base frame, matrices [.., 3, 3]."""
    position: Tensor
    """Of the cloud's mean [m] [.., 3]."""


@dataclass(frozen=True)
class StudentInput:
    """What a student reads of a step; leading axes [N] or [T, N]."""

    camera: Tensor
    """What the camera sees, or complete surfaces; NaN for none [.., K, 3]."""
    hand: Tensor
    """The hand's own points by its joints [.., H, 3]."""
    goal: Tensor
    """The goal's cloud about its mean, in its own axes [.., P, 3]."""
    goal_rotation: Tensor
    """Wanted rotation, from the cloud's own axes to the base frame, matrices [.., 3, 3]."""
    proprioception: Tensor
    """Joint positions and velocities, scaled, and the last action [.., 3 D]."""
    belief: Belief
    """What the step before left."""


@dataclass(frozen=True)
class StudentOutput:
    """What a student says of a step; leading axes [N] or [T, N], the memory's [N]."""

    mean: Tensor
    """Mean of the action, not clipped [.., D]."""
    log_std: Tensor
    """Logarithm of its standard deviation [.., D]."""
    belief: Belief
    """The better belief; detached it is the next step's."""
    log_distance: Tensor
    """Logarithm of the angle to the goal [rad] [..]."""
    voxels: Tensor
    """How many voxels hold points of the camera and none of the hand [..]."""
    hidden: Tensor
    """Memory after the last step [N, G]."""


def each(step: Step, change: Callable[[Tensor], Tensor]) -> Step:
    """A step with every tensor changed, such as indexed."""
    values: dict[str, Any] = {}
    for field in fields(step):
        value = getattr(step, field.name)
        nested = isinstance(value, Belief)
        values[field.name] = each(value, change) if nested else change(value)
    return type(step)(**values)


def carried(points: Tensor, rotation: Tensor, position: Tensor | float = 0.0) -> Tensor:
    """Points [.., P, 3] turned by matrices [.., 3, 3] and shifted by [.., 1, 3]: P R^T + p."""
    return points @ rotation.mT + position


class InputBuilder:
    """Makes what a student reads of what N hands sense.

    Args:
        hand: The hand.
        goals: Clouds of the goals, in their own axes and of true size [m] [N, P, 3].
    """

    def __init__(self, hand: HandModel, goals: Tensor):
        device = goals.device
        links = np.arange(len(hand.link_names))
        self.set_goals(goals)
        self._cloud = HandCloud(hand, link_body=links, device=str(device))
        self._links = len(links)

        def constant(values: np.ndarray) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        self._to_base = quaternion_matrices(constant(hand.mount[3:])).T
        self._place = constant(hand.goal_in_base)
        self._lower = constant(hand.lower)
        self._range = constant(hand.upper - hand.lower)

    def set_goals(self, goals: Tensor) -> None:
        """Take other clouds."""
        middle = goals.mean(dim=1)
        self._middle = middle
        self._goals = goals - middle[:, None]

    def goal_rotation(self, goal_quat: Tensor) -> Tensor:
        """Wanted rotations in the base frame [R, 3, 3], of quaternions in the world's [R, 4]."""
        return self._to_base @ quaternion_matrices(goal_quat)

    def goal_quat(self, rotation: Tensor) -> Tensor:
        """The inverse of :meth:`goal_rotation`."""
        return quaternions(self._to_base.T @ rotation)

    def first_belief(self, goal_quat: Tensor) -> Belief:
        """What is believed of an object before it is seen.

        It is turned as it is wanted and lies where objects are handled.
        """
        rotation = self.goal_rotation(goal_quat)
        return Belief(rotation, self._place.repeat(len(goal_quat), 1))

    def near_place(self, belief: Belief, reach_m: float) -> Belief:
        """A belief whose place is at most ``reach_m`` from where objects are handled."""
        offset = belief.position - self._place
        length = offset.norm(dim=-1, keepdim=True)
        share = reach_m / length.clamp(min=reach_m)
        position = self._place + offset * share
        return Belief(belief.rotation, position)

    def belief_of(self, pose: Tensor, rows: Tensor | None = None) -> Belief:
        """What is to be believed of objects at poses in the base frame [R, 7]; ``rows`` as below."""
        middle = self._middle if rows is None else self._middle[rows]
        rotation = quaternion_matrices(pose[:, 3:])
        position = carried(middle[:, None], rotation, pose[:, None, :3])
        return Belief(rotation, position[:, 0])

    def pose_of(self, belief: Belief) -> Tensor:
        """Where the frames of the objects of all environments are believed to be [N, 7]."""
        middle = carried(self._middle[:, None], belief.rotation)[:, 0]
        orientation = quaternions(belief.rotation)
        return torch.cat([belief.position - middle, orientation], dim=1)

    def __call__(self, senses: Senses, belief: Belief, rows: Tensor | None = None) -> StudentInput:
        """What is read of R steps.

        Args:
            senses: What was sensed, R rows; instead of what a camera sees ``points`` may hold
                complete surfaces (:func:`carried`).
            belief: What was believed before [R].
            rows: Environment of each row [R]; row i is of environment i by default.
        """
        joint_q = senses.joint_q
        poses = joint_q.new_empty((len(joint_q), self._links, 7))
        links = as_warp(poses, wp.transform)
        self._cloud.pose(as_warp(joint_q), links)
        position = 2.0 * (joint_q - self._lower) / self._range - 1.0
        velocity = PAPER.observation.velocity_scale * senses.joint_qd
        return StudentInput(
            camera=senses.points,
            hand=wp.to_torch(self._cloud(links)),
            goal=self._goals if rows is None else self._goals[rows],
            goal_rotation=self.goal_rotation(senses.goal_quat),
            proprioception=torch.cat([position, velocity, senses.action], dim=-1),
            belief=belief,
        )


class VoxelStage(nn.Module):
    """A convolution of stride 2, BN and residual blocks on the coarser cells.

    Args:
        inputs: C_in.
        outputs: C_out.
        blocks: Residual blocks.
    """

    def __init__(self, inputs: int, outputs: int, blocks: int):
        super().__init__()
        self.conv = StridedConv(inputs, outputs)
        self.norm = nn.BatchNorm1d(outputs)
        self.blocks = nn.Sequential(*(ResidualBlock(outputs) for _ in range(blocks)))

    def forward(self, x: SparseTensor) -> SparseTensor:
        """Features of the coarser cells."""
        x = self.conv(x)
        normed = SparseTensor(self.norm(x.features), x.sites)
        return self.blocks(normed)


class Student(nn.Module):
    """From what is seen and sensed to the action, with memory (the paper's Figure 7).

    Its stages multiply in their weights' precision: ``stages.bfloat16()`` is for a robot's
    computer, ``half`` for learning. Geometry is computed in single precision; so call it outside
    of autocast.

    Args:
        cfg: Its sizes.
        num_actions: D.

    Attributes:
        half: The stages multiply in bfloat16 while weights stay in single precision.
    """

    def __init__(self, cfg: StudentCfg, num_actions: int):
        super().__init__()
        cfg.validate()
        self.cfg = cfg
        self.num_actions = num_actions
        self.half = False
        widths = (4 * KINDS + 3, *cfg.channels)
        self.stages = nn.Sequential()
        for inputs, outputs in pairwise(widths):
            self.stages.append(VoxelStage(inputs, outputs, cfg.blocks))
        self.project = nn.Sequential(
            nn.Linear(2 * widths[-1], cfg.embedding),
            nn.ReLU(),
        )
        believed = len(UNTURNED) + 3
        self.senses = nn.Sequential(
            nn.Linear(3 * num_actions + believed, cfg.senses),
            nn.GELU(),
            nn.Linear(cfg.senses, cfg.senses),
        )
        self.memory = nn.GRU(cfg.embedding + cfg.senses, cfg.memory)
        self.residual = nn.Linear(cfg.memory, believed)
        self.head = nn.Sequential(
            nn.Linear(cfg.memory + believed, cfg.head),
            nn.GELU(),
        )
        self.mean = nn.Linear(cfg.head, num_actions)
        self.log_std = nn.Linear(cfg.head, num_actions)
        nn.init.constant_(self.log_std.bias, UNSURE)
        self.log_distance = nn.Linear(cfg.head, 1)
        self.register_buffer("unturned", torch.tensor(UNTURNED), persistent=False)

    def first_hidden(self, envs: int) -> Tensor:
        """The memory where an episode begins: zeros [N, G]."""
        return self.mean.weight.new_zeros((envs, self.cfg.memory))

    def encode(self, sight: StudentInput) -> tuple[Tensor, Tensor]:
        """What one look shows [.., E], and voxels of the camera's points beside the hand's [..].

        Waits for the device.
        """
        lead = sight.camera.shape[:-2]
        place = sight.belief.position[..., None, :]
        laid = carried(sight.goal, sight.belief.rotation)
        kinds = [sight.camera - place, sight.hand - place, laid]
        within = [self._within_reach(kind).flatten(0, -3) for kind in kinds]
        voxels = voxelise(within, self.cfg.voxel_m)
        cells = voxels.sites.coordinates[:, 1:]
        middles = self.cfg.voxel_m / PLACE_M * (cells + 0.5)
        features = torch.cat([voxels.features, middles], dim=1)
        features = features.to(next(self.stages.parameters()).dtype)
        with torch.autocast(features.device.type, torch.bfloat16, enabled=self.half):
            coarse = self.stages(SparseTensor(features, voxels.sites))
        pooled = global_pool(coarse).to(place.dtype)
        camera = voxels.features[:, 0]
        hand = voxels.features[:, 4]
        beside = camera * (1.0 - hand)
        count = torch.segment_reduce(beside, "sum", lengths=voxels.sites.lengths, unsafe=True)
        look = self.project(pooled).unflatten(0, lead)
        return look, count.unflatten(0, lead)

    def forward(
        self, sight: StudentInput, hidden: Tensor, done: Tensor | None = None
    ) -> StudentOutput:
        """Read a sequence.

        Args:
            sight: What was sensed in each step [T, N].
            hidden: Memory before the first step [N, G].
            done: Where step t was the last of an episode, bool [T, N]: t + 1 begins without memory.
        """
        belief = sight.belief
        believed = self._believed(belief, sight.goal_rotation)
        sensed = self.senses(torch.cat([sight.proprioception, believed], dim=-1))
        look, voxels = self.encode(sight)
        inputs = torch.cat([look, sensed], dim=-1)
        remembered, hidden = self._remember(inputs, hidden, done)
        turn, shift = self.residual(remembered).split([len(UNTURNED), 3], dim=-1)
        turned = matrices(self.unturned + turn) @ belief.rotation
        better = Belief(
            rotation=matrices(first_columns(turned)),  # still a rotation after many steps
            position=belief.position + PLACE_M * shift,
        )
        believed = self._believed(better, sight.goal_rotation)
        features = self.head(torch.cat([remembered, believed], dim=-1))
        low, high = LOG_STD
        mean = self.mean(features)
        share = torch.sigmoid(self.log_std(features))
        return StudentOutput(
            mean=mean,
            log_std=low + (high - low) * share,
            belief=better,
            log_distance=self.log_distance(features).squeeze(-1),
            voxels=voxels,
            hidden=hidden,
        )

    def act(self, sight: StudentInput, hidden: Tensor) -> StudentOutput:
        """One step of N hands: what :meth:`forward` says of it, leading axis [N]."""
        sequence = each(sight, lambda value: value[None])
        output = self(sequence, hidden)
        step = each(output, lambda value: value[0])
        return replace(step, hidden=output.hidden)

    def _within_reach(self, points: Tensor) -> Tensor:
        """Points [.., 3] about the object's place; NaN for those that are out of reach."""
        far = points.norm(dim=-1, keepdim=True) > self.cfg.reach_m
        return points.masked_fill(far, torch.nan)

    def _believed(self, belief: Belief, goal_rotation: Tensor) -> Tensor:
        """From the goal to the object as two columns, and the object's place [.., 9]."""
        turn = belief.rotation @ goal_rotation.mT
        place = belief.position / PLACE_M
        return torch.cat([first_columns(turn), place], dim=-1)

    def _remember(
        self, inputs: Tensor, hidden: Tensor, done: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """The GRU over [T, N, ..], its memory cleared where episodes ended: [T, N, G], [N, G]."""
        outputs = []
        state = hidden[None]
        for step in range(len(inputs)):
            output, state = self.memory(inputs[step : step + 1], state)
            outputs.append(output)
            if done is not None:
                state = state.masked_fill(done[step, :, None], 0.0)
        return torch.cat(outputs), state[0]
