"""``vd-train teacher``: from a configuration to a run."""

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, TypeVar

from vd.command import interrupt
from vd.command.config import to_dict
from vd.command.device import resolve_device
from vd.command.files import check_folder, locked
from vd.command.line import say_same_as
from vd.command.warp_quiet import quiet_warp
from vd.train.begin import find_start, read_start
from vd.train.config import validate
from vd.train.flags import parse_teacher, write_config
from vd.train.presets import SMOKE_RUN, TeacherCfg

if TYPE_CHECKING:
    from vd.train.alignment.config import AlignmentTrainCfg
    from vd.train.runner import TeacherRunner
    from vd.train.student.config import StudentTrainCfg

Cfg = TypeVar("Cfg", TeacherCfg, "AlignmentTrainCfg", "StudentTrainCfg")

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
    folder = cfg.run.out
    runner = build_teacher(cfg, say=say)
    for line in _beginning(cfg, runner) if runner.iteration else []:
        say(line)
    if not runner.run_to_end():
        if not cfg.smoke:
            again = f"vd-train teacher --out {folder} --resume"
            say(
                f"saved in {folder}; go on with: "
                f"{'the same command' if cfg.resume == 'auto' else again}"
            )
        return interrupt.INTERRUPTED
    # It loads torch, which the first message should not wait for.
    from vd.train.checkpoint import POLICY_NAME

    if cfg.smoke:
        say(
            f"done: everything runs. {runner.env_steps} steps are a test, and the policy is of no "
            f"use"
        )
    elif not (folder / POLICY_NAME).exists():
        say(
            f"done: nothing was trained, so {folder} has no {POLICY_NAME}: the {runner.env_steps} "
            f"steps done before are more than --max-steps {cfg.run.max_steps}; raise it"
        )
    else:
        say(
            f"done: {folder}/{POLICY_NAME} is the best policy, tensorboard --logdir {folder} draws "
            f"the curves"
        )
    return 0


def _beginning(cfg: TeacherCfg, runner: "TeacherRunner") -> Iterator[str]:
    """What a run that does not begin from nothing begins with."""
    how = f"begins from {cfg.init}" if runner.begun else "resumed"
    yield f"{how} after iteration {runner.iteration} of {runner.total_iterations}"
    if runner.new_episodes and not runner.begun:
        yield f"episodes start anew: {runner.new_episodes}"
    if runner.critic_warmup:
        yield f"the critic learns alone for {runner.critic_warmup} iterations"
    for difference in runner.unlike:
        yield f"other than in the training of that policy: {difference}"
