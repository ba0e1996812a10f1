"""Policies as ONNX act on a hand as those of torch do, where torch cannot be imported."""

import os
import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from sensed_world import state_of

from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.deploy.loop.policy_runner import load_runner
from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.sensors.depth_camera import DepthCamera
from vd.train.cli import main

pytest.importorskip("onnxruntime", reason="pip install 'visual-dexterity[export]'")
WITHOUT_TORCH = """
import pickle, sys
from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.deploy.loop.policy_runner import load_runner
name, told, file = sys.argv[1:]
hand, item = load_hand("dclaw3"), load_set("cube")[0]
runner = load_runner(name, "dclaw3", hand, item, object=told or None)
print(pickle.dumps([runner.decide(state) for state in pickle.load(open(file, "rb"))]).hex())
"""


@pytest.fixture(scope="module")
def states():
    """What a hand senses of a cube that falls between moving fingers."""
    plain = RandomisationCfg(enabled=False)
    env = ReorientEnv(ReorientCfg(hand="dclaw3", num_envs=1, randomisation=plain), "cpu")
    camera = DepthCamera.of_scene(env.scene, env.sim.body_q, frame_s=env.cfg.sim.control_dt)
    rng, states = np.random.default_rng(0), []
    for _ in range(6):
        camera.capture()
        states.append(replace(state_of(env), depth=camera.depth.numpy()[0].copy()))
        env.step(wp.array(rng.uniform(-1, 1, (1, env.num_actions)), dtype=float, device="cpu"))
    return states


@pytest.mark.parametrize(("name", "told"), [("dclaw3-tracking", None), ("dclaw3", "cube")])
def test_without_torch_decisions_are_those_of_torch(tmp_path, states, name, told):
    path, sensed = tmp_path / "policy.onnx", tmp_path / "states"
    assert main(["export", name, str(path)]) == 0
    sensed.write_bytes(pickle.dumps(states))
    runner = load_runner(name, "dclaw3", load_hand("dclaw3"), load_set("cube")[0], object=told)
    (tmp_path / "torch.py").write_text("raise ModuleNotFoundError('torch is not here', name='torch')")
    command = [sys.executable, "-c", WITHOUT_TORCH, str(path), told or "", str(sensed)]
    done = subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(tmp_path)}
    )
    assert done.returncode == 0, done.stderr
    found = pickle.loads(bytes.fromhex(done.stdout.split()[-1]))
    for state, there in zip(states, found, strict=True):
        here = runner.decide(state)
        np.testing.assert_allclose(there.action, here.action, atol=1e-3)
        np.testing.assert_allclose(there.distance, here.distance, atol=1e-3)
        if told is None:
            np.testing.assert_allclose(there.found, here.found, atol=1e-3)


def test_vision_policies_and_other_files_are_refused(tmp_path, capsys):
    main(["export", "dclaw3-vision", str(tmp_path / "vision.onnx")])
    (tmp_path / "no.onnx").write_text("no")
    capsys.readouterr()
    for name, said in (("vision", "is of a vision policy"), ("no", "cannot be read")):
        with pytest.raises(ValueError, match=said):
            load_runner(str(tmp_path / f"{name}.onnx"), "dclaw3", None, None)
