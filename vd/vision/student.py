"""The student: a network that turns what a camera sees, joints and a goal's cloud into an action.

One sparse tensor holds what the camera sees, the hand's own points by its joints, and the goal's
cloud, each kind in channels of its own. The goal's cloud is laid where the object is believed to
be, so what is wrong with the belief shows as a shift between two surfaces, wherever the object is.
The network predicts for each voxel of the goal by how much it is to move, and how sure that is; the
rigid motion that fits these shifts best makes the belief better, and the network acts on that. A
GRU carries over steps what one look does not show.

The voxels of a step depend on the belief that the step before left. So a sequence can only be
encoded at once if its beliefs are those of the rollout: training stores them beside the rest of a
:class:`StudentInput`, as data through which no gradient flows, and teaches the shifts from each
stored belief to the truth.

N environments, T steps, R looks, V voxels of goals in all of them, D joints of which A have motors
and so actions, E the embedding, G the memory. Base frame of the hand; metres, radians.
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
BELIEVED = 9
"""Numbers of a belief: two columns of a rotation, and a place."""
SHIFT_M = 0.01
"""Unit of the deviation of shifts [m]."""
LOG_SCALE = (-3.0, 3.0)
"""Least and largest logarithm of that deviation: from 0.5 mm to 20 cm."""
LEAST_M = 1e-4
"""Goals are as if they were this wide at least [m], for what cannot be told."""

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
    """Positions and velocities of joints with motors, scaled, and the last action [.., 3 A]."""
    belief: Belief
    """What the step before left."""


@dataclass(frozen=True)
class Flow:
    """By how much the goal's voxels are to move to lie on the object, predicted."""

    start: Tensor
    """Where they are laid, from the believed place [m] [V, 3]."""
    shift: Tensor
    """By how much they are to move [m] [V, 3]."""
    log_scale: Tensor
    """Logarithm of the deviation of that, of a Laplace distribution [cm] [V]."""
    look: Tensor
    """The look to which each belongs, int64 [V]."""


@dataclass(frozen=True)
class Look:
    """What R looks show, without memory."""

    embedding: Tensor
    """For the memory [R, E]."""
    belief: Belief
    """The better belief [R]."""
    doubt: Tensor
    """Mean of the logarithm of the deviation of shifts [cm] [R]."""
    voxels: Tensor
    """How many voxels hold points of the camera and none of the hand [R]."""
    flow: Flow
    """What the belief is made better by."""


@dataclass(frozen=True)
class StudentOutput:
    """What a student says of a step; leading axes [N] or [T, N], the memory's [N]."""

    mean: Tensor
    """Mean of the action, not clipped [.., A]."""
    log_std: Tensor
    """Logarithm of its standard deviation [.., A]."""
    belief: Belief
    """The better belief; detached it is the next step's."""
    log_distance: Tensor
    """Logarithm of the angle to the goal [rad] [..]."""
    voxels: Tensor
    """How many voxels hold points of the camera and none of the hand [..]."""
    hidden: Tensor
    """Memory after the last step [N, G]."""
    flow: Flow
    """The shifts of all steps."""


def each(step: Step, change: Callable[[Tensor], Tensor]) -> Step:
    """A step with every tensor changed, such as indexed; a flow stays."""
    values: dict[str, Any] = {}
    for field in fields(step):
        value = getattr(step, field.name)
        if isinstance(value, Belief):
            value = each(value, change)
        elif not isinstance(value, Flow):  # which has no rows of steps
            value = change(value)
        values[field.name] = value
    return type(step)(**values)


def carried(points: Tensor, rotation: Tensor, position: Tensor | float = 0.0) -> Tensor:
    """Points [.., P, 3] turned by matrices [.., 3, 3] and shifted by [.., 1, 3]: P R^T + p."""
    return points @ rotation.mT + position


@torch.no_grad()
def rigid_motion(flow: Flow, looks: int) -> tuple[Tensor, Tensor]:
    """The rigid motion of each look that fits its shifts best, by weighted least squares (Kabsch 1976).

    Voxels weigh by the inverse square of their deviation. About a line on which all of them lie
    nothing is turned. No gradient flows.

    Returns:
        Rotations [R, 3, 3], and translations [m] [R, 3]: q ~ R p + t.
    """
    lengths = torch.bincount(flow.look, minlength=looks)

    def total(values: Tensor) -> Tensor:
        return torch.segment_reduce(values, "sum", lengths=lengths, unsafe=True)

    weight = torch.exp(-2.0 * flow.log_scale)
    weight = weight / total(weight)[flow.look]
    end = flow.start + flow.shift
    from_middle = total(weight[:, None] * flow.start)
    to_middle = total(weight[:, None] * end)
    start = flow.start - from_middle[flow.look]
    end = end - to_middle[flow.look]
    products = weight[:, None, None] * end[:, :, None] * start[:, None, :]
    covariance = total(products.flatten(1)).unflatten(1, (3, 3))
    still = LEAST_M**2 * torch.eye(3, device=covariance.device)
    left, _, right = torch.linalg.svd(covariance + still)
    signs = torch.ones_like(to_middle)
    signs[:, 2] = torch.linalg.det(left @ right).sign()
    rotation = left @ (signs[:, :, None] * right)
    return rotation, to_middle - carried(from_middle[:, None], rotation)[:, 0]


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
        self._moved = torch.tensor(hand.actuated, device=device)
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
        moved = torch.stack([position, velocity, senses.action])[..., self._moved]
        return StudentInput(
            camera=senses.points,
            hand=wp.to_torch(self._cloud(links)),
            goal=self._goals if rows is None else self._goals[rows],
            goal_rotation=self.goal_rotation(senses.goal_quat),
            proprioception=torch.cat(tuple(moved), dim=-1),
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
        num_actions: A.

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
        self.flow = nn.Sequential(
            nn.Linear(sum(widths[1:]) + 2 * widths[-1] + 6, cfg.flow),
            nn.GELU(),
            nn.Linear(cfg.flow, cfg.flow),
            nn.GELU(),
            nn.Linear(cfg.flow, 4),
        )
        self.senses = nn.Sequential(
            nn.Linear(3 * num_actions + BELIEVED + 1, cfg.senses),
            nn.GELU(),
            nn.Linear(cfg.senses, cfg.senses),
        )
        self.memory = nn.GRU(cfg.embedding + cfg.senses, cfg.memory)
        self.head = nn.Sequential(
            nn.Linear(cfg.memory + BELIEVED, cfg.head),
            nn.GELU(),
        )
        self.mean = nn.Linear(cfg.head, num_actions)
        self.log_std = nn.Linear(cfg.head, num_actions)
        nn.init.constant_(self.log_std.bias, UNSURE)
        self.log_distance = nn.Linear(cfg.head, 1)

    def first_hidden(self, envs: int) -> Tensor:
        """The memory where an episode begins: zeros [N, G]."""
        return self.mean.weight.new_zeros((envs, self.cfg.memory))

    def look(self, sight: StudentInput) -> Look:
        """What R looks show, and a better belief. Waits for the device."""
        believed = sight.belief
        place = believed.position[:, None]
        laid = carried(sight.goal, believed.rotation)
        kinds = [sight.camera - place, sight.hand - place, laid]
        within = list(map(self._within_reach, kinds))
        voxels = voxelise(within, self.cfg.voxel_m)
        levels = self._convolve(voxels)
        pooled = global_pool(levels[-1]).to(place.dtype)
        flow = self._flow(voxels, levels, pooled)
        looks = len(place)
        turn, shift = rigid_motion(flow, looks)
        camera = voxels.features[:, 0]
        hand = voxels.features[:, 4]
        beside = camera * (1.0 - hand)
        lengths = voxels.sites.lengths
        seen = torch.segment_reduce(beside, "sum", lengths=lengths, unsafe=True)
        turned = turn @ believed.rotation
        rotation = matrices(first_columns(turned))  # still a rotation after many steps
        position = believed.position + shift
        blind = (seen == 0.0)[:, None]
        better = Belief(
            rotation=torch.where(blind[..., None], believed.rotation, rotation),
            position=torch.where(blind, believed.position, position),
        )
        of_look = torch.bincount(flow.look, minlength=looks)
        doubt = torch.segment_reduce(flow.log_scale, "mean", lengths=of_look, unsafe=True)
        return Look(self.project(pooled), better, doubt, seen, flow)

    def _convolve(self, voxels: SparseTensor) -> list[SparseTensor]:
        """Features of the cells of each stage."""
        cells = voxels.sites.coordinates[:, 1:]
        middles = self.cfg.voxel_m / PLACE_M * (cells + 0.5)
        features = torch.cat([voxels.features, middles], dim=1)
        x = SparseTensor(features.to(next(self.stages.parameters()).dtype), voxels.sites)
        levels = []
        with torch.autocast(features.device.type, torch.bfloat16, enabled=self.half):
            for stage in self.stages:
                x = stage(x)
                levels.append(x)
        return levels

    def _flow(self, voxels: SparseTensor, levels: list[SparseTensor], pooled: Tensor) -> Flow:
        """The shifts of the goal's voxels, from the cells of all stages that hold them."""
        sites = voxels.sites
        goal = voxels.features[:, 8] > 0.0
        keys = sites.keys[goal]
        look = sites.coordinates[goal, 0].long()
        offset = voxels.features[goal, 9:12]
        start = self.cfg.voxel_m * (sites.coordinates[goal, 1:] + 0.5 + offset)
        columns = [start / PLACE_M, offset, pooled[look]]
        for level in levels:
            cell = keys & ~(level.sites.step**3 - 1)
            row = torch.searchsorted(level.sites.keys, cell)
            columns.append(level.features[row].to(start.dtype))
        predicted = self.flow(torch.cat(columns, dim=1))
        return Flow(
            start=start,
            shift=PLACE_M * predicted[:, :3],
            log_scale=predicted[:, 3].clamp(*LOG_SCALE),
            look=look,
        )

    def forward(
        self, sight: StudentInput, hidden: Tensor, done: Tensor | None = None
    ) -> StudentOutput:
        """Read a sequence.

        Args:
            sight: What was sensed in each step [T, N].
            hidden: Memory before the first step [N, G].
            done: Where step t was the last of an episode, bool [T, N]: t + 1 begins without memory.
        """
        flat = self.look(each(sight, lambda value: value.flatten(0, 1)))
        lead = sight.camera.shape[:2]

        def of_steps(value: Tensor) -> Tensor:
            return value.unflatten(0, lead)

        better = each(flat.belief, of_steps)
        believed = self._believed(better, sight.goal_rotation)
        doubt = of_steps(flat.doubt.detach())[..., None]
        sensed = self.senses(torch.cat([sight.proprioception, believed, doubt], dim=-1))
        inputs = torch.cat([of_steps(flat.embedding), sensed], dim=-1)
        remembered, hidden = self._remember(inputs, hidden, done)
        features = self.head(torch.cat([remembered, believed], dim=-1))
        low, high = LOG_STD
        mean = self.mean(features)
        share = torch.sigmoid(self.log_std(features))
        return StudentOutput(
            mean=mean,
            log_std=low + (high - low) * share,
            belief=better,
            log_distance=self.log_distance(features).squeeze(-1),
            voxels=of_steps(flat.voxels),
            hidden=hidden,
            flow=flat.flow,
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
