"""Flags of the teacher's training, and what they start from."""

import dataclasses
import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_type_hints

import tyro

from vd.command.config import from_dict, to_dict
from vd.command.device import resolve_device
from vd.command.files import write_json
from vd.command.line import PRINT, ConfigFile, flags_of, parse, take_config
from vd.policy.agents import DEFAULT_POLICY, check_names, installed_policies
from vd.train.begin import find_start, read_start, settings_of
from vd.train.presets import PRESETS, TeacherCfg, for_hand, smoke

if TYPE_CHECKING:
    from vd.train.alignment.config import AlignmentTrainCfg
    from vd.train.student.config import StudentTrainCfg

Cfg = TypeVar("Cfg", TeacherCfg, "AlignmentTrainCfg", "StudentTrainCfg")
CONFIG_NAME = "config.json"
"""The resolved configuration, in the run's folder, written before the first iteration."""

TEACHER_HELP = """Train the teacher: PPO on the simulator's state.

Flags start from --preset, or with --resume from the run's config.json; what a --config says wins
over these. Without either the machine decides: gpu, and cpu-demo where there is no GPU. Short forms:
--hand, --hand-layer, --objects, --num-envs and --seed stand for --env.hand and so on, --randomise
for --env.randomisation.enabled.
Ctrl-C saves. --help-all lists the flags of physics, reward, success and of the ranges of Table S3 too."""

_RARE = {
    "env": "sim action reward success visuals table_friction",
    "env.observation": "terms critic_terms",
    "env.curriculum": "goals stillness physics air loose",
    "env.randomisation": "stiffness_scale damping_scale link_mass_scale friction table_friction "
    "object_scale object_scale_count object_sizes object_mass_kg action_noise_std "
    "action_offset_std observation_noise_mean observation_noise_std observation_offset_std "
    "force_probability force_n_per_kg force_decay tracked_pose",
}
OF_HELP_ALL = frozenset(
    f"{group}.{name}" for group, names in _RARE.items() for name in names.split()
)
"""Settings that few runs change: ``--help`` leaves them out, ``--help-all`` does not, and all are
flags.
"""

WHY = {
    "cpu-demo": "there is no GPU: an easier task, turns about the vertical; --preset gpu is whole",
    "gpu": "the recipe that learns; Ctrl-C or --max-minutes ends it",
}
"""Why the machine decides for a preset."""
SHORT_FORMS = {
    name: f"env.{name}" for name in ("hand", "hand-layer", "objects", "num-envs", "seed")
} | {"randomise": "env.randomisation.enabled"}
"""Flags that are short for others: fields of the environment that are common enough."""
STARTS = {
    **{name: f"--{name}" for name in ("preset", "init", "resume", "smoke", "stage")},
    **{f"run.{name}": f"--{name}" for name in ("out", "device")},
    "env.hand": "--env.hand",
}
"""What decides from where a configuration starts, by its place in a file."""


def parse_teacher(
    arguments: Sequence[str], *, say: Callable[..., object] | None = None
) -> TeacherCfg:
    """The configuration that command-line flags ask for.

    ``say`` (:func:`vd.command.line.say_same_as`) is told what the machine decided.

    The first pass finds where to start from (``--preset``, ``--smoke``, what ``--init`` begins
    from, or the run's own configuration with ``--resume``), as flags and ``--config`` say; the
    second reads every flag with those values, and over them those of the file, as defaults.

    Raises:
        FileNotFoundError: ``--resume`` names a run without a configuration.
        ValueError: There is no such preset, the run's configuration is not one of this version, or
            ``--init`` is no teacher.
    """
    arguments, file = starting(normalise(arguments, SHORT_FORMS))
    preset = value_of(arguments, "--preset")
    init = value_of(arguments, "--init")
    resume = value_of(arguments, "--resume")
    out = value_of(arguments, "--out")
    saved = resume is not None and out is not None and (Path(out) / CONFIG_NAME).is_file()
    small = is_on(arguments, "smoke")
    if preset is not None and preset not in PRESETS:
        raise ValueError(f"--preset {preset} is none; one of {', '.join(PRESETS)}")
    chosen = False
    if preset is None and init is not None:
        start = settings_of(init)
    elif small:
        start = PRESETS[preset or "cpu-demo"]()
    elif preset is None and not saved:
        # Wrong flags and names, and --help, do not wait for torch.
        _parsed([word for word in arguments if word != PRINT], PRESETS["gpu"](), file)
        preset = machine_preset(value_of(arguments, "--device"))
        chosen = True
        start = PRESETS[preset]()
    else:
        start = PRESETS[preset or "gpu"]()
    if small:
        done = 0 if init is None else read_start(find_start(init))["env_steps"]
        start = smoke(start, done)
    if init is None:
        start = for_hand(start, value_of(arguments, "--env.hand"))
    base = (saved_config(arguments, start) or start) if resume is not None else start
    cfg = _parsed(arguments, base, file)
    if say is not None and chosen:
        words = ("--preset", preset, "--hand", cfg.env.hand, "--objects", *cfg.env.objects)
        flags = flags_of(cfg.run, always=("out",), over=base.run)
        flags += flags_of(cfg, "preset", "run", "env.hand", "env.objects", over=base)
        say("vd-train", "teacher", *words, *flags, why=WHY[str(preset)])
    return cfg


def starting(arguments: list[str]) -> tuple[list[str], ConfigFile | None]:
    """A command line with what a ``--config`` says of where to start from before it, and that file.

    Raises:
        ValueError: The file and ``--preset`` name two presets.
    """
    arguments, file = take_config(arguments)
    if file is None:
        return arguments, None
    words = file.words(STARTS)
    named = value_of(words, "--preset")
    asked = value_of(arguments, "--preset")
    if named is not None and asked not in (None, named):
        raise ValueError(
            f"--preset {asked}: the settings of {file.path} are those of {named}; name one"
        )
    return words + arguments, file


def machine_preset(device: str | None) -> str:
    """The preset that learns on this machine, or on what ``--device`` asks for."""
    return "cpu-demo" if resolve_device(device or "auto") == "cpu" else "gpu"


def installed_teacher(name: str | None) -> str:
    """The teacher that is taken where none is named: the preset's, if it is installed."""
    return name if name is not None and name in installed_policies() else DEFAULT_POLICY


def check_begun_alike(arguments: list[str], saved: Cfg) -> None:
    """Refuse flags by which a run that goes on would have begun otherwise.

    Raises:
        ValueError: Names the flag, what the run began with, and the remedy.
    """
    asked = {name: value_of(arguments, f"--{name}") for name in ("preset", "init", "stage")}
    asked["smoke"] = "True" if is_on(arguments, "smoke") else None
    for name, value in asked.items():
        begun = getattr(saved, name, None)
        if value not in (None, str(begun)):
            raise ValueError(
                f"--{name} {value}: the run in {saved.run.out} began with {begun}, and goes on so; "
                f"leave --{name} out, or choose another --out"
            )


def normalise(arguments: Sequence[str], short_forms: Mapping[str, str]) -> list[str]:
    """Spell out flags in their short forms, and a bare ``--resume``."""
    result: list[str] = []
    for argument in arguments:
        flag, equals, value = argument.partition("=")
        if not argument.startswith("--"):
            result.append(argument)
            continue
        name = flag[2:].replace("_", "-")
        off = name.startswith("no-") and name[3:] in short_forms
        if name in short_forms or off:
            group, _, field = short_forms[name[3:] if off else name].rpartition(".")
            name = f"{group}.{'no-' if off else ''}{field}"
        result.append(f"--{name}{equals}{value}")
    if "--resume" in result:
        after = result.index("--resume") + 1
        if after == len(result) or result[after].startswith("--"):
            result.insert(after, "latest")
    return result


def is_on(arguments: list[str], name: str) -> bool:
    """Whether a switch is on: the last of it and its negation counts."""
    said = [word for word in arguments if word in (f"--{name}", f"--no-{name}")]
    return said[-1:] == [f"--{name}"]


def value_of(arguments: list[str], flag: str) -> str | None:
    """Value after the last ``flag``, or behind its ``=``, or ``None``."""
    found = None
    for argument, after in zip_longest(arguments, arguments[1:]):
        name, equals, value = argument.partition("=")
        if name == flag:
            found = value if equals else after
    return found


def _parsed(arguments: list[str], default: TeacherCfg, file: ConfigFile | None) -> TeacherCfg:
    """Every flag, with the values of ``file`` and ``default`` for the others.

    Wrong names are refused.
    """
    kind: Any = TeacherCfg
    default = default if file is None else file.over(default)
    if "--help-all" in arguments:
        arguments = ["--help"]
    elif {"-h", "--help"} & set(arguments):
        kind = _without(TeacherCfg, OF_HELP_ALL)
        default = from_dict(kind, to_dict(default))
    cfg: TeacherCfg = parse(
        kind, arguments, default=default, prog="vd-train teacher", description=TEACHER_HELP
    )
    check_names((), cfg.env.objects, cfg.env.hand)
    drawn = cfg.env.randomisation
    before = default.env.randomisation
    given = [name for name, value in vars(before).items() if getattr(drawn, name) != value]
    if given and not drawn.enabled and given != ["enabled"]:
        raise ValueError(
            f"--env.randomisation.{given[-1].replace('_', '-')} draws nothing; add --randomise"
        )
    return cfg


def _without(kind: type, hidden: Collection[str], where: str = "") -> type:
    """The dataclass ``kind``, of which help does not show the fields ``hidden``, dotted paths."""
    shown: dict[str, Any] = {}
    suppressed: Any = tyro.conf.Suppress
    hints = get_type_hints(kind)
    annotations = get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        path = where + field.name
        hint = hints[field.name]
        if path in hidden:
            shown[field.name] = suppressed[hint]
        elif any(name.startswith(f"{path}.") for name in hidden):
            shown[field.name] = _without(hint, hidden, f"{path}.")
        else:
            shown[field.name] = annotations[field.name]
    return type(kind.__name__, (kind,), {"__annotations__": shown, "__doc__": kind.__doc__})


def saved_config(arguments: list[str], start: Cfg) -> Cfg | None:
    """Configuration of the run that ``--resume`` goes on with, of the kind that ``start`` is.

    None where ``auto`` finds no run.

    Raises:
        FileNotFoundError: There is no such run.
        ValueError: Its configuration is of another version.
    """
    run_dir = Path(value_of(arguments, "--out") or start.run.out)
    path = run_dir / CONFIG_NAME
    if not path.is_file():
        if value_of(arguments, "--resume") == "auto":
            return None
        raise FileNotFoundError(f"--resume: no {path}; give the --out of the run to go on with")
    try:
        cfg = from_dict(type(start), json.loads(path.read_text()))
    except ValueError as error:
        raise ValueError(
            f"{path}: {error}; it was written by another version, start anew or edit it"
        ) from error
    cfg = replace(cfg, run=replace(cfg.run, out=run_dir))
    check_begun_alike(arguments, cfg)
    return cfg


def write_config(cfg: "TeacherCfg | AlignmentTrainCfg | StudentTrainCfg") -> None:
    """Save the resolved configuration in the run's folder, for ``--resume`` on any machine."""
    run = replace(cfg.run, device="auto")
    write_json(cfg.run.out / CONFIG_NAME, to_dict(replace(cfg, resume=None, run=run)))
