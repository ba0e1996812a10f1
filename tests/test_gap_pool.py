"""Fits one by one and in processes."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gap_recordings import TRUE, made_up, recorded

import vd.kernels.servo.actuators as servo
from vd.gap.assemble import curves
from vd.gap.bench.hide import Hiding, hide
from vd.gap.chain import chains
from vd.gap.design import design
from vd.gap.fit import JointProblem, JointSpec, Problems
from vd.gap.rollout import STEP_S, Rollouts
from vd.gap.statistics import noise_floor
from vd.gap.worker_pool import WorkerPool
from vd.gap.workflow import baseline_of

EFFECTS = ("coulomb_friction", "backlash", "load_friction")


def fits(pool: WorkerPool, problems: Problems, spec: JointSpec) -> list[Any]:
    base = problems.chains[0].start_row.copy()
    for column, value in TRUE.items():
        base[0, column] = 1.1 * value
    scales = pool.run(spec, [partial(JointProblem.scales, row=base[0], residual=0.02)])[0]
    fit = partial(JointProblem.fit, base=base, starts=[{}], scales=scales, iterations=3)
    return pool.run(spec, [partial(fit, effects=(effect,)) for effect in EFFECTS])


def problem(extra: dict[int, float]) -> tuple[Problems, JointSpec]:
    """A made-up recording of a servo, and what makes the problem of its joint."""
    recording = recorded(extra)
    (chain,) = chains(recording)
    trajectories, folds, _ = design(recording, chain, 0)
    spec = JointSpec(0, 0, trajectories, folds, noise_floor(recording, 0), baseline_of(chain))
    return Problems(recording, [chain], STEP_S, "cpu"), spec


def test_processes_find_what_one_alone_finds() -> None:
    problems, spec = problem({servo.COULOMB_TORQUE: 0.06})
    with WorkerPool(problems.of, workers=1) as pool:
        alone = fits(pool, problems, spec)
    problems, spec = problem({servo.COULOMB_TORQUE: 0.06})
    with WorkerPool(problems.of, workers=2) as pool:
        for one, other in zip(alone, fits(pool, problems, spec), strict=True):
            np.testing.assert_array_equal(one.x, other.x)
            np.testing.assert_array_equal(one.held_out, other.held_out)


def test_a_worker_that_is_killed_ends_the_run_with_what_to_change() -> None:
    problems, spec = problem({})
    others = multiprocessing.active_children()
    with WorkerPool(problems.of, workers=2) as pool:
        fits(pool, problems, spec)
        for process in multiprocessing.active_children():
            if process not in others:
                process.kill()
        with pytest.raises(ChildProcessError, match=r"of 2 .*killed.*memory"):
            pool.run(spec, [partial(JointProblem.scales, row=np.ones(99), residual=0.03)])


@pytest.mark.parametrize("after_s", [0.3, 3.0, 6.0])
def test_ctrl_c_ends_an_analysis_at_once(after_s: float, tmp_path: Path) -> None:
    """While modules are imported, while processes start, and while they fit."""
    hide(Hiding("servo", {"load_friction": {"k_load": 0.3}}, seed=5), tmp_path / "rec")
    command = [sys.executable, "-m", "vd.gap.cli", "run", "rec", "--out", "gap"]
    run = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    assert run.stderr is not None and "starting" in run.stderr.readline()
    time.sleep(after_s)
    os.kill(run.pid, signal.SIGINT)
    # The goal is 2 s of idle processors; what runs beside makes it longer.
    waiting = os.getloadavg()[0] / len(os.sched_getaffinity(0))
    assert run.wait(timeout=2.0 * max(1.0, waiting)) == 130


def test_the_curves_of_a_report_do_not_show_the_step_of_the_search() -> None:
    problems, spec = problem({servo.TORQUE_LIMIT: 0.8, servo.LOAD_FRICTION: 0.2})
    recording, (chain,) = problems.recording, problems.chains
    rows = chain.start_row.copy()
    for column, value in {**TRUE, servo.TORQUE_LIMIT: 0.8, servo.LOAD_FRICTION: 0.2}.items():
        rows[0, column] = value
    exact = Rollouts(chain, recording, dt=STEP_S / 32).predict(rows[None])[0]
    drawn = curves(problems, [spec], [replace(made_up((), 0.0), rows=rows)])
    searched = Rollouts(chain, recording, dt=STEP_S).predict(rows[None])[0]
    assert np.std(drawn - exact) < 0.25 * np.std(searched - exact)
