"""Find an object in depth images, and follow it while it falls."""

import numpy as np

import vd
from vd.sensors.depth_camera import DepthCamera  # stands for the driver of a real camera

env = vd.ReorientEnv(vd.ReorientCfg(hand="dclaw3", objects=("cuboid",), num_envs=1), "cpu")
camera = DepthCamera.of_scene(env.scene, env.sim.body_q)
tracker = vd.ObjectTracker(vd.load_hand("dclaw3"), vd.load_objects("cuboid")[0])

for step in range(6):
    camera.capture()
    depth = camera.depth.numpy()[0]  # [m], 0 for none, shape [H, W]
    joints = env.measured_q.numpy()[0, : env.num_joints]
    pose = tracker.look(depth, joints, fresh=step == 0)
    away = np.linalg.norm(pose[:3] - env.object_pose()[0, :3])
    print(f"at {np.round(pose[:3], 3)} m, {1000 * away:.1f} mm from where it is")
    env.step(env.action)
