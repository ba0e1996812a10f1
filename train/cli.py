"""Command line of training: ``vd-train`` and its commands."""

import importlib
import sys
from collections.abc import Sequence

from vd.command import interrupt

USAGE = """usage: vd-train COMMAND [flags]

commands:
  teacher    train the teacher with PPO           vd-train teacher --preset gpu --out runs/first
  adapt      go on in an identified model         vd-train adapt dclaw3 --hand-layer identified.usda
  student    learn to act by a camera             vd-train student --stage 1 --teacher dclaw3
  alignment  learn where an object is             vd-train alignment --teacher dclaw3 --objects SET
  tracker    let a teacher act by a camera         vd-train tracker dclaw3 --objects SET
  export     write a policy for others            vd-train export runs/first policy.safetensors
             or a small checkpoint to go on from  vd-train export --resumable CHECKPOINT small.pt
             or its networks as ONNX              vd-train export POLICY policy.onnx

Several GPUs:  torchrun --standalone --nproc-per-node 4 -m vd.train.cli teacher --preset gpu
Several nodes: torchrun --nnodes 2 --nproc-per-node 8 --rdzv-backend c10d \\
               --rdzv-endpoint HOST:29500 -m vd.train.cli teacher --preset gpu --out SHARED/FOLDER
Restart by itself after a failure: torchrun --max-restarts 3 ... teacher --out FOLDER --resume auto
               (several nodes: set TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1, or old addresses outlive
               a restart)

A run goes on with any number of GPUs and environments (--resume). On another machine it needs its
config.json and a checkpoint, progress.jsonl for the curve so far:
               vd-train teacher --out FOLDER --resume small.pt

vd-train COMMAND --help lists the flags of a command."""

COMMANDS = {
    "teacher": ("vd.train.teacher", "teacher_command"),
    "adapt": ("vd.train.adapt", "adapt_command"),
    "student": ("vd.train.student.cli", "student_command"),
    "alignment": ("vd.train.alignment.cli", "alignment_command"),
    "tracker": ("vd.train.tracker", "tracker_command"),
    "export": ("vd.train.export", "export_command"),
}
"""Module and function of each command: it takes its flags and returns the exit status."""


@interrupt.command("vd-train")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``vd-train``.

    Returns:
        Exit status: 0 at the end, 1 on an error, 130 after Ctrl-C and 143 after SIGTERM, if saved.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE)
        return 0 if arguments else interrupt.USAGE_ERROR
    name = arguments.pop(0)
    if name not in COMMANDS:
        known = ", ".join(COMMANDS)
        print(f"vd-train: no command '{name}'; one of {known}\n\n{USAGE}", file=sys.stderr)
        return interrupt.USAGE_ERROR
    module, function = COMMANDS[name]
    if name in ("teacher", "adapt", "student", "alignment") and not {"-h", "--help"} & set(
        arguments
    ):
        interrupt.need("rsl_rl", "tensordict")
    try:
        return int(getattr(importlib.import_module(module), function)(arguments))
    except KeyboardInterrupt as stop:
        print(f"vd-train: stopped at once{stop}", file=sys.stderr)
        return interrupt.INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
