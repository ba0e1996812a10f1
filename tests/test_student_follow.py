"""A student gets the layers of a teacher that has gone on, and sees the same as before."""

import pytest
import torch

from vd.evaluate.agents import find_policy
from vd.kernels.observations import teacher_observation_size
from vd.kernels.shapes import shape_observation_size
from vd.policy import MeanAction, PolicySpec, load_policy, perceptron
from vd.student.object_sense import object_values
from vd.student.saved import load_student
from vd.student.state import StateHead, state_cfg
from vd.train.cli import main

FINGERS, ACTIONS, WIDTH = 3, 9, 5
VALUES = teacher_observation_size(FINGERS) + shape_observation_size(FINGERS)
SPEC = PolicySpec(VALUES, ACTIONS, (16, 8), "elu", "state-dependent", True)


def teacher(seed: int) -> MeanAction:
    torch.manual_seed(seed)
    weights = {f"mlp.{name}": value for name, value in perceptron(SPEC).state_dict().items()}
    weights["obs_normalizer._mean"] = torch.randn(1, VALUES)
    weights["obs_normalizer._std"] = 0.5 + torch.rand(1, VALUES)
    return MeanAction(SPEC, weights)


@pytest.mark.parametrize("finds", [False, True])
def test_it_estimates_the_same_of_the_world_and_acts_as_the_other_teacher(finds):
    before, after = teacher(0), teacher(1)
    width = WIDTH + object_values(ACTIONS)
    head = StateHead(state_cfg(SPEC), width, ACTIONS, found=WIDTH if finds else None)
    head.adopt(before)
    head.fitted.fill_(True)
    with torch.no_grad():
        head.estimate.weight.normal_()
        head.estimate.bias.normal_()
    features = torch.randn(20, width)
    seen = head.offset + head.scale * head(features)[0]
    assert head.follow(after)
    estimate, action, _ = head(features)
    world = head.offset + head.scale * estimate
    torch.testing.assert_close(world, seen, atol=1e-4, rtol=1e-4)
    told = torch.where(head.known > 0.0, world, head.offset)
    torch.testing.assert_close(action, after(told), atol=1e-4, rtol=1e-4)
    assert head.fitted, "the estimate is not to be fitted anew"


def test_the_same_teacher_again_changes_nothing():
    head = StateHead(state_cfg(SPEC), WIDTH, ACTIONS)
    head.adopt(teacher(0))
    features = torch.randn(20, WIDTH)
    action = head(features)[1]
    assert not head.follow(teacher(0))
    torch.testing.assert_close(head(features)[1], action)


def test_the_command_writes_a_student_that_is_to_be_calibrated_anew(tmp_path, capsys):
    output = tmp_path / "student.pt"
    assert main(["follow", "dclaw4-student", "dclaw4-air", str(output)]) == 0
    assert f"vd-train calibrate {output}" in capsys.readouterr().out
    student, policy = load_student(output), load_policy(find_policy("dclaw4-air"))
    assert student.spec.teacher == "dclaw4-air" and not student.spec.calibrated_on
    assert student.spec.stopping == load_student(find_policy("dclaw4-student")).spec.stopping
    # Weights of matrices are stored in half precision.
    last = student.network.state.teacher[-1].bias
    torch.testing.assert_close(last, policy.network.layers[-1].bias[: len(last)], atol=1e-3, rtol=1e-3)


def test_it_follows_a_teacher_that_sees_its_goals_in_other_views(tmp_path):
    state = torch.load(find_policy("dclaw3-table"), weights_only=True)
    state["task"]["observation"]["view"] = "mirrored"
    torch.save(state, tmp_path / "mirrored.pt")
    for name in ("dclaw3-table", str(tmp_path / "mirrored.pt")):
        assert main(["follow", "dclaw3-student", name, str(tmp_path / f"{len(name)}.pt")]) == 0
    names = ("dclaw3-table", str(tmp_path / "mirrored.pt"))
    turned, mirrored = (load_student(tmp_path / f"{len(name)}.pt").network.state for name in names)
    assert len(turned.views) == 3 and len(mirrored.views) == 6
    # An estimate is measured in units of its own; what is told of the world is the same.
    world = turned.offset + turned.scale * torch.randn(60, len(turned.offset))
    action, view = turned.act((world - turned.offset) / turned.scale)
    other, chosen = mirrored.act((world - mirrored.offset) / mirrored.scale)
    same = view == chosen
    assert same.any() and not same.all(), "half of them are seen in the mirror"
    torch.testing.assert_close(action[same], other[same], atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize(
    ("teacher", "message"),
    [("dclaw3-table", "same hand"), ("dclaw4-cube", "observes other things"), ("zero", "trained teacher")],
)
def test_another_hand_or_observation_is_refused(tmp_path, capsys, teacher, message):
    output = tmp_path / "student.pt"
    assert main(["follow", "dclaw4-student", teacher, str(output)]) == 1
    assert message in capsys.readouterr().err and not output.exists()


def test_a_teacher_is_no_student(tmp_path, capsys):
    assert main(["follow", "dclaw4-air", "dclaw4-table", str(tmp_path / "student.pt")]) == 1
    assert "no student" in capsys.readouterr().err


def test_actions_that_mean_something_else_are_refused(tmp_path, capsys):
    state = torch.load(find_policy("dclaw4-table"), weights_only=True)
    state["task"]["action"]["scale_rad_s"] += 1.0
    torch.save(state, tmp_path / "policy.pt")
    output = tmp_path / "student.pt"
    assert main(["follow", "dclaw4-student", str(tmp_path / "policy.pt"), str(output)]) == 1
    assert "an action of" in capsys.readouterr().err and not output.exists()
