"""Explain the joints of a recording, those of a finger in turn, and what they tell each other."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from vd.gap.evidence import CANCELLING, JITTER, MIN_GAIN, explains
from vd.gap.explain import Explained, Explainer, Joint, beside
from vd.gap.explanation import NAMED, Explanation, estimates, intervals, polished
from vd.gap.joint_fit import JointFit
from vd.gap.worker_pool import WorkerPool, parallel

OF_THE_MACHINE = {"command_delay", "read_delay", "command_jitter", "supply_sag", "gravity_load"}
"""What all joints of a machine have or have not: its bus, its supply, gravity."""

SPRUNG = f"{explains(CANCELLING)} here, but cancel at rest on another joint of the finger, as a spring does"
"""Why a load and an offset are no names."""

Polish = Callable[[JointFit], JointFit]
"""Fits a model to the end."""


def share(
    explanations: Sequence[Explanation],
    floors: Sequence[float],
    groups: Sequence[int],
    polish: Sequence[Polish],
) -> list[Explanation]:
    """Name on a joint that member of a set which another joint names, or which all such sets share.

    The joints of a finger are built alike: one cause on all of them is simpler than another on each. Joints
    that have nothing in common but the machine share its bus, its supply, and that it stands in gravity, but
    not the friction or the play of one gear. What comes nearest on a joint whose gap nothing explains is no
    answer: other joints do not make it one, nor does it settle theirs.

    Args:
        explanations: Of the joints.
        floors: Their noise floors [rad].
        groups: Number of the finger of each joint.
        polish: Of each joint: fits a member of a set to the end, which the search for the best one did not.
    """
    result = []
    for explanation, floor, finger, end in zip(explanations, floors, groups, polish, strict=True):
        if not _answered(explanation):
            result.append(explanation)
            continue
        alike = [e for e, other in zip(explanations, groups, strict=True) if other == finger]
        named = _named(alike) | (_named(explanations) & OF_THE_MACHINE)
        result.append(_adopt(explanation, named, floor, end))
    return result


def doubted(explanations: Sequence[Explanation], groups: Sequence[int]) -> list[Explanation]:
    """Explanations without what another joint of the finger shows to be a cause that is not in the table.

    That is a load and an offset that cancel at rest there: where a joint travels little they imitate the same
    spring.

    Args:
        explanations: Of the joints.
        groups: Number of the finger of each joint.
    """
    both, pairs = {*CANCELLING}, list(zip(explanations, groups, strict=True))
    sprung = {group for e, group in pairs if e.verdict == "unknown" and both <= {*e.final.effects}}

    def judged(e: Explanation, group: int) -> Explanation:
        if not _answered(e):
            return e
        if group in sprung and both == {*e.final.effects}:
            return replace(e, verdict="unknown", reason=SPRUNG)
        return e

    return [judged(e, group) for e, group in pairs]


def _answered(explanation: Explanation) -> bool:
    """Whether it gives names or sets; one that does not keeps the effects that come nearest."""
    return explanation.verdict in ("effects", "ambiguous")


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


def explain_joints(explainer: Explainer) -> list[Explanation]:
    """What every joint lacks.

    Args:
        explainer: Explains one.
    """
    pool, joints = explainer.pool, explainer.joints
    floors, fingers = ([getattr(j.spec, name) for j in joints] for name in ("floor", "chain"))
    alone = _in_turn(joints, explainer.explain)
    ends = [partial(_finished, pool, list(zip(joints, alone, strict=True)), joint) for joint in joints]
    shared = share(alone, floors, fingers, ends)
    return doubted(_consistent(pool, joints, shared), fingers)


def _finished(pool: WorkerPool, known: Explained, joint: Joint, fit: JointFit) -> JointFit:
    """A model fitted to the end from where it is, beside the joints as they are known."""
    call = {"base": beside(joint, known), "effects": fit.effects, "starts": [fit.values]}
    call |= {"scales": joint.scales}
    whole = pool.run(joint.spec, [("fit", call)])[0]
    return pool.run(joint.spec, [("refine", {"fit": whole, "scales": joint.scales})])[0]


def _in_turn(
    joints: Sequence[Joint], explain: Callable[[Joint, Explained], Explanation]
) -> list[Explanation]:
    """Explanations of all joints: of each finger from its tip on, as a joint's motion shakes those before it.

    Args:
        joints: The joints.
        explain: Explains a joint, knowing those of its finger that are explained already.
    """

    def finger(chain: int) -> Explained:
        found: Explained = []
        own = [joint for joint in joints if joint.spec.chain == chain]
        for joint in sorted(own, key=lambda each: -each.spec.joint):
            found.append((joint, explain(joint, found)))
        return found

    explained = parallel(finger, sorted({joint.spec.chain for joint in joints}))
    by_name = {joint.name: found for each in explained for joint, found in each}
    return [by_name[joint.name] for joint in joints]


def _consistent(
    pool: WorkerPool, joints: Sequence[Joint], explanations: Sequence[Explanation]
) -> list[Explanation]:
    """Final models with the other joints of their chain as these are in the end, not without effects.

    Joints that drive or load each other are else fitted to motions that the others do not make.
    """
    known = list(zip(joints, explanations, strict=True))

    def again(index: int) -> Explanation:
        joint, own = known[index]
        rows = beside(joint, known)
        changed = not np.array_equal(rows, joint.fit.rows)
        if not changed or not own.final.effects or JITTER in own.final.effects:
            return own
        rows[joint.spec.joint] = own.final.rows[joint.spec.joint]
        call = {"fit": replace(own.final, rows=rows), "scales": joint.scales}
        return polished(own, pool.run(joint.spec, [("refine", call)])[0], joint.spec.floor)

    return parallel(again, range(len(joints)))
