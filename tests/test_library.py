"""What programs build on.

The stable names, the examples, and own terms of reward and observation.
"""

import re
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp

import vd
from vd.envs.cfg import ObservationCfg, RandomisationCfg, ReorientCfg, RewardCfg
from vd.evaluate.result import RESULT_FORMAT
from vd.train.cli import main
from vd.train.metrics import PROGRESS_FILE, read_progress

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture
def beside_examples(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.chdir(tmp_path)


def test_the_package_loads_no_name_before_it_is_used():
    code = "import sys, vd; print({'torch', 'warp', 'numpy', 'tyro'} & set(sys.modules), dir(vd))"
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert said.startswith("set()") and all(f"'{name}'" in said for name in vd.__all__)
    stub = Path(vd.__file__).with_suffix(".pyi").read_text()  # for editors and type checkers
    assert set(re.findall(r'"(\w+)",', stub)) == set(vd.__all__)
    assert len(vd.__all__) == 11 and all(getattr(vd, name).__doc__ for name in vd.__all__)


@pytest.mark.slow
@pytest.mark.parametrize("example", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_examples_are_short_and_run(example, beside_examples, capsys):
    assert len(example.read_text().splitlines()) < 40
    runpy.run_path(str(example), run_name="__main__")
    assert capsys.readouterr().out


def test_own_terms_pay_and_show_what_they_say_and_change_nothing_else(beside_examples):
    seen = ObservationCfg(shape="full", view="goal", dynamics="critic")
    cfg = ReorientCfg(hand="dclaw3", num_envs=3, observation=seen, reward=RewardCfg(scale=0.5))
    seen = replace(seen, terms={"own_terms:height": 1}, critic_terms={"own_terms:quiet": 1})
    own = replace(
        cfg, observation=seen, reward=replace(cfg.reward, terms={"own_terms:quiet": -0.1})
    )
    plain, env = vd.ReorientEnv(cfg, "cpu"), vd.ReorientEnv(own, "cpu")
    width, rng = plain.num_observations, np.random.default_rng(0)
    for _ in range(4):
        action = wp.array(rng.uniform(-1.0, 1.0, (3, 9)), dtype=float, device="cpu")
        plain.step(action)
        env.step(action)
        assert np.array_equal(env.observation.numpy()[:, :width], plain.observation.numpy())
        assert np.array_equal(env.privileged.numpy()[:, :-1], plain.privileged.numpy())
        speeds = np.square(plain.measured_qd.numpy()[:, :9]).sum(axis=1)
        np.testing.assert_allclose(env.reward_terms.numpy()[:, -1], -0.1 * speeds, rtol=1e-5)
        np.testing.assert_allclose(
            env.reward.numpy(), plain.reward.numpy() - 0.05 * speeds, rtol=1e-4
        )
        np.testing.assert_array_equal(env.observation.numpy()[:, width], env.object_pose()[:, 2])
        np.testing.assert_allclose(env.privileged.numpy()[:, -1], speeds, rtol=1e-5)


def test_the_layout_says_where_each_value_of_an_observation_is():
    seen = ObservationCfg(shape="full", dynamics="critic", canonical=True)
    quiet = RandomisationCfg(enabled=False)  # or what is observed is noisy, and late
    cfg = ReorientCfg(hand="dclaw3", num_envs=2, observation=seen, randomisation=quiet)
    layout, env = vd.observation_layout(cfg), vd.ReorientEnv(cfg, "cpu")
    env.step(wp.zeros((2, 9), dtype=float, device="cpu"))
    values = np.hstack([env.observation.numpy(), env.privileged.numpy()])
    ends = [columns.stop for columns in layout.values()]
    assert [columns.start for columns in layout.values()] == [0, *ends[:-1]]
    assert ends[-1] == values.shape[1]
    actor = [name for name in layout if not name.startswith("critic/")]
    assert layout[actor[-1]].stop == env.num_observations
    pose = env.object_pose()
    np.testing.assert_allclose(values[:, layout["object_position"]], pose[:, :3], atol=1e-6)
    orientation = values[:, layout["object_orientation"]]
    np.testing.assert_allclose(np.abs((orientation * pose[:, 3:]).sum(axis=1)), 1.0, atol=1e-5)
    present = values[:, layout["critic/present"]]
    assert present.shape[1] == layout["goal_extent"].stop
    assert list(vd.observation_layout(replace(cfg, observation=ObservationCfg()))) == actor[:10]


def test_a_term_that_is_none_or_gives_what_cannot_be_is_named(beside_examples, monkeypatch):
    given = [torch.zeros(2)]
    monkeypatch.setattr("own_terms.height", lambda env: given[0])

    def observing(name: str) -> vd.ReorientEnv:
        return vd.ReorientEnv(
            ReorientCfg(num_envs=2, observation=ObservationCfg(terms={name: 1})), "cpu"
        )

    for name in ("own_terms:loud", "own:quiet"):
        with pytest.raises(ValueError, match=f"'{name}' .*module:function"):
            observing(name)
    env = observing("own_terms:height")
    given[0] = torch.full((2,), torch.nan)
    with pytest.raises(ValueError, match=r"own_terms:height .*not finite"):
        env.renew()
    with pytest.raises(ValueError, match=r"own_terms:height .*not finite"):
        env.check()
    given[0] = torch.zeros(2, 2)
    with pytest.raises(ValueError, match=r"own_terms:height .*\(2, 2\)"):
        env.renew()
    given.clear()
    with pytest.raises(ValueError, match=r"own_terms:height .*IndexError"):
        env.renew()


def test_what_is_no_file_of_ours_is_refused_with_file_and_remedy(tmp_path):
    path = tmp_path / "odd"
    with pytest.raises(FileNotFoundError, match=f"there is no {path}"):
        vd.read(path)
    for text in (b"", b"[]", b"\xff", b"{}", b'{"format": "visual-dexterity policies 1"}'):
        path.write_bytes(text)
        with pytest.raises(ValueError, match=f"{path} .*format.*folder of a recording"):
            vd.read(path)
    path.write_text(f'{{"format": "{RESULT_FORMAT}"}}')
    with pytest.raises(ValueError, match=f"{path}.*run vd-eval again"):
        vd.read(path)
    path.unlink()
    path.mkdir()
    good = {
        "run.json": '{"format": "vd-hand-log/1", "joints": [], "goals": []}',
        "steps.csv": "t\n1\n",
    }
    for name, text in (
        ("events.jsonl", "{\n"),
        ("steps.csv", "t,a\n1,2\n3,4,5\n"),
        ("run.json", "{"),
    ):
        for file, written in {**good, name: text}.items():
            (path / file).write_text(written)
        with pytest.raises(ValueError, match=f"{path / name} is damaged .*copy the whole"):
            vd.read(path)
    path = tmp_path / "a.pt"
    torch.save(torch.nn.Linear(1, 1), path)
    with pytest.raises(ValueError, match=r"more than weights, .*again") as said:
        vd.load_policy(path, device="cpu")
    assert "weights_only" not in str(said.value)


@pytest.mark.slow
def test_the_tutorials_run_logs_its_terms_and_its_policy_knows_them(
    beside_examples, tmp_path, capsys
):
    terms = "--env.reward.terms own_terms:quiet -0.1 --env.observation.terms own_terms:height 1"
    flags = ["--smoke", "--num-envs", "4", "--max-steps", "64", *terms.split()]
    assert main(["teacher", "--out", "run", *flags]) == 0
    assert read_progress(Path("run") / PROGRESS_FILE)[-1]["reward/own_terms:quiet"] < 0.0
    policy = vd.load_policy("run", device="cpu")
    assert policy.task["reward"]["terms"] == {"own_terms:quiet": -0.1}
    result = vd.evaluate_policies(
        "run", episodes=1, episode_s=0.5, device="cpu", out=tmp_path / "eval"
    )
    assert result.rows[0].overall.episodes == 1
    assert main(["tracker", "run", "--objects", "cube", "--out", "vision.safetensors"]) == 1
    assert "own_terms:height" in capsys.readouterr().err
