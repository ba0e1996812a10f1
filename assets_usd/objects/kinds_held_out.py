"""Kinds of the held-out families, which no training family contains. Conventions as in :mod:`.procedural`."""

from itertools import pairwise

import numpy as np

from vd.assets_usd.objects.geometry import Hull
from vd.assets_usd.objects.primitives import box, cylinder, prism, rod


def mug(rng: np.random.Generator) -> list[Hull]:
    """Five walls, a bottom, a handle of two rods: open, so truly concave."""
    radius, height, wall = rng.uniform(0.8, 1.0), rng.uniform(1.5, 2.2), rng.uniform(0.14, 0.2)
    angles = 2.0 * np.pi * np.arange(6) / 5
    bottom = [(0.95 * radius * np.cos(t), 0.95 * radius * np.sin(t)) for t in angles[:5]]
    parts = [prism(bottom, 0.0, 1.4 * wall, axis="z")]
    for start, end in pairwise(angles):
        outline = [(r * np.cos(t), r * np.sin(t)) for r in (radius, radius - wall) for t in (start, end)]
        parts.append(prism(outline, 0.0, height, axis="z"))
    reach = rng.uniform(0.5, 0.8)
    low, high = 0.2 * height, rng.uniform(0.7, 0.9) * height
    corner = (-radius - reach, 0.0, rng.uniform(0.4, 0.6) * height)
    # The middle of the wall opposite the first corner; the rod's cap must not come through it.
    inner = -radius * np.cos(np.pi / 5) - 0.04
    parts += [rod((inner, 0, low), corner, 0.15), rod(corner, (inner, 0, high), 0.15)]
    return parts


def chair(rng: np.random.Generator) -> list[Hull]:
    """Seat, back, four legs, two arm rests."""
    width, depth, leg, back = (rng.uniform(a, b) for a, b in ((1.1, 1.4), (1.0, 1.3), (0.8, 1.2), (1.0, 1.5)))
    thick, splay, lean = rng.uniform(0.14, 0.2), rng.uniform(0.0, 0.15), rng.uniform(0.0, 0.25)
    parts = [
        box((0, 0, leg), (depth, width, 0.24)),
        box((-depth / 2 - lean / 2, 0, leg + back / 2), (0.22, 0.9 * width, back + 0.2), euler=(0, -lean, 0)),
    ]
    for x in (-1, 1):
        for y in (-1, 1):
            top = np.array([x * (depth / 2 - thick), y * (width / 2 - thick), leg])
            parts.append(rod(top, top * (1 + splay, 1 + splay, 0), thick, 0.8 * thick))
    arm = rng.uniform(0.35, 0.5)
    rear = -depth / 2 - 0.1
    rest = [(rear, leg), (depth * 0.3, leg), (depth * 0.4, leg + arm), (rear, leg + arm)]
    return parts + [prism(rest, y * width / 2 - 0.1, y * width / 2 + 0.1) for y in (-1, 1)]


def robot(rng: np.random.Generator) -> list[Hull]:
    """Torso, head, arms and legs in a pose, backpack."""
    width, height = rng.uniform(0.8, 1.1), rng.uniform(0.9, 1.3)
    parts = [
        box((0, 0, height / 2), (0.6, width, height), top=(1.0, 1.15)),
        box((0.05, 0, height + 0.22), (0.5, 0.55, 0.5), euler=(0, 0, rng.uniform(-0.5, 0.5))),
        box((-0.45, 0, 0.6 * height), (0.4, 0.6 * width, 0.6 * height)),
    ]
    for side in (-1, 1):
        shoulder = np.array([0.0, side * width * 0.55, height - 0.15])
        swing = rng.uniform(-0.9, 2.2)
        hand = shoulder + np.array([np.sin(swing), 0.3 * side, -np.cos(swing)]) * rng.uniform(0.8, 1.0)
        parts.append(rod(shoulder, hand, 0.2, 0.16))
        step = rng.uniform(-0.35, 0.35)
        parts.append(
            rod((0, side * 0.27 * width, 0.1), (step, side * 0.3 * width, -rng.uniform(0.8, 1.0)), 0.24, 0.22)
        )
    parts.append(
        cylinder((0, 0.15, height + 0.4), (-0.1, 0.2, height + rng.uniform(0.7, 1.0)), 0.08, 0.12, sides=8)
    )
    return parts


def camera(rng: np.random.Generator) -> list[Hull]:
    """Body, lens, hood, grip, finder, dial, strap lug."""
    width, height, depth = rng.uniform(1.7, 2.2), rng.uniform(1.0, 1.3), rng.uniform(0.5, 0.7)
    lens = rng.uniform(0.36, 0.46)
    reach = depth / 2 + rng.uniform(0.4, 0.9)
    offset = rng.uniform(-0.3, 0.1)
    return [
        box((0, 0, 0), (depth, width, height)),
        cylinder((0, offset, 0), (reach, offset, 0), lens),
        cylinder((reach - 0.1, offset, 0), (reach + 0.3, offset, 0), lens, 1.2 * lens),
        rod((0.25, width / 2 - 0.15, -0.3 * height), (0.25, width / 2 - 0.15, 0.35 * height), 0.26),
        box((0, offset, height / 2 + 0.1), (0.9 * depth, 0.6, 0.45), top=(0.8, 0.6)),
        cylinder((0, width / 2 - 0.3, 0.4 * height), (0, width / 2 - 0.3, height / 2 + 0.2), 0.2, sides=10),
    ]
