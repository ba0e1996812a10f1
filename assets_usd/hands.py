"""Hands by name, as the rest of the project asks for them."""

from pathlib import Path

from vd.assets_usd.hand_author import hand_usd
from vd.assets_usd.hand_model import HandModel, read_hand

USD_SUFFIXES = (".usd", ".usda", ".usdc")


def load_hand(name: str, fingertip: str = "rigid", layer: str | Path | None = None) -> HandModel:
    """Read a hand by name (authored on demand) or by the path of its USD.

    Args:
        name: ``dclaw3``, ``dclaw4``, or a file.
        fingertip: Variant of the fingertips, ``rigid`` or ``soft``.
        layer: Layer over the hand with an identified servo model (``identified.usda``).

    Raises:
        HandError: The file is not a hand, or the layer not one of it.
    """
    path = Path(name) if name.endswith(USD_SUFFIXES) else hand_usd(name)
    return read_hand(path, fingertip=fingertip, layer=None if layer is None else Path(layer))
