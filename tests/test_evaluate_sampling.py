"""Planning by sampling: it finds what pays, knows the state it starts from, and changes nothing."""

import pytest
import torch
import warp as wp

from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.sampling import SamplingCfg, SamplingController


@pytest.fixture(scope="module")
def env() -> ReorientEnv:
    task = ReorientCfg(
        objects=("symmetric",), num_envs=2, randomisation=RandomisationCfg(enabled=False)
    )
    return ReorientEnv(task, "cpu")


def controller(env: ReorientEnv, **sizes: float) -> SamplingController:
    return SamplingController(env, SamplingCfg(**({"samples": 8, "horizon": 4} | sizes)))


def test_a_plan_goes_to_the_actions_that_pay(env, monkeypatch):
    planner = controller(env, samples=64, horizon=1, std=0.2)
    best = torch.linspace(-0.8, 0.8, env.num_actions)

    def simulate(noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        actions = (planner._plan[:, None] + planner.cfg.std * noise).clamp(-1.0, 1.0)
        return actions, -(actions - best).square().sum(dim=(-1, -2))

    monkeypatch.setattr(planner, "_simulate", simulate)
    env.step(wp.from_torch(torch.zeros(2, env.num_actions)))  # in the first step plans begin anew
    for _ in range(40):
        action = planner.act(wp.to_torch(env.observation))
    assert (action - best).abs().mean() < 0.25  # begun at zero it is 0.44


def test_planning_starts_from_the_state_and_leaves_it_alone(env):
    env.reset(seed=3)
    moved = torch.full((2, env.num_actions), 0.5)
    for _ in range(2):
        env.step(wp.from_torch(moved))
    before = {name: array.numpy().copy() for name, array in env.changing_arrays().items()}
    planner = controller(env)
    planner._restore()
    planned = planner._model.sim.joint_q.numpy().reshape(2, 8, -1)
    assert (planned == before["joint_q"][:, None]).all()
    action = planner.act(wp.to_torch(env.observation))
    assert action.shape == (2, env.num_actions)
    assert action.abs().max() <= 1.0
    assert action.abs().max() > 0.0
    for name, array in env.changing_arrays().items():
        assert (array.numpy() == before[name]).all(), name


def test_objects_have_to_have_equal_shares():
    task = ReorientCfg(objects=("symmetric",), num_envs=3)
    with pytest.raises(ValueError, match="same number"):
        controller(ReorientEnv(task, "cpu"))
