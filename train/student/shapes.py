"""Shapes without end for the training of vision, made on the device.

Clouds of points with outward normals.

A shape is a union of bodies, superquadrics and tori, some of them hollowed, and then deformed; or
the mesh of an object, deformed. Bodies are made at the size of 1 and brought to metres at the end.

K shapes, P points. Points and normals lie in the shape's own axes; normals have unit length.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from vd.vision.rotations import quaternion_matrices, random_rotations

BODIES = 5
"""Bodies of a shape at most: cups, tools and figures of a few parts are among the unions of so
many.
"""
CANDIDATES = 3072
"""Points of each body, of which those on the union's surface are drawn: more than a shape has in
all.
"""
HALF_AXES = (0.06, 0.56)
"""Half axes of a superquadric, drawn evenly in the logarithm: rods, plates and lumps."""
FIRST_GROWN = 1.5
"""How much larger the first body is, which the others are parts of."""
BOX_EXPONENT = 0.2
"""Exponent of flat faces and sharp edges; half of the superquadrics' are this one, as of things
made.
"""
ROUND_EXPONENTS = (0.2, 1.4)
"""Range of the others: 1 is round, more is pointed."""
TORI = (0.05, 0.12)
"""Share of tori among first bodies, and among their parts: handles."""
RING_RADII, TUBE_RADII = (0.2, 0.5), (0.04, 0.12)
"""Radii of tori."""
HOLLOWS = 0.25
"""Share of shapes whose first body is hollowed, as cups are."""
WALL, DEPTH = 0.85, 0.35
"""The hollow is the body, this much narrower, and moved along its axis by this part of its half
axis.
"""
MESH_UNIT_M = 1.0 / 6.0
"""Length of a mesh that is deformed as if it was 1: of the objects the longest sides are about as
long.
"""
MESH_STRENGTH = 0.8
"""How strongly meshes are deformed, of how strongly bodies are: what they are stays to be seen."""
TANGENT = 1e-3
"""Step by which tangents are taken through a deformation."""
TINY = 1e-4
"""Relative distance under a surface that counts as on it."""


def uniform(low: float | Tensor, high: float | Tensor, *shape: int, device: torch.device) -> Tensor:
    """Numbers uniform in a range, of a shape."""
    return low + (high - low) * torch.rand(shape, device=device)


def random_matrices(count: int, device: torch.device) -> Tensor:
    """Rotation matrices uniform on SO(3) [count, 3, 3]."""
    return quaternion_matrices(random_rotations(count, device))


def drawn(weights: Tensor, count: int) -> Tensor:
    """Columns drawn in proportion to weights [K, P], with repetition: indices [K, count].

    By the running sum: ``torch.multinomial`` takes several times as long.
    """
    total = weights.cumsum(dim=1)
    at = torch.rand((len(weights), count), device=weights.device) * total[:, -1:]
    return torch.searchsorted(total, at, right=True).clamp(max=weights.shape[1] - 1)


@dataclass(frozen=True)
class Bodies:
    """K bodies, each a superquadric or a torus, about their own centres and axes."""

    half: Tensor
    """Half axes of superquadrics [K, 3]."""
    exponents: Tensor
    """Their exponents: along z, and around it [K, 2]."""
    ring: Tensor
    """Which are tori about z instead [K]."""
    radii: Tensor
    """Radii of tori: of the ring, and of the tube [K, 2]."""
    turn: Tensor
    """From their axes to the shape's [K, 3, 3]."""
    centre: Tensor
    """In the shape's axes [K, 3]."""

    def level(self, points: Tensor) -> Tensor:
        """How far out points [K, P, 3] of the shape's axes are.

        0 on the surface, -1 in the middle [K, P].
        """
        own = (points - self.centre[:, None]) @ self.turn
        ring, tube = self.radii.split(1, dim=1)
        beside = own[..., :2].norm(dim=-1) - ring
        radius = (beside.square() + own[..., 2].square()).sqrt()
        value, _ = _superquadric(own / self.half[:, None], self.exponents)
        quadric = value ** (0.5 * self.exponents[:, :1])
        return torch.where(self.ring[:, None], radius / tube, quadric) - 1.0

    def sample(self, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Points of the surfaces and normals [K, count, 3], and the area each stands for [K, count]."""
        quadric = self._quadric_points(count)
        torus = self._torus_points(count)
        ring = self.ring[:, None]
        points = torch.where(ring[..., None], torus[0], quadric[0])
        normals = torch.where(ring[..., None], torus[1], quadric[1])
        area = torch.where(ring, torus[2], quadric[2])
        back = self.turn.mT
        return points @ back + self.centre[:, None], normals @ back, area

    def _quadric_points(self, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Where rays from the middle meet the surface; a ray stands for its solid angle."""
        half = self.half[:, None]
        direction = torch.randn((len(half), count, 3), device=half.device)
        ray = normalize(direction, dim=-1) * half
        length = ray.norm(dim=-1)
        ray = ray / length[..., None]
        value, _ = _superquadric(ray / half, self.exponents)
        reach = value ** (-0.5 * self.exponents[:, :1])
        points = ray * reach[..., None]
        _, slope = _superquadric(points / half, self.exponents)
        normals = normalize(slope / half, dim=-1)
        angle = half.prod(dim=-1) / length**3
        # Along a flat ray an area is seen as its cosine; those of edges would have no end.
        cosine = (normals * ray).sum(dim=-1).clamp_min(0.05)
        return points, normals, 4.0 * math.pi * angle * reach.square() / cosine

    def _torus_points(self, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Points at angles about the ring and the tube."""
        ring, tube = self.radii.split(1, dim=1)
        about, around = uniform(0.0, 2.0 * math.pi, 2, len(ring), count, device=ring.device)
        outwards = torch.stack([about.cos(), about.sin(), torch.zeros_like(about)], dim=-1)
        normals = around.cos()[..., None] * outwards
        normals[..., 2] = around.sin()
        points = ring[..., None] * outwards + tube[..., None] * normals
        return points, normals, 4.0 * math.pi**2 * tube * (ring + tube * around.cos())


def _superquadric(x: Tensor, exponents: Tensor) -> tuple[Tensor, Tensor]:
    """The implicit function of points in units of half axes [K, P, 3], and the direction of its gradient.

    It is 1 on the surface. Of x and y the larger is taken out of powers, which would leave single
    precision.
    """
    along, around = 2.0 / exponents[:, :1], 2.0 / exponents[:, 1:]
    size = x.abs().clamp_min(1e-6)
    larger = size[..., :2].amax(dim=-1)
    x1 = size[..., 0] / larger
    y1 = size[..., 1] / larger
    z1 = size[..., 2]
    both = x1**around + y1**around
    value = both ** (along / around) * larger**along + z1**along
    flat = both ** (along / around - 1.0) * larger ** (along - 1.0)
    slopes = [
        flat * x1 ** (around - 1.0),
        flat * y1 ** (around - 1.0),
        z1 ** (along - 1.0),
    ]
    return value, torch.stack(slopes, dim=-1) * x.sign()


def random_bodies(count: int, place: int, device: torch.device) -> Bodies:
    """Bodies about the origin.

    Args:
        count: K.
        place: Number of the body in its shape, 0 for the first.
        device: Torch device.
    """
    low, high = map(math.log, HALF_AXES)
    half = uniform(low, high, count, 3, device=device).exp() * (1.0 if place else FIRST_GROWN)
    exponents = uniform(*ROUND_EXPONENTS, count, 2, device=device)
    boxes = torch.rand((count, 2), device=device) < 0.5
    ring = uniform(*RING_RADII, count, device=device)
    tube = uniform(*TUBE_RADII, count, device=device)
    return Bodies(
        half,
        torch.where(boxes, BOX_EXPONENT, exponents),
        torch.rand(count, device=device) < TORI[min(place, 1)],
        torch.stack([ring, tube], dim=1),
        random_matrices(count, device),
        torch.zeros((count, 3), device=device),
    )


def draw_parts(count: int, device: torch.device) -> tuple[list[Bodies], list[Tensor], Tensor]:
    """The bodies of shapes, their points, normals and areas [K, P, 3 + 3 + 1], and how many count [K].

    Each body is about a point of one before it. Half have the first one's axes, as things that are
    made.
    """
    number = torch.randint(1, BODIES + 1, (count,), device=device)
    bodies: list[Bodies] = []
    samples: list[Tensor] = []
    for place in range(BODIES):
        body = random_bodies(count, place, device)
        if place:
            same = torch.rand((count, 1, 1), device=device) < 0.5
            earlier = torch.stack(samples, dim=1)[..., :3]
            rows = torch.arange(count, device=device)
            parent = torch.randint(place, (count,), device=device).minimum(number - 1)
            point = torch.randint(CANDIDATES, (count,), device=device)
            turn = torch.where(same, bodies[0].turn, body.turn)
            body = replace(body, turn=turn, centre=earlier[rows, parent, point])
        points, normals, area = body.sample(CANDIDATES)
        bodies.append(body)
        samples.append(torch.cat([points, normals, area[..., None]], dim=-1))
    return bodies, samples, number


def unions(count: int, points: int, device: torch.device) -> Tensor:
    """Unions of bodies, some hollowed, at their own size: points and normals [count, points, 6]."""
    bodies, samples, number = draw_parts(count, device)
    first = bodies[0]
    hollowed = (torch.rand(count, device=device) < HOLLOWS) & ~first.ring
    narrow = torch.tensor([WALL, WALL, 1.0], device=device)
    shift = DEPTH * first.half[:, 2:] * first.turn[:, :, 2]
    hollow = replace(first, half=narrow * first.half, centre=first.centre + shift)
    inner, inwards, area = hollow.sample(CANDIDATES)
    samples.append(torch.cat([inner, -inwards, area[..., None]], dim=-1))
    there = [(number > place)[:, None] for place in range(BODIES)] + [hollowed[:, None]]
    outside = []
    for place, sample in enumerate(samples):
        at = sample[..., :3]
        free = there[place]
        for other, body in enumerate([*bodies, hollow]):
            if place == BODIES and other == 0:  # the wall of a hollow is inside of its body
                free = free & (body.level(at) < 0.0)
            elif other != place:
                free = free & ~((body.level(at) < -TINY) & there[other])
        outside.append(free)
    everything = torch.cat(samples, dim=1)
    area = everything[..., 6] * torch.cat(outside, dim=1)
    index = drawn(area, points)
    return everything[..., :6].take_along_dim(index[..., None], dim=1)


@dataclass(frozen=True)
class Deformation:
    """Smooth maps of space, one of each of K shapes whose size is about 1."""

    turn: Tensor
    """Axes in which they deform [K, 3, 3]."""
    scale: Tensor
    """Uneven scale [K, 3]."""
    taper: Tensor
    """Growth across x per unit of x [K]."""
    twist: Tensor
    """About x [rad per unit] [K]."""
    bend: Tensor
    """Curvature of the x axis in the xy plane [1 / unit] [K]."""
    waves: Tensor
    """Three waves: amplitudes, wave numbers, phases (of which the first is used) [K, 3, 3, 3]."""

    @staticmethod
    def draw(count: int, strength: float, device: torch.device) -> "Deformation":
        """Random ones; half of the shapes are not tapered, bent or waved at all, most are not twisted."""

        def sometimes(share: float, most: float, *shape: int) -> Tensor:
            on = torch.rand((count, *(1 for _ in shape)), device=device) < share
            return uniform(-most * strength, most * strength, count, *shape, device=device) * on

        waves = (
            sometimes(0.5, 0.04, 3, 3),
            uniform(-4.0, 4.0, count, 3, 3, device=device),
            uniform(0.0, 2.0 * math.pi, count, 3, 3, device=device),
        )
        return Deformation(
            random_matrices(count, device),
            sometimes(1.0, 0.45, 3).exp(),
            sometimes(0.5, 0.5),
            sometimes(0.2, 1.0),
            sometimes(0.4, 1.0),
            torch.stack(waves, dim=1),
        )

    def __call__(self, points: Tensor) -> Tensor:
        """Points [K, P, 3] where they come to lie."""
        x, y, z = (points @ self.turn.mT * self.scale[:, None]).unbind(-1)
        wider = (1.0 + self.taper[:, None] * x).clamp_min(0.3)  # never inside out
        y = wider * y
        z = wider * z
        angle = self.twist[:, None] * x
        turned = y * angle.cos() - z * angle.sin()
        z = y * angle.sin() + z * angle.cos()
        y = turned
        # By sin(a) / a, which has no pole where nothing is bent.
        angle = self.bend[:, None] * x
        along = x * torch.sinc(angle / math.pi) - y * angle.sin()
        across = 0.5 * x * angle * torch.sinc(0.5 * angle / math.pi).square() + y * angle.cos()
        bent = torch.stack((along, across, z), dim=-1)
        amplitude, number, phase = self.waves.unbind(1)
        angle = bent @ number.mT + phase[:, None, :, 0]  # [K, P, 3 waves]
        return bent + torch.sin(angle) @ amplitude


def deformed(shapes: Tensor, deformation: Deformation) -> Tensor:
    """Points and normals [K, P, 6] after a deformation.

    The tangents at each point are deformed with it.
    """
    points, normals = shapes[..., :3], shapes[..., 3:]
    x, y = torch.eye(3, device=shapes.device)[:2]
    other = torch.where(normals[..., :1].abs() < 0.7, x, y)
    across = normalize(torch.linalg.cross(normals, other), dim=-1)
    along = torch.linalg.cross(normals, across)
    at = deformation(points)
    across = deformation(points + TANGENT * across) - at
    along = deformation(points + TANGENT * along) - at
    normals = normalize(torch.linalg.cross(across, along), dim=-1)
    return torch.cat([at, normals], dim=-1)


def sized(shapes: Tensor, sides: tuple[float, float]) -> Tensor:
    """Shapes about the mean of their points [m] with longest sides in a range [m], drawn evenly.

    Points and normals [K, P, 6].
    """
    points = shapes[..., :3] - shapes[..., :3].mean(dim=1, keepdim=True)
    longest = (points.amax(dim=1) - points.amin(dim=1)).amax(dim=-1)
    wanted = uniform(*sides, len(points), device=points.device)
    points = points * (wanted / longest)[:, None, None]
    return torch.cat([points, shapes[..., 3:]], dim=-1)


def made_shapes(
    count: int, points: int, sides: tuple[float, float], device: torch.device
) -> Tensor:
    """Unions of bodies, deformed, of :func:`sized`: points [m] and normals [count, points, 6]."""
    bodies = unions(count, points, device)
    return sized(deformed(bodies, Deformation.draw(count, 1.0, device)), sides)


def mesh_shapes(meshes: Tensor, count: int, points: int, sides: tuple[float, float]) -> Tensor:
    """Objects drawn from meshes, deformed.

    Args:
        meshes: Points [m] and normals of the objects' surfaces [O, P', 6].
        count: K.
        points: P, at most P'.
        sides: Shortest and longest longest side of a shape [m].

    Returns:
        Points [m] and normals [count, points, 6].
    """
    device = meshes.device
    rows = torch.randint(len(meshes), (count, 1), device=device)
    columns = torch.randperm(meshes.shape[1], device=device)[:points]
    some = meshes[rows, columns].float()
    some[..., :3] /= MESH_UNIT_M
    return sized(deformed(some, Deformation.draw(count, MESH_STRENGTH, device)), sides)
