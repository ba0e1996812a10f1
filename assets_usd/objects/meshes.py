"""Foreign meshes: the size and weight they are given."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import trimesh

from vd.assets_usd.objects.settings import DENSITIES_KG_M3, ImportSettings, MeshError
from vd.paper import PAPER

LONGEST_SIDE_M = (0.095, 0.165)
"""Range of an object's longest side: the objects of the paper."""

MEAN_WIDTH_M = 0.13
"""Most of the mean width, the side of the bounding box averaged over all its orientations (our
choice).

What is wider starts wedged between the fingers and stays there: of seven such objects (14.5 cm and
more) a policy brought 22 % to their goals, of the others 92 %.
"""

THINNEST_M = 0.025
"""Least of the shortest side, as far as the other bounds let it be (our choice).

What is thinner lies flat on the table, where no finger gets under it: of eight such objects the
same policy brought 49 % to their goals.
"""

UNITS_M = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254}
"""Units a mesh may be in."""

GUESSED_UNITS = ("m", "mm", "cm")
"""Units that are tried where none is known; the first that needs the least rescaling is taken. An
inch is too near to others to be guessed."""


def mean_width(vertices: np.ndarray) -> float:
    """Mean distance of two parallel planes that enclose points, over all directions.

    It is the integral of the mean curvature of their convex hull over 2 pi: 2 r of a sphere, half
    of the sum of its sides for a box.

    Args:
        vertices: Points in any unit and frame, not all in a plane [V, 3].

    Returns:
        The mean width in the points' unit.
    """
    return float(trimesh.convex.convex_hull(vertices).integral_mean_curvature / (2.0 * np.pi))


@dataclass(frozen=True)
class SizeLimits:
    """Sizes of objects that fit a hand [m]."""

    longest: tuple[float, float] = LONGEST_SIDE_M
    """Range of the longest side."""
    mean_width: float = MEAN_WIDTH_M
    """Most of the mean width."""
    thinnest: float = THINNEST_M
    """Least of the shortest side."""


@cache
def fit_of(hand: str) -> SizeLimits:
    """Sizes that fit a hand: its longest sides, and of a D'Claw's bounds as large a share.

    Args:
        hand: Its name or USD file.

    Raises:
        ValueError: No hand has this name.
    """
    from vd.assets_usd.hands import load_hand

    least, most = load_hand(hand).workspace.size_m
    share = most / LONGEST_SIDE_M[1]
    return SizeLimits((least, most), share * MEAN_WIDTH_M, share * THINNEST_M)


DCLAW = SizeLimits()
"""Sizes of the paper's hand."""


def scales_that_fit(
    sides: Sequence[float], width: float, fit: SizeLimits = DCLAW
) -> tuple[float, float]:
    """Least and largest factor to metres by which a shape fits a hand.

    A shape that fits at no size has a least factor above the largest.

    Args:
        sides: Sides of the bounding box in the shape's units, in any order, none of them 0 [3].
        width: :func:`mean_width` in the shape's units.
        fit: Sizes that fit the hand.
    """
    low, high = fit.longest
    longest = float(max(sides))
    least = max(low / longest, fit.thinnest / float(min(sides)))
    return least, min(high / longest, fit.mean_width / width)


def scale_of(
    settings: ImportSettings, vertices: np.ndarray, declared: float | None
) -> tuple[float, list[str], list[str]]:
    """Factor to metres for vertices [V, 3] in a file's unit (``declared``, m).

    Notes and warnings.
    """
    sides = np.ptp(vertices, axis=0)
    width = mean_width(vertices)
    fit = fit_of(settings.hand)
    unit = UNITS_M.get(settings.units, declared)
    if not settings.keep_size or unit is None:
        factor, note = choose_scale(sides, width, unit, fit)
        return factor, [note] if note else [], []
    size = f"{sides.max() * unit:.3f} m"
    notes = [f"taken as {unit_name(unit)}, real size kept: {size}"]
    least, most = scales_that_fit(sides, width, fit)
    if least <= unit <= most:
        return unit, notes, []
    misfit = (
        f"does not fit the hand at its real size of {size}, mean width {width * unit:.3f} m: "
        f"longest side {fit.longest[0]:g} to {fit.longest[1]:g} m, mean width at most "
        f"{fit.mean_width:.3g} m, shortest side at least {fit.thinnest:.3g} m"
    )
    return unit, notes, [misfit]


def mass_of(settings: ImportSettings, volume: float) -> tuple[float, list[str], list[str]]:
    """Mass [kg] of a solid of a volume [m^3]; notes and warnings.

    Raises:
        MeshError: A mass was given that no material of this volume has.
    """
    if settings.density is not None:
        mass = settings.density * volume
        return mass, [f"mass {mass:.3g} kg by a density of {settings.density:g} kg/m3"], []
    mass = PAPER.materials.object_mass_kg if settings.mass is None else settings.mass
    low, high = DENSITIES_KG_M3
    density = mass / volume
    what = f"a mass of {mass:g} kg makes {density:.3g} kg/m3, and {low:g} to {high:g} are possible"
    if low <= density <= high:
        return mass, [] if settings.mass is None else [f"mass {mass:g} kg as given"], []
    if settings.mass is None:
        return mass, [], [f"{what}; give --density or --mass"]
    raise MeshError(f"{what}; --mass is in kg")


def unit_name(unit: float) -> str:
    """Name of a unit of so many metres."""
    return next((name for name, metres in UNITS_M.items() if metres == unit), f"{unit:g} m")


def choose_scale(
    sides: Sequence[float], width: float, unit: float | None = None, fit: SizeLimits = DCLAW
) -> tuple[float, str]:
    """Factor from a mesh's units to metres, so that it fits a hand.

    The paper scales each mesh by hand, "to a proper size compared to the robot hand size", with its
    longest side in ``LONGEST_SIDE_M`` (supplementary text on objects). Here a mesh stays as it is
    where it fits; otherwise it is scaled as little as possible. The range of the longest side is
    kept first, thickness gives way first. A unit that is not known is the one of ``GUESSED_UNITS``
    that needs the least rescaling.

    Args:
        sides: Sides of the bounding box in the mesh's units, in any order, none of them 0 [3].
        width: :func:`mean_width` in the mesh's units.
        unit: Unit of the mesh [m]; None if it is not known.
        fit: Sizes that fit the hand.

    Returns:
        The factor and a note, empty if the mesh is taken as it is.
    """
    least, most = scales_that_fit(sides, width, fit)
    longest = float(max(sides))
    most = max(most, fit.longest[0] / longest)
    least = min(least, most)

    def fitting(unit: float) -> float:
        return float(np.clip(unit, least, most))

    if unit is None:
        units = map(UNITS_M.__getitem__, GUESSED_UNITS)
        unit = min(units, key=lambda metres: abs(np.log(fitting(metres) / metres)))
    factor = fitting(unit)
    words = [] if unit == 1.0 else [f"taken as {unit_name(unit)}"]
    if factor != unit:
        words.append(f"scaled by {factor / unit:.3g} to {longest * factor:.3f} m")
    return factor, ", ".join(words)
