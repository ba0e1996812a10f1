"""Where a hand's depth camera was found to be, as a USD layer over the hand: ``camera.usda``.

The layer holds the place of ``/<hand>/base/camera`` and nothing else, in the ops that the hand's
own file has. Like the layer with an identified servo model it can be a sublayer of any stage in
which the hand is.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import CameraModel, HandError, HandModel
from vd.assets_usd.hand_layer import author, new_layer, open_layer, save_layer
from vd.assets_usd.hand_model import OPTICAL_FROM_USD
from vd.assets_usd.usd_prims import numpy_quaternion, usd_quaternion

CAMERA_LAYER_FORMAT = "vd-camera-layer/1"
"""What ``customLayerData`` of a layer says it is."""


def write_camera_layer(
    path: Path, hand: HandModel, pose: np.ndarray, notes: Mapping[str, str]
) -> None:
    """Write a camera's place as a layer over a hand, atomically.

    Args:
        path: File to write, ``.usda``.
        hand: The hand.
        pose: Optical frame (x right, y down, z forward) in the hand's base: position [m],
            quaternion xyzw.
        notes: How it was found, for people; goes into ``customLayerData``.

    Raises:
        HandError: The file is not to be a ``.usda``, or the pose is none.
    """
    pose = np.asarray(pose, dtype=float)
    if pose.shape != (7,) or not np.isfinite(pose).all():
        raise HandError(f"{path}: the camera's pose is {pose}; it must be 7 finite numbers")
    text = f"Place of the depth camera of {hand.name}, a layer over the hand."
    layer = new_layer(hand.name, text, {"format": CAMERA_LAYER_FORMAT, **notes})
    camera = Sdf.CreatePrimInLayer(layer, f"/{hand.name}/base/camera")
    turn = Rotation.from_quat(pose[3:]) * OPTICAL_FROM_USD.inv()
    author(camera, "xformOp:translate", Sdf.ValueTypeNames.Double3, Gf.Vec3d(*pose[:3]))
    author(camera, "xformOp:orient", Sdf.ValueTypeNames.Quatd, usd_quaternion(turn.as_quat()))
    save_layer(layer, path)


def read_camera(hand: HandModel, layer: Path) -> CameraModel:
    """The hand's camera where a layer says that it is.

    Args:
        hand: The hand, whatever layer it has already.
        layer: The camera's layer.

    Raises:
        HandError: The file is missing, no such layer, or not one of this hand, which has a camera.
    """
    pose = read_camera_pose(hand, layer)
    return replace(hand.camera, position=pose[:3], quaternion=pose[3:])


def read_camera_pose(hand: HandModel, layer: Path) -> np.ndarray:
    """Pose of a camera's optical frame in the base of any hand [7].

    Args:
        hand: The hand.
        layer: The camera's layer.

    Raises:
        HandError: The file is missing, no such layer, or not one of this hand.
    """
    opened = open_layer(layer) if Path(layer).is_file() else None
    if opened is None or opened.customLayerData.get("format") != CAMERA_LAYER_FORMAT:
        raise HandError(
            f"{layer}: no camera layer ({CAMERA_LAYER_FORMAT}); name the camera.usda that "
            "vd-deploy calibrate wrote"
        )
    camera = f"/{hand.name}/base/camera"
    if opened.GetPrimAtPath(camera) is None:
        raise HandError(f"{layer} is of {opened.defaultPrim}, not of {hand.name}")
    place = opened.GetAttributeAtPath(f"{camera}.xformOp:translate").default
    turn = opened.GetAttributeAtPath(f"{camera}.xformOp:orient").default
    optical = Rotation.from_quat(numpy_quaternion(turn)) * OPTICAL_FROM_USD
    return np.array([*place, *optical.as_quat()])
