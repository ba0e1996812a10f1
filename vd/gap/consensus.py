"""What the joints of one machine tell each other: a set on one of them that another settles."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from vd.gap.explanation import NAMED, Explanation, added, certain, estimates, intervals
from vd.gap.joint_fit import JointFit
from vd.gap.judge import (
    EXPLAINED,
    JITTER,
    MIN_GAIN,
    MIN_GAIN_FLOORS,
    NESTED,
    SMALL_EXCESS_FLOORS,
)
from vd.gap.verdict import CANCELLING, explains
from vd.gap.warming import LEVELS

OF_THE_MACHINE = {"command_delay", "read_delay", "command_jitter", "supply_sag", "gravity_load"}
"""What all joints of a machine have or have not: its bus, its supply, gravity."""

CHANGING = "its friction changes over the recording, as another joint of the finger shows"
"""Why a constant friction is no name, nor what is found beside it."""

Polish = Callable[[JointFit], JointFit]
"""Fits a model to the end."""
Fit = Callable[[tuple[str, ...], Sequence[Mapping[str, float]]], JointFit]
"""Fits the model with these effects to the end, from these starts."""


def share(
    explanations: Sequence[Explanation],
    floors: Sequence[float],
    groups: Sequence[int] | None = None,
    polish: Sequence[Polish] | None = None,
) -> list[Explanation]:
    """Name on a joint that member of a set which another joint names, or which all such sets share.

    The joints of a finger are built alike: one cause on all of them is simpler than another on each. Joints
    that have nothing in common but the machine share its bus, its supply, and that it stands in gravity, but
    not the friction or the play of one gear. What comes nearest on a joint whose gap nothing explains is no
    answer: other joints do not make it one, nor does it settle theirs.

    Args:
        explanations: Of the joints.
        floors: Their noise floors [rad].
        groups: Number of the finger of each joint; one for all if None.
        polish: Of each joint: fits a member of a set to the end, which the search for the best one did not.
    """
    fingers = [0] * len(explanations) if groups is None else groups
    result = []
    finish = [_as_it_is] * len(explanations) if polish is None else polish
    for explanation, floor, finger, end in zip(explanations, floors, fingers, finish, strict=True):
        if not _answered(explanation):
            result.append(explanation)
            continue
        alike = [e for e, other in zip(explanations, fingers, strict=True) if other == finger]
        named = _named(alike) | (_named(explanations) & OF_THE_MACHINE)
        result.append(_adopt(explanation, named, floor, end))
    return result


def agree(
    explanations: Sequence[Explanation], floors: Sequence[float], groups: Sequence[int], fits: Sequence[Fit]
) -> list[Explanation]:
    """Explain a joint as all others of its finger are explained, or have a part of, where that is as good.

    A search can end where no step leads out: with a filter and another load in the place of the delay and the
    load that the other joints have. Their values are a start that it did not have. A fuller form of what the
    others have has to be better by what an effect must gain: it is found where it imitates something else. So
    has a model of more effects than the joint's own, which also has to leave noise. A model of fewer effects
    needs no second joint, and where it leaves noise the joint's own has to gain as much over it: a load and a
    coupling stood for a limit that one of three joints had been found to have, a filter for what a line was
    short of at the end of its fit.

    Args:
        explanations: Of the joints.
        floors: Their noise floors [rad].
        groups: Number of the finger of each joint.
        fits: Of each joint.
    """
    result = list(explanations)
    for i, own in enumerate(explanations):
        others = [e for j, e in enumerate(explanations) if j != i and groups[j] == groups[i]]
        for model in _models(own, others):
            fit = _as(model, own, fits[i])
            if fit.at_bound or _worse(fit, own.final, floors[i]):
                continue
            spread, effects = intervals(fit, floors[i]), model.final.effects
            result[i] = replace(
                own,
                final=fit,
                accepted=tuple(replace(a, estimates=estimates(fit, a.name, spread)) for a in model.accepted),
                verdict="effects",
                reason=f"{explains(effects)}, as on the other joints",
            )
            break
    return result


def _models(own: Explanation, others: Sequence[Explanation]) -> list[Explanation]:
    """What a joint may have as well: what all others have, or a part of, or fewer effects that one has."""
    mine, sure = {*own.final.effects}, [e for e in others if certain(e)]
    if not mine or not sure:
        return []
    # Where one of two effects is too small to show there, a joint has the other alone.
    most = max(sure, key=lambda e: len(e.final.effects))
    common = len(sure) == len(others) > 1 and all({*e.final.effects} <= {*most.final.effects} for e in sure)
    fewer = [e for e in sure if _answered(own) and 0 < len(e.final.effects) < len(mine)]
    models = sorted(fewer, key=lambda e: len(e.final.effects))
    if common:
        models = [most, *(e for e in models if e is not most)]
    return [e for e in models if JITTER not in e.final.effects and {*e.final.effects} != mine]


def _as(model: Explanation, own: Explanation, fit: Fit) -> JointFit:
    """The fit of a joint with the effects of another's model, from the values that these have there."""
    effects, theirs = added(model.final)
    starts = [
        {**{k: v for k, v in start.values.items() if "." not in k}, **theirs}
        for start in (own.final, own.baseline, model.final)
    ]
    return fit(effects, starts)


def _worse(fit: JointFit, own: JointFit, floor: float) -> bool:
    """Whether a joint's own model is to be kept; see :func:`agree`."""
    earns, noise = (MIN_GAIN_FLOORS * floor) ** 2, EXPLAINED * floor
    if len(fit.effects) > len(own.effects):
        return own.rmse**2 - fit.rmse**2 < earns or fit.rmse > noise
    if len(fit.effects) < len(own.effects) and fit.rmse < noise:
        return fit.rmse**2 - own.rmse**2 > earns  # a further effect has to be earned here, too
    if all({name, *NESTED.get(name, ())} & {*fit.effects} for name in own.effects):
        return fit.held_out_rmse * (1.0 - MIN_GAIN) > own.held_out_rmse
    return fit.rmse**2 - own.rmse**2 > (SMALL_EXCESS_FLOORS * floor) ** 2


def no_spring(explanations: Sequence[Explanation], groups: Sequence[int]) -> list[Explanation]:
    """Explanations without a load and an offset that another joint of the finger shows to be neither.

    Together they imitate a spring where a joint travels little or the spring is soft. Where they come nearest
    on another joint, too, and leave structure, its cause is none of the table, and so is this one's.

    Args:
        explanations: Of the joints.
        groups: Number of the finger of each joint.
    """
    both = {*CANCELLING}
    refused = {
        group
        for e, group in zip(explanations, groups, strict=True)
        if e.verdict == "unknown" and both <= {*e.final.effects}
    }
    reason = (
        f"{explains(CANCELLING)} here, but leave structure on another joint of the finger, where they come "
        "nearest, too: the cause is another, such as a spring"
    )
    return [
        replace(e, verdict="unknown", reason=reason)
        if group in refused and _answered(e) and both == {*e.final.effects}
        else e
        for e, group in zip(explanations, groups, strict=True)
    ]


def no_constant_friction(explanations: Sequence[Explanation], groups: Sequence[int]) -> list[Explanation]:
    """Explanations without a friction that is seen to change on another joint of the finger.

    Where it moves only early in a recording, or late, a joint shows no change of its own, and a play or a
    coupling stands for it.

    Args:
        explanations: Of the joints.
        groups: Number of the finger of each joint.
    """
    changing = {group for e, group in zip(explanations, groups, strict=True) if e.warms}
    return [
        replace(e, verdict="unknown", reason=CHANGING)
        if group in changing and _answered(e) and {*LEVELS} & {*e.final.effects}
        else e
        for e, group in zip(explanations, groups, strict=True)
    ]


def _answered(explanation: Explanation) -> bool:
    """Whether it gives names or sets; one that does not keeps the effects that come nearest."""
    return explanation.verdict in ("effects", "ambiguous")


def _as_it_is(fit: JointFit) -> JointFit:
    return fit


def _named(explanations: Sequence[Explanation]) -> set[str]:
    """What some joint names, and the only effect that is in the set of every joint that has one set."""
    answers = [e for e in explanations if _answered(e)]
    named = {a.name for e in answers for a in e.accepted if a.named}
    open_sets = [[{a.name, *a.tied} for a in e.accepted if a.tied and not a.at_bound] for e in answers]
    sets = [of_joint[0] for of_joint in open_sets if len(of_joint) == 1]
    if len(sets) > 1:
        common = set.intersection(*sets)
        named |= common if len(common) == 1 else set()
    return named


def _adopt(explanation: Explanation, named: set[str], floor: float, polish: Polish) -> Explanation:
    """One joint's explanation with what the other joints name in the place of its sets.

    A set stays where that model is worse by as much as an effect must gain.
    """
    final, accepted = explanation.final, list(explanation.accepted)
    for i, own in enumerate(accepted):
        others = [name for name in own.tied if name in named]
        if not own.tied or own.at_bound or (own.name not in named and len(others) != 1):
            continue
        if own.name not in named:
            fits = explanation.rivals.get(own.name, ())
            fit = next((fit for fit in fits if fit.effects[-1] == others[0]), None)
            if fit is None or set(fit.effects) != {*final.effects, others[0]} - {own.name}:
                continue
            fit = polish(fit)
            if fit.held_out_rmse * (1.0 - MIN_GAIN) > final.held_out_rmse:
                continue
            final = fit
            own = replace(own, name=others[0])
        accepted[i] = replace(own, tied=(), confidence=max(own.confidence, NAMED))
    if final is not explanation.final:
        spread = intervals(final, floor)
        accepted = [replace(a, estimates=estimates(final, a.name, spread)) for a in accepted]
    verdict, reason = explanation.verdict, explanation.reason
    names = [a.name for a in accepted if a.named]
    if names and len(names) > sum(a.named for a in explanation.accepted):
        verdict, reason = "effects", f"{explains(names)}, as on the other joints"
    return replace(explanation, final=final, accepted=tuple(accepted), verdict=verdict, reason=reason)
