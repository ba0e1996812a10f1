"""Bundles: what is written comes back, what does not fit is refused by name, nothing in them runs."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from vd.assets_usd.hands import load_hand
from vd.bundle import is_bundle
from vd.bundle.contract import ContractError, check_hand, check_trained_hand, trained_hand
from vd.bundle.store import read_bundle, read_contract, write_bundle
from vd.evaluate.agents import SHIPPED_POLICIES, find_policy, open_policy
from vd.evaluate.cli import main as evaluate
from vd.policy import load_policy
from vd.tracking.policy import read_policy
from vd.train.cli import main as train
from vd.vision.alignment import AlignmentNetwork
from vd.vision.cfg import AlignmentCfg

TEACHER = "dclaw3"
PLACED = (0.5, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0)
"""Where a training put its camera."""


@pytest.fixture(scope="module")
def hand():
    return load_hand("dclaw3")


def make_tracking(camera=None):
    """A tracking policy whose training had folders of its machine."""
    policy = read_policy(SHIPPED_POLICIES["dclaw3-tracking"])
    policy.teacher.task["objects"] = ["/somewhere/mine/training-set", "cube"]
    return replace(policy, spec=replace(policy.spec, camera=camera))


@pytest.fixture
def teacher_bundle(tmp_path):
    write_bundle(load_policy(SHIPPED_POLICIES[TEACHER]), tmp_path / "teacher")
    return tmp_path / "teacher"


def edit(folder, change, *, sign=True):
    """Change contract.json; with ``sign`` its digests are those of the files."""
    path = folder / "contract.json"
    values = json.loads(path.read_text())
    change(values)
    if sign:
        for name in values["files"]:
            values["files"][name] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
    path.write_text(json.dumps(values))


def test_a_teacher_comes_back(teacher_bundle):
    policy, original = (
        open_policy(str(teacher_bundle), "cpu"),
        load_policy(SHIPPED_POLICIES[TEACHER]),
    )
    observation = torch.randn(5, policy.num_observations)
    assert torch.equal(policy.act(observation), original.act(observation))
    assert policy.task == original.task and policy.env_steps == original.env_steps
    assert find_policy(teacher_bundle) == teacher_bundle


@pytest.mark.parametrize("camera", [None, PLACED])
def test_a_tracking_policy_comes_back(tmp_path, hand, camera):
    original = make_tracking(camera)
    contract = write_bundle(original, tmp_path / "tracking")
    found = open_policy(str(tmp_path / "tracking"), "cpu")
    assert found.spec == original.spec and found.teacher.env_steps == original.teacher.env_steps
    observation = torch.randn(5, found.teacher.num_observations)
    assert torch.equal(found.teacher.act(observation), original.teacher.act(observation))
    source = contract.interface["camera"]["source"]
    assert contract.kind == "tracking" and source == ("hand" if camera is None else "policy")
    check_hand(read_contract(tmp_path / "tracking"), hand, "it")
    assert contract.provenance.objects == ("training-set", "cube"), "no folders of the machine"
    assert "/somewhere" not in (tmp_path / "tracking" / "contract.json").read_text()
    # One of before tells of clouds and stages, which it had none of.
    edit(tmp_path / "tracking", lambda values: values["interface"].update(cloud=None))
    edit(tmp_path / "tracking", lambda values: values["provenance"].update(stage=None))
    check_hand(read_contract(tmp_path / "tracking"), hand, "it")
    edit(tmp_path / "tracking", lambda values: values["network"].update(aim={"enabled": True}))
    with pytest.warns(UserWarning, match=r"network\.aim\.enabled is True; this version ignores it"):
        assert read_bundle(tmp_path / "tracking").spec == original.spec


def test_a_vision_policy_comes_back_and_answers_with_its_network(tmp_path):
    torch.manual_seed(0)
    sizes = AlignmentCfg(width=16, layers=1, heads=2, tokens=12)
    network = AlignmentNetwork(sizes).eval().requires_grad_(False)
    original = read_policy(SHIPPED_POLICIES["dclaw3-tracking"])
    original = replace(original, spec=replace(original.spec, alignment=sizes), alignment=network)
    assert write_bundle(original, tmp_path / "vision").kind == "vision"
    found = open_policy(str(tmp_path / "vision"), "cpu")
    assert found.kind == "vision" and found.spec == original.spec
    clouds = torch.randn(2, 3, 40, 3)
    assert torch.equal(found.alignment(*clouds).rotation, network(*clouds).rotation)
    weights = load_file(tmp_path / "vision" / "weights.safetensors")
    weights["alignment.heads.rotation.2.bias"] += 1.0
    save_file(weights, tmp_path / "vision" / "weights.safetensors")
    edit(tmp_path / "vision", lambda _: None)
    with pytest.raises(ContractError, match="outputs differ by"):
        read_bundle(tmp_path / "vision")


def test_a_policys_hand_is_refused_once_it_is_another_one_of_the_same_name(hand):
    wanted = trained_hand(hand)
    assert load_policy(SHIPPED_POLICIES["leap-cube"]).trained_hand["effort_nm"][0] == pytest.approx(
        0.28
    )
    for other in (hand, load_hand("dclaw4")):  # of another name, a person chose it
        check_trained_hand(wanted, other, "policy.pt")
    with pytest.raises(
        ContractError, match=r"hand\.effort_nm\[0\] is .* here, but .* in its training; use"
    ):
        check_trained_hand(wanted, replace(hand, effort=2.0 * hand.effort), "policy.pt")
    with pytest.raises(ContractError, match=r"hand\.tips_in_base\[0\]\[0\]"):
        check_trained_hand(wanted, replace(hand, tip_frame=hand.tip_frame + 1e-3), "policy.pt")


def test_another_hand_is_refused_by_field(teacher_bundle, hand, capsys):
    contract = read_contract(teacher_bundle)
    swapped = (hand.joint_names[1], hand.joint_names[0], *hand.joint_names[2:])
    limited = hand.upper.copy()
    limited[3] = 1.2
    for other, message in (
        (load_hand("dclaw4"), r"hand.name is 'dclaw4' here, but 'dclaw3' in the bundle; use the"),
        (
            replace(hand, joint_names=swapped),
            r"hand\.joint_names\[0\] is 'f0_j2' here, but 'f0_j1'",
        ),
        (replace(hand, upper=limited), r"hand\.upper_rad\[3\] is 1\.2"),
    ):
        with pytest.raises(ContractError, match=message):
            check_hand(contract, other, teacher_bundle)
    for part, field, value, message in (
        ("conventions", "quaternion", "wxyz", "conventions.quaternion is 'xyzw' here, but 'wxyz'"),
        ("action", "scale_rad_s", 2.0, "action.scale_rad_s is 3.5 here, but 2 in"),
        ("observation", "parts", {}, r"observation\.parts\.\w+\[0\] is 0 here, but missing in"),
    ):
        changed = contract.interface | {part: contract.interface[part] | {field: value}}
        with pytest.raises(ContractError, match=message):
            check_hand(replace(contract, interface=changed), hand, teacher_bundle)
    # a hand that is the same but for rounding
    check_hand(contract, replace(hand, upper=hand.upper + 1e-6), teacher_bundle)
    assert evaluate([str(teacher_bundle), "--hand", "dclaw4", "--device", "cpu"]) == 1
    assert "hand.name is 'dclaw4' here" in capsys.readouterr().err


def test_another_camera_is_refused_unless_the_policy_has_its_own(tmp_path, hand):
    moved = replace(
        hand,
        mounted_camera=replace(
            hand.camera, position=hand.camera.position + np.array([0.0, 0.0, 0.02])
        ),
    )
    write_bundle(make_tracking(), tmp_path / "own")
    with pytest.raises(
        ContractError, match=r"camera\.pose_in_base\[2\] is .*write it for this one"
    ):
        check_hand(read_contract(tmp_path / "own"), moved, "it")
    write_bundle(make_tracking(PLACED), tmp_path / "placed")
    check_hand(read_contract(tmp_path / "placed"), moved, "it")
    with pytest.raises(ContractError, match=r"camera\.fx is .* here"):
        zoomed = replace(hand, mounted_camera=replace(hand.camera, fx=300.0))
        check_hand(read_contract(tmp_path / "placed"), zoomed, "it")


def test_damage_is_named(teacher_bundle):
    weights = teacher_bundle / "weights.safetensors"
    data = bytearray(weights.read_bytes())
    data[-1] ^= 1
    weights.write_bytes(bytes(data))
    with pytest.raises(ContractError, match=r"weights\.safetensors is not the file"):
        read_bundle(teacher_bundle)
    weights.write_bytes(bytes(data[:100]))
    edit(teacher_bundle, lambda values: None)
    with pytest.raises(ContractError, match=r"weights\.safetensors is damaged"):
        read_bundle(teacher_bundle)
    weights.unlink()
    with pytest.raises(FileNotFoundError, match="copy the whole folder"):
        read_bundle(teacher_bundle)
    edit(teacher_bundle, lambda values: values.update(format="other 9"), sign=False)
    with pytest.raises(ContractError, match="format is 'other 9', this version reads"):
        read_contract(teacher_bundle)
    (teacher_bundle / "contract.json").write_text("{")
    with pytest.raises(ContractError, match=r"contract\.json: .*vd-train bundle"):
        read_contract(teacher_bundle)


def test_what_does_not_answer_as_it_did_or_is_not_of_this_version_is_refused(teacher_bundle):
    path = teacher_bundle / "weights.safetensors"
    tensors = load_file(path)
    tensors["mlp.0.bias"] += 0.1
    save_file(tensors, path)
    edit(teacher_bundle, lambda values: None)
    with pytest.raises(ContractError, match=r"outputs differ by .* write the bundle again"):
        read_bundle(teacher_bundle)
    del tensors["mlp.0.bias"]
    save_file(tensors, path)
    edit(teacher_bundle, lambda values: None)
    with pytest.raises(ContractError, match=r'Missing key.* "0\.bias".*: write the bundle again'):
        read_bundle(teacher_bundle)
    edit(teacher_bundle, lambda values: values["provenance"]["task"].update(gone=1))
    with pytest.raises(
        ContractError, match=r"has no field gone.* another one wrote .*vd-train bundle"
    ):
        read_bundle(teacher_bundle)


def test_commands(tmp_path, capsys):
    out, run = tmp_path / "bundle", tmp_path / "run"
    assert train(["bundle", "dclaw3-tracking", str(out)]) == 0
    assert "tracking for dclaw3, 9 joints" in capsys.readouterr().out
    assert train(["bundle", TEACHER, str(out)]) == 0, "the bundle of before is replaced"
    assert json.loads((out / "contract.json").read_text())["kind"] == "teacher"
    assert is_bundle(out) and sorted(p.name for p in out.iterdir()) == [
        "contract.json",
        "golden.safetensors",
        "weights.safetensors",
    ]
    run.mkdir()
    (run / "policy.pt").touch()
    assert train(["bundle", TEACHER, str(run)]) == 1
    assert "exists and is no bundle" in capsys.readouterr().err
    assert [path.name for path in run.iterdir()] == ["policy.pt"]
