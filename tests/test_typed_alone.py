"""Commands typed alone: they take the obvious, and say in one line what that is.

Runs that would be long end at that line; the line is a command that asks for the same.
"""

import importlib
import math
import re
import shlex
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from gap_recordings import recorded
from test_first_hour import SCRIPTS

from vd.assets_usd.hand_layer import write_layer
from vd.assets_usd.hands import hand_usd, load_hand
from vd.command.files import locked
from vd.deploy.loop.goals import drawn_goals
from vd.evaluate.statistics import symmetric_error
from vd.logs.recording import write_recording
from vd.policy.agents import default_policy
from vd.train import adapt, tracker
from vd.train.alignment.cli import ALIGNMENT
from vd.train.flags import parse_teacher
from vd.train.stages import parse_stage
from vd.train.student.cli import STUDENT


class ReachedError(Exception):
    """Raised where a command would begin what takes long."""


LONG = {
    "vd-train teacher": "vd.train.teacher.train",
    "vd-train student": "vd.train.stages.train_stage",
    "vd-train student --stage 0": "vd.train.stages.train_stage",
    "vd-train student --stage 1": "vd.train.stages.train_stage",
    "vd-train student --stage 2": "vd.train.stages.train_stage",
    "vd-train alignment": "vd.train.stages.train_stage",
    "vd-train alignment --stage 1": "vd.train.stages.train_stage",
    "vd-train adapt": "vd.train.adapt._adapt",
    "vd-train adapt --steps 900 --seed 3": "vd.train.adapt._adapt",
    "vd-train tracker --seed 3": "vd.train.tracker._track",
    "vd-deploy --twin": "vd.deploy.loop.policy_runner.load_runner",
    "vd-deploy --hand dclaw3": "vd.deploy.loop.policy_runner.load_runner",
    "vd-deploy --hand dclaw4": "vd.deploy.loop.policy_runner.load_runner",
    "vd-deploy --hand leap --twin": "vd.deploy.loop.policy_runner.load_runner",
    "vd-deploy --hand leap --twin --safety.misses 12": "vd.deploy.loop.policy_runner.load_runner",
    "vd-eval": "vd.evaluate.cli._evaluate",
    "vd-eval --hand dclaw3 --in-air --out=-x": "vd.evaluate.cli._evaluate",
    "vd-play": "vd.play.cli._session",
    "vd-play --hand dclaw3 --cells 4": "vd.play.cli._session",
    "vd-gap run REC": "vd.gap.steps.Analysis.run",
}
"""Where each command is ended."""
TAKEN = {
    "vd-train teacher": "teacher --preset cpu-demo --hand dclaw3 --objects cube --out runs/cpu-demo",
    "vd-train student": "--preset cpu-demo --stage 0 --teacher dclaw4-cube --out runs/student/cpu",
    "vd-train student --stage 0": "--preset cpu-demo --stage 0 --teacher dclaw4-cube",
    "vd-train student --stage 1": "--preset cpu-demo --stage 1 --teacher dclaw4-cube --out runs/",
    "vd-train student --stage 2": "--preset cpu-demo --stage 2 --teacher dclaw4-cube --out runs/",
    "vd-train alignment": "--preset cpu-demo --stage 0 --teacher dclaw4-cube --out runs/alignment/cpu",
    "vd-train alignment --stage 1": "--stage 1 --teacher dclaw4-cube --init dclaw4-vision",
    "vd-train adapt": "adapt dclaw3 --hand-layer gap/identified.usda --objects cube --num-envs 256",
    "vd-train adapt --steps 900 --seed 3": "--steps 900 --max-minutes 7.0 --seed 3",
    "vd-train tracker --seed 3": "-seed0 --seed 3 --episodes 64 --out vision.safetensors",
    "vd-deploy --twin": "dclaw3-vision --hand dclaw3 --object cube --twin   (3 goals)",
    "vd-deploy --hand dclaw3": "dclaw3-vision --hand dclaw3 --object cube --port {}/ttyUSB0",
    "vd-deploy --hand dclaw4": "dclaw4-vision --hand dclaw4 --object cube --port {}/ttyUSB0",
    "vd-deploy --hand leap --twin": "leap-cube --hand leap --object cube --twin",
    "vd-deploy --hand leap --twin --safety.misses 12": "--twin --safety.misses 12   (",
    "vd-eval": "vd-eval dclaw4 --objects cube --episodes 20 --out runs/eval",
    "vd-eval --hand dclaw3 --in-air --out=-x": "--in-air --episodes 20 --hand dclaw3 --out=-x",
    "vd-play": "vd-play dclaw4 --objects cube",
    "vd-play --hand dclaw3 --cells 4": "cube --port 8080 --hand dclaw3 --cells 4",
    "vd-gap run REC": "vd-gap run REC",
}
"""What each command then says."""


@pytest.fixture
def typed(tmp_path, monkeypatch, capsys):
    """Type a command line in an empty folder of a machine without a GPU; what it says."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr("vd.deploy.hardware.port.DEVICES", tmp_path)

    def run(line: str) -> tuple[int, str]:
        command, *arguments = shlex.split(line)
        module = importlib.import_module(SCRIPTS[command].partition(":")[0])
        status = module.main(arguments)
        return status, capsys.readouterr().err

    return run


@pytest.fixture
def leap(tmp_path, monkeypatch):
    """A hand that was imported as ``leap``: a D'Claw, since LEAP's files are not here."""
    monkeypatch.setenv("VD_ASSETS", str(tmp_path / "assets"))
    folder = tmp_path / "assets" / "hands" / "leap"
    folder.mkdir(parents=True)
    text = hand_usd("dclaw3").read_text().replace("dclaw3", "leap")
    (folder / "leap.usda").write_text(text)


def reached(*_args, **_kwargs):
    """Stands for what takes long."""
    raise ReachedError


@pytest.mark.parametrize("line", LONG)
def test_a_command_typed_alone_takes_the_obvious_and_says_it(
    line, typed, leap, tmp_path, monkeypatch, capsys
):
    (tmp_path / "ttyUSB0").touch()
    hand = load_hand("dclaw3")
    kept = {"baseline": {}, "effects": {}, "tool": "a test", "recording": "none"}
    write_layer(tmp_path / "gap" / "identified.usda", hand, **kept)
    if "REC" in line:
        write_recording(recorded({}), tmp_path / "REC")
    monkeypatch.setattr(LONG[line], reached)
    with pytest.raises(ReachedError):
        typed(line)
    said = re.findall(r"^the same as: (.*)", capsys.readouterr().err, re.MULTILINE)
    assert len(said) == 1 and TAKEN[line].format(tmp_path) in said[0]
    monkeypatch.setattr(LONG[line], reached)
    with pytest.raises(ReachedError):  # what it says can be typed, and then nothing is to be said
        typed(said[0].partition("   (")[0])


@pytest.mark.parametrize("command", ["teacher", "student", "alignment", "adapt", "tracker"])
def test_a_seed_that_cannot_be_is_refused_before_anything_is_built(command, typed, tmp_path):
    hand = load_hand("dclaw3")
    kept = {"baseline": {}, "effects": {}, "tool": "a test", "recording": "none"}
    write_layer(tmp_path / "gap" / "identified.usda", hand, **kept)
    status, said = typed(f"vd-train {command} --seed -1")
    assert status == 1 and "seed is -1" in said
    assert not list((tmp_path / "runs").rglob("*"))


RUNS = {
    "teacher": (parse_teacher, []),
    "teacher with flags": (
        parse_teacher,
        [
            *("--randomise", "--num-envs", "64", "--seed", "3", "--resume", "auto", "--out=-x"),
            *("--env.randomisation.effects", "backlash.width_rad", "0", "0.03"),
            *("--max-minutes", "3", "--ppo.gamma", "0.9", "--logger", "none"),
        ],
    ),
    "student": (
        partial(parse_stage, STUDENT),
        ["--smoke", "--stage", "2", "--camera-range", "0", "0"],
    ),
    "student on a GPU": (
        partial(parse_stage, STUDENT),
        ["--preset", "gpu", "--objects", "cube", "--teacher", "dclaw3", "--max-steps", "9"],
    ),
    "alignment": (partial(parse_stage, ALIGNMENT), ["--stage", "1"]),
    "alignment with flags": (
        partial(parse_stage, ALIGNMENT),
        ["--device", "cpu", "--align.network.tokens", "32", "--save-every", "7", "--out=-x"],
    ),
}


@pytest.mark.parametrize("run", RUNS)
def test_what_is_said_asks_for_the_same(run, typed):
    parse, flags = RUNS[run]
    said: list[str] = []
    asked = parse(flags, say=lambda *words, why="": said.extend(map(str, words)))
    assert parse(said[2:]) == asked and run.startswith(said[1])


def test_where_there_is_nothing_to_take_the_remedy_is_named(typed, tmp_path, monkeypatch):
    status, said = typed("vd-deploy --hand dclaw3")
    assert status == 1 and "no serial adapter" in said and "--twin" in said
    for name in ("ttyUSB0", "ttyACM1"):
        (tmp_path / name).touch()
    status, said = typed("vd-deploy check --hand dclaw3")
    assert status == 1 and "ttyACM1" in said and "--port" in said
    assert "import URDF --describe leap" in typed("vd-deploy --hand leap --twin")[1]
    status, said = typed("vd-train adapt")
    assert status == 1 and "no gap/identified.usda" in said
    assert default_policy("leap", "vision", "teacher") == "leap-cube"
    with pytest.raises(ValueError, match=r"leap .*leap-objects"):
        default_policy("leap", "vision")


def test_a_hand_of_teachers_alone_names_them(typed, leap, tmp_path):
    status, said = typed("vd-deploy --hand leap")
    assert status == 1 and "no serial adapter" in said and "--twin" in said
    (tmp_path / "ttyUSB0").touch()
    status, said = typed("vd-deploy --hand leap")
    assert status == 1 and "policy of leap" in said and "leap-cube" in said


@pytest.mark.parametrize(
    "command",
    [
        "teacher",
        "student --stage 2",
        "alignment",
        "alignment --stage 1",
        "adapt",
        "adapt dclaw3",
        "tracker",
    ],
)
def test_every_training_has_a_smoke_test_that_is_tiny_and_leaves_nothing(
    command, typed, tmp_path, monkeypatch
):
    given = []

    def note(cfg, *_args):
        given.append(cfg)
        return 0

    for place in ("teacher.train", "adapt._adapt", "tracker._track", "stages.train_stage"):
        monkeypatch.setattr(f"vd.train.{place}", note)
    assert typed(f"vd-train {command} --smoke")[0] == 0
    assert not list(tmp_path.iterdir())
    (cfg,) = given
    if isinstance(cfg, tracker.TrackerCfg):
        assert (cfg.objects, cfg.episodes, cfg.stop_tolerance) == (("cube",), 2, math.pi)
    elif isinstance(cfg, adapt.AdaptCfg):
        assert cfg.policy == (command.partition(" ")[2] or "dclaw4")
        assert cfg.num_envs == 16 and cfg.steps <= 2048
    else:
        assert cfg.smoke and cfg.run.max_steps <= 2048 and cfg.run.device == "cpu"


@pytest.mark.slow
@pytest.mark.parametrize("command", ["alignment", "student"])
def test_smoke_tests_run(command, typed):
    assert typed(f"vd-train {command} --smoke")[0] == 0


def test_a_stage_begins_from_the_one_before_if_it_was_trained(typed, tmp_path):
    alone = parse_stage(STUDENT, ["--stage", "1"])
    assert alone.init is None
    before = tmp_path / parse_stage(STUDENT, []).run.out
    small = "--learn.window 2 --learn.batch 2 --clouds.updates 1 --clouds.shapes 2 --clouds.hands 2"
    small += " --student.channels 4 8 --max-steps 4 --logger none"
    assert typed(f"vd-train student --stage 0 {small}")[0] == 0
    assert (before / "policy.safetensors").is_file()
    begun = parse_stage(STUDENT, ["--stage", "2"])
    assert begun.init == before.relative_to(tmp_path) and begun.student.channels == (4, 8)
    # A network of another hand is not taken.
    assert parse_stage(STUDENT, ["--stage", "1", "--teacher", "dclaw3"]).init is None
    status, said = typed("vd-train student --stage 1 --init dclaw3")
    assert status == 1 and "no student" in said


def test_default_goals_are_turns_that_can_be_seen():
    """A cube looks the same after 24 turns: none of its orientations is further than 1.09 rad away."""
    from vd.assets_usd.objects.procedural import cube

    symmetry = cube().symmetry
    for seed in range(20):
        goals = drawn_goals(symmetry, 3, seed=seed)
        assert len(goals) == 3
        starts = np.array([[0.0, 0.0, 0.0, 1.0], *goals[:-1]])
        # 0.75 to 1.08 rad for these seeds; one of a single draw each was 0.1 rad from the start.
        assert symmetric_error(starts, np.array(goals), symmetry).min() > 0.5


def test_a_folder_is_one_trainings_and_that_of_a_dead_one_is_free(tmp_path, typed):
    folder = tmp_path / "run"
    hold = (
        "import sys, time, pathlib; from vd.command.files import locked\n"
        "with locked(pathlib.Path(sys.argv[1])): print('has it', flush=True); time.sleep(100)"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", hold, str(folder)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert other.stdout.readline() == "has it\n"
        for command in ("teacher --smoke", "student --smoke", "alignment --smoke"):
            status, said = typed(f"vd-train {command} --out {folder}")
            assert status == 1 and f"process {other.pid} on" in said
    finally:
        other.kill()
        other.wait()
    assert (folder / ".lock").exists()
    with locked(folder):
        pass


def test_a_folder_that_a_lock_made_goes_if_nothing_is_put_there(tmp_path):
    with locked(tmp_path / "a" / "run"):
        assert (tmp_path / "a" / "run").is_dir()
    assert not list(tmp_path.iterdir())
    with locked(tmp_path / "run"):
        (tmp_path / "run" / "mine").touch()
    assert (tmp_path / "run" / "mine").exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--preset", "paper"], "--preset paper: the run in .* began with cpu-demo"),
        (["--init", "dclaw4"], "--init dclaw4: the run in .* began with None"),
        (["--smoke"], "--smoke .*the run in .* began with False"),
    ],
)
def test_a_run_that_goes_on_refuses_to_have_begun_otherwise(flags, message, tmp_path):
    from dataclasses import replace

    from vd.train.flags import write_config
    from vd.train.presets import PRESETS
    from vd.train.student.config import PRESETS as STUDENTS

    cfg = PRESETS["cpu-demo"]()
    write_config(replace(cfg, run=replace(cfg.run, out=tmp_path)))
    for resume in ("latest", "auto"):
        with pytest.raises(ValueError, match=message):
            parse_teacher(["--out", str(tmp_path), "--resume", resume, *flags])
    same = ["--out", str(tmp_path), "--resume", "auto", "--preset", "cpu-demo"]
    assert parse_teacher(same).preset == "cpu-demo"
    cfg = STUDENTS["cpu-demo"](0)
    write_config(replace(cfg, run=replace(cfg.run, out=tmp_path)))
    with pytest.raises(ValueError, match=r"--stage 1: .* 0"):
        parse_stage(STUDENT, ["--out", str(tmp_path), "--resume", "--stage", "1"])


def test_ctrl_c_promises_to_go_on_only_where_that_is_possible(typed, tmp_path, monkeypatch):
    def stop(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("vd.train.teacher.build_teacher", stop)
    status, said = typed(f"vd-train teacher --smoke --out {tmp_path / 'run'}")
    assert status == 130 and "stopped at once" in said and "--resume" not in said
    assert not (tmp_path / "run").exists()


def test_examples_of_lines_are_of_every_command():
    assert LONG.keys() == TAKEN.keys()
    assert {line.split()[0] for line in LONG} | {"vd-assets", "vd-bench", "vd-policies"} == {
        *SCRIPTS
    }
