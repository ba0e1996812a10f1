"""Real-time priority: of every thread, for the loop is watched by others than its own."""

import os
import threading

import pytest

from vd.deploy.timely import real_time

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="needs Linux")


def test_all_threads_run_before_other_programs_and_not_after():
    end = threading.Event()

    def start() -> int:
        thread = threading.Thread(target=end.wait, daemon=True)
        thread.start()
        return thread.native_id

    before = start()
    with real_time("auto") as permitted:
        if not permitted:
            pytest.skip("this system permits no real-time priority")
        inside = start()
        assert [os.sched_getscheduler(thread) for thread in (0, before, inside)] == [os.SCHED_RR] * 3
    assert [os.sched_getscheduler(thread) for thread in (0, before)] == [os.SCHED_OTHER] * 2
    end.set()


def test_where_it_is_not_permitted_it_is_done_without_or_refused(monkeypatch):
    def refuse(*_):
        raise PermissionError("Operation not permitted")

    monkeypatch.setattr("vd.deploy.timely.os.sched_setscheduler", refuse)
    with real_time("auto") as permitted:
        assert not permitted
    with pytest.raises(OSError, match="ulimit -r 1"), real_time("on"):
        pass
