"""More worlds for the objects that a policy fails with: the success rates of an evaluation."""

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from vd.paper import PAPER

_TOLERANCE = str(PAPER.success.rotation_rad)
"""Error at which success is counted, as evaluations write it [rad]."""
_NAMED = 5
"""Objects that :func:`worlds_text` names."""


def read_success(path: Path) -> dict[str, float]:
    """Success rate of every object within the paper's tolerance, by name, from ``eval.json`` of vd-eval.

    The groups of a comparison are taken together.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no evaluation, or it has more than one rate of an object.
    """
    if not path.is_file():
        raise FileNotFoundError(f"--focus-on: no file {path}; give the eval.json of a vd-eval of the policy")
    rates: dict[str, float] = {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        results = [row["result"] for row in found["rows"]] if "rows" in found else [found]
        measured = [
            (str(item["name"]), float(item["success"][_TOLERANCE]["value"]))
            for result in results
            for item in result["per_object"]
        ]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"--focus-on: {path} is no evaluation ({type(error).__name__}: {error}); "
            "give the eval.json of vd-eval"
        ) from error
    for name, rate in measured:
        if name in rates:
            raise ValueError(
                f"--focus-on: {path} has more than one rate of {name}; evaluate one teacher, each object once"
            )
        rates[name] = rate
    return rates


def worlds_text(names: Sequence[str], world_object: Iterable[int]) -> str:
    """How many worlds the objects have, in words: those with the most, and the least that any has.

    Args:
        names: K names.
        world_object: Object of each world, shape [N].
    """
    counts = Counter(names[index] for index in world_object)
    most = ", ".join(f"{name} {count}" for name, count in counts.most_common(_NAMED))
    mean = sum(counts.values()) / len(names)
    return f"worlds of an object: {min(counts.values())} at least, {mean:.0f} in the mean; most: {most}"
