"""The log of a run: appended whole, read also where it was cut short, and a recording for vd-gap."""

import json
import os
import threading
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
from simulated_clock import SimulatedClock

from vd.assets_usd.hands import load_hand
from vd.deploy.loop import run_page
from vd.deploy.loop.log import LogWriter
from vd.deploy.safety.safety import StopReport
from vd.logs.hand_log import is_log, read_log
from vd.logs.log_format import (
    FOUND_COLUMNS,
    JOINT_CHANNELS,
    STEP_COLUMNS,
    STEPS_FILE,
    TRUTH_COLUMNS,
    LogError,
)
from vd.logs.recording import read_recording
from vd.play.cli import main as play
from vd.play.render import OUT_OF_SIGHT
from vd.play.replay import Replay

STEPS = 30
SENT_S = 0.02
GOALS = [[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0]]


@pytest.fixture
def folder(tmp_path):
    """A log with two goals, the first of which was reached."""
    hand, clock = load_hand("dclaw3"), SimulatedClock()
    run = {
        "goals": GOALS,
        "object": {"name": "cube", "set": "cube"},
        "control_hz": 12.0,
        "tolerance_rad": 1.0,
    }
    log = LogWriter(tmp_path / "log", hand, run, servo={"p_gain": 200}, truth=True, clock=clock)
    for step in range(STEPS):
        wave = 0.3 * np.sin(0.5 * step + np.arange(9))
        joints = {channel: wave + 0.01 * i for i, channel in enumerate(JOINT_CHANNELS)}
        values = [float(step >= 10), 1.0, 0.5, 0.001, -0.03, 0.002, 0.02, 0.02, 0.0]
        assert len(values) == len(STEP_COLUMNS)
        now = clock.now()
        truth = [0.0, 0.0, 0.03, 0.0, 0.0, 0.0, 1.0, 0.1 * step]
        log.step(now, now + SENT_S, joints, values, truth, [0.1 * step] * 7)
        if step == 9:
            log.event("stop", goal=0, outcome="stopped", distance=0.2)
        clock.sleep(1 / 12)
    log.event("stop", goal=1, outcome="lost", distance=0.7)
    log.finish("all goals done", steps=STEPS)
    return tmp_path / "log"


def test_what_is_written_is_read(folder):
    log = read_log(folder)
    assert is_log(folder) and not is_log(folder.parent)
    assert log.run["end"] == {"reason": "all goals done", "steps": STEPS}
    np.testing.assert_allclose(log.columns["t"], np.arange(STEPS) / 12, atol=1e-6)
    expected = 0.3 * np.sin(0.5 * np.arange(STEPS)[:, None] + np.arange(9))
    np.testing.assert_allclose(log.channel("position"), expected + 0.01, atol=1e-6)
    assert log.object_pose.shape == (STEPS, 7) and log.object_pose[3, 2] == 0.03
    first, second = log.stops
    assert (first.outcome, second.outcome) == ("stopped", "lost")
    assert second.goal_quat == tuple(GOALS[1])
    assert len(TRUTH_COLUMNS) == 8


def test_a_log_is_shown(folder, tmp_path, capsys):
    shots = Replay(read_log(folder)).snapshots
    assert len(shots) == STEPS
    np.testing.assert_allclose(shots[5].joint_q[:9], read_log(folder).channel("position")[5])
    np.testing.assert_allclose(shots[12].goal_quat, GOALS[1])
    # Stopped 0.9 rad from its goal.
    assert [shot.success for shot in shots].index(True) == 9 and shots[-1].goals == 1
    assert [shot.fell for shot in shots].index(True) == STEPS - 1
    real = read_log(folder)  # where nobody knows the truth it is shown as it was found last
    for name in TRUTH_COLUMNS:
        del real.columns[name]
    for name in FOUND_COLUMNS:
        real.columns[name][[0, 4, 5]] = np.nan
    shots = Replay(real).snapshots
    np.testing.assert_allclose(
        [s.joint_q[9] for s in shots[1:7]], [0.1, 0.2, 0.3, 0.3, 0.3, 0.6], atol=1e-6
    )
    np.testing.assert_allclose(shots[0].joint_q[9:], OUT_OF_SIGHT)
    assert play([str(folder), "--video", str(tmp_path / "log.mp4")]) == 0
    assert iio.imread(tmp_path / "log.mp4").shape[0] == STEPS
    run = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(run | {"tolerance_rad": 0.8}))
    assert not any(shot.success for shot in Replay(read_log(folder)).snapshots)
    run["object"]["set"] = str(tmp_path / "gone.usda")
    (folder / "run.json").write_text(json.dumps(run))
    assert play([str(folder), "--video", str(tmp_path / "gone.mp4")]) == 1
    assert "cannot be shown" in capsys.readouterr().err


def test_without_its_encoder_there_is_a_page_without_a_film(folder, monkeypatch):
    monkeypatch.setattr(run_page, "find_spec", lambda _: None)
    log = read_log(folder)
    log.run.update(policy="one", twin=True)
    page = run_page.write_page(log, run_page.goal_results(log))
    assert "visual-dexterity[video]" in page.read_text() and not (folder / "run.mp4").exists()


@pytest.mark.parametrize(
    ("event", "said"),
    [
        (("finished", {}), "Ended: all goals done. | The torque of every motor is off."),
        (("Ctrl-C", {}), "Stopped: Ctrl-C. | The torque of every motor is off."),
        (
            ("lost the bus", {11: "motor 11 does not answer", 12: "it holds"}),
            "Stopped: lost the bus. | Motors that may still be on, cut their power: "
            "11 (motor 11 does not answer); 12 (it holds).",
        ),
        (None, "Ended: all goals done. | Nobody noted that the torque went off"),
    ],
)
def test_the_page_says_first_why_the_run_ended_and_which_motors_may_be_on(folder, event, said):
    if event is not None:
        (folder.parent / "other").mkdir()
        log = LogWriter(folder.parent / "other", load_hand("dclaw3"), {"goals": GOALS}, servo={})
        log.stopped(StopReport(event[0], 0.0, unreleased=event[1]))
        log.finish("all goals done")
        with (folder / "events.jsonl").open("a") as events:
            events.write((folder.parent / "other" / "events.jsonl").read_text())
    log = read_log(folder)
    log.run.update(policy="one", twin=True)
    page = run_page.write_page(log, run_page.goal_results(log), filmed=False).read_text()
    page = page.replace("&#39;", "'")
    first, second = said.split(" | ")
    assert page.index(first) < page.index(second) < page.index("goals reached")
    assert "vd-play" in page and "<video" not in page


def test_the_viewer_steps_through_a_log(folder, monkeypatch):
    session = Replay(read_log(folder))
    assert session.snapshot.table
    up = replace(session.hand, palm=-session.hand.palm)
    monkeypatch.setattr("vd.play.replay.load_hand", lambda _: up)
    assert not Replay(read_log(folder)).snapshot.table, "a palm that looks up has none"
    session.step()
    first = session.snapshot.time_s
    session.step()
    assert session.snapshot.time_s > first > 0.0
    session.new_goal()
    np.testing.assert_allclose(session.snapshot.goal_quat, GOALS[1])
    session.reset()
    for _ in range(STEPS):
        session.step()
    assert session.snapshot.time_s == 0.0


def test_the_log_is_a_recording(folder):
    recording = read_recording(folder)
    trajectory = recording.trajectories[0]
    np.testing.assert_allclose(trajectory.position, read_log(folder).channel("position"), atol=1e-9)
    assert recording.model == "dclaw3" and trajectory.current is not None
    np.testing.assert_allclose(trajectory.sent - trajectory.time, SENT_S, atol=1e-6)


def test_a_state_that_was_told_again_is_one_sample(folder):
    """Over a short gap of the bus the loop acts on the state before."""
    header, *rows = (folder / STEPS_FILE).read_text().splitlines()
    again = rows[11].split(",")
    again[:1], again[2:] = rows[10].split(",")[:1], rows[10].split(",")[2:]
    rows[11] = ",".join(again)
    (folder / STEPS_FILE).write_text("\n".join([header, *rows]) + "\n")
    assert len(read_log(folder).columns["t"]) == STEPS
    assert len(read_recording(folder).trajectories[0].time) == STEPS - 1


def test_a_log_cut_short_is_read_to_its_last_whole_row(folder):
    """Killed while it ran: no end, a torn row, a torn event."""
    run = json.loads((folder / "run.json").read_text())
    del run["end"]
    (folder / "run.json").write_text(json.dumps(run))
    whole = (folder / STEPS_FILE).read_bytes()
    (folder / STEPS_FILE).write_bytes(whole[: len(whole) - 150])
    events = (folder / "events.jsonl").read_text()
    (folder / "events.jsonl").write_text(events[:-20])
    log = read_log(folder)
    assert len(log.columns["t"]) == STEPS - 1 and len(log.stops) == 2


def test_the_loop_does_not_wait_for_the_disk(tmp_path, monkeypatch):
    log = LogWriter(tmp_path / "log", load_hand("dclaw3"), {"goals": GOALS}, servo={})
    busy, write = threading.Event(), os.write
    monkeypatch.setattr("vd.deploy.loop.log.os.write", lambda *a: busy.wait(60.0) and write(*a))
    joints = dict.fromkeys(JOINT_CHANNELS, np.zeros(9))
    for step in range(3):
        now = log.started_s + step
        log.step(now, now, joints, [0.0] * len(STEP_COLUMNS))  # nothing is written yet
    assert len((tmp_path / "log" / STEPS_FILE).read_text().splitlines()) <= 1
    busy.set()
    log.finish("done")
    np.testing.assert_allclose(read_log(tmp_path / "log").columns["t"], [0.0, 1.0, 2.0])


def test_a_full_disk_is_told(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    log = LogWriter(tmp_path / "log", load_hand("dclaw3"), {"goals": GOALS}, servo={})
    monkeypatch.setattr("vd.deploy.loop.log.os.write", full)
    with pytest.raises(OSError, match=r"log: No space left.*free"):
        log.finish("done")


def test_what_is_no_log_is_refused(folder, tmp_path):
    with pytest.raises(LogError, match=r"run\.json"):
        read_log(tmp_path)
    run = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**run, "format": "vd-hand-log/0"}))
    with pytest.raises(LogError, match="this version reads"):
        read_log(folder)
    with pytest.raises(FileExistsError):
        LogWriter(folder, load_hand("dclaw3"), {}, servo={})
