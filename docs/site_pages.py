"""What the site has beyond the files of ``docs``, and the tables of the reference.

A hook of mkdocs (``mkdocs.yml``), by which documents of the root are pages too. As a script (``make
reference``) it writes anew what the pages of ``docs/reference`` have of the code, between two
comments. The package has to be installed.
"""

import contextlib
import dataclasses
import importlib
import inspect
import io
import os
import re
import sys
import textwrap
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

ROOT = Path(__file__).resolve().parents[1]
AT_ROOT = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "ARCHITECTURE.md": "architecture.md",
    "CHANGELOG.md": "changelog.md",
    "LICENSE": "LICENSE",
    "CITATION.cff": "CITATION.cff",
}
"""Files of the repository's root, and where they are on the site."""
COLUMNS = 78
"""Width of help texts: what a page shows without scrolling."""


def on_files(files: Any, config: Any) -> Any:
    """Add the documents of the root."""
    from mkdocs.structure.files import File

    for name, uri in AT_ROOT.items():
        files.append(File.generated(config, uri, content=(ROOT / name).read_text()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Have links between root and ``docs`` lead to pages of the site."""
    uri = page.file.src_uri
    if uri in AT_ROOT.values():
        markdown = markdown.replace("](docs/", "](")
    names = "|".join(map(re.escape, AT_ROOT))
    up = "../" * uri.count("/")
    return re.sub(
        rf"\]\((?:\.\./)*({names})(?=[)#])", lambda link: f"]({up}{AT_ROOT[link[1]]}", markdown
    )


def generated(markdown: str) -> str:
    """A page with what it has of the code made anew, between ``generated`` and ``end`` comments."""
    return re.sub(
        r"<!-- generated: (\w+) -->\n.*?<!-- end -->",
        lambda mark: f"<!-- generated: {mark[1]} -->\n{GENERATED[mark[1]]()}\n<!-- end -->",
        markdown,
        flags=re.DOTALL,
    )


def on_page_content(html: str, **_: Any) -> str:
    """Show a film where a page links to one."""
    return re.sub(
        r'<a href="([^"]+\.mp4)">(.*?)</a>', r'\2 <video controls muted src="\1"></video>', html
    )


def commands() -> str:
    """Every command and subcommand with its own help text."""
    parts = []
    for script, target in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "scripts"
    ].items():
        module, _, function = target.partition(":")
        main = getattr(importlib.import_module(module), function)
        text = _help(main, script, ())
        parts += [f"## {script}", f"```text\n{text}\n```"]
        for name in _subcommands(text):
            parts += [f"### {script} {name}", f"```text\n{_help(main, script, (name,))}\n```"]
    return "\n\n".join(parts)


def _help(main: Callable[[], object], script: str, words: Sequence[str]) -> str:
    """What ``script words --help`` prints, or ``--help-all`` where that says more."""
    flag = "--help-all" if tuple(words) == ("teacher",) else "--help"
    shown = io.StringIO()
    with (
        mock.patch.dict(os.environ, {"COLUMNS": str(COLUMNS), "NO_COLOR": "1", "TERM": "dumb"}),
        mock.patch.object(sys, "argv", [script, *words, flag]),
        contextlib.redirect_stdout(shown),
        contextlib.suppress(SystemExit),
    ):
        main()
    lines = shown.getvalue().replace("``", "").strip().splitlines()
    if not lines:
        raise ValueError(f"`{script} {' '.join(words)} {flag}` prints nothing")
    return "\n".join(
        line.rstrip() if line[:1] == " " else textwrap.fill(line, COLUMNS) for line in lines
    )


def _subcommands(text: str) -> Iterator[str]:
    """Names of the subcommands that a help text lists."""
    listed = re.search(r"^usage: vd-\w+ \[-h\] \{([a-z,-]+)\}", text)
    if listed:
        yield from listed[1].split(",")
    elif "\ncommands:\n" in text:
        block = text.partition("\ncommands:\n")[2].partition("\n\n")[0]
        yield from re.findall(r"^  ([a-z][a-z-]+)", block, re.MULTILINE)


def names() -> str:
    """The stable names of the package: what each takes, and its docstring."""
    import vd

    parts = []
    for name in vd.__all__:
        thing = getattr(vd, name)
        parts += [f"## {name}", _documented(name, thing)]
        # Of a class the methods that its docstring names.
        methods = re.findall(r":meth:`(\w+)`", thing.__doc__) if inspect.isclass(thing) else ()
        parts += [_documented(f"{name}.{method}", getattr(thing, method)) for method in methods]
    return "\n\n".join(parts)


def _documented(name: str, thing: Any) -> str:
    """A class or function with its docstring, and its signature, unless that is long."""
    own = inspect.isclass(thing) and not dataclasses.is_dataclass(thing)
    texts = [inspect.getdoc(one) or "" for one in ([thing, thing.__init__] if own else [thing])]
    text = re.sub(r":\w+:`([^`]+)`", r"\1", "\n\n".join(texts)).replace("``", "")
    signature = str(inspect.signature(thing)).replace("'", "")
    shown = f"{name}{signature if len(signature) < 2 * COLUMNS else '(...)'}"
    return f"```text\n{shown}\n\n{textwrap.indent(text, '    ')}\n```"


def example(name: str) -> str:
    """One of the examples."""
    return f"```python\n{(ROOT / f'examples/{name}.py').read_text()}```"


def constants() -> str:
    """The paper's constants with their sources."""
    from vd.paper import provenance

    rows = ((f"`{name}`", value, tag, note) for name, value, tag, note in provenance())
    return _table(("name", "value", "kind", "source"), rows)


def effects() -> str:
    """The effects of the servo model with their parameters."""
    from vd.kernels.servo.effects import EFFECTS

    rows = (
        (
            f"`{effect.name}`",
            effect.meaning,
            f"`vd:{effect.name}:{p.name}`",
            p.unit,
            f"{p.typical:g}",
        )
        for effect in EFFECTS.values()
        for p in effect.parameters
    )
    return _table(("effect", "what it is", "attribute", "unit", "typical"), rows)


def registers() -> str:
    """The registers of a motor that the preflight compares."""
    from vd.deploy.hardware.registers import REGISTERS

    rows = ((f"`{one.name}`", one.why, "refused" if one.remedy else "set") for one in REGISTERS)
    return _table(("register", "with another value", "what we do"), rows)


OBSERVED = {
    "joint_position": "position of each joint, from its lower limit -1 to its upper limit 1",
    "joint_velocity": "velocity of each joint, 0.2 of it [rad/s]",
    "object_position": "position of the object, world frame [m]",
    "object_orientation": "its orientation, xyzw, of the axes of its file",
    "object_velocity": "its velocity [m/s]",
    "object_spin": "its angular velocity, 0.2 of it [rad/s]",
    "goal_orientation": "wanted orientation of the object, xyzw",
    "relative_orientation": "rotation from the goal to the object, object times conjugate goal, xyzw",
    "fingertips": "each fingertip: position [m], orientation xyzw, velocity [m/s], spin [rad/s]",
    "previous_action": "moving average of the actions so far",
    "surface": "each fingertip: vector to the nearest point of the surface [2 cm]",
    "extent": "how far the object extends up, down and in three rings, less 5 cm [2 cm]",
    "goal_extent": "the same as it would lie at the goal",
    "critic/dynamics": "what was drawn: five values a joint, frictions, mass, latency; 0 is nominal",
    "critic/present": "state and shape of this moment, without noise and latency",
}
"""What the values of an observation are, and their units."""


def observation() -> str:
    """The columns of an observation, of both D'Claws, with all parts that can be switched on."""
    from vd.api import observation_layout
    from vd.envs.cfg import ObservationCfg, ReorientCfg

    seen = ObservationCfg(shape="full", dynamics="critic")
    three, four = (
        observation_layout(ReorientCfg(hand=hand, observation=seen))
        for hand in ("dclaw3", "dclaw4")
    )
    rows = (
        (
            f"`{name}`",
            f"{three[name].start}:{three[name].stop}",
            f"{four[name].start}:{four[name].stop}",
            OBSERVED[name],
        )
        for name in three
    )
    return _table(("name", "dclaw3", "dclaw4", "what it is [unit]"), rows)


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    cells = ([" ".join(str(cell).replace("|", "\\|").split()) for cell in line] for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


GENERATED = {
    "observation": observation,
    "names": names,
    "own_terms": partial(example, "own_terms"),
    "contact": partial(example, "contact"),
    "commands": commands,
    "constants": constants,
    "effects": effects,
    "registers": registers,
}
"""What stands behind a comment ``<!-- generated: name -->``."""


if __name__ == "__main__":
    for path in sorted((ROOT / "docs").rglob("*.md")):
        page = path.read_text()
        if (anew := generated(page)) != page:
            path.write_text(anew)
            print(path.relative_to(ROOT))
