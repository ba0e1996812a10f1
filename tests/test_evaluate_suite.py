"""The paper's suite: what is run, what is not run again, and the page.

Evaluation is a test double.
"""

import json
import re
from dataclasses import fields, replace
from typing import get_args

import numpy as np
import pytest
from test_evaluate_page import read_page
from test_evaluate_trace import compared

from vd.evaluate import suite_run
from vd.evaluate.cfg import EvalCfg
from vd.evaluate.claims import lost_at_once, success_without_table
from vd.evaluate.cli import main
from vd.evaluate.conditions import Condition
from vd.evaluate.result import Result
from vd.evaluate.suite import OWN_SETS, Suite, SuiteEntry, read_suite
from vd.evaluate.trace import Episode
from vd.paper import ResultConstants
from vd.policy.agents import SHIPPED_POLICIES

TEACHER, CAMERA = "dclaw3", "dclaw3-vision"
OBJECTS = ("training=cube", "held-out=cube", "symmetric=cube")
"""Sets that need no authoring; the test double looks at none of them."""
PAPERS, ROBUST = read_suite("paper").lines, read_suite("robust").lines
CLAIMS = read_suite("paper").claims
OF_TEACHERS = [c.name for c in PAPERS if c.teacher and c.name != "validation"]
"""Entries of a teacher: its goals are no clouds, to be scanned or told by points."""


@pytest.fixture(scope="module")
def found():
    """Rows of a camera policy: the intervals take longest."""
    return compared()


@pytest.fixture
def asked(monkeypatch, found):
    """Replace the evaluation of one policy; returns what was asked for, as condition and policy."""
    asked = []

    def compare(cfg, condition):
        (name,) = cfg.agent_names
        asked.append((condition, name))
        (group,) = {item.partition("=")[0] for item in cfg.objects}
        rows = [replace(row, policy=name, group=group, condition=condition) for row in found]
        if name != CAMERA:
            rows = [replace(row, kind="teacher", sees="state") for row in rows[1:]]
        Result(tuple(rows), software={"device": "a double"}).write(cfg.out / "eval.json")

    monkeypatch.setattr(suite_run, "compare", compare)
    return asked


def run(tmp_path, *policies, **changes):
    settings = dict(suite="paper", objects=OBJECTS, out=tmp_path / "out", device="cpu")
    return suite_run.run_suite(EvalCfg(policies=policies or (TEACHER,), **{**settings, **changes}))


def command(tmp_path, *flags):
    return main(
        [TEACHER, "--suite", "paper", "--objects", *OBJECTS, "--out", str(tmp_path / "out"), *flags]
    )


def test_every_figure_of_the_paper_is_claimed_under_its_conditions():
    by_name = {entry.name: entry for entry in PAPERS}
    assert {claim.paper for claim in CLAIMS} - {None} == {
        item.name for item in fields(ResultConstants)
    }
    assert {name for claim in CLAIMS for name in claim.entries} <= by_name.keys()
    texts = {claim.paper: suite_run.paper_text(claim) for claim in CLAIMS}
    assert texts["table_held_out"] == "85.0 % (82.0 to 88.0)"
    assert texts["table_training_median_rad"] == "0.12 to 0.13"
    assert texts["air_time_s"] == "below 7" and texts["air_by_truth"] == "80.9 %"
    groups = dict.fromkeys(suite_run.groups_of(PAPERS), suite_run.ObjectGroup(("x",), "x"))
    for entry in PAPERS:
        for line in entry.lines:
            cfg = suite_run.settings(EvalCfg(seed=3), line, TEACHER, groups)
            assert cfg.sensor_errors and cfg.no_at_rest and cfg.seed == 3 and not cfg.suite
            assert cfg.objects[0].endswith("=x") and cfg.policies == (TEACHER,)
            assert cfg.schedule.length_s == (15.0 if cfg.in_air else 10.0)


def test_ones_own_suite_is_a_file_of_command_lines(tmp_path, asked, capsys):
    own = tmp_path / "own.yaml"
    own.write_text(
        "title: Own\nlines:\n- name: far\n  teacher: vd-eval dclaw3 --objects desk=SET --seed 7\n"
        "- {name: near, teacher: vd-eval POLICY --objects cube --max-goal-angle 1}\n"
    )
    (tmp_path / "near").mkdir()
    flags = ["dclaw4", "--suite", str(own), "--out", str(tmp_path / "out"), "--device", "cpu"]
    assert main([*flags, "--objects", "desk=cube"]) == 0
    assert asked == [("far", "dclaw3"), ("near", "dclaw4")], "a line may name its policy"
    said = json.loads((tmp_path / "out" / "far" / "dclaw3" / "settings.json").read_text())
    assert said["seed"] == 7 and said["objects"] == ["desk=cube"]
    assert "Own" in (tmp_path / "out" / "own.html").read_text()
    for text, message in (
        ("title: x\nlines: [{name: a}]", "a has no line 'vd-eval POLICY ...'"),
        ("title: x\nlines: [{name: a, camera: vd-eval dclaw3}]", "a has dclaw3 in the wrong line"),
        (
            "title: x\nlines: [{name: a, camera: vd-eval --in-air}]",
            "a has dclaw4 in the wrong line",
        ),
        ("title: x\nlines: [{name: a, speed: b}]", "has no field speed"),
        ("- a", "has no lines, title; name it"),
    ):
        own.write_text(text)
        assert main(flags) == 1 and message in capsys.readouterr().err
    assert main([*flags[:2], "nothing", "--out", str(tmp_path)]) == 1
    assert "benchmark, paper, robust, or a YAML" in capsys.readouterr().err


def test_everything_is_run_once_and_only_what_changed_again(tmp_path, asked, monkeypatch):
    first = run(tmp_path)
    assert asked == [(name, TEACHER) for name in OF_TEACHERS]
    assert run(tmp_path).summary() == first.summary() and len(asked) == len(OF_TEACHERS)
    asked.clear()
    (tmp_path / "out" / "air" / TEACHER / "eval.json").write_text("{")
    run(tmp_path)
    assert asked == [("air", TEACHER)], "a damaged file"
    asked.clear()
    run(tmp_path, TEACHER, CAMERA)
    assert {name for _, name in asked} == {CAMERA}, "one more policy"
    for change in ({"seed": 1}, {}):
        asked.clear()
        run(tmp_path, **change)
        assert len(asked) == len(OF_TEACHERS), "another seed, other weights"
        monkeypatch.setattr(suite_run, "fingerprint", lambda name: "new weights")


def test_jobs_of_an_array_share_the_work_and_the_whole_command_merges_it(tmp_path, asked):
    for part in ("0/2", "1/2"):
        assert not run(tmp_path, shard=part).missing
        assert not (tmp_path / "out" / "paper.html").exists(), "others are at work"
    assert sorted(asked) == sorted((name, TEACHER) for name in OF_TEACHERS)
    assert not run(tmp_path).missing and len(asked) == len(OF_TEACHERS)


def test_side_by_side_the_same_is_measured_camera_policies_first(tmp_path, asked, monkeypatch):
    told = {}

    def in_this_process(work, tasks, finished, *, jobs, limit_s, gpu):
        told.update(jobs=jobs, gpu=gpu)
        for number, task in enumerate(tasks):
            finished(task, None, "its process died") if number == 1 else finished(
                task, work(task), ""
            )

    monkeypatch.setattr(suite_run, "run_tasks", in_this_process)
    together = run(tmp_path, TEACHER, CAMERA, jobs=3)
    assert told == {"jobs": 3, "gpu": True}
    camera = [name == CAMERA for _, name in asked]
    assert camera == sorted(camera, reverse=True) and not all(camera)
    ((condition, policy, why),) = together.missing
    assert why == "its process died"
    asked.clear()
    assert not run(tmp_path, TEACHER, CAMERA).missing
    assert asked == [(condition, policy)], "only what failed is measured again"
    assert (tmp_path / "out" / "training" / TEACHER / suite_run.LOG_FILE).is_file()


@pytest.mark.parametrize(
    ("left_out", "error", "status"),
    [
        (("air", "air-training"), RuntimeError("environment 3 (spoon) is not finite"), 1),
        (OF_TEACHERS[2:], KeyboardInterrupt(), 130),
        (OF_TEACHERS, KeyboardInterrupt(), 130),
    ],
)
def test_what_fails_costs_no_other_and_is_measured_by_the_next_call(
    tmp_path, asked, monkeypatch, capsys, left_out, error, status
):
    whole = suite_run.compare

    def fails(cfg, condition):
        if condition in left_out:
            raise error
        return whole(cfg, condition)

    monkeypatch.setattr(suite_run, "compare", fails)
    assert command(tmp_path) == status
    text, said = read_page(tmp_path / "out" / "paper.html")[0], capsys.readouterr().err
    assert ("Nothing has been measured" in text) == (left_out == OF_TEACHERS)
    assert status == 130 or ("spoon" in said and "spoon" in text)
    written = json.loads((tmp_path / "out" / "paper.json").read_text())
    assert {condition for condition, *_ in written["missing"]} == set(left_out)
    asked.clear()
    monkeypatch.setattr(suite_run, "compare", whole)
    assert command(tmp_path) == 0
    assert [condition for condition, _ in asked] == list(left_out)


def test_the_papers_figures_stand_beside_ours(tmp_path, asked):
    run(tmp_path, TEACHER, CAMERA)
    written = json.loads((tmp_path / "out" / "paper.json").read_text())
    figures = {(row["figure"], row["condition"]): row for row in written["figures"]}
    ours = figures["stopped within 0.4 rad by prediction", "air"]
    assert ours[TEACHER] == "–" and ours[CAMERA].startswith("0.0 %"), "the double stops at 0.65 rad"  # noqa: RUF001
    assert figures["states within 0.4 rad up to symmetry seen so", "air"][CAMERA] == "100.0 %"
    text, _ = read_page(tmp_path / "out" / "paper.html")
    assert "72.3 %" in text and "Held-out objects" in text and "our own" not in text


def test_robustness_is_one_table_of_what_each_change_costs(tmp_path, asked, monkeypatch):
    whole = suite_run.compare

    def spoiled(cfg, condition):  # of everything but the nominal condition the first episode fails
        whole(cfg, condition)
        result = Result.read(cfg.out / "eval.json")
        if condition != "nominal":
            rows = [
                replace(
                    row,
                    episodes=(
                        replace(row.episodes[0], fell=True, stopped=False),
                        *row.episodes[1:],
                    ),
                )
                for row in result.rows
            ]
            replace(result, rows=tuple(rows)).write(cfg.out / "eval.json")

    monkeypatch.setattr(suite_run, "compare", spoiled)
    run(tmp_path, TEACHER, CAMERA, suite="robust", objects=("held-out=cube",))
    of_state = {"observation-late", "all-late", "tracked", "mixed-tracked"}
    names = [c.name for c in ROBUST]
    of_goals = set(get_args(Condition)) - {"hora"}  # under which objects are spun
    assert set(names) == {*of_goals, "air-nominal", "air-mixed"} and names[0] == "nominal"
    assert {n for n, policy in asked if policy == CAMERA} == set(names) - of_state
    assert {n for n, policy in asked if policy == TEACHER} == set(names)
    table = json.loads((tmp_path / "out" / "robust.json").read_text())["figures"]
    lines = [(name, policy) for name in names for policy in (CAMERA, TEACHER)]
    expected = {line for line in lines if line[1] == TEACHER or line[0] not in of_state}
    assert {(row["condition"], row["policy"]) for row in table} == expected
    assert len(table[0]) <= 7 and table[0]["points from nominal"] == "–"  # noqa: RUF001
    cost = {float(row["points from nominal"].split()[0]) for row in table[2:]}
    assert len(cost) <= 2 and min(cost) < 0.0
    text, _ = read_page(tmp_path / "out" / "robust.html")
    assert (
        "Condition by condition" in text
        and "--condition off-centre" in text
        and "72.3 %" not in text
    )


def test_lines_of_other_objects_are_not_compared(found):
    row = next(row for row in found if row.headline)
    others = replace(row, condition="others", object_names=("something else",))
    entries = [SuiteEntry(name, teacher="vd-eval POLICY") for name in ("first", "same", "others")]
    rows = [replace(row, condition=entry.name) for entry in entries[:2]]
    table = suite_run.robust_table(Result((*rows, others)), entries)
    shown = [line["points from first"] for line in table]
    assert shown[0] == shown[2] == suite_run.NOTHING
    assert shown[1].startswith("+0.0")


def test_our_objects_stand_for_the_papers_where_none_are_given(monkeypatch):
    assert OWN_SETS.keys() == {"training", "held-out", "symmetric"}
    few = OWN_SETS | {"training": ("procedural-2-seed0",)}  # all of them take a minute to make
    monkeypatch.setattr(suite_run, "OWN_SETS", few)
    wanted = ["training", "validation", "held-out", "symmetric"]
    groups = suite_run.object_groups((), wanted, {})
    assert groups.keys() == few.keys(), "nothing stands in for validation objects"
    assert groups["training"].sets == few["training"] and "our own" in groups["held-out"].text
    left_out = set(SHIPPED_POLICIES) - set(EvalCfg(suite="paper").agent_names)
    imported = {name for name in SHIPPED_POLICIES if not name.startswith("dclaw")}
    assert left_out == imported, "whose hands are not here"
    with pytest.raises(ValueError, match=r"'table' .*training, validation, held-out"):
        suite_run.object_groups(("table=cube",), wanted, {})


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--suite", "paper", "--condition", "mixed"], "--condition is decided by --suite paper"),
        (["--suite", "paper", "--in-air"], "--in-air is decided by --suite paper"),
        (["--suite", "paper", "--plan"], "--plan is decided by --suite paper"),
        (
            ["dclaw4-cube", "--jobs", "2"],
            "--jobs and --shard are of a suite; add --suite paper",
        ),
        (["--suite", "paper", "--jobs", "0"], "--jobs is 0; it has to be positive"),
        (["--suite", "paper", "--shard", "2/2"], "--shard is '2/2'; it has to be I/N"),
        (
            ["zero", "--condition", "mixed", "--table-friction", "0"],
            "--condition and --table-friction exclude",
        ),
        (["zero", "--at-rest", "--no-at-rest"], "--at-rest and --no-at-rest exclude each other"),
        (
            ["zero", "--air-goals", "--episode-s", "3"],
            "--air-goals and --episode-s exclude each other",
        ),
        (
            ["dclaw4-cube", "--table-friction", "-1"],
            "--table-friction is -1.0; it has to be zero",
        ),
        (["nobody", "--suite", "paper"], "no policy at nobody"),
        (["dclaw4-cube", "--objects", "=a"], "NAME=SET"),
        (["zero", "--stop-tolerance", "23"], "at most pi [rad]; 23 degrees are 0.401"),
        (["zero", "--max-goal-angle", "90"], "at most pi [rad]; 90 degrees are 1.57"),
        (["zero", "--seed", "-1"], "--seed is -1; it has to be zero or positive"),
    ],
)
def test_settings_that_cannot_be_are_refused_before_anything_is_built(
    flags, message, capsys, tmp_path, monkeypatch
):
    monkeypatch.setattr("vd.evaluate.compare.compare", lambda cfg: pytest.fail("it began"))
    assert main([*flags, "--out", str(tmp_path), "--device", "cpu"]) == 1
    assert message in capsys.readouterr().err


def test_a_policy_is_known_by_its_weights(tmp_path):
    paths = [tmp_path / name for name in ("a.safetensors", "copy.safetensors", "b.safetensors")]
    for path, content in zip(paths, (b"one", b"one", b"two"), strict=True):
        path.write_bytes(content)
    first, copy, other = (suite_run.fingerprint(str(path)) for path in paths)
    assert first == copy != other and suite_run.fingerprint("zero") == "zero"


def test_measures_count_what_they_say(found):
    def episode(steps, *, error=1.0, stopped=False, fell=False):
        quat = (0.0, 0.0, 0.0, 1.0)
        return Episode(0, quat, quat, 2.0, error, error, steps, stopped, fell)

    episodes = (
        *(episode(steps, fell=True) for steps in (20, 25, 30, 31)),  # the table goes after 24 steps
        episode(12, error=0.2, stopped=True),
        episode(36, error=0.3, stopped=True),
        episode(6, error=0.9, stopped=True),
        episode(180),
    )
    row = replace(found[1], episodes=episodes, object_names=("a",))
    assert lost_at_once(row).value == pytest.approx(2 / 8)
    assert success_without_table(row).value == pytest.approx(1 / 8)


@pytest.mark.slow
def test_on_a_table_of_other_friction_and_in_the_air(tmp_path, monkeypatch):
    chosen = tuple(
        replace(c, teacher=re.sub(r"--episodes \d+", "--episodes 4", c.teacher))
        for c in PAPERS
        if c.name in ("symmetric", "friction-0.05", "air")
    )
    monkeypatch.setattr(suite_run, "read_suite", lambda name: Suite("Part", chosen, CLAIMS))
    flags = ["dclaw4-cube", "--suite", "paper", "--jobs", "2", "--device", "cpu"]
    assert main([*flags, "--objects", *OBJECTS[1:], "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "paper.json").read_text())["rows"]
    assert {row["condition"] for row in rows} == {c.name for c in chosen}
    friction, nominal = (
        Result.read(tmp_path / name / "dclaw4-cube" / "eval.json").rows[0]
        for name in ("friction-0.05", "symmetric")
    )
    assert friction.protocol.table_friction == 0.05
    starts, ends = (
        [[getattr(e, name) for e in row.episodes] for row in (friction, nominal)]
        for name in ("start_quat", "error_rad")
    )
    np.testing.assert_allclose(*starts, atol=1e-6)
    assert not np.allclose(*ends), "the same starts and goals on another table"
