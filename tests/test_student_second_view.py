"""A student's second view: in which view it acts, from when on, and by which critic."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from student_dummy import asks_its_teacher

from vd.config import to_dict
from vd.envs.cfg import ObservationCfg, RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.envs.symmetry import view_tables
from vd.evaluate import cli
from vd.evaluate.agents import find_policy, open_critic, open_policy
from vd.evaluate.second_view import (
    AFTER_S,
    EVERY_S,
    NEAREST,
    GoalClock,
    StudentSecondView,
    with_second_view,
)
from vd.evaluate.trace import Trace
from vd.kernels.observations import teacher_observation_slices
from vd.policy import PolicySpec, TrainedPolicy, perceptron
from vd.student.saved import SavedStudent, load_student
from vd.student.state import StateHead, state_cfg
from vd.train.cli import main as vd_train
from vd.train.student.follow import follow_teacher

WORLDS, WIDTH = 12, 8


@pytest.fixture(scope="module", params=[("dclaw3", "goal"), ("dclaw4", "goal"), ("dclaw3", "mirrored")])
def env(request):
    """What its teacher was trained in; it serves as the student's too, which looks at its clock only."""
    hand, view = request.param
    return ReorientEnv(
        ReorientCfg(
            hand=hand,
            objects=("cuboid",),
            num_worlds=WORLDS,
            randomisation=RandomisationCfg(enabled=False),
            observation=ObservationCfg(shape="full", view=view),
        ),
        "cpu",
    )


@pytest.fixture
def teacher(env):
    torch.manual_seed(0)
    spec = PolicySpec(env.num_observations, env.num_actions, (16, 8), "elu", "gaussian", True)
    actor, critic = (
        {f"mlp.{name}": value for name, value in perceptron(part).state_dict().items()}
        | {
            "obs_normalizer._mean": torch.randn(1, env.num_observations),
            "obs_normalizer._std": 0.5 + torch.rand(1, env.num_observations),
        }
        for part in (spec, replace(spec, num_actions=1))
    )
    return TrainedPolicy(spec, actor, task=to_dict(env.cfg), critic=critic)


@pytest.fixture
def head(env, teacher):
    views = env.cfg.observation.views(env.num_fingers)
    made = StateHead(state_cfg(teacher.spec, views=views), WIDTH, env.num_actions)
    made.adopt(teacher.network, view_tables(env.state, env.cfg.observation.view))
    return made


def estimates(env: ReorientEnv, head: StateHead, angles: np.ndarray) -> torch.Tensor:
    """Estimates, normalised [N, O], of random states that far from their goals [rad]."""
    torch.manual_seed(1)
    world = torch.randn(WORLDS, env.num_observations)
    axis = torch.nn.functional.normalize(torch.randn(WORLDS, 3), dim=-1)
    half = torch.tensor(angles / 2.0, dtype=torch.float32)[:, None]
    turn = torch.cat([half.sin() * axis, half.cos()], dim=-1)
    world[:, teacher_observation_slices(env.num_fingers)["relative_orientation"]] = turn
    return (world - head.offset) / head.scale


def at_step(env: ReorientEnv, step: int) -> None:
    wp.to_torch(env.goal_steps).fill_(step)


def wanted(env: ReorientEnv, head: StateHead, teacher: TrainedPolicy, estimate: torch.Tensor) -> list[int]:
    """Views of which the critic expects most, from the simulator's own tables and one world at a time."""
    tables = view_tables(env.state, with_second_view(env.cfg.observation).view)
    fingers, chosen = env.num_fingers, []
    for world in (head.offset + head.scale * estimate).double().numpy():
        turn = world[teacher_observation_slices(fingers)["relative_orientation"]]
        axis = -np.sign(turn[3]) * turn[:3]
        near = (tables.sector @ axis).reshape(-1, fingers).argmax(axis=1)
        offered = [near[0], near[1] + fingers] if len(near) == 2 else list(range(fingers))
        values = []
        for view in offered:
            seen = (tables.factor[view] * world[tables.source[view]]).sum(axis=1) + tables.offset[view]
            known = head.known.numpy() > 0
            seen = np.where(known, seen, teacher.network.offset[0].numpy())
            values.append(float(teacher.value(torch.tensor(seen, dtype=torch.float32)[None])[0]))
        chosen.append(int(offered[int(np.argmax(values))]))
    return chosen


def test_it_takes_other_views_of_far_goals_after_a_while_and_keeps_them(env, teacher, head):
    angles = np.where(np.arange(WORLDS) < 3, 0.3, 2.0)
    estimate, hz = estimates(env, head, angles), env.cfg.sim.control_hz
    _, nearest = head.act(estimate)
    at_step(env, 0)
    second = StudentSecondView(GoalClock.of(env), head, env.cfg, teacher.value)
    better = wanted(env, head, teacher, estimate)
    assert any(view != first for view, first in zip(better[3:], nearest[3:].tolist(), strict=True))
    for step in range(round((AFTER_S + EVERY_S) * hz)):
        at_step(env, step)
        second.begin_step()
        seen = []
        for rows in torch.arange(WORLDS).split(5):  # as a network goes through its clouds
            second.rows = rows
            seen += head.act(estimate[rows])[1].tolist()
        late = step >= round(AFTER_S * hz)
        assert seen == nearest[:3].tolist() + (better if late else nearest.tolist())[3:]
    # With a new goal it begins anew.
    at_step(env, step + 1)
    wp.to_torch(env.goal_steps)[4] = 0
    second.begin_step()
    assert second._taken[4] == NEAREST and (second._taken[5:] != NEAREST).all()


def test_in_the_view_that_is_taken_it_acts_as_its_teacher(env, teacher, head):
    estimate = estimates(env, head, np.full(WORLDS, 2.0))
    at_step(env, 0)
    second, after = (
        StudentSecondView(GoalClock.of(env), head, env.cfg, teacher.value),
        round(AFTER_S * env.cfg.sim.control_hz),
    )
    for step in range(after + 1):
        at_step(env, step)
        second.begin_step()
    action, view = head.act(estimate)
    seen = head.guessed(head.views.take(head.offset + head.scale * estimate, view))
    torch.testing.assert_close(action, head.views.world_action(teacher.act(seen), view), atol=1e-4, rtol=1e-4)


def test_a_student_without_views_is_refused(env, teacher, head):
    with pytest.raises(ValueError, match="does not act by the layers of a teacher that sees its goals"):
        StudentSecondView(GoalClock.of(env), None, env.cfg, teacher.value)
    plain = StateHead(state_cfg(teacher.spec, views=0), WIDTH, env.num_actions)
    with pytest.raises(ValueError, match="does not act by the layers of a teacher that sees its goals"):
        StudentSecondView(GoalClock.of(env), plain, env.cfg, teacher.value)


def renamed(student: SavedStudent, teacher: str) -> SavedStudent:
    return replace(student, spec=replace(student.spec, teacher=teacher))


def test_a_student_asks_its_own_critic_or_that_of_its_teacher_by_name(tmp_path):
    student = load_student(asks_its_teacher("dclaw4-table-student", tmp_path / "asking.pt"))
    policy = open_policy("dclaw4-table", "cpu")
    seen = torch.randn(5, policy.num_observations)
    torch.testing.assert_close(open_critic(student, "cpu")(seen), policy.value(seen))
    with pytest.raises(ValueError, match="'lost', which cannot be read"):
        open_critic(renamed(student, "lost"), "cpu")
    with pytest.raises(ValueError, match="'dclaw3-table' observes other things"):
        open_critic(renamed(student, "dclaw3-table"), "cpu")
    blind = torch.load(find_policy("dclaw4-table"), weights_only=True)
    del blind["critic_state_dict"]
    torch.save(blind, tmp_path / "blind.pt")
    with pytest.raises(ValueError, match="no critic; export it again"):
        open_critic(renamed(student, str(tmp_path / "blind.pt")), "cpu")

    # From now on it needs no other file.
    follow_teacher(str(tmp_path / "asking.pt"), "dclaw4-table", tmp_path / "student.pt")
    alone = load_student(tmp_path / "student.pt")
    assert open_critic(alone, "cpu")(seen).equal(policy.value(seen)), "to the last bit, though stored small"
    torch.testing.assert_close(open_critic(renamed(alone, "lost"), "cpu")(seen), policy.value(seen))
    follow_teacher(str(tmp_path / "student.pt"), str(tmp_path / "blind.pt"), tmp_path / "other.pt")
    assert load_student(tmp_path / "other.pt").network.state.critic is None, "not that of another teacher"


def test_an_evaluation_of_a_student_says_that_it_looked_twice(tmp_path):
    arguments = ["dclaw3-student", "--objects", "cuboid", "--episodes", "1", "--device", "cpu"]
    assert cli.main([*arguments, "--second-view", "--episode-s", "0.3", "--output", str(tmp_path)]) == 0
    assert "symmetry-view selection" in (tmp_path / "eval.html").read_text()


def test_a_stopping_rule_is_chosen_of_a_student_that_looks_twice_if_it_is_to(tmp_path, monkeypatch):
    """The rule is that of what will fly, and the file says so."""
    asked = []

    def spy(env, actor, episodes, **_others):
        asked.append(actor.looks_twice)
        seen = np.zeros((1, 1, 4))
        norms, quat = np.array([[[0.0, 0.5, 0.4, 0.3]]]), np.zeros((1, 1, 4))
        return Trace(quat, quat, seen, seen, norms, seen, np.full((1, 1), 4), np.zeros((1, 1), bool))

    monkeypatch.setattr("vd.train.student.calibrate.record", spy)
    shutil.copy(find_policy("dclaw3-student"), path := tmp_path / "student.pt")
    once = ["calibrate", str(path), "--objects", "cube", "--episodes", "1", "--device", "cpu"]
    for arguments, twice in ((once, False), ([*once, "--second-view"], True)):
        assert vd_train(arguments) == 0
        assert asked[-1] == twice == ("looked at twice" in load_student(path).spec.calibrated_on)
