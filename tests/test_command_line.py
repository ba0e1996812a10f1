"""Settings in files, in and out, of every command."""

import importlib
import shlex
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

from vd.command.line import flags_of, parse
from vd.deploy.loop.run import DriveCfg
from vd.train.alignment.cli import ALIGNMENT
from vd.train.flags import parse_teacher
from vd.train.presets import PRESETS
from vd.train.stages import parse_stage

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
LINES = {
    "vd-eval": "zero --objects cube cuboid --in-air --at-rest --table-friction 3e-1",
    "vd-play": "zero --video a.mp4 --in-air",
    "vd-train teacher": "--preset gpu --hand dclaw3 --ppo.actor-learning-rate 3e-5 --randomise",
    "vd-train alignment": "--preset cpu-demo --validate cube --camera 0 0 0 0 0 0 1",
    "vd-train student": "--preset cpu-demo --validate cube --smoke",
    "vd-train tracker": "dclaw3 --objects cube --in-air",
    "vd-train export": "a.pt b.safetensors",
    "vd-gap run": "rec --effects backlash --model a.usda",
    "vd-gap hide": "servo --out rec --effect backlash:width_rad=0.06 --effect dead_zone",
    "vd-bench sim": "--envs 16 32",
    "vd-assets import": "meshes --mcts-iterations 5",
    "vd-deploy": "dclaw3-vision --twin --safety.misses 12 --goal 0,0,0,1 --no-realtime",
    "vd-policies pull": "dclaw3 --at folder",
}
REFUSED = {
    ("vd-train teacher", "ppo: {epoch: 3}"): "bad.yaml: ppo has no field epoch; is it epochs?",
    ("vd-train teacher", "out: runs/x"): "bad.yaml: TeacherCfg has no field out; is it run.out?",
    ("vd-train teacher", "run: {out: 5}"): "bad.yaml: run.out: expected Path, got 5",
    ("vd-train teacher", "true: 1"): "bad.yaml: TeacherCfg has no field True",
    ("vd-train teacher", "env: {seed: 1, seed: 2}"): "seed is there twice; keep one",
    ("vd-train teacher --preset gpu", "preset: cpu-demo"): "--preset gpu: the settings of",
    ("vd-train teacher", "preset: huge"): "--preset huge is none; one of paper",
    ("vd-eval zero", "objects: cube"): "bad.yaml: objects: expected a list, ['cube']",
    ("vd-eval zero", "episodes: 0"): "--episodes is 0; it has to be positive",
    ("vd-deploy", "safety: {misses: 0}"): "bad.yaml: safety.misses is 0; it has to be positive",
    ("vd-gap run", "a: ["): "bad.yaml cannot be read",
    ("vd-play", "seed"): "bad.yaml has no fields",
    ("vd-play --config a.yaml", "seed: 1"): "names a.yaml and",
    ("vd-play", None): "there is no file",
    ("vd-play --config --seed 1", "seed: 1"): "--config needs a file",
}


@pytest.fixture
def run(monkeypatch, capsys):
    """Runs a command line; its exit status, what it prints, and what it says."""

    def started(line):
        script, *words = shlex.split(line)
        monkeypatch.setattr(sys, "argv", [script, *words])
        try:
            status = importlib.import_module(SCRIPTS[script].partition(":")[0]).main()
        except SystemExit as end:
            status = end.code
        return status, *capsys.readouterr()

    return started


@pytest.mark.parametrize("command", LINES)
def test_what_a_command_prints_of_its_settings_it_reads(command, tmp_path, run):
    status, printed, _ = run(f"{command} {LINES[command]} --print-config")
    assert status == 0 and isinstance(yaml.safe_load(printed), dict)
    (tmp_path / "run.yaml").write_text(printed)
    assert run(f"{command} --config {tmp_path / 'run.yaml'} --print-config")[:2] == (0, printed)


@pytest.mark.parametrize(("line", "text"), REFUSED)
def test_a_file_that_cannot_be_used_is_refused_by_name(line, text, tmp_path, run):
    if text is not None:
        (tmp_path / "bad.yaml").write_text(text)
    status, _, said = run(f"{line} --config {tmp_path / 'bad.yaml'}")
    assert status == 1 and REFUSED[line, text] in said


def test_flags_override_the_file_and_it_the_preset_that_it_names(tmp_path, run):
    path = tmp_path / "run.yaml"
    path.write_text("at_rest: true")
    values = yaml.safe_load(run(f"vd-eval zero --config={path} --no-at-rest --print-config")[1])
    assert values["no_at_rest"] and not values["at_rest"]
    path.write_text(
        "objects: [cuboid]\nin_air: true\nair_goals: true\ntable_friction: 3e-1\npolicies: [random]"
    )
    values = yaml.safe_load(
        run(f"vd-eval zero --config={path} --in-air --no-air-goals --print-config")[1]
    )
    assert values["policies"] == ["zero"] and values["objects"] == ["cuboid"]
    assert values["in_air"] and not values["air_goals"] and values["table_friction"] == 0.3

    path.write_text("preset: cpu-demo\nppo: {epochs: 3}\nrun: {out: a}\nenv: {hand: dclaw4}")
    cfg, preset = (
        parse_teacher(["--config", str(path), "--ppo.gamma", "0.5"]),
        PRESETS["cpu-demo"](),
    )
    assert (cfg.ppo.epochs, cfg.ppo.gamma, cfg.run.out) == (3, 0.5, Path("a"))
    assert (
        cfg.ppo.minibatch_size == preset.ppo.minibatch_size and cfg.env.observation.view == "goal"
    )
    path.write_text("ppo: {epochs: 3}")
    cfg = parse_teacher(["--config", str(path), "--preset", "gpu"])
    assert cfg.policy == PRESETS["gpu"]().policy and cfg.ppo.epochs == 3
    assert "epochs: 3" in run(f"vd-train teacher --print-config --config={path}")[1]
    path.write_text("stage: 1\npreset: cpu-demo")
    assert parse_stage(ALIGNMENT, ["--config", str(path)]).run.out.name == "cpu-stage1"


def test_flags_ask_for_the_settings_that_they_were_made_of():
    """Those of groups, too, and values that look like flags."""
    typed = "--twin --pose sim --no-realtime --pose-frame -1 0 0 0 0 0 1 --safety.misses 12"
    asked = parse(DriveCfg, [*typed.split(), "--ros2-args=-r a:=/b"], prog="vd-deploy")
    flags = flags_of(asked)
    assert parse(DriveCfg, flags, prog="vd-deploy") == asked
    assert "--ros2-args=-r a:=/b" in flags and "--safety.misses" in flags
    assert flags_of(parse(DriveCfg, [], prog="vd-deploy")) == []
