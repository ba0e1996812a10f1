"""Random delays as the cause of what a search leaves, and the search for what there is beside them.

No single prediction shows them (:mod:`vd.gap.jitter`). So the same search is made once more with
samples weighted by what delays do (:mod:`vd.gap.joint_fit`); they and what is found beside them are
looked for in turn.
"""

from collections.abc import Callable
from dataclasses import replace

from vd.gap.evidence import JITTER
from vd.gap.explanation import Accepted, Explanation, Trial
from vd.gap.joint_fit import JointFit
from vd.gap.search import Search
from vd.gap.statistics import REPEATABLE

Explain = Callable[[Search, JointFit], Explanation]
"""Explains a joint by a search, from its plain model."""

SIGMA, DROP = (f"{JITTER}.{name}" for name in ("sigma_s", "p_drop"))
FIXED = "command_delay"
"""What is the mean of random delays, too."""
PASSES = 2
"""Searches for what there is beside random delays, each with these as they are beside what the last
found. With one, the interval of a delay beside them is a quarter as wide, and misses; three were
not tried.
"""
SPREAD = "its spread is what is measured"
"""Why they are named."""


def try_jitter(
    search: Search, explain: Explain, baseline: JointFit, present: JointFit
) -> tuple[JointFit, tuple[Accepted, ...], list[Trial]]:
    """What nothing else explains can be random delays, and what is to be found beside them.

    Args:
        search: The search that has come to its end.
        explain: Explains a joint by a search.
        baseline: The plain model.
        present: What the search has found.

    Returns:
        The better model; what it has besides random delays, if it has these; and the evidence.
    """
    if search.behind_jitter or JITTER not in search.candidates or JITTER in search.vetoes:
        return present, (), []
    random, beside, rows, left = with_jitter(search, explain, baseline, present)
    others = [name for name in random.effects if name != JITTER]
    if others:
        rest = search.refit(random, others)
        if search.white(rest) and not search.likelier(rest, random)[0]:
            # No jitter is needed: it has only smoothed the way to where the search before did not
            # come.
            search.report(f"+ {' and '.join(others)}: {1e3 * rest.held_out_rmse:.2f} mrad held out")
            return rest, (), []
    accepted, why = search.likelier(present, random)
    if left > REPEATABLE * search.floor:
        accepted, why = (
            False,
            f"leaves {left / search.floor:.1f} noise floors besides, more than chance does",
        )
    gain, ci = search.gain(present, random)
    decision = "named" if accepted else "rejected"
    row = Trial(1, JITTER, random, gain, ci, decision, SPREAD if accepted else why)
    if not accepted:
        return present, (), [row]
    random = search.run([("bound_jitter", {"fit": random, "scales": search.scales})])[0]
    names, before, after = " and ".join(random.effects), present.held_out_rmse, random.held_out_rmse
    text = f"as likely as {1e3 * after:.2f} mrad of constant width, before {1e3 * before:.2f}"
    search.report(f"+ {names}: {text}")
    return random, beside, [row, *rows]


def with_jitter(
    search: Search, explain: Explain, baseline: JointFit, present: JointFit
) -> tuple[JointFit, tuple[Accepted, ...], list[Trial], float]:
    """The model with random delays, what is named beside them, and the evidence for that.

    The arguments are those of :func:`try_jitter`. The last result is the error of the rest of the
    model, seen
    through what the delays do [rad]: the noise floor if it is right.
    """
    jitter, weighting = search.run([("look", {"fit": baseline, "scales": search.scales})])[0]
    for _ in range(PASSES):
        inner = search.weighted(
            weighting,
            candidates=[name for name in search.candidates if name != JITTER],
            behind_jitter=True,
            report=lambda line: search.report(f"beside {JITTER}: {line}"),
        )
        plain = inner.plain(baseline)
        found = explain(inner, plain)
        clear = found.verdict in ("effects", "ambiguous")
        rest, beside = (found.final, found.accepted) if clear else (plain, ())
        call = {"fit": rest, "scales": search.scales, "start": jitter}
        random, weighting = search.run([("fit_jitter", call)])[0]
        jitter = random.values[SIGMA], random.values[DROP]
        if not search.likelier(present, random)[0]:
            break
    rows = [
        replace(row, round=row.round + 1, fit=replace(row.fit, effects=(JITTER, *row.fit.effects)))
        for row in found.trials
    ]
    return random, beside, rows, rest.rmse
