"""The RealSense SDK, for tests that need it."""

from types import ModuleType

import pytest

from vd.deploy.camera.camera import CameraError
from vd.deploy.camera.realsense import sdk


def camera_sdk() -> ModuleType:
    """The SDK's Python package; where it cannot be imported the test, or its whole file, is skipped."""
    try:
        return sdk()
    except CameraError as error:
        pytest.skip(str(error), allow_module_level=True)
