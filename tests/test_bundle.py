"""Bundles: what is written comes back, what does not fit is refused by name, nothing in them runs."""

import hashlib
import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from scipy.spatial.transform import Rotation
from student_dummy import TINY

from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.bundle import is_bundle
from vd.bundle.contract import ContractError, check_hand
from vd.bundle.store import read_bundle, read_contract, write_student, write_teacher, write_tracking
from vd.config import to_dict
from vd.envs.cfg import ReorientCfg
from vd.evaluate.agents import SHIPPED_POLICIES, find_policy, open_policy
from vd.evaluate.cli import main as evaluate
from vd.policy import load_policy
from vd.sensors.cfg import DepthCameraCfg
from vd.stopping import StoppingRule
from vd.tracking.policy import load_tracking
from vd.train.checkpoint import save_checkpoint
from vd.train.cli import main as train
from vd.vision.network import Student
from vd.vision.saved import SavedStudent, StudentSpec, student_export

TEACHER = "dclaw3-table"


@pytest.fixture(scope="module")
def hand():
    return load_hand("dclaw3")


def make_student(stage=2, goal="merged", camera=None):
    """A student of random weights for three fingers."""
    torch.manual_seed(0)
    cfg = replace(TINY, goal=goal)
    spec = StudentSpec(
        network=cfg,
        num_actions=9,
        stage=stage,
        teacher=TEACHER,
        camera=camera,
        stopping=StoppingRule(0.31, 0.7),
        tolerance_rad=0.3,
        precise=StoppingRule(0.08, 0.9),
        calibrated_on="cube: 8 episodes",
    )
    task = to_dict(ReorientCfg(hand="dclaw3", objects=("/somewhere/mine/training-set", "cube")))
    network = Student(cfg, 9).eval().requires_grad_(False)
    return SavedStudent(spec, network, task, to_dict(DepthCameraCfg(points=500)), 3, 4000)


@pytest.fixture
def teacher_bundle(tmp_path, hand):
    write_teacher(tmp_path / "teacher", load_policy(SHIPPED_POLICIES[TEACHER]), hand)
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
    policy, original = read_bundle(teacher_bundle).policy, load_policy(SHIPPED_POLICIES[TEACHER])
    observation = torch.randn(5, policy.num_observations)
    assert torch.equal(policy.act(observation), original.act(observation))
    assert policy.task == original.task and policy.env_steps == original.env_steps
    assert find_policy(teacher_bundle) == teacher_bundle
    assert torch.equal(open_policy(str(teacher_bundle), "cpu").act(observation), original.act(observation))


@pytest.mark.parametrize("goal", ["merged", "separate"])
@pytest.mark.parametrize("stage", [1, 2])
def test_a_student_comes_back(tmp_path, hand, stage, goal):
    student = make_student(stage, goal, camera=(0.5, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0) if stage == 2 else None)
    contract = write_student(tmp_path / "student", student, hand)
    found = read_bundle(tmp_path / "student").policy
    assert found.spec == student.spec and found.iteration == 3 and found.env_steps == 4000
    for name, value in student.network.state_dict().items():
        assert torch.equal(found.network.state_dict()[name], value), name
    assert (contract.interface.camera is not None) == (stage == 2)
    assert contract.provenance.objects == ("training-set", "cube"), "no folders of the machine"
    assert "/somewhere" not in (tmp_path / "student" / "contract.json").read_text()
    check_hand(read_contract(tmp_path / "student"), hand, "it")


@pytest.mark.parametrize("camera", [None, (0.5, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0)])
def test_a_tracking_policy_comes_back(tmp_path, hand, camera):
    original = load_tracking(SHIPPED_POLICIES["dclaw3-tracking"])
    original = replace(original, spec=replace(original.spec, camera=camera))
    contract = write_tracking(tmp_path / "tracking", original, hand)
    found = open_policy(str(tmp_path / "tracking"), "cpu")
    assert found.spec == original.spec and found.teacher.env_steps == original.teacher.env_steps
    observation = torch.randn(5, found.teacher.num_observations)
    assert torch.equal(found.teacher.act(observation), original.teacher.act(observation))
    assert torch.equal(found.teacher.value(observation), original.teacher.value(observation))
    assert contract.kind == "tracking" and contract.interface.camera.source == (
        "hand" if camera is None else "policy"
    )
    check_hand(read_contract(tmp_path / "tracking"), hand, "it")
    edit(tmp_path / "tracking", lambda values: values["network"].update(aim={"enabled": True}))
    with pytest.warns(UserWarning, match=r"network\.aim\.enabled is True; this version ignores it"):
        assert read_bundle(tmp_path / "tracking").policy.spec == original.spec


def test_another_hand_is_refused_by_field(teacher_bundle, hand, capsys):
    contract = read_contract(teacher_bundle)
    check_hand(contract, hand, teacher_bundle)
    with pytest.raises(
        ContractError, match=r"hand.name is 'dclaw4' here, but 'dclaw3' in the bundle; use the"
    ):
        check_hand(contract, load_hand("dclaw4"), teacher_bundle)
    swapped = replace(hand, joint_names=(hand.joint_names[1], hand.joint_names[0], *hand.joint_names[2:]))
    with pytest.raises(ContractError, match=r"hand\.joint_names\[0\] is 'f0_j2' here, but 'f0_j1'"):
        check_hand(contract, swapped, teacher_bundle)
    with pytest.raises(ContractError, match=r"hand\.upper_rad\[3\] is 1\.2"):
        limited = hand.upper.copy()
        limited[3] = 1.2
        check_hand(contract, replace(hand, upper=limited), teacher_bundle)
    # a hand that is the same but for rounding
    check_hand(contract, replace(hand, upper=hand.upper + 1e-6), teacher_bundle)
    assert evaluate([str(teacher_bundle), "--hand", "dclaw4", "--device", "cpu"]) == 1
    assert "hand.name is 'dclaw4' here" in capsys.readouterr().err


def test_another_camera_is_refused_unless_the_policy_has_its_own(tmp_path, hand):
    moved = replace(
        hand, camera=replace(hand.camera, position=hand.camera.position + np.array([0.0, 0.0, 0.02]))
    )
    write_student(tmp_path / "own", make_student(), hand)
    with pytest.raises(ContractError, match=r"camera\.pose_in_base\[2\] is .*write it for this one"):
        check_hand(read_contract(tmp_path / "own"), moved, "it")
    pose = (0.5, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0)
    write_student(tmp_path / "placed", make_student(camera=pose), hand)
    check_hand(read_contract(tmp_path / "placed"), moved, "it")
    with pytest.raises(ContractError, match=r"camera\.fx is .* here"):
        zoomed = replace(hand, camera=replace(hand.camera, fx=300.0))
        check_hand(read_contract(tmp_path / "placed"), zoomed, "it")
    # complete clouds ask for no camera, but for the points of the hand
    write_student(tmp_path / "complete", make_student(stage=1), hand)
    check_hand(read_contract(tmp_path / "complete"), moved, "it")
    fewer = replace(hand, point_names=hand.point_names[:-1])
    with pytest.raises(ContractError, match=r"cloud\.point_names \(their number\) is 11 here, but 12"):
        check_hand(read_contract(tmp_path / "complete"), fewer, "it")


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        (
            ("interface", "conventions", "quaternion"),
            "wxyz",
            "conventions.quaternion is 'xyzw' here, but 'wxyz'",
        ),
        (("interface", "action", "scale_rad_s"), 2.0, "action.scale_rad_s is 3.5 here, but 2 in"),
        (("interface", "observation", "velocity_scale"), 1.0, "observation.velocity_scale is 0.2 here"),
        (("interface", "observation", "file_axes"), True, "observation.file_axes is False here"),
    ],
)
def test_a_contract_of_other_conventions_is_refused(teacher_bundle, hand, field, value, message):
    def change(values):
        for key in field[:-1]:
            values = values[key]
        values[field[-1]] = value

    edit(teacher_bundle, change)
    with pytest.raises(ContractError, match=message):
        check_hand(read_contract(teacher_bundle), hand, teacher_bundle)


def test_what_a_robots_loop_does_not_observe_is_refused(tmp_path, hand):
    policy = load_policy(SHIPPED_POLICIES[TEACHER])
    policy.task["observation"]["history"] = 5
    with pytest.raises(ContractError, match="does not remember yet"):
        write_teacher(tmp_path / "teacher", policy, hand)


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


def test_other_answers_than_the_golden_ones_are_refused(teacher_bundle, tmp_path):
    from safetensors.torch import load_file, save_file

    path = teacher_bundle / "weights.safetensors"
    tensors = load_file(path)
    tensors["mlp.0.bias"] += 0.1
    save_file(tensors, path)
    edit(teacher_bundle, lambda values: None)
    with pytest.raises(ContractError, match=r"outputs differ by .* write it again"):
        read_bundle(teacher_bundle)
    del tensors["mlp.0.bias"]
    save_file(tensors, path)
    edit(teacher_bundle, lambda values: None)
    with pytest.raises(ContractError, match=r'Missing key.* "0\.bias".*: write the bundle again'):
        read_bundle(teacher_bundle)


def test_a_setting_that_this_version_has_not_is_named_with_the_remedy(teacher_bundle):
    edit(teacher_bundle, lambda values: values["provenance"]["task"].update(gone=1))
    with pytest.raises(ContractError, match=r"has no field gone.* another one wrote .*vd-train bundle"):
        read_bundle(teacher_bundle)


class Bomb:
    """Touches a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (self.path, "w"))


def test_nothing_in_a_bundle_runs(teacher_bundle, tmp_path):
    marker = tmp_path / "ran"
    (teacher_bundle / "weights.safetensors").write_bytes(pickle.dumps(Bomb(str(marker))))
    edit(teacher_bundle, lambda values: None)
    with pytest.raises(ContractError, match="damaged"):
        read_bundle(teacher_bundle)
    assert not marker.exists()


def test_golden_clouds_are_those_of_the_kernels(tmp_path, hand):
    """From golden joint positions and poses the product's kernels make the golden cloud."""
    from safetensors.torch import load_file

    from vd.clouds import HandKinematics, SceneClouds
    from vd.sim.scene import hand_mount

    write_student(tmp_path / "student", make_student(), hand)
    golden = load_file(tmp_path / "student" / "golden.safetensors")
    steps, links = golden["joint_q"].shape[0], len(hand.link_names)
    body_q = torch.zeros((steps, links + 1, 7))
    mount = Rotation.from_quat(list(hand_mount())[3:])
    pose = golden["object_pose"].numpy()
    body_q[:, links, :3] = torch.from_numpy(mount.apply(pose[:, :3]) + list(hand_mount())[:3]).float()
    body_q[:, links, 3:] = torch.from_numpy((mount * Rotation.from_quat(pose[:, 3:])).as_quat()).float()
    poses = wp.from_torch(body_q, dtype=wp.transform)
    kinematics = HandKinematics(hand, link_body=np.arange(links), base=hand_mount(), device="cpu")
    kinematics.write(wp.from_torch(golden["joint_q"].contiguous()), poses)
    clouds = SceneClouds(
        hand,
        load_set(["cube"]),
        link_body=np.arange(links),
        object_body=links,
        world_object=np.zeros(steps, dtype=int),
        world_scale=np.ones(steps),
        device="cpu",
    )
    points = wp.zeros((steps, clouds.item.stop), dtype=wp.vec3, device="cpu")
    goal = golden["goal_quat"].repeat(steps, 1).contiguous()
    clouds.write(points, poses, wp.from_torch(goal, dtype=wp.quat))
    wanted = torch.cat([golden["goal_points"], golden["scene_points"]], dim=1).numpy()
    # golden points were moved within their voxels, by a tenth of a side at most
    np.testing.assert_allclose(points.numpy(), wanted, atol=0.1 * TINY.voxel_m + 1e-5)


def test_commands(tmp_path, capsys):
    path = tmp_path / "run" / "student.pt"
    student = make_student()
    state = {
        "spec": to_dict(student.spec),
        "task": student.task,
        "depth": student.depth,
        "iter": 3,
        "env_steps": 4000,
        "student_state_dict": student.network.state_dict(),
    }
    save_checkpoint(path, student_export(state))
    assert find_policy(path.parent) == path
    out = tmp_path / "bundle"
    assert train(["bundle", str(path), str(out)]) == 0
    assert "student for dclaw3, 9 joints" in capsys.readouterr().out
    assert train(["bundle", TEACHER, str(out), "--json"]) == 0, "the bundle of before is replaced"
    assert json.loads(capsys.readouterr().out)["kind"] == "teacher"
    assert is_bundle(out) and sorted(p.name for p in out.iterdir()) == [
        "contract.json",
        "golden.safetensors",
        "weights.safetensors",
    ]
    assert train(["bundle", str(out), str(tmp_path / "again")]) == 1
    assert "is a bundle already" in capsys.readouterr().err
    assert train(["bundle", TEACHER, str(tmp_path / "run")]) == 1
    assert "exists and is no bundle" in capsys.readouterr().err
    assert path.is_file()
