"""Kinds of procedural objects.

Each draws the overlapping convex parts of one object, at most eight.

x points forward, y to the left, z up; units are arbitrary. A left-right mirror plane is welcome, as
in real things. ``u(low, high)`` draws a number; the order of the draws is the shape of a seed: keep
it.
"""

from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise, product

import numpy as np

from vd.assets_usd.objects.geometry import Hull, convex_hull, hull_planes
from vd.assets_usd.objects.primitives import (
    Draw,
    beam,
    box,
    cylinder,
    ellipsoid,
    prism,
    rod,
    vec,
)

SIDES = (-1, 1)
"""Right and left."""


def car(u: Draw) -> Iterator[Hull]:
    """Body, cabin, spoiler, four wheels."""
    length = u(2.4, 3.2)
    width = u(1.2, 1.6)
    height = u(0.45, 0.7)
    wheel = u(0.28, 0.42)
    cabin = u(0.4, 0.75)
    back = -0.45 * length
    front = u(0.0, 0.2) * length
    top = height + cabin
    yield box((0, 0, height / 2), (length, width, height), top=(0.95, 0.9))
    sill = height * 0.8
    yield prism(
        [(back, sill), (front, sill), (front - 0.5, top), (back + 0.2, top)],
        -0.42 * width,
        0.42 * width,
    )
    yield box((-0.47 * length, 0, height + 0.35 * cabin), (0.3, width * u(0.7, 1.1), 0.5 * cabin))
    for x, side in product((-0.3 * length, 0.32 * length), SIDES):
        y = side * width / 2
        yield cylinder((x, y - side * 0.15, 0.05), (x, y + side * 0.12, 0.05), wheel, sides=10)


def truck(u: Draw) -> Iterator[Hull]:
    """Chassis, cab, load, exhaust, two axles with wheels."""
    length = u(3.0, 4.0)
    width = u(1.2, 1.5)
    cab = u(1.0, 1.4)
    load = u(0.7, 1.5)
    yield box((0, 0, 0.4), (length, 0.8 * width, 0.3))
    front = length / 2
    back = length / 2 - 0.9
    roof = 0.4 + cab
    outline = [(back, 0.4), (front, 0.4), (front, 0.9), (front - 0.3, roof), (back, roof)]
    yield prism(outline, -width / 2, width / 2)
    size = (length - 1.2, width * u(0.9, 1.15), load)
    yield box((-0.45, 0, 0.5 + load / 2), size, top=(1, u(0.8, 1.0)))
    x = front - 1.0
    y = width / 2 - 0.1
    yield cylinder((x, y, 0.5), (x, y, cab + 0.9), 0.12, sides=8)
    for x in (-0.36 * length, 0.34 * length):
        yield cylinder((x, -width / 2, 0.3), (x, width / 2, 0.3), u(0.36, 0.5))


def locomotive(u: Draw) -> Iterator[Hull]:
    """Boiler, cab, chassis, chimney, dome, cow catcher, axles."""
    length = u(2.6, 3.4)
    radius = u(0.45, 0.65)
    cab = u(0.7, 1.0)
    front = length / 2
    yield cylinder((-0.2 * length, 0, 1.0), (front, 0, 1.0), radius)
    yield box((-front + cab / 2, 0, 1.15), (cab, 1.5, u(1.5, 2.0)))
    yield box((0, 0, 0.45), (length, 1.2, 0.35))
    yield cylinder(
        (front - 0.4, 0, 1.0), (front - 0.4, 0, 1.6 + radius), 0.16, u(0.16, 0.32), sides=8
    )
    yield ellipsoid((u(-0.1, 0.1) * length, 0, 1.0 + radius), (0.3, 0.3, 0.35))
    yield prism([(front - 0.1, 0.1), (front + 0.5, 0.1), (front - 0.1, 0.7)], -0.5, 0.5)
    for x in (-0.28 * length, 0.25 * length):
        yield cylinder((x, -0.75, 0.3), (x, 0.75, 0.3), u(0.3, 0.45))


def aeroplane(u: Draw) -> Iterator[Hull]:
    """Fuselage, two swept wings, tailplane, fin, cockpit."""
    length = u(3.0, 3.8)
    radius = u(0.3, 0.45)
    span = u(1.3, 1.9)
    sweep = u(0.2, 0.9)
    chord = u(0.7, 1.1)
    thick = u(0.16, 0.24)
    yield rod((length / 2, 0, 0), (-length / 2, 0, 0.15), radius, 0.45 * radius)
    for side in SIDES:
        tip = [(-chord * 0.35 - sweep, side * span), (chord * 0.1 - sweep, side * span)]
        yield prism([(chord / 2, 0.0), (-chord / 2, 0.0), *tip], -thick / 2, thick / 2, axis="z")
    tail = -length / 2
    yield box((tail + 0.1, 0, 0.15), (0.5, u(1.0, 1.5), 0.17))
    fin = [(tail - 0.2, 0.1), (tail + 0.5, 0.1), (tail, u(0.9, 1.2)), (tail - 0.3, 0.9)]
    yield prism(fin, -0.09, 0.09)
    yield ellipsoid((0.25 * length, 0, radius), (0.45, 0.25, 0.25))


def boat(u: Draw) -> Iterator[Hull]:
    """Bow and stern of the hull, cabin, funnel, mast, bench."""
    length = u(2.4, 3.2)
    width = u(0.9, 1.3)
    deck = np.array([(-1, -1), (-1, 1), (0.2, 1), (1.1, 0.05), (1.1, -0.05), (0.2, -1)])
    deck = deck * (length / 2, width / 2)
    keel = deck * (0.8, 0.5)
    cabin = u(0.5, 0.8)
    x = u(-0.3, 0.0) * length
    yield convex_hull(
        np.concatenate([np.insert(deck, 2, 0.6, axis=1), np.insert(keel, 2, 0.0, axis=1)])
    )
    yield box((x, 0, 0.55 + cabin / 2), (0.9, 0.7 * width, cabin), top=(0.8, 0.9))
    yield cylinder((x - 0.15, 0, 0.5 + cabin), (x - 0.3, 0, 0.9 + cabin), 0.2, 0.17, sides=10)
    yield rod((0.3 * length, 0, 0.5), (0.28 * length, 0, u(1.2, 1.7)), 0.09)
    yield box((-0.4 * length, 0, 0.7), (0.35, 0.8 * width, 0.3))


def quadruped(u: Draw) -> Iterator[Hull]:
    """Trunk, neck and head, four legs, tail."""
    length = u(1.4, 2.2)
    girth = u(0.42, 0.7)
    leg = u(0.8, 1.3)
    rise = u(0.3, 1.1)
    reach = u(0.3, 0.8)
    thick = u(0.15, 0.24)
    head = vec(length / 2 + reach, 0.0, leg + girth * 0.5 + rise)
    yield rod((-length / 2, 0, leg + 0.25), (length / 2, 0, leg + 0.3), girth * u(0.8, 1.0), girth)
    yield rod((length / 2 - 0.1, 0, leg + 0.4), head, 0.6 * girth, 0.4 * girth)
    yield ellipsoid(head + vec(0.25, 0, 0), (u(0.42, 0.7), 0.34, 0.34), euler=(0, u(-0.1, 0.6), 0))
    for x, y in product((-0.45 * length, 0.45 * length), (-0.6 * girth, 0.6 * girth)):
        yield rod((x, y, leg + 0.1), (x + u(-0.15, 0.15), y, thick), 1.3 * thick, thick)
    rump = vec(-length / 2, 0.0, leg + 0.4)
    yield rod(rump, rump + vec(-u(0.4, 0.9), 0, u(-0.5, 0.5)), 0.2, 0.12)


def bird(u: Draw) -> Iterator[Hull]:
    """Body, neck, head, beak, tail, two wings, foot."""
    body = vec(u(0.9, 1.2), u(0.55, 0.75), u(0.55, 0.7))
    head = vec(u(0.7, 1.1), 0.0, u(0.7, 1.2))
    size = u(0.32, 0.45)
    wing = u(0.6, 1.1)
    lift = u(-0.2, 0.6)
    yield ellipsoid((0, 0, 0), body, euler=(0, u(-0.4, 0.1), 0))
    yield rod((0.5 * body[0], 0, 0.2), head, 0.36, 0.28)
    yield ellipsoid(head, (size, 0.9 * size, size))
    beak = head + vec(0.5 * size, 0, 0), head + vec(size + u(0.3, 0.6), 0, -0.1)
    yield cylinder(*beak, 0.17, 0.06, sides=8)
    yield box((-body[0] - 0.2, 0, 0.15), (0.9, u(0.4, 0.8), 0.18), euler=(0, u(0.1, 0.5), 0))
    root = body[1] * 0.6
    for side in SIDES:
        yield rod(
            (0.2, side * root, 0.1), (-0.5, side * (root + wing * 0.7), 0.1 + lift), 0.28, 0.14
        )
    yield cylinder((0, 0, -0.3), (0.1, 0, -body[2] - u(0.2, 0.5)), 0.22, 0.4, sides=8)


def fish(u: Draw) -> Iterator[Hull]:
    """Body, head, two tail lobes, back fin, two side fins."""
    length = u(1.2, 1.6)
    height = u(0.55, 0.9)
    width = u(0.35, 0.5)
    end = -length
    yield ellipsoid((0, 0, 0), (length, width, height))
    yield ellipsoid((0.6 * length, 0, -0.05), (0.55 * length, 0.9 * width, 0.62 * height))
    for fin in (
        [(end + 0.3, -0.1), (end + 0.3, 0.15), (end - 0.6, u(0.7, 1.0)), (end - 0.2, 0.1)],
        [(end + 0.3, 0.1), (end + 0.3, -0.15), (end - u(0.2, 0.5), -0.6), (end - 0.1, 0.0)],
        [
            (-0.5 * length, 0.5 * height),
            (0.3 * length, 0.6 * height),
            (-0.3 * length, height + u(0.3, 0.6)),
        ],
    ):
        yield prism(fin, -0.09, 0.09)
    droop = u(-0.5, 0.2)
    for side in SIDES:
        yield rod(
            (0.3, side * 0.5 * width, -0.2), (-0.2, side * (width + 0.5), -0.2 + droop), 0.2, 0.1
        )


def dinosaur(u: Draw) -> Iterator[Hull]:
    """Two-legged: body, neck, head, tail, thighs with feet, arms."""
    hip = vec(-0.3, 0, 1.2)
    chest = vec(0.6, 0, 1.2 + u(0.2, 0.7))
    head = chest + vec(u(0.3, 0.6), 0, u(0.4, 0.8))
    tail = hip + vec(-u(1.2, 1.9), 0, u(-0.6, 0.2))
    yield rod(hip, chest, u(0.5, 0.62), 0.42)
    yield rod(chest, head, 0.32, 0.26)
    snout = (u(0.7, 1.0), 0.45, 0.45)
    yield box(head + vec(0.3, 0, 0.02), snout, euler=(0, u(0, 0.3), 0), top=(0.8, 0.8))
    yield rod(hip, tail, 0.42, 0.1)
    for side in SIDES:
        shoulder = chest + vec(0, side * 0.3, -0.1)
        yield rod((hip[0] + 0.05, side * 0.4, 1.0), (u(-0.1, 0.3), side * 0.48, 0.2), 0.32, 0.2)
        yield rod(shoulder, shoulder + vec(0.55, side * 0.05, -0.35), 0.15, 0.1)


def _sole(u: Draw, length: float, width: float) -> np.ndarray:
    """Convex outline of a left or right foot, heel at x = 0."""
    side = u.choice([-1.0, 1.0])
    waist = u(0.38, 0.45)
    outer = [(0.0, -0.25), (0.1, -0.4), (0.65, -0.55), (0.9, -0.4), (1.0, -0.1 + 0.2 * waist)]
    inner = [(0.98, 0.25), (0.75, 0.48), (0.1, 0.38), (0.0, 0.22)]
    return np.array([(length * x, side * width * y) for x, y in outer + inner])


def sneaker(u: Draw) -> Iterator[Hull]:
    """Sole, toe box, instep, collar, tongue."""
    length = u(2.4, 3.0)
    width = u(0.9, 1.15)
    height = u(0.9, 1.3)
    yield prism(_sole(u, length, width), 0.0, u(0.25, 0.4), axis="z")
    yield ellipsoid((0.72 * length, 0, 0.38), (0.27 * length, 0.46 * width, u(0.35, 0.5)))
    toe = [(0.75 * length, 0.2), (0.7 * length, 0.6), (0.45 * length, height)]
    yield prism([(0.2, 0.2), *toe, (0.2, 0.9 * height)], -0.38 * width, 0.38 * width)
    collar = (0.22 * length, 0, 0.3), (0.2 * length, 0, height + u(0.1, 0.5))
    yield cylinder(*collar, 0.4 * width, 0.36 * width)
    yield box((0.45 * length, 0, height), (0.6, 0.35 * width, 0.16), euler=(0, -u(0.6, 1.0), 0))


def boot(u: Draw) -> Iterator[Hull]:
    """Sole, heel, foot, toe cap, shaft, cuff."""
    length = u(2.0, 2.6)
    width = u(0.8, 1.05)
    shaft = u(1.6, 2.4)
    lean = u(-0.2, 0.25)
    ankle = 0.2 * length
    yield prism(_sole(u, length, width), 0.2, 0.4, axis="z")
    yield box((0.15 * length, 0, 0.13), (0.3 * length, 0.7 * width, 0.3), top=(1.0, 1.1))
    yield rod((0.25 * length, 0, 0.7), (0.7 * length, 0, 0.6), 0.44 * width, 0.38 * width)
    yield ellipsoid((0.8 * length, 0, 0.55), (0.26 * length, 0.42 * width, u(0.28, 0.36)))
    yield cylinder(
        (ankle, 0, 0.4), (ankle + lean, 0, 0.4 + shaft), 0.4 * width, u(0.42, 0.52) * width
    )
    yield box((ankle + lean, 0, 0.3 + shaft), (1.1 * width, 1.1 * width, u(0.2, 0.4)))


def heel_shoe(u: Draw) -> Iterator[Hull]:
    """Sloped arch, sole, stiletto heel, toe box, counter."""
    length = u(2.2, 2.7)
    width = u(0.7, 0.9)
    lift = u(0.8, 1.3)
    ball = 0.65 * length
    arch = [
        (0.0, lift),
        (0.6, lift),
        (ball, 0.1),
        (ball, 0.0),
        (0.5 * length, 0.0),
        (0.0, lift - 0.15),
    ]
    yield prism(arch, -0.34 * width, 0.34 * width)
    yield prism(_sole(u, 0.55 * length, width) + vec(0.5 * length, 0.0), 0.0, 0.16, axis="z")
    yield rod((0.15, 0, lift - 0.1), (0.1, 0, 0.1), 0.2, 0.1)
    yield ellipsoid((0.85 * length, 0, 0.2), (0.25 * length, 0.38 * width, 0.3))
    yield cylinder((0.35, 0, lift - 0.1), (0.25, 0, lift + u(0.35, 0.7)), 0.4 * width, 0.36 * width)


def hammer(u: Draw) -> Iterator[Hull]:
    """Handle, grip, head, face, two claws."""
    length = u(2.6, 3.4)
    head = u(0.22, 0.3)
    spread = u(0.12, 0.3)
    drop = u(0.2, 0.7)
    yield rod((0, 0, 0), (0, 0, length), 0.2, 0.16)
    yield rod((0, 0, 0), (0, 0, 0.4 * length), u(0.22, 0.3))
    yield box((0.0, 0, length), (0.8, 2 * head, 2 * head))
    yield cylinder((0.3, 0, length), (u(0.9, 1.3), 0, length), u(1.1, 1.6) * head)
    for side in SIDES:
        yield rod((-0.3, side * 0.12, length), (-1.2, side * spread * 1.3, length - drop), 0.2, 0.1)


def wrench(u: Draw) -> Iterator[Hull]:
    """Open-ended, bent: handle, head, two jaws of unequal length, end plate."""
    length = u(2.4, 3.2)
    depth = u(0.3, 0.5)
    bend = u(-0.7, 1.1)
    tip = vec(length, bend)
    yield beam((0, 0), (0.55 * length, 0), u(0.4, 0.6), depth)
    yield beam((0.5 * length, 0), tip, u(0.35, 0.55), depth)
    yield beam(tip + vec(-0.1, -0.3), tip + vec(0.1, 0.4), 0.5, 1.2 * depth)
    yield beam(tip + vec(0.1, 0.45), tip + vec(u(0.6, 0.8), 0.5), 0.3, 1.2 * depth)
    yield beam(tip + vec(0.1, -0.35), tip + vec(u(0.4, 0.55), -0.45), 0.36, 1.2 * depth)
    yield cylinder((0, -depth * 0.8, 0), (0, depth * 0.8, 0), u(0.4, 0.55))


def drill(u: Draw) -> Iterator[Hull]:
    """Motor, chuck, bit, grip, battery, trigger."""
    length = u(1.6, 2.2)
    tilt = u(0.1, 0.5)
    front = length / 2
    foot = vec(-0.45 - tilt, 0.0, -u(1.3, 1.8))
    yield cylinder((-front, 0, 0), (front, 0, 0), 0.46, 0.38)
    yield cylinder((front - 0.1, 0, 0), (front + 0.5, 0, 0), 0.3, 0.2, sides=10)
    yield rod((front, 0, 0), (front + u(0.8, 1.2), 0, 0), 0.09)
    yield rod((-0.4, 0, -0.1), foot, 0.3, 0.27)
    yield box(foot + vec(0.1, 0, -0.1), (u(0.9, 1.3), 0.75, 0.45))
    yield box((-0.02 - tilt / 3, 0, -0.6), (0.3, 0.2, 0.4))


def axe(u: Draw) -> Iterator[Hull]:
    """Handle with a bent end, head, blade, spike."""
    length = u(2.6, 3.2)
    blade = u(0.8, 1.3)
    yield rod((0, 0, 0.4), (0, 0, length), 0.17)
    yield rod((0, 0, 0.5), (u(0.2, 0.5), 0, 0), 0.19, 0.22)
    yield box((0, 0, length - 0.2), (0.7, 0.45, 0.55))
    edge = [
        (blade + 0.3, length + 0.35),
        (blade + 0.4, length - 0.2),
        (blade + 0.2, length - u(0.8, 1.1)),
    ]
    yield prism([(0.2, length - 0.45), (0.2, length), *edge], -0.14, 0.14)
    yield cylinder((-0.25, 0, length - 0.2), (-u(0.6, 1.0), 0, length - 0.2), 0.24, 0.1, sides=8)


def pliers(u: Draw) -> Iterator[Hull]:
    """Two handles of unequal bend, pivot, two jaws of unequal length."""
    opening = u(0.35, 0.6)
    depth = u(0.28, 0.4)
    yield rod((0, 0.03, 0), (-1.2, 0.03, -opening), 0.22, 0.19)
    yield rod((-1.2, 0, -opening), (-u(2.0, 2.4), 0, -opening * 0.7), 0.22)
    yield rod((0, -0.03, 0), (-1.1, -0.03, opening), 0.22, 0.19)
    yield rod((-1.1, 0, opening), (-u(1.7, 2.2), 0, opening * 1.5), 0.22)
    yield cylinder((0, -depth, 0), (0, depth, 0), u(0.35, 0.48))
    yield beam((0.1, 0.15), (u(1.1, 1.6), 0.3), 0.26, depth)
    yield beam((0.1, -0.15), (u(0.7, 1.0), -0.3), 0.34, depth)


STROKES = {
    "F": "0,0 0,2 1.2,2 | 0,1.1 0.8,1.1",
    "G": "1.2,1.7 0.5,2 0,1.4 0,0.5 0.5,0 1.2,0.2 1.2,0.9 0.7,0.9",
    "J": "1,2 1,0.5 0.6,0 0.2,0 0,0.4 | 0.5,2 1.4,2",
    "L": "0,0 0,2 | 0,0 1.1,0",
    "P": "0,0 0,2 0.8,2 1.1,1.5 0.8,1 0,1",
    "Q": "0.3,2 1,2 1.3,1 1,0 0.3,0 0,1 0.3,2 | 0.8,0.6 1.5,-0.3",
    "R": "0,0 0,2 0.8,2 1.1,1.5 0.8,1 0,1 | 0.5,1 1.2,0",
    "a": "0,0 0.6,2 1.3,0 | 0.25,0.7 1.1,0.7 | 1.3,0 1.7,0",
    "h": "0,0 0,2 | 0,1 0.8,1.1 1,0.8 1,0",
    "k": "0,0 0,2 | 0,0.7 0.9,1.5 | 0.3,0.95 1,0",
    "y": "0,2 0.6,1 | 1.2,2 0.2,0 -0.2,0",
    "2": "0,1.6 0.4,2 0.9,2 1.2,1.5 0,0 1.3,0",
    "4": "0.9,0 0.9,2 0,0.7 1.3,0.7",
    "5": "1.1,2 0.1,2 0,1.1 0.8,1.2 1.1,0.7 0.8,0 0,0.1",
    "7": "0,2 1.2,2 0.5,0 | 0.5,1.1 1.2,1.1",
}
"""Lines (x,z) of characters without a symmetry in their plane."""


def letter(u: Draw) -> Iterator[Hull]:
    """A character of straight strokes, slanted and stretched."""
    lines = STROKES[str(u.choice(sorted(STROKES)))].split("|")
    stretch = u(0.85, 1.25)
    slant = u(-0.2, 0.3)
    width = u(0.28, 0.42)
    depth = u(0.35, 0.8)
    for line in lines:
        corners = [[float(number) for number in corner.split(",")] for corner in line.split()]
        for start, end in pairwise((stretch * x + slant * z, z) for x, z in corners):
            yield beam(start, end, width, depth)


def monogram(u: Draw) -> Iterator[Hull]:
    """An L or a hook of thick strokes with a rod and a ball on its faces: no mirror plane left."""
    width = u(0.4, 0.55)
    depth = u(0.4, 0.7)
    arm = u(0.8, 1.5)
    side = u.choice([-1.0, 1.0])
    yield beam((0, 0), (0, u(1.6, 2.2)), width, depth)
    yield beam((0, 0), (arm, u(-0.2, 0.3)), width, depth)
    yield rod((0, 0, 1.2), (u(-0.3, 0.3), side * u(0.8, 1.2), 1.3), 0.3, 0.24)
    yield ellipsoid((arm, -side * 0.2, 0.1), (0.4, 0.5, 0.4))


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _grown(u: Draw, host: Hull) -> Hull:
    """A random primitive rooted inside a part and sticking out of it."""
    normals, offsets = hull_planes(host)
    centre = host.vertices.mean(axis=0)
    plane = int(u.integers(len(normals)))
    normal = normals[plane]
    surface = centre + (offsets[plane] - normal @ centre) * normal
    out = _unit(normal + u.normal(0.0, 0.25, 3))
    length = u(0.6, 1.5)
    turn = u(-np.pi, np.pi, 3)
    kind = int(u.integers(4))
    thick = u(0.25, 0.5)
    root = surface - 0.3 * length * out
    middle = surface + out * length * 0.35
    if kind == 0:
        return rod(root, surface + length * out, thick, thick * u(0.5, 1.0))
    if kind == 1:
        return cylinder(root, surface + 0.8 * length * out, thick, thick * u(0.4, 1.3), sides=10)
    if kind == 2:
        return box(middle, u(0.5, 1.3, 3), euler=turn)
    return ellipsoid(middle, u(0.35, 0.8, 3), euler=turn)


def cluster(u: Draw) -> list[Hull]:
    """Random primitives grown on one another."""
    parts = [box((0, 0, 0), u(0.8, 1.6, 3))]
    for _ in range(int(u.integers(3, 7))):
        parts.append(_grown(u, parts[int(u.integers(len(parts)))]))
    return parts


def branch(u: Draw) -> Iterator[Hull]:
    """A bent trunk of rods with side arms that end in blobs."""
    points = [np.zeros(3)]
    direction = vec(0.0, 0.0, 1.0)
    for _ in range(3):
        direction = _unit(direction + u.normal(0.0, 0.45, 3))
        points.append(points[-1] + direction * u(0.6, 1.0))
    thick = u(0.22, 0.34)
    for start, end in pairwise(points):
        yield rod(start, end, thick, 0.9 * thick)
    for joint in points[1:3]:
        end = joint + _unit(np.cross(direction, u.normal(size=3))) * u(0.6, 1.2)
        yield rod(joint, end, 0.8 * thick, 0.6 * thick)
        yield ellipsoid(end, u(0.25, 0.5, 3))


def handled_tool(u: Draw) -> Iterator[Hull]:
    """A handle with a collar and a head of any form at an angle: spoon, brush, key, ladle, mallet."""
    length = u(2.4, 4.5)
    thick = u(0.16, 0.32)
    flat = u(0.4, 1.0)
    head = vec(length, 0.0, 0.0)
    lean = u(-0.9, 0.9)
    size = u(0.35, 0.9, 3) * (1.0, 1.0, flat)
    aside = u(-0.3, 0.3)
    yield rod((0, 0, 0), head, thick, thick * u(0.6, 1.0))
    yield cylinder((0.3 * length, 0, 0), (u(0.45, 0.6) * length, 0, 0), thick * u(1.0, 1.4))
    place = head + vec(0.6 * size[0], aside, 0.0)
    form = int(u.integers(3))
    if form == 0:
        yield ellipsoid(place, size, euler=(0, lean, aside))
    elif form == 1:
        yield box(place, 1.6 * size, euler=(0, lean, aside), top=(u(0.6, 1.0), 1.0))
    else:
        across = vec(0.0, size[1] + 0.3, u(-0.4, 0.4))
        yield cylinder(place - across, place + u(0.4, 1.0) * across, 0.7 * size[0])
    yield box((0.0, 0, 0), (0.5, u(2.2, 3.0) * thick, u(1.6, 2.4) * thick))


def bent_bar(u: Draw) -> Iterator[Hull]:
    """A bar of two or three straight pieces, with a knob near one end: lever, crank, bracket."""
    thick = u(0.3, 0.55)
    depth = u(0.3, 0.6)
    bend = u(-1.1, 1.1)
    length = u(1.8, 3.2)
    rest = u(0.5, 1.6)
    end = vec(length + rest * np.cos(bend), rest * np.sin(bend))
    yield beam((0, 0), (length, 0), thick, depth)
    yield beam((length, 0), end, thick * u(0.7, 1.0), depth)
    if u() < 0.5:
        turn = bend + u(0.6, 1.4) * u.choice([-1.0, 1.0])
        yield beam(end, end + u(0.4, 0.9) * vec(np.cos(turn), np.sin(turn)), thick, depth)
    knob = vec(u(0.1, 0.4) * length, 0.0, u(0.2, 0.6) * thick)
    yield ellipsoid(knob, u(0.3, 0.5, 3))


def plate(u: Draw) -> Iterator[Hull]:
    """A flat body with a lobe, a boss and a rim: phone, tray, cover, pan without a handle."""
    angle = np.sort(u(0.0, 2.0 * np.pi, 7)) + 0.2 * np.arange(7)
    angle *= 2.0 * np.pi / (angle[-1] + 0.4)
    outline = np.stack([u(1.0, 1.4) * np.cos(angle), u(0.7, 1.2) * np.sin(angle)], axis=1)
    thick = u(0.2, 0.4)
    yield prism(outline, 0.0, thick, axis="z")
    yield prism(0.5 * outline + vec(u(0.6, 1.0), u(-0.5, 0.5)), 0.0, thick, axis="z")
    boss = vec(u(-0.5, 0.2), u(-0.4, 0.4), 0.5 * thick)
    yield cylinder(boss, boss + vec(0, 0, u(0.3, 0.7)), u(0.25, 0.45), sides=10)
    yield beam((-0.9, 0.5 * thick), (0.4, thick * u(0.5, 1.2)), thick, u(0.2, 0.5))


def open_ring(u: Draw) -> Iterator[Hull]:
    """Six pieces around a flattened ring, one of them heavy, and a stub: ring, clamp, frame, watch."""
    wide = u(0.9, 1.3)
    high = u(0.5, 1.1)
    thick = u(0.22, 0.36)
    depth = u(0.3, 0.7)
    count = 6 if u() < 0.7 else 5
    corners = 2.0 * np.pi * np.arange(7) / 6 + u(0.0, 1.0)
    points = np.stack([wide * np.cos(corners), high * np.sin(corners)], axis=1)
    for start, end in pairwise(points[: count + 1]):
        yield beam(start, end, thick, depth)
    heavy = np.insert(points[1], 1, u(-0.1, 0.1))
    yield box(
        heavy, (u(0.5, 0.9), u(0.6, 1.0) * (depth + 0.2), u(0.4, 0.8)), euler=(0, u(-1, 1), 0)
    )
    if count == 5:
        yield beam(points[0], 1.5 * points[0], thick, depth)


def hook(u: Draw) -> Iterator[Hull]:
    """A straight shank and an arc of four pieces, with a foot: hook, cane, tap, handle."""
    shank = u(1.2, 2.6)
    radius = u(0.5, 0.9)
    thick = u(0.18, 0.3)
    angles = np.linspace(np.pi, np.pi - u(2.0, 4.0), 5)
    arc = np.stack([radius * (1.0 + np.cos(angles)), shank + radius * np.sin(angles)], axis=1)
    arc = np.insert(arc, 1, u(-0.3, 0.3) * np.linspace(0.0, 1.0, 5) ** 2, axis=1)
    yield rod((0, 0, 0), arc[0], thick * u(0.9, 1.3), thick)
    for start, end in pairwise(arc):
        yield rod(start, end, thick)
    yield box((0.1, u(-0.2, 0.2), 0), (u(0.5, 1.0), u(0.4, 0.9), u(0.2, 0.5)))


def shell(u: Draw) -> Iterator[Hull]:
    """A trough of four wall pieces with one end closed and a tab: scoop, half a shell, soap dish."""
    radius = u(0.7, 1.1)
    length = u(1.4, 2.6)
    wall = u(0.14, 0.22)
    span = u(2.2, 3.6)
    angles = -0.5 * np.pi + np.linspace(-0.5, 0.5, 5) * span
    for start, end in pairwise(angles):
        outline = [
            (r * np.cos(t), r * np.sin(t)) for r in (radius, radius - wall) for t in (start, end)
        ]
        yield prism(outline, 0.0, length)
    closed = [(0.97 * radius * np.cos(t), 0.97 * radius * np.sin(t)) for t in angles]
    yield prism(closed, 0.0, wall * u(1.0, 1.6))
    tab = vec(radius * np.cos(angles[0]), u(0.2, 0.8) * length, radius * np.sin(angles[0]))
    yield box(tab, (u(0.4, 0.8), u(0.4, 0.9), 1.2 * wall))


def mug(u: Draw) -> Iterator[Hull]:
    """A bottom, five walls, a handle of two rods: open, so truly concave."""
    radius = u(0.8, 1.0)
    height = u(1.5, 2.2)
    wall = u(0.14, 0.2)
    angles = 2.0 * np.pi * np.arange(6) / 5
    bottom = [(0.95 * radius * np.cos(t), 0.95 * radius * np.sin(t)) for t in angles[:5]]
    yield prism(bottom, 0.0, 1.4 * wall, axis="z")
    for start, end in pairwise(angles):
        outline = [
            (r * np.cos(t), r * np.sin(t)) for r in (radius, radius - wall) for t in (start, end)
        ]
        yield prism(outline, 0.0, height, axis="z")
    reach = u(0.5, 0.8)
    low = 0.2 * height
    high = u(0.7, 0.9) * height
    corner = (-radius - reach, 0.0, u(0.4, 0.6) * height)
    # The middle of the wall opposite the first corner; the rod's cap must not come through it.
    inner = -radius * np.cos(np.pi / 5) - 0.04
    yield rod((inner, 0, low), corner, 0.15)
    yield rod(corner, (inner, 0, high), 0.15)


def chair(u: Draw) -> Iterator[Hull]:
    """Seat, back, four legs, two arm rests."""
    width = u(1.1, 1.4)
    depth = u(1.0, 1.3)
    leg = u(0.8, 1.2)
    back = u(1.0, 1.5)
    thick = u(0.14, 0.2)
    splay = u(0.0, 0.15)
    lean = u(0.0, 0.25)
    yield box((0, 0, leg), (depth, width, 0.24))
    behind = (-depth / 2 - lean / 2, 0, leg + back / 2)
    yield box(behind, (0.22, 0.9 * width, back + 0.2), euler=(0, -lean, 0))
    for x, y in product(SIDES, SIDES):
        top = vec(x * (depth / 2 - thick), y * (width / 2 - thick), leg)
        yield rod(top, top * (1 + splay, 1 + splay, 0), thick, 0.8 * thick)
    arm = u(0.35, 0.5)
    rear = -depth / 2 - 0.1
    rest = [(rear, leg), (depth * 0.3, leg), (depth * 0.4, leg + arm), (rear, leg + arm)]
    for y in SIDES:
        yield prism(rest, y * width / 2 - 0.1, y * width / 2 + 0.1)


def robot(u: Draw) -> Iterator[Hull]:
    """Torso, head, backpack, arms and legs in a pose, antenna."""
    width = u(0.8, 1.1)
    height = u(0.9, 1.3)
    yield box((0, 0, height / 2), (0.6, width, height), top=(1.0, 1.15))
    yield box((0.05, 0, height + 0.22), (0.5, 0.55, 0.5), euler=(0, 0, u(-0.5, 0.5)))
    yield box((-0.45, 0, 0.6 * height), (0.4, 0.6 * width, 0.6 * height))
    for side in SIDES:
        shoulder = vec(0.0, side * width * 0.55, height - 0.15)
        swing = u(-0.9, 2.2)
        yield rod(
            shoulder,
            shoulder + vec(np.sin(swing), 0.3 * side, -np.cos(swing)) * u(0.8, 1.0),
            0.2,
            0.16,
        )
        step = u(-0.35, 0.35)
        foot = (step, side * 0.3 * width, -u(0.8, 1.0))
        yield rod((0, side * 0.27 * width, 0.1), foot, 0.24, 0.22)
    yield cylinder((0, 0.15, height + 0.4), (-0.1, 0.2, height + u(0.7, 1.0)), 0.08, 0.12, sides=8)


def camera(u: Draw) -> Iterator[Hull]:
    """Body, lens, hood, grip, finder, dial."""
    width = u(1.7, 2.2)
    height = u(1.0, 1.3)
    depth = u(0.5, 0.7)
    lens = u(0.36, 0.46)
    reach = depth / 2 + u(0.4, 0.9)
    offset = u(-0.3, 0.1)
    dial = width / 2 - 0.3
    yield box((0, 0, 0), (depth, width, height))
    yield cylinder((0, offset, 0), (reach, offset, 0), lens)
    yield cylinder((reach - 0.1, offset, 0), (reach + 0.3, offset, 0), lens, 1.2 * lens)
    yield rod(
        (0.25, width / 2 - 0.15, -0.3 * height), (0.25, width / 2 - 0.15, 0.35 * height), 0.26
    )
    yield box((0, offset, height / 2 + 0.1), (0.9 * depth, 0.6, 0.45), top=(0.8, 0.6))
    yield cylinder((0, dial, 0.4 * height), (0, dial, height / 2 + 0.2), 0.2, sides=10)


Kind = Callable[[Draw], Iterable[Hull]]
"""Draws one object; its parts overlap, so that the object is one piece."""

TRAINING: dict[str, tuple[Kind, ...]] = {
    "vehicles": (car, truck, locomotive, aeroplane, boat),
    "animals": (quadruped, bird, fish, dinosaur),
    "shoes": (sneaker, boot, heel_shoe),
    "tools": (hammer, wrench, drill, axe, pliers),
    "letters": (letter, monogram),
    "composites": (cluster, branch),
}
"""Kinds by training family."""

HELD_OUT: dict[str, tuple[Kind, ...]] = {
    "kitchen": (mug,),
    "furniture": (chair,),
    "figures": (robot,),
    "cameras": (camera,),
}
"""Kinds by held-out family, none of which resembles a training kind."""

SLENDER: dict[str, tuple[Kind, ...]] = {
    "slender": (handled_tool, bent_bar, plate, open_ring, hook, shell),
}
"""Long, flat and hollow kinds, for training beside ``TRAINING``."""

FAMILIES = {"training": TRAINING, "heldout": HELD_OUT, "slender": SLENDER}
"""Kinds by family, by what a set of them is called. Their order is part of every object's seed."""
