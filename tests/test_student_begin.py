"""What a student takes over from the one it begins with: what fits, and what is said of the rest."""

from dataclasses import replace

import pytest
import torch
from student_dummy import TINY, make_dagger

from vd.train.student.build import begin_from
from vd.vision.cfg import StudentCfg
from vd.vision.network import Student

ACTIONS = 3


@pytest.fixture
def saved(tmp_path):
    """Writes a student of a stage with weights that differ from a new one's."""

    def write(stage: int, network: StudentCfg = TINY, actions: int = ACTIONS):
        torch.manual_seed(7)
        runner = make_dagger(tmp_path / str(stage))
        runner.student = student = Student(network, actions)
        runner.spec = replace(runner.spec, stage=stage, network=network, num_actions=actions)
        for value in student.state_dict().values():
            if value.is_floating_point():
                value.uniform_(-1.0, 1.0)
        runner.save()
        return tmp_path / str(stage) / "student.pt", student

    return write


def same(one: Student, other: Student, part: str) -> bool:
    first, second = (getattr(student, part).state_dict() for student in (one, other))
    return all(torch.equal(value, second[name]) for name, value in first.items())


@pytest.mark.parametrize("stage", [0, 1])
def test_all_of_a_student_of_the_same_network(saved, stage):
    path, there = saved(stage)
    here = Student(TINY, ACTIONS)
    assert begin_from(path, here, "cpu") == []
    assert all(torch.equal(value, here.state_dict()[name]) for name, value in there.state_dict().items())


def test_an_encoder_serves_another_hand_and_a_policy_does_not(saved):
    path, there = saved(0)
    here = Student(TINY, ACTIONS + 1)
    anew = begin_from(path, here, "cpu")
    assert anew == ["action_layers", "log_std", "mean"]
    assert same(here, there, "encoder") and same(here, there, "memory")
    path, _ = saved(1)
    with pytest.raises(ValueError, match="same hand"):
        begin_from(path, Student(TINY, ACTIONS + 1), "cpu")


def test_another_network_is_refused_but_for_what_an_encoder_does_not_need(saved):
    wider = replace(TINY, memory=8)
    path, _ = saved(1)
    with pytest.raises(ValueError, match="another network"):
        begin_from(path, Student(wider, ACTIONS), "cpu")
    path, there = saved(0)
    here = Student(wider, ACTIONS)
    assert "memory" in begin_from(path, here, "cpu") and same(here, there, "encoder")
    other = replace(TINY, encoder=replace(TINY.encoder, channels=(4, 8)))
    with pytest.raises(ValueError, match="another network"):
        begin_from(path, Student(other, ACTIONS), "cpu")
