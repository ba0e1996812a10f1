"""Settings in files, in and out, of every command."""

import importlib
import json
import shlex
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

from vd.config import to_dict
from vd.train.config import RunCfg
from vd.train.flags import parse_teacher, write_config
from vd.train.presets import PRESETS
from vd.train.student.cli import parse_student

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
LINES = {
    "vd-eval": "zero --objects cube cuboid --in-air --table-friction 3e-1",
    "vd-play": "zero --video a.mp4",
    "vd-train teacher": "--preset gpu --hand dclaw3 --ppo.actor-learning-rate 3e-5 --randomise",
    "vd-train student": "--preset cpu-demo --validate cube --camera 0 0 0 0 0 0 1",
    "vd-train tracker": "dclaw3 --objects cube",
    "vd-train export": "a.pt b.pt --resumable",
    "vd-train bundle": "a.pt b",
    "vd-gap run": "rec --effects backlash --model a.usda",
    "vd-gap hide": "servo --out rec --effect backlash:width_rad=0.06 --effect dead_zone",
    "vd-bench sim": "--envs 16 32",
    "vd-assets import": "meshes --mcts-iterations 5",
    "vd-deploy": "dclaw3-tracking --twin --safety.misses 12 --goal 0,0,0,1 --no-realtime",
}


def run(line, monkeypatch, capsys):
    """What a command prints, and its exit status."""
    script, *words = shlex.split(line)
    monkeypatch.setattr(sys, "argv", [script, *words])
    capsys.readouterr()
    try:
        status = importlib.import_module(SCRIPTS[script].partition(":")[0]).main()
    except SystemExit as end:
        status = end.code
    said = capsys.readouterr()
    return status, said.out, said.err


@pytest.mark.parametrize("command", LINES)
def test_what_a_command_prints_of_its_settings_it_reads(command, tmp_path, monkeypatch, capsys):
    status, printed, _ = run(f"{command} {LINES[command]} --print-config", monkeypatch, capsys)
    assert status == 0 and isinstance(yaml.safe_load(printed), dict)
    (tmp_path / "run.yaml").write_text(printed)
    again = run(f"{command} --config {tmp_path / 'run.yaml'} --print-config", monkeypatch, capsys)
    assert again[:2] == (0, printed)


def test_only_one_place_reads_command_lines():
    folders = ("vd", "train", "deploy", "assets_usd")
    sources = {path: path.read_text() for folder in folders for path in (ROOT / folder).rglob("*.py")}
    assert [path.name for path, text in sources.items() if "tyro.cli(" in text] == ["command_line.py"]


def test_flags_override_the_file_and_it_the_preset_that_it_names(tmp_path, monkeypatch, capsys):
    path = tmp_path / "run.yaml"
    path.write_text("objects: [cuboid]\nin_air: true\nquick: true\ntable_friction: 3e-1\npolicies: [random]")
    line = f"vd-eval zero --config={path} --in-air --no-quick --seed 2 --print-config"
    values = yaml.safe_load(run(line, monkeypatch, capsys)[1])
    assert (values["policies"], values["objects"], values["seed"]) == (["zero"], ["cuboid"], 2)
    assert values["in_air"] and not values["quick"] and values["table_friction"] == 0.3

    path.write_text(
        f"preset: cpu-demo\nppo: {{epochs: 3}}\nrun: {{out: {tmp_path / 'a'}}}\nenv: {{hand: dclaw4}}"
    )
    cfg, preset = parse_teacher(["--config", str(path), "--ppo.gamma", "0.5"]), PRESETS["cpu-demo"]()
    assert (cfg.ppo.epochs, cfg.ppo.gamma, cfg.run.out) == (3, 0.5, tmp_path / "a")
    assert cfg.ppo.minibatch_size == preset.ppo.minibatch_size and cfg.env.observation.view == "goal"
    assert parse_teacher(["--config", str(path), "--preset", "gpu"]).policy == PRESETS["gpu"]().policy
    path.write_text("stage: 1\npreset: cpu-demo")
    assert parse_student(["--config", str(path)]).run.out.name == "cpu-stage1"


def test_the_configuration_of_a_run_is_read_also_of_an_earlier_version(tmp_path):
    asked = ["--preset", "gpu", "--hand", "dclaw3", "--out", str(tmp_path), "--ppo.epochs", "9"]
    cfg = parse_teacher([*asked, "--logger", "none"])
    write_config(cfg)
    path = tmp_path / "config.json"
    assert parse_teacher(["--config", str(path)]) == cfg
    before = to_dict(cfg) | {"preset": "multi-gpu"}
    before["run"]["tensorboard"] = before["run"].pop("logger") != "none"
    path.write_text(json.dumps(before))
    assert parse_teacher(["--config", str(path)]) == cfg


@pytest.mark.parametrize(
    ("line", "text", "said"),
    [
        ("vd-eval", "episode: 3", "EvalCfg has no field episode; is it episodes?"),
        ("vd-train teacher", "ppo: {epoch: 3}", "ppo has no field epoch; is it epochs?"),
        ("vd-train teacher", "out: runs/x", "TeacherCfg has no field out; is it run.out?"),
        ("vd-train teacher", "preset: huge", "--preset huge is none; one of paper"),
        ("vd-eval zero", "objects: cube", "objects: expected a list, ['cube']"),
        ("vd-play", "seed: [1]", "seed: expected int, got [1]"),
        ("vd-eval zero", "episodes: 0", "--episodes is 0; it has to be positive"),
        ("vd-deploy", "safety: {misses: 0}", "safety.misses is 0; it has to be positive"),
        ("vd-gap run", "a: [", "cannot be read"),
        ("vd-play", "seed", "has no fields"),
        ("vd-play --config a.yaml", "seed: 1", "give one file"),
        ("vd-play", None, "there is no file"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_by_name(line, text, said, tmp_path, monkeypatch, capsys):
    if text is not None:
        (tmp_path / "bad.yaml").write_text(text)
    status, _, error = run(f"{line} --config {tmp_path / 'bad.yaml'}", monkeypatch, capsys)
    assert status == 1 and said in error
    assert "bad.yaml" in error or said.startswith(("--", "safety"))


def test_a_logger_that_is_not_installed_is_refused_and_one_that_is_gets_the_curve(tmp_path, monkeypatch):
    from train_dummy import make_runner

    with pytest.raises(ValueError, match=r"--logger wandb needs wandb, .* pip install wandb"):
        RunCfg(logger="wandb").validate()

    class Wandb:
        """Stands for the library."""

        run, config, logged = type("Run", (), {})(), {}, []
        init = finish = staticmethod(lambda **_: None)
        log = staticmethod(lambda values, step: Wandb.logged.append((step, *values)))

    monkeypatch.setattr("rsl_rl.utils.wandb_log_writer.wandb", Wandb)
    monkeypatch.setitem(sys.modules, "wandb", Wandb)
    (tmp_path / "config.json").write_text('{"ppo": {}}')
    make_runner(tmp_path, logger="wandb").learn(2)
    assert {(1, "reward/total"), (2, "run/steps_per_s")} <= set(Wandb.logged)
    assert Wandb.run.name == tmp_path.name and Wandb.config == {"ppo": {}}
