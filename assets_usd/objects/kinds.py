"""Kinds of procedural objects.

Each draws the overlapping convex parts of one object, at most eight.

x points forward, y to the left, z up; units are arbitrary. ``u(low, high)`` draws a number; the
order of the draws is the shape of a seed: keep it.
"""

from collections.abc import Callable, Iterable, Iterator
from itertools import product

import numpy as np

from vd.assets_usd.objects.geometry import Hull
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


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _limb(u: Draw, root: np.ndarray, out: np.ndarray) -> Hull:
    """A rod, cone, box or ball around a point, which reaches out along a unit vector."""
    length = u(0.6, 1.5)
    thick = u(0.2, 0.5)
    end = root + length * out
    middle = root + 0.2 * out
    turn = u(-np.pi, np.pi, 3)
    match int(u.integers(4)):
        case 0:
            return rod(root, end, thick, thick * u(0.5, 1.0))
        case 1:
            return cylinder(root, end, thick, thick * u(0.4, 1.3), sides=10)
        case 2:
            return box(middle, u(0.5, 1.6, 3), euler=turn)
        case _:
            return ellipsoid(middle, u(0.35, 0.9, 3), euler=turn)


def figure(u: Draw) -> Iterator[Hull]:
    """A trunk with limbs, some in pairs right and left: animals, vehicles, shoes, appliances."""
    size = u(0.4, 1.6, 3)
    yield box((0, 0, 0), 2.0 * size, top=(u(0.6, 1.0), u(0.6, 1.0)))
    for _ in range(int(u.integers(1, 4))):
        out = _unit(u.normal(size=3) * (1.0, 0.0, 1.0))
        yield _limb(u, 0.7 * size * out, out)
    for _ in range(int(u.integers(1, 3))):
        out = _unit(u.normal(size=3))
        limb = _limb(u, 0.7 * size * out, out)
        yield limb
        yield Hull(limb.vertices * (1, -1, 1), limb.faces[:, ::-1])


def cluster(u: Draw) -> list[Hull]:
    """Random primitives grown on one another."""
    parts = [box((0, 0, 0), u(0.8, 1.6, 3))]
    for _ in range(int(u.integers(3, 7))):
        host = parts[int(u.integers(len(parts)))].vertices
        centre = host.mean(axis=0)
        corner = host[int(u.integers(len(host)))] - centre
        out = _unit(_unit(corner) + u.normal(0.0, 0.25, 3))
        parts.append(_limb(u, centre + 0.7 * corner, out))
    return parts


def tool(u: Draw) -> Iterator[Hull]:
    """A handle with a collar and a head at its end: hammer, spoon, brush, key, ladle."""
    length = u(2.4, 5.0)
    thick = u(0.16, 0.4)
    end = vec(length, 0.0, 0.0)
    yield rod((0, 0, 0), end, thick, thick * u(0.6, 1.0))
    yield cylinder((0.3 * length, 0, 0), (u(0.45, 0.6) * length, 0, 0), thick * u(1.0, 1.4))
    for _ in range(int(u.integers(1, 4))):
        yield _limb(u, end, _unit(u.normal(size=3)))


def path(u: Draw) -> Iterator[Hull]:
    """Bars end to end, each turned against the last, and a knob: letter, lever, hook, ring."""
    width = u(0.25, 0.5)
    depth = u(0.3, 0.8)
    bend = u(-1.3, 1.3)
    angle = 0.0
    end = vec(0.0, 0.0)
    for _ in range(int(u.integers(2, 7))):
        start = end
        angle += bend + u(-0.4, 0.4)
        end = start + u(0.6, 1.4) * vec(np.cos(angle), np.sin(angle))
        yield beam(start, end, width, depth)
    yield _limb(u, np.insert(end, 1, 0.0), _unit(u.normal(size=3)))


def plate(u: Draw) -> Iterator[Hull]:
    """A flat body with a lobe, a boss and a rim: phone, tray, cover, pan without a handle."""
    angle = 2.0 * np.pi / 7 * (np.arange(7) + u(-0.3, 0.3, 7))
    outline = _arc(1.0, angle) * (u(1.0, 1.4), u(0.7, 1.2))
    thick = u(0.2, 0.4)
    yield prism(outline, 0.0, thick, axis="z")
    yield prism(0.5 * outline + vec(u(0.5, 0.8), u(-0.3, 0.3)), 0.0, thick, axis="z")
    boss = vec(u(-0.5, 0.2), u(-0.4, 0.4), 0.5 * thick)
    yield cylinder(boss, boss + vec(0, 0, u(0.3, 0.7)), u(0.25, 0.45), sides=10)
    yield beam((-0.9, 0.5 * thick), (0.4, thick * u(0.5, 1.2)), thick, u(0.2, 0.5))


def _arc(radius: float, angles: np.ndarray) -> np.ndarray:
    """Points of a circle [N, 2]."""
    return np.stack([radius * np.cos(angles), radius * np.sin(angles)], axis=1)


def _walls(
    radius: float, wall: float, angles: np.ndarray, height: float, axis: str
) -> Iterator[Hull]:
    """Pieces of a wall around an axis, with their edges at angles."""
    for ends in np.stack([angles[:-1], angles[1:]], axis=1):
        outline = np.concatenate([_arc(radius, ends), _arc(radius - wall, ends)])
        yield prism(outline, 0.0, height, axis=axis)


def shell(u: Draw) -> Iterator[Hull]:
    """A trough of four walls with one end closed and a tab: scoop, half a shell, soap dish."""
    radius = u(0.7, 1.1)
    length = u(1.4, 2.6)
    wall = u(0.2, 0.32)
    span = u(2.2, 3.6)
    angles = -0.5 * np.pi + np.linspace(-0.5, 0.5, 5) * span
    yield from _walls(radius, wall, angles, length, "y")
    yield prism(_arc(0.97 * radius, angles), 0.0, wall * u(1.0, 1.6))
    tab = vec(radius * np.cos(angles[0]), u(0.2, 0.8) * length, radius * np.sin(angles[0]))
    yield box(tab, (u(0.4, 0.8), u(0.4, 0.9), 1.2 * wall))


def _section(u: Draw, start: np.ndarray, end: np.ndarray, width: float, depth: float) -> Hull:
    """A straight piece between two points: round, with corners, or flat as a blade is."""
    match int(u.integers(3)):
        case 0:
            return rod(start, end, 0.5 * width, 0.5 * width * u(0.5, 1.0))
        case 1:
            return beam(start[[0, 2]], end[[0, 2]], width, depth)
        case _:
            return cylinder(start, end, 0.5 * width, 0.5 * width * u(0.6, 1.2), sides=8)


def bar(u: Draw) -> Iterator[Hull]:
    """Sections end to end in a line, and a knob beside it: pen, torch, screwdriver, knife."""
    x = 0.0
    for _ in range(int(u.integers(2, 5))):
        width = u(0.3, 0.9)
        start = vec(x - 0.1, 0, 0)
        x += u(0.8, 2.4)
        yield _section(u, start, vec(x, 0, u(-0.15, 0.15)), width, width * u(0.4, 1.2))
    knob = vec(x * u(0.1, 0.9), 0, 0.3)
    yield box(knob, u(0.25, 0.7, 3), euler=(0, 0, u(-0.5, 0.5)))


def handled(u: Draw) -> Iterator[Hull]:
    """A handle and a head across or along it: hammer, brush, spoon, racket, key."""
    length = u(2.5, 5.0)
    width = u(0.3, 0.7)
    end = vec(length, 0, 0)
    yield _section(u, vec(0, 0, 0), end, width, width * u(0.5, 1.2))
    yield ellipsoid((0.2 * length, 0, 0), (u(0.2, 0.35) * length, 0.6 * width, 0.6 * width))
    tilt = (u(-0.4, 0.4), u(-0.5, 0.5), u(-0.3, 0.3))
    size = vec(u(0.4, 1.8), u(0.4, 2.4), u(0.25, 0.8))
    if u.integers(2):
        yield box(end, size, euler=tilt, top=(u(0.5, 1.0), u(0.5, 1.0)))
    else:
        yield ellipsoid(end, 0.6 * size, euler=tilt)
    yield box(end + vec(u(-0.3, 0.2), 0.4 * size[1], u(0.0, 0.3)), u(0.3, 0.8, 3), euler=tilt)


def prongs(u: Draw) -> Iterator[Hull]:
    """A handle, a bridge across its end and bars along it: fork, rake, comb, plug, pliers."""
    length = u(1.5, 3.5)
    count = int(u.integers(2, 5))
    reach = u(0.6, 2.2)
    spread = u(0.9, 2.0)
    width = u(0.25, 0.4)
    rise = u(-0.3, 0.3)
    yield _section(u, vec(0, 0, 0), vec(length, 0, 0), u(0.35, 0.7), u(0.3, 0.7))
    yield box((length, 0, 0), (0.5, spread + width, u(0.3, 0.5)))
    for y in np.linspace(-0.5, 0.5, count) * spread:
        tip = vec(length + reach * u(0.7, 1.0), y * u(0.8, 1.2), rise)
        yield rod((length, y, 0), tip, 0.5 * width)


def cross(u: Draw) -> Iterator[Hull]:
    """Two bars that cross, with a lump at their ends: scissors, clamp, wrench, propeller."""
    angle = u(0.25, 1.4)
    thick = u(0.3, 0.5)
    for side in SIDES:
        way = vec(np.cos(0.5 * angle), 0, side * np.sin(0.5 * angle))
        front = u(1.0, 2.4)
        back = u(0.6, 1.8)
        shift = vec(0, 0.3 * side * thick, 0)
        start = -back * way + shift
        yield _section(u, start, front * way + shift, u(0.3, 0.6), thick)
        yield _limb(u, start, -way)
    yield cylinder((0, -0.6 * thick, 0), (0, 0.6 * thick, 0), u(0.25, 0.45), sides=10)


def hoop(u: Draw) -> Iterator[Hull]:
    """A bow of walls with pads at its ends: headphones, tongs, bracelet, handle of a bucket."""
    span = u(2.4, 5.6)
    radius = u(0.9, 1.3)
    wall = u(0.2, 0.35)
    height = u(0.25, 0.7)
    angles = np.linspace(-0.5, 0.5, 6) * span
    yield from _walls(radius, wall, angles, height, "y")
    for end in (0, -1):
        middle = (radius - 0.5 * wall) * vec(np.cos(angles[end]), 0, np.sin(angles[end]))
        yield box(middle + vec(0, 0.5 * height, 0), u(0.4, 1.0, 3), euler=(0, -angles[end], 0))


def frame(u: Draw) -> Iterator[Hull]:
    """A flat front and two arms back from its ends: spectacles, clip, bracket, stapler, tray."""
    width = u(1.6, 3.0)
    tall = u(0.5, 1.0)
    thick = u(0.25, 0.4)
    reach = u(1.0, 2.6)
    yield box((0, 0, 0), (thick, width, tall))
    for side in SIDES:
        root = vec(0, 0.5 * side * (width - thick), u(-0.3, 0.3) * tall)
        tip = root + vec(-reach * u(0.7, 1.0), side * u(-0.5, 0.2), 0)
        yield rod(root, tip, 0.5 * thick)
        yield rod(tip, tip + vec(-0.3, 0, -u(0.2, 0.7)), 0.5 * thick)
    yield box((0.1, u(-0.3, 0.3) * width, 0), (u(0.3, 0.8), u(0.4, 0.9), u(0.3, 0.8)))


def mug(u: Draw) -> Iterator[Hull]:
    """A bottom, five walls, a handle of two rods: open, so truly concave."""
    radius = u(0.8, 1.0)
    height = u(1.5, 2.2)
    wall = u(0.14, 0.2)
    angles = 2.0 * np.pi * np.arange(6) / 5
    yield prism(_arc(0.95 * radius, angles[:5]), 0.0, 1.4 * wall, axis="z")
    yield from _walls(radius, wall, angles, height, "z")
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

KINDS: dict[str, tuple[Kind, ...]] = {
    "training": (figure, path, tool, plate, shell, cluster),
    "heldout": (mug, chair, robot, camera),
    "tools": (bar, handled, prongs, cross, hoop, frame),
}
"""Kinds by what a set of them is called; training draws none of the held-out ones. Their order is
part of every object's seed. Tools are as long and thin as hands can hold."""
