"""The environment as Gymnasium's: torch tensors, episodes that reset themselves."""

import gymnasium

env = gymnasium.make_vec(
    "vd.gym:VisualDexterity-v0", num_envs=4, hand="dclaw3", device="cpu", episode_s=1.0
)
observation, _ = env.reset(seed=0)
for _ in range(15):
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    ended = terminated | truncated
    if ended.any():
        print("ended:", ended.tolist(), "last seen:", info["final_obs"][ended, :3].tolist())
env.close()
