"""Beginning a run from an exported policy.

What is taken over, what the critic learns, what is refused.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from train_dummy import SMALL_POLICY, SMALL_PPO, DummyEnv, make_runner

from vd.command.config import to_dict
from vd.envs.cfg import ReorientCfg
from vd.envs.curriculum import Levels
from vd.policy.agents import SHIPPED_POLICIES
from vd.policy.bundle import read_contract, read_policy, write_policy
from vd.train import begin
from vd.train.begin import CRITIC_WARMUP, MOMENTS_WARMUP, find_start
from vd.train.checkpoint import BEST_NAME, find_checkpoint
from vd.train.cli import main
from vd.train.flags import parse_teacher
from vd.train.metrics import read_progress
from vd.train.presets import PRESETS

NORMALISING = replace(SMALL_POLICY, normalise_observations=True)
LEARNED = replace(SMALL_PPO, minibatch_size=128)


def _export(folder: Path, *, critic: bool = True, learner: bool = True) -> Path:
    """A policy of a short run on the dummy, and one that says less of its training."""
    runner = make_runner(folder, policy=NORMALISING, ppo=LEARNED)
    runner.learn(3)
    policy = read_policy(find_checkpoint(folder, "latest"))
    if not critic:
        policy.critic = {}
    path = folder / "exported.safetensors"
    kept = {} if learner else {"learner": {}, "stage": {}}
    write_policy(policy, path, replace(policy.contract, **kept))
    return path


def _changed(path: Path, **changes) -> None:
    """Say other things in a policy's contract."""
    policy = read_policy(path)
    write_policy(policy, path, replace(policy.contract, **changes))


def _begun(folder: Path, policy: Path, **options):
    ppo = replace(LEARNED, **options)
    runner = make_runner(
        folder, env=DummyEnv(num_envs=16, seed=7), seed=7, policy=NORMALISING, ppo=ppo
    )
    runner.begin_from(str(policy))
    return runner


def _state(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: tensor.clone() for name, tensor in module.state_dict().items()}


def _same(one: dict[str, torch.Tensor], two: dict[str, torch.Tensor]) -> list[str]:
    return [name for name in one if torch.equal(one[name], two[name])]


@pytest.mark.parametrize(("critic", "warmup"), [(False, CRITIC_WARMUP), (True, MOMENTS_WARMUP)])
def test_a_run_begun_from_a_policy_acts_as_it_and_says_how_long_the_critic_learns_alone(
    tmp_path, critic, warmup
):
    path = _export(tmp_path / "first", critic=critic)
    runner = _begun(tmp_path / "second", path)
    assert runner.critic_warmup == warmup
    assert runner.iteration == 3 and runner.env_steps == 3 * 128
    observation = runner.env.get_observations()
    with torch.no_grad():
        assert torch.allclose(
            runner.alg.actor(observation), read_policy(path).act(observation["policy"]), atol=1e-6
        )
    actor, learned = _state(runner.alg.actor), read_policy(path).weights
    assert _same(actor, learned) == list(actor), "its normaliser and its std belong to it"
    assert runner.env.env.levels.goals == pytest.approx(0.03)
    assert not runner.alg.optimizer.state_dict()["state"], "moments would be another network's"
    values = _state(runner.alg.critic)
    if critic:
        assert _same(values, read_policy(path).critic) == list(values)
    else:
        normaliser = [name for name in values if name.startswith("obs_normalizer")]
        assert normaliser and set(_same(values, actor)) >= set(normaliser), (
            "both read the same observations"
        )


@pytest.mark.parametrize("schedule", ["fixed", "adaptive"])
def test_only_the_critic_learns_while_it_warms_up(tmp_path, monkeypatch, schedule):
    monkeypatch.setattr(begin, "CRITIC_WARMUP", 2)
    path = _export(tmp_path / "first", critic=False)
    runner = _begun(tmp_path / "second", path, schedule=schedule)
    actor, critic, rate = (
        _state(runner.alg.actor),
        _state(runner.alg.critic),
        runner.alg.learning_rate,
    )
    runner.learn(2)
    assert _same(actor, _state(runner.alg.actor)) == list(actor)
    assert not _same(critic, _state(runner.alg.critic))
    assert runner.alg.learning_rate == rate == runner.alg.optimizer.param_groups[0]["lr"]
    moments = runner.alg.optimizer.state_dict()["state"]
    assert all(moment["exp_avg_sq"].abs().max() > 0.0 for moment in moments.values()), (
        "the actor's too"
    )
    runner.learn(1)
    assert runner.critic_warmup == 0
    assert _same(actor, _state(runner.alg.actor)) == [], "afterwards both learn"
    assert [
        row["critic_warmup"] for row in read_progress(tmp_path / "second" / "progress.jsonl")
    ] == [
        1,
        0,
        0,
    ]


@pytest.mark.parametrize("asked", [None, (0.5, 0.0, 1.0, 1.0)])
def test_a_policy_that_does_not_say_how_far_it_came_has_come_to_the_end(tmp_path, asked):
    path = _export(tmp_path / "first", learner=False)
    env = DummyEnv(num_envs=16)
    runner = make_runner(tmp_path / "second", env=env, policy=NORMALISING)
    runner.begin_from(str(path), asked)
    assert env.levels == (Levels() if asked is None else Levels(*asked))
    with pytest.raises(ValueError, match=r"--init-levels is 1\.5 0 1 1"):
        runner.begin_from(str(path), (1.5, 0.0, 1.0, 1.0))


class Seeing(DummyEnv):
    """The dummy with two values more for its actor."""

    num_observations = 7

    def _observe(self) -> None:
        more = np.ones((self.num_envs, 2), dtype=np.float32)
        self.observation.assign(np.hstack([self._target, np.abs(self._target), more, more[:, :1]]))


def test_what_does_not_fit_is_named_with_the_flag_that_would(tmp_path):
    path = _export(tmp_path / "first")
    for policy, message in (
        (
            replace(NORMALISING, hidden=(8,)),
            r"has --policy\.hidden \(16, 16\), and this run \(8,\)",
        ),
        (
            replace(NORMALISING, distribution="gaussian"),
            r"has --policy\.distribution state-dependent",
        ),
        (SMALL_POLICY, r"has --policy\.normalise-observations True.*leave --preset out"),
    ):
        runner = make_runner(tmp_path / "other", policy=policy)
        with pytest.raises(ValueError, match=message):
            runner.begin_from(str(path))

    class Larger(DummyEnv):
        num_actions = 3

        def _observe(self) -> None: ...

    runner = make_runner(tmp_path / "hand", env=Larger(num_envs=4), policy=NORMALISING)
    with pytest.raises(ValueError, match=r"2 joints of dummy.* 3"):
        runner.begin_from(str(path))
    make_runner(tmp_path / "more", env=Seeing(num_envs=16), policy=NORMALISING).learn(1)
    path = tmp_path / "more" / "policy.safetensors"
    runner = make_runner(tmp_path / "less", policy=NORMALISING)
    with pytest.raises(ValueError, match=r"7 values .* 5: .*--preset"):
        runner.begin_from(str(path))


class Telling(DummyEnv):
    """The dummy with two values more for its critic: twice the target."""

    num_privileged = 2

    def _observe(self) -> None:
        super()._observe()
        self.privileged.assign(2.0 * self._target)


def test_a_critic_that_is_told_more_begins_anew_and_learns_alone_first(tmp_path):
    path = _export(tmp_path / "first")
    runner = make_runner(
        tmp_path / "told", env=Telling(num_envs=16), policy=NORMALISING, ppo=LEARNED
    )
    runner.begin_from(str(path))
    assert runner.critic_warmup == CRITIC_WARMUP and runner.num_observations == 5
    observation, plain = runner.env.get_observations(), read_policy(path)
    with torch.no_grad():
        actions = runner.alg.actor(observation)
    assert torch.allclose(actions, plain.act(observation["policy"]), atol=1e-6)
    runner.learn(1)
    again = make_runner(
        tmp_path / "told", env=Telling(num_envs=16), policy=NORMALISING, ppo=LEARNED
    )
    again.load(str(find_checkpoint(tmp_path / "told", "latest")))
    assert _same(_state(runner.alg.critic), _state(again.alg.critic)) == list(
        _state(again.alg.critic)
    )


def test_names_files_and_folders_are_found_and_students_refused(tmp_path, capsys):
    assert find_start("dclaw3") == SHIPPED_POLICIES["dclaw3"]
    make_runner(tmp_path).learn(1)
    assert find_start(str(tmp_path)) == tmp_path / "checkpoints" / BEST_NAME, "it has the optimiser"
    assert find_start(str(tmp_path / "policy.safetensors")) == tmp_path / "policy.safetensors"
    with pytest.raises(FileNotFoundError, match=r"--init: .*dclaw3"):
        find_start(str(tmp_path / "none"))
    start = [
        "--preset",
        "gpu",
        "--init",
        str(tmp_path / "no.pt"),
        "--env.observation.shape",
        "full",
    ]
    cfg = parse_teacher([*start, "--out", str(tmp_path / "run"), "--resume", "auto"])
    assert cfg.env.observation.shape == "full" and cfg.ppo == PRESETS["gpu"]().ppo
    assert main(["teacher", *start, "--out", str(tmp_path / "run")]) == 1
    assert "--init: no policy" in capsys.readouterr().err
    assert main(["teacher", "--init", "dclaw3-vision", "--out", str(tmp_path / "run")]) == 1
    assert "teacher, dclaw3" in capsys.readouterr().err
    assert (
        main(["teacher", "--init-levels", "1", "0", "1", "1", "--out", str(tmp_path / "run")]) == 1
    )
    assert "--init-levels says" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["dclaw3", "dclaw4"])
def test_without_a_preset_task_and_networks_are_those_of_the_policy(name):
    drawn = ["--env.randomisation.effects", "dead_zone.width_rad", "0", "0.1"]
    cfg = parse_teacher(["--init", name, "--objects", "cube", "--num-envs", "8", *drawn])
    network = read_contract(SHIPPED_POLICIES[name]).network
    assert cfg.env.objects == ("cube",) and cfg.env.num_envs == 8
    trained = ReorientCfg.of(read_policy(SHIPPED_POLICIES[name]))
    drawn = replace(trained.randomisation, effects={"dead_zone.width_rad": (0, 0.1)})
    curriculum = PRESETS["gpu"]().env.curriculum  # of a training, not of a policy
    if trained.table.lift_share == 0.0:
        curriculum = replace(curriculum, object_weight=1.0)
    cfg.env.validate()  # or such a run would not begin
    trained = replace(trained, randomisation=drawn, curriculum=curriculum)
    assert replace(cfg.env, objects=trained.objects, num_envs=trained.num_envs) == trained
    for field in ("hidden", "distribution", "normalise_observations"):
        assert getattr(cfg.policy, field) == getattr(network, field)
    assert parse_teacher(["--init", name, "--preset", "gpu"]).env == PRESETS["gpu"]().env


def test_without_a_preset_the_learner_is_the_policys_if_it_says(tmp_path):
    path, task = _export(tmp_path / "first"), to_dict(PRESETS["gpu"]().env)
    _changed(path, task=task)
    cfg = parse_teacher(["--init", str(path)])
    assert cfg.ppo == LEARNED and cfg.policy == NORMALISING and cfg.env == PRESETS["gpu"]().env
    _changed(path, learner={"ppo": {"wind": 3.0}, "policy": {}})
    with pytest.raises(ValueError, match=r"no field wind.*--preset"):
        parse_teacher(["--init", str(path)])
