"""Looks of the simulation that alignment learns from, stages on the command line, several processes."""

import json
import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import mannwhitneyu
from test_alignment import TINY

from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.camera_actor import CameraActor, sensed
from vd.policy.agents import SHIPPED_POLICIES, find_policy
from vd.policy.bundle import read_policy
from vd.policy.contract import VisionSpec
from vd.train.alignment.config import LooksCfg
from vd.train.alignment.looks import SimulatedLooks
from vd.train.cli import main
from vd.train.metrics import read_progress
from vd.train.student.bank import mesh_points
from vd.train.vec_env import ReorientVecEnv
from vd.vision.acting_teacher import VisionPolicy
from vd.vision.alignment import AlignmentNetwork
from vd.vision.saved import load_alignment

LOOKS = 16
"""Of a policy that sees, and of one that does not."""
LOPSIDED = "procedural-heldout-1-seed0"
"""An object without symmetry."""
NEAR_M = 0.006
"""Median distance of what a camera sees, at centres of voxels, from samples 3 mm apart."""


def make_looks(points: int) -> SimulatedLooks:
    """Two cuboids of so many points, seen by a policy of random weights."""
    torch.manual_seed(0)
    cfg = ReorientCfg(
        hand="dclaw3", objects=("cuboid",), num_envs=2, randomisation=RandomisationCfg()
    )
    env = ReorientEnv(cfg, "cpu")
    network = AlignmentNetwork(TINY)
    teacher = read_policy(find_policy("dclaw3"))
    contract = replace(teacher.contract, tracking=VisionSpec(alignment=TINY))
    policy = VisionPolicy(teacher, contract, network)
    surfaces = mesh_points(env.objects, points, torch.device("cpu"))[..., :3]
    return SimulatedLooks(ReorientVecEnv(env), policy, surfaces, LooksCfg(steps=1, kept=6), seed=0)


def test_goals_turned_as_the_label_says_lie_on_what_was_seen():
    looks = make_looks(2000)
    figures = looks.collect(lambda: False)  # a first image is not late
    assert set(figures) == {"looks/rotation_error", "looks/success_per_goal"}
    pairs = looks.pairs(64, 200, near=0.5, scans=0.0)
    assert pairs.goal.shape == pairs.seen.shape == (64, 200, 3)
    back = pairs.surface @ pairs.rotation.transpose(-1, -2) + pairs.offset[:, None]
    apart = torch.cdist(pairs.seen, back).amin(dim=-1).median(dim=-1).values
    assert apart.median() < NEAR_M
    turned = (
        torch.cdist(pairs.seen, pairs.surface + pairs.offset[:, None])
        .amin(dim=-1)
        .median(dim=-1)
        .values
    )
    assert turned.median() > 1.3 * apart.median()
    for _ in range(5):  # more than are kept
        looks.collect(lambda: False)
    assert len(looks.pairs(64, 200, near=0.5, scans=0.0).goal) == 64
    assert looks.collect(lambda: True) is None


@pytest.mark.slow
def test_stages_on_the_command_line(tmp_path, capsys):
    sizes = {
        "batch": 8,
        "steps": 2,
        "shapes": 8,
        "hands": 4,
        "points": 64,
        "views": 1,
        "fresh-shapes": 1,
    }
    small = [word for name, value in sizes.items() for word in (f"--align.{name}", str(value))]
    network = [
        "--align.network.width",
        "16",
        "--align.network.tokens",
        "12",
        "--align.network.layers",
        "1",
    ]
    common = ["--preset", "cpu-demo", "--num-envs", "2", "--logger", "none", "--teacher", "dclaw3"]
    common += ["--objects", "cube", *small]
    folders = [tmp_path / f"stage{number}" for number in (0, 1)]
    assert (
        main(["alignment", *common, *network, "--out", str(folders[0]), "--max-steps", "32"]) == 0
    )
    init = ["--stage", "1", "--init", str(folders[0] / "alignment.pt"), "--looks.steps", "2"]
    assert main(["alignment", *common, *init, "--out", str(folders[1]), "--max-steps", "32"]) == 0
    assert "begins from" in capsys.readouterr().out
    assert main(["alignment", "--out", str(folders[1]), "--resume", "--max-steps", "48"]) == 0
    assert "resumed after iteration 2" in capsys.readouterr().out
    rows = read_progress(folders[1] / "progress.jsonl")
    assert [row["iteration"] for row in rows] == [1, 2, 3]
    assert all(0.0 <= row["looks/rotation_error"] <= 3.15 for row in rows)
    assert load_alignment(folders[1] / "alignment.pt")[1].network.width == 16


PROCESS = """
import json, os, sys
from pathlib import Path
import torch
torch.set_num_threads(1)
sys.path.insert(0, {tests!r})
from test_alignment import make_runner
rank, folder = int(os.environ["RANK"]), Path({folder!r})
runner = make_runner(seed=rank, out=folder)
runner.learn(2)
weights = torch.nn.utils.parameters_to_vector(runner.network.parameters())
result = [weights.tolist(), float(runner.pairs().seen.sum())]
(folder / f"rank{{rank}}.json").write_text(json.dumps(result))
runner.shutdown()
"""


def test_two_processes_share_gradients_and_draw_their_own(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    code = PROCESS.format(tests=str(Path(__file__).parent), folder=str(tmp_path))
    common = os.environ | {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    environments = [common | {"RANK": rank, "LOCAL_RANK": rank} for rank in "01"]
    processes = [subprocess.Popen([sys.executable, "-c", code], env=one) for one in environments]
    try:
        assert [process.wait(timeout=300) for process in processes] == [0, 0]
    finally:
        for process in processes:
            process.kill()
    one, two = (json.loads((tmp_path / f"rank{rank}.json").read_text()) for rank in range(2))
    assert one[0] == two[0] and one[1] != two[1]
    rows = read_progress(tmp_path / "progress.jsonl")
    assert [row["env_steps"] for row in rows] == [64, 128]  # 2 processes x 16 pairs x 2 steps


@pytest.mark.parametrize("name", [name for name in SHIPPED_POLICIES if name.endswith("-vision")])
def test_with_its_network_set_to_zero_it_does_not_find_how_an_object_is_turned(name):
    policy = read_policy(find_policy(name))
    task = replace(ReorientCfg.of(policy), objects=(LOPSIDED,), num_envs=LOOKS)
    env = ReorientEnv(task, "cpu")
    turned = Rotation.from_quat(env.sim.body_q.numpy()[:, env.scene.object_body, 3:])
    errors = []
    for blind in (False, True):
        if blind:
            weights = list(policy.alignment.parameters())
            zeros = torch.zeros_like(torch.nn.utils.parameters_to_vector(weights))
            torch.nn.utils.vector_to_parameters(zeros, weights)
        actor = CameraActor(env, policy)
        decision = actor.tracker.step(sensed(env, actor.camera))
        found = Rotation.from_quat(decision.orientation.numpy())
        errors.append((turned.inv() * found).magnitude())
    assert mannwhitneyu(*errors, alternative="less").pvalue < 0.01, errors
    env.close()
