"""A run of several processes: the same parameters, own environments, and errors and hangs of one of them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from train_dummy import DummyEnv, make_runner

from vd.train.checkpoint import find_checkpoint
from vd.train.metrics import read_progress

BEGIN = """
import json, os, sys, time
from datetime import timedelta
from pathlib import Path
import torch
torch.set_num_threads(1)
sys.path.insert(0, {tests!r})
from train_dummy import DummyEnv, make_runner
from vd.train import distributed
from vd.train.checkpoint import find_checkpoint
rank, folder = int(os.environ["RANK"]), Path({folder!r})
"""
HANGING = (
    BEGIN
    + """
distributed.COLLECTIVE_TIMEOUT, distributed.REPORT_AFTER_S = timedelta(seconds=6), 1.5
runner = make_runner(folder, env=DummyEnv(num_envs=8, seed=rank), seed=rank, save_every=2)
runner.learn(2)
torch.manual_seed(100 + rank)
runner.load(str(find_checkpoint(folder, "latest")))
draw = float(torch.rand(()))
networks = (runner.alg.actor, runner.alg.critic)
weights = torch.cat([p.detach().flatten() for network in networks for p in network.parameters()])
target = runner.env.env._target.sum()
(folder / f"rank{{rank}}.json").write_text(json.dumps(dict(
    weights=weights.tolist(), draw=draw, target=float(target), steps=runner.env_steps, main=runner.is_main)))
def hang():
    if rank == 1:
        time.sleep(600)
runner.env.env.check = hang
with distributed.ending_together():
    runner.learn(5)
"""
)


PATIENCE_S = 300.0
"""For processes to end: two that load torch on a fresh, busy machine have taken more than a minute."""


def _two_processes(code: str, **options) -> list[subprocess.Popen]:
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    # No PATH: nothing may depend on a git binary, which rsl-rl's logger looks for.
    shared = os.environ | {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "PATH": ""}
    return [
        subprocess.Popen(
            [sys.executable, "-c", code], env=shared | {"RANK": str(r), "LOCAL_RANK": str(r)}, **options
        )
        for r in range(2)
    ]


@pytest.mark.slow
def test_two_processes_keep_the_same_parameters_and_their_own_worlds_until_one_hangs(tmp_path):
    code = HANGING.format(tests=str(Path(__file__).parent), folder=str(tmp_path))
    processes = _two_processes(code, stderr=subprocess.PIPE, text=True)
    try:
        _, error = processes[0].communicate(timeout=PATIENCE_S)
        assert processes[0].returncode == 1
        assert "process 0 failed and ends the run; --resume" in error  # the wait reached its limit
    finally:
        for process in processes:
            process.kill()
    _, error = processes[1].communicate()
    assert "in hang" in error and "distributed" not in error.split("Thread")[-1], "its stack was shown"
    one, two = (json.loads((tmp_path / f"rank{r}.json").read_text()) for r in range(2))
    assert one["weights"] == two["weights"]
    assert one["draw"] != two["draw"] and one["target"] != two["target"]
    assert one["steps"] == two["steps"] == 2 * 8 * 8 * 2
    assert one["main"] and not two["main"]
    assert [row["iteration"] for row in read_progress(tmp_path / "progress.jsonl")] == [1, 2]

    # One process goes on with what two have begun.
    alone = make_runner(tmp_path, env=DummyEnv(num_envs=8))
    alone.load(str(find_checkpoint(tmp_path, "latest")))
    assert alone.new_episodes == "it is of 2 processes, this run has 1"
    assert alone.env_steps == one["steps"] and alone.env.env.stage.difficulty == pytest.approx(0.02)
    networks = (alone.alg.actor, alone.alg.critic)
    weights = torch.cat([p.detach().flatten() for network in networks for p in network.parameters()])
    assert weights.tolist() == one["weights"]
    alone.learn(1)
    assert [row["env_steps"] for row in read_progress(tmp_path / "progress.jsonl")] == [128, 256, 256 + 64]
