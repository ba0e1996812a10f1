"""Shoes and tools.

Conventions as in :mod:`.procedural`.
"""

import numpy as np

from vd.assets_usd.objects.geometry import Hull
from vd.assets_usd.objects.primitives import beam, box, cylinder, ellipsoid, prism, rod, vec


def _sole(rng: np.random.Generator, length: float, width: float) -> list[tuple[float, float]]:
    """Convex outline of a left or right foot, heel at x = 0."""
    side = rng.choice([-1.0, 1.0])
    waist = rng.uniform(0.38, 0.45)
    outline = [
        (0.0, -0.25),
        (0.1, -0.4),
        (0.65, -0.55),
        (0.9, -0.4),
        (1.0, -0.1 + 0.2 * waist),
        (0.98, 0.25),
        (0.75, 0.48),
        (0.1, 0.38),
        (0.0, 0.22),
    ]
    return [(length * x, side * width * y) for x, y in outline]


def sneaker(rng: np.random.Generator) -> list[Hull]:
    """Sole, toe box, instep, collar, tongue, heel tab."""
    length, width, height = rng.uniform(2.4, 3.0), rng.uniform(0.9, 1.15), rng.uniform(0.9, 1.3)
    sole = _sole(rng, length, width)
    return [
        prism(sole, 0.0, rng.uniform(0.25, 0.4), axis="z"),
        ellipsoid((0.72 * length, 0, 0.38), (0.27 * length, 0.46 * width, rng.uniform(0.35, 0.5))),
        prism(
            [
                (0.2, 0.2),
                (0.75 * length, 0.2),
                (0.7 * length, 0.6),
                (0.45 * length, height),
                (0.2, 0.9 * height),
            ],
            -0.38 * width,
            0.38 * width,
        ),
        cylinder(
            (0.22 * length, 0, 0.3),
            (0.2 * length, 0, height + rng.uniform(0.1, 0.5)),
            0.4 * width,
            0.36 * width,
        ),
        box((0.45 * length, 0, height), (0.6, 0.35 * width, 0.16), euler=(0, -rng.uniform(0.6, 1.0), 0)),
    ]


def boot(rng: np.random.Generator) -> list[Hull]:
    """Sole, heel, foot, toe cap, shaft, cuff."""
    length, width, shaft = rng.uniform(2.0, 2.6), rng.uniform(0.8, 1.05), rng.uniform(1.6, 2.4)
    lean = rng.uniform(-0.2, 0.25)
    return [
        prism(_sole(rng, length, width), 0.2, 0.4, axis="z"),
        box((0.15 * length, 0, 0.13), (0.3 * length, 0.7 * width, 0.3), top=(1.0, 1.1)),
        rod((0.25 * length, 0, 0.7), (0.7 * length, 0, 0.6), 0.44 * width, 0.38 * width),
        ellipsoid((0.8 * length, 0, 0.55), (0.26 * length, 0.42 * width, rng.uniform(0.28, 0.36))),
        cylinder(
            (0.2 * length, 0, 0.4),
            (0.2 * length + lean, 0, 0.4 + shaft),
            0.4 * width,
            rng.uniform(0.42, 0.52) * width,
        ),
        box((0.2 * length + lean, 0, 0.3 + shaft), (1.1 * width, 1.1 * width, rng.uniform(0.2, 0.4))),
    ]


def heel_shoe(rng: np.random.Generator) -> list[Hull]:
    """Sloped sole, stiletto heel, toe box, counter, strap."""
    length, width, lift = rng.uniform(2.2, 2.7), rng.uniform(0.7, 0.9), rng.uniform(0.8, 1.3)
    return [
        prism(
            [
                (0.0, lift),
                (0.6, lift),
                (0.65 * length, 0.1),
                (0.65 * length, 0.0),
                (0.5 * length, 0.0),
                (0.0, lift - 0.15),
            ],
            -0.34 * width,
            0.34 * width,
        ),
        prism(_sole(rng, 0.55 * length, width) + np.array([0.5 * length, 0.0]), 0.0, 0.16, axis="z"),
        rod((0.15, 0, lift - 0.1), (0.1, 0, 0.1), 0.2, 0.1),
        ellipsoid((0.85 * length, 0, 0.2), (0.25 * length, 0.38 * width, 0.3)),
        cylinder((0.35, 0, lift - 0.1), (0.25, 0, lift + rng.uniform(0.35, 0.7)), 0.4 * width, 0.36 * width),
    ]


def hammer(rng: np.random.Generator) -> list[Hull]:
    """Handle, grip, head, face, two claws."""
    length = rng.uniform(2.6, 3.4)
    head = rng.uniform(0.22, 0.3)
    spread, drop = rng.uniform(0.12, 0.3), rng.uniform(0.2, 0.7)
    parts = [
        rod((0, 0, 0), (0, 0, length), 0.2, 0.16),
        rod((0, 0, 0), (0, 0, 0.4 * length), rng.uniform(0.22, 0.3)),
        box((0.0, 0, length), (0.8, 2 * head, 2 * head)),
        cylinder((0.3, 0, length), (rng.uniform(0.9, 1.3), 0, length), rng.uniform(1.1, 1.6) * head),
    ]
    claws = [
        rod((-0.3, side * 0.12, length), (-1.2, side * spread * 1.3, length - drop), 0.2, 0.1)
        for side in (-1, 1)
    ]
    return parts + claws


def wrench(rng: np.random.Generator) -> list[Hull]:
    """Open-ended, bent: handle, head, two jaws of unequal length, end plate."""
    length, depth = rng.uniform(2.4, 3.2), rng.uniform(0.3, 0.5)
    bend = rng.uniform(-0.7, 1.1)
    tip = np.array([length, bend])
    return [
        beam((0, 0), (0.55 * length, 0), rng.uniform(0.4, 0.6), depth),
        beam((0.5 * length, 0), tip, rng.uniform(0.35, 0.55), depth),
        beam(tip + vec(-0.1, -0.3), tip + vec(0.1, 0.4), 0.5, 1.2 * depth),
        beam(tip + vec(0.1, 0.45), tip + vec(rng.uniform(0.6, 0.8), 0.5), 0.3, 1.2 * depth),
        beam(tip + vec(0.1, -0.35), tip + vec(rng.uniform(0.4, 0.55), -0.45), 0.36, 1.2 * depth),
        cylinder((0, -depth * 0.8, 0), (0, depth * 0.8, 0), rng.uniform(0.4, 0.55)),
    ]


def drill(rng: np.random.Generator) -> list[Hull]:
    """Motor, chuck, bit, grip, battery, trigger."""
    length, tilt = rng.uniform(1.6, 2.2), rng.uniform(0.1, 0.5)
    foot = np.array([-0.45 - tilt, 0.0, -rng.uniform(1.3, 1.8)])
    return [
        cylinder((-length / 2, 0, 0), (length / 2, 0, 0), 0.46, 0.38),
        cylinder((length / 2 - 0.1, 0, 0), (length / 2 + 0.5, 0, 0), 0.3, 0.2, sides=10),
        rod((length / 2, 0, 0), (length / 2 + rng.uniform(0.8, 1.2), 0, 0), 0.09),
        rod((-0.4, 0, -0.1), foot, 0.3, 0.27),
        box(foot + vec(0.1, 0, -0.1), (rng.uniform(0.9, 1.3), 0.75, 0.45)),
        box((-0.02 - tilt / 3, 0, -0.6), (0.3, 0.2, 0.4)),
    ]


def axe(rng: np.random.Generator) -> list[Hull]:
    """Handle with a bent end, head, blade, spike."""
    length, blade = rng.uniform(2.6, 3.2), rng.uniform(0.8, 1.3)
    return [
        rod((0, 0, 0.4), (0, 0, length), 0.17),
        rod((0, 0, 0.5), (rng.uniform(0.2, 0.5), 0, 0), 0.19, 0.22),
        box((0, 0, length - 0.2), (0.7, 0.45, 0.55)),
        prism(
            [
                (0.2, length - 0.45),
                (0.2, length),
                (blade + 0.3, length + 0.35),
                (blade + 0.4, length - 0.2),
                (blade + 0.2, length - rng.uniform(0.8, 1.1)),
            ],
            -0.14,
            0.14,
        ),
        cylinder((-0.25, 0, length - 0.2), (-rng.uniform(0.6, 1.0), 0, length - 0.2), 0.24, 0.1, sides=8),
    ]


def pliers(rng: np.random.Generator) -> list[Hull]:
    """Two handles of unequal bend, pivot, two jaws of unequal length."""
    opening, depth = rng.uniform(0.35, 0.6), rng.uniform(0.28, 0.4)
    return [
        rod((0, 0.03, 0), (-1.2, 0.03, -opening), 0.22, 0.19),
        rod((-1.2, 0, -opening), (-rng.uniform(2.0, 2.4), 0, -opening * 0.7), 0.22),
        rod((0, -0.03, 0), (-1.1, -0.03, opening), 0.22, 0.19),
        rod((-1.1, 0, opening), (-rng.uniform(1.7, 2.2), 0, opening * 1.5), 0.22),
        cylinder((0, -depth, 0), (0, depth, 0), rng.uniform(0.35, 0.48)),
        beam((0.1, 0.15), (rng.uniform(1.1, 1.6), 0.3), 0.26, depth),
        beam((0.1, -0.15), (rng.uniform(0.7, 1.0), -0.3), 0.34, depth),
    ]
