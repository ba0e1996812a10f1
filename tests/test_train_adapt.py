"""vd-train adapt: what it takes over of a policy, what it refuses, and how it ends."""

import shlex
from dataclasses import replace

import pytest

from vd.assets_usd.hand_layer import write_layer
from vd.assets_usd.hands import load_hand
from vd.command.line import parse
from vd.envs.cfg import ReorientCfg
from vd.evaluate.cfg import EvalCfg
from vd.evaluate.conditions import EXACT
from vd.policy.agents import policy_at
from vd.policy.bundle import read_policy
from vd.train import adapt
from vd.train.adapt import AdaptCfg, teacher_cfg
from vd.train.flags import write_config


@pytest.fixture
def cfg(tmp_path) -> AdaptCfg:
    hand, layer = load_hand("dclaw4"), tmp_path / "late.usda"
    effects = {
        name: {"command_delay": {"delay_s": (0.08, 0.07, 0.09)}} for name in hand.joint_names
    }
    write_layer(layer, hand, baseline={}, effects=effects, tool="a test", recording="none")
    return AdaptCfg(policy="dclaw4", hand_layer=layer, out=tmp_path / "a run", objects=("cube",))


def test_it_goes_on_as_the_policy_was_trained_with_the_servos_of_the_layer_alone(cfg):
    policy, run = read_policy(adapt.find_start("dclaw4")), teacher_cfg(cfg)
    before = ReorientCfg.of(policy)
    asked = {"hand_layer": str(cfg.hand_layer), "objects": ("cube",), "seed": 0}
    assert run.init_levels == (1.0, adapt.LOOSE, 1.0, 1.0), "it begins loosened"
    assert run.env == replace(before, randomisation=EXACT, curriculum=run.env.curriculum, **asked)
    assert run.run.max_steps == policy.contract.env_steps + cfg.steps
    write_config(run)
    assert teacher_cfg(cfg) == run, "the same command goes on"
    with pytest.raises(FileExistsError, match="other settings"):
        teacher_cfg(replace(cfg, seed=1))
    for name, remedy in (
        ("dclaw4-vision", "sees by camera; give its teacher, dclaw4"),
        ("dclaw4-cube", "does not say how it was trained.*vd-train teacher --init POLICY"),
    ):
        with pytest.raises(ValueError, match=remedy):
            teacher_cfg(replace(cfg, policy=name, out=cfg.out.with_name("other")))


def test_it_ends_with_the_line_that_compares_before_and_after(cfg, monkeypatch, capsys):
    monkeypatch.setattr("vd.train.adapt.train", lambda run, say: 0)
    assert adapt._adapt(cfg) == 0
    line = capsys.readouterr().out.partition("compare: vd-eval ")[2]
    compared = parse(EvalCfg, shlex.split(line), prog="vd-eval")
    assert (compared.objects, compared.seed) == (cfg.objects, cfg.seed)
    assert compared.policies == ("dclaw4", policy_at(cfg.out))
    assert compared.hand_layer == str(cfg.hand_layer)
