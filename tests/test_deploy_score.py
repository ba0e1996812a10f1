"""Scores of runs by motion capture: made-up runs whose object is known, exported as files."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vd.assets_usd.hands import load_hand
from vd.deploy.loop.log import LogWriter
from vd.deploy.loop.score import (
    MocapError,
    ScoreCfg,
    in_world,
    lines,
    read_mocap,
    score,
    stop_errors,
)
from vd.geometry.quaternions import rotation_distance
from vd.logs.hand_log import read_log
from vd.logs.log_format import JOINT_CHANNELS, STEP_COLUMNS

GOALS = 6
GOAL_S = 5.0
RATE = 12
ERRORS = np.array([0.05, 0.15, 0.3, 0.08, 0.5, 0.19])
"""Angle to each goal at its end [rad]."""
FIFTH_ENDS_BY_TIME = 4
QUARTER = Rotation.from_euler("z", 90, degrees=True)


class Run:
    """A log whose object turns evenly from each goal's error of 2 rad to ERRORS, and its true track."""

    def __init__(self, folder, monkeypatch, *, turn=None):
        generator = np.random.default_rng(4)
        hand = load_hand("dclaw3")
        goals = Rotation.random(GOALS, random_state=generator)
        axis = np.array([0.3, -0.5, 0.81])
        axis /= np.linalg.norm(axis)
        run = {
            "policy": "made up",
            "object": {"name": "cube", "set": "cube"},
            "goals": goals.as_quat().tolist(),
        }
        log = LogWriter(folder, hand, run, servo={})
        joints = {channel: np.zeros(hand.num_joints) for channel in JOINT_CHANNELS}
        steps = int(GOAL_S * RATE)
        self.t = np.arange(GOALS * steps) / RATE
        turns = []
        for number, goal in enumerate(goals):
            # Uneven in time, so that no two goals look alike to a search for the offset.
            share = np.linspace(0.0, 1.0, steps) ** (0.5 + 0.4 * number)
            angle = 2.0 + (ERRORS[number] - 2.0) * share
            for step in range(steps):
                here = number * steps + step
                turns.append((Rotation.from_rotvec(angle[step] * axis) * goal).as_quat())
                values = dict.fromkeys(STEP_COLUMNS, 0.0) | {
                    "goal": number,
                    "distance": angle[step] + 0.02,
                }
                now = log.started_s + self.t[here]
                log.step(now, now, joints, list(values.values()))
            end = self.t[(number + 1) * steps - 1]
            monkeypatch.setattr(
                "vd.deploy.loop.log.time.monotonic", lambda end=end: log.started_s + end
            )
            outcome = "time limit" if number == FIFTH_ENDS_BY_TIME else "stopped"
            log.event("stop", goal=number, outcome=outcome, distance=ERRORS[number] + 0.02)
        log.finish("all goals pursued")
        monkeypatch.undo()
        self.log = read_log(folder)
        self.turn = np.array(turns)
        if turn is not None:
            self.turn = (Rotation.from_quat(self.turn) * turn).as_quat()

    def export(self, path, *, start=0.0, lost=(), rate=60.0):
        """A plain export; ``start`` is its time at the log's beginning."""
        t = np.arange(0.0, self.t[-1] + 1.0, 1.0 / rate)
        row = np.clip(np.rint(t * RATE).astype(int), 0, len(self.t) - 1)
        rows = ["time,x,qx,qy,qz,qw,tracked"]  # and what else it tells
        for when, turn in zip(t, self.turn[row], strict=True):
            tracked = not any(low <= when <= high for low, high in lost)
            numbers = ",".join(f"{v:.6f}" for v in (0.1, *turn))
            rows.append(f"{start + when:.6f},{numbers},{int(tracked)}")
        path.write_text("\n".join(rows) + "\n")
        return path


@pytest.fixture
def run(tmp_path, monkeypatch):
    return Run(tmp_path / "log", monkeypatch)


NONE = np.array([[0.0, 0.0, 0.0, 1.0]])


def test_errors_are_those_at_the_stops_and_lost_markers_discard(run, tmp_path):
    ends = [stop.time_s for stop in run.log.stops]
    # At a stop, and on the way.
    lost = [
        (ends[2] - 0.5, ends[2] + 0.5),
        (ends[0] + 1.0, ends[0] + 2.0),
    ]
    mocap = read_mocap(run.export(tmp_path / "m.csv", lost=lost))
    errors = stop_errors(run.log, mocap, NONE, offset_s=0.0)
    assert np.isnan(errors).tolist() == [False, False, True, False, False, False]
    assert np.isinf(errors).tolist() == [False, False, False, False, True, False]
    np.testing.assert_allclose(errors[[0, 1, 3, 5]], ERRORS[[0, 1, 3, 5]], atol=1e-4)
    text = "\n".join(lines(run.log, errors))
    assert "5 trials scored, 1 discarded" in text
    median = float(text.partition("median error at 4 stops: ")[2].split()[0])
    assert median == pytest.approx(np.median(ERRORS[[0, 1, 3, 5]]), abs=0.006)
    assert "within 0.1 rad:  40 %" in text
    assert "within 0.2 rad:  80 %" in text  # the one out of time never


def test_seconds_since_1970_need_no_search(run, tmp_path):
    mocap = read_mocap(run.export(tmp_path / "m.csv", start=run.log.run["unix_s"]))
    assert stop_errors(run.log, mocap, NONE)[0] == pytest.approx(ERRORS[0], abs=1e-3)
    with pytest.raises(MocapError, match="right take"):
        stop_errors(run.log, mocap, NONE, offset_s=3600.0)


def test_symmetric_objects_count_up_to_their_symmetry(tmp_path, monkeypatch, capsys):
    """A cube that was put down a quarter turn further is scored as if it had not been."""
    turned = Run(tmp_path / "log", monkeypatch, turn=QUARTER)
    path = turned.export(tmp_path / "m.csv")
    cfg = ScoreCfg(log=tmp_path / "log", mocap=path, offset_s=0.0)
    assert score(cfg) == 0
    first = capsys.readouterr().out.splitlines()[1]
    assert first.split()[-2] == f"{np.degrees(ERRORS[0]):.0f}°"
    assert stop_errors(turned.log, read_mocap(path), NONE, offset_s=0.0)[0] > 1.0


def test_a_track_is_turned_into_the_hands_world(run, tmp_path):
    frame = Rotation.from_euler("z", 30, degrees=True) * Rotation.from_euler("x", 90, degrees=True)
    path = run.export(tmp_path / "m.csv", lost=[(0.5, 0.6)])
    path.write_text("\n".join([*path.read_text().splitlines()[:30], "9,,,,,,"]))
    mocap = in_world(read_mocap(path), world=tuple(frame.as_quat()), marker=(0.0, 0.0, 0.0, 1.0))
    assert not mocap.tracked[-1], "empty cells"
    turn = (frame * Rotation.from_quat(run.turn[0])).as_quat()
    assert rotation_distance(mocap.quat[0], turn) < 1e-5


def test_the_markers_frame_on_the_object_is_taken_out(run, tmp_path):
    path = run.export(tmp_path / "m.csv")
    mocap = in_world(read_mocap(path), world=(0, 0, 0, 1), marker=tuple(QUARTER.as_quat()))
    expected = (Rotation.from_quat(run.turn[0]) * QUARTER).as_quat()
    assert rotation_distance(mocap.quat[0], expected) < 1e-5


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("time,qx\n0,1\n", "no column 'qy'"),
        ("time,qx,qy,qz,qw\n0,0,0,0,one\n", "'one'"),
        ("time,qx,qy,qz,qw\n0,0,0,0,2\n1,0,0,0,2\n", "not 1"),
        ("time,qx,qy,qz,qw\n1,0,0,0,1\n0,0,0,0,1\n", "must rise"),
        ("time,qx,qy,qz,qw\n", "at least two samples"),
        ("", "at least two samples"),
    ],
)
def test_bad_exports_are_refused_by_name(tmp_path, text, why):
    path = tmp_path / "export.csv"
    path.write_text(text)
    with pytest.raises(MocapError, match=why) as error:
        read_mocap(path)
    assert "export.csv" in str(error.value)
