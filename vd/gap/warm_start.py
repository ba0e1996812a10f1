"""Rough models of a finger's joints, from the first that is searched.

The joints before it are then simulated as their plain models move. Where these are off by a hundred noise
floors they shake it as it was not shaken, by more than noise, and no effect of its own makes up for that.
What it mostly lacks they mostly lack as well: with that they do as they did.
"""

from collections.abc import Callable, Mapping

from vd.gap.joint_fit import JointFit
from vd.gap.judge import SHARP
from vd.gap.select import MIN_TRAJECTORIES, Selection

FAR = 50.0
"""Gap in noise floors from which a joint shakes others by more than noise: one of four hundred does so by
five (our choice)."""
NEARER = 0.5
"""Share of a plain model's error up to which a rough one is better company (our choice): it may lack
something more."""

Fit = Callable[[tuple[str, ...], Mapping[str, float]], JointFit]
"""Fits a joint with these effects from these values."""


def rough_model(search: Selection, baseline: JointFit) -> JointFit | None:
    """What a joint mostly lacks: the best model with one effect, where it explains nearly all but not all.

    The search makes the same fits, and does not make them again.

    Args:
        search: Of the joint.
        baseline: Its plain model.
    """
    if len(baseline.sse) < MIN_TRAJECTORIES or baseline.held_out_rmse < FAR * search.floor:
        return None
    fits = search.fit_candidates(baseline)
    best = search.winner(list(fits.values())) if fits else baseline
    return best if best.rmse < SHARP * baseline.rmse and not search.white(best) else None


def warm_starts(
    rough: JointFit, plain: Mapping[str, JointFit], fits: Mapping[str, Fit]
) -> dict[str, JointFit]:
    """Models of the other joints with what one mostly lacks, of those which that explains for the most part.

    Args:
        rough: Model of the one.
        plain: Plain models of the others, by name.
        fits: Fit these.
    """
    values = {key: value for key, value in rough.values.items() if "." in key}
    found = {name: fits[name](rough.effects, values) for name in plain}
    return {name: fit for name, fit in found.items() if fit.rmse < NEARER * plain[name].rmse}
