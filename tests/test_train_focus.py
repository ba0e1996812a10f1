"""More worlds for the objects that fail: how they are counted, where the rates come from, what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vd.config import to_dict
from vd.envs.cfg import FocusCfg, RandomisationCfg, ReorientCfg
from vd.envs.objects import object_weights
from vd.envs.reorient import ReorientEnv
from vd.evaluate.result import Episode, Protocol, summarise
from vd.policy import load_policy
from vd.sim.scene import assign_objects
from vd.train.cli import CONFIG_NAME, main, parse_teacher
from vd.train.focus import read_success, worlds_text

NAMES = ("cube", "cuboid")
"""Objects of the set ``symmetric``."""
IDENTITY = (0.0, 0.0, 0.0, 1.0)
PROTOCOL = Protocol(
    policy="some.pt",
    objects="symmetric",
    hand="dclaw3",
    episodes=4,
    seed=1,
    max_goal_angle_rad=3.1,
    stop_tolerance_rad=0.4,
    episode_s=10.0,
    control_hz=12.0,
    randomised=False,
)


def _evaluation(rates: dict[str, float]):
    """An evaluation of four episodes of each object, of which these shares succeed."""
    episodes = tuple(
        Episode(
            object_index=index,
            start_quat=IDENTITY,
            goal_quat=IDENTITY,
            start_error_rad=1.0,
            error_rad=0.2 if number < round(4 * rate) else 2.0,
            exact_error_rad=0.2 if number < round(4 * rate) else 2.0,
            steps=100,
            stopped=number < round(4 * rate),
            fell=False,
        )
        for index, rate in enumerate(rates.values())
        for number in range(4)
    )
    return summarise(PROTOCOL, tuple(rates), episodes)


@given(weights=st.lists(st.floats(0.001, 1000.0), min_size=1, max_size=12), spare=st.integers(0, 200))
def test_worlds_are_shared_out_by_weight_and_every_object_has_one(weights, spare):
    n, k = len(weights) + spare, len(weights)
    worlds = assign_objects(n, k, weights)
    counts = np.bincount(worlds, minlength=k)
    assert len(worlds) == n and (np.diff(worlds) >= 0).all(), "one block of worlds for each object"
    wanted = 1.0 + spare * np.array(weights) / sum(weights)
    assert (np.abs(counts - wanted) < 1.0 + 1e-6).all() and counts.min() >= 1
    heavier = np.argsort(weights, kind="stable")
    assert (np.diff(counts[heavier]) >= -1).all()
    assert np.array_equal(worlds, assign_objects(n, k, weights))


@given(k=st.integers(1, 9), spare=st.integers(0, 50))
def test_equal_weights_give_what_no_weights_give(k, spare):
    even, weighted = (np.bincount(assign_objects(k + spare, k, w), minlength=k) for w in (None, [2.0] * k))
    assert sorted(even) == sorted(weighted)


def test_weights_are_an_even_part_and_a_part_by_failure():
    focus = FocusCfg(success={"a": 1.0, "b": 0.5, "c": 0.0, "of another set": 0.0}, share=0.6)
    weights = object_weights(["a", "b", "c"], focus)
    assert weights == pytest.approx([0.4 / 3, 0.4 / 3 + 0.2, 0.4 / 3 + 0.4])
    assert object_weights(["a"], focus) is None, "nothing fails"
    assert object_weights(["a", "b"], FocusCfg()) is None
    assert object_weights(["a", "b"], replace(focus, share=0.0)) is None


def test_an_object_without_a_rate_is_named():
    with pytest.raises(ValueError, match=r"no rate of 2 of the 3 objects \(b, c\)"):
        object_weights(["a", "b", "c"], FocusCfg(success={"a": 0.5}))


@pytest.mark.parametrize(
    ("focus", "message"),
    [
        (FocusCfg(share=1.0), r"focus\.share is 1;.*every object keeps some"),
        (FocusCfg(share=-0.1), r"focus\.share is -0\.1"),
        (FocusCfg(success={"cube": 87.0}), "focus.success of cube is 87"),
    ],
)
def test_settings_that_cannot_work_are_refused(focus, message):
    with pytest.raises(ValueError, match=message):
        ReorientCfg(focus=focus).validate()


def test_rates_are_read_from_an_evaluation_and_from_the_groups_of_a_comparison(tmp_path):
    one, other = _evaluation({"cube": 0.25, "cuboid": 1.0}), _evaluation({"duck": 0.5})
    one.write(tmp_path / "eval.json")
    assert read_success(tmp_path / "eval.json") == {"cube": 0.25, "cuboid": 1.0}
    both = tmp_path / "both.json"
    both.write_text(json.dumps({"rows": [{"result": to_dict(one)}, {"result": to_dict(other)}]}))
    assert read_success(both) == {"cube": 0.25, "cuboid": 1.0, "duck": 0.5}
    twice = tmp_path / "twice.json"
    twice.write_text(json.dumps({"rows": [{"result": to_dict(one)}, {"result": to_dict(one)}]}))
    with pytest.raises(ValueError, match="more than one rate of cube; evaluate one teacher"):
        read_success(twice)


@pytest.mark.parametrize(
    "text", ["", "no json", "[1]", "{}", '{"rows": [{}]}', '{"per_object": [{"name": "a"}]}']
)
def test_what_is_no_evaluation_is_refused(tmp_path, text, capsys):
    path = tmp_path / "eval.json"
    path.write_text(text)
    assert main(["teacher", "--smoke", "--run-dir", str(tmp_path / "run"), "--focus-on", str(path)]) == 1
    assert f"{path} is no evaluation" in capsys.readouterr().err
    path.unlink()
    assert main(["teacher", "--smoke", "--run-dir", str(tmp_path / "run"), "--focus-on", str(path)]) == 1
    assert f"no file {path}" in capsys.readouterr().err


def test_the_words_name_the_objects_with_most_worlds():
    assert worlds_text(NAMES, np.array([0, 1, 1, 1])) == (
        "worlds of an object: 1 at least, 2 in the mean; most: cuboid 3, cube 1"
    )


def _worlds(share: float) -> ReorientEnv:
    focus = FocusCfg(success={"cube": 1.0, "cuboid": 0.0}, share=share)
    still = RandomisationCfg(enabled=False)
    cfg = ReorientCfg(hand="dclaw3", objects=("symmetric",), num_worlds=10, randomisation=still, focus=focus)
    return ReorientEnv(cfg, "cpu")


def test_worlds_hold_the_objects_that_fail_and_no_other_worlds_are_restored_into_them():
    env = _worlds(share=0.5)
    held = [env.objects[index].name for index in env.world_object]
    assert held == ["cube"] * 3 + ["cuboid"] * 7
    again = _worlds(share=0.5)
    again.load_state_dict(env.state_dict())
    assert np.array_equal(again.observation.numpy(), env.observation.numpy())
    with pytest.raises(ValueError, match="hold other objects; resume with objects and focus"):
        _worlds(share=0.0).load_state_dict(env.state_dict())


def test_a_run_keeps_the_rates_and_its_policies_do_not(tmp_path, capsys):
    evaluation, run = tmp_path / "eval.json", tmp_path / "run"
    _evaluation({"cube": 0.75, "cuboid": 0.0}).write(evaluation)
    flags = ["--smoke", "--objects", "symmetric", "--num-worlds", "16", "--run-dir", str(run)]
    focus = ["--focus-on", str(evaluation), "--env.focus.share", "0.8"]
    assert main(["teacher", *flags, *focus, "--max-steps", "256"]) == 0
    assert "most: cuboid 11, cube 5" in capsys.readouterr().out
    saved = json.loads((run / CONFIG_NAME).read_text())
    assert saved["focus_on"] is None
    assert saved["env"]["focus"] == {"success": {"cube": 0.75, "cuboid": 0.0}, "share": 0.8}
    assert load_policy(run / "policy.pt").task["focus"] == to_dict(FocusCfg())

    evaluation.unlink()
    assert parse_teacher(["--resume", "--run-dir", str(run)]).env.focus.success == {
        "cube": 0.75,
        "cuboid": 0.0,
    }
    assert main(["teacher", "--resume", "--run-dir", str(run), "--max-steps", "512"]) == 0
    said = capsys.readouterr().out
    assert "most: cuboid 11, cube 5" in said and "episodes start anew" not in said
