"""What all commands do with their words.

Flags over a file of settings, ``--config``, over defaults.
"""

import dataclasses
import inspect
import re
import shlex
import sys
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import tyro

from vd.command.config import from_dict, needed, to_dict

T = TypeVar("T")

CONFIG = "--config"
PRINT = "--print-config"
HELP = """Settings may be in a file too: --config FILE reads YAML or JSON as --print-config prints it. Flags
override it, and what it leaves out keeps its default."""
_FLOAT = re.compile(r"[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$")
"""Numbers that PyYAML takes for text: 3e-4."""


@dataclass(frozen=True)
class ConfigFile:
    """Settings of a file, by group and field as ``config.json`` of a run has them."""

    path: Path
    values: Mapping[str, Any]

    def over(self, default: T) -> T:
        """``default`` with what the file says.

        Raises:
            ValueError: A field is unknown, or has a wrong value; names file, field and remedy.
        """
        try:
            return from_dict(type(default), self.values, over=default)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{CONFIG} {self.path}: {error}") from error

    def words(self, flags: Mapping[str, str]) -> list[str]:
        """What the file says of a few flags, by dotted path, as if it had been typed."""
        words = []
        for path, flag in flags.items():
            value: Any = self.values
            for name in path.split("."):
                value = value.get(name) if isinstance(value, Mapping) else None
            if value is not None and value is not False:
                words.append(flag if value is True else f"{flag}={value}")
        return words


def parse(
    kind: Any,
    words: Sequence[str] | None = None,
    *,
    prog: str,
    default: Any = None,
    description: str | None = None,
) -> Any:
    """Read a command line; ``--print-config`` prints what it asks for as YAML and ends the program.

    Args:
        kind: Dataclass of the settings, or a union of those of subcommands.
        words: The command line without the command's name; that of the program by default.
        prog: The command's name.
        default: What is set where neither flags nor a file say otherwise.
        description: What the help text begins with; the docstring of ``kind`` by default.

    Raises:
        FileNotFoundError: There is no such ``--config``.
        ValueError: It is no file of these settings, or the seed is negative.
    """
    arguments, file = take_config(sys.argv[1:] if words is None else words)
    commands = _subcommands(kind)
    if commands and arguments and arguments[0] in commands:
        command = arguments.pop(0)
        kind = commands[command]
        prog = f"{prog} {command}"
        description = None
    if file is not None and isinstance(kind, type):
        default = file.over(default or kind(**dict.fromkeys(needed(kind), tyro.MISSING)))
        default, arguments = _switched(default, arguments)
    shown = PRINT in arguments
    cfg = tyro.cli(
        kind,
        args=[word for word in arguments if word != PRINT],
        prog=prog,
        description=f"{description or inspect.getdoc(kind)}\n\n{HELP}",
        **({} if default is None else {"default": default}),
    )
    if (getattr(cfg, "seed", None) or 0) < 0:  # NumPy would refuse it once all is built
        raise ValueError(f"--seed is {cfg.seed}; it has to be zero or positive")
    if shown:
        import yaml

        print(yaml.safe_dump(to_dict(cfg), sort_keys=False), end="")
        raise SystemExit(0)
    return cfg


def take_config(words: Sequence[str]) -> tuple[list[str], ConfigFile | None]:
    """A command line without ``--config FILE``, and that file.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, or there are two.
    """
    left: list[str] = []
    paths: list[str] = []
    rest = iter(words)
    for word in rest:
        flag, equals, value = word.partition("=")
        if flag != CONFIG:
            left.append(word)
        elif (path := value if equals else next(rest, "")) and not path.startswith("-"):
            paths.append(path)
        else:
            raise ValueError(f"{CONFIG} needs a file; {PRINT} shows what it may hold")
    if len(paths) > 1:
        raise ValueError(f"{CONFIG} names {' and '.join(paths)}; give one file")
    return left, _read(Path(paths[0])) if paths else None


def _read(path: Path) -> ConfigFile:
    """A file of settings."""
    import yaml

    class Loader(yaml.SafeLoader):
        """Takes 3e-4 for a number, and refuses a name that is there twice."""

        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
            """A mapping."""
            names = [key.value for key, _ in node.value]
            if twice := [key for i, (key, _) in enumerate(node.value) if key.value in names[:i]]:
                problem = f"{twice[0].value} is there twice; keep one"
                raise yaml.constructor.ConstructorError(None, None, problem, twice[0].start_mark)
            return super().construct_mapping(node, deep)

    Loader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+0123456789"))
    try:
        values = yaml.load(path.read_text(encoding="utf-8"), Loader=Loader)  # a safe one
    except FileNotFoundError as error:
        raise FileNotFoundError(
            f"{CONFIG}: there is no file {path}; {PRINT} prints settings to begin from"
        ) from error
    except (OSError, yaml.YAMLError, ValueError) as error:  # of dates such as 2020-13-01 too
        raise ValueError(f"{CONFIG} {path} cannot be read: {error}") from error
    if not isinstance(values, dict):
        raise ValueError(f"{CONFIG} {path} has no fields; {PRINT} shows what it may hold")
    return ConfigFile(path, values)


def _subcommands(kind: Any) -> dict[str, Any]:
    """Settings of subcommands by name; none of a single command."""
    if dataclasses.is_dataclass(kind):
        return {}
    commands = {}
    for option in typing.get_args(kind):
        settings, *markers = typing.get_args(option)
        for marker in markers:
            if getattr(marker, "name", None):
                commands[marker.name] = settings
    return commands


def _switched(settings: Any, words: Sequence[str]) -> tuple[Any, list[str]]:
    """Switches that a file turns on, typed before ``words``: tyro would know some by --no- alone."""
    left = list(words)
    off = {}
    for field in dataclasses.fields(settings):
        if getattr(settings, field.name) is not True or field.default is not False:
            continue
        off[field.name] = False
        flag = field.name.replace("_", "-")
        if f"--no-{flag}" not in words:
            left.insert(0, f"--{flag}")
        elif not hasattr(settings, f"no_{field.name}"):
            left.remove(f"--no-{flag}")
    return dataclasses.replace(settings, **off), left


def flags_of(
    settings: Any, *without: str, always: Sequence[str] = (), over: Any = None, group: str = ""
) -> list[str]:
    """The flags that ask for settings which are not their defaults.

    Args:
        settings: A dataclass, with groups in it.
        without: Flags that are left out.
        always: Flags that ask for their defaults too.
        over: Settings that count as the defaults.
        group: Begin of the flags' names.
    """
    words = list[str]()
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        before = getattr(over, field.name, field.default)
        flag = group + field.name.replace("_", "-")
        if flag in without:
            continue
        if dataclasses.is_dataclass(value):
            words += flags_of(value, *without, over=before, group=f"{flag}.")
        elif before in (value, dataclasses.MISSING) and flag not in always:
            continue
        elif isinstance(value, bool):
            words.append(f"--{group}{'' if value else 'no-'}{flag.removeprefix(group)}")
        elif isinstance(value, (tuple, Mapping)):
            words += [f"--{flag}", *_typed(value)]
        else:
            text = str(value)  # one that begins as a flag does is no value but behind =
            words += [f"--{flag}={text}"] if text.startswith("-") else [f"--{flag}", text]
    return words


def _typed(value: Any) -> list[str]:
    """A value's words: of a mapping each name and what it names."""
    if isinstance(value, Mapping):
        value = tuple(value.items())
    return list(chain(*map(_typed, value))) if isinstance(value, tuple) else [str(value)]


def say_same_as(*words: object, why: str = "") -> None:
    """Say, as a command line that does the same, what a command takes where flags are left out."""
    note = f"   ({why})" if why else ""
    print(f"the same as: {shlex.join(map(str, words))}{note}", file=sys.stderr, flush=True)
