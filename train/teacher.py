"""``vd-train teacher``: from a configuration to a run."""

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from vd.command import interrupt
from vd.command.config import to_dict
from vd.command.device import resolve_device
from vd.command.files import check_folder, locked
from vd.command.line import say_same_as
from vd.command.warp_quiet import quiet_warp
from vd.policy import SUFFIX
from vd.train.begin import find_start, read_start
from vd.train.config import validate
from vd.train.flags import Cfg, parse_teacher, write_config
from vd.train.presets import SMOKE_RUN, TeacherCfg

if TYPE_CHECKING:
    from vd.train.loop import TrainingLoop
    from vd.train.runner import TeacherRunner

CPU_ENVS = 1024
"""Most environments of which a CPU simulates an iteration within a minute."""

BUILDING = "building the environments (the first start compiles the kernels: a minute or two) ..."


def build_teacher(cfg: TeacherCfg, *, say: Callable[[str], object] = print) -> "TeacherRunner":
    """Build environment and learner as ``cfg`` says, save the configuration, and resume if asked.

    ``say`` is told when the slow part begins.

    Raises:
        FileExistsError: The run folder holds another run and ``resume`` is not set.
        FileNotFoundError: There is nothing to resume or to begin from.
    """
    from vd.train.checkpoint import find_checkpoint

    validate(cfg.ppo, cfg.policy, cfg.run)
    cfg.env.validate()
    check_folder(cfg.run.out)
    rank = int(os.environ.get("RANK", "0"))
    device = resolve_device(cfg.run.device)
    checkpoint = find_checkpoint(cfg.run.out, cfg.resume)
    init = find_start(cfg.init) if checkpoint is None and cfg.init is not None else None
    if init is not None:
        read_start(init)  # a damaged one is refused before anything is built
    if cfg.init is None and cfg.init_levels is not None:
        raise ValueError(
            "--init-levels says where a run with --init begins; leave it out, or give --init"
        )
    if device == "cpu" and cfg.env.num_envs > CPU_ENVS:
        say(
            f"{cfg.env.num_envs} environments take a CPU minutes an iteration; --num-envs asks for "
            f"fewer"
        )
    say(BUILDING)

    import torch

    # A line for each of some hundred kernels would scroll the progress away.
    quiet_warp()
    from vd.assets_usd.hands import load_hand
    from vd.envs.reorient import ReorientEnv
    from vd.policy.contract import derive_interface
    from vd.sim.cfg import coarser
    from vd.train.runner import TeacherRunner
    from vd.train.vec_env import ReorientVecEnv

    # Actions of different processes have to differ; parameters are broadcast from the first.
    torch.manual_seed(cfg.env.seed + rank)
    # TF32 halves the update on a GPU; the simulator is not touched by it.
    torch.set_float32_matmul_precision("high")
    physics = coarser(cfg.env.sim) if cfg.run.coarse_physics else cfg.env.sim
    simulation = ReorientEnv(replace(cfg.env, seed=cfg.env.seed + rank, sim=physics), device)
    runner = TeacherRunner(
        ReorientVecEnv(simulation),
        cfg.ppo,
        cfg.policy,
        cfg.run,
        task=to_dict(cfg.env),
        interface=derive_interface(cfg.env, load_hand(cfg.env.hand, cfg.env.fingertip)),
        device=device,
    )
    if checkpoint is not None:
        runner.load(checkpoint)
    elif init is not None:
        runner.begin_from(init, cfg.init_levels)
    if rank == 0:
        # After all that can refuse: settings that a run cannot have must not take the place of its
        # own.
        write_config(cfg)
    return runner


def teacher_command(arguments: list[str]) -> int:
    """``vd-train teacher``; the exit status."""
    cfg = parse_teacher(arguments, say=say_same_as if is_main() else None)
    with run_folder(cfg) as run:
        return train(run, say_of_main())


def is_main() -> bool:
    """Whether this is the first process of those of ``torchrun``, or the only one."""
    return os.environ.get("RANK", "0") == "0"


def say_of_main() -> Callable[[str], None]:
    """Prints at once, in the first process; nothing in the others."""
    return partial(print, flush=True) if is_main() else lambda _: None


@contextmanager
def run_folder(cfg: Cfg) -> Iterator[Cfg]:
    """``cfg`` with its folder for this run alone; that of a smoke test, if not named, goes again.

    Raises:
        FileExistsError: Another process trains into it; names that.
    """
    with ExitStack() as stack:
        if cfg.smoke and cfg.run.out == SMOKE_RUN:
            folder = stack.enter_context(TemporaryDirectory(prefix="vd-smoke-"))
            cfg = replace(cfg, run=replace(cfg.run, out=Path(folder)))
        if is_main():
            stack.enter_context(locked(cfg.run.out))
        yield cfg


def train(cfg: TeacherCfg, say: Callable[[str], None]) -> int:
    """Train as ``cfg`` says; the exit status.

    ``say`` as of :func:`build_teacher`.
    """
    runner = build_teacher(cfg, say=say)
    if runner.iteration:
        _say_beginning(cfg, runner, say)
    return train_to_end(cfg, runner, "teacher", f"policy{SUFFIX}", say)


def train_to_end(
    cfg: Cfg, trainer: "TrainingLoop", name: str, result: str, say: Callable[[str], None]
) -> int:
    """Run a training of ``vd-train NAME`` whose ``result`` is a file in its folder; exit status."""
    folder = cfg.run.out
    whole = trainer.run_to_end()
    if cfg.smoke:
        if whole:
            say("done: everything runs, and what was learned is of no use")
    elif not whole:
        again = f"vd-train {name} --out {folder} --resume"
        if cfg.resume == "auto":
            again = "the same command"
        say(f"saved in {folder}; go on with: {again}")
    elif (folder / result).exists():
        say(f"done: {folder / result}; tensorboard --logdir {folder} draws the curves")
    else:
        say(
            f"done: nothing was trained, so {folder} has no {result}: the {trainer.env_steps} "
            f"steps done before are more than --max-steps {cfg.run.max_steps}; raise it"
        )
    return 0 if whole else interrupt.INTERRUPTED


def _say_beginning(cfg: TeacherCfg, runner: "TeacherRunner", say: Callable[[str], None]) -> None:
    """Tell what a run that does not begin from nothing begins with."""
    how = f"begins from {cfg.init}" if runner.begun else "resumed"
    say(f"{how} after iteration {runner.iteration} of {runner.total_iterations}")
    if runner.new_episodes:
        say(f"episodes start anew: {runner.new_episodes}")
    if runner.critic_warmup:
        say(f"the critic learns alone for {runner.critic_warmup} iterations")
    for difference in runner.unlike:
        say(f"other than in the training of that policy: {difference}")
