"""What a depth camera sees of shapes in a hand, and the clouds of goals.

Pairs to learn alignment from.

Visibility is looked up in small depth maps and voxels. Those of hands are made once, of many
postures: in a batch nothing of a hand is left to do but a look into its tables.

B pairs, P points of a shape, M postures of the hand. All is in the hand's base frame, in metres.
"""

from dataclasses import dataclass, fields

import numpy as np
import torch
import warp as wp
from scipy.spatial.transform import Rotation
from torch.nn.functional import normalize

from vd.assets_usd.hand_data import HandModel, compose, invert
from vd.evaluate.scanned import MISSING, NOISE_M
from vd.geometry.arrays import as_warp
from vd.geometry.clouds import HandCloud
from vd.train.student.shapes import drawn, random_matrices, uniform
from vd.vision.rotations import matrices, rotations_about, two_columns

OBJECT_RANGE_M = ((-0.06, 0.06), (-0.06, 0.06), (0.02, 0.16))
"""Where objects are, world frame: from the table to the palm, as wide as the claw opens."""
WINDOW_M = 0.2
"""Half the width of depth maps at the middle of that range: objects at its border fit in."""
CELL_M = 0.007
"""Width of a cell there: about the distance of points on a shape, so that few are seen through
it.
"""
SLACK_M = 0.012
"""How far a point may lie behind the nearest of its cell: as deep as a cell is on a steep face."""
TOUCH_M = 0.008
"""Side of voxels; points in one with a point of the hand are taken for the hand's. What tells a
camera's points apart drops voxels of 5 mm that touch the hand's, which reaches about as far."""
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

    goal: torch.Tensor
    """[m] [B, G, 3]."""
    seen: torch.Tensor
    """[m] [B, G, 3]."""
    rotation: torch.Tensor
    """From goals to objects, matrices [B, 3, 3]."""
    offset: torch.Tensor
    """Where the goal's mean lies on the object, from the mean of what is seen [m] [B, 3]."""
    surface: torch.Tensor
    """The whole shape, turned as the goal is and about its mean [m] [B, P, 3]."""


class Hands:
    """What hands in random postures hide, as tables.

    Args:
        hand: The hand, with its camera.
        camera: Pose of the optical frame, position [m] and quaternion xyzw [7]; the hand's by
            default.
        count: M.
        device: Warp device.
    """

    def __init__(
        self, hand: HandModel, count: int, *, camera: tuple[float, ...] | None = None, device: str
    ) -> None:
        place = torch.device(wp.device_to_torch(device))
        eye = hand.camera.at(camera)

        def tensor(values: object) -> torch.Tensor:
            return torch.tensor(np.asarray(values), dtype=torch.float32, device=place)

        corners = np.array(OBJECT_RANGE_M).T
        poses = np.concatenate([corners, np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))], axis=1)
        box = np.sort(compose(invert(hand.mount), poses)[:, :3], axis=0)
        self.box = tensor(box)
        """Corners of where objects are [2, 3]."""
        self.count = count
        self.eye, self._optical = (
            tensor(eye.position),
            tensor(Rotation.from_quat(eye.quaternion).as_matrix()),
        )
        middle = (self.box.mean(dim=0) - self.eye) @ self._optical
        self._side = int(2 * WINDOW_M / CELL_M)
        self._cell = CELL_M / middle[2]
        self._corner = middle[:2] / middle[2] - 0.5 * self._side * self._cell
        self._low = self.box[0] - REACH_M
        self._voxels = [
            int(size) for size in ((self.box[1] - self.box[0] + 2 * REACH_M) / TOUCH_M).ceil()
        ]
        self._depth = torch.empty((count, self.cells), device=place)
        self._near = torch.zeros(
            (count, int(np.prod(self._voxels)) + 1), dtype=torch.bool, device=place
        )
        self.joints = random_joints(hand, count, device)
        """Joint positions of the postures [rad] [M, D]."""
        for rows in torch.arange(count, device=place).split(POSTURES_AT_ONCE):
            points = posture_points(hand, self.joints[rows])
            cell, depth = self.project(points)
            self._depth[rows] = nearest(cell, depth, self.cells)
            voxel = self._voxel(points)
            near = self._near[rows]
            self._near[rows] = near.scatter_(1, voxel, torch.ones_like(voxel, dtype=torch.bool))
        self._depth[:, -1], self._near[:, -1] = torch.inf, False  # what is outside

    @property
    def cells(self) -> int:
        """Cells of a depth map; the last is of all that is outside."""
        return self._side**2 + 1

    def project(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Cells of a depth map and depths [m] of points, [B, P] each."""
        x, y, depth = ((points - self.eye) @ self._optical).unbind(-1)
        across, down = (
            ((v / depth - low) / self._cell).floor().long()
            for v, low in zip((x, y), self._corner, strict=True)
        )
        inside = (
            (across >= 0)
            & (across < self._side)
            & (down >= 0)
            & (down < self._side)
            & (depth > 0.0)
        )
        return torch.where(inside, down * self._side + across, self.cells - 1), depth

    def free(
        self, rows: torch.Tensor, points: torch.Tensor, cell: torch.Tensor, depth: torch.Tensor
    ) -> torch.Tensor:
        """Which points [B, P, 3] are neither behind nor beside the hands ``rows`` [B]; [B, P]."""
        each = rows[:, None]
        return (depth < self._depth[each, cell]) & ~self._near[each, self._voxel(points)]

    def holding(self, points: torch.Tensor) -> torch.Tensor:
        """For shapes with points [B, P, 3] hands that are about them, at random [B]."""
        rows = torch.randint(self.count, (len(points), TRIED_HANDS), device=points.device)
        touched = self._near[rows[:, :, None], self._voxel(points[:, None, :TRIED_POINTS])].sum(
            dim=-1
        )
        return rows.take_along_dim(touched.argmax(dim=1, keepdim=True), dim=1).squeeze(1)

    def _voxel(self, points: torch.Tensor) -> torch.Tensor:
        """Voxels of points [B, P]; the last is outside."""
        at = ((points - self._low) / TOUCH_M).floor().long()
        x, y, z = self._voxels
        inside = (at >= 0).all(dim=-1) & (at < torch.tensor(self._voxels, device=at.device)).all(
            dim=-1
        )
        return torch.where(inside, (at[..., 0] * y + at[..., 1]) * z + at[..., 2], x * y * z)


def random_joints(hand: HandModel, count: int, device: str) -> torch.Tensor:
    """Random joint positions within their limits [rad] [count, D]."""
    place = wp.device_to_torch(device)
    lower = torch.tensor(hand.lower, dtype=torch.float32, device=place)
    upper = torch.tensor(hand.upper, dtype=torch.float32, device=place)
    return lower + (upper - lower) * torch.rand((count, len(lower)), device=place)


def posture_points(hand: HandModel, joints: torch.Tensor) -> torch.Tensor:
    """The hand's own points at joint positions [rad] [M, D], base frame [m] [M, H, 3]."""
    links = np.arange(len(hand.link_names))
    device = str(as_warp(joints).device)
    poses = wp.empty((len(joints), len(links)), dtype=wp.transform, device=device)
    cloud = HandCloud(hand, link_body=links, device=device)
    cloud.pose(as_warp(joints), poses)
    return wp.to_torch(cloud(poses))


def nearest(cell: torch.Tensor, depth: torch.Tensor, cells: int) -> torch.Tensor:
    """Depth maps [m] [B, cells] of points in cells at depths, [B, P] each.

    Infinite where there are none.
    """
    empty = torch.full((len(cell), cells), torch.inf, device=cell.device)
    return empty.scatter_reduce_(1, cell, depth, "amin")


def visible(hands: Hands, rows: torch.Tensor, shapes: torch.Tensor) -> torch.Tensor:
    """Which points a camera sees and tells from the hand [B, P].

    Args:
        hands: The hands.
        rows: Which of them holds each shape [B].
        shapes: Points [m] and normals [B, P, 6].
    """
    points = shapes[..., :3]
    ray = normalize(points - hands.eye, dim=-1)
    facing = (shapes[..., 3:] * ray).sum(dim=-1) < FACING
    cell, depth = hands.project(points)
    front = torch.where(facing, depth, torch.inf)
    shown = facing & (depth < nearest(cell, front, hands.cells).gather(1, cell) + SLACK_M)
    free = shown & hands.free(rows, points, cell, depth)
    enough = free.sum(dim=1, keepdim=True) >= LEAST_SEEN
    return torch.where(enough, free, facing)


def camera_points(
    hands: Hands, rows: torch.Tensor, shapes: torch.Tensor, count: int
) -> torch.Tensor:
    """Points [m] [B, count, 3] that a camera has of shapes, with errors.

    Arguments as of :func:`visible`.
    """
    points, device = shapes[..., :3], shapes.device
    batch = len(points)
    shown = visible(hands, rows, shapes)
    kept = shown
    middles = points[
        torch.arange(batch, device=device)[:, None], drawn(shown.float(), LOST_PATCHES)
    ]
    for middle in middles.unbind(1):
        radius = LOST_RADIUS_M * torch.rand((batch, 1), device=device)
        kept = kept & ((points - middle[:, None]).norm(dim=-1) > radius)
    kept = torch.where(kept.sum(dim=1, keepdim=True) >= LEAST_SEEN, kept, shown)
    seen = points.take_along_dim(drawn(kept.float(), count)[..., None], dim=1)
    std = DEPTH_STD_M * torch.rand((batch, 1, 1), device=device)
    ray = normalize(seen - hands.eye, dim=-1)
    noise = POINT_STD_M * torch.randn_like(seen)
    return seen + noise + std * torch.randn((batch, count, 1), device=device) * ray


def goal_points(points: torch.Tensor, count: int, scans: float) -> torch.Tensor:
    """Clouds of goals [m] [B, count, 3], the first points of whole shapes [m] [B, P, 3], in no order.

    A share ``scans`` is as :func:`vd.evaluate.scanned.scan` has them: a side is missing, others
    stand for it, and points are noisy.
    """
    goal, device = points[:, :count], points.device
    scan = torch.rand((len(goal), 1), device=device) < scans
    height = (goal @ torch.randn((len(goal), 3, 1), device=device)).squeeze(-1)
    there = height <= height.kthvalue(round((1.0 - MISSING) * count), dim=1, keepdim=True).values
    index = torch.arange(count, device=device).expand(len(goal), -1)
    index = torch.where(scan & ~there, drawn(there.float(), count), index)
    return goal.take_along_dim(index[..., None], dim=1) + NOISE_M * scan[
        ..., None
    ] * torch.randn_like(goal)


def draw_pairs(
    hands: Hands, shapes: torch.Tensor, count: int, *, near: float = 0.0, scans: float = 0.0
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
    batch, device = len(shapes), shapes.device
    shapes = shapes[:, torch.randperm(shapes.shape[1], device=device)].float()
    orientation = random_matrices(batch, device)
    held = orientation.transpose(-1, -2)
    place = hands.box[0] + (hands.box[1] - hands.box[0]) * uniform(
        0.0, 1.0, batch, 3, device=device
    )
    rest = shapes[:, count:]
    posed = torch.cat([rest[..., :3] @ held + place[:, None], rest[..., 3:] @ held], dim=-1)
    seen = camera_points(hands, hands.holding(posed[..., :3]), posed, count)
    return with_goals(shapes[..., :3], orientation, place, seen, near=near, scans=scans)


def with_goals(
    shapes: torch.Tensor,
    orientation: torch.Tensor,
    place: torch.Tensor,
    seen: torch.Tensor,
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
    batch, device = len(shapes), shapes.device
    angle = NEAR_RAD * torch.rand(batch, device=device)
    small = matrices(two_columns(rotations_about(torch.randn((batch, 3), device=device), angle)))
    is_near = torch.rand((batch, 1, 1), device=device) < near
    turn = torch.where(is_near, small, random_matrices(batch, device))
    wanted = orientation.transpose(-1, -2) @ turn  # its transpose turns the shape to the goal
    goal = goal_points(shapes, seen.shape[1], scans)
    middle, mean = goal.mean(dim=1, keepdim=True), seen.mean(dim=1)
    return Pairs(
        (goal - middle) @ wanted,
        seen - mean[:, None],
        turn,
        (middle @ orientation.transpose(-1, -2))[:, 0] + place - mean,
        (shapes - middle) @ wanted,
    )


def joined(first: Pairs, second: Pairs) -> Pairs:
    """Pairs of both, one after the other."""
    return Pairs(
        *(torch.cat([getattr(pairs, f.name) for pairs in (first, second)]) for f in fields(Pairs))
    )
