"""The teacher's layers on an estimate of what it observes: what is aimed at, the first estimate, learning."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from vd.config import from_dict, to_dict
from vd.kernels.task.observations import teacher_observation_size, teacher_observation_slices
from vd.policy import MeanAction, PolicySpec, perceptron
from vd.vision.cfg import StateCfg, StudentCfg
from vd.vision.network import Student
from vd.vision.state import UNSEEN, StateHead, state_cfg

FINGERS, ACTIONS, WIDTH = 3, 9, 12
SHAPE_VALUES = 5
SPEC = PolicySpec(
    num_observations=teacher_observation_size(FINGERS) + SHAPE_VALUES,
    num_actions=ACTIONS,
    hidden=(16, 8),
    activation="elu",
    distribution="state-dependent",
    normalise_observations=True,
)
COLUMNS = teacher_observation_slices(FINGERS)


def teacher(seed: int = 0) -> MeanAction:
    """A teacher of random weights whose observation is not normalised by nature."""
    torch.manual_seed(seed)
    weights = {f"mlp.{name}": value for name, value in perceptron(SPEC).state_dict().items()}
    weights["obs_normalizer._mean"] = torch.randn(1, SPEC.num_observations)
    weights["obs_normalizer._std"] = 0.5 + torch.rand(1, SPEC.num_observations)
    return MeanAction(SPEC, weights)


def observations(count: int = 6) -> torch.Tensor:
    """Random values with proper quaternions where the rotation from the goal is."""
    values = torch.randn(count, SPEC.num_observations)
    turns = Rotation.random(count, random_state=0).as_quat()
    turns[::2] *= -np.sign(turns[::2, 3:])  # more than half a turn, as the simulator may give it
    values[:, COLUMNS["relative_orientation"]] = torch.from_numpy(turns).float()
    return values


def head(acts_like: MeanAction | None = None) -> StateHead:
    torch.manual_seed(1)
    made = StateHead(state_cfg(SPEC), WIDTH, ACTIONS)
    made.adopt(acts_like or teacher())
    return made


def test_at_a_true_estimate_the_teacher_acts():
    """But for what cannot be seen, which it is told the mean of, and quaternions of more than half a turn."""
    policy = teacher()
    made, observation = head(policy), observations()
    told = observation.clone()
    turn = told[:, COLUMNS["relative_orientation"]]
    assert (turn[:, 3] < 0.0).any() and (turn[:, 3] > 0.0).any()
    told[:, COLUMNS["relative_orientation"]] = turn * turn[:, 3:].sign()
    for name in UNSEEN:
        told[:, COLUMNS[name]] = policy.offset[:, COLUMNS[name]]
    estimate = made.target(observation)
    torch.testing.assert_close(made.act(estimate)[0], policy(told))
    assert (made.act(estimate)[0] - policy(observation)).abs().max() > 1e-3
    assert not torch.equal(estimate, observation)
    # of a rotation both quaternions are the same
    other = observation.clone()
    other[:, COLUMNS["relative_orientation"]] *= -1.0
    torch.testing.assert_close(made.target(other), estimate)


def test_the_first_estimate_is_the_best_linear_one():
    made, policy = head(), teacher()
    assert not made.fitted
    features = torch.randn(4000, WIDTH) * 0.5 + 1.0
    mixed = torch.randn(WIDTH, SPEC.num_observations) * 0.2
    observation = features @ mixed + 0.3
    observation[:, COLUMNS["relative_orientation"]] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    made.fit(features, observation)
    assert made.fitted and head().load_state_dict(made.state_dict())
    estimate, action, _ = made(features)
    assert (estimate - made.target(observation)).square().mean().sqrt() < 0.01
    # columns at their mean would be off by far more
    assert made.target(observation)[:, : COLUMNS["object_orientation"].start].std(dim=0).min() > 0.1
    assert action.shape == (4000, ACTIONS)
    observation[:, 0] += torch.randn(4000)  # what features do not say leaves the mean
    made.fit(features, observation)
    error = (made(features)[0] - made.target(observation)).detach()
    assert abs(float(error[:, 0].mean())) < 1e-3 and error[:, 0].std() * policy.scale[0, 0] < 1.05


def test_of_few_states_the_first_estimate_learns_no_chance_by_heart():
    """Features that say nothing, hardly more states than features: other states are to be near the mean."""
    made = head()
    made.fit(torch.randn(2 * WIDTH, WIDTH), torch.randn(2 * WIDTH, SPEC.num_observations))
    features, observation = torch.randn(2000, WIDTH), torch.randn(2000, SPEC.num_observations)
    target = made.target(observation)
    error = (made(features)[0] - target).detach().square().mean()
    assert error < 1.25 * target.var(dim=0).mean()


def test_a_student_with_the_head_is_saved_whole_and_leaves_the_teachers_layers_alone():
    cfg = from_dict(StudentCfg, to_dict(StudentCfg(memory=8, head_hidden=8, state=state_cfg(SPEC))))
    student = Student(cfg, ACTIONS)
    assert student.state is not None
    student.state.adopt(teacher())
    embedding, senses = torch.randn(4, 2, cfg.encoder.embedding), torch.randn(4, 2, student.num_senses)
    output = student(embedding, senses, student.initial_hidden(2))
    torch.testing.assert_close(output.mean, student.state.act(output.state)[0])  # nothing to add yet
    output.mean.square().sum().backward()
    gradients = {name: p.grad for name, p in student.named_parameters()}
    assert all(gradients[name] is None for name in gradients if "teacher" in name)
    assert gradients["state.estimate.weight"].abs().max() > 0.0 and gradients["mean.weight"].abs().max() > 0.0
    again = Student(cfg, ACTIONS)
    again.load_state_dict(student.state_dict())
    torch.testing.assert_close(again(embedding, senses, again.initial_hidden(2)).mean, output.mean)
    plain = Student(StudentCfg(), ACTIONS)(embedding, senses, torch.zeros(2, StudentCfg().memory))
    assert plain.state.shape == (4, 2, 0)


def test_sizes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="state"):
        Student(StudentCfg(state=StateCfg(values=-1)), ACTIONS)
    with pytest.raises(RuntimeError, match="size mismatch"):
        StateHead(StateCfg(values=SPEC.num_observations, hidden=(16, 9)), WIDTH, ACTIONS).adopt(teacher())
