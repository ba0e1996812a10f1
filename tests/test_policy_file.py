"""Policies in files: what is written comes back, what does not fit is refused by name, nothing runs."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save

from vd.assets_usd.hands import load_hand
from vd.command.config import from_dict
from vd.envs.cfg import ReorientCfg
from vd.evaluate.cli import main as evaluate
from vd.policy.agents import SHIPPED_POLICIES, open_policy
from vd.policy.bundle import read_contract, read_policy, write_policy
from vd.policy.contract import (
    CONTRACT_KEY,
    SEAL_KEY,
    UNSEALED,
    ContractError,
    check_hand,
    contract_text,
    derive_interface,
    sealed,
)
from vd.train.cli import main as train

PLACED = (0.5, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0)
"""Where a training put its camera."""


@pytest.fixture(scope="module")
def hand():
    return load_hand("dclaw3")


@pytest.fixture
def path(tmp_path):
    """A policy that may be changed."""
    path = tmp_path / "policy.safetensors"
    path.write_bytes(SHIPPED_POLICIES["dclaw4-cube"].read_bytes())
    return path


def made(camera=None):
    """The contract of a vision policy that was made for a camera at this place."""
    contract = read_contract(SHIPPED_POLICIES["dclaw3-vision"])
    tracking = replace(contract.tracking, camera=camera)
    task = replace(ReorientCfg(), **{name: contract.task[name] for name in ("hand", "fingertip")})
    interface = derive_interface(task, load_hand("dclaw3"), tracking)
    parts = contract.interface | {"camera": interface["camera"]}
    return replace(contract, tracking=tracking, interface=parts)


def edit(path, change, weights=lambda _: None):
    """Change contract and weights of a policy, and seal it again."""
    values = json.loads(contract_text(read_contract(path)))
    change(values)
    tensors = load_file(path)
    weights(tensors)
    tensors[SEAL_KEY] = torch.tensor(list(UNSEALED), dtype=torch.uint8)
    path.write_bytes(sealed(save(tensors, {CONTRACT_KEY: json.dumps(values)})))


@pytest.mark.parametrize("name", ["dclaw3", "dclaw3-vision"])
def test_a_policy_that_is_exported_is_the_same_without_folders_of_its_machine(name, tmp_path):
    policy, out = open_policy(name, "cpu"), tmp_path / "out.safetensors"
    task = policy.contract.task | {"objects": ["/somewhere/mine/training-set", "cube"]}
    file = tmp_path / "mine.safetensors"
    write_policy(policy, file, replace(policy.contract, task=task))
    assert train(["export", str(file), str(out)]) == 0
    assert b"/somewhere" in file.read_bytes() and b"/somewhere" not in out.read_bytes()
    again = read_policy(out)
    assert (again.kind, again.hand) == (policy.kind, "dclaw3")
    assert again.contract == replace(
        policy.contract, task=task | {"objects": ["training-set", "cube"]}
    )
    before, after = load_file(SHIPPED_POLICIES[name]), load_file(out)
    del before[SEAL_KEY], after[SEAL_KEY]
    assert before.keys() == after.keys() and any(key.startswith("actor.") for key in after)
    # Golden answers are computed anew, with other rounding on another number of threads.
    weights = [key for key in before if not key.startswith("golden.")]
    assert all(torch.equal(before[key], after[key]) for key in weights), "the critic's too"


def test_whoever_reads_safetensors_finds_contract_and_weights():
    with safe_open(SHIPPED_POLICIES["dclaw4"], "np") as file:
        contract = json.loads(file.metadata()["contract"])
        observed = file.get_tensor("actor.mlp.0.weight").shape[1]
    assert contract["format"] == "visual-dexterity policy 1"
    assert contract["network"]["num_observations"] == observed
    assert contract["interface"]["hand"]["name"] == contract["task"]["hand"] == "dclaw4"


def test_every_flipped_byte_is_noticed(path):
    whole = path.read_bytes()
    places = np.linspace(0, len(whole) - 1, 40).astype(int)
    for place in {*places, 9, 500, len(whole) - 65, len(whole) - 1}:
        data = bytearray(whole)
        data[place] ^= 1
        path.write_bytes(data)
        with pytest.raises(ContractError, match=rf"{path} is damaged"):
            read_policy(path)
    for data in (b"", whole[:100], whole[:-1], whole + b"\n"):
        path.write_bytes(data)
        with pytest.raises(ContractError, match=rf"{path} is damaged"):
            read_contract(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v.update(format="other 9"), r"format is 'other 9', this version reads"),
        (lambda v: v.update(future=1), r"contract has no field future"),
        (lambda v: v["task"].update(gone=1), r"contract\.task has no field gone"),
        (
            lambda v: v["task"]["start"].update(reached_share=0.3),
            r"contract\.task\.start\.reached_share = 0\.3 is gone",
        ),
        (lambda v: v["network"].update(hidden=3), r"contract\.network\.hidden: expected a list"),
    ],
)
def test_what_this_version_does_not_know_is_refused_by_file_and_field(path, change, message):
    edit(path, change)
    with pytest.raises(ContractError, match=f"{path}: {message}.*take the version"):
        read_policy(path)


@pytest.mark.parametrize(
    ("group", "name", "off"),
    [
        ("start", "reached_share", 0.0),
        ("randomisation", "observation_jitter_s", 0.0),
        ("randomisation", "object_pose_error", [0.0, 0.0]),
    ],
)
def test_a_setting_that_is_gone_is_read_where_it_was_off(path, group, name, off):
    before = ReorientCfg.of(read_policy(path))
    edit(path, lambda v: v["task"][group].update({name: off}))
    assert ReorientCfg.of(read_policy(path)) == before
    assert from_dict(ReorientCfg, {group: {name: off}}) == ReorientCfg(), "of a run's config too"


def test_weights_that_are_others_are_refused(path):
    edit(path, lambda _: None, lambda tensors: tensors["actor.mlp.0.bias"].add_(0.1))
    with pytest.raises(ContractError, match=r"outputs differ by .*golden"):
        read_policy(path)
    edit(path, lambda _: None, lambda tensors: tensors.pop("actor.mlp.0.bias"))
    with pytest.raises(ContractError, match=r'Missing key.* "0\.bias"'):
        read_policy(path)


@pytest.mark.parametrize("name", ["dclaw4", "dclaw3-vision"])
def test_a_training_that_rounds_products_reads_and_writes_policies(name, device, tmp_path):
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        policy = read_policy(SHIPPED_POLICIES[name], device)
        write_policy(policy, tmp_path / "policy.safetensors")
    finally:
        torch.set_float32_matmul_precision(before)
    read_policy(tmp_path / "policy.safetensors")


def test_golden_values_are_of_the_network_of_a_vision_policy_too(tmp_path):
    path = tmp_path / "vision.safetensors"
    path.write_bytes(SHIPPED_POLICIES["dclaw3-vision"].read_bytes())
    edit(path, lambda _: None, lambda t: t["alignment.heads.rotation.2.bias"].add_(1.0))
    with pytest.raises(ContractError, match="outputs differ by"):
        read_policy(path)


def test_another_hand_is_refused_by_field(hand, capsys):
    contract = read_contract(SHIPPED_POLICIES["dclaw3"])
    swapped = (hand.joint_names[1], hand.joint_names[0], *hand.joint_names[2:])
    limited = hand.upper.copy()
    limited[3] = 1.2
    for other, message in (
        (load_hand("dclaw4"), r"hand.name is 'dclaw4' here, but 'dclaw3' in the policy's contract"),
        (
            replace(hand, joint_names=swapped),
            r"hand\.joint_names\[0\] is 'f0_j2' here, but 'f0_j1'",
        ),
        (replace(hand, upper=limited), r"hand\.upper_rad\[3\] is 1\.2 .*; use the hand it was"),
        (replace(hand, effort=2.0 * hand.effort), r"hand\.effort_nm\[0\] is .* here, but .*; use"),
        (replace(hand, tip_frame=hand.tip_frame + 1e-3), r"hand\.tips_in_base\[0\]\[0\]"),
    ):
        with pytest.raises(ContractError, match=message):
            check_hand(contract, other, "it")
    for part, field, value, message in (
        ("conventions", "quaternion", "wxyz", "conventions.quaternion is 'xyzw' here, but 'wxyz'"),
        ("action", "scale_rad_s", 2.0, "action.scale_rad_s is 3.5 here, but 2 in"),
        ("observation", "parts", {}, r"observation\.parts\.\w+\[0\] is 0 here, but missing in"),
    ):
        changed = contract.interface | {part: contract.interface[part] | {field: value}}
        with pytest.raises(ContractError, match=message):
            check_hand(replace(contract, interface=changed), hand, "it")
    # a hand that is the same but for rounding
    check_hand(contract, replace(hand, upper=hand.upper + 1e-6), "it")


def test_an_evaluation_refuses_a_hand_that_changed_under_its_name(tmp_path, capsys):
    moved = tmp_path / "moved.usda"
    text = load_hand("dclaw4").path.read_text()
    before = next(line for line in text.splitlines() if "vd:workspace:drop" in line)
    moved.write_text(text.replace(before, before.partition("=")[0] + "= (0, 0, 0.2)"))
    assert evaluate(["dclaw4", "--hand", str(moved), "--device", "cpu"]) == 1
    assert "hand.drop_m[2] is 0.2 here, but 0.12" in capsys.readouterr().err


def test_another_camera_is_refused_unless_the_policy_has_its_own(hand):
    place = hand.camera.position + np.array([0.0, 0.0, 0.02])
    moved = replace(hand, mounted_camera=replace(hand.camera, position=place))
    assert made().interface == read_contract(SHIPPED_POLICIES["dclaw3-vision"]).interface
    with pytest.raises(ContractError, match=r"camera\.pose_in_base\[2\] is .*this one"):
        check_hand(made(), moved, "it")
    check_hand(made(PLACED), moved, "it")
    with pytest.raises(ContractError, match=r"camera\.fx is .* here"):
        zoomed = replace(hand, mounted_camera=replace(hand.camera, fx=300.0))
        check_hand(made(PLACED), zoomed, "it")


def test_a_policy_is_read_without_simulator_and_its_contract_without_torch():
    code = """
import sys
from vd.policy.contract import Contract
from vd.policy.onnx import read_onnx
assert "torch" not in sys.modules
from vd.policy.bundle import read_policy
read_policy(sys.argv[1])
loaded = {"newton", "mujoco", "rsl_rl", "pxr"} & set(sys.modules)
assert not loaded, loaded
"""
    run = [sys.executable, "-c", code, str(SHIPPED_POLICIES["dclaw4-vision"])]
    done = subprocess.run(run, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_names_of_outputs_say_what_is_written(tmp_path, capsys, monkeypatch):
    for name in ("out.pt", "out", "out.onnx.bak"):
        assert train(["export", "dclaw4-cube", str(tmp_path / name)]) == 1
        assert ".safetensors or .onnx" in capsys.readouterr().err
    tracker = ["tracker", "dclaw3", "--objects", "cube", "--out", str(tmp_path / "vision.pt")]
    assert train(tracker) == 1 and "in .safetensors" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    written = []
    monkeypatch.setattr("vd.train.export.export_onnx", lambda policy, *_: written.append(policy))
    assert train(["export", "dclaw4-cube", str(tmp_path / "policy.ONNX")]) == 0
    assert written and not list(tmp_path.iterdir()), "capital letters mean the same"
