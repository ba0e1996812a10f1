"""The demo from end to end, tiny, and what its page says about what it cannot know beforehand."""

import json
import re
import time
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh
from test_demo_deploy import made_up_flights
from test_demo_student import student_rows
from test_gap_report import sample_curves, sample_report

from vd.assets_usd.objects import importer
from vd.envs.cfg import ReorientCfg
from vd.evaluate.agents import SHIPPED_POLICIES
from vd.evaluate.result import Episode, EvalResult, Protocol, summarise
from vd.gap.report import write_report
from vd.train import cli, demo, demo_agents, demo_page
from vd.train.demo_gap import ANALYSIS
from vd.train.demo_stages import Budget, Stages, TimeUp, time_limit
from vd.train.demo_student import student_files
from vd.train.metrics import PROGRESS_FILE
from vd.train.presets import PRESETS

EPISODE_S = 0.5
"""Six control steps: a step takes as long with few worlds as with many."""


def result(agent: str, reached: int, episodes: int = 40) -> EvalResult:
    """An evaluation in which the first ``reached`` of ``episodes`` reached their goal."""
    unit = (0.0, 0.0, 0.0, 1.0)
    protocol = Protocol(agent, "cube", "dclaw4", episodes, 0, 1.0, 0.4, 10.0, 12.0, False)
    rows = tuple(
        Episode(0, unit, unit, 0.9, *2 * (0.3 if i < reached else 1.2,), 60, i < reached, False)
        for i in range(episodes)
    )
    return summarise(protocol, ("cube",), rows)


class Clock:
    """A clock that moves only when told to."""

    now = 0.0

    def __call__(self) -> float:
        """What it says [s]."""
        return self.now


def stages_in(folder: Path, minutes: float = 1.0, clock: Clock | None = None) -> Stages:
    clock = clock or Clock()
    return Stages(folder / "stages.json", 1, Budget(minutes, clock, clock()))


def made_up_gap(folder: Path, _seed: int, _device: str) -> None:
    """The report of a gap that was never looked for; tests/test_demo_gap.py looks for one."""
    curves = sample_curves()
    write_report(sample_report(curves), curves, folder / ANALYSIS)


def made_up_students(folder: Path, _seed: int, *, minutes: float) -> None:
    """Runs of students that never were; tests/test_demo_student.py trains some."""
    assert minutes > 0.0
    for path, rows in zip(student_files(folder), (student_rows(0.1), student_rows(0.4)), strict=True):
        path.parent.mkdir(parents=True)
        path.touch()
        lines = [json.dumps(row) for row in rows]
        (path.parent / PROGRESS_FILE).write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def assets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that the first demo fills."""
    return tmp_path_factory.mktemp("assets")


@pytest.fixture
def small(monkeypatch, tmp_path, assets) -> demo.DemoCfg:
    """Settings under which every stage is short, with assets of its own."""
    monkeypatch.setenv("VD_ASSETS", str(assets))
    preset = PRESETS["cpu-demo"]()
    env = replace(preset.env, episode_s=EPISODE_S, start=replace(preset.env.start, poses=1))
    monkeypatch.setitem(PRESETS, "cpu-demo", lambda: replace(preset, env=env))
    monkeypatch.setitem(demo.EPISODES_RANGE, "cpu", (4, 4))
    monkeypatch.setitem(demo.PAPER_EPISODES, "cpu", 4)
    monkeypatch.setitem(demo.MESH_EPISODES, "cpu", 4)
    monkeypatch.setattr(demo_agents, "VIDEO_SECONDS", 0.5)
    monkeypatch.setattr(demo_agents, "VIDEO_CELLS", 1)
    monkeypatch.setattr(demo, "find_hidden_gap", made_up_gap)
    monkeypatch.setattr(demo, "train_students", made_up_students)
    monkeypatch.setattr(demo, "fly_twins", made_up_flights)
    return demo.DemoCfg(
        out=tmp_path / "demo", minutes=20.0, objects=("cube",), preset="cpu-demo", num_worlds=4, max_steps=128
    )


@pytest.fixture
def cone(tmp_path) -> Path:
    """A folder with one mesh."""
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    trimesh.creation.cone(0.05, 0.12, sections=12).export(meshes / "cone.stl")
    return meshes


@pytest.mark.slow
def test_demo_ends_with_a_page_and_repeats_nothing(small, cone, capsys):
    small = replace(small, meshes=cone)
    page = demo.run_demo(small)
    text = page.read_text()
    assert text.count("<video") == 4  # its own objects, imported ones, both twins
    assert text.count("<img") >= 5  # comparison, learning, curves, contact sheet, student
    assert "lacks command delay" in text
    assert "begins to imitate" in text and "0.45 on held-out episodes" in text
    (link,) = re.findall(r'<a href="([^"]+)"', text)
    assert (page.parent / link).is_file()
    assert "task on purpose" in text  # what makes it easier is said
    assert "not trained" in text and "no time" not in text
    for name in demo_page.NAMES.values():
        assert text.count(name) >= 2  # on its own objects and on imported ones
    (folder,) = (path.parent for path in small.out.rglob("stages.json"))
    assert EvalResult.read(folder / "trained.json").object_names == ("cube",)
    assert EvalResult.read(folder / "imported" / "zero.json").object_names == ("cone",)
    judged = EvalResult.read(folder / "evaluation" / "eval.json")
    assert "cone" in judged.object_names
    assert judged.protocol.policy in SHIPPED_POLICIES and not judged.protocol.at_rest
    assert f"are of {judged.protocol.policy}" in text
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*.pt")}
    output = capsys.readouterr().out
    total = demo.STAGES + 1 + demo.MESH_STAGES
    assert all(f"[{number}/{total}, " in output for number in range(1, total + 1))
    assert "done before" not in output

    page.unlink()
    assert demo.run_demo(small) == page
    assert page.is_file()
    assert {path: path.stat().st_mtime_ns for path in before} == before
    # Import, objects, gap, training, comparison, video, both again with meshes, student, twins, evaluation.
    assert capsys.readouterr().out.count("done before") == total - 2


@pytest.mark.slow
def test_a_used_up_budget_still_ends_with_a_page_that_says_what_is_missing(small, cone, monkeypatch, capsys):
    compare = demo._Demo.compare

    def late(self):  # the time is over just after the comparison
        agents = compare(self)
        monkeypatch.setattr(demo, "PAGE_MIN", 10.0)
        return agents

    monkeypatch.setattr(demo._Demo, "compare", late)
    monkeypatch.setattr(demo, "IMPORT_SHARE", 0.0)
    page = demo.run_demo(replace(small, minutes=10.0, meshes=cone))
    text, output = page.read_text(), capsys.readouterr().out
    assert "<video" not in text
    for name in demo_page.NAMES.values():
        assert name in text
    for command in ("vd-assets import", "vd-play", "vd-eval"):
        assert f"by hand: {command}" in output
        assert command in text.partition("Left out")[2]
    assert "cone.stl" in text
    assert "[11/11, " in output  # nothing is announced for meshes that are not there


def test_a_machine_too_slow_for_the_comparison_ends_with_the_remedy(tmp_path):
    clock = Clock()
    it = demo._Demo(demo.DemoCfg(out=tmp_path), "cpu-demo", "cpu", tmp_path, stages_in(tmp_path, 14.0, clock))
    clock.now = 60.0 * 13.9
    with pytest.raises(demo.DemoError, match="--minutes"):
        it.compare()


def test_training_gets_what_the_other_stages_leave(tmp_path, monkeypatch):
    clock, asked = Clock(), []

    def teacher(arguments):
        asked.append(float(arguments[arguments.index("--max-minutes") + 1]))
        (tmp_path / "teacher").mkdir(exist_ok=True)
        (tmp_path / "teacher" / "policy.pt").touch()
        return 0

    monkeypatch.setattr(cli, "main", teacher)
    for meshes, used_min in ((None, 0.0), (None, 3.0), (tmp_path, 3.0), (None, 13.0)):
        clock.now = 60.0 * used_min
        cfg = demo.DemoCfg(out=tmp_path, meshes=meshes)
        stages = Stages(tmp_path / "stages.json", 1, Budget(cfg.minutes, clock, 0.0))
        demo._Demo(cfg, "cpu-demo", "cpu", tmp_path, stages).train()
    end = demo.DemoCfg().minutes - demo.RESERVE_MIN
    assert asked == [end, end - 3.0, end - 3.0 - demo.RESERVE_MESHES_MIN, demo.LEAST_TRAINING_MIN]


def test_the_plan_of_fifteen_minutes_leaves_time_to_learn():
    minutes = demo.DemoCfg().minutes
    assert minutes < 15.0
    reserve = demo.RESERVE_MIN + demo.RESERVE_MESHES_MIN
    assert minutes * (1.0 - demo.IMPORT_SHARE) - reserve > 5.0


def test_an_import_ends_with_its_share_and_goes_on_with_the_smallest_first(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("VD_ASSETS", str(tmp_path / "assets"))
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    for size, name in enumerate(("c", "b", "a"), start=1):
        (meshes / f"{name}.obj").write_text("o\n" * size)
    order = []

    def slow(job, *_):
        order.append(job.name)
        time.sleep(0.0 if job.name == "c" else 0.7)
        Path(job.target).write_text("")
        return importer.ImportResult(job.source, job.name, "imported", target=job.target)

    monkeypatch.setattr(importer, "_run_child", slow)
    monkeypatch.setattr(importer.os, "cpu_count", lambda: 1)
    cfg = demo.DemoCfg(out=tmp_path, meshes=meshes, minutes=1.0)
    monkeypatch.setattr(demo, "IMPORT_SHARE", 0.3 / 60.0)
    stages = stages_in(tmp_path)
    it = demo._Demo(cfg, "cpu-demo", "cpu", tmp_path, stages)
    it.import_meshes()
    assert order == ["c", "b"]  # b was under way when the time was over
    ((what, command),) = stages.left_out
    assert "2 of 3 meshes: b.obj, a.obj" in what
    assert command.startswith(f"vd-assets import {meshes} --out {tmp_path / 'meshes'} ")
    assert command in capsys.readouterr().out


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
    stages = stages_in(tmp_path)
    with pytest.raises(RuntimeError), stages.run("work", "work", products=[product]) as needed:
        assert needed
        product.write_text("half")
        raise RuntimeError
    stages.load()
    with stages.run("work", "work", products=[product]) as needed:
        assert needed
    again = stages_in(tmp_path)
    again.load()
    with again.run("work", "work", products=[product]) as needed:
        assert not needed
    product.unlink()
    with again.run("work", "work", products=[product]) as needed:
        assert needed
    assert capsys.readouterr().out.count("done before") == 1


def test_the_alarm_ends_a_block_and_leaves_no_alarm_behind():
    started = time.monotonic()
    with pytest.raises(TimeUp), time_limit(0.05):
        time.sleep(120.0)
    assert time.monotonic() - started < 60.0
    with time_limit(0.05):
        pass
    time.sleep(0.1)
    with pytest.raises(TimeUp), time_limit(0.0):
        pytest.fail("there was no time to begin")


def test_a_stage_without_time_is_left_out_and_run_by_the_next_call(tmp_path, capsys):
    clock, product = Clock(), tmp_path / "product"
    keep = {"products": [product], "keep_min": 0.5, "command": "vd-eval policy.pt"}
    stages = stages_in(tmp_path, 1.0, clock)
    clock.now = 31.0
    assert not stages.run_if_time("work", "do the work", product.touch, **keep)
    assert stages.left_out == [("do the work", "vd-eval policy.pt")]
    assert "by hand: vd-eval policy.pt" in capsys.readouterr().out
    again = stages_in(tmp_path, 1.0, clock)
    again.load()
    assert again.run_if_time("work", "do the work", product.touch, **keep)
    assert not again.left_out
    assert product.exists()


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
