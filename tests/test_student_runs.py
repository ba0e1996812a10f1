"""The student in the simulator, on the command line, and in several processes."""

import json
import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from student_dummy import make_dagger

from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.statistics import symmetric_error
from vd.evaluate.student import StudentView
from vd.sensors.cfg import DepthCameraCfg
from vd.train.checkpoint import save_checkpoint
from vd.train.cli import main
from vd.train.metrics import read_progress
from vd.train.student.config import PRESETS
from vd.vision.cfg import NoiseCfg, StudentCfg
from vd.vision.saved import load_student

NETWORK = StudentCfg(voxel_m=0.01)


@pytest.fixture(scope="module")
def env():
    cfg = ReorientCfg(
        hand="dclaw3",
        objects=("cube", "cuboid"),
        num_envs=2,
        randomisation=RandomisationCfg(enabled=False),
    )
    return ReorientEnv(cfg, "cpu")


def steps(env, view, count=6):
    """Frames before ``count`` random actions, and the voxels that each showed at its time."""
    rng = np.random.default_rng(0)
    frames, seen = [], []
    for _ in range(count):
        frames.append(view.frame())
        seen.append(view.sites(frames[-1], augment=False).coordinates.clone())
        env.action.assign(rng.uniform(-1, 1, (2, 9)).astype(np.float32))
        env.step(env.action)
    return frames, seen


@pytest.mark.parametrize("rendered", [False, True])
def test_recorded_frames_show_what_was_seen(env, rendered):
    """Later steps change nothing; rows of chosen environments are those worlds' clouds."""
    env.reset()
    view = StudentView(env, NETWORK, rendered=rendered, depth=DepthCameraCfg(points=500))
    frames, seen = steps(env, view)
    envs = torch.tensor([1, 0, 1])
    times = [0, 3, 5]
    rows = {
        name: torch.stack([frames[t][name][w] for t, w in zip(times, envs.tolist(), strict=True)])
        for name in frames[0]
    }
    sites = view.sites(rows, envs, augment=False)
    for row, (time, world) in enumerate(zip(times, envs.tolist(), strict=True)):
        found = sites.coordinates[sites.coordinates[:, 0] == row][:, 1:]
        assert torch.equal(found, seen[time][seen[time][:, 0] == world][:, 1:])


def test_a_frame_holds_the_true_distance_and_the_action_before_it(env):
    """The distance is to the nearest goal that looks the same: of a cube there are 24."""
    env.reset()
    view = StudentView(env, NETWORK, rendered=False)
    assert not view.frame()["action"].any()
    frames, _ = steps(env, view, 3)
    turn = wp.to_torch(env.sim.body_q)[:, env.scene.object_body, 3:].numpy()
    error = [
        symmetric_error(turn[world], env.goal_quat.numpy()[world], env.objects[index].symmetry)
        for world, index in enumerate(env.world_object)
    ]
    np.testing.assert_allclose(view.frame()["distance"], error, atol=1e-3)
    assert torch.equal(view.frame()["action"], wp.to_torch(env.smoothed))
    assert not torch.equal(frames[1]["action"], frames[2]["action"])


def test_a_camera_sees_a_part_of_the_scene_from_where_it_is(env):
    """The complete cloud has points of the object that no camera sees; another viewpoint sees others."""
    env.reset()
    whole = StudentView(env, NETWORK, rendered=False)
    own = StudentView(env, NETWORK, rendered=True)
    camera = env.hand.camera
    pose = [*camera.position, *camera.quaternion]
    same = StudentView(env, NETWORK, rendered=True, camera=pose)
    # from the other side: turned by pi about the base's z axis, that is by the quaternion (0, 0, 1, 0)
    x, y, z, w = pose[3:]
    mirrored = [-pose[0], -pose[1], pose[2], -y, x, w, -z]
    other = StudentView(env, NETWORK, rendered=True, camera=mirrored)
    clouds = [view.frame().get("points") for view in (own, same, other)]
    assert whole.frame().keys() == own.frame().keys() - {"points"}
    first = set(map(tuple, np.round(clouds[0][0].numpy(), 4)))
    assert len(first & set(map(tuple, np.round(clouds[1][0].numpy(), 4)))) > 0.5 * len(first)
    assert len(first & set(map(tuple, np.round(clouds[2][0].numpy(), 4)))) < 0.1 * len(first)
    with pytest.raises(ValueError, match="quaternion"):
        StudentView(env, NETWORK, rendered=True, camera=[0.0] * 7)


def test_a_cloud_without_a_seen_point_has_the_hand_and_goal_only(env):
    env.reset()
    nothing = DepthCameraCfg(points=100, crop_m=(5.0, 6.0))
    view = StudentView(env, NETWORK, rendered=True, depth=nothing)
    frame = view.frame()
    assert torch.isnan(frame["points"]).all()
    sites = view.sites(frame, augment=False)
    assert len(sites) > 600
    origin = (sites.coordinates[:, 1:] == 0).all(dim=1)
    assert not origin.any()


def test_the_hand_is_seen_where_the_encoders_say(env):
    env.reset()
    true = StudentView(env, NETWORK, rendered=False).frame()["body_q"]
    exact, env.measured_q = env.measured_q, wp.clone(env.sim.joint_q)
    try:
        view = StudentView(env, NETWORK, rendered=False)
        torch.testing.assert_close(view.frame()["body_q"], true, atol=1e-5, rtol=0.0)
        wp.to_torch(env.measured_q)[:, 0] += 0.3
        moved = (view.frame()["body_q"] - true).abs().amax(dim=(0, 2))
    finally:
        env.measured_q = exact
    assert (moved[1:4] > 1e-3).all()  # the first finger, not the others and not the object
    assert (np.delete(moved.numpy(), slice(1, 4)) < 1e-5).all()


def test_random_states_of_a_view_come_back(env):
    env.reset()
    always = NoiseCfg(jitter_probability=1.0, dropout_probability=1.0)
    one, two = (StudentView(env, NETWORK, rendered=True, noise=always, seed=seed) for seed in (0, 1))
    frame = one.frame()
    two.load_state_dict(one.state_dict())
    drawn = [view.sites(frame, augment=True).coordinates for view in (one, two)]
    assert torch.equal(*drawn)
    assert not torch.equal(one.sites(frame, augment=True).coordinates, drawn[0])


@pytest.fixture
def stage(tmp_path):
    """Writes a student of a stage, beside a folder for the next."""

    def write(number):
        runner = make_dagger(tmp_path / f"stage{number}")
        runner.spec = replace(runner.spec, stage=number, teacher="dclaw3-table")
        runner.save()
        return tmp_path / f"stage{number}" / "student.pt"

    return write


def test_presets_are_valid_and_bad_settings_named():
    for preset in PRESETS.values():
        for number in (0, 1, 2):
            preset(number).validate()
    first = PRESETS["paper"](1)
    with pytest.raises(ValueError, match="--camera is for --stage 0 and 2"):
        replace(first, camera=(0.0,) * 7).validate()
    with pytest.raises(ValueError, match=r"--dagger\.epochs is 0"):
        replace(first, dagger=replace(first.dagger, epochs=0)).validate()


def test_another_network_or_no_teacher_is_explained(tmp_path, stage, capsys):
    path = stage(1)
    base = ["student", "--preset", "cpu-demo", "--out", str(tmp_path / "run"), "--device", "cpu"]
    assert main([*base, "--init", str(path), "--network.memory", "32"]) == 1
    assert "moves 2 joints" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    assert main(["student", "--device", "cpu", "--out", str(tmp_path / "x")]) == 1
    assert "--teacher is missing" in capsys.readouterr().err
    save_checkpoint(tmp_path / "bad.pt", {"spec": 1})
    assert main([*base, "--init", str(tmp_path / "bad.pt")]) == 1
    assert "holds no student" in capsys.readouterr().err


@pytest.mark.slow
def test_stages_on_the_command_line(tmp_path, capsys):
    """Stage 1 by imitation of an installed teacher of views, stage 2 from it, resumed."""
    small = ["--preset", "cpu-demo", "--num-envs", "2", "--dagger.rollout-steps", "3", "--no-tensorboard"]
    small += ["--teacher", "dclaw3-table", "--objects", "cube"]
    first = ["student", *small, "--network.proprioception", "action", "position"]
    assert main([*first, "--out", str(tmp_path / "stage1"), "--max-steps", "6"]) == 0
    (row,) = read_progress(tmp_path / "stage1" / "progress.jsonl")
    assert all(row[f"loss/{name}"] > 0.0 for name in ("imitation", "distance", "pose"))
    second = ["student", *small, "--stage", "2", "--out", str(tmp_path / "stage2"), "--max-steps", "6"]
    assert main(second) == 1
    assert "give it as --init" in capsys.readouterr().err and not (tmp_path / "stage2").exists()
    assert main([*second, "--init", str(tmp_path / "stage1" / "student.pt")]) == 0
    assert "begins with the weights of" in capsys.readouterr().out
    resume = ["student", "--out", str(tmp_path / "stage2"), "--resume", "--max-steps", "12"]
    assert main(resume) == 0
    assert "resumed after iteration 1 of 2" in capsys.readouterr().out
    assert [row["iteration"] for row in read_progress(tmp_path / "stage2" / "progress.jsonl")] == [1, 2]
    path = tmp_path / "stage2" / "student.pt"
    saved = load_student(path)
    assert saved.spec.stage == 2 and saved.spec.teacher == "dclaw3-table" and saved.iteration == 2
    assert saved.spec.network.proprioception == ("action", "position")
    assert saved.depth["points"] == 2000 and saved.task["randomisation"]["observation_noise_std"] == 0.0
    assert saved.task["observation"]["view"] == "world"


PROCESS = """
import json, os, sys
from pathlib import Path
import torch
torch.set_num_threads(1)
sys.path.insert(0, {tests!r})
from types import SimpleNamespace
from student_dummy import make_dagger, weights
from train_dummy import DummyEnv
import vd.train.student.dagger as dagger_module
DummyEnv.scene = SimpleNamespace(object_body=1)
dagger_module.poses = lambda frames: frames["target"].repeat(1, 1, 5)[..., :9]
rank, folder = int(os.environ["RANK"]), Path({folder!r})
runner = make_dagger(folder, seed=rank, pose_weight=1.0)  # other environments; other weights at first
runner.learn(2)
result = [weights(runner.networks).tolist(), float(runner.collect().label.sum())]
(folder / f"rank{{rank}}.json").write_text(json.dumps(result))
runner.shutdown()
"""


def test_two_processes_share_gradients_and_keep_their_worlds(tmp_path):
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
    assert [row["env_steps"] for row in rows] == [96, 192]  # 2 processes x 8 environments x 6 steps
