"""What the joints of one machine tell each other: a set on one of them that another settles."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from vd.gap.evidence import MIN_GAIN, explains
from vd.gap.explanation import NAMED, Explanation, estimates, intervals
from vd.gap.joint_fit import JointFit
from vd.gap.warming import LEVELS

OF_THE_MACHINE = {"command_delay", "read_delay", "command_jitter", "supply_sag", "gravity_load"}
"""What all joints of a machine have or have not: its bus, its supply, gravity."""

CHANGING = "its friction changes over the recording, as another joint of the finger shows"
"""Why a constant friction is no name, nor what is found beside it."""

Polish = Callable[[JointFit], JointFit]
"""Fits a model to the end."""


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
