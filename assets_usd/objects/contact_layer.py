"""Identified contact of an object as a layer over its USD file: ``identified.usda``.

The layer has the object's file as sublayer, so commands take it wherever they take the file. The
root prim has what was identified, ``vd:contact:<parameter>``, with ``vd:contact:<parameter>:ci95``
(low ends, high ends; SI units) for the 95 % interval, and mass and centre of mass in USD's own
attributes besides.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq

from vd.paper import PAPER

NAMESPACE = "vd:contact"
LAYER_FORMAT = "vd-contact-layer/1"
"""What ``customLayerData`` of a layer says it is."""
LEAST_RESTITUTION = 0.135
"""Of the simulator's contacts, which are critically damped springs: exp(-2)."""


class ContactParameter(NamedTuple):
    """What a motion tells of an object's contact.

    Attributes:
        meaning: In words.
        unit: SI unit.
        nominal: Where the object's file has nothing; as many numbers as the parameter has.
        resolution: Difference that matters to a policy (ours), in the unit or as a share of
            nominal.
        record: What tells it.
        relative: Whether the resolution is a share.
    """

    meaning: str
    unit: str
    nominal: tuple[float, ...]
    resolution: float
    record: str
    relative: bool = False


_MATERIALS = PAPER.materials
CONTACT: dict[str, ContactParameter] = {
    "table_friction": ContactParameter(
        "coefficient of friction between this object and the table",
        "1",
        (0.5 * (_MATERIALS.friction + _MATERIALS.table_friction),),
        0.05,
        "record slides of 1 m/s or more on one of its faces, in several directions",
    ),
    "restitution": ContactParameter(
        "share of its speed with which the object leaves the table",
        "1",
        (LEAST_RESTITUTION,),
        0.08,
        "record drops from 0.15 m or more onto one of its faces",
    ),
    "mass": ContactParameter(
        "mass",
        "kg",
        (_MATERIALS.object_mass_kg,),
        0.1,
        "record slides, and pushes with the force of the pusher: free motion does not depend on "
        "the mass",
        relative=True,
    ),
    "centre_of_mass": ContactParameter(
        "centre of mass in the frame of the object's file",
        "m",
        (0.0, 0.0, 0.0),
        0.003,
        "record tosses in which the object turns by a radian or more, about several axes",
    ),
    "tip_compliance": ContactParameter(
        "way that the fingertip gives under a force",
        "m/N",
        (0.0,),
        2.0e-4,
        "record presses of a finger whose force is measured on the object, up to some N",
    ),
}
"""Parameters by name; names are a contract: USD attributes and keys of reports."""


def contact_of(item: Any, name: str) -> np.ndarray:
    """A parameter as an object has it, identified or nominal.

    Args:
        item: :class:`vd.assets_usd.objects.model.ObjectModel`.
        name: Key of :data:`CONTACT`.
    """
    usd_values = {"mass": (item.mass_kg,), "centre_of_mass": item.centre_of_mass}
    value, *_ = item.contact.get(name, (CONTACT[name].nominal,))
    return np.array(usd_values.get(name, value), dtype=float)


Identified = Mapping[str, tuple[tuple[float, ...], ...]]
"""By parameter three tuples of as many numbers as it has: value, low and high end of the 95 %
interval.
"""


def author_contact(prim: Any, identified: Identified) -> None:
    """Author what was identified on an object's root prim, USD's own attributes apart."""
    from pxr import Sdf

    from vd.assets_usd.hand_layer import author

    kind = Sdf.ValueTypeNames.DoubleArray
    for name, (value, low, high) in identified.items():
        author(prim, f"{NAMESPACE}:{name}", kind, list(value))
        author(prim, f"{NAMESPACE}:{name}:ci95", kind, [*low, *high])


def read_contact(prim: Any, where: str) -> dict[str, tuple[tuple[float, ...], ...]]:
    """What was identified of an object; the type is :data:`Identified`.

    Args:
        prim: The object's root prim.
        where: The file to name in errors.

    Raises:
        ValueError: An attribute is no parameter, or not as many ordered, finite numbers as it
            should be.
    """
    identified = {}
    for attribute in prim.GetAuthoredPropertiesInNamespace(NAMESPACE):
        full = attribute.GetName()
        name = full.removeprefix(f"{NAMESPACE}:").removesuffix(":ci95")
        if name not in CONTACT:
            raise ValueError(
                f"{where}: {full!r} is no parameter of contact; choose from {', '.join(CONTACT)}"
            )
        size = len(CONTACT[name].nominal)
        parts = [prim.GetAttribute(f"{NAMESPACE}:{name}{end}").Get() for end in ("", ":ci95")]
        numbers = np.concatenate(
            [np.atleast_1d([] if part is None else part) for part in parts]
        ).astype(float)
        value, low, high = (numbers[i * size : (i + 1) * size] for i in range(3))
        if len(numbers) != 3 * size or not (
            np.isfinite(numbers).all() and np.all((low <= value) & (value <= high))
        ):
            raise ValueError(
                f"{where}: {full!r}: give {size} numbers, and for its ci95 {size} low and {size} "
                f"high"
            )
        identified[name] = tuple(tuple(part.tolist()) for part in (value, low, high))
    return identified


def damping_ratio(restitution: float) -> float:
    """Of a spring and a damper that push but never pull, whose impacts have this restitution.

    Critically damped it is exp(-2), the least there is here.
    """

    def kept(ratio: float) -> float:
        root = math.sqrt(1.0 - ratio**2)
        return (
            math.exp(-ratio / root * math.atan2(2.0 * ratio * root, 2.0 * ratio**2 - 1.0))
            - restitution
        )

    low = 1e-6
    high = 1.0 - 1e-6
    return float(brentq(kept, low, high)) if kept(low) > 0.0 > kept(high) else high
