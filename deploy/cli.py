"""``vd-deploy``: a policy on a real hand, or on its twin, and what has to come before and after."""

import importlib
import inspect
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from vd.command import interrupt
from vd.command.line import parse

OK, FAILED = 0, interrupt.FAILED
"""Exit statuses: done, or not, with the reason; after a signal 128 and its number."""


COMMANDS = {
    "run": ("loop.run", "drive the hand with a policy"),
    "check": ("hardware.check", "preflight: everything that must be right before it moves"),
    "calibrate": ("camera.calibrate", "find where the camera is, by a cube of tags on a finger"),
    "home": ("hardware.home", "move slowly to the pose in which an episode starts"),
    "record": ("hardware.record", "record motions for vd-gap"),
    "tags": ("pose.tag_sheet", "print a cube of tags, by which --pose tags sees it"),
    "score": ("loop.score", "the object's error at each stop, by motion capture"),
}
"""Module of each command and what it does. A module has a function of the command's name, which
takes options as it is annotated, and returns a status."""
USAGE = """usage: vd-deploy [POLICY] [flags]   the same as vd-deploy run
       vd-deploy COMMAND [flags]

commands:
{}

What talks to motors takes --hand HAND and --port DEVICE, by default the only serial adapter, or
--twin, a simulated hand. Nothing moves before the preflight has passed and you have said yes (--yes
says so at once).
vd-deploy COMMAND --help lists the flags of a command, vd-deploy --hand dclaw3 --help those of a run."""


def usage() -> str:
    """The overview of the commands."""
    lines = [f"  {name:<10} {summary}" for name, (_, summary) in COMMANDS.items()]
    return USAGE.format("\n".join(lines))


def _no_policy(text: str) -> str:
    """Why it is no file, no folder and no installed policy; "" if it is one."""
    if Path(text).exists():
        return ""
    from vd.policy.agents import check_names

    try:
        check_names([text], [])
    except FileNotFoundError as error:
        return f"no command {text!r}; commands are {', '.join(COMMANDS)}; and {error}"
    except ValueError as error:  # it has to be pulled
        return str(error)
    return ""


@interrupt.command("vd-deploy")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``vd-deploy``; returns the exit status."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if not arguments or arguments in (["-h"], ["--help"]):
        print(usage())
        return OK
    name = "run"
    if arguments[0] in COMMANDS:
        name = arguments.pop(0)
    elif not arguments[0].startswith("-") and (wrong := _no_policy(arguments[0])):
        print(f"vd-deploy: {wrong}", file=sys.stderr)
        return FAILED
    module = importlib.import_module(f"vd.deploy.{COMMANDS[name][0]}")
    command = getattr(module, name)
    options_of = inspect.get_annotations(command)["cfg"]
    options = parse(options_of, arguments, prog=f"vd-deploy {name}", description=module.__doc__)
    by_ros = getattr(options, "ros2", False)
    if hasattr(options, "port") and not (options.port or options.twin or by_ros):
        from vd.deploy.hardware.port import find_port

        options = replace(options, port=find_port())
        print(f"vd-deploy: --port {options.port}, the only serial adapter", file=sys.stderr)
    return int(command(options))


if __name__ == "__main__":
    sys.exit(main())
