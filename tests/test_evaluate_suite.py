"""The paper's suite: what is run, what is not run again, and the page; evaluation is a test double."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from test_evaluate_report import PNG, read_page
from test_evaluate_trace import compared, protocol

from vd.evaluate import suite_result, suite_run
from vd.evaluate.agents import SHIPPED_POLICIES
from vd.evaluate.cfg import EvalCfg
from vd.evaluate.cli import main
from vd.evaluate.comparison import Comparison, outcome_shares
from vd.evaluate.result import Episode, summarise
from vd.evaluate.suite import (
    CLAIMS,
    CONDITIONS,
    NO_STUDENT,
    OUT_OF_TIME,
    QUICK_OBJECTS,
    QUICK_S,
    dropped_at_once,
    seen_within,
    success_without_table,
    time_to_success,
)
from vd.evaluate.suite_page import paper_text
from vd.paper import PAPER, ResultConstants

TEACHER, STUDENT = "dclaw3-table", "runs/s/student.pt"
SYMMETRIC = ("training=cube", "held-out=cube", "symmetric=cube")
"""Sets that need no authoring; the test double looks at none of them."""
OF_TEACHERS = [c for c in CONDITIONS if c.objects != "validation" and c.concerns(student=False, views=True)]
"""Conditions of a teacher: its goals are no clouds, to be scanned or told by points, and it has no camera."""


@pytest.fixture(scope="module")
def found():
    """Rows and prediction of a student: the intervals take longest."""
    return compared()


@pytest.fixture
def asked(monkeypatch, found):
    """Replace the evaluation of one policy; returns what was asked for."""
    asked = []

    def compare(cfg, stop_at=None):
        asked.append(cfg)
        (name,) = cfg.agent_names
        rows, prediction = found
        (group,) = {item.partition("=")[0] for item in cfg.objects}
        student = name == STUDENT
        rows = [
            replace(
                row,
                policy=name,
                group=group,
                kind="student of stage 2" if student else "teacher",
                result=replace(row.result, protocol=replace(row.result.protocol, policy=name)),
            )
            for row in (rows if student else rows[1:])
        ]
        told = (replace(prediction, policy=name, group=group),) if student else ()
        comparison = Comparison(tuple(rows), told, software={"device": "a double"})
        comparison.write(cfg.out / "eval.json")
        return comparison

    monkeypatch.setattr(suite_run, "compare", compare)
    for module in (suite_run, suite_result):
        monkeypatch.setattr(module, "sees_clouds", lambda name: name == STUDENT)
    monkeypatch.setattr(suite_run, "has_second_view", lambda name: name == TEACHER)
    monkeypatch.setattr(suite_run.SuiteResult, "pictures", {"training": PNG})
    monkeypatch.setattr(suite_run, "fingerprint", lambda name, **_: f"weights of {name}")
    return asked


def suite(tmp_path, *policies, **changes):
    settings = dict(suite="paper", objects=SYMMETRIC, out=tmp_path / "out", device="cpu")
    return EvalCfg(policies=policies or (TEACHER,), **{**settings, **changes})


def run(cfg):
    return suite_run.run_suite(cfg, say=lambda line: None)


def asked_for(asked):
    return [(cfg.out.parent.name, cfg.agent_names[0]) for cfg in asked]


def test_every_figure_of_the_paper_is_claimed_once_per_setting_and_has_a_condition():
    names = {condition.name for condition in CONDITIONS}
    assert len(names) == len(CONDITIONS)
    claimed = {claim.paper for claim in CLAIMS if claim.paper is not None}
    assert claimed == {item.name for item in fields(ResultConstants)}
    assert {claim.condition for claim in CLAIMS} == names
    for claim in CLAIMS:
        assert claim.source.startswith("P: ") == (claim.paper is not None)
        if claim.paper is not None and claim.unit == "share":
            value, *interval = getattr(PAPER.results, claim.paper)
            assert not interval or interval[0] <= value <= interval[1]


def test_the_conditions_are_the_papers():
    by_name = {condition.name: condition for condition in CONDITIONS}
    frictions = {c.table_friction for c in CONDITIONS if c.table_friction is not None}
    low, high = PAPER.randomisation.table_friction
    assert len(frictions | {PAPER.materials.table_friction}) == 5, "five materials"
    assert min(frictions) == low and max(frictions) == high
    cfg = suite_run.settings(EvalCfg(seed=3), by_name["air"], TEACHER, suite_run.Objects(("x",), "x", False))
    assert cfg.in_air and cfg.limit_s == PAPER.scene.air_episode_s and cfg.seed == 3
    assert cfg.no_at_rest and cfg.objects == ("held-out=x",) and cfg.episodes == 100
    assert cfg.stop_tolerance == PAPER.success.rotation_rad


def test_the_headline_has_the_papers_conditions_and_what_is_ours_is_marked():
    """A real camera's errors and no view selection; what students know of goals is said."""
    objects = suite_run.Objects(("x",), "x", False)
    for condition in CONDITIONS:
        cfg = suite_run.settings(EvalCfg(), condition, TEACHER, objects)
        plain = cfg.sensor_errors and not cfg.second_view
        assert plain == (not condition.mark), condition.name
        assert cfg.goals == condition.goals
    known = {c.name: c.goals for c in CONDITIONS}
    assert (known["held-out"], known["held-out-points"], known["air-points"]) == ("mesh", "points", "points")
    looks = next(c for c in CONDITIONS if c.second_view and c.sensor_errors)
    assert "--second-view" in looks.flags and looks.mark.startswith("ours")
    assert looks.concerns(student=True, views=True) and not looks.concerns(student=True, views=False)
    default = EvalCfg()
    assert default.sensor_errors and not default.second_view


def test_the_reduced_suite_ends_in_its_time_and_shows_what_it_has(tmp_path, asked, monkeypatch):
    whole, now = suite_run.compare, [0.0]
    monkeypatch.setattr(suite_run.time, "monotonic", lambda: now[0])

    def slow(cfg, stop_at):
        now[0] += 0.45 * QUICK_S
        if now[0] > stop_at:
            raise TimeoutError
        return whole(cfg)

    monkeypatch.setattr(suite_run, "compare", slow)
    result = run(suite(tmp_path, STUDENT, TEACHER, quick=True))
    assert [name for _, name in asked_for(asked)] == [TEACHER, TEACHER], "a student takes longest"
    assert len(result.found) == 2 and len(result.late) > 10 and not result.failed and now[0] < 1.5 * QUICK_S
    page = (tmp_path / "out" / "paper.html").read_text()
    assert "not run" in page and f"{len(result.late)} evaluations are {OUT_OF_TIME}" in page


def test_everything_is_run_once_and_a_second_call_runs_nothing(tmp_path, asked):
    first = run(suite(tmp_path))
    expected = [(c.name, TEACHER) for c in OF_TEACHERS]
    assert asked_for(asked) == expected, "a teacher's goals are no clouds: nothing to scan"
    second = run(suite(tmp_path))
    assert len(asked) == len(expected) and second.summary() == first.summary()
    page = tmp_path / "out" / "paper.html"
    page.unlink()
    assert run(suite(tmp_path)).found and page.is_file()


def test_only_what_changed_is_run_again(tmp_path, asked, monkeypatch):
    run(suite(tmp_path))
    once = len(asked)
    (tmp_path / "out" / "air" / TEACHER / "eval.json").write_text("{")
    run(suite(tmp_path))
    assert asked_for(asked[once:]) == [("air", TEACHER)], "a damaged file"
    run(suite(tmp_path, TEACHER, STUDENT))
    assert {name for _, name in asked_for(asked[once + 1 :])} == {STUDENT}, "one more policy"
    before = len(asked)
    monkeypatch.setattr(suite_run, "fingerprint", lambda name, **_: "new weights")
    run(suite(tmp_path))
    assert len(asked) == before + once
    run(suite(tmp_path, seed=1))
    assert len(asked) == before + 2 * once


def test_side_by_side_the_same_is_measured_students_first(tmp_path, asked, monkeypatch):
    asked_of = {}

    def in_this_process(work, tasks, finished, *, jobs, limit_s, gpu):
        asked_of.update(jobs=jobs, gpu=gpu)
        for number, task in enumerate(tasks):
            if number == 1:
                finished(task, None, "its process died")
            else:
                finished(task, work(task), "")

    monkeypatch.setattr(suite_run, "run_tasks", in_this_process)
    together = run(suite(tmp_path, TEACHER, STUDENT, jobs=3))
    assert asked_of == {"jobs": 3, "gpu": True}
    students = [name == STUDENT for _, name in asked_for(asked)]
    assert students == sorted(students, reverse=True) and not all(students)
    assert list(together.failed.values()) == ["its process died"]
    once = len(asked)
    alone = run(suite(tmp_path, TEACHER, STUDENT))
    assert asked_for(asked[once:]) == list(together.failed), "only what failed is measured again"
    assert set(alone.found) == set(together.found) | set(together.failed)
    assert (tmp_path / "out" / "training" / TEACHER / suite_run.LOG_FILE).is_file()


def test_students_have_fewer_episodes(asked):
    objects = suite_run.Objects(("x",), "x", False)
    for condition in CONDITIONS:
        episodes = [
            suite_run.settings(EvalCfg(), condition, name, objects).episodes for name in (TEACHER, STUDENT)
        ]
        assert episodes == [condition.episodes, condition.student_episodes] and episodes[0] > episodes[1]


def test_an_interruption_keeps_what_was_measured(tmp_path, asked, monkeypatch):
    whole = suite_run.compare

    def interrupted(cfg, stop_at):
        if len(asked) == 2:
            raise KeyboardInterrupt
        return whole(cfg)

    monkeypatch.setattr(suite_run, "compare", interrupted)
    arguments = [TEACHER, "--suite", "paper", "--objects", *SYMMETRIC, "--out", str(tmp_path / "out")]
    assert main(arguments) == 130
    assert "not run" in (tmp_path / "out" / "paper.html").read_text()
    monkeypatch.setattr(suite_run, "compare", whole)
    assert main(arguments) == 0
    assert asked_for(asked) == [(c.name, TEACHER) for c in OF_TEACHERS]


def test_an_interruption_before_anything_was_measured_leaves_a_page_too(tmp_path, asked, monkeypatch):
    def interrupted(cfg, stop_at):
        raise KeyboardInterrupt

    monkeypatch.setattr(suite_run, "compare", interrupted)
    arguments = [TEACHER, "--suite", "paper", "--objects", *SYMMETRIC, "--out", str(tmp_path / "out")]
    assert main(arguments) == 130
    assert "Nothing has been measured yet" in read_page(tmp_path / "out" / "paper.html")[0]


def test_a_condition_that_fails_costs_no_other(tmp_path, asked, monkeypatch, capsys):
    whole = suite_run.compare

    def fails(cfg, stop_at):
        if cfg.in_air:
            raise RuntimeError("world 3 (spoon) is not finite")
        return whole(cfg)

    monkeypatch.setattr(suite_run, "compare", fails)
    arguments = [TEACHER, "--suite", "paper", "--objects", *SYMMETRIC, "--out", str(tmp_path / "out")]
    assert main([*arguments, "--json"]) == 1
    printed = capsys.readouterr()
    assert {entry["condition"] for entry in json.loads(printed.out)["failed"]} == {"air", "air-training"}
    assert "spoon" in printed.err and "spoon" in (tmp_path / "out" / "paper.html").read_text()
    monkeypatch.setattr(suite_run, "compare", whole)
    before = len(asked)
    assert main(arguments) == 0
    assert [condition for condition, _ in asked_for(asked[before:])] == ["air", "air-training"]


def test_without_a_student_its_figures_are_named_and_not_invented(tmp_path, asked, capsys):
    result = run(suite(tmp_path))
    summary = result.summary()
    assert summary["students"] == NO_STUDENT
    by_prediction = [f for f in summary["figures"] if f["stopped_by"] == "prediction"]
    assert by_prediction and not any(value for figure in by_prediction for value in figure["ours"].values())
    text, references = read_page(tmp_path / "out" / "paper.html")
    assert NO_STUDENT in text and "predicts nothing" in text and "72.3 %" in text
    assert all(address.startswith("data:image/png;base64,") for address in references.addresses)
    assert not {"script", "link", "iframe"} & set(references.tags)
    assert main([TEACHER, "--suite", "paper", "--objects", *SYMMETRIC, "--out", str(tmp_path / "out")]) == 0
    assert NO_STUDENT in capsys.readouterr().out


def test_students_have_their_predictions_and_scanned_goals(tmp_path, asked):
    result = run(suite(tmp_path, TEACHER, STUDENT))
    assert ("scanned-goals", STUDENT) in asked_for(asked)
    assert ("scanned-goals", TEACHER) not in asked_for(asked)
    figures = {(f["figure"], f["condition"]): f["ours"] for f in result.summary()["figures"]}
    ours = figures["stopped within 0.4 rad by prediction", "air"]
    assert ours[TEACHER] is None and ours[STUDENT]["value"] == 0.0, "the double stops at 0.65 rad"
    assert figures["states within 0.4 rad predicted so", "air"][STUDENT] == 1.0
    text, references = read_page(tmp_path / "out" / "paper.html")
    assert NO_STUDENT not in text and "Predicted beside true distance" in text
    assert "needs no cloud" in text, "a teacher in the row of scans"
    assert references.tags.count("img") >= 8


def test_the_reduced_suite_takes_a_spread_of_objects(tmp_path, asked):
    many = tmp_path / "many"
    many.mkdir()
    for index in range(QUICK_OBJECTS * 3):
        (many / f"{index:02}.usd").touch()
    result = run(suite(tmp_path, objects=(f"training={many}", *SYMMETRIC[1:]), quick=True))
    assert {c.name for c in result.conditions} < {c.name for c in CONDITIONS}
    (training,) = [cfg for cfg in asked if cfg.out.parent.name == "training"]
    assert [item[-6:] for item in training.objects] == [f"{i:02}.usd" for i in range(0, 18, 3)]
    assert training.episodes < next(c.episodes for c in CONDITIONS if c.name == "training")
    assert f"{QUICK_OBJECTS} of the 18" in result.objects["training"].text


def test_which_objects_stand_for_the_papers_is_said(tmp_path, asked):
    result = run(suite(tmp_path, objects=("training=cube", "held-out=cube", "validation=cube")))
    page = (tmp_path / "out" / "paper.html").read_text()
    assert "No others were given" not in page and "Held-out objects judge, and nothing is" in page
    assert ("validation", TEACHER) in result.found
    groups = suite_run.object_groups((), quick=False)
    assert "validation" not in groups, "nothing stands in for it"
    assert all(objects.own for objects in groups.values())
    assert groups["training"].sets == ("procedural-150-seed0",)
    with pytest.raises(
        ValueError, match="'table' is no group of the suite; training, validation, held-out, symmetric"
    ):
        suite_run.object_groups(("table=cube",), quick=False)


def test_installed_policies_are_taken_where_none_is_named():
    assert EvalCfg(suite="paper").agent_names == tuple(SHIPPED_POLICIES)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--suite", "paper", "--condition", "mixed"], "--condition is decided by --suite paper"),
        (["--suite", "paper", "--in-air"], "--in-air is decided by --suite paper"),
        (["--suite", "paper", "--episodes", "3"], "--episodes is decided by"),
        (["dclaw4-cube", "--quick"], "add --suite paper"),
        (["dclaw4-cube", "--jobs", "2"], "--jobs is of a suite"),
        (["--suite", "paper", "--jobs", "0"], "at least 1 is needed"),
        (["dclaw4-cube", "--table-friction", "0.1", "--randomise"], "exclude each other"),
        (["dclaw4-cube", "--table-friction", "-1"], "must not be negative"),
        (["nobody", "--suite", "paper"], "no policy at nobody"),
        (["dclaw4-cube", "--second-view"], "--second-view is for teachers that see their goals in views"),
    ],
)
def test_settings_that_cannot_be_are_refused(flags, message, capsys, tmp_path):
    assert main([*flags, "--out", str(tmp_path), "--device", "cpu"]) == 1
    assert message in capsys.readouterr().err


def test_a_policy_is_known_by_its_weights(tmp_path):
    path = tmp_path / "policy.pt"
    path.write_bytes(b"one")
    first = suite_run.fingerprint(str(path))
    (tmp_path / "copy.pt").write_bytes(b"one")
    assert suite_run.fingerprint(str(tmp_path / "copy.pt")) == first
    path.write_bytes(b"two")
    assert suite_run.fingerprint(str(path)) != first
    assert suite_run.fingerprint("zero") == "zero"


def episode(steps, *, error=1.0, stopped=False, fell=False):
    quat = (0.0, 0.0, 0.0, 1.0)
    return Episode(0, quat, quat, 2.0, error, error, steps, stopped, fell)


def test_measures_count_what_they_say():
    episodes = (
        episode(25, fell=True),  # the table goes after 24 steps
        episode(30, fell=True),
        episode(31, fell=True),
        episode(20, fell=True),
        episode(12, error=0.2, stopped=True),
        episode(36, error=0.3, stopped=True),
        episode(6, error=0.9, stopped=True),
        episode(180),
    )
    result = summarise(protocol("p", 8), ("a",), episodes)
    row = replace(compared()[0][0], result=result, outcomes=outcome_shares(result))
    comparison = Comparison((row,), ())
    assert dropped_at_once(comparison, row).value == pytest.approx(2 / 8)
    assert success_without_table(comparison, row).value == pytest.approx(1 / 8)
    assert time_to_success(comparison, row).value == pytest.approx(np.median([12, 36]) / 12.0)
    assert seen_within(0.4)(comparison, row) is None
    never = replace(result, episodes=(episode(180),) * 8)
    assert time_to_success(comparison, replace(row, result=never)) is None


def test_the_papers_figures_are_written_as_it_gives_them():
    texts = {claim.paper: paper_text(claim) for claim in CLAIMS}
    assert texts["table_held_out"] == "85 % (82 to 88)"
    assert texts["table_training_median_rad"] == "0.12 to 0.13"
    assert texts["air_time_s"] == "below 7" and texts["air_by_truth"] == "80.9 %"


@pytest.mark.slow
def test_on_a_table_of_other_friction_and_in_the_air(tmp_path, monkeypatch, capsys):
    chosen = tuple(c for c in CONDITIONS if c.name in ("symmetric", "friction-0.05", "air"))
    monkeypatch.setattr(suite_run, "CONDITIONS", chosen)
    flags = ["dclaw4-cube", "--suite", "paper", "--quick", "--jobs", "2", "--device", "cpu"]
    assert main([*flags, "--objects", *SYMMETRIC, "--out", str(tmp_path), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)["figures"]
    assert {figure["condition"] for figure in figures} == {c.name for c in chosen}
    friction = Comparison.read(tmp_path / "friction-0.05" / "dclaw4-cube" / "eval.json")
    nominal = Comparison.read(tmp_path / "symmetric" / "dclaw4-cube" / "eval.json")
    assert friction.rows[0].result.protocol.table_friction == 0.05
    starts = [[e.start_quat for e in part.rows[0].result.episodes] for part in (friction, nominal)]
    np.testing.assert_allclose(*starts, atol=1e-6)
    ends = [[e.error_rad for e in part.rows[0].result.episodes] for part in (friction, nominal)]
    assert not np.allclose(*ends), "the same starts and goals on another table"
