"""The teacher's network as ONNX."""

import numpy as np
import pytest
import torch

from vd.evaluate.agents import SHIPPED_POLICIES
from vd.policy import load_policy
from vd.train.cli import main

onnxruntime = pytest.importorskip("onnxruntime", reason="pip install 'visual-dexterity[export]'")


@pytest.mark.parametrize("name", ["dclaw3", "dclaw4-cube"], ids=["state-dependent", "gaussian"])
def test_onnxruntime_gives_the_same_actions_for_any_number_of_worlds(tmp_path, name, capsys):
    assert main(["export", str(SHIPPED_POLICIES[name]), str(tmp_path / "policy.onnx")]) == 0
    assert "the same actions within" in capsys.readouterr().out
    policy = load_policy(SHIPPED_POLICIES[name])
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"))
    for envs in (1, 7):
        # observations of the size they have, not of size 1
        noise = torch.randn(envs, policy.num_observations, generator=torch.Generator().manual_seed(0))
        observation = policy.network.offset + policy.network.scale * noise
        (found,) = session.run(["action"], {"observation": observation.numpy()})
        assert found.shape == (envs, policy.num_actions)
        np.testing.assert_allclose(found, policy.act(observation).numpy(), atol=1e-4)


def test_a_file_with_other_actions_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr("vd.train.export.TOLERANCE", -1.0)
    path = tmp_path / "policy.onnx"
    assert main(["export", str(SHIPPED_POLICIES["dclaw4-cube"]), str(path)]) == 1
    assert not path.exists()
