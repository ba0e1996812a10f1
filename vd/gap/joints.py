"""Explain the joints of a recording, those of a finger in turn, and what they tell each other."""

from collections.abc import Sequence
from dataclasses import replace

from vd.gap.evidence import CANCELLING, explains
from vd.gap.explain import Explained, Explainer
from vd.gap.explanation import Explanation
from vd.gap.worker_pool import parallel

SPRUNG = f"{explains(CANCELLING)} here, but cancel at rest on another joint of the finger, as a spring does"
"""Why a load and an offset are no names."""


def doubted(explanations: Sequence[Explanation], groups: Sequence[int]) -> list[Explanation]:
    """Explanations without what another joint of the finger shows to be a cause that is not in the table.

    That is a load and an offset that cancel at rest there: where a joint travels little they
    imitate the same spring.

    Args:
        explanations: Of the joints.
        groups: Number of the finger of each joint.
    """
    both, pairs = {*CANCELLING}, list(zip(explanations, groups, strict=True))
    sprung = {group for e, group in pairs if e.verdict == "unknown" and both <= {*e.final.effects}}

    def judged(e: Explanation, group: int) -> Explanation:
        if e.verdict not in ("effects", "ambiguous"):
            return e
        if group in sprung and both == {*e.final.effects}:
            return replace(e, verdict="unknown", reason=SPRUNG)
        return e

    return [judged(e, group) for e, group in pairs]


def explain_joints(explainer: Explainer) -> list[Explanation]:
    """What every joint lacks.

    Of each finger from its tip on, as a joint's motion shakes those before it.

    Args:
        explainer: Explains one, knowing those of its finger that are explained already.
    """
    joints = explainer.joints

    def finger(chain: int) -> Explained:
        found: Explained = []
        own = [joint for joint in joints if joint.spec.chain == chain]
        for joint in sorted(own, key=lambda each: -each.spec.joint):
            found.append((joint, explainer.explain(joint, found)))
        return found

    explained = parallel(finger, sorted({joint.spec.chain for joint in joints}))
    by_name = {joint.name: found for each in explained for joint, found in each}
    alone = [by_name[joint.name] for joint in joints]
    return doubted(alone, [joint.spec.chain for joint in joints])
