"""The rotations that map a shape onto itself, as far as a depth camera could tell.

Found by registration: the shape's own samples are looked for, from many rotations, and where they lie on its
surface again the rotation is one of its symmetries. A shape's own file may declare them, as those of our
solids do. Object frame; quaternions xyzw.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
import warp as wp
from scipy.sparse.csgraph import connected_components

from vd.assets_usd.objects.model import ObjectModel
from vd.student.quaternions import product, rotation_distance
from vd.student.registration import POINTS, Registration

SAME = 0.012
"""A shape looks the same up to this root mean square of the distance of turned samples from its surface, as
a share of the longest side: 1.4 mm at 12 cm. Procedural objects differ by more in the mean."""
STEPS, EVERY = 12, 2
"""Steps of each rotation, and every so many-th sample they look at."""
APART_RAD = 0.12
"""Least angle between two symmetries: a solid of revolution has some fifty."""
BESIDE_RAD = 0.4
"""Rotations nearer to each other than this are neighbours; those tried are some 0.25 rad apart."""
AROUND_RAD = 2.0
"""Rotations that neighbour the identity, one after the other, as far as this go around."""
MOST = 128
"""Symmetries of a shape at most: a ball has more."""


_found: dict[bytes, np.ndarray] = {}
"""Symmetries of the shapes that were asked for before: looking for those of one takes a processor 0.3 s."""


def symmetries(objects: Sequence[ObjectModel], device: str) -> list[np.ndarray]:
    """Symmetries of shapes, the identity first: quaternions [S, 4] for each.

    Args:
        objects: The shapes.
        device: Warp device.
    """
    keys = [_key(item) for item in objects]
    unknown = {}
    for key, item in zip(keys, objects, strict=True):
        if len(item.symmetry) > 1:
            _found[key] = np.asarray(item.symmetry, dtype=np.float32)
        elif key not in _found:
            unknown[key] = item
    if unknown:
        _found.update(zip(unknown, _search(list(unknown.values()), device), strict=True))
    return [_found[key] for key in keys]


def with_symmetries(objects: Sequence[ObjectModel], device: str) -> list[ObjectModel]:
    """Objects that declare their symmetries."""
    found = symmetries(objects, device)
    return [replace(item, symmetry=turns) for item, turns in zip(objects, found, strict=True)]


def symmetries_of_worlds(
    objects: Sequence[ObjectModel], world_object: np.ndarray, device: str
) -> torch.Tensor:
    """Symmetries of the object of each world [N, S, 4], the identity where a shape has fewer than another.

    Args:
        objects: The shapes.
        world_object: Object of each world, shape [N].
        device: Warp device.
    """
    found = symmetries(objects, device)
    turns = np.zeros((len(found), max(map(len, found)), 4), dtype=np.float32)
    turns[..., 3] = 1.0
    for row, own in zip(turns, found, strict=True):
        row[: len(own)] = own
    return torch.tensor(turns[np.asarray(world_object)], device=wp.device_to_torch(device))


def equivalent_goals(goal: torch.Tensor, turns: torch.Tensor) -> torch.Tensor:
    """Orientations that look like the wanted one.

    Args:
        goal: Wanted orientations [N, 4].
        turns: Symmetries of each world's shape [N, S, 4].

    Returns:
        Orientations [N, S, 4], the wanted one first.
    """
    return product(goal[:, None].expand_as(turns), turns)


def nearest_goal(orientation: torch.Tensor, goal: torch.Tensor, turns: torch.Tensor) -> torch.Tensor:
    """Of the orientations that look like the wanted one the nearest [N, 4]; arguments [N, 4], [N, S, 4]."""
    goals = equivalent_goals(goal, turns)
    angle = rotation_distance(orientation[:, None].expand_as(goals), goals)
    best = angle.argmin(dim=1)
    return goals[torch.arange(len(goals), device=goals.device), best]


def _key(item: ObjectModel) -> bytes:
    """What tells one shape from another."""
    parts = (item.vertices, item.faces, item.surface_points)
    return hashlib.sha1(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).digest()


def _search(items: Sequence[ObjectModel], device: str) -> list[np.ndarray]:
    """Symmetries of shapes by registration of each with itself."""
    itself = Registration(
        items, world_object=np.arange(len(items)), world_scale=np.ones(len(items)), camera=None, device=device
    )
    # Samples are in an order in which any leading part of them is evenly spread.
    place = wp.device_to_torch(device)
    seen = torch.tensor(np.stack([item.surface_points[:POINTS] for item in items]), device=place)
    count = torch.full((len(items),), seen.shape[1], dtype=torch.int32, device=place)
    poses, misfits = itself.tried(seen, count, steps=STEPS, every=EVERY)
    found = []
    for item, turns, misfit in zip(items, poses[..., 3:].cpu(), misfits.cpu(), strict=True):
        fits = int((misfit < (SAME * item.longest_side) ** 2).sum())
        found.append(_distinct(turns[misfit.argsort()[:fits]].numpy()))
    return found


def _distinct(turns: np.ndarray) -> np.ndarray:
    """Symmetries among the rotations that fit, best first [R, 4]: the identity, then others [S, 4].

    A small turn of any shape fits too, and so do turns that differ little from a symmetry. Of rotations that
    neighbour each other only the best counts, unless those that neighbour the identity go around: then the
    shape is one of revolution, and all count.
    """
    chosen = np.array([[0.0, 0.0, 0.0, 1.0]], dtype=np.float32)
    for turn in turns:
        if len(chosen) < MOST and _angles(chosen, turn).min() > APART_RAD:
            chosen = np.concatenate([chosen, turn[None]])
    angle = _angles(chosen[:, None], chosen[None])
    _, family = connected_components(angle < BESIDE_RAD)
    if angle[0, family == family[0]].max() > AROUND_RAD:
        return chosen
    return chosen[np.sort(np.unique(family, return_index=True)[1])]


def _angles(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angles between quaternions [.., 4] [rad]."""
    return 2.0 * np.arccos(np.minimum(np.abs((first * second).sum(axis=-1)), 1.0))
