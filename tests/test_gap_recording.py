"""Recordings: what is written is read, and what cannot be used is refused with file, place and remedy."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vd.gap.bench.hide import Hiding, simulate_hidden
from vd.logs.recording import Recording, RecordingError, Trajectory, read_recording, write_recording
from vd.logs.recording_checks import cautions, check_motion

SAMPLES = 200
COUNT = 2.0 * np.pi / 4096


def example(joints=("f0_j1", "f0_j2"), model="dclaw3", **channels) -> Recording:
    time = np.arange(SAMPLES) / 100.0
    command = np.stack([0.3 * np.sin((j + 2) * time) for j in range(len(joints))], axis=1)
    position = np.round(0.95 * command / COUNT) * COUNT
    on = np.ones((SAMPLES, len(joints)), dtype=bool)
    trajectory = Trajectory(
        "a.csv",
        "sine",
        joints,
        {"p_gain": 400.0, "grease": "new"},
        time,
        command,
        position,
        channels.pop("enabled", on),
        **channels,
    )
    return Recording(Path(), model, joints, {"model": "X"}, COUNT, (trajectory,))


@pytest.fixture
def folder(tmp_path):
    return write_recording(example(), tmp_path / "recording")


def edit_table(folder, change):
    rows = [line.split(",") for line in (folder / "a.csv").read_text().splitlines()]
    rows = change(rows) or rows
    (folder / "a.csv").write_text("\n".join(",".join(row) for row in rows) + "\n")


def set_cells(column, value, rows=range(1, SAMPLES + 1)):
    def change(table):
        index = table[0].index(column)
        for row in rows:
            cell = table[row][index]
            table[row][index] = value(float(cell)) if callable(value) else value

    return change


def refused(folder, *words):
    with pytest.raises(RecordingError) as error:
        read_recording(folder)
    for word in words:
        assert word in str(error.value)


def test_what_is_written_is_read(tmp_path):
    enabled = np.ones((SAMPLES, 2), dtype=bool)
    enabled[120:, 0] = False
    voltage = np.full((SAMPLES, 2), 7.4)
    voltage[:, 1] = np.nan  # measured on one joint only
    written = example(enabled=enabled, voltage=voltage)
    read = read_recording(write_recording(written, tmp_path / "r"))
    (a,), (b,) = written.trajectories, read.trajectories
    assert (read.joints, read.model, read.servo) == (written.joints, written.model, written.servo)
    assert (b.joints, b.conditions, b.excitation) == (a.joints, a.conditions, a.excitation)
    for name in ("time", "command", "position", "voltage"):
        np.testing.assert_allclose(getattr(b, name), getattr(a, name), atol=1e-6)
    np.testing.assert_array_equal(b.enabled, enabled)
    assert b.current is None and b.time.dtype == np.float64
    assert read_recording(tmp_path / "r" / "recording.json").joints == read.joints


def test_commands_may_be_sent_at_other_times_than_the_stamps(tmp_path):
    sent = np.arange(SAMPLES) / 100.0 - 0.0003
    folder = write_recording(example(command_time=sent), tmp_path / "r")
    (read,) = read_recording(folder).trajectories
    np.testing.assert_allclose(read.sent, sent, atol=1e-6)
    np.testing.assert_array_equal(read.piece(50, 90).sent, read.sent[50:90])
    for column in ("t", "t_command"):
        edit_table(folder, set_cells(column, lambda t: f"{5.0 + t + 1e-5 * np.sin(50 * t):.6f}"))
    (late,) = read_recording(folder).trajectories
    assert late.time[0] == 0.0 and np.ptp(np.diff(late.time)) > 1e-6  # it need not be regular
    np.testing.assert_allclose(late.sent, sent, atol=1.2e-5)
    edit_table(folder, set_cells("t_command", "5.1", [7]))
    refused(folder, "a.csv", "'t_command' runs backward")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format": "vd-recording/9"}, ("format", "vd-recording/9", "vd-recording/1")),
        ({"model": "dclaw7"}, ("no hand is called 'dclaw7'", "dclaw3", "servo")),
        ({"joints": ["f0_j1", "f9_j2"]}, ("unknown joint 'f9_j2'", "f2_j3")),
        ({"encoder_resolution_rad": None}, ("encoder_resolution_rad", "0.001534")),
        ({"encoder_resolution_rad": 360.0 / 4096}, ("degrees", "0.001534")),
        ({"encoder_resolution_rad": 4096}, ("encoder_resolution_rad", "0.001534")),
        ({"servo": {"kp_nm_rad": "stiff"}}, ("servo.kp_nm_rad", "'stiff'", "N m/rad")),
        ({"trajectories": []}, ("trajectories", "empty")),
        ({"trajectories": [{"file": "b.csv", "joints": ["f0_j1"]}]}, ("b.csv", "no such file")),
        ({"trajectories": [{"file": "../a.csv", "joints": ["f0_j1"]}]}, ("folder",)),
        (
            {
                "trajectories": [
                    {"file": "a.csv", "joints": ["f0_j1"], "conditions": {"payload_kg": -0.2}}
                ]
            },
            ("trajectories[0]", "'payload_kg'", "-0.2", "not negative"),
        ),
        (
            {"trajectories": [{"file": "a.csv", "joints": ["f0_j1"]}] * 2},
            ("'a.csv'", "twice", "once"),
        ),
    ],
)
def test_a_header_that_cannot_be_used_is_refused(folder, changes, words):
    header = json.loads((folder / "recording.json").read_text()) | changes
    kept = {key: value for key, value in header.items() if value is not None}
    (folder / "recording.json").write_text(json.dumps(kept))
    refused(folder, *words)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: [row[:-1] for row in t], ("row 1", "no column 'position.f0_j2'")),
        (lambda t: t[0].__setitem__(1, "command.f0_j9"), ("row 1", "unknown joint 'f0_j9'")),
        (
            lambda t: [t[0], ["s", *["rad"] * (len(t[0]) - 1)], *t[1:]],
            ("row 2", "'t'", "s is not a finite"),
        ),
        (
            set_cells("t", lambda t: f"{1e3 * t:.3f}"),
            ("'t'", "10 s without a sample", "milliseconds"),
        ),
        (lambda t: t[:4], ("3 samples", "at least")),
        (lambda t: [*t[:50], t[48], *t[50:]], ("row 51", "'t'", "runs backward")),
        (set_cells("position.f0_j1", "nan", [7]), ("row 8", "'position.f0_j1'", "nan")),
        (lambda t: t[30].append("0"), ("row 31", "cells")),
        (
            set_cells("position.f0_j2", lambda q: f"{np.degrees(q):.6f}"),
            ("position.f0_j2", "degrees"),
        ),
        (set_cells("position.f0_j2", lambda q: f"{-q:.6f}"), ("position.f0_j2", "sign")),
        (set_cells("position.f0_j1", "0.1"), ("position.f0_j1", "dead encoder")),
    ],
)
def test_a_table_that_cannot_be_used_is_refused(folder, change, words):
    edit_table(folder, change)
    refused(folder, *words)


def test_commands_that_never_move_are_refused(folder):
    edit_table(folder, set_cells("command.f0_j1", "0.2"))
    read_recording(folder)  # one joint at rest is no fault
    edit_table(folder, set_cells("command.f0_j2", "0.2"))
    refused(folder, "no 'command.' column moves", "record")


def test_torque_is_on_or_off_and_a_servo_that_is_off_has_no_dead_encoder(tmp_path, folder):
    recording = example(enabled=np.zeros((SAMPLES, 2), dtype=bool))
    recording.trajectories[0].position[:, 0] = 0.1
    read_recording(write_recording(recording, tmp_path / "off"))
    cells = ["enabled.f0_j1", "0", "0.5", *["1"] * (SAMPLES - 2)]
    edit_table(folder, lambda table: [[*row, cell] for row, cell in zip(table, cells, strict=True)])
    refused(folder, "a.csv", "row 3", "'enabled.f0_j1'", "0.5", "0 or 1")


def test_an_encoder_that_only_flickers_is_dead(tmp_path):
    recording = example()
    (trajectory,) = recording.trajectories
    trajectory.position[:, 1] = COUNT * np.random.default_rng(0).integers(-1, 2, SAMPLES)
    refused(
        write_recording(recording, tmp_path / "r"),
        "a.csv",
        "position.f0_j2",
        "flickers",
        "dead encoder",
    )
    moves = replace(trajectory, file="b.csv", position=0.9 * trajectory.command)
    whole = replace(recording, trajectories=(trajectory, moves))
    read_recording(write_recording(whole, tmp_path / "sticks"))  # it may stick in one motion


def test_files_of_a_spreadsheet_are_read(folder):
    plain = read_recording(folder).trajectories[0]
    for file in ("recording.json", "a.csv"):  # a byte order mark, and lines that end in CR LF
        text = (folder / file).read_text()
        (folder / file).write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    marked = read_recording(folder).trajectories[0]
    np.testing.assert_array_equal(marked.position, plain.position)
    assert marked.conditions == plain.conditions
    german = text.replace(".", "#").replace(",", ";").replace("#", ",").replace(",f0", ".f0")
    (folder / "a.csv").write_text(german)
    np.testing.assert_array_equal(read_recording(folder).trajectories[0].position, plain.position)


def test_small_motions_in_degrees_show_in_the_encoder_counts(tmp_path):
    small = example()
    (trajectory,) = small.trajectories
    for values in (trajectory.command, trajectory.position):
        values[:] = np.degrees(np.round(values / 3.0 / COUNT) * COUNT)
    refused(
        write_recording(small, tmp_path / "r"),
        "degrees",
        "encoder_resolution_rad",
        "position.f0_j1",
    )


def test_telemetry_out_of_range_is_refused(tmp_path):
    for channel, value, remedy in (
        ("pwm", 400.0, "full scale"),
        ("velocity", 400.0, "write rad/s"),
    ):
        off = example(**{channel: np.full((SAMPLES, 2), value)})
        refused(write_recording(off, tmp_path / channel), f"{channel}.f0_j1", "row 2", remedy)


LAG_S = 0.08
AT_100_HZ = np.arange(1000) / 100.0


def servo(amplitude=0.05, middle=0.0, **channels) -> Recording:
    """Ten seconds of a servo that follows two sines 80 ms late, with noise in place of counts."""

    def moves(time):
        return middle + amplitude * (np.sin(2.0 * time) + 0.5 * np.sin(5.0 * time))

    noise = 1e-4 * np.random.default_rng(0).normal(size=len(AT_100_HZ))
    arrays = {
        "time": AT_100_HZ,
        "command": moves(AT_100_HZ)[:, None],
        "position": (moves(AT_100_HZ - LAG_S) + noise)[:, None],
        "enabled": np.ones((len(AT_100_HZ), 1), dtype=bool),
        **channels,
    }
    whole = example(("joint",), "servo")
    return replace(whole, trajectories=(replace(whole.trajectories[0], **arrays),))


SOUND = servo().trajectories[0]
SPEED = np.gradient(SOUND.position, AT_100_HZ, axis=0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"command": SOUND.position, "position": SOUND.command}, ("swapped", "before its command")),
        (
            {"position": np.roll(SOUND.command, -20, axis=0)},
            ("200 ms before its command", "two clocks"),
        ),
        ({"position": SOUND.command}, ("position.joint", "copy of its command")),
        ({"command_time": 1e3 * AT_100_HZ}, ("t_command", "another unit or clock")),
        ({"command_time": AT_100_HZ + 3.0}, ("t_command", "or drop it")),
        (
            {"time": AT_100_HZ + 5.0 * (AT_100_HZ > 4.0)},
            ("row 403", "'t'", "5.01 s without", "cut the file"),
        ),
    ],
)
def test_a_recording_of_other_clocks_units_or_columns_is_refused_by_its_cause(
    tmp_path, change, words
):
    change = {name: np.array(values) for name, values in change.items()}
    refused(write_recording(servo(**change), tmp_path / "r"), *words)


def test_a_servo_that_lags_and_tells_its_speed_is_read(tmp_path):
    read_recording(
        write_recording(servo(velocity=SPEED, command_time=AT_100_HZ - 0.004), tmp_path / "r")
    )


def wrapped(angle):
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def test_angles_wrapped_at_pi_are_refused(tmp_path):
    true = servo(amplitude=0.8, middle=np.pi)
    (t,) = read_recording(write_recording(true, tmp_path / "sound")).trajectories
    jumps = replace(true, trajectories=(replace(t, position=wrapped(t.position)),))
    refused(
        write_recording(jumps, tmp_path / "r"), "position.joint", "jumps by a turn", "numpy.unwrap"
    )


def test_large_effects_of_real_servos_are_no_faults_of_the_recording(tmp_path):
    effects = {
        "command_delay": {"delay_s": 0.3},
        "stribeck_friction": {"tau_s_nm": 0.9, "tau_c_nm": 0.5, "v_s_rad_s": 0.3},
        "encoder_bias": {"bias_rad": 0.3},
        "backlash": {"width_rad": 0.1},
    }
    hidden = simulate_hidden(Hiding("servo", effects=effects))
    read_recording(write_recording(hidden.recording, tmp_path / "r"))


def test_a_file_that_is_none_is_refused(tmp_path, folder):
    refused(tmp_path / "nowhere", "nowhere", "no such file")
    for name, text, words in (("a.csv", "", "empty"), ("recording.json", "{", "not JSON")):
        (folder / name).write_text(text)
        refused(folder, name, words)


@pytest.mark.parametrize(
    ("name", "model", "joints", "trajectories"),
    [("so101", "servo", 6, 20), ("xl330_pendulum", "pendulum", 1, 12)],
)
def test_real_recordings_are_read(shared_dir, name, model, joints, trajectories):
    recording = read_recording(shared_dir / "measured" / name)
    assert recording.model == model
    assert (len(recording.joints), len(recording.trajectories)) == (joints, trajectories)
    released = [t.excitation for t in recording.trajectories if not t.enabled.all()]
    assert set(released) == ({"lift_and_drop"} if model == "pendulum" else set())
    swapped = [replace(t, command=t.position, position=t.command) for t in recording.trajectories]
    with pytest.raises(RecordingError, match="swapped"):
        check_motion(replace(recording, trajectories=tuple(swapped)))
    for trajectory in recording.trajectories:  # one motion alone tells less
        if np.ptp(trajectory.command, axis=0).any():
            check_motion(replace(recording, trajectories=(trajectory,)))


@pytest.fixture(scope="module")
def machine():
    hidden = simulate_hidden(Hiding("servo", joints=("a", "b")))
    return hidden.recording


def test_joints_that_no_motion_or_few_move_are_named(machine):
    assert cautions(machine) == ()
    first = replace(
        machine, trajectories=tuple(t for t in machine.trajectories if t.joints == ("a",))
    )
    (idle,) = cautions(first)
    assert "No motion moves b" in idle
    few = replace(first, trajectories=first.trajectories[:2])
    assert any("3 kinds of motion" in line for line in cautions(few))


def test_samples_far_apart_are_told(machine):
    slow = tuple(replace(t, time=4.0 * t.time) for t in machine.trajectories)
    (line,) = cautions(replace(machine, trajectories=slow))
    assert "40 ms apart" in line and "32 Hz" in line
