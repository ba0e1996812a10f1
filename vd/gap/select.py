"""Explain what one joint lacks: search, weigh samples that say little, try random delays, conclude."""

from dataclasses import replace

from vd.gap.evidence import JITTER, cancelled
from vd.gap.explanation import Explanation
from vd.gap.jitter_search import try_jitter
from vd.gap.joint_fit import JointFit
from vd.gap.sample_weighting import SampleWeighting
from vd.gap.search import MAX_ROUNDS, UNEARNED, Search
from vd.gap.telemetry import BEHIND_SENSOR

MIN_TRAJECTORIES = 3
WEIGHTED = "where errors of the recording's clock grow, samples count by how surely they are known"
"""What a reason says of it."""


def explain(search: Search, baseline: JointFit) -> Explanation:
    """Select effects, starting from the fitted plain model.

    Args:
        search: Of the joint.
        baseline: The plain model.
    """
    loose = search.undetermined(baseline)
    if nothing := _nothing_to_explain(search, baseline, loose):
        return nothing
    if weighting := search.clock_sensitivity(baseline):  # with an identified limit in it
        return _explain_weighted(search, baseline, weighting)
    present, rows = search.search(baseline)
    trials = [*search.contradicted(baseline), *rows]
    if weighting := search.clock_sensitivity(present):
        return _explain_weighted(search, baseline, weighting)
    if present.effects:
        earned, why = search.better(baseline, present)
        if not earned:
            search.report(f"taken back: {why}")
            present = baseline
    known = ()
    if not search.no_gap(present) and present.rmse > UNEARNED * search.floor:
        found, known, rows = try_jitter(search, explain, baseline, present)
        present = found if found is present or JITTER in found.effects else search.revise(found)
        trials += [replace(row, round=row.round + 2 * MAX_ROUNDS) for row in rows]
    evidence = search.settle(trials, present)
    random = JITTER in present.effects
    rivals = {} if random else {name: search.rivals(present, name) for name in present.effects}
    refined = None if random or not present.effects else search.refined(present)
    found = search.conclude(baseline, present, rivals, evidence, loose, refined, known)
    return found if random else _with_notes(search, found)


def _nothing_to_explain(search: Search, baseline: JointFit, loose: str) -> Explanation | None:
    """The explanation of a joint whose plain model leaves nothing to search for, or cannot be judged."""
    if len(baseline.sse) < MIN_TRAJECTORIES:
        text = f"{len(baseline.sse)} trajectories leave none to hold out; record {MIN_TRAJECTORIES} at least"
        return Explanation(baseline, baseline, "under_excited", text)
    if not search.no_gap(baseline):
        return None
    text = "the plain model is within the noise floor"
    return Explanation(baseline, baseline, "under_excited" if loose else "no_gap", loose or text)


def _explain_weighted(search: Search, baseline: JointFit, weighting: SampleWeighting) -> Explanation:
    """What a search finds with samples weighted by how surely they are known, which says so."""
    search.report("errors of the clock grow: samples are weighted by how surely they are known")
    inner = search.weighted(weighting)
    found = explain(inner, inner.run([inner.plain(baseline)])[0])
    return replace(found, weighting=weighting, reason=f"{found.reason}; {WEIGHTED}")


def _with_notes(search: Search, explanation: Explanation) -> Explanation:
    """The explanation with what its names do not say.

    What a member of a set means that telemetry contradicts by its name; and no names where two effects are
    but one that is not in the table.
    """
    alike = cancelled(explanation.final, search.joint, search.rest)
    if alike and explanation.verdict in ("effects", "ambiguous"):
        return replace(explanation, verdict="unknown", reason=alike)
    tied = {name for one in explanation.accepted for name in one.tied}
    notes = [
        f"{name} {BEHIND_SENSOR[name]}" for name in sorted(tied & set(BEHIND_SENSOR) & set(search.vetoes))
    ]
    return replace(explanation, reason="; ".join([explanation.reason, *notes]))
