"""Build the environment and step it with random actions."""

import torch
import warp as wp

import vd

cfg = vd.ReorientCfg(hand="dclaw3", objects=("cube",), num_envs=4)
env = vd.ReorientEnv(cfg, "cpu")  # without a device: the first GPU, or else the CPU

for _ in range(12):  # one second
    action = 2.0 * torch.rand(env.num_envs, env.num_actions) - 1.0
    env.step(wp.from_torch(action))

print("observation", tuple(wp.to_torch(env.observation).shape))
print("reward", wp.to_torch(env.reward).tolist())
print("angle to the goal [rad]", wp.to_torch(env.rotation_error).tolist())
env.close()
