"""Explain the joints of a recording, those of a finger in turn, each knowing what the others have."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from vd.gap.candidates import FULL_ITERATIONS
from vd.gap.consensus import no_constant_friction, share
from vd.gap.evidence import JITTER
from vd.gap.explanation import Explanation, polished
from vd.gap.finger_masses import masses_alone, masses_beside
from vd.gap.joint_fit import JointFit
from vd.gap.masses import widened
from vd.gap.one_joint import REFITS, Explained, Explainer, Joint, beside, weighting_of
from vd.gap.worker_pool import WorkerPool, parallel


def explain_joints(explainer: Explainer) -> list[Explanation]:
    """What every joint lacks.

    Args:
        explainer: Explains one.
    """
    pool, joints = explainer.pool, explainer.joints
    masses = masses_alone(pool, joints)

    def one(joint: Joint, explained: Explained) -> Explanation:
        if joint.spec.chain not in masses:
            return explainer.explain(joint, explained)
        text = f"the plain model is within the noise floor {masses[joint.spec.chain].text}"
        explainer.progress(f"explain: {joint.name}: no_gap: {text}")
        return Explanation(joint.fit, joint.fit, "no_gap", text)

    floors, fingers = ([getattr(j.spec, name) for j in joints] for name in ("floor", "chain"))
    alone = _in_turn(joints, one)
    ends = [partial(_finished, pool, list(zip(joints, alone, strict=True)), joint) for joint in joints]
    shared = share(alone, floors, fingers, ends)
    return no_constant_friction(_consistent(pool, joints, masses_beside(pool, joints, shared)), fingers)


def _finished(pool: WorkerPool, known: Explained, joint: Joint, fit: JointFit) -> JointFit:
    """A model fitted to the end from where it is, beside the joints as they are known."""
    call = {"base": beside(joint, known), "effects": fit.effects, "starts": [fit.values]}
    call |= {"scales": joint.scales, "iterations": FULL_ITERATIONS, "refits": REFITS}
    weighting = weighting_of(next(found for other, found in known if other is joint))
    whole = pool.run(joint.spec, [("fit", {**call, **weighting})])[0]
    return pool.run(joint.spec, [("refine", {"fit": whole, "scales": joint.scales, **weighting})])[0]


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
        call = {"fit": replace(own.final, rows=rows), "scales": joint.scales, **weighting_of(own)}
        fit = pool.run(joint.spec, [("refine", call)])[0]
        if own.final.extents:
            fit = widened(fit, joint.spec.floor, own.final.extents)
        return polished(own, fit, joint.spec.floor)

    return parallel(again, range(len(joints)))
