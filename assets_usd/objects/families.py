"""Families of procedural objects: each kind is a function from a generator to convex parts.

x points forward, y to the left, z up; units are arbitrary. Parts overlap, so that an object is one
piece, and at most eight are used, one collision shape each. A left-right mirror plane is welcome, as
in real things; a rotational symmetry is not, and :mod:`.procedural` draws again where one shows up.
"""

from collections.abc import Callable

import numpy as np

from vd.assets_usd.objects import kinds_abstract as abstract
from vd.assets_usd.objects import kinds_animals as animals
from vd.assets_usd.objects import kinds_goods as goods
from vd.assets_usd.objects import kinds_held_out as held_out
from vd.assets_usd.objects import kinds_vehicles as vehicles
from vd.assets_usd.objects.geometry import Hull

Maker = Callable[[np.random.Generator], list[Hull]]
"""Draws one object of a kind."""

TRAINING: dict[str, tuple[Maker, ...]] = {
    "vehicles": (vehicles.car, vehicles.truck, vehicles.locomotive, vehicles.aeroplane, vehicles.boat),
    "animals": (animals.quadruped, animals.bird, animals.fish, animals.dinosaur),
    "shoes": (goods.sneaker, goods.boot, goods.heel_shoe),
    "tools": (goods.hammer, goods.wrench, goods.drill, goods.axe, goods.pliers),
    "letters": (abstract.letter, abstract.monogram),
    "composites": (abstract.cluster, abstract.branch),
}
"""Kinds by training family."""

HELD_OUT: dict[str, tuple[Maker, ...]] = {
    "kitchen": (held_out.mug, held_out.teapot, held_out.pan),
    "furniture": (held_out.chair, held_out.desk_lamp),
    "figures": (held_out.robot, held_out.cactus),
    "cameras": (held_out.camera,),
}
"""Kinds by held-out family."""
