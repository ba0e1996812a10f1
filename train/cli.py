"""Command line of training: ``vd-train`` and its commands."""

import importlib
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import tyro

from vd import interrupt
from vd.config import to_dict
from vd.device import resolve_device
from vd.files import check_file, check_folder
from vd.train.begin import find_start
from vd.train.flags import parse_teacher, write_config
from vd.train.presets import SMOKE_RUN, TeacherCfg
from vd.warp_quiet import quiet_warp

if TYPE_CHECKING:
    from vd.train.runner import TeacherRunner

USAGE = """usage: vd-train COMMAND [flags]

commands:
  teacher    train the teacher with PPO           vd-train teacher --preset gpu --out runs/first
  student    imitate it from point clouds         vd-train student --stage 1 --teacher dclaw3-table
  tracker    let it act by a camera, learn nothing vd-train tracker dclaw3-table --objects SET
  average    mean weights of several teachers     vd-train average runs/a runs/b --out policy.pt
  export     write a policy without its optimiser vd-train export runs/first/checkpoints/best.pt policy.pt
             or a small checkpoint to go on from  vd-train export --resumable CHECKPOINT small.pt
             or a teacher's network as ONNX       vd-train export CHECKPOINT policy.onnx
  bundle     write a policy as it is deployed     vd-train bundle student.pt bundles/first
  curves     draw the curves of a run             vd-train curves runs/first

Several GPUs:  torchrun --standalone --nproc-per-node 4 -m vd.train.cli teacher --preset multi-gpu
Several nodes: torchrun --nnodes 2 --nproc-per-node 8 --rdzv-backend c10d --rdzv-endpoint HOST:29500 \\
               -m vd.train.cli teacher --preset multi-gpu --out SHARED/FOLDER
Restart by itself after a failure: torchrun --max-restarts 3 ... teacher --out FOLDER --resume auto
               (several nodes: set TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1, or old addresses outlive a restart)

A run goes on with any number of GPUs and environments (--resume); on another machine it needs its
config.json and a checkpoint, progress.jsonl for the curve so far: vd-train teacher --out FOLDER --resume
small.pt

vd-train COMMAND --help lists the flags of a command."""

_TRACKER = "vd-train tracker TEACHER --objects SET writes a tracking policy and its stopping rules"
_UNUSED = "nothing takes its place, since no training needed it"
GONE = {
    "calibrate": _TRACKER,
    "follow": _TRACKER,
    "noise": _UNUSED,
    "profile": _UNUSED,
    "precompile": "kernels stay in the folder that WARP_CACHE_PATH names, from one start to the next",
}
"""Commands that are no more, and what to do."""


@dataclass
class ExportCfg:
    """Write the policy of a checkpoint without its training state, as ONNX, or a small checkpoint.

    A policy keeps its critic, so that --init can go on from it.

    A student keeps its weights, and --init goes on from it.
    """

    checkpoint: Annotated[Path, tyro.conf.Positional]
    """Checkpoint of vd-train teacher, or its policy.pt; or a student."""
    output: Annotated[Path, tyro.conf.Positional] = Path("policy.pt")
    """File to write. A name that ends in .onnx gets the network from observation to mean action, checked
    against onnxruntime where that is installed."""
    resumable: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Write a checkpoint for --resume instead, all but the state of the environments: a run that moves to
    another machine or number of GPUs starts its episodes anew anyway."""


@dataclass
class BundleCfg:
    """Write a policy as it is deployed: weights, a contract in JSON, golden inputs and outputs, in a folder.

    vd-eval takes the folder in place of a policy, and refuses it for a hand that it was not made for.
    """

    policy: Annotated[str, tyro.conf.Positional]
    """policy.pt, student.pt, a checkpoint, a run's folder, or the name of an installed policy."""
    output: Annotated[Path, tyro.conf.Positional]
    """Folder to write; a bundle that is there is replaced."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the contract."""


@dataclass
class CurvesCfg:
    """Draw success, reward, terms, difficulty, error, std, falls and speed of runs against control steps."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs, or progress.jsonl files."""
    out: Path | None = None
    """PNG to write; curves.png beside the first run's progress by default."""


@interrupt.command("vd-train")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``vd-train``.

    Returns:
        Exit status: 0 at the end, 1 on an error, 130 after Ctrl-C and 143 after SIGTERM, if saved.
    """
    started = time.monotonic()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    commands = {
        "teacher": _teacher,
        "student": _elsewhere("vd.train.student.cli", "student_command"),
        "tracker": _elsewhere("vd.train.tracker", "tracker_command"),
        "average": _elsewhere("vd.train.average", "average_command"),
        "export": _export,
        "bundle": _bundle,
        "curves": _curves,
    }
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE)
        return 0 if arguments else 2
    if arguments[0] in GONE:
        print(f"vd-train: '{arguments[0]}' is no more; {GONE[arguments[0]]}", file=sys.stderr)
        return 2
    if arguments[0] not in commands:
        print(
            f"vd-train: no command '{arguments[0]}'; one of {', '.join(commands)}\n\n{USAGE}", file=sys.stderr
        )
        return 2
    try:
        return commands[arguments[0]](arguments[1:], started)
    except (ValueError, OSError, RuntimeError) as error:
        if os.environ.get("VD_DEBUG"):
            raise
        print(f"vd-train: {error}\n(VD_DEBUG=1 shows where)", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        hint = "; --resume goes on from the last checkpoint" if arguments[0] in ("teacher", "student") else ""
        print(f"vd-train: stopped at once{hint}", file=sys.stderr)
        return interrupt.INTERRUPTED


def _elsewhere(module: str, function: str) -> Callable[[list[str], float], int]:
    """A command of another module, which is imported when it is called."""
    return lambda arguments, started: getattr(importlib.import_module(module), function)(arguments, started)


def build_teacher(cfg: TeacherCfg, *, started: float | None = None) -> "TeacherRunner":
    """Build environment and learner as ``cfg`` says, save the resolved configuration, and resume if asked.

    Args:
        cfg: Configuration.
        started: ``time.monotonic()`` from which ``max_minutes`` counts; now by default.

    Raises:
        FileExistsError: The run folder holds another run and ``resume`` is not set.
        FileNotFoundError: There is nothing to resume or to begin from.
    """
    from vd.train.checkpoint import find_checkpoint, load_checkpoint

    check_folder(cfg.run.out)
    rank, device = int(os.environ.get("RANK", "0")), resolve_device(cfg.run.device)
    checkpoint = find_checkpoint(cfg.run.out, cfg.resume)
    init = find_start(cfg.init) if checkpoint is None and cfg.init is not None else None
    if init is not None:
        load_checkpoint(init, flag="--init")  # a damaged one is refused before anything is built
    if cfg.init is None and cfg.init_stage is not None:
        raise ValueError("--init-stage says where a run with --init begins; leave it out, or give --init")
    if cfg.init is None and cfg.ppo.imitation_iterations:
        raise ValueError("--ppo.imitation-iterations imitates the policy that --init names; give --init too")

    import torch

    # A line for each of some hundred kernels would scroll the progress away.
    quiet_warp()
    from vd.envs.reorient import ReorientEnv
    from vd.sim.cfg import coarser
    from vd.train.runner import TeacherRunner
    from vd.train.vec_env import ReorientVecEnv

    # Actions of different processes have to differ; parameters are broadcast from the first.
    torch.manual_seed(cfg.env.seed + rank)
    # TF32 halves the update on a GPU; the simulator is not touched by it.
    torch.set_float32_matmul_precision("high")
    physics = coarser(cfg.env.sim) if cfg.run.coarse_physics else cfg.env.sim
    simulation = ReorientEnv(replace(cfg.env, seed=cfg.env.seed + rank, sim=physics), device)
    simulation.dump_dir = cfg.run.out
    runner = TeacherRunner(
        ReorientVecEnv(simulation),
        cfg.ppo,
        cfg.policy,
        cfg.run,
        task=to_dict(cfg.env),
        device=device,
        deadline=cfg.run.deadline(started),
    )
    if checkpoint is not None:
        runner.load(checkpoint)
    elif init is not None:
        runner.begin_from(init, cfg.init_stage)
    if rank == 0:
        # After all that can refuse: settings that a run cannot have must not take the place of its own.
        write_config(cfg)
    return runner


def _teacher(arguments: list[str], started: float) -> int:
    main_process = os.environ.get("RANK", "0") == "0"
    cfg = parse_teacher(arguments, say=print if main_process else None)
    if not cfg.smoke or cfg.run.out != SMOKE_RUN:
        return _train_teacher(cfg, main_process, started)
    with TemporaryDirectory(prefix="vd-smoke-") as folder:  # nobody needs what is in it, twice least of all
        return _train_teacher(replace(cfg, run=replace(cfg.run, out=Path(folder))), main_process, started)


def _train_teacher(cfg: TeacherCfg, main_process: bool, started: float) -> int:
    from vd.train.progress import BUILDING

    folder, say = cfg.run.out, partial(print, flush=True) if main_process else (lambda _: None)
    say(BUILDING)
    runner = build_teacher(cfg, started=started)
    for line in _beginning(cfg, runner) if runner.iteration else []:
        say(line)
    if not runner.run_to_end():
        if not cfg.smoke:
            say(f"saved in {folder}; go on with: vd-train teacher --out {folder} --resume")
        return interrupt.INTERRUPTED
    from vd.train.runner import POLICY_NAME  # loads torch, which the first message should not wait for

    if cfg.smoke:
        say(f"done: everything runs. {runner.env_steps} steps are a test, and the policy is of no use")
    elif not (folder / POLICY_NAME).exists():
        say(
            f"done: nothing was trained, so {folder} has no {POLICY_NAME}: the {runner.env_steps} steps "
            f"done before are more than --max-steps {cfg.run.max_steps}; raise it"
        )
    else:
        say(f"done: {folder}/{POLICY_NAME} is the best policy, vd-train curves {folder} draws the curves")
    return 0


def _beginning(cfg: TeacherCfg, runner: "TeacherRunner") -> Iterator[str]:
    """What a run that does not begin from nothing begins with."""
    how = f"begins from {cfg.init}" if runner.begun else "resumed"
    yield f"{how} after iteration {runner.iteration} of {runner.total_iterations}"
    if runner.new_episodes and not runner.begun:
        yield f"episodes start anew, the checkpoint does not fit the environments: {runner.new_episodes}"
    if runner.new_inputs:
        yield f"{runner.new_inputs} observed values are new to the networks and start without effect"
    if runner.critic_warmup:
        actor = "stays as it is" if runner.imitation is None else "imitates what it began from"
        yield f"the critic learns alone for {runner.critic_warmup} iterations, the actor {actor}"
    for difference in runner.unlike:
        yield f"the policy was trained with other observations or actions: {difference}"


def _export(arguments: list[str], _started: float) -> int:
    cfg = tyro.cli(ExportCfg, args=arguments, prog="vd-train export")
    check_file(cfg.output)

    from vd.policy import policy_export
    from vd.train.checkpoint import load_checkpoint, save_checkpoint, without_worlds
    from vd.vision.saved import is_student, read_student, saved_spec, student_export

    if is_student(cfg.checkpoint):
        if cfg.resumable or cfg.output.suffix == ".onnx":
            raise ValueError(
                f"{cfg.checkpoint} is a student, which goes on with --init; leave --resumable out"
            )
        student = read_student(cfg.checkpoint)
        saved_spec(student, cfg.checkpoint)  # refuses one that nothing reads any more
        save_checkpoint(cfg.output, student_export(student))
        print(cfg.output)
        return 0
    if cfg.output.suffix == ".onnx":
        return _export_onnx(cfg)
    state = load_checkpoint(cfg.checkpoint, flag="vd-train export")
    if cfg.resumable and "optimizer_state_dict" not in state:
        raise ValueError(f"{cfg.checkpoint} is a policy, not a checkpoint; nothing can go on from it")
    save_checkpoint(cfg.output, without_worlds(state) if cfg.resumable else policy_export(state))
    print(cfg.output)
    return 0


def _export_onnx(cfg: ExportCfg) -> int:
    from vd.policy import load_policy
    from vd.train.onnx_export import export_onnx, onnx_difference

    if cfg.resumable:
        raise ValueError(f"--resumable writes a checkpoint, which {cfg.output} is not; leave one of them out")
    policy = load_policy(cfg.checkpoint)
    export_onnx(policy, cfg.output)
    worst = onnx_difference(policy, cfg.output)
    if worst is None:
        print("onnxruntime is not installed: not checked (pip install -e '.[export]')")
    else:
        print(f"onnxruntime gives the same actions within {worst:.1e}")
    print(cfg.output)
    return 0


def _bundle(arguments: list[str], _started: float) -> int:
    import json

    cfg = tyro.cli(BundleCfg, args=arguments, prog="vd-train bundle")
    check_folder(cfg.output.parent)

    quiet_warp()  # golden outputs of a student come from its kernels
    from vd.bundle.store import write_bundle
    from vd.evaluate.agents import find_policy, open_policy

    policy = open_policy(str(find_policy(cfg.policy)), "cpu")
    assert policy is not None  # a file was found
    contract = write_bundle(policy, cfg.output)
    if cfg.json:
        print(json.dumps(to_dict(contract), indent=1))
    else:
        hand = contract.interface.hand
        print(f"{cfg.output}: {contract.kind} for {hand.name}, {len(hand.joint_names)} joints")
    return 0


def _curves(arguments: list[str], _started: float) -> int:
    cfg = tyro.cli(CurvesCfg, args=arguments, prog="vd-train curves")

    from vd.train.curves import plot_curves
    from vd.train.metrics import PROGRESS_FILE

    files = [run / PROGRESS_FILE if run.is_dir() else run for run in cfg.runs]
    output = cfg.out or files[0].with_name("curves.png")
    check_file(output)
    plot_curves(files, output)
    print(output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
