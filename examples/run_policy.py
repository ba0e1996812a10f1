"""Let an installed policy turn an object in the task it was trained in."""

import warp as wp

import vd

policy = vd.load_policy("dclaw4", device="cpu")
env = vd.ReorientEnv(vd.ReorientCfg.of(policy, objects=("cube",), num_envs=4), "cpu")
actor = vd.load_policy("dclaw4", env)  # zero, random and policies by camera act so too

reached = 0
for _ in range(36):  # three seconds
    action = actor.act(wp.to_torch(env.observation))
    env.step(wp.from_torch(action.contiguous()))
    reached += int(env.success.numpy().sum())
print(f"{reached} goals reached")
env.close()
