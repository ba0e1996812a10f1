"""The demo's student: what its runs are called with, what the page says of them, and a run in short."""

import json
from dataclasses import replace

import pytest

from vd.page import Page
from vd.train import cli
from vd.train.demo_stages import TimeUp
from vd.train.demo_student import (
    LEAST_STUDENT_MIN,
    PRESETS,
    STUDENT_MIN,
    add_student,
    student_commands,
    student_figure,
    student_files,
    summary,
    train_students,
)
from vd.train.metrics import PROGRESS_FILE
from vd.train.student import config


def student_rows(last: float, held_out: bool = True) -> list[dict]:
    """A training in which the error falls from 0.6 to ``last``."""
    errors = [0.6 + (last - 0.6) * i / 4 for i in range(5)]
    return [
        {
            "iteration": i + 1,
            "env_steps": 100 * (i + 1),
            "elapsed_s": 10.0 * (i + 1),
            "student/action_error": error,
            "student/zero_error": 0.55,
            "validation/action_error": error + 0.05 if held_out and i > 1 else None,
            "validation/zero_error": 0.5 if held_out and i > 1 else None,
        }
        for i, error in enumerate(errors)
    ]


def test_both_runs_share_the_time_and_go_on_where_they_were(tmp_path, monkeypatch):
    asked = []

    def run(arguments):
        asked.append(arguments)
        return 0

    monkeypatch.setattr(cli, "main", run)
    train_students(tmp_path, 3, minutes=100.0)
    minutes = [float(arguments[arguments.index("--max-minutes") + 1]) for arguments in asked]
    assert sum(minutes) == pytest.approx(STUDENT_MIN, abs=0.02)
    commands, files = student_commands(tmp_path, 3), student_files(tmp_path)
    for arguments, command, path in zip(asked, commands, files, strict=True):
        assert arguments[: len(command)] == command
        assert str(path.parent) in command and command[-2:] == ["--resume", "auto"]
    with pytest.raises(TimeUp):
        train_students(tmp_path, 3, minutes=0.9 * LEAST_STUDENT_MIN)
    monkeypatch.setattr(cli, "main", lambda arguments: 1)
    with pytest.raises(RuntimeError, match="failed"):
        train_students(tmp_path, 3, minutes=2.0)
    monkeypatch.setattr(cli, "main", lambda arguments: 130)
    with pytest.raises(KeyboardInterrupt):
        train_students(tmp_path, 3, minutes=2.0)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (student_rows(0.3), "0.35 on held-out episodes, where doing nothing has 0.50; it has begun"),
        (student_rows(0.5), "0.55 on held-out episodes, where doing nothing has 0.50; that is not yet"),
        (student_rows(0.5, held_out=False), "0.50 on its own states; no held-out episode had ended"),
    ],
)
def test_the_page_says_how_far_it_came(rows, words):
    text = summary(student_rows(0.1), rows)
    assert words in text and "from 0.60 to 0.10 in 50 s" in text
    axes = student_figure(student_rows(0.1), rows).axes
    assert [len(line.get_xdata()) for line in axes[0].lines] == [5, 5]


@pytest.mark.slow
def test_both_runs_in_short(tmp_path, monkeypatch):
    for name, preset in config.PRESETS.items():
        if name in PRESETS.values():

            def short(stage, preset=preset):
                cfg = preset(stage)
                held_out = min(1, cfg.dagger.validation_worlds)
                dagger = replace(cfg.dagger, rollout_steps=3, epochs=1, validation_worlds=held_out)
                task = replace(cfg.task, num_worlds=min(cfg.task.num_worlds, 2), at_rest=False)
                return replace(cfg, run=replace(cfg.run, max_steps=6), dagger=dagger, task=task)

            monkeypatch.setitem(config.PRESETS, name, short)
    train_students(tmp_path, 0, minutes=2.0)
    assert all(path.is_file() for path in student_files(tmp_path))
    for path in student_files(tmp_path):
        assert (
            json.loads((path.parent / PROGRESS_FILE).read_text().splitlines()[0])["student/zero_error"] > 0.0
        )
    page = Page("x")
    add_student(page, tmp_path)
    assert "By heart: the error" in page.html()
