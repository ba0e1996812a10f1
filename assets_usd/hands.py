"""Hands by name, as the rest of the project asks for them: USD files of this package, or of anyone."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vd.assets_usd.hand_model import HandModel

HANDS = ("dclaw3", "dclaw4")
"""Hands of the package; their numbers and sources are in ``assets_usd/usd``."""

USD_SUFFIXES = (".usd", ".usda", ".usdc")


def check_hand_name(name: str) -> None:
    """Refuse a hand that :func:`load_hand` would not find, without reading it.

    Raises:
        ValueError: No hand has this name, or there is no such file.
    """
    if name in HANDS or (name.endswith(USD_SUFFIXES) and Path(name).is_file()):
        return
    raise ValueError(
        f"no hand is called {name!r}: choose one of {', '.join(HANDS)}, or give a hand's USD file"
    )


def hand_usd(name: str) -> Path:
    """The USD file of a hand of the package.

    Raises:
        ValueError: No hand has this name.
    """
    if name not in HANDS:
        raise ValueError(f"no hand is called {name!r}: choose one of {', '.join(HANDS)}")
    return Path(__file__).parent / "usd" / f"{name}.usda"


def load_hand(name: str, fingertip: str = "rigid", layer: str | Path | None = None) -> "HandModel":
    """Read a hand by name or by the path of its USD.

    Args:
        name: ``dclaw3``, ``dclaw4``, or a file.
        fingertip: Variant of the fingertips, ``rigid`` or ``soft``.
        layer: Layer over the hand with an identified servo model (``identified.usda``).

    Raises:
        HandError: The file is not a hand, or the layer not one of it.
        ValueError: No hand has this name.
    """
    from vd.assets_usd.hand_model import read_hand

    path = Path(name) if name.endswith(USD_SUFFIXES) else hand_usd(name)
    return read_hand(path, fingertip=fingertip, layer=None if layer is None else Path(layer))
