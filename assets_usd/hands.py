"""Hands by name, as the rest of the project asks for them.

Of this package, imported, or USD files.
"""

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from vd.assets_usd.cache import assets_dir

if TYPE_CHECKING:
    from vd.assets_usd.hand_model import HandModel

HANDS = ("dclaw3", "dclaw4")
"""Hands of the package; their numbers and sources are in ``assets_usd/usd``."""

USD_SUFFIXES = (".usd", ".usda", ".usdc")


def imported_folder(name: str) -> Path:
    """Where a hand of this name is imported to, unless another folder is named."""
    return assets_dir() / "hands" / name


def check_hand_name(name: str) -> None:
    """Refuse a hand that :func:`load_hand` would not find, without reading it.

    Raises:
        ValueError: No hand has this name, or there is no such file.
    """
    if not (name.endswith(USD_SUFFIXES) and Path(name).is_file()):
        hand_usd(name)


def hand_usd(name: str) -> Path:
    """The USD file of a hand of the package, or of one that was imported.

    Raises:
        ValueError: No hand has this name.
    """
    if name in HANDS:
        return Path(__file__).parent / "usd" / f"{name}.usda"
    imported = imported_folder(name) / f"{name}.usda"
    if name.isidentifier() and imported.is_file():
        return imported
    from vd.assets_usd.hand_import.description import BUILT_IN

    how = f" URDF --describe {name}" if name in BUILT_IN else ""
    there = {*HANDS, *(file.parent.name for file in imported_folder("").glob("*/*.usda"))}
    raise ValueError(
        f"no hand is called {name!r}: choose one of {', '.join(sorted(there))}, give a hand's USD "
        f"file, or import one (vd-assets hand import{how})"
    )


def called(hand: "HandModel") -> str:
    """What :func:`load_hand` finds a hand by.

    Its name, or its file if no hand of that name is this one.
    """
    with suppress(ValueError):
        if hand_usd(hand.name).samefile(hand.path):
            return hand.name
    return str(hand.path.resolve())


def root_name(hand: str) -> str:
    """What a hand is called in its USD, given by name or file.

    A file that is not here, as that is called.
    """
    return load_hand(hand).name if Path(hand).is_file() else Path(hand).stem


def load_hand(name: str, fingertip: str = "rigid", layer: str | Path | None = None) -> "HandModel":
    """Read a hand by name or by the path of its USD.

    Args:
        name: ``dclaw3``, ``dclaw4``, an imported hand, or a file.
        fingertip: Variant of the fingertips, ``rigid`` or ``soft``.
        layer: Layer over the hand with an identified servo model (``identified.usda``).

    Raises:
        HandError: The file is not a hand, or the layer not one of it.
        ValueError: No hand has this name.
    """
    from vd.assets_usd.hand_model import read_hand

    path = Path(name) if name.endswith(USD_SUFFIXES) else hand_usd(name)
    return read_hand(path, fingertip=fingertip, layer=None if layer is None else Path(layer))
