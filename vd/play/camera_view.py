"""What a policy's depth camera sees, with the object drawn in where it is believed to be."""

from typing import Any

import numpy as np
import warp as wp
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

SURFACE_COLOR = (60, 230, 120)
"""Colour of the believed surface."""


def camera_view(actor: Any, world: int) -> np.ndarray:
    """The depth image about the hand, near is bright.

    Surface points are drawn in where the object is believed to be.

    Args:
        actor: A :class:`vd.evaluate.camera_actor.CameraActor` that has acted.
        world: Environment.

    Returns:
        RGB bytes [H, W, 3], of the half of the image about the hand.
    """
    camera = actor.camera
    depth = wp.to_torch(camera.depth)[world].cpu().numpy()
    model = camera.camera
    shade = np.where(depth > 0.0, 235.0 - 180.0 * _share(depth), 20.0)
    picture = Image.fromarray(np.repeat(shade.astype(np.uint8)[..., None], 3, axis=2))
    pose = actor.tracker.pose[world].cpu().numpy().astype(float)
    turn = Rotation.from_quat(pose[3:])
    draw = ImageDraw.Draw(picture)
    for u, v, ahead in model.project(pose[:3] + turn.apply(actor.surface(world))):
        if ahead > 0.0:
            draw.ellipse((u - 1, v - 1, u + 1, v + 1), fill=SURFACE_COLOR)
    middle = model.project(actor.hand.tip_poses(actor.hand.start)[:, :3].mean(axis=0))[:2]
    half = np.array(picture.size) // 2
    corner = np.clip(middle - half / 2, 0, half).astype(int)
    box = (*corner, *(corner + half))
    return np.asarray(picture.resize(picture.size, box=box))


def _share(depth: np.ndarray) -> np.ndarray:
    """Depth [H, W] from the nearest 0 to the farthest 1 of what is measured."""
    measured = depth[depth > 0.0]
    if not len(measured):
        return depth
    near, far = np.percentile(measured, (1, 99))
    return np.clip((depth - near) / max(far - near, 1e-6), 0.0, 1.0)
