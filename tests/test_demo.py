"""The demo: what it calls, what its page says of parts that end, fail or stop, and what it refuses."""

import importlib
import json
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import trimesh
import tyro
from gap_reports import rubbing_servo, servo_report
from test_evaluate_trace import compared

from vd.assets_usd.hands import load_hand
from vd.deploy.loop.log import LogWriter
from vd.evaluate.result import Result
from vd.gap.report import write_report
from vd.logs.log_format import JOINT_CHANNELS
from vd.train.demo import Demo, Part, main
from vd.train.metrics import PROGRESS_FILE

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


def option(line: list[str], flag: str) -> Path:
    return Path(line[line.index(flag) + 1])


def leave_evaluation(line: list[str]) -> None:
    rows = compared()
    Result(tuple(rows)).write(option(line, "--out") / "eval.json")


def leave_report(line: list[str]) -> None:
    out = option(line, "--out")
    write_report(*servo_report(rubbing_servo(out.with_name("recorded"))), out)


def leave_flight(line: list[str]) -> None:
    import numpy as np

    hand = load_hand("dclaw4")
    run = {
        "object": {"name": "mug", "set": "x"},
        "goals": [[0.0, 0.0, 0.0, 1.0]],
        "control_hz": 12.0,
    }
    log = LogWriter(option(line, "--log"), hand, run, servo={})
    joints = dict.fromkeys(JOINT_CHANNELS, np.zeros(hand.num_joints))
    for step in range(3):
        now = log.started_s + step / 12
        log.step(now, now + 0.04, joints, [0.0, 1.0, 0.5, 0.0, 0.0, 0.002, 0.04, 0.004, 1.0])
    log.event("stop", goal=0, outcome="stopped", distance=0.2)
    log.finish("all goals pursued")
    (option(line, "--log") / "run.mp4").write_bytes(b"no film")


GOALS = [5.0, 4.5, 9.9]
"""Goals an episode of the made-up training."""


def leave_training(line: list[str]) -> None:
    rows = [
        {"env_steps": 20_000 * k, "goals_per_episode": goals}
        for k, goals in enumerate((None, 99.0, *GOALS))
    ]
    option(line, "--out").mkdir()
    (option(line, "--out") / PROGRESS_FILE).write_text("\n".join(map(json.dumps, rows)))


LEAVE = {
    "vd-eval": leave_evaluation,
    "vd-play": lambda line: option(line, "--video").write_bytes(b"no film"),
    "vd-gap run": leave_report,
    "vd-deploy": leave_flight,
    "vd-train teacher": leave_training,
}
"""What stands in for each command: it leaves the files that the page is made of."""


class ParsedError(Exception):
    """Raised in place of running a command, once its line was understood."""


@pytest.fixture
def played(monkeypatch):
    """The command lines that a demo runs; they are understood, and their files made up."""
    lines: list[list[str]] = []
    parse = tyro.cli

    def only_parse(*args, **kwargs):
        parse(*args, **kwargs)
        raise ParsedError

    def run(self, *words):
        monkeypatch.setattr(tyro, "cli", only_parse)
        line = [str(word) for word in words]
        module = importlib.import_module(SCRIPTS[line[0]].partition(":")[0])
        with monkeypatch.context() as patch, pytest.raises(ParsedError):
            patch.setattr(sys, "argv", line)
            module.main()
        lines.append(line)
        for start, leave in LEAVE.items():
            if start in " ".join(line):
                leave(line)
        monkeypatch.setattr(tyro, "cli", parse)

    monkeypatch.setattr(Part, "run", run)
    return lines


def test_the_page_shows_every_part(played, tmp_path):
    assert main(["--out", str(tmp_path / "demo"), "--seed", "3"]) == 0
    text = (tmp_path / "demo" / "index.html").read_text()
    assert text.count("<video") == 3 and "http-equiv" not in text
    for words in (
        "The simulation lacks",
        "mug",
        "stopped",
        "9.9 goals an episode",
        "up to symmetry",
    ):
        assert words in text
    assert "from 5.0 to" in text and "no learning" not in text
    assert [
        line[0] for line in played if "--seed" in line and option(line, "--seed").name != "3"
    ] == []
    assert (tmp_path / "demo" / "gap" / "analysis" / "report.html").is_file()


def test_quick_ends_after_the_first_part_and_a_demo_again_replaces_the_one_before(played, tmp_path):
    assert main(["--out", str(tmp_path), "--quick"]) == 0
    assert {line[0] for line in played} == {"vd-eval", "vd-play"}
    for file in (tmp_path / "camera" / "old.txt", tmp_path / "mine.txt"):
        file.touch()
    assert main(["--out", str(tmp_path), "--quick"]) == 0
    assert not (tmp_path / "camera" / "old.txt").exists() and (tmp_path / "mine.txt").exists()
    assert Result.read(tmp_path / "camera" / "eval.json").rows


def test_a_training_that_learned_nothing_says_so(played, tmp_path, monkeypatch):
    monkeypatch.setitem(globals(), "GOALS", [18.0, 12.0, 6.0])
    assert main(["--out", str(tmp_path / "demo")]) == 0
    text = (tmp_path / "demo" / "index.html").read_text()
    assert "from 18.0 to" in text and "no learning" in text


def test_compact_meshes_are_turned_and_built_in_objects_fill_up(played, tmp_path, monkeypatch):
    """Small files of flat and long things, and of nothing, are passed over."""
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    (meshes / "broken.stl").write_text("nothing")
    for name, sides in {
        "knife": (20, 2, 1),
        "a": (2, 1, 1),
        "b": (3, 2, 2),
        "disc": (9, 9, 1),
    }.items():
        trimesh.creation.box(sides).export(meshes / f"{name}.stl")
    trimesh.creation.icosphere(2).export(meshes / "c.stl")

    def leave_set(line):
        option(line, "--out").mkdir()
        (option(line, "--out") / "a.usda").touch()

    monkeypatch.setitem(LEAVE, "vd-assets import", leave_set)
    assert main(["--out", str(tmp_path / "demo"), "--meshes", str(meshes)]) == 0
    words = played[0][2 : played[0].index("--out")]
    assert [Path(word).name for word in words] == ["a.stl", "b.stl", "c.stl"]
    folder = tmp_path / "demo" / "camera" / "objects"
    at = played[1].index("--objects")
    assert played[1][at + 1 : at + 3] == [str(folder), "procedural-heldout-3-seed0"]
    flown = next(line for line in played if line[0] == "vd-deploy")
    assert option(flown, "--object") == folder / "a.usda" and flown[1] == "dclaw4-vision"
    assert "fewer than four" in (tmp_path / "demo" / "index.html").read_text()
    monkeypatch.delitem(LEAVE, "vd-assets import")
    assert main(["--out", str(tmp_path / "none"), "--meshes", str(meshes)]) == 0, "none imported"
    flown = [line for line in played if line[0] == "vd-deploy"][-1]
    assert flown[flown.index("--object") + 1] == "procedural-heldout-1-seed0"


def test_a_part_that_fails_is_named_and_the_others_go_on(tmp_path, monkeypatch, capsys):
    seen = []

    def fail(demo, part):
        seen.append(demo.page.read_text())
        raise RuntimeError("vd-x <y> ended with status 1: no such motor")

    for name in ("camera", "gap", "twin", "training"):
        monkeypatch.setattr(Demo, name, fail)
    assert main(["--out", str(tmp_path)]) == 1
    assert "failed: Objects never seen" in capsys.readouterr().err
    assert "http-equiv" in seen[1] and "vd-x &lt;y&gt;" in seen[1]
    assert '<p class="small">running' in seen[1] and '<p class="small">waiting' in seen[1]


def test_a_command_that_fails_says_which_and_why(tmp_path):
    with pytest.raises(RuntimeError, match=r"(?s)vd-play nosuch .*1: .*nosuch"):
        part = Part("x", "X", lambda part: {}, tmp_path)
        part.folder.mkdir()
        part.run("vd-play", "nosuch", "--video", tmp_path / "x.mp4")


def test_ctrl_c_ends_the_command_under_way_and_the_page_says_so(tmp_path):
    script = (
        "import sys; from vd.train import demo; sys.executable = '/bin/sh'\n"
        "demo.Demo.camera = lambda demo, part: part.run('sleep', '100')\n"
        "sys.exit(demo.main(['--quick', '--out', sys.argv[1]]))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE
    )
    while b"$ sleep" not in process.stdout.readline():
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    assert process.wait(50.0) == 130
    text = (tmp_path / "index.html").read_text()
    assert "interrupted" in text and "http-equiv" not in text, "it is not read again"
