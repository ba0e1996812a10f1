"""A RealSense through the SDK.

Its software device stands for the camera, everything else is what meets one.

Oracle: an inclined plane, whose depth is known in every pixel.
"""

import dataclasses
import time

import numpy as np
import pytest
from camera_sdk import SoftwareCamera, rs

from vd.assets_usd.hand_data import Intrinsics
from vd.deploy.camera.camera import CameraError, StaleCamera
from vd.deploy.camera.realsense import RealSense, RealSenseCfg, find_device

LENS = Intrinsics(640, 360, 455.0, 456.0, 323.5, 177.0)
NORMAL, DISTANCE = np.array([0.3, -0.2, 1.0]), 0.7
"""An inclined plane: NORMAL . p = DISTANCE in the optical frame [m]."""
PATIENCE_S = 10.0
WHOLE = RealSenseCfg(decimation=1)


@pytest.fixture
def stand_in():
    return SoftwareCamera(LENS)


def rays(lens):
    """Directions of pixel centres with z = 1, [H, W, 3]."""
    x = (np.arange(lens.width) + 0.5 - lens.cx) / lens.fx
    y = (np.arange(lens.height) + 0.5 - lens.cy) / lens.fy
    return np.stack([*np.meshgrid(x, y), np.ones((lens.height, lens.width))], axis=2)


def plane(lens=LENS):
    return DISTANCE / (rays(lens) @ NORMAL)


@pytest.mark.parametrize("side", [1, 2, 3, 8])
def test_points_of_a_plane_lie_on_it_whatever_the_decimation(stand_in, side):
    """The SDK pads 360 / 8 rows to 48; the padding is cut off."""
    camera = RealSense(stand_in.device, RealSenseCfg(decimation=side))
    stand_in.show(plane())
    depth, lens = camera.read(PATIENCE_S).image, camera.intrinsics
    camera.close()
    assert depth.shape == (lens.height, lens.width) == (360 // side, 640 // side)
    assert depth.dtype == np.float32 and (depth > 0).all()
    off = ((rays(lens) * depth[..., None]) @ NORMAL - DISTANCE) / np.linalg.norm(NORMAL)
    if side < 4:  # the mean of more pixels is cut off to whole millimetres
        assert abs(off.mean()) < 1e-4  # half a pixel off is 2e-4 and more
    assert np.abs(off).max() < 1.5e-3  # steps of 1 mm, and the mean of a block on an inclined plane


def test_the_newest_image_comes_once_with_its_time(stand_in):
    camera = RealSense(stand_in.device, WHOLE)
    for depth in (0.5, 0.6, 0.7):
        exposed = time.monotonic() - 0.05
        stand_in.show(np.full((360, 640), depth), exposed)
    deadline = time.monotonic() + PATIENCE_S
    frame = camera.read(PATIENCE_S)
    # The SDK's thread may lag.
    while abs(frame.image[0, 0] - 0.7) > 1e-3 and time.monotonic() < deadline:
        frame = camera.read(PATIENCE_S)
    assert frame.image[0, 0] == pytest.approx(0.7, abs=1e-3)
    assert frame.time_s == pytest.approx(exposed, abs=5e-3)
    with pytest.raises(StaleCamera, match="no image"):
        camera.read(0.05)
    stand_in.show(plane(), own_clock=True)
    with pytest.raises(CameraError, match="global_time_enabled"):
        camera.read(PATIENCE_S)
    camera.close()


def test_infrared_comes_undecimated_also_without_a_projector(stand_in):
    """As of a D405."""
    camera = RealSense(stand_in.device, infrared=True)
    image = np.random.default_rng(0).integers(0, 255, (360, 640), dtype=np.uint8)
    stand_in.show(image)
    np.testing.assert_array_equal(camera.read(PATIENCE_S).image, image)
    assert dataclasses.astuple(camera.intrinsics) == pytest.approx(dataclasses.astuple(LENS))
    camera.close()


def test_refusals_name_the_remedy(stand_in):
    with pytest.raises(CameraError, match="640 x 360 at 30 Hz"):
        RealSense(stand_in.device, RealSenseCfg(width=848, height=480))
    with pytest.raises(ValueError, match="decimation"):
        RealSense(stand_in.device, RealSenseCfg(decimation=9))
    if not len(rs.context().query_devices()):
        with pytest.raises(CameraError, match="no RealSense"):
            find_device()
