"""``vd-train adapt``: train a teacher further in an identified model of its hand."""

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import tyro

from vd.command.config import require
from vd.command.device import resolve_device
from vd.command.line import flags_of, parse, say_same_as
from vd.envs.cfg import CurriculumCfg, LevelCfg, LooseCfg
from vd.evaluate.conditions import EXACT
from vd.policy.agents import (
    DEFAULT_POLICY,
    NO_LAYER,
    check_names,
    default_policy,
    policy_at,
)
from vd.train.begin import find_start, read_start, settings_of
from vd.train.flags import saved_config
from vd.train.presets import TeacherCfg
from vd.train.teacher import is_main, run_folder, say_of_main, train

LOOSE = 0.4
"""Level of stillness at which it begins: who has to stand still at once learns little. So begun,
and with nothing random but the layer's numbers, 4.4 points more (2.1 to 6.8) come back than when
the policy's own training goes on: 1300 validation episodes of two hidden models, 118 M steps.
Neither was tried alone, nor half and twice."""
RATE, RAISE_AT = 0.0013, 0.1
"""It rises by so much an update while so many goals succeed, which they did: in 461 updates, 60 M
steps of 16384 environments, to 1. Tried with LOOSE."""
LOOSENED = CurriculumCfg(
    stillness=LevelCfg(rate=RATE, raise_at=RAISE_AT),
    loose=LooseCfg(joint_speed_rad_s=2.0, object_speed_m_s=0.12, action_norm=2.8, rotation_rad=0.3),
)
"""What moves meanwhile; loose is what it was in the last training of the installed policies."""
IDENTIFIED_LAYER = Path("gap/identified.usda")
"""What vd-gap run writes where no other folder is named."""
CPU_ENVS, CPU_MINUTES = 256, 7.0
"""A small adaptation, for machines without a GPU."""
KL = 0.015
"""Between the policies before and after an update, with which LOOSE was tried."""


@dataclass(kw_only=True)
class AdaptCfg:
    """Train a teacher further in the identified model of a hand.

    Task and learner stay those of the policy's own training. The servos are the layer's: each
    number with an interval is drawn from it in every episode; nothing else is random, nor observed
    late. To stand still is asked for little at first, and as before after 461 updates.

    At the end a line of vd-eval is printed that compares the policy before and after in the
    identified model. The same command goes on where it was interrupted. For other settings, as the
    policy's own randomisation, take vd-train teacher --init POLICY --hand-layer LAYER.
    """

    policy: Annotated[str | None, tyro.conf.Positional] = None
    """The teacher: an installed policy, a policy.safetensors, a checkpoint, or a run's folder; by
    default the installed one of the layer's hand."""
    hand_layer: Path | None = None
    """The identified model: identified.usda, or identified-all-fingers.usda, of vd-gap; by default
    gap/identified.usda."""
    out: Path = Path("runs/adapted")
    """Folder of the run, as of vd-train teacher."""
    objects: tuple[str, ...] = ()
    """Object sets to train on; by default those of the policy's training, and the cube on a CPU."""
    num_envs: int | None = None
    """Environments simulated side by side; by default as many as in the policy's training, and 256
    on a CPU."""
    steps: int = 100_000_000
    """Control steps to train for, all environments together."""
    max_minutes: float | None = None
    """End the training after this much time, as of vd-train teacher; 7 by default on a CPU."""
    smoke: bool = False
    """Check the installation: the same, tiny, on the CPU, for at most a minute or two, of the hand
    as it is. It learns nothing, and nothing is kept."""
    seed: int = 0
    """Of the training."""
    device: str = "auto"
    """auto, cpu or cuda:N."""


def adapt_command(arguments: list[str]) -> int:
    """``vd-train adapt``; the exit status.

    Raises:
        ValueError: The policy is no teacher, or does not say how it was trained; names the remedy.
        vd.assets_usd.hand_data.HandError: The layer is not one of the policy's hand.
        FileExistsError: The folder holds another run.
    """
    cfg: AdaptCfg = parse(AdaptCfg, arguments, prog="vd-train adapt")
    require(cfg, "--", "positive", "num_envs steps")
    if not cfg.smoke:
        return _adapt(with_defaults(cfg))
    with TemporaryDirectory(prefix="vd-smoke-") as folder:
        return _adapt(_shrunk(cfg, Path(folder)))


def _adapt(cfg: AdaptCfg) -> int:
    """Train; the exit status."""
    say = say_of_main()
    with run_folder(replace(teacher_cfg(cfg), smoke=cfg.smoke)) as run:
        status = train(run, say)
    if status == 0 and not cfg.smoke:
        policies = [str(cfg.policy), policy_at(cfg.out)]
        where = ["--hand-layer", str(cfg.hand_layer), "--objects", *run.env.objects]
        say(f"compare: {shlex.join(['vd-eval', *policies, *where, '--seed', str(cfg.seed)])}")
    return status


def with_defaults(cfg: AdaptCfg) -> AdaptCfg:
    """``cfg`` with what is not named: policy, model, and on a CPU a small task, which are said.

    Raises:
        ValueError: There is no identified model, or no policy of its hand.
    """
    from vd.assets_usd.hand_layer import open_layer

    layer = cfg.hand_layer or IDENTIFIED_LAYER
    if cfg.hand_layer is None and not layer.is_file():
        raise ValueError(
            f"name the identified model, --hand-layer identified.usda; there is no {layer}, which "
            "vd-gap run RECORDING writes"
        )
    if str(layer) == NO_LAYER:
        raise ValueError(
            "--hand-layer none is nothing to adapt to; name the identified.usda of vd-gap"
        )
    policy = cfg.policy or default_policy(str(open_layer(layer).defaultPrim), "teacher")
    full = replace(cfg, policy=policy, hand_layer=layer)
    if resolve_device(cfg.device) == "cpu":
        full = replace(
            full,
            objects=cfg.objects or ("cube",),
            num_envs=cfg.num_envs or CPU_ENVS,
            max_minutes=cfg.max_minutes or CPU_MINUTES,
        )
    if full != cfg and is_main():
        say_same_as("vd-train", "adapt", policy, *flags_of(full, "policy"))
    return full


def _shrunk(cfg: AdaptCfg, folder: Path) -> AdaptCfg:
    """An adaptation of everything in a minute or two, in ``folder``, to the hand as it is."""
    from vd.assets_usd.hand_layer import write_layer
    from vd.assets_usd.hands import load_hand

    layer = folder / "as-it-is.usda"
    policy = cfg.policy or DEFAULT_POLICY
    hand = load_hand(read_start(find_start(policy))["task"]["hand"])
    write_layer(layer, hand, baseline={}, effects={}, tool="vd-train", recording="none")
    return replace(
        cfg,
        policy=policy,
        hand_layer=layer,
        out=folder / "run",
        objects=("cube",),
        num_envs=16,
        steps=256,
        max_minutes=1.0,
        device="cpu",
    )


def teacher_cfg(cfg: AdaptCfg) -> TeacherCfg:
    """The training of a teacher that an adaptation is.

    Raises:
        As :func:`adapt_command`.
    """
    assert cfg.policy is not None and cfg.hand_layer is not None
    check_names([cfg.policy], cfg.objects)
    try:
        base = settings_of(cfg.policy)
    except ValueError as error:
        raise ValueError(
            f"{error}; adapt goes on with settings of a teacher's own; with others: vd-train teacher "
            f"--init POLICY --hand-layer {cfg.hand_layer} --preset ..."
        ) from error
    from vd.assets_usd.hands import load_hand

    load_hand(base.env.hand, base.env.fingertip, cfg.hand_layer)
    env = replace(
        base.env,
        hand_layer=str(cfg.hand_layer),
        objects=cfg.objects or base.env.objects,
        num_envs=cfg.num_envs or base.env.num_envs,
        seed=cfg.seed,
        curriculum=LOOSENED,
        randomisation=EXACT,
    )
    check_names([], env.objects)
    done = read_start(find_start(cfg.policy))["env_steps"]
    how = replace(base.run, out=cfg.out, device=cfg.device, max_minutes=cfg.max_minutes)
    run = replace(
        base,
        init=cfg.policy,
        init_levels=(1.0, LOOSE, 1.0, 1.0),
        resume="auto",
        run=replace(how, max_steps=done + cfg.steps),
        ppo=replace(base.ppo, desired_kl=KL, late_kl=None),
        env=env,
    )
    there = saved_config(["--resume", "auto"], run)
    if there is not None and (there.init, there.env) != (run.init, run.env):
        raise FileExistsError(f"{cfg.out} holds a run of other settings; choose another --out")
    return run
