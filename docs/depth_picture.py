"""Draw docs/depth.png: ``python docs/depth_picture.py``. A held object as the depth camera sees it."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.files import atomic_path
from vd.render import Camera, Renderer
from vd.sensors.cfg import DepthCameraCfg, DepthSensorCfg
from vd.sensors.depth_camera import DepthCamera
from vd.sim.scene import hand_mount

OBJECTS = ("procedural-6-seed0",)
SHOWN = 0
# Half a second to fall onto the table, then the middle joints of all fingers bend inward (-q2 is inward).
SETTLE_STEPS, CLOSE_STEPS, INWARD = 8, 9, (0.0, -0.3, 0.12)
START = (0.0, 0.0, 0.38, 0.92)
DEPTH_RANGE_M = (0.4, 0.9)
CLOUD_HALF_M = 0.11
MISSING = "#d8d8d8"


def main() -> None:
    """Simulate, take the image with a perfect and with a real sensor, write the PNG beside this file."""
    cfg = ReorientCfg(objects=OBJECTS, num_worlds=6, randomisation=RandomisationCfg(enabled=False))
    env = ReorientEnv(cfg, "cpu")
    env.reset(object_quat=np.tile(np.array(START) / np.linalg.norm(START), (cfg.num_worlds, 1)))
    inward = np.tile(INWARD, env.num_fingers)
    for step in range(SETTLE_STEPS + CLOSE_STEPS):
        action = inward if step >= SETTLE_STEPS else 0.0 * inward
        env.step(wp.array(np.tile(action, (cfg.num_worlds, 1)), dtype=wp.float32, device="cpu"))
    camera = DepthCamera.of_scene(
        env.scene, env.sim.body_q, DepthCameraCfg(sensor=DepthSensorCfg.realistic())
    )
    camera.capture()
    true, measured = (image.numpy()[SHOWN] for image in (camera.true_depth, camera.depth))
    cloud = camera.points.numpy()[SHOWN, : camera.count.numpy()[SHOWN]]
    mount = hand_mount()
    cloud = Rotation.from_quat(mount.q).apply(cloud) + np.array(mount.p)

    pose = camera.camera_q.numpy()[SHOWN]
    ahead = Rotation.from_quat(pose[3:]).apply([0.0, 0.0, 1.0])
    model = env.hand.camera
    eye, target = pose[:3], pose[:3] + ahead
    viewer = Camera(
        eye=(float(eye[0]), float(eye[1]), float(eye[2])),
        target=(float(target[0]), float(target[1]), float(target[2])),
        fov=2.0 * float(np.arctan(0.5 * model.height / model.fy)),
    )
    item = env.objects[env.world_object[SHOWN]]
    renderer = Renderer(
        env.hand, [item], width=2 * model.width, height=2 * model.height, camera=viewer, samples=4
    )
    goal = np.array([[0.0, 0.0, 0.0, 1.0]])
    picture = renderer.render(env.sim.joint_q.numpy()[[SHOWN]], goal)[0].scene

    figure, axes = plt.subplots(2, 2, figsize=(9.0, 5.4), layout="constrained")
    axes[0, 0].imshow(picture)
    axes[0, 0].set_title("the camera's view")
    colors = plt.get_cmap("viridis_r").with_extremes(bad=MISSING)
    for axis, depth, title in (
        (axes[0, 1], true, "depth"),
        (axes[1, 0], measured, "depth as a D415 measures it"),
    ):
        shown = axis.imshow(
            np.ma.masked_equal(depth, 0.0), cmap=colors, vmin=DEPTH_RANGE_M[0], vmax=DEPTH_RANGE_M[1]
        )
        axis.set_title(title)
    figure.colorbar(shown, ax=axes, label="depth, m", shrink=0.6)
    for axis in (axes[0, 0], axes[0, 1], axes[1, 0]):
        axis.set_axis_off()
    # Seen from the side: the camera is on the left, at x = -0.57 m.
    axes[1, 1].scatter(cloud[:, 0], cloud[:, 2], s=1.5, c=cloud[:, 1], cmap="coolwarm", linewidths=0)
    axes[1, 1].set(
        title=f"its cloud of {len(cloud)} points, from the side",
        xlabel="x, m",
        ylabel="z, m",
        xlim=(-1.6 * CLOUD_HALF_M, 1.6 * CLOUD_HALF_M),
        ylim=(0.0, 2.0 * CLOUD_HALF_M),
        aspect="equal",
    )
    with atomic_path(Path(__file__).with_name("depth.png")) as temporary:
        figure.savefig(temporary, dpi=90)


if __name__ == "__main__":
    main()
