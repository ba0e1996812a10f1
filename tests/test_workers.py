"""Tasks of a battery: one that hangs or dies costs itself only."""

import multiprocessing
import os
import time
from pathlib import Path

from vd.workers import SINGLE, run_tasks


def work(task):
    what, value = task
    if what == "hang":
        time.sleep(600)
    if what == "die":
        os._exit(9)
    if what == "threads":
        return [os.environ.get(name) for name in (*SINGLE, "CUDA_VISIBLE_DEVICES")]
    return 2 * value


def test_tasks_that_hang_or_die_cost_themselves_only():
    tasks = [("double", 1), ("die", 2), ("hang", 3), ("double", 4), ("double", 5)]
    results, reasons = {}, {}

    def finished(task, result, why):
        results[task], reasons[task] = result, why

    run_tasks(work, tasks, finished, jobs=2, limit_s=10.0)
    assert [results[task] for task in tasks] == [2, None, None, 8, 10]
    assert "died" in reasons[tasks[1]] and "longer than 10 s" in reasons[tasks[2]]
    assert not any(reasons[task] for task in (tasks[0], tasks[3], tasks[4]))


def test_workers_have_one_thread_each_and_no_gpu():
    before = dict(os.environ)
    answers = []
    run_tasks(work, [("threads", 0)], lambda task, result, why: answers.append(result), jobs=1, limit_s=60.0)
    assert answers == [["1"] * len(SINGLE) + [""]]
    assert dict(os.environ) == before


def begin_and_wait(folder):
    """Of a process that is then killed: one worker that says its number and hangs."""
    run_tasks(say_and_hang, [folder], lambda *a: None, jobs=1, limit_s=600.0)


def say_and_hang(folder):
    (folder / "began").write_text(str(os.getpid()))
    time.sleep(600)


def wait_for(condition):
    end = time.monotonic() + 60.0
    while not condition() and time.monotonic() < end:
        time.sleep(0.1)
    return condition()


def test_a_worker_ends_with_a_parent_that_is_killed(tmp_path):
    parent = multiprocessing.get_context("spawn").Process(target=begin_and_wait, args=(tmp_path,))
    parent.start()
    try:
        assert wait_for(lambda: (tmp_path / "began").exists() and (tmp_path / "began").read_text())
    finally:
        parent.kill()
        parent.join()
    worker = Path("/proc") / (tmp_path / "began").read_text() / "cmdline"
    # A process that ended but was not waited for has no command line any more.
    assert wait_for(lambda: not worker.exists() or not worker.read_bytes())
