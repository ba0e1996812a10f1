"""A run of several processes.

The same parameters, own environments, and errors and hangs of one of them.
"""

import json
import os
import re
import socket
import subprocess
import sys
import time
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
distributed.COLLECTIVE_TIMEOUT, distributed.REPORT_AFTER_S = timedelta(seconds=15), 1.5
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
agent = os.getppid()
def hang():
    while rank == 1 and os.getppid() == agent:
        time.sleep(0.1)
runner.env.env.check = hang
with distributed.ending_together():
    runner.learn(5)
"""
)


PATIENCE_S = 300.0
"""For processes to end: two that load torch on a fresh, busy machine have taken more than a
minute.
"""


def _two_nodes(script: Path, folder: Path) -> list[subprocess.Popen]:
    """Starts torchrun on two addresses of this machine, as on two machines, with a process each.

    What they say on stderr goes to a file each: stacks that both write at once would be torn.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    flags = "--nnodes 2 --nproc-per-node 1 --rdzv-backend c10d --rdzv-endpoint"
    run = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        *flags.split(),
        f"127.0.0.1:{port}",
        "--local-addr",
    ]
    # No PATH: nothing may depend on a git binary, which rsl-rl's logger looks for.
    env = os.environ | {"PATH": ""}
    return [
        subprocess.Popen(
            [*run, f"127.0.0.{node}", script], stderr=(folder / f"stderr{node}").open("w"), env=env
        )
        for node in (1, 2)
    ]


@pytest.mark.slow
def test_two_nodes_keep_the_same_parameters_and_their_own_worlds_until_one_hangs(tmp_path):
    script = tmp_path / "run.py"
    script.write_text(HANGING.format(tests=str(Path(__file__).parent), folder=str(tmp_path)))
    deadline = time.monotonic() + PATIENCE_S
    nodes = _two_nodes(script, tmp_path)
    try:
        # The wait of one of them reaches its limit, and so do the others.
        while all(node.poll() is None for node in nodes):
            assert time.monotonic() < deadline
            time.sleep(0.1)
    finally:
        for node in nodes:
            # Asked to end, one whose rendezvous has gone with the other waits for minutes.
            node.kill()
            node.wait(timeout=PATIENCE_S)
    said = "".join((tmp_path / f"stderr{node}").read_text() for node in (1, 2))
    assert "process 0 failed and ends the run; --resume" in said
    assert re.search(r"most recent call first\):\n  File .* in hang\n", said), (
        "the stack of who hangs"
    )
    one, two = (json.loads((tmp_path / f"rank{r}.json").read_text()) for r in range(2))
    assert one["weights"] == two["weights"]
    assert one["draw"] != two["draw"] and one["target"] != two["target"]
    assert one["steps"] == two["steps"] == 2 * 8 * 8 * 2
    assert one["main"] and not two["main"]
    assert [row["iteration"] for row in read_progress(tmp_path / "progress.jsonl")] == [1, 2]

    # One process goes on with what two have begun.
    alone = make_runner(tmp_path, env=DummyEnv(num_envs=8))
    alone.load(str(find_checkpoint(tmp_path, "latest")))
    assert alone.new_episodes == "the checkpoint is of 2 processes, this run has 1"
    assert alone.env_steps == one["steps"] and alone.env.env.levels.goals == pytest.approx(0.02)
    networks = (alone.alg.actor, alone.alg.critic)
    weights = torch.cat(
        [p.detach().flatten() for network in networks for p in network.parameters()]
    )
    assert weights.tolist() == one["weights"]
    alone.learn(1)
    assert [row["env_steps"] for row in read_progress(tmp_path / "progress.jsonl")] == [
        128,
        256,
        256 + 64,
    ]
