"""The demo from end to end, tiny, and what its page says about what it cannot know beforehand."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from vd.envs.cfg import ReorientCfg
from vd.evaluate.result import Episode, EvalResult, Protocol, summarise
from vd.train import demo, demo_agents, demo_page
from vd.train.presets import PRESETS

EPISODE_S = 0.5
"""Six control steps: a step takes as long with few worlds as with many."""


def result(agent: str, reached: int, episodes: int = 40) -> EvalResult:
    """An evaluation in which the first ``reached`` of ``episodes`` reached their goal."""
    unit = (0.0, 0.0, 0.0, 1.0)
    protocol = Protocol(agent, "cube", "dclaw4", episodes, 0, 1.0, 0.4, 10.0, 12.0, False)
    rows = tuple(
        Episode(0, unit, unit, 0.9, 0.3 if i < reached else 1.2, 60, i < reached, False)
        for i in range(episodes)
    )
    return summarise(protocol, ("cube",), [np.array([unit])], rows)


@pytest.fixture
def small(monkeypatch, tmp_path) -> demo.DemoCfg:
    """Settings under which every stage is short, with assets of its own."""
    monkeypatch.setenv("VD_ASSETS", str(tmp_path / "assets"))
    preset = PRESETS["cpu-demo"]()
    monkeypatch.setitem(
        PRESETS, "cpu-demo", lambda: replace(preset, env=replace(preset.env, episode_s=EPISODE_S))
    )
    monkeypatch.setitem(demo.EPISODES_RANGE, "cpu", (4, 4))
    monkeypatch.setitem(demo.PAPER_EPISODES, "cpu", 4)
    monkeypatch.setattr(demo, "LEAST_TRAINING_MIN", 5.0)
    monkeypatch.setattr(demo_agents, "VIDEO_SECONDS", 0.5)
    monkeypatch.setattr(demo_agents, "VIDEO_CELLS", 1)
    return demo.DemoCfg(
        out=tmp_path / "demo", minutes=1.0, objects=("cube",), preset="cpu-demo", num_worlds=4, max_steps=128
    )


@pytest.mark.slow
def test_demo_ends_with_a_page_and_repeats_nothing(small, tmp_path, capsys):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    trimesh.creation.cone(0.05, 0.12, sections=12).export(meshes / "cone.stl")
    small = replace(small, meshes=meshes)
    page = demo.run_demo(small)
    text = page.read_text()
    assert text.count("<video") == 1
    assert text.count("<img") >= 4  # comparison, learning, curves, contact sheet
    assert "task on purpose" in text  # what makes it easier is said
    for name in demo_page.NAMES.values():
        assert name in text
    (trained,) = small.out.rglob("trained.json")
    assert EvalResult.read(trained).object_names == ("cube", "cone")
    (policy,) = small.out.rglob("teacher/policy.pt")
    before = {path: path.stat().st_mtime_ns for path in policy.parents[1].rglob("*.pt")}
    output = capsys.readouterr().out
    assert [f"[{i}/{demo.STAGES}]" in output for i in range(1, demo.STAGES + 1)] == [True] * demo.STAGES
    assert "done before" not in output

    page.unlink()
    assert demo.run_demo(small) == page
    assert page.is_file()
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert capsys.readouterr().out.count("done before") == 4  # import, train, evaluate, video


def test_meshes_that_cannot_be_imported_end_the_demo_with_the_reason(small, tmp_path, capfd):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    (meshes / "empty.obj").write_text("# no vertices\n")
    with pytest.raises(demo.DemoError, match="none of the meshes"):
        demo.run_demo(replace(small, meshes=meshes))
    assert "empty.obj" in "".join(capfd.readouterr())


def test_other_meshes_seeds_and_objects_get_their_own_folder(tmp_path):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    (meshes / "a.obj").write_text("o a\n")
    base = demo.DemoCfg(out=tmp_path)
    labels = [
        demo._label(cfg, "cpu-demo")
        for cfg in (base, replace(base, seed=1), replace(base, objects=("cuboid",)))
    ]
    labels.append(demo._label(replace(base, meshes=meshes), "cpu-demo"))
    (meshes / "b.obj").write_text("o b\n")
    labels.append(demo._label(replace(base, meshes=meshes), "cpu-demo"))
    assert len(set(labels)) == len(labels)
    # More time is no other demo: what is finished stays.
    assert demo._label(replace(base, minutes=30.0), "cpu-demo") == labels[0]


@pytest.mark.parametrize(
    ("changes", "flag"),
    [
        ({"minutes": 0.0}, "--minutes"),
        ({"meshes": "nowhere"}, "--meshes"),
        ({"objects": ()}, "--objects"),
        ({"num_worlds": 0}, "--num-worlds"),
    ],
)
def test_wrong_settings_are_refused_by_flag(tmp_path, changes, flag):
    if "meshes" in changes:
        changes = {"meshes": tmp_path / "nowhere"}
    with pytest.raises(ValueError, match=flag):
        demo.DemoCfg(out=tmp_path, **changes).validate()


def test_a_stage_that_fails_is_run_again(tmp_path, capsys):
    product = tmp_path / "product"
    stages = demo._Stages(tmp_path / "stages.json")
    with pytest.raises(RuntimeError), stages.run("work", "work", products=[product]) as needed:
        assert needed
        product.write_text("half")
        raise RuntimeError
    stages.load()
    with stages.run("work", "work", products=[product]) as needed:
        assert needed
    again = demo._Stages(tmp_path / "stages.json")
    again.load()
    with again.run("work", "work", products=[product]) as needed:
        assert not needed
    product.unlink()
    with again.run("work", "work", products=[product]) as needed:
        assert needed
    assert capsys.readouterr().out.count("done before") == 1


def test_the_page_says_what_makes_the_task_easier():
    task = PRESETS["cpu-demo"]().env
    text = " ".join(demo_page.task_sentences(task))
    assert f"vertical only, by up to {task.goal.max_angle_rad:.2g} rad" in text
    assert "must not be compared" in text
    assert "easier" not in " ".join(demo_page.task_sentences(ReorientCfg()))


def test_the_page_lists_exactly_the_settings_that_differ():
    task = replace(ReorientCfg(), num_worlds=7, seed=3, reward=replace(ReorientCfg().reward, energy=-0.5))
    assert list(demo_page.differences(task)) == [("reward.energy", "-20", "-0.5")]


@pytest.mark.parametrize(
    ("trained", "random", "words"),
    [(36, 4, "better than random"), (12, 10, "do not settle"), (4, 12, "not better")],
)
def test_the_verdict_follows_the_intervals(trained, random, words):
    agents = {"trained": result("trained", trained), "random": result("random", random)}
    assert words in demo_page.verdict(agents)
