"""Animals: quadrupeds, birds, fish, dinosaurs.

Conventions as in :mod:`.procedural`.
"""

import numpy as np

from vd.assets_usd.objects.geometry import Hull
from vd.assets_usd.objects.primitives import box, cylinder, ellipsoid, prism, rod, vec


def quadruped(rng: np.random.Generator) -> list[Hull]:
    """Trunk, neck and head, four legs, tail."""
    length, girth, leg = rng.uniform(1.4, 2.2), rng.uniform(0.42, 0.7), rng.uniform(0.8, 1.3)
    rise, reach, thick = rng.uniform(0.3, 1.1), rng.uniform(0.3, 0.8), rng.uniform(0.15, 0.24)
    head = np.array([length / 2 + reach, 0.0, leg + girth * 0.5 + rise])
    parts = [
        rod((-length / 2, 0, leg + 0.25), (length / 2, 0, leg + 0.3), girth * rng.uniform(0.8, 1.0), girth),
        rod((length / 2 - 0.1, 0, leg + 0.4), head, 0.6 * girth, 0.4 * girth),
        ellipsoid(
            head + vec(0.25, 0, 0), (rng.uniform(0.42, 0.7), 0.34, 0.34), euler=(0, rng.uniform(-0.1, 0.6), 0)
        ),
    ]
    legs = [
        rod((x, y, leg + 0.1), (x + rng.uniform(-0.15, 0.15), y, thick), 1.3 * thick, thick)
        for x in (-0.45 * length, 0.45 * length)
        for y in (-0.6 * girth, 0.6 * girth)
    ]
    rump = np.array([-length / 2, 0.0, leg + 0.4])
    tail = rod(rump, rump + vec(-rng.uniform(0.4, 0.9), 0, rng.uniform(-0.5, 0.5)), 0.2, 0.12)
    return [*parts, *legs, tail]


def bird(rng: np.random.Generator) -> list[Hull]:
    """Body, neck, head, beak, tail, two wings, foot."""
    body = np.array([rng.uniform(0.9, 1.2), rng.uniform(0.55, 0.75), rng.uniform(0.55, 0.7)])
    head = np.array([rng.uniform(0.7, 1.1), 0.0, rng.uniform(0.7, 1.2)])
    size = rng.uniform(0.32, 0.45)
    wing, lift = rng.uniform(0.6, 1.1), rng.uniform(-0.2, 0.6)
    parts = [
        ellipsoid((0, 0, 0), body, euler=(0, rng.uniform(-0.4, 0.1), 0)),
        rod((0.5 * body[0], 0, 0.2), head, 0.36, 0.28),
        ellipsoid(head, (size, 0.9 * size, size)),
        cylinder(
            head + vec(0.5 * size, 0, 0),
            head + vec(size + rng.uniform(0.3, 0.6), 0, -0.1),
            0.17,
            0.06,
            sides=8,
        ),
        box(
            (-body[0] - 0.2, 0, 0.15), (0.9, rng.uniform(0.4, 0.8), 0.18), euler=(0, rng.uniform(0.1, 0.5), 0)
        ),
    ]
    root = body[1] * 0.6
    wings = [
        rod((0.2, side * root, 0.1), (-0.5, side * (root + wing * 0.7), 0.1 + lift), 0.28, 0.14)
        for side in (-1, 1)
    ]
    foot = cylinder((0, 0, -0.3), (0.1, 0, -body[2] - rng.uniform(0.2, 0.5)), 0.22, 0.4, sides=8)
    return [*parts, *wings, foot]


def fish(rng: np.random.Generator) -> list[Hull]:
    """Body, head, two tail lobes, back fin, two side fins."""
    length, height, width = rng.uniform(1.2, 1.6), rng.uniform(0.55, 0.9), rng.uniform(0.35, 0.5)
    thick = 0.09
    end = -length
    parts = [
        ellipsoid((0, 0, 0), (length, width, height)),
        ellipsoid((0.6 * length, 0, -0.05), (0.55 * length, 0.9 * width, 0.62 * height)),
        prism(
            [(end + 0.3, -0.1), (end + 0.3, 0.15), (end - 0.6, rng.uniform(0.7, 1.0)), (end - 0.2, 0.1)],
            -thick,
            thick,
        ),
        prism(
            [(end + 0.3, 0.1), (end + 0.3, -0.15), (end - rng.uniform(0.2, 0.5), -0.6), (end - 0.1, 0.0)],
            -thick,
            thick,
        ),
        prism(
            [
                (-0.5 * length, 0.5 * height),
                (0.3 * length, 0.6 * height),
                (-0.3 * length, height + rng.uniform(0.3, 0.6)),
            ],
            -thick,
            thick,
        ),
    ]
    droop = rng.uniform(-0.5, 0.2)
    fins = [
        rod((0.3, side * 0.5 * width, -0.2), (-0.2, side * (width + 0.5), -0.2 + droop), 0.2, 0.1)
        for side in (-1, 1)
    ]
    return parts + fins


def dinosaur(rng: np.random.Generator) -> list[Hull]:
    """Two-legged: body, neck, head, tail, thighs with feet, arms."""
    tilt = rng.uniform(0.2, 0.7)
    hip, chest = np.array([-0.3, 0, 1.2]), np.array([0.6, 0, 1.2 + tilt])
    head = chest + vec(rng.uniform(0.3, 0.6), 0, rng.uniform(0.4, 0.8))
    tail = hip + vec(-rng.uniform(1.2, 1.9), 0, rng.uniform(-0.6, 0.2))
    parts = [
        rod(hip, chest, rng.uniform(0.5, 0.62), 0.42),
        rod(chest, head, 0.32, 0.26),
        box(
            head + vec(0.3, 0, 0.02),
            (rng.uniform(0.7, 1.0), 0.45, 0.45),
            euler=(0, rng.uniform(0, 0.3), 0),
            top=(0.8, 0.8),
        ),
        rod(hip, tail, 0.42, 0.1),
    ]
    for side in (-1, 1):
        step = rng.uniform(-0.1, 0.3)
        shoulder = chest + vec(0, side * 0.3, -0.1)
        parts += [
            rod((hip[0] + 0.05, side * 0.4, 1.0), (step, side * 0.48, 0.2), 0.32, 0.2),
            rod(shoulder, shoulder + vec(0.55, side * 0.05, -0.35), 0.15, 0.1),
        ]
    return parts
