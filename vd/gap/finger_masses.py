"""Effects of a finger's joints beside links of other mass than the drawing's."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vd.gap.candidates import FULL_ITERATIONS
from vd.gap.evidence import EXCESS_FLOORS, JITTER, NESTED, NO_GAP, cancelled, explains
from vd.gap.explanation import NAMED, Accepted, Explanation, polished
from vd.gap.joint_fit import JointFit
from vd.gap.masses import Masses, fit_masses, widened, with_free_masses
from vd.gap.one_joint import REFITS, Explained, Joint, rest
from vd.gap.worker_pool import WorkerPool, parallel
from vd.kernels.servo.effects import EFFECTS


def masses_alone(pool: WorkerPool, joints: Sequence[Joint]) -> dict[int, Masses]:
    """By chain, the masses of links that explain a gap on all joints that have one."""
    result = {}
    for index, chain in enumerate(pool.problems.chains):
        own = [joint for joint in joints if joint.spec.chain == index]
        floors = np.array([NO_GAP * joint.spec.floor for joint in own])
        if not chain.bodies or all(j.fit.held_out_rmse < floor for j, floor in zip(own, floors, strict=True)):
            continue
        masses = fit_masses([pool.problems.of(joint.spec) for joint in own], [joint.fit for joint in own])
        if (masses.errors < floors).all():
            result[index] = masses
    return result


def masses_beside(
    pool: WorkerPool, joints: Sequence[Joint], explanations: Sequence[Explanation]
) -> list[Explanation]:
    """Only what all joints of a finger lack, where other masses of its links are the rest.

    What slightly heavier links leave beside an effect is imitated by a second effect, another on each joint,
    or has something else imitate the effect better.
    """
    result = list(explanations)
    for index, chain in enumerate(pool.problems.chains):
        own = [i for i, joint in enumerate(joints) if joint.spec.chain == index]
        known = [(joints[i], explanations[i]) for i in own]
        models = {frozenset(found.final.effects) for _, found in known if found.verdict != "no_gap"}
        certain = all(found.verdict in ("effects", "no_gap") for _, found in known)
        warms = any(found.warms for _, found in known)
        if not chain.bodies or not models or warms or (certain and len(models) == 1):
            continue
        told = [found for core in _cores(known) if (found := _all_with(pool, known, core))]
        fewest = min((found.effects for found in told), default=0)
        best = sorted((found for found in told if found.effects == fewest), key=lambda found: found.left)
        if best and (len(best) == 1 or best[1].left - best[0].left > EXCESS_FLOORS**2):
            problems = [pool.problems.of(joint.spec) for joint, _ in known]
            free = with_free_masses(problems, best[0].fits, best[0].masses)
            for i, explanation, extents in zip(own, best[0].explanations, free, strict=True):
                floor = joints[i].spec.floor
                fit = widened(explanation.final, floor, extents)
                result[i] = polished(explanation, fit, floor) if explanation.accepted else explanation
    return result


def _cores(known: Explained) -> list[tuple[str, ...]]:
    """What all joints with a gap may lack: what all were found to, or one effect that most can have."""
    gaps = [found for _, found in known if found.verdict != "no_gap"]
    common = tuple(name for name in gaps[0].final.effects if all(name in e.final.effects for e in gaps))
    can = []
    for found in gaps:
        names = {*found.final.effects, *(name for one in found.accepted for name in one.tied)}
        can.append({*names, *(inside for name in names for inside in NESTED.get(name, ()))})
    most = [n for n in sorted(set().union(*can)) if sum(n in names for names in can) > len(gaps) // 2]
    cores = dict.fromkeys([common, *((name,) for name in most)])
    return [core for core in cores if core and JITTER not in core]


@dataclass(frozen=True)
class _Finger:
    """A finger's joints with the same effects and links of other mass.

    Attributes:
        effects: How many effects.
        left: Sum of the joints' squared errors, in squared noise floors.
        explanations: Of the joints.
        fits: Of the joints, with the masses of the model.
        masses: What they are found to be.
    """

    effects: int
    left: float
    explanations: list[Explanation]
    fits: list[JointFit]
    masses: Masses


def _all_with(pool: WorkerPool, known: Explained, core: tuple[str, ...]) -> _Finger | None:
    """The joints of a finger with these effects alone, if links of other mass then leave noise on all."""
    begun = _begin_with(known, core)
    if begun is None:
        return None
    start, accepted = begun
    rows = known[0][0].fit.rows.copy()
    for joint, found in known:
        rows[joint.spec.joint] = _row_with(joint, found, core)

    def fitted(one: tuple[Joint, Explanation]) -> JointFit:
        joint, found = one
        if found.verdict == "no_gap":
            return joint.fit
        starts = [{}] if {*core} <= {*found.final.effects} else [start]
        call = {"base": rows, "effects": core, "starts": starts, "scales": joint.scales}
        call |= {"iterations": FULL_ITERATIONS, "refits": REFITS}
        return pool.run(joint.spec, [("fit", call)])[0]

    fits = parallel(fitted, known)
    problems = [pool.problems.of(joint.spec) for joint, _ in known]
    masses = fit_masses(problems, fits)
    floors = np.array([joint.spec.floor for joint, _ in known])
    if not masses.other or (masses.errors >= NO_GAP * floors).any():
        return None
    reason, explanations = f"{explains(core)}, {masses.text}", []
    for (joint, found), fit in zip(known, fits, strict=True):
        column = int(pool.problems.chains[joint.spec.chain].columns[joint.spec.joint])
        resting = rest(pool.problems.recording, column, joint.spec.trajectories)
        if cancelled(fit, joint.spec.joint, resting):
            return None  # a spring, and no load and offset
        if found.verdict != "no_gap":
            plain = replace(found, accepted=accepted, verdict="effects", reason=reason)
            found = polished(plain, fit, joint.spec.floor)
        explanations.append(found)
    left = float(np.sum((masses.errors / floors) ** 2))
    return _Finger(len(core), left, explanations, list(fits), masses)


def _begin_with(
    known: Explained, core: tuple[str, ...]
) -> tuple[dict[str, float], tuple[Accepted, ...]] | None:
    """Where fits with these effects begin, and the effects as joints have them; None if one has not."""
    start: dict[str, float] = {}
    accepted: list[Accepted] = []
    for name in core:
        one, values = next((one for _, found in known for one in _can_have(found, name)), (None, {}))
        if one is None:
            return None
        start |= {key: value for key, value in values.items() if key.startswith(f"{name}.")}
        accepted.append(replace(one, tied=(), confidence=max(one.confidence, NAMED)))
    return start, tuple(accepted)


def _row_with(joint: Joint, found: Explanation, core: tuple[str, ...]) -> np.ndarray:
    """The parameter row of a joint without what it was found to have besides these effects."""
    row = (found.final if {*core} <= {*found.final.effects} else joint.fit).rows[joint.spec.joint].copy()
    for name in {*found.final.effects} - {*core}:
        for parameter in EFFECTS[name].parameters:
            row[parameter.column] = parameter.neutral
    return row


def _can_have(found: Explanation, name: str) -> Iterator[tuple[Accepted, dict[str, float]]]:
    """An effect as a joint has it, or could have it in the place of another that it is not told from."""
    for one in found.accepted:
        if one.at_bound or not one.shown:
            continue
        if one.name == name:
            yield one, found.final.values
        for fit in found.rivals.get(one.name, ()):
            if fit.effects[-1] == name and name in one.tied and not fit.at_bound:
                yield replace(one, name=name, alternatives=(), equivalent=()), fit.values
