"""An actor that sees late imitates what it was when it saw the present state."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from train_dummy import SMALL_PPO, DummyEnv, make_runner

from vd.policy.bundle import read_policy
from vd.train.checkpoint import find_checkpoint
from vd.train.cli import main
from vd.train.config import PolicyCfg
from vd.train.metrics import read_progress

NETWORK = PolicyCfg(
    hidden=(32, 32), distribution="state-dependent", initial_std=0.2, std_range=(0.05, 0.5)
)
IMITATING = replace(SMALL_PPO, imitation_iterations=60)


TURN = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]], np.float32)


class PromptEnv(DummyEnv):
    """The dummy in which a target circles a little in every step, and is seen at once."""

    fall_probability = 0.0
    reach = 0.02

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs, max_episode_steps=40)

    def _shown(self) -> np.ndarray:
        ones = np.ones((self.num_envs, 1), np.float32)
        return np.hstack([self._target, np.abs(self._target), ones])

    def _observe(self) -> None:
        self.observation.assign(self._shown())

    def step(self, action) -> None:
        """Move the target, then as the dummy."""
        self._target = self._target @ TURN.T
        super().step(action)


class LateEnv(PromptEnv):
    """The same seen a step late, but for new targets; the critic is told the present."""

    num_privileged = 6
    num_present = 5

    def _observe(self) -> None:
        now = self._shown()
        past = getattr(self, "_past", now)
        begins = np.abs(now - past)[:, :2].max(axis=1, keepdims=True) > 0.4
        self.observation.assign(np.where(begins, now, past))
        self.privileged.assign(np.hstack([np.zeros((self.num_envs, 1), np.float32), now]))
        self._past = now


@pytest.fixture(scope="module")
def taught(tmp_path_factory):
    """A policy that acts on the present target."""
    folder = tmp_path_factory.mktemp("teacher")
    runner = make_runner(folder, env=PromptEnv(num_envs=32), policy=NETWORK)
    runner.learn(60)
    return folder / "policy.safetensors"


def test_an_actor_that_sees_late_comes_to_what_its_teacher_does(taught, tmp_path):
    runner = make_runner(tmp_path, env=LateEnv(num_envs=32), policy=NETWORK, ppo=IMITATING)
    runner.begin_from(str(taught))
    assert runner.critic_warmup == 60 and runner.new_inputs == 6, "of the critic"

    frozen = {k: v.clone() for k, v in runner.imitation.teacher.state_dict().items()}
    runner.learn(60)
    losses = [row["loss/imitation"] for row in read_progress(tmp_path / "progress.jsonl")]
    assert losses[-1] < 0.4 * losses[0]
    seen, teacher = runner.env.get_observations(), read_policy(taught)
    with torch.no_grad():
        wanted = teacher.act(seen["privileged"][:, -5:])
        apart, unaware = (
            float((actions - wanted).square().mean())
            for actions in (runner.alg.actor(seen), teacher.act(seen["policy"]))
        )
    assert apart < 0.3 * unaware, (apart, unaware)
    for name, value in runner.imitation.teacher.state_dict().items():
        assert torch.equal(value, frozen[name]), name


def test_ppo_goes_on_from_there_with_its_own_rates_and_small_first_steps(taught, tmp_path):
    ppo = replace(IMITATING, imitation_iterations=10, actor_learning_rate=1e-4)
    runner = make_runner(tmp_path, env=LateEnv(num_envs=32), policy=NETWORK, ppo=ppo)
    runner.begin_from(str(taught))
    runner.learn(10)
    parameters = []

    def note(*_args) -> None:
        values = [value.detach().flatten() for value in runner.alg.actor.parameters()]
        parameters.append(torch.cat(values))

    runner.alg.optimizer.register_step_pre_hook(note)
    runner.learn(1)
    rows = read_progress(tmp_path / "progress.jsonl")
    assert [row["critic_warmup"] for row in rows[-2:]] == [0, 0]
    assert "loss/imitation" not in rows[-1] and rows[-1]["actor_learning_rate"] == 1e-4
    first = float((parameters[1] - parameters[0]).abs().mean()) / 1e-4
    # An Adam that knows no gradient yet moves every weight by the whole rate, so by 1.000. One that
    # knows how large they are: 0.13 to 0.45 for eight seeds.
    assert 0.0 < first < 0.7


def test_a_run_that_was_stopped_on_the_way_goes_on_imitating_the_same(taught, tmp_path):
    def runner(ppo=IMITATING):
        return make_runner(
            tmp_path, env=LateEnv(num_envs=32), policy=NETWORK, ppo=ppo, save_every=1
        )

    first = runner()
    first.begin_from(str(taught))
    first.learn(4)
    again = runner()
    again.load(str(find_checkpoint(tmp_path, "latest")))
    assert again.critic_warmup == 56 and again.imitation is not None
    for name, value in first.imitation.teacher.state_dict().items():
        assert torch.equal(value, again.imitation.teacher.state_dict()[name]), name
    again.learn(1)
    assert read_progress(tmp_path / "progress.jsonl")[-1]["loss/imitation"] > 0.0
    without = runner(replace(IMITATING, imitation_iterations=0))
    without.load(str(find_checkpoint(tmp_path, "latest")))
    assert without.imitation is None


def test_it_is_refused_without_a_policy_or_without_the_present(taught, tmp_path, capsys):
    flags = ["--ppo.imitation-iterations", "5", "--out", str(tmp_path / "run"), "--device", "cpu"]
    assert main(["teacher", "--preset", "gpu", *flags]) == 1
    assert (
        "--ppo.imitation-iterations imitates the policy that --init names"
        in capsys.readouterr().err
    )
    assert not (tmp_path / "run").exists()
    runner = make_runner(tmp_path, env=PromptEnv(num_envs=4), policy=NETWORK, ppo=IMITATING)
    with pytest.raises(
        ValueError, match=r"is told 0 of the present; give --env\.observation\.dynamics critic"
    ):
        runner.begin_from(str(taught))
