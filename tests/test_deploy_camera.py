"""What every source of depth images promises."""

import dataclasses
import time

import numpy as np
import pytest

from vd.assets_usd.hand_data import Intrinsics
from vd.assets_usd.hands import load_hand
from vd.deploy.camera.camera import MAX_AGE_S, DepthFrame, StaleCamera, check_fresh


def test_a_device_gives_the_lens_and_the_hand_the_place():
    camera = load_hand("dclaw3").camera
    device = Intrinsics(width=640, height=360, fx=455.0, fy=456.0, cx=321.5, cy=178.5)
    seen = device.seen_from(camera)
    assert (seen.width, seen.height) == (640, 360)
    np.testing.assert_array_equal(seen.matrix, device.matrix)
    np.testing.assert_array_equal(seen.position, camera.position)
    np.testing.assert_array_equal(seen.quaternion, camera.quaternion)
    assert (seen.near, seen.far) == (camera.near, camera.far)
    # A point before the camera falls where the device's own lens puts it.
    ahead = dataclasses.replace(seen, position=np.zeros(3), quaternion=np.array([0.0, 0.0, 0.0, 1.0]))
    np.testing.assert_allclose(ahead.project([0.1, -0.05, 0.5]), [321.5 + 91.0, 178.5 - 45.6, 0.5], atol=1e-9)


def test_an_old_image_is_refused_and_a_new_one_returned():
    image = np.zeros((2, 2), dtype=np.float32)
    new = DepthFrame(image, time.monotonic())
    assert check_fresh(new) is new
    with pytest.raises(StaleCamera, match=r"1\.\d\d s old"):
        check_fresh(DepthFrame(image, time.monotonic() - MAX_AGE_S - 1.0))
