"""Training on the simulator itself: a run goes on bit for bit, and the command line ends cleanly."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from vd.evaluate.agents import trained_task
from vd.policy import load_policy
from vd.sim.cfg import SimCfg, coarser
from vd.train.checkpoint import checkpoint_path
from vd.train.cli import build_teacher, main
from vd.train.metrics import PROGRESS_FILE, read_progress
from vd.train.presets import smoke
from vd.train.runner import TeacherRunner

TIMING = ("elapsed_s", "steps_per_s", "collect_s", "learn_s")


def _train(run_dir: Path, iterations: int, resume: str | None = None) -> TeacherRunner:
    """A few iterations of a few environments on the CPU, with randomisation and curriculum on."""
    cfg = smoke()
    task = replace(
        cfg.env,
        num_envs=8,
        start=replace(cfg.env.start, poses=2),
        randomisation=replace(cfg.env.randomisation, enabled=True),
        curriculum=replace(cfg.env.curriculum, enabled=True, raise_at=0.0, lower_at=0.0),
    )
    cfg = replace(
        cfg,
        resume=resume,
        run=replace(cfg.run, out=run_dir, max_minutes=None),
        ppo=replace(cfg.ppo, rollout_steps=4, minibatch_size=16),
        env=task,
    )
    runner = build_teacher(cfg)
    runner.learn(iterations)
    return runner


@pytest.mark.slow
def test_a_resumed_run_equals_one_that_never_stopped(tmp_path):
    whole = _train(tmp_path / "whole", 4)
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
    assert rows[1][-1]["task/difficulty"] > 0.0


def test_what_is_learned_in_coarser_physics_is_judged_in_the_default(tmp_path):
    cfg = smoke()
    cfg = replace(
        cfg,
        run=replace(cfg.run, out=tmp_path, max_minutes=None, coarse_physics=True),
        ppo=replace(cfg.ppo, rollout_steps=4, minibatch_size=16),
        env=replace(cfg.env, num_envs=4),
    )
    runner = build_teacher(cfg)
    assert runner.env.env.cfg.sim == coarser(SimCfg()) != SimCfg()
    runner.learn(1)
    assert trained_task(load_policy(tmp_path / "policy.pt")).sim == SimCfg()


@pytest.mark.slow
def test_a_blind_run_goes_on_with_shape_and_memory_and_its_policy_is_evaluated(tmp_path):
    import numpy as np
    import warp as wp

    from vd.evaluate.cli import main as evaluate

    flags = ["teacher", "--smoke", "--num-envs", "4", "--max-steps", "32", "--out"]
    assert main([*flags, str(tmp_path / "blind"), "--save-every", "1"]) == 0
    checkpoint = checkpoint_path(tmp_path / "blind", 1)
    cfg = smoke()
    observation = replace(cfg.env.observation, shape="full", history=2, dynamics="critic")
    cfg = replace(
        cfg,
        init=checkpoint,
        run=replace(cfg.run, out=tmp_path / "seeing"),
        env=replace(cfg.env, num_envs=4, observation=observation),
    )
    runner = build_teacher(cfg)
    before, simulation = load_policy(checkpoint).num_observations, runner.env.env
    told = simulation.privileged.shape[1]
    assert runner.new_inputs == simulation.num_observations + told - before > told > 0
    observation = runner.env.get_observations()
    blind = load_policy(checkpoint).act(observation["policy"][:, :before])
    with torch.no_grad():
        assert torch.allclose(runner.alg.actor(observation), blind, atol=1e-5)
    runner.learn(1)
    policy = load_policy(tmp_path / "seeing" / "policy.pt")
    assert policy.task["observation"]["shape"] == "full" and policy.task["observation"]["history"] == 2
    assert np.isfinite(policy.act(wp.to_torch(runner.env.env.observation)).numpy()).all()
    arguments = ["--episodes", "1", "--num-envs", "1", "--episode-s", "0.5", "--device", "cpu"]
    arguments += ["--condition", "mixed", "--out"]
    assert evaluate([str(tmp_path / "seeing"), *arguments, str(tmp_path / "eval")]) == 0


@pytest.mark.slow
def test_the_command_trains_saves_on_sigterm_and_resumes(tmp_path):
    command = [sys.executable, "-m", "vd.train.cli", "teacher", "--out", str(tmp_path)]
    run = subprocess.Popen(
        [*command, "--smoke", "--num-envs", "4", "--max-steps", "100000", "--max-minutes", "5"],
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )
    progress = tmp_path / PROGRESS_FILE
    deadline = time.monotonic() + 240
    while not (progress.is_file() and progress.read_text().count("\n") >= 2) and time.monotonic() < deadline:
        assert run.poll() is None, "training ended by itself"
        time.sleep(0.2)
    run.send_signal(signal.SIGTERM)
    assert run.wait(timeout=300) == 143
    done = read_progress(progress)[-1]["iteration"]
    config = json.loads((tmp_path / "config.json").read_text())
    assert config["env"]["num_envs"] == 4

    steps = (done + 1) * 4 * config["ppo"]["rollout_steps"]
    assert main(["teacher", "--out", str(tmp_path), "--resume", "--max-steps", str(steps)]) == 0
    assert [row["iteration"] for row in read_progress(progress)] == list(range(1, done + 2))
    assert load_policy(tmp_path / "policy.pt").hand == "dclaw3"
