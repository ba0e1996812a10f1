"""Open the depth camera of a hand, or that of its twin."""

from vd.assets_usd.hand_data import CameraModel
from vd.deploy.camera.camera import CameraError, DepthSource
from vd.deploy.camera.realsense import RealSense, RealSenseCfg, describe, find_device
from vd.deploy.twin.twin_link import SdkTwinCamera, TwinCamera, TwinLink


def open_camera(
    place: CameraModel, link: TwinLink | None, cfg: RealSenseCfg, *, sdk: bool | None = False
) -> tuple[DepthSource, str]:
    """The depth camera and what it is, in words.

    Args:
        place: The camera that a twin was told to have.
        link: A twin; None for a real camera.
        cfg: Settings of the real one.
        sdk: Take a twin's images through the camera's SDK; None: where it is installed.

    Raises:
        CameraError: There is none, or it has no such images.
    """
    if link is None:
        device = find_device(cfg.serial)
        return RealSense(device, cfg), describe(device)
    camera = TwinCamera(link, place)
    if sdk is not False:
        try:
            return SdkTwinCamera(camera), "the twin's, through the SDK's software device"
        except CameraError:
            if sdk:
                raise
    return camera, "the twin's own: the camera's SDK is not " + ("installed" if sdk is None else "asked for")
