"""What errors of a recording's clock do where a model lets them grow.

A profile of bounded acceleration that cannot follow its command turns at moments that hang on ever smaller
things: a tenth of a millisecond is tens of milliradians some seconds later, and no fit of the right model
leaves noise there. Such samples say little. Weighted by how surely they are known
(:mod:`vd.gap.sample_weighting`), the right model leaves noise again, and a search ends with it.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from vd.gap.candidates import Call
from vd.gap.explanation import Explanation
from vd.gap.jitter import CALLS
from vd.gap.joint_fit import JointFit
from vd.gap.judge import JITTER
from vd.gap.sample_weighting import SampleWeighting
from vd.gap.search import Search

GROWN = 1.5
"""Spread of the samples of a motion, in that of the noise alone, from which they are weighted. Motions that
do not let errors grow have 1.05 at most (our choice)."""
WEIGHTED = "where errors of the recording's clock grow, samples count by how surely they are known"
"""What a reason says of it."""


def clock_sensitivity(search: Search, fit: JointFit) -> SampleWeighting | None:
    """What errors of the clock do under a model that leaves more than noise; None where they do not grow.

    Args:
        search: Whose model it is; one that weighs its samples already does not ask again.
        fit: The model.
    """
    if search.clocked or search.behind_jitter or JITTER in fit.effects or search.no_gap(fit):
        return None
    weighting = search.run([("clock_weighting", {"fit": fit, "scales": search.scales})])[0]
    ends = np.cumsum(fit.count.astype(int))[:-1]
    spread = [float(np.sqrt(np.mean(part**2))) for part in np.split(weighting.growth, ends)]
    return weighting if max(spread) > GROWN else None


def weighted(search: Search, weighting: SampleWeighting) -> Search:
    """The same search with samples weighted by how surely they are known."""

    def run(calls: list[Call]) -> list[Any]:
        # What jitter does is more than what the clock does, and is measured on the samples themselves.
        return search.run(
            [
                (name, options if name in CALLS else {"weighting": weighting, **options})
                for name, options in calls
            ]
        )

    return replace(search, run=run, clocked=True, without={}, apart={}, promised={}, added={})


def explain_weighted(search: Search, baseline: JointFit, weighting: SampleWeighting) -> Explanation:
    """What a search finds with samples weighted by how surely they are known.

    Args:
        search: The search.
        baseline: The plain model, fitted to samples that all count the same.
        weighting: What errors of the clock do.
    """
    search.report("errors of the clock grow: samples are weighted by how surely they are known")
    inner = weighted(search, weighting)
    return told(inner.explain(inner.run([inner.plain(baseline)])[0]), weighting)


def told(found: Explanation, weighting: SampleWeighting) -> Explanation:
    """What was found with samples weighted, which says so."""
    return replace(found, weighting=weighting, reason=f"{found.reason}; {WEIGHTED}")
