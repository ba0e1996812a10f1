"""Random delays as the cause of what a search leaves, and the search for what there is beside them.

No single prediction shows them (:mod:`vd.gap.jitter`). So the same search is made once more with samples
weighted by what delays do (:mod:`vd.gap.sample_weighting`); they and what is found beside them are looked for
in turn.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from vd.gap.candidates import BETTER, FULL_ITERATIONS, SCREEN_ITERATIONS, Call
from vd.gap.explanation import Accepted, Explanation, Trial
from vd.gap.joint_fit import JointFit
from vd.gap.judge import JITTER, NO_GAP, REPEATABLE
from vd.gap.sample_weighting import SampleWeighting
from vd.gap.search import Search

SIGMA, DROP = (f"{JITTER}.{name}" for name in ("sigma_s", "p_drop"))
FIXED = "command_delay"
"""What is the mean of random delays, too."""
LATE = (FIXED, "read_delay", "command_filter", "payload_inertia")
"""What makes a joint late as random delays do in the mean: a search finds one of these in their place."""
LIMITS = ("torque_limit", "torque_speed_limit", "torque_saturation", "supply_sag")
"""What keeps a joint late where it starts and turns, as random delays do; from few starts it is not found."""
PROMISING = 2.0
"""Error, in noise floors, that a model leaves at most through a first guess of random delays that are all it
lacks (our choice): 1.1 where they were, 5.4 where friction was missing as well, on one recording."""
HELPS = 0.95
"""Share of the error that a fixed delay, their mean, leaves at most where delays are random (our choice)."""
MOST = 0.2
"""Share of commands dropped from which the spread is as wide as the motion, and hides any cause.

An acceleration limit of 32 noise floors was imitated with 0.37."""
PASSES = 2
"""Searches for what there is beside random delays, each with these as they are beside what the last found."""
NOT_NEAR = 1.5
"""Error after the first of them, in that of the model without them, from which the next is not made."""
HOPELESS = 3.0
"""The same of what is left through it, in what may be left in the end: the first weighting is too narrow."""
SAME_SPREAD = 0.1
"""Relative change of their standard deviation up to which they are the same."""
SPREAD = "its spread is what is measured"
"""Why they are named."""


def try_jitter(
    search: Search, baseline: JointFit, present: JointFit
) -> tuple[JointFit, tuple[Accepted, ...], list[Trial]]:
    """What nothing else explains can be random delays, and what is to be found beside them.

    Args:
        search: The search that has come to its end.
        baseline: The plain model.
        present: What the search has found.

    Returns:
        The better model; what it has besides random delays, if it has these; and the evidence.
    """
    if not _tried(search):
        return present, (), []
    random, beside, rows, left = with_jitter(search, baseline, present)
    others = [name for name in random.effects if name != JITTER]
    if others:
        rest = search.search_nearby(search.refit(random, others), search.whole)
        if search.white(rest) and not search.better(rest, random)[0]:
            # No jitter is needed: it has only smoothed the way to where the search before did not come.
            search.report(f"+ {' and '.join(others)}: {1e3 * rest.held_out_rmse:.2f} mrad held out")
            return rest, (), []
    accepted, why = search.better(present, random)
    if not accepted and len(random.effects) <= len(present.effects) and left < NO_GAP * search.floor:
        # In the place of as many effects they are no further one.
        accepted = search.likelier(present, random)
    if left > REPEATABLE * search.floor:
        accepted, why = False, f"leaves {left / search.floor:.1f} noise floors besides, more than chance does"
    gain, ci = search.gain(present, random)
    decision = "named" if accepted else "rejected"
    row = Trial(1, JITTER, random, gain, ci, decision, SPREAD if accepted else why)
    if not accepted:
        return present, (), [row]
    random = bounded(search, random)
    names, before, after = " and ".join(random.effects), present.held_out_rmse, random.held_out_rmse
    text = f"as likely as {1e3 * after:.2f} mrad of constant width, before {1e3 * before:.2f}"
    search.report(f"+ {names}: {text}")
    return random, beside, [row, *rows]


def at_once(search: Search, baseline: JointFit) -> tuple[JointFit, SampleWeighting] | None:
    """Random delays of a model in which nothing else is missing but what a fixed delay can stand for.

    Given where they leave noise and are likelier than that delay: then no wide search is worth its time. A
    filter or a payload beside them is late as well, and they alone would have its mean in their spread.
    So a fixed delay stands for it where the motions are sure of one. Asked again, it is answered at once.

    Args:
        search: The search that is to be made.
        baseline: The plain model.

    Returns:
        The model, and what the delays do to the samples.
    """
    if not _tried(search) or FIXED not in {*search.candidates} - {*search.vetoes}:
        return None
    starts = search.starts(baseline, search.sized(baseline, FIXED))
    fixed = search.run([search.call(baseline, (FIXED,), starts, FULL_ITERATIONS)])[0]
    if search.white(fixed) or fixed.rmse > HELPS * baseline.rmse:
        return None
    alone = _spread(search, baseline, baseline, fixed)
    if alone is None:
        return None
    beside = _spread(search, baseline, fixed, fixed)
    if beside is None or not search.sure(alone[0], beside[0]):
        return alone
    return beside


def in_place(search: Search, present: JointFit) -> tuple[JointFit, SampleWeighting] | None:
    """Random delays in the place of what is late in a model of several effects, as :func:`at_once` has them.

    A search that goes on from there adds what imitates their spread, motion by motion, and drops it again.

    Args:
        search: The search.
        present: The model.
    """
    if not _tried(search) or len(present.effects) < 2 or search.white(present):
        return None
    for name in present.effects:
        if name in LATE:
            rest = search.refit(present, [other for other in present.effects if other != name])
            if found := _spread(search, rest, rest, present, PROMISING * search.floor):
                return found
    return None


def unlimited(search: Search, late: JointFit, random: JointFit) -> bool:
    """Whether random delays are likelier than a limit of the torque beside what is late, from every start.

    Lest the early end of a search be for the want of a start: so two torque-speed lines beside a delay or a
    payload were taken for random delays.

    Args:
        search: The search that would end.
        late: What it has found.
        random: The model with random delays.
    """
    names = [name for name in LIMITS if name in {*search.candidates} - {*search.vetoes, *late.effects}]
    starts = [search.starts(late, search.sized(late, name)) for name in names]
    calls = [search.call(late, *pair, SCREEN_ITERATIONS) for pair in zip(names, starts, strict=True)]
    near = [fit for fit in search.run(calls) if fit.rmse < BETTER * late.rmse]
    fits = search.run([search.call(late, f.effects[-1], [f.values], FULL_ITERATIONS) for f in near])
    return all(search.likelier(fit, random) for fit in fits)


def _tried(search: Search) -> bool:
    """Whether random delays are among what a search may find."""
    return not search.behind_jitter and JITTER in search.candidates and JITTER not in search.vetoes


def _spread(
    search: Search, baseline: JointFit, rest: JointFit, late: JointFit, promising: float = np.inf
) -> tuple[JointFit, SampleWeighting] | None:
    """Random delays beside nothing but a model, as :func:`at_once` has them.

    Args:
        search: The search.
        baseline: Model for the first guess.
        rest: The model beside them.
        late: The model without them that they have to be likelier than.
        promising: Error through the first guess from which no better one is looked for [rad].
    """

    def weighted(weighting: SampleWeighting) -> JointFit:
        return search.run([("fit", {**refit, "weighting": weighting})])[0]

    refit = {**search.call(rest, (), [rest.values], FULL_ITERATIONS)[1], "refits": 0}
    jitter, weighting = search.run([("look", {"fit": baseline, "scales": search.scales})])[0]
    if weighted(weighting).rmse > promising:
        return None
    for _ in range(PASSES):
        call = {"fit": weighted(weighting), "scales": search.scales, "start": jitter}
        random, weighting = search.run([("fit_jitter", call)])[0]
        jitter = random.values[SIGMA], random.values[DROP]
        if not search.likelier(late, random) or jitter[1] > MOST:
            return None
    return (random, weighting) if weighted(weighting).rmse < NO_GAP * search.floor else None


def jitter_as_another(search: Search, baseline: JointFit, loose: str) -> Explanation | None:
    """The explanation of a joint by random delays where another of its finger has them, without a search.

    The commands of a finger go out together: what is late at random on one joint is on all. None where more
    than noise is left, or where they are not likelier than the plain model.

    Args:
        search: Of the joint; :attr:`~vd.gap.search.Search.jittered` is what the other has.
        baseline: The plain model.
        loose: What of the baseline the motions leave open.
    """
    if not search.jittered[0] or not _tried(search):
        return None
    random, beside, rows, left = with_jitter(search, baseline, baseline)
    if left > NO_GAP * search.floor or not search.likelier(baseline, random):
        return None
    random = bounded(search, random)
    gain, ci = search.gain(baseline, random)
    names, before, after = " and ".join(random.effects), baseline.held_out_rmse, random.held_out_rmse
    search.report(
        f"+ {names}, as on another joint: as likely as {1e3 * after:.2f} mrad, before {1e3 * before:.2f}"
    )
    row = Trial(1, JITTER, random, gain, ci, "named", f"as on another joint: {SPREAD}")
    return search.conclude(baseline, random, {}, [row, *rows], loose, known=beside)


def bounded(search: Search, random: JointFit) -> JointFit:
    """A model with the intervals of its random delays."""
    return search.run([("bound_jitter", {"fit": random, "scales": search.scales})])[0]


def with_jitter(
    search: Search, baseline: JointFit, present: JointFit
) -> tuple[JointFit, tuple[Accepted, ...], list[Trial], float]:
    """The model with random delays, what is named beside them, and the evidence for that.

    The arguments are those of :func:`try_jitter`. The last result is the error of the rest of the model, seen
    through what the delays do [rad]: the noise floor if it is right. What another joint of the finger is sure
    to have beside random delays is tried first, and its delays are where the search begins.
    """
    names, values = search.jittered
    like = tuple(name for name in names if name != JITTER)
    beside_them = like, {key: value for key, value in values.items() if not key.startswith(JITTER)}
    known = None if like else at_once(search, baseline) or in_place(search, present)
    if known is not None:
        # Nearly all is known of them: there is no need to begin with less than the likeliest.
        jitter, weighting = (known[0].values[SIGMA], known[0].values[DROP]), known[1]
    else:
        look = {"fit": baseline, "scales": search.scales}
        look |= {"start": (values[SIGMA], values[DROP])} if names else {}
        jitter, weighting = search.run([("look", look)])[0]
    for _ in range(PASSES):
        inner = replace(behind(search, weighting), like=beside_them)
        plain = inner.run([inner.plain(baseline)])[0]
        found = inner.explain(plain)
        clear = found.verdict in ("effects", "ambiguous")
        rest, beside = (found.final, found.accepted) if clear else (plain, ())
        call = {"fit": rest, "scales": search.scales, "start": jitter}
        random, weighting = search.run([("fit_jitter", call)])[0]
        before, jitter = jitter, (random.values[SIGMA], random.values[DROP])
        same = abs(np.log(jitter[0] / before[0])) < SAME_SPREAD
        hopeless = rest.rmse > HOPELESS * REPEATABLE * search.floor
        if same or hopeless or equivalent(random) > NOT_NEAR * equivalent(present):
            break
    rows = [
        replace(row, round=row.round + 1, fit=replace(row.fit, effects=(JITTER, *row.fit.effects)))
        for row in found.trials
    ]
    return random, beside, rows, rest.rmse


def equivalent(fit: JointFit) -> float:
    """RMSE of a fit as a likelihood has it that knows a width of each motion: their geometric mean [rad]."""
    return float(np.exp(0.5 * np.sum(fit.count * np.log(fit.sse / fit.count)) / fit.count.sum()))


def behind(search: Search, weighting: SampleWeighting) -> Search:
    """The same search, samples weighted by what random delays do to them."""

    def run(calls: list[Call]) -> list[Any]:
        return search.run([(name, {**options, "weighting": weighting}) for name, options in calls])

    return replace(
        search,
        run=run,
        candidates=[name for name in search.candidates if name != JITTER],
        like=((), {}),
        changing=((), {}),
        jittered=((), {}),
        behind_jitter=True,
        report=lambda line: search.report(f"beside {JITTER}: {line}"),
        without={},
        apart={},
        promised={},
        added={},
    )
