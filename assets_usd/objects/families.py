"""Training families of procedural objects: each kind is a function from a generator to convex parts.

x points forward, y to the left, z up; units are arbitrary. Parts overlap, so that an object is one
piece, and at most eight are used, one collision shape each. A left-right mirror plane is welcome, as
in real things; a rotational symmetry is not, and :mod:`.procedural` draws again where one shows up.
"""

from collections.abc import Callable

import numpy as np

from vd.assets_usd.objects.geometry import Hull, hull_planes
from vd.assets_usd.objects.primitives import beam, box, cylinder, ellipsoid, prism, rod

Maker = Callable[[np.random.Generator], list[Hull]]


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
    for x in (-0.36 * length, 0.34 * length):
        parts.append(cylinder((x, -width / 2, 0.3), (x, width / 2, 0.3), rng.uniform(0.36, 0.5)))
    return parts


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
    for x in (-0.28 * length, 0.25 * length):
        parts.append(cylinder((x, -0.75, 0.3), (x, 0.75, 0.3), rng.uniform(0.3, 0.45)))
    return parts


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
    from vd.assets_usd.objects.geometry import convex_hull

    return [
        convex_hull(points),
        box((x, 0, 0.55 + cabin / 2), (0.9, 0.7 * width, cabin), top=(0.8, 0.9)),
        cylinder((x - 0.15, 0, 0.5 + cabin), (x - 0.3, 0, 0.9 + cabin), 0.2, 0.17, sides=10),
        rod((0.3 * length, 0, 0.5), (0.28 * length, 0, rng.uniform(1.2, 1.7)), 0.09),
        box((-0.4 * length, 0, 0.7), (0.35, 0.8 * width, 0.3)),
    ]


def quadruped(rng: np.random.Generator) -> list[Hull]:
    """Trunk, neck and head, four legs, tail."""
    length, girth, leg = rng.uniform(1.4, 2.2), rng.uniform(0.42, 0.7), rng.uniform(0.8, 1.3)
    rise, reach, thick = rng.uniform(0.3, 1.1), rng.uniform(0.3, 0.8), rng.uniform(0.15, 0.24)
    head = np.array([length / 2 + reach, 0.0, leg + girth * 0.5 + rise])
    parts = [
        rod((-length / 2, 0, leg + 0.25), (length / 2, 0, leg + 0.3), girth * rng.uniform(0.8, 1.0), girth),
        rod((length / 2 - 0.1, 0, leg + 0.4), head, 0.6 * girth, 0.4 * girth),
        ellipsoid(
            head + (0.25, 0, 0), (rng.uniform(0.42, 0.7), 0.34, 0.34), euler=(0, rng.uniform(-0.1, 0.6), 0)
        ),
    ]
    for x in (-0.45 * length, 0.45 * length):
        for y in (-0.6 * girth, 0.6 * girth):
            stride = rng.uniform(-0.15, 0.15)
            parts.append(rod((x, y, leg + 0.1), (x + stride, y, thick), 1.3 * thick, thick))
    tail = rng.uniform(0.4, 0.9)
    parts.append(
        rod((-length / 2, 0, leg + 0.4), (-length / 2 - tail, 0, leg + rng.uniform(-0.1, 0.9)), 0.2, 0.12)
    )
    return parts


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
            head + (0.5 * size, 0, 0), head + (size + rng.uniform(0.3, 0.6), 0, -0.1), 0.17, 0.06, sides=8
        ),
        box(
            (-body[0] - 0.2, 0, 0.15), (0.9, rng.uniform(0.4, 0.8), 0.18), euler=(0, rng.uniform(0.1, 0.5), 0)
        ),
    ]
    for side in (-1, 1):
        y = side * body[1] * 0.6
        parts.append(rod((0.2, y, 0.1), (-0.5, y + side * wing * 0.7, 0.1 + lift), 0.28, 0.14))
    parts.append(cylinder((0, 0, -0.3), (0.1, 0, -body[2] - rng.uniform(0.2, 0.5)), 0.22, 0.4, sides=8))
    return parts


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
    for side in (-1, 1):
        parts.append(
            rod((0.3, side * 0.5 * width, -0.2), (-0.2, side * (width + 0.5), -0.2 + droop), 0.2, 0.1)
        )
    return parts


def dinosaur(rng: np.random.Generator) -> list[Hull]:
    """Two-legged: body, neck, head, tail, thighs with feet, arms."""
    tilt = rng.uniform(0.2, 0.7)
    hip, chest = np.array([-0.3, 0, 1.2]), np.array([0.6, 0, 1.2 + tilt])
    head = chest + (rng.uniform(0.3, 0.6), 0, rng.uniform(0.4, 0.8))
    tail = hip + (-rng.uniform(1.2, 1.9), 0, rng.uniform(-0.6, 0.2))
    parts = [
        rod(hip, chest, rng.uniform(0.5, 0.62), 0.42),
        rod(chest, head, 0.32, 0.26),
        box(
            head + (0.3, 0, 0.02),
            (rng.uniform(0.7, 1.0), 0.45, 0.45),
            euler=(0, rng.uniform(0, 0.3), 0),
            top=(0.8, 0.8),
        ),
        rod(hip, tail, 0.42, 0.1),
    ]
    for side in (-1, 1):
        step = rng.uniform(-0.1, 0.3)
        parts.append(rod((hip[0] + 0.05, side * 0.4, 1.0), (step, side * 0.48, 0.2), 0.32, 0.2))
        parts.append(
            rod(
                (chest[0], side * 0.3, chest[2] - 0.1),
                (chest[0] + 0.55, side * 0.35, chest[2] - 0.45),
                0.15,
                0.1,
            )
        )
    return parts


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
    for side in (-1, 1):
        parts.append(rod((-0.3, side * 0.12, length), (-1.2, side * spread * 1.3, length - drop), 0.2, 0.1))
    return parts


def wrench(rng: np.random.Generator) -> list[Hull]:
    """Open-ended, bent: handle, head, two jaws of unequal length, end plate."""
    length, depth = rng.uniform(2.4, 3.2), rng.uniform(0.3, 0.5)
    bend = rng.uniform(0.2, 0.6)
    tip = np.array([length, bend])
    return [
        beam((0, 0), (0.55 * length, 0), rng.uniform(0.4, 0.6), depth),
        beam((0.5 * length, 0), tip, 0.45, depth),
        beam(tip + (-0.1, -0.3), tip + (0.1, 0.4), 0.5, 1.2 * depth),
        beam(tip + (0.1, 0.45), tip + (rng.uniform(0.6, 0.8), 0.5), 0.3, 1.2 * depth),
        beam(tip + (0.1, -0.35), tip + (rng.uniform(0.4, 0.55), -0.45), 0.36, 1.2 * depth),
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
        box(foot + (0.1, 0, -0.1), (rng.uniform(0.9, 1.3), 0.75, 0.45)),
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


STROKES: dict[str, list[tuple[float, float, float, float]]] = {
    "F": [(0, 0, 0, 2), (0, 2, 1.2, 2), (0, 1.1, 0.8, 1.1)],
    "G": [(1.2, 1.7, 0.5, 2), (0.5, 2, 0, 1.4), (0, 1.4, 0, 0.5), (0, 0.5, 0.5, 0), (0.5, 0, 1.2, 0.2), (1.2, 0.2, 1.2, 0.9), (1.2, 0.9, 0.7, 0.9)],
    "J": [(1, 2, 1, 0.5), (1, 0.5, 0.6, 0), (0.6, 0, 0.2, 0), (0.2, 0, 0, 0.4), (0.5, 2, 1.4, 2)],
    "L": [(0, 0, 0, 2), (0, 0, 1.1, 0)],
    "P": [(0, 0, 0, 2), (0, 2, 0.8, 2), (0.8, 2, 1.1, 1.5), (1.1, 1.5, 0.8, 1), (0.8, 1, 0, 1)],
    "Q": [(0.3, 2, 1, 2), (1, 2, 1.3, 1), (1.3, 1, 1, 0), (1, 0, 0.3, 0), (0.3, 0, 0, 1), (0, 1, 0.3, 2), (0.8, 0.6, 1.5, -0.3)],
    "R": [(0, 0, 0, 2), (0, 2, 0.8, 2), (0.8, 2, 1.1, 1.5), (1.1, 1.5, 0.8, 1), (0.8, 1, 0, 1), (0.5, 1, 1.2, 0)],
    "a": [(0, 0, 0.6, 2), (0.6, 2, 1.3, 0), (0.25, 0.7, 1.1, 0.7), (1.3, 0, 1.7, 0)],
    "h": [(0, 0, 0, 2), (0, 1, 0.8, 1.1), (0.8, 1.1, 1, 0.8), (1, 0.8, 1, 0)],
    "k": [(0, 0, 0, 2), (0, 0.7, 0.9, 1.5), (0.3, 0.95, 1, 0)],
    "y": [(0, 2, 0.6, 1), (1.2, 2, 0.2, 0), (0.2, 0, -0.2, 0)],
    "2": [(0, 1.6, 0.4, 2), (0.4, 2, 0.9, 2), (0.9, 2, 1.2, 1.5), (1.2, 1.5, 0, 0), (0, 0, 1.3, 0)],
    "4": [(0.9, 0, 0.9, 2), (0.9, 2, 0, 0.7), (0, 0.7, 1.3, 0.7)],
    "5": [(1.1, 2, 0.1, 2), (0.1, 2, 0, 1.1), (0, 1.1, 0.8, 1.2), (0.8, 1.2, 1.1, 0.7), (1.1, 0.7, 0.8, 0), (0.8, 0, 0, 0.1)],
    "7": [(0, 2, 1.2, 2), (1.2, 2, 0.5, 0), (0.5, 1.1, 1.2, 1.1)],
}  # fmt: skip
"""Strokes (x0, z0, x1, z1) of characters without a symmetry in their plane."""


def letter(rng: np.random.Generator) -> list[Hull]:
    """A character of straight strokes, slanted and stretched."""
    strokes = STROKES[str(rng.choice(sorted(STROKES)))]
    stretch, slant = rng.uniform(0.85, 1.25), rng.uniform(-0.2, 0.3)
    width, depth = rng.uniform(0.28, 0.42), rng.uniform(0.35, 0.8)

    def at(x: float, z: float) -> tuple[float, float]:
        return stretch * x + slant * z, z

    return [beam(at(x0, z0), at(x1, z1), width, depth) for x0, z0, x1, z1 in strokes]


def monogram(rng: np.random.Generator) -> list[Hull]:
    """An L or a hook of thick strokes with a rod or a ball on one face: no mirror plane left."""
    width, depth = rng.uniform(0.4, 0.55), rng.uniform(0.4, 0.7)
    arm = rng.uniform(0.8, 1.5)
    side = rng.choice([-1.0, 1.0])
    return [
        beam((0, 0), (0, rng.uniform(1.6, 2.2)), width, depth),
        beam((0, 0), (arm, rng.uniform(-0.2, 0.3)), width, depth),
        rod((0, 0, 1.2), (rng.uniform(-0.3, 0.3), side * rng.uniform(0.8, 1.2), 1.3), 0.3, 0.24),
        ellipsoid((arm, -side * 0.2, 0.1), (0.4, 0.5, 0.4)),
    ]


def _attach(rng: np.random.Generator, parts: list[Hull], scale: float) -> Hull:
    """A random primitive rooted inside a random part and sticking out of it."""
    host = parts[int(rng.integers(len(parts)))]
    normals, offsets = hull_planes(host)
    centre = host.vertices.mean(axis=0)
    plane = int(rng.integers(len(normals)))
    normal = normals[plane]
    surface = centre + (offsets[plane] - normal @ centre) * normal
    out = normal + rng.normal(0.0, 0.25, 3)
    out /= np.linalg.norm(out)
    length = scale * rng.uniform(0.6, 1.5)
    middle = surface + out * length * 0.35
    turn = rng.uniform(-np.pi, np.pi, 3)
    kind = int(rng.integers(4))
    thick = scale * rng.uniform(0.25, 0.5)
    if kind == 0:
        return rod(surface - 0.3 * length * out, surface + length * out, thick, thick * rng.uniform(0.5, 1.0))
    if kind == 1:
        return cylinder(
            surface - 0.3 * length * out,
            surface + 0.8 * length * out,
            thick,
            thick * rng.uniform(0.4, 1.3),
            sides=10,
        )
    if kind == 2:
        return box(middle, scale * rng.uniform(0.5, 1.3, 3), euler=turn)
    return ellipsoid(middle, scale * rng.uniform(0.35, 0.8, 3), euler=turn)


def cluster(rng: np.random.Generator) -> list[Hull]:
    """Random primitives grown on one another."""
    parts = [box((0, 0, 0), rng.uniform(0.8, 1.6, 3))]
    for _ in range(int(rng.integers(3, 7))):
        parts.append(_attach(rng, parts, 1.0))
    return parts


def branch(rng: np.random.Generator) -> list[Hull]:
    """A bent trunk of rods with side arms that end in blobs."""
    points = [np.zeros(3)]
    direction = np.array([0.0, 0.0, 1.0])
    for _ in range(3):
        direction = direction + rng.normal(0.0, 0.45, 3)
        direction /= np.linalg.norm(direction)
        points.append(points[-1] + direction * rng.uniform(0.6, 1.0))
    thick = rng.uniform(0.22, 0.34)
    parts = [rod(a, b, thick, 0.9 * thick) for a, b in zip(points[:-1], points[1:], strict=True)]
    for joint in points[1:3]:
        out = np.cross(direction, rng.normal(size=3))
        out /= np.linalg.norm(out)
        end = joint + out * rng.uniform(0.6, 1.2)
        parts += [rod(joint, end, 0.8 * thick, 0.6 * thick), ellipsoid(end, rng.uniform(0.25, 0.5, 3))]
    return parts


TRAINING: dict[str, dict[str, Maker]] = {
    "vehicles": {"car": car, "truck": truck, "locomotive": locomotive, "aeroplane": aeroplane, "boat": boat},
    "animals": {"quadruped": quadruped, "bird": bird, "fish": fish, "dinosaur": dinosaur},
    "shoes": {"sneaker": sneaker, "boot": boot, "heel_shoe": heel_shoe},
    "tools": {"hammer": hammer, "wrench": wrench, "drill": drill, "axe": axe, "pliers": pliers},
    "letters": {"letter": letter, "monogram": monogram},
    "composites": {"cluster": cluster, "branch": branch},
}
"""Kinds by training family."""
