"""What a depth camera sees of shapes in a hand, and the clouds of goals.

Pairs to learn alignment from.

Visibility is looked up in small depth maps and voxels. Those of hands are made once, of many
postures: in a batch nothing of a hand is left to do but a look into its tables.

B pairs, P points of a shape, M postures of the hand. All is in the hand's base frame, in metres.
"""

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import normalize

from vd.assets_usd.hand_data import HandModel, compose, invert
from vd.evaluate.scanned import MISSING, NOISE_M
from vd.geometry.arrays import as_warp
from vd.geometry.clouds import HandCloud
from vd.sensors.depth_camera import camera_places
from vd.train.student.shapes import drawn, random_matrices, uniform
from vd.vision.inputs import carried
from vd.vision.rotations import matrices_about

CELL_M = 0.007
"""Width of a cell at the middle of where objects are: about the distance of points on a shape, so
that few are seen through it.
"""
SLACK_M = 0.012
"""How far a point may lie behind the nearest of its cell: as deep as a cell is on a steep face."""
TOUCH_M = 0.008
"""Side of voxels; points in one with a point of the hand are taken for the hand's. What tells a
camera's points apart drops voxels of 5 mm that touch the hand's, which reaches about as far."""
SPARE = 0.1
"""Shapes are up to this share smaller and larger than the hand's objects, whose sizes are drawn too
(ours). Not tuned."""
REACH_M = 0.14
"""How far voxels go beyond where objects are: longer than half an object."""
FACING = -0.05
"""Cosine between ray and normal from which a camera sees a surface: not along it."""
LEAST_SEEN = 32
"""Of a shape with fewer points in view the hand is left out: there would be nothing to learn
from.
"""
DEPTH_STD_M, POINT_STD_M = 0.003, 0.001
"""Noise along the ray, of each view up to this much, and of points: stereo depth at half a
metre.
"""
LOST_PATCHES, LOST_RADIUS_M = 2, 0.025
"""Patches in which stereo finds no depth, and up to how large they are."""
NEAR_RAD = 0.9
"""Near starts are up to this far off: nearer than the rotations of a cube leave gaps, as later
passes are.
"""
TRIED_HANDS, TRIED_POINTS = 8, 64
"""Of so many hands the one that touches most of so many points holds a shape: few random ones are
near it.
"""
POSTURES_AT_ONCE = 128
"""Hands whose points are made at a time."""


@dataclass(frozen=True)
class Pairs:
    """Clouds about their means, in the base frame's axes, and how they lie."""

    goal: Tensor
    """[m] [B, G, 3]."""
    seen: Tensor
    """[m] [B, G, 3]."""
    rotation: Tensor
    """From goals to objects, matrices [B, 3, 3]."""
    offset: Tensor
    """Where the goal's mean lies on the object, from the mean of what is seen [m] [B, 3]."""
    surface: Tensor
    """The whole shape, turned as the goal is and about its mean [m] [B, P, 3]."""


class Hands:
    """What hands in random postures hide, as tables.

    Args:
        hand: The hand, with its camera.
        count: M.
        camera: Pose of the optical frame, position [m] and quaternion xyzw [7]; the hand's by
            default.
        camera_range: Up to how far along [m], and turned about [rad], each of its axes cameras are
            from there, each posture's another.
        device: Warp device.
    """

    def __init__(
        self,
        hand: HandModel,
        count: int,
        *,
        camera: tuple[float, ...] | None = None,
        camera_range: tuple[float, float] = (0.0, 0.0),
        device: str,
    ) -> None:
        place = torch.device(wp.device_to_torch(device))
        generator = np.random.default_rng(int(torch.randint(2**31, (1,))))
        eyes = camera_places(hand.camera.at(camera), count, camera_range, generator)

        def tensor(values: object) -> Tensor:
            return torch.tensor(np.asarray(values), dtype=torch.float32, device=place)

        corners = hand.workspace.box_m
        poses = np.concatenate([corners, np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))], axis=1)
        box = np.sort(compose(invert(hand.mount), poses)[:, :3], axis=0)
        self.box = tensor(box)
        """Corners of where objects are [2, 3]."""
        low, high = hand.workspace.size_m
        self.sides = (1.0 - SPARE) * low, (1.0 + SPARE) * high
        """Shortest and longest longest side of shapes [m]."""
        self.count = count
        self.eye = tensor(eyes[:, :3])
        """Where the camera of each posture is [M, 3]."""
        self._optical = tensor(Rotation.from_quat(eyes[:, 3:]).as_matrix())
        middle = self._in_camera(torch.arange(count, device=place), self.box.mean(dim=0))
        away = middle[..., 2]
        # Objects at the border of where they are fit in.
        width = np.linalg.norm(corners[1] - corners[0]) + hand.workspace.size_m[1]
        self._side = int(width / CELL_M)
        self._cell = CELL_M / away
        self._corner = middle[..., :2] / away[..., None] - 0.5 * self._side * self._cell[..., None]
        self._depth = torch.empty((count, self.cells), device=place)
        self._low = self.box[0] - REACH_M
        self._voxels = ((self.box[1] - self.box[0] + 2 * REACH_M) / TOUCH_M).ceil().long()
        _, y, z = self._voxels.tolist()
        self._strides = torch.tensor([y * z, z, 1], device=place)
        self._outside = int(self._voxels.prod())
        self._near = torch.zeros((count, self._outside + 1), dtype=torch.bool, device=place)
        self.joints = random_joints(hand, count, device)
        """Joint positions of the postures [rad] [M, D]."""
        for rows in torch.arange(count, device=place).split(POSTURES_AT_ONCE):
            points = posture_points(hand, self.joints[rows])
            cell, depth = self.project(rows, points)
            self._depth[rows] = nearest(cell, depth, self.cells)
            self._near[rows[:, None], self._voxel(points)] = True
        self._depth[:, -1] = torch.inf  # what is outside
        self._near[:, -1] = False

    @property
    def cells(self) -> int:
        """Cells of a depth map; the last is of all that is outside."""
        return self._side**2 + 1

    def project(self, rows: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Cells of the depth maps of hands ``rows`` [B] and depths [m] of points, [B, P] each."""
        at = self._in_camera(rows, points)
        depth = at[..., 2]
        place = at[..., :2] / depth[..., None]
        cell = ((place - self._corner[rows]) / self._cell[rows, :, None]).floor().long()
        inside = ((cell >= 0) & (cell < self._side)).all(dim=-1) & (depth > 0.0)
        index = self._side * cell[..., 1] + cell[..., 0]
        return torch.where(inside, index, self.cells - 1), depth

    def rays(self, rows: Tensor, points: Tensor) -> Tensor:
        """Directions from the cameras of hands ``rows`` [B] to points [B, P, 3]."""
        return normalize(points - self.eye[rows, None], dim=-1)

    def _in_camera(self, rows: Tensor, points: Tensor) -> Tensor:
        """Points [.., 3] in the optical frames of hands ``rows`` [B]: [B, P, 3] [m]."""
        return (points - self.eye[rows, None]) @ self._optical[rows]

    def before(self, rows: Tensor, cell: Tensor, depth: Tensor) -> Tensor:
        """Which points in cells at depths [m] [B, P] are not behind the hands ``rows`` [B]."""
        return depth < self._depth[rows[:, None], cell]

    def near(self, rows: Tensor, points: Tensor) -> Tensor:
        """Which points [B, P, 3] are beside the hands ``rows`` [B]; [B, P]."""
        return self._near[rows[:, None], self._voxel(points)]

    def holding(self, points: Tensor) -> Tensor:
        """For shapes with points [B, P, 3] hands that are about them, at random [B]."""
        rows = torch.randint(self.count, (len(points), TRIED_HANDS), device=points.device)
        voxel = self._voxel(points[:, None, :TRIED_POINTS])
        touched = self._near[rows[:, :, None], voxel].sum(dim=-1)
        most = touched.argmax(dim=1, keepdim=True)
        return rows.take_along_dim(most, dim=1).squeeze(1)

    def _voxel(self, points: Tensor) -> Tensor:
        """Voxels of points [B, P]; the last is outside."""
        voxel = ((points - self._low) / TOUCH_M).floor().long()
        inside = ((voxel >= 0) & (voxel < self._voxels)).all(dim=-1)
        index = (voxel * self._strides).sum(dim=-1)
        return torch.where(inside, index, self._outside)


def random_joints(hand: HandModel, count: int, device: str) -> Tensor:
    """Random joint positions within their limits [rad] [count, D]."""
    place = wp.device_to_torch(device)

    def tensor(values: np.ndarray) -> Tensor:
        return torch.tensor(values, dtype=torch.float32, device=place)

    joints = uniform(tensor(hand.lower), tensor(hand.upper), count, hand.num_joints, device=place)
    followed = joints[:, hand.mimic] * tensor(hand.mimic_factor) + tensor(hand.mimic_offset)
    return torch.where(torch.tensor(hand.mimic >= 0, device=place), followed, joints)


def posture_points(hand: HandModel, joints: Tensor) -> Tensor:
    """The hand's own points at joint positions [rad] [M, D], base frame [m] [M, H, 3]."""
    links = np.arange(len(hand.link_names))
    device = str(as_warp(joints).device)
    poses = wp.empty((len(joints), len(links)), dtype=wp.transform, device=device)
    cloud = HandCloud(hand, link_body=links, device=device)
    cloud.pose(as_warp(joints), poses)
    return wp.to_torch(cloud(poses))


def nearest(cell: Tensor, depth: Tensor, cells: int) -> Tensor:
    """Depth maps [m] [B, cells] of points in cells at depths, [B, P] each.

    Infinite where there are none.
    """
    empty = torch.full((len(cell), cells), torch.inf, device=cell.device)
    return empty.scatter_reduce_(1, cell, depth, "amin")


def visible(hands: Hands, rows: Tensor, shapes: Tensor, *, apart: bool = True) -> Tensor:
    """Which points a camera sees [B, P].

    Args:
        hands: The hands.
        rows: Which of them holds each shape [B].
        shapes: Points [m] and normals [B, P, 6].
        apart: Only those that are told from the hand by where they are.
    """
    points = shapes[..., :3]
    ray = hands.rays(rows, points)
    facing = (shapes[..., 3:] * ray).sum(dim=-1) < FACING
    cell, depth = hands.project(rows, points)
    front = torch.where(facing, depth, torch.inf)
    shown = facing & (depth < nearest(cell, front, hands.cells).gather(1, cell) + SLACK_M)
    free = shown & hands.before(rows, cell, depth)
    if apart:
        free = free & ~hands.near(rows, points)
    enough = free.sum(dim=1, keepdim=True) >= LEAST_SEEN
    return torch.where(enough, free, facing)


def own_points(hands: Hands, rows: Tensor, shapes: Tensor, points: Tensor) -> Tensor:
    """Points [m] [B, H, 3] that a camera has of the hands themselves, NaN for those that are hidden.

    Args:
        hands: The hands.
        rows: Which of them holds each shape [B].
        shapes: Points [m] of shapes, which hide hands [B, P, 3].
        points: Of these hands [m] [B, H, 3].
    """
    cell, depth = hands.project(rows, points)
    shape_cell, shape_depth = hands.project(rows, shapes)
    shape = nearest(shape_cell, shape_depth, hands.cells).gather(1, cell)
    front = depth - SLACK_M
    shown = hands.before(rows, cell, front) & (front < shape)
    noisy = points + POINT_STD_M * torch.randn_like(points)
    return noisy.masked_fill(~shown[..., None], torch.nan)


def camera_points(
    hands: Hands, rows: Tensor, shapes: Tensor, count: int, *, apart: bool = True
) -> Tensor:
    """Points [m] [B, count, 3] that a camera has of shapes, with errors.

    Arguments as of :func:`visible`.
    """
    points = shapes[..., :3]
    device = shapes.device
    batch = len(points)
    shown = visible(hands, rows, shapes, apart=apart)
    patches = drawn(shown.float(), LOST_PATCHES)
    kept = shown
    for middle in points.take_along_dim(patches[..., None], dim=1).unbind(1):
        radius = LOST_RADIUS_M * torch.rand((batch, 1), device=device)
        kept = kept & ((points - middle[:, None]).norm(dim=-1) > radius)
    kept = torch.where(kept.sum(dim=1, keepdim=True) >= LEAST_SEEN, kept, shown)
    chosen = drawn(kept.float(), count)
    seen = points.take_along_dim(chosen[..., None], dim=1)
    std = DEPTH_STD_M * torch.rand((batch, 1, 1), device=device)
    ray = hands.rays(rows, seen)
    noise = POINT_STD_M * torch.randn_like(seen)
    return seen + noise + std * torch.randn((batch, count, 1), device=device) * ray


def goal_points(points: Tensor, count: int, scans: float) -> Tensor:
    """Clouds of goals [m] [B, count, 3], the first points of whole shapes [m] [B, P, 3], in no order.

    A share ``scans`` is as :func:`vd.evaluate.scanned.scan` has them: a side is missing, others
    stand for it, and points are noisy.
    """
    goal = points[:, :count]
    device = points.device
    scan = torch.rand((len(goal), 1), device=device) < scans
    direction = torch.randn((len(goal), 3, 1), device=device)
    height = (goal @ direction).squeeze(-1)
    kept = round((1.0 - MISSING) * count)
    there = height <= height.kthvalue(kept, dim=1, keepdim=True).values
    index = torch.arange(count, device=device).expand(len(goal), -1)
    index = torch.where(scan & ~there, drawn(there.float(), count), index)
    goal = goal.take_along_dim(index[..., None], dim=1)
    return goal + NOISE_M * scan[..., None] * torch.randn_like(goal)


def posed(shapes: Tensor, rotation: Tensor, position: Tensor) -> Tensor:
    """Points and normals [.., P, 6] turned by matrices [.., 3, 3] and shifted by [.., 3]."""
    points = carried(shapes[..., :3], rotation, position[..., None, :])
    normals = carried(shapes[..., 3:], rotation)
    return torch.cat([points, normals], dim=-1)


def draw_pairs(
    hands: Hands, shapes: Tensor, count: int, *, near: float = 0.0, scans: float = 0.0
) -> Pairs:
    """Pairs of a goal and of what is seen of the same shape, of different points of it.

    Args:
        hands: What hides shapes.
        shapes: Points [m] and normals of shapes about their middles [B, P, 6], P of at least 3
            ``count``.
        count: G, points of a cloud.
        near: Share of pairs that are less than ``NEAR_RAD`` apart; others are uniform on SO(3).
        scans: Share of goals as from scans.
    """
    batch = len(shapes)
    device = shapes.device
    order = torch.randperm(shapes.shape[1], device=device)
    shapes = shapes[:, order].float()
    orientation = random_matrices(batch, device)
    place = uniform(*hands.box, batch, 3, device=device)
    held = posed(shapes[:, count:], orientation, place)
    seen = camera_points(hands, hands.holding(held[..., :3]), held, count)
    return with_goals(shapes[..., :3], orientation, place, seen, near=near, scans=scans)


def with_goals(
    shapes: Tensor,
    orientation: Tensor,
    place: Tensor,
    seen: Tensor,
    *,
    near: float,
    scans: float,
) -> Pairs:
    """Pairs of what is seen of shapes and of goals, turned at random, whose points come first in the shapes.

    Args:
        shapes: Points of shapes in their own frames, in no order [m] [B, P, 3].
        orientation: Of these frames, matrices [B, 3, 3].
        place: Where their origins are [m] [B, 3].
        seen: What is seen [m] [B, G, 3].
        near: Share of pairs that are less than ``NEAR_RAD`` apart; others are uniform on SO(3).
        scans: Share of goals as from scans.
    """
    batch = len(shapes)
    device = shapes.device
    angle = NEAR_RAD * torch.rand(batch, device=device)
    small = matrices_about(torch.randn((batch, 3), device=device), angle)
    is_near = torch.rand((batch, 1, 1), device=device) < near
    turn = torch.where(is_near, small, random_matrices(batch, device))
    wanted = orientation.mT @ turn  # its transpose turns the shape to the goal
    goal = goal_points(shapes, seen.shape[1], scans)
    middle = goal.mean(dim=1, keepdim=True)
    mean = seen.mean(dim=1)
    return Pairs(
        goal=(goal - middle) @ wanted,
        seen=seen - mean[:, None],
        rotation=turn,
        offset=carried(middle, orientation)[:, 0] + place - mean,
        surface=(shapes - middle) @ wanted,
    )


def joined(first: Pairs, second: Pairs) -> Pairs:
    """Pairs of both, one after the other."""
    both = zip(vars(first).values(), vars(second).values(), strict=True)
    return Pairs(*map(torch.cat, both))
