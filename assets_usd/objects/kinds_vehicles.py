"""Vehicles: cars, trucks, locomotives, aeroplanes, boats.

Conventions as in :mod:`.procedural`.
"""

import numpy as np

from vd.assets_usd.objects.geometry import Hull, convex_hull
from vd.assets_usd.objects.primitives import box, cylinder, ellipsoid, prism, rod


def car(rng: np.random.Generator) -> list[Hull]:
    """Body, cabin, bonnet, four wheels, spoiler."""
    length, width, height = rng.uniform(2.4, 3.2), rng.uniform(1.2, 1.6), rng.uniform(0.45, 0.7)
    wheel, cabin = rng.uniform(0.28, 0.42), rng.uniform(0.4, 0.75)
    back, front = -0.45 * length, rng.uniform(0.0, 0.2) * length
    parts = [
        box((0, 0, height / 2), (length, width, height), top=(0.95, 0.9)),
        prism(
            [
                (back, height * 0.8),
                (front, height * 0.8),
                (front - 0.5, height + cabin),
                (back + 0.2, height + cabin),
            ],
            -0.42 * width,
            0.42 * width,
        ),
        box((-0.47 * length, 0, height + 0.35 * cabin), (0.3, width * rng.uniform(0.7, 1.1), 0.5 * cabin)),
    ]
    for x in (-0.3 * length, 0.32 * length):
        for side in (-1, 1):
            y = side * width / 2
            parts.append(cylinder((x, y - side * 0.15, 0.05), (x, y + side * 0.12, 0.05), wheel, sides=10))
    return parts


def truck(rng: np.random.Generator) -> list[Hull]:
    """Chassis, cab, windscreen box, load, two axles with wheels, exhaust."""
    length, width = rng.uniform(3.0, 4.0), rng.uniform(1.2, 1.5)
    cab, load = rng.uniform(1.0, 1.4), rng.uniform(0.7, 1.5)
    parts = [
        box((0, 0, 0.4), (length, 0.8 * width, 0.3)),
        prism(
            [
                (length / 2 - 0.9, 0.4),
                (length / 2, 0.4),
                (length / 2, 0.9),
                (length / 2 - 0.3, 0.4 + cab),
                (length / 2 - 0.9, 0.4 + cab),
            ],
            -width / 2,
            width / 2,
        ),
        box(
            (-0.45, 0, 0.5 + load / 2),
            (length - 1.2, width * rng.uniform(0.9, 1.15), load),
            top=(1, rng.uniform(0.8, 1.0)),
        ),
        cylinder(
            (length / 2 - 1.0, width / 2 - 0.1, 0.5),
            (length / 2 - 1.0, width / 2 - 0.1, cab + 0.9),
            0.12,
            sides=8,
        ),
    ]
    axles = [
        cylinder((x, -width / 2, 0.3), (x, width / 2, 0.3), rng.uniform(0.36, 0.5))
        for x in (-0.36 * length, 0.34 * length)
    ]
    return parts + axles


def locomotive(rng: np.random.Generator) -> list[Hull]:
    """Boiler, cab, chassis, chimney, dome, axles, cow catcher."""
    length, radius = rng.uniform(2.6, 3.4), rng.uniform(0.45, 0.65)
    cab = rng.uniform(0.7, 1.0)
    front = length / 2
    parts = [
        cylinder((-0.2 * length, 0, 1.0), (front, 0, 1.0), radius),
        box((-front + cab / 2, 0, 1.15), (cab, 1.5, rng.uniform(1.5, 2.0))),
        box((0, 0, 0.45), (length, 1.2, 0.35)),
        cylinder(
            (front - 0.4, 0, 1.0), (front - 0.4, 0, 1.6 + radius), 0.16, rng.uniform(0.16, 0.32), sides=8
        ),
        ellipsoid((rng.uniform(-0.1, 0.1) * length, 0, 1.0 + radius), (0.3, 0.3, 0.35)),
        prism([(front - 0.1, 0.1), (front + 0.5, 0.1), (front - 0.1, 0.7)], -0.5, 0.5),
    ]
    axles = [
        cylinder((x, -0.75, 0.3), (x, 0.75, 0.3), rng.uniform(0.3, 0.45))
        for x in (-0.28 * length, 0.25 * length)
    ]
    return parts + axles


def aeroplane(rng: np.random.Generator) -> list[Hull]:
    """Fuselage, two swept wings, tailplane, fin, cockpit."""
    length, radius, span = rng.uniform(3.0, 3.8), rng.uniform(0.3, 0.45), rng.uniform(1.3, 1.9)
    sweep, chord = rng.uniform(0.2, 0.9), rng.uniform(0.7, 1.1)
    thick = rng.uniform(0.16, 0.24)
    parts = [rod((length / 2, 0, 0), (-length / 2, 0, 0.15), radius, 0.45 * radius)]
    for side in (-1, 1):
        outline = [
            (chord / 2, 0.0),
            (-chord / 2, 0.0),
            (-chord * 0.35 - sweep, side * span),
            (chord * 0.1 - sweep, side * span),
        ]
        parts.append(prism(outline, -thick / 2, thick / 2, axis="z"))
    tail = -length / 2
    parts += [
        box((tail + 0.1, 0, 0.15), (0.5, rng.uniform(1.0, 1.5), 0.17)),
        prism(
            [(tail - 0.2, 0.1), (tail + 0.5, 0.1), (tail, rng.uniform(0.9, 1.2)), (tail - 0.3, 0.9)],
            -0.09,
            0.09,
        ),
        ellipsoid((0.25 * length, 0, radius), (0.45, 0.25, 0.25)),
    ]
    return parts


def boat(rng: np.random.Generator) -> list[Hull]:
    """Bow and stern of the hull, cabin, funnel, mast."""
    length, width = rng.uniform(2.4, 3.2), rng.uniform(0.9, 1.3)
    hull = np.array([(-1, -1), (-1, 1), (0.2, 1), (1.1, 0.05), (1.1, -0.05), (0.2, -1)]) * (
        length / 2,
        width / 2,
    )
    keel = hull * (0.8, 0.5)
    points = np.concatenate([np.insert(hull, 2, 0.6, axis=1), np.insert(keel, 2, 0.0, axis=1)])
    cabin = rng.uniform(0.5, 0.8)
    x = rng.uniform(-0.3, 0.0) * length
    return [
        convex_hull(points),
        box((x, 0, 0.55 + cabin / 2), (0.9, 0.7 * width, cabin), top=(0.8, 0.9)),
        cylinder((x - 0.15, 0, 0.5 + cabin), (x - 0.3, 0, 0.9 + cabin), 0.2, 0.17, sides=10),
        rod((0.3 * length, 0, 0.5), (0.28 * length, 0, rng.uniform(1.2, 1.7)), 0.09),
        box((-0.4 * length, 0, 0.7), (0.35, 0.8 * width, 0.3)),
    ]
