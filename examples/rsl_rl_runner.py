"""Learn with rsl-rl's own runner.

Vd-train teacher has a loop of its own, with curriculum and checkpoints.
"""

from rsl_rl.runners import OnPolicyRunner

import vd
from vd.train.vec_env import ReorientVecEnv

env = ReorientVecEnv(vd.ReorientEnv(vd.ReorientCfg(hand="dclaw3", num_envs=16), "cpu"))
network = {
    "class_name": "MLPModel",
    "hidden_dims": [64, 64],
    "activation": "elu",
    "obs_normalization": True,
}
settings = {
    "num_steps_per_env": 8,
    "save_interval": 50,
    "obs_groups": {
        "actor": ["policy"],
        "critic": ["policy"],
    },  # and "privileged", where the critic is told more
    "algorithm": {"class_name": "PPO", "num_learning_epochs": 2},
    "actor": network
    | {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.5}},
    "critic": network,
}
runner = OnPolicyRunner(env, settings, device=env.device)  # with a folder it logs and saves
runner.learn(2)
print(
    "actions of", env.num_envs, "environments:", tuple(runner.alg.act(env.get_observations()).shape)
)
