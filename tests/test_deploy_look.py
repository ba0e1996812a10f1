"""A policy on a hand sees by the real camera's lens, from where calibration found it to be."""

import os
import pickle
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from sensed_world import state_of

from vd.assets_usd.camera_layer import read_camera, write_camera_layer
from vd.assets_usd.hand_data import Intrinsics
from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.deploy.loop.policy_runner import load_runner
from vd.deploy.loop.run import DriveCfg, _camera
from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.policy.agents import open_policy, task_for
from vd.sensors.depth_camera import DepthCamera
from vd.train.cli import main

SHIFT_M = 0.01


LENS = Intrinsics(64, 36, 55.0, 55.0, 31.0, 19.0)
"""Another one than the training's."""
WITHOUT_TORCH = """
import pickle, sys
from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.deploy.loop.policy_runner import load_runner
name, file = sys.argv[1:]
hand, item = load_hand("dclaw3"), load_set("cube")[0]
runner = load_runner(name, "dclaw3", hand, item, object="cube")
print(pickle.dumps([runner.decide(state) for state in pickle.load(open(file, "rb"))]).hex())
"""


def test_installed_policies_by_camera_stop_by_rules_from_episodes_and_say_where_there_is_none():
    (item,) = load_set("cube")
    for name in ("dclaw3", "dclaw4"):
        hand = load_hand(name)
        runners = {
            tolerance: load_runner(f"{name}-vision", name, hand, item, tolerance_rad=tolerance)
            for tolerance in (0.4, 0.2, 0.1)
        }
        assert [runner.calibrated for runner in runners.values()] == [True, False, True]
        bounds = [runner.rule.distance_rad for runner in runners.values()]
        assert bounds[0] > bounds[1] > bounds[2] > 0.0


@pytest.mark.parametrize("name", ["dclaw3", "dclaw4-cube"])
def test_a_teacher_acts_on_what_a_twin_tells_as_in_its_environment(name):
    policy = open_policy(name, "cpu")
    task = task_for(policy, stop_tolerance_rad=0.4, randomised=False, num_envs=1, objects=("cube",))
    env = ReorientEnv(task, "cpu")
    runner = load_runner(name, task.hand, env.hand, env.objects[0], object="cube")
    for _ in range(4):
        action = wp.from_torch(policy.act(wp.to_torch(env.observation)))
        wanted = action if env.symmetry_frames is None else env.symmetry_frames.world_action(action)
        found = runner.decide(state_of(env))
        np.testing.assert_allclose(found.action, wanted.numpy()[0], atol=2e-3)
        env.step(action)


def test_lens_and_place_are_those_of_the_real_camera(tmp_path):
    hand = load_hand("dclaw3")
    runner = load_runner("dclaw3-vision", "dclaw3", hand, load_set("cube")[0])
    image = np.full((36, 64), 0.6, dtype=np.float32)

    def middle():
        points = runner.eye.seen(image).numpy()[0]
        return points[np.isfinite(points).all(axis=1)]

    runner.look_by(LENS.seen_from(runner.camera))
    before = middle()
    # Every point is one of the image by this lens, from the place of the training.
    seen = runner.camera.project(before)
    assert len(before) == len(seen) > 100
    np.testing.assert_allclose(seen[:, 2], 0.6, atol=1e-5)
    np.testing.assert_allclose(seen[:, :2] % 1.0, 0.5, atol=2e-3)

    place = np.concatenate([hand.camera.position, hand.camera.quaternion])
    place[1] += SHIFT_M
    write_camera_layer(tmp_path / "camera.usda", hand, place, {})
    runner.look_by(LENS.seen_from(read_camera(hand, tmp_path / "camera.usda")))
    # Sideways in the base is level: the crop by height keeps the same pixels.
    np.testing.assert_allclose(np.sort(middle()[:, 1]), np.sort(before[:, 1]) + SHIFT_M, atol=1e-5)


def test_a_real_camera_of_a_hand_without_one_needs_a_place():
    blind = replace(load_hand("dclaw3"), mounted_camera=None)
    runner = load_runner("dclaw3-vision", "dclaw3", blind, load_set("cube")[0])
    connection = SimpleNamespace(hand=blind, twin=None)
    with pytest.raises(ValueError, match="--camera-layer"):
        _camera(DriveCfg("dclaw3-vision"), runner, connection)


def falling():
    """What a hand senses of a cube that falls between moving fingers."""
    plain = RandomisationCfg(enabled=False)
    env = ReorientEnv(ReorientCfg(hand="dclaw3", num_envs=1, randomisation=plain), "cpu")
    camera = DepthCamera.of_scene(env.scene, env.sim.body_q, frame_s=env.cfg.sim.control_dt)
    rng = np.random.default_rng(0)
    for _ in range(6):
        camera.capture()
        yield replace(state_of(env), depth=camera.depth.numpy()[0].copy())
        env.step(wp.array(rng.uniform(-1, 1, (1, env.num_actions)), dtype=float, device="cpu"))


def test_without_torch_decisions_are_those_of_torch(tmp_path):
    pytest.importorskip("onnxruntime", reason="pip install 'visual-dexterity[export]'")
    path, sensed, states = tmp_path / "policy.onnx", tmp_path / "states", list(falling())
    assert main(["export", "dclaw3", str(path)]) == 0
    sensed.write_bytes(pickle.dumps(states))
    item = load_set("cube")[0]
    runner = load_runner("dclaw3", "dclaw3", load_hand("dclaw3"), item, object="cube")
    (tmp_path / "torch.py").write_text(
        "raise ModuleNotFoundError('torch is not here', name='torch')"
    )
    command = [sys.executable, "-c", WITHOUT_TORCH, str(path), str(sensed)]
    done = subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(tmp_path)}
    )
    assert done.returncode == 0, done.stderr
    found = pickle.loads(bytes.fromhex(done.stdout.split()[-1]))
    for state, there in zip(states, found, strict=True):
        here = runner.decide(state)
        np.testing.assert_allclose(there.action, here.action, atol=1e-3)
        np.testing.assert_allclose(there.distance, here.distance, atol=1e-3)
