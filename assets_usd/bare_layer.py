"""Identified servo models of bare joints, which have no articulation: a layer of its own, read back.

The same attributes as over a hand (:mod:`vd.assets_usd.hand_layer`) on prims ``/servo/<joint>`` or
``/pendulum/<joint>``, so that one file format serves a motor on a bench and a hand.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pxr import Tf, Usd

from vd.assets_usd.hand_data import HandError
from vd.assets_usd.hand_layer import DRIVE, LAYER_FORMAT, NAMESPACE, read_servo


def read_bare_layer(path: Path, joints: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """The servo models of joints without an articulation.

    Args:
        path: Layer that :func:`vd.assets_usd.hand_layer.write_layer` wrote for a bare servo.
        joints: Names of the joints, J.

    Returns:
        Rows of parameters [J, P] and their 95 % intervals [J, P, 2], NaN where none is authored.

    Raises:
        HandError: The file is missing, no such layer, or lacks a joint or its drive; names it.
    """
    path = Path(path)
    if not path.is_file():
        raise HandError(f"{path}: no such layer; vd-gap writes one as identified.usda")
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise HandError(f"{path}: not a USD layer ({error}); let vd-gap write it again") from error
    stage.Reload()
    layer = stage.GetRootLayer()
    if layer.customLayerData.get("format") != LAYER_FORMAT:
        raise HandError(f"{path}: not an identified servo model ({LAYER_FORMAT}); let vd-gap write it again")
    prims = [stage.GetPrimAtPath(f"/{layer.defaultPrim}/{name}") for name in joints]
    for name, prim in zip(joints, prims, strict=True):
        if not prim:
            raise HandError(f"{path}: there is no joint /{layer.defaultPrim}/{name}; identify it first")
    baseline = {
        name: np.array([_number(path, prim, attribute) / factor for prim in prims])
        for name, (attribute, factor) in DRIVE.items()
        if not attribute.startswith(f"{NAMESPACE}:")
    }
    return read_servo(prims, baseline, path)


def _number(path: Path, prim: Usd.Prim, attribute: str) -> float:
    found = prim.GetAttribute(attribute)
    if not found or not found.HasAuthoredValue():
        raise HandError(f"{path}: {prim.GetPath()}: '{attribute}' is not authored; give it a value")
    return float(found.Get())
