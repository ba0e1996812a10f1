"""Recordings of other programs, each made here by its own library, come out as what was put in."""

import json

import numpy as np
import pytest

from vd.gap.cli import main
from vd.logs.recording import read_recording

RATE, COUNT = 100.0, 2.0 * np.pi / 4096
TIME = np.arange(400) / RATE
COMMAND = np.stack([0.5 * np.sin(2.0 * TIME), 0.3 * np.sin(3.0 * TIME)], axis=1)
POSITION = COUNT * np.round(0.9 * np.roll(COMMAND, 6, axis=0) / COUNT)
POSITION[:6] = POSITION[6]
JOINTS = ("elbow", "wrist")


def csv(folder):
    table = np.column_stack([1e3 * TIME, np.degrees(COMMAND), np.degrees(POSITION)])
    names = [f"{c}.{j} [deg]" for c in ("command", "position") for j in JOINTS]
    header = ",".join(["clock [ms]", *names])
    np.savetxt(folder / "a.csv", table, "%.9f", ",", header=header, comments="")
    return folder / "a.csv", ["--rename", "clock=t"]


def bam(folder):
    keys = ("timestamp", "goal_position", "position")
    rows = [
        dict(zip(keys, map(float, row), strict=True)) for row in zip(TIME, *_first(), strict=True)
    ]
    log = {"mass": 0.4, "length": 0.1, "kp": 8, "vin": 12.0, "trajectory": "sin", "entries": rows}
    (folder / "log.json").write_text(json.dumps(log))
    return folder / "log.json", ["--rename", "pendulum=elbow"]


def _first():
    return COMMAND[:, 0], POSITION[:, 0]


def lerobot(folder):
    pa = pytest.importorskip("pyarrow")
    pq = pytest.importorskip("pyarrow.parquet")
    feature = {"dtype": "float32", "names": {"motors": [f"{joint}.pos" for joint in JOINTS]}}
    (folder / "meta").mkdir()
    info = {"features": {"action": feature, "observation.state": feature}}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    (folder / "data" / "chunk-000").mkdir(parents=True)
    columns = {"episode_index": np.zeros(len(TIME), int), "timestamp": TIME}
    columns |= {
        "action": list(np.degrees(COMMAND)),
        "observation.state": list(np.degrees(POSITION)),
    }
    pq.write_table(pa.table(columns), folder / "data" / "chunk-000" / "file-000.parquet")
    return folder, ["--unit", "deg"]


def ros(folder, *, mcap=False):
    writers = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = store.types
    plugin = writers.StoragePlugin.MCAP if mcap else writers.StoragePlugin.SQLITE3
    state, array = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
    with writers.Writer(folder / "bag", version=9, storage_plugin=plugin) as writer:
        to = {
            kind: writer.add_connection(f"/{i}", kind, typestore=store)
            for i, kind in enumerate((state, array))
        }
        layout = kinds["std_msgs/msg/MultiArrayLayout"]([], 0)
        for t, command, position in zip(TIME, COMMAND, POSITION, strict=True):
            stamp = round(1e9 * (t + 1e3))
            header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](7, 0), "")
            told = kinds[array](layout, command)
            measured = kinds[state](header, list(JOINTS), position, np.zeros(0), np.zeros(0))
            gripper = kinds[state](header, ["gripper"], np.ones(1), np.ones(1), np.zeros(0))
            turned = kinds[state](
                header, list(JOINTS[::-1]), position[::-1].copy(), np.zeros(0), np.zeros(0)
            )
            measured = turned if round(t * RATE) % 2 else measured  # names say which is which
            for kind, message, late in (
                (array, told, 0),
                (state, measured, 1_000_000),
                (state, gripper, 2_000_000),  # of another device, on the same topic
            ):
                writer.write(to[kind], stamp + late, store.serialize_cdr(message, kind))
    return (folder / "bag" / "bag.mcap" if mcap else folder / "bag"), []


def mcap(folder):
    return ros(folder, mcap=True)


@pytest.mark.parametrize("make", [csv, bam, lerobot, ros, mcap])
def test_a_sample_of_each_format_is_read_as_it_was_made(make, tmp_path, capsys):
    (tmp_path / "in").mkdir()
    source, flags = make(tmp_path / "in")
    out = tmp_path / "rec"
    assert (
        main(["convert", str(source), "--out", str(out), "--counts-per-turn", "4096", *flags]) == 0
    )
    recording = read_recording(out)
    (motion,) = recording.trajectories
    joints = len(recording.joints)
    assert recording.joints == JOINTS[:joints] and motion.joints == recording.joints
    np.testing.assert_allclose(motion.time, TIME, atol=2e-6)
    np.testing.assert_allclose(motion.command, COMMAND[:, :joints], atol=2e-6)
    np.testing.assert_allclose(motion.position, POSITION[:, :joints], atol=2e-6)
    np.testing.assert_allclose(motion.sent, TIME - 1e-3 * (make in (ros, mcap)), atol=2e-6)
    assert motion.conditions.get("p_gain", 8) == 8 and (motion.excitation == "sin") == (make is bam)
    before = (out / "recording.json").read_bytes()
    assert (
        main(["convert", str(source), "--out", str(out), "--counts-per-turn", "4096", *flags]) == 1
    )
    assert (
        out / "recording.json"
    ).read_bytes() == before and "name another folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("make", "flags", "said"),
    [
        (csv, [], "no column 't'"),
        (csv, ["--rename", "clock [ms]=t [h]"], "write 't [s] or [ms]"),
        (csv, ["--rename", "clock=t", "--joints", "hip"], "no joint 'hip'; there are elbow, wrist"),
        (
            csv,
            ["--rename", "clock=t", "command.wrist [deg]=x", "--joints", "wrist"],
            "command of wrist has gaps",
        ),
        (csv, ["--rename", "clock=t", "elbow angle=x"], "has no 'elbow angle'"),
        (csv, ["--rename", "clock=t", "--out", "."], "a.csv, which would be lost"),
        (
            csv,
            ["--rename", "clock=t", "command.wrist [deg]=command.elbow [deg]"],
            "two columns are",
        ),
        (csv, ["--format", "bam"], "no log of BAM"),
        (
            csv,
            ["--rename", "clock=t", "--command-topic", "/goal"],
            "read as csv, which has no topics",
        ),
        (lerobot, [], "give --unit deg or rad"),
        (ros, ["--state-topic", "/nosuch"], "/nosuch is none; give --state-topic"),
    ],
)
def test_what_a_source_does_not_say_is_asked_for(make, flags, said, tmp_path, capsys, monkeypatch):
    source, _ = make(tmp_path)
    out = tmp_path / "rec"
    monkeypatch.chdir(tmp_path)
    assert (
        main(["convert", str(source), "--out", str(out), "--counts-per-turn", "4096", *flags]) != 0
    )
    assert said in capsys.readouterr().err and not out.exists()
