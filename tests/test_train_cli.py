"""Presets, flags and the configuration file of training."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

from vd.assets_usd.hands import HANDS
from vd.command.config import from_dict, to_dict
from vd.command.device import resolve_device
from vd.policy.agents import SHIPPED_POLICIES
from vd.policy.contract import installed_contract
from vd.train.cli import main
from vd.train.config import validate
from vd.train.flags import OF_HELP_ALL, parse_teacher
from vd.train.presets import PRESETS, TeacherCfg, smoke


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_preset_parses_validates_and_survives_a_file(name, tmp_path, monkeypatch):
    monkeypatch.setenv("VD_ASSETS", str(tmp_path))
    preset = PRESETS[name]()
    assert preset.preset == name
    if preset.env.hand in HANDS:
        assert parse_teacher(["--preset", name]) == preset
    else:
        with pytest.raises(ValueError, match=f"'{preset.env.hand}'.*--describe {preset.env.hand}"):
            parse_teacher(["--preset", name])
        flags = ["--preset", name, "--hand", "dclaw3"]
        assert parse_teacher(flags).env == dataclasses.replace(preset.env, hand="dclaw3")
    validate(preset.ppo, preset.policy, preset.run)
    preset.env.validate()
    assert from_dict(TeacherCfg, json.loads(json.dumps(to_dict(preset)))) == preset


@pytest.mark.parametrize(
    ("gpus", "flags", "name"),
    [
        (0, [], "cpu-demo"),
        (1, [], "gpu"),
        (1, ["--device", "cpu"], "cpu-demo"),
        (2, ["--device", "cuda:1"], "gpu"),
    ],
)
def test_the_machine_decides_where_no_preset_is_named(monkeypatch, capsys, gpus, flags, name):
    monkeypatch.setattr("torch.cuda.is_available", lambda: gpus > 0)
    monkeypatch.setattr("torch.cuda.device_count", lambda: gpus)
    said: list[str] = []
    cfg = parse_teacher([*flags, "--seed", "5"], say=lambda *words, why: said.append(words))
    assert cfg.preset == name and cfg.env.seed == 5
    assert cfg.ppo == PRESETS[name]().ppo and cfg.run.out == PRESETS[name]().run.out
    assert len(said) == 1 and said[0][2:4] == ("--preset", name)
    with pytest.raises(SystemExit):
        parse_teacher([*flags, "--print-config"])
    assert f"preset: {name}\n" in capsys.readouterr().out
    assert parse_teacher(["--preset", "paper"], say=said.append).ppo == PRESETS["paper"]().ppo
    assert parse_teacher(["--smoke"], say=said.append).smoke and len(said) == 1
    assert parse_teacher(["--smoke", "--no-smoke"]) == parse_teacher([])
    tiny = smoke(PRESETS["leap-cube"]())
    assert (
        tiny.smoke
        and tiny.env.hand == "leap"
        and tiny.run.device == "cpu"
        and tiny.env.num_envs == 16
    )


def test_a_preset_for_a_hand_of_its_own_serves_the_other():
    """dclaw4 is not its own mirror image, so that nothing can be seen in the mirror."""
    for start in (["--smoke"], ["--preset", "cpu-demo"]):
        assert parse_teacher(start).env.observation.view == "mirrored"
        assert parse_teacher([*start, "--hand", "dclaw4"]).env.observation.view == "goal"
        flags = [*start, "--hand", "dclaw4", "--env.observation.view", "world"]
        assert parse_teacher(flags).env.observation.view == "world"


def test_a_smoke_test_goes_on_from_what_is_named_whatever_was_trained_before():
    cfg = parse_teacher(["--smoke", "--init", "dclaw4"])
    begun = installed_contract(SHIPPED_POLICIES["dclaw4"])
    assert cfg.run.max_steps == begun.env_steps + 2048
    assert cfg.policy.hidden == begun.network.hidden and cfg.env.num_envs == 16


def test_help_lists_at_most_80_flags_and_help_all_the_others_too(capsys):
    listed = []
    for flag in ("--help", "--help-all"):
        with pytest.raises(SystemExit) as end:
            main(["teacher", flag])
        assert end.value.code == 0
        listed.append(set(re.findall(r"^\W*(--[\w.-]+)", capsys.readouterr().out, re.MULTILINE)))
    short, everything = listed
    assert len(short) <= 80 and {"--env.reward.success", "--max-minutes"} <= everything >= short
    hidden = ["--" + name.replace("_", "-") for name in OF_HELP_ALL]
    for flag in everything:
        assert (flag in short) != any(
            flag == name or flag.startswith(f"{name}.") for name in hidden
        ), flag
    assert parse_teacher(["--preset", "gpu", "--env.sim.njmax", "200"]).env.sim.njmax == 200


def test_flags_override_the_preset_and_short_forms_mean_the_environment():
    cfg = parse_teacher(
        [
            *(
                "--preset",
                "gpu",
                "--hand",
                "dclaw3",
                "--objects",
                "cube",
                "cuboid",
                "--num_envs=128",
            ),
            *("--seed", "7", "--ppo.epochs", "3", "--env.reward.energy=-1.5", "--out", "runs/x"),
            *("--max-minutes", "2.5", "--hand-layer", "bench/identified.usda", "--randomise"),
            *("--env.randomisation.effects", "backlash.width_rad", "0", "0.03"),
        ]
    )
    assert cfg.env.hand_layer == "bench/identified.usda"
    assert cfg.env.randomisation.effects == {"backlash.width_rad": (0.0, 0.03)}
    assert from_dict(TeacherCfg, json.loads(json.dumps(to_dict(cfg)))) == cfg
    assert (cfg.env.hand, cfg.env.objects) == ("dclaw3", ("cube", "cuboid"))
    assert (cfg.env.num_envs, cfg.env.seed) == (128, 7)
    assert cfg.env.reward.energy == -1.5 and cfg.ppo.epochs == 3
    assert cfg.run.out == Path("runs/x") and cfg.run.max_minutes == 2.5
    assert cfg.policy == PRESETS["gpu"]().policy
    with pytest.raises(ValueError, match=r"--env\.randomisation\.force-s .*--randomise"):
        parse_teacher(["--preset", "cpu-demo", "--env.randomisation.force-s", "0.1"])


def test_a_smoke_test_leaves_nothing_and_can_be_done_again(tmp_path, monkeypatch, capsys):
    from train_dummy import simulating_the_dummy

    simulating_the_dummy(monkeypatch)
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert main(["teacher", "--smoke", "--max-steps", "128"]) == 0
        text = capsys.readouterr().out
        assert "done: everything runs" in text and "of no use" in text and "best policy" not in text
    assert not list(tmp_path.iterdir())


def test_resume_starts_from_the_runs_own_configuration(tmp_path):
    saved = dataclasses.replace(
        PRESETS["gpu"](), run=dataclasses.replace(PRESETS["gpu"]().run, save_every=17)
    )
    (tmp_path / "config.json").write_text(json.dumps(to_dict(saved)))
    again = parse_teacher(["--config", str(tmp_path / "config.json")])
    assert again == saved, "another run like it"
    cfg = parse_teacher(["--out", str(tmp_path), "--resume", "--max-steps", "123"])
    assert cfg.resume == "latest" and cfg.run.save_every == 17 and cfg.run.max_steps == 123
    assert cfg.env == saved.env and cfg.run.out == tmp_path
    assert parse_teacher(["--out", str(tmp_path), "--resume", "best"]).resume == "best"
    auto = ["--preset", "gpu", "--resume", "auto", "--out"]
    assert parse_teacher([*auto, str(tmp_path)]).run.save_every == 17
    assert parse_teacher([*auto, str(tmp_path / "new")]).ppo == PRESETS["gpu"]().ppo
    assert parse_teacher(["--smoke", "--resume", "auto", "--out", str(tmp_path / "new")]).smoke
    with pytest.raises(ValueError, match=r"--preset multi-gpu .*paper, "):
        parse_teacher(["--preset", "multi-gpu"])
    with pytest.raises(FileNotFoundError, match="--out"):
        parse_teacher(["--out", str(tmp_path / "none"), "--resume"])
    (tmp_path / "config.json").write_text('{"ppo": {"epoch": 3}}')
    with pytest.raises(ValueError, match=r"no field epoch"):
        parse_teacher(["--out", str(tmp_path), "--resume"])


def test_a_folder_with_a_run_is_not_overwritten(tmp_path, capsys):
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "model_0000001.pt").touch()
    student = ["student", "--teacher", "dclaw4-cube", "--device", "cpu"]
    for command in (["teacher", "--smoke"], student):
        assert main([*command, "--out", str(tmp_path)]) == 1
        said = capsys.readouterr()
        assert "add --resume" in said.err and "building" not in said.out, "before anything slow"
    assert not (tmp_path / "config.json").exists()


@pytest.mark.parametrize("name", ["gpu", "cuda:97", "cuda:x"])
def test_devices_that_do_not_exist_are_named(name):
    with pytest.raises(ValueError, match=f"--device is '{name}'"):
        resolve_device(name)


def test_export_commands(tmp_path, capsys):
    from train_dummy import make_runner

    from vd.policy.bundle import read_contract

    make_runner(tmp_path).learn(1)
    whole = tmp_path / "checkpoints" / "model_0000001.pt"
    out, again = tmp_path / "out.safetensors", tmp_path / "again.safetensors"
    assert main(["export", str(whole), str(out)]) == 0
    assert read_contract(out).iterations == 1
    assert out.stat().st_size < whole.stat().st_size
    assert main(["export", str(tmp_path), str(again)]) == 0, "a run's folder"
    assert read_contract(again).iterations == 1
    small = tmp_path / "small.pt"
    assert main(["export", "--resumable", str(whole), str(small)]) == 0
    resumed = make_runner(tmp_path)
    resumed.load(str(small))
    assert resumed.iteration == 1 and resumed.new_episodes
    assert main(["export", "--resumable", str(out), str(small)]) == 1
    assert "nothing can resume" in capsys.readouterr().err
