"""Tasks of a battery: one that fails, hangs or dies costs itself only."""

import os
import time

from vd.command.workers import SINGLE, run_tasks


def work(task):
    what, value = task
    if what == "hang":
        time.sleep(600)
    if what == "die":
        os._exit(9)
    if what == "fail":
        raise MemoryError("40 GiB")
    if what == "threads":
        return [os.environ.get(name) for name in (*SINGLE, "CUDA_VISIBLE_DEVICES")]
    return 2 * value


def test_tasks_that_fail_hang_or_die_cost_themselves_only():
    tasks = [("double", 1), ("die", 2), ("hang", 3), ("double", 4), ("fail", 5)]
    results, reasons = {}, {}

    def finished(task, result, why):
        results[task], reasons[task] = result, why

    run_tasks(work, tasks, finished, jobs=2, limit_s=10.0)
    assert [results[task] for task in tasks] == [2, None, None, 8, None]
    assert "died" in reasons[tasks[1]] and "longer than 10 s" in reasons[tasks[2]]
    assert reasons[tasks[4]] == "MemoryError: 40 GiB"
    assert not any(reasons[task] for task in (tasks[0], tasks[3]))


def test_workers_have_one_thread_each_and_no_gpu():
    before = dict(os.environ)
    answers = []
    run_tasks(
        work,
        [("threads", 0)],
        lambda task, result, why: answers.append(result),
        jobs=1,
        limit_s=60.0,
    )
    assert answers == [["1"] * len(SINGLE) + [""]]
    assert dict(os.environ) == before
