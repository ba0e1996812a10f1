"""Training on the simulator itself: a run goes on bit for bit."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from vd.envs.cfg import CurriculumCfg, LevelCfg, ReorientCfg
from vd.policy.bundle import read_policy
from vd.sim.cfg import SimCfg, coarser
from vd.train.checkpoint import checkpoint_path
from vd.train.metrics import PROGRESS_FILE, read_progress
from vd.train.presets import cpu_demo, smoke
from vd.train.runner import TeacherRunner
from vd.train.teacher import build_teacher

TIMING = ("elapsed_s", "steps_per_s", "collect_s", "learn_s")


def _train(run_dir: Path, iterations: int, observation=None, **begin) -> TeacherRunner:
    """A few iterations of a few environments on the CPU, with randomisation and curriculum on."""
    cfg = smoke(cpu_demo())
    task = replace(
        cfg.env,
        num_envs=8,
        observation=observation or cfg.env.observation,
        start=replace(cfg.env.start, poses=2),
        randomisation=replace(cfg.env.randomisation, enabled=True),
        curriculum=CurriculumCfg(goals=LevelCfg(rate=0.005, raise_at=0.0, lower_at=0.0)),
    )
    run = replace(cfg.run, out=run_dir, max_minutes=None, coarse_physics=True)
    ppo = replace(cfg.ppo, rollout_steps=4, minibatch_size=16)
    runner = build_teacher(replace(cfg, run=run, ppo=ppo, env=task, **begin))
    if iterations:
        runner.learn(iterations)
    return runner


@pytest.mark.slow
def test_a_run_goes_on_bit_for_bit_and_another_tells_its_critic_more_from_there(tmp_path):
    """It learns in coarser physics; what it learned is judged in the default."""
    whole = _train(tmp_path / "whole", 4)
    assert whole.env.env.cfg.sim == coarser(SimCfg()) != SimCfg()
    assert ReorientCfg.of(read_policy(tmp_path / "whole" / "policy.safetensors")).sim == SimCfg()
    resumed = _train(tmp_path / "part", 2, resume=str(checkpoint_path(tmp_path / "whole", 2)))
    for one, two in ((whole.alg.actor, resumed.alg.actor), (whole.alg.critic, resumed.alg.critic)):
        weights, again = one.state_dict(), two.state_dict()
        assert all(torch.equal(weights[name], again[name]) for name in weights)
    rows = [
        [
            {k: v for k, v in row.items() if k not in TIMING}
            for row in read_progress(tmp_path / name / PROGRESS_FILE)
        ]
        for name in ("whole", "part")
    ]
    assert rows[0][2:] == rows[1]
    assert rows[1][-1]["level/goals"] > 0.0

    blind = read_policy(checkpoint_path(tmp_path / "part", 4))
    told = replace(smoke(cpu_demo()).env.observation, dynamics="critic")
    telling = _train(
        tmp_path / "telling", 0, init=str(checkpoint_path(tmp_path / "part", 4)), observation=told
    )
    assert telling.env.env.privileged.shape[1] > 0 and telling.critic_warmup > 0
    observation = telling.env.get_observations()
    with torch.no_grad():
        acted = telling.alg.actor(observation)
    assert torch.allclose(acted, blind.act(observation["policy"]), atol=1e-5)
    telling.learn(1)
    policy = read_policy(tmp_path / "telling" / "policy.safetensors")
    assert policy.task["observation"]["dynamics"] == "critic"
    assert policy.contract.interface["hand"]["name"] == "dclaw3"
    assert torch.isfinite(policy.act(telling.env.get_observations()["policy"])).all()
