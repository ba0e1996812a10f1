"""Kinds of the held-out families, which no training family contains. Conventions as in :mod:`.families`."""

from itertools import pairwise

import numpy as np

from vd.assets_usd.objects.geometry import Hull
from vd.assets_usd.objects.primitives import box, cylinder, ellipsoid, prism, rod, vec


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


def teapot(rng: np.random.Generator) -> list[Hull]:
    """Belly, spout, handle of three rods, lid, knob."""
    belly = np.array([rng.uniform(0.9, 1.1), rng.uniform(0.8, 1.0), rng.uniform(0.7, 0.9)])
    reach, top = belly[0] + rng.uniform(0.4, 0.6), rng.uniform(0.3, 0.5)
    return [
        ellipsoid((0, 0, 0), belly),
        rod(
            (0.7 * belly[0], 0, -0.2),
            (belly[0] + rng.uniform(0.5, 0.8), 0, rng.uniform(0.4, 0.8)),
            0.28,
            0.14,
        ),
        rod((-0.7 * belly[0], 0, top), (-reach, 0, top), 0.13),
        rod((-reach, 0, top), (-reach, 0, -0.3), 0.13),
        rod((-reach, 0, -0.3), (-0.7 * belly[0], 0, -0.4), 0.13),
        cylinder((0, 0, 0.6 * belly[2]), (0, 0, belly[2] + 0.1), 0.5, 0.4),
        ellipsoid((0, 0, belly[2] + 0.2), (0.17, 0.17, 0.2)),
        cylinder((0, 0, -belly[2] - 0.1), (0, 0, -0.5), 0.55, 0.6),
    ]


def pan(rng: np.random.Generator) -> list[Hull]:
    """Bowl block, long handle, hook, spout lip."""
    radius, depth = rng.uniform(0.9, 1.1), rng.uniform(0.4, 0.7)
    length = rng.uniform(1.2, 1.8)
    return [
        cylinder((0, 0, 0), (0, 0, depth), 0.85 * radius, radius),
        rod(
            (-0.8 * radius, 0, 0.7 * depth), (-radius - length, 0, depth + rng.uniform(0.0, 0.5)), 0.17, 0.15
        ),
        box((radius * 0.2, radius, 0.85 * depth), (0.4, 0.5, 0.24)),
        rod((0, -0.9 * radius, 0.8 * depth), (0, -radius - 0.35, 0.9 * depth), 0.14),
    ]


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


def desk_lamp(rng: np.random.Generator) -> list[Hull]:
    """Foot, two arms, joint, shade, switch."""
    elbow = np.array([-rng.uniform(0.4, 0.7), 0.0, rng.uniform(1.0, 1.4)])
    head = elbow + vec(rng.uniform(0.9, 1.3), 0.0, rng.uniform(0.3, 0.7))
    return [
        cylinder((0, 0, 0), (0, 0, 0.22), rng.uniform(0.6, 0.8), 0.55),
        rod((0, 0, 0.1), elbow, 0.15),
        rod(elbow, head, 0.15),
        ellipsoid(elbow, (0.24, 0.24, 0.24)),
        cylinder(head + vec(-0.1, 0, 0.15), head + vec(0.45, 0, -0.5), 0.2, rng.uniform(0.5, 0.65)),
        box((0.35, 0.2, 0.25), (0.2, 0.2, 0.2)),
    ]


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


def cactus(rng: np.random.Generator) -> list[Hull]:
    """Pot, trunk, two bent arms at unequal heights, flower."""
    height, thick = rng.uniform(2.0, 2.6), rng.uniform(0.3, 0.4)
    parts = [
        cylinder((0, 0, -0.6), (0, 0, 0.1), rng.uniform(0.45, 0.6), rng.uniform(0.6, 0.75)),
        rod((0, 0, 0), (rng.uniform(-0.15, 0.15), 0, height), thick, 0.85 * thick),
    ]
    turn = rng.uniform(-0.8, 0.8)
    for side, level in ((1, rng.uniform(0.35, 0.5)), (-1, rng.uniform(0.55, 0.75))):
        direction = side * np.array(
            [np.cos(turn if side > 0 else 0.0), np.sin(turn if side > 0 else 0.0), 0.0]
        )
        root = np.array([0.0, 0.0, level * height])
        elbow = root + direction * rng.uniform(0.7, 1.0)
        tip = elbow + vec(0, 0, rng.uniform(0.4, 0.8))
        parts += [rod(root, elbow, 0.62 * thick), rod(elbow, tip, 0.62 * thick, 0.55 * thick)]
    parts.append(ellipsoid((0.1, 0.1, height + thick), (0.22, 0.22, 0.16)))
    return parts
