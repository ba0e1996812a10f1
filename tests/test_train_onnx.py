"""The networks of policies as ONNX."""

import importlib.util

import numpy as np
import pytest
import torch

from vd.policy.agents import SHIPPED_POLICIES, open_policy
from vd.policy.bundle import read_policy
from vd.policy.onnx import read_onnx
from vd.train.cli import main

onnxruntime = pytest.importorskip("onnxruntime", reason="pip install 'visual-dexterity[export]'")


@pytest.mark.parametrize("name", ["dclaw3", "dclaw4-cube"], ids=["state-dependent", "gaussian"])
def test_onnxruntime_gives_the_same_actions_for_any_number_of_worlds(tmp_path, name, capsys):
    assert main(["export", str(SHIPPED_POLICIES[name]), str(tmp_path / "policy.onnx")]) == 0
    assert "gives the same" in capsys.readouterr().out
    policy = read_policy(SHIPPED_POLICIES[name])
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"))
    for envs in (1, 7):
        # observations of the size they have, not of size 1
        noise = torch.randn(
            envs, policy.num_observations, generator=torch.Generator().manual_seed(0)
        )
        observation = policy.network.offset + policy.network.scale * noise
        (found,) = session.run(["action"], {"observation": observation.numpy()})
        assert found.shape == (envs, policy.num_actions)
        np.testing.assert_allclose(found, policy.act(observation).numpy(), atol=1e-4)


@pytest.mark.parametrize("kind", ["vision", "student"])
def test_a_policy_that_sees_by_a_network_is_refused(tmp_path, capsys, kind):
    assert main(["export", f"dclaw3-{kind}", str(tmp_path / "policy.onnx")]) == 1
    assert f"a {kind} policy" in capsys.readouterr().err
    assert not (tmp_path / "policy.onnx").exists()


def test_what_an_export_needs_is_named_before_it_begins(tmp_path, capsys, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        "importlib.util.find_spec",
        lambda name, *a: None if name == "onnxscript" else find(name, *a),
    )
    assert main(["export", "dclaw4", str(tmp_path / "policy.onnx")]) == 1
    assert "onnxscript is not installed: " in capsys.readouterr().err
    assert not (tmp_path / "policy.onnx").exists()


def test_a_file_with_other_actions_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr("vd.train.export.TOLERANCE", -1.0)
    path = tmp_path / "policy.onnx"
    assert main(["export", str(SHIPPED_POLICIES["dclaw4-cube"]), str(path)]) == 1
    assert not path.exists()


def test_an_onnx_file_has_the_contract_of_its_policy_and_its_seal(tmp_path):
    path, policy = tmp_path / "policy.onnx", open_policy("dclaw3", "cpu")
    assert main(["export", "dclaw3", str(path)]) == 0
    assert read_onnx(path).contract == policy.contract
    whole = path.read_bytes()
    for place in np.linspace(0, len(whole) - 1, 40).astype(int):
        data = bytearray(whole)
        data[place] ^= 1
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"policy\.onnx is"):
            read_onnx(path)
    with pytest.raises(FileNotFoundError, match=r"none\.onnx"):
        read_onnx(tmp_path / "none.onnx")
