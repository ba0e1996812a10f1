"""Terms of one's own: a reward for a quiet hand, and the object's height to observe."""

import dataclasses

import torch
import warp as wp

import vd


def quiet(env: vd.ReorientEnv) -> torch.Tensor:
    """Squared speeds of the joints, summed [rad^2/s^2], shape [N]."""
    return wp.to_torch(env.measured_qd)[:, : env.num_joints].square().sum(dim=1)


def height(env: vd.ReorientEnv) -> torch.Tensor:
    """Height of the object over the table [m], shape [N]."""
    return wp.to_torch(env.sim.joint_q)[:, env.num_joints + 2]


if __name__ == "__main__":
    cfg = vd.ReorientCfg(hand="dclaw3", num_envs=4)
    reward = dataclasses.replace(cfg.reward, terms={"own_terms:quiet": -0.1})
    seen = dataclasses.replace(cfg.observation, terms={"own_terms:height": 1})
    env = vd.ReorientEnv(dataclasses.replace(cfg, reward=reward, observation=seen), "cpu")
    for _ in range(3):
        env.step(env.action)
    print(env.reward_term_names[-1], env.reward_terms.numpy()[:, -1])
    print("heights [m]", env.observation.numpy()[:, -1])
