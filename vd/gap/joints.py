"""Explain the joints of a recording, those of a finger in turn, each knowing what the others have."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np

from vd.gap.candidates import FULL_ITERATIONS, alike, stood_for
from vd.gap.chain import candidates, others_in
from vd.gap.chance import FIXED, as_random
from vd.gap.clock import explain_weighted, swayed
from vd.gap.consensus import agree, no_constant_friction, no_spring, share
from vd.gap.coordinates import BASELINE_PARAMETERS, Scales
from vd.gap.explanation import NAMED, Accepted, Explanation, added, lacking, polished
from vd.gap.joint_fit import JointFit
from vd.gap.judge import EXCESS_FLOORS, EXPLAINED, NESTED, NO_GAP, RANDOM
from vd.gap.masses import Masses, fit_masses, widened, with_free_masses
from vd.gap.recording import Recording
from vd.gap.select import LOOKS, RESTARTS, Selection
from vd.gap.sketch import outline, sketched
from vd.gap.statistics import resamples
from vd.gap.team import JointSpec, Team
from vd.gap.telemetry import vetoes
from vd.gap.verdict import Verdicts, cancelled, explains
from vd.gap.warming import middles
from vd.kernels.effects import EFFECTS

POLISH_ITERATIONS = 5
"""Steps of a fit that has to follow small changes of the other joints."""
REFITS = 3
"""Steps of Levenberg-Marquardt of each refit without a fold."""

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint under analysis: its data and its baseline."""

    name: str
    spec: JointSpec
    scales: Scales
    fit: JointFit


Explained = list[tuple[Joint, Explanation]]
"""Joints, and what they lack."""


def explain_joints(
    team: Team,
    joints: Sequence[Joint],
    recording: Recording,
    *,
    effects: Sequence[str],
    seed: int,
    progress: Progress,
) -> list[Explanation]:
    """What every joint lacks.

    Args:
        team: Who fits.
        joints: The joints with their plain models.
        recording: The recording.
        effects: Effects to consider.
        seed: Of everything random.
        progress: Called with lines of progress.
    """
    masses = _masses(team, joints)
    when = middles(recording)
    rough: dict[int, dict[Joint, JointFit]] = {}  # by chain

    def plain(joint: Joint, explained: Explained) -> JointFit:
        """The plain model, fitted again beside joints of which more is known than theirs."""
        rows = _beside(joint, explained)
        known = {joint, *(other for other, _ in explained)}
        for other, model in rough.get(joint.spec.chain, {}).items():
            if other not in known:
                rows[other.spec.joint] = model.rows[other.spec.joint]
        if np.array_equal(rows, joint.fit.rows):
            return joint.fit
        call = {"base": rows, "effects": (), "starts": [{}], "scales": joint.scales}
        call |= {"iterations": POLISH_ITERATIONS, "refits": REFITS}
        return team.run(joint.spec, [("fit", call)])[0]

    def sketch(joint: Joint, found: JointFit) -> None:
        """Rough models of the other joints of a finger, beside a rough one of its first."""

        def fit(other: Joint, effects: tuple[str, ...], values: Mapping[str, float]) -> JointFit:
            rows = other.fit.rows.copy()
            rows[joint.spec.joint] = found.rows[joint.spec.joint]
            call = {"base": rows, "effects": effects, "starts": [values], "scales": other.scales}
            return team.run(other.spec, [("fit", {**call, "iterations": FULL_ITERATIONS})])[0]

        others = {j.name: j for j in joints if j.spec.chain == joint.spec.chain and j is not joint}
        fits = {name: partial(fit, other) for name, other in others.items()}
        models = sketched(found, {name: other.fit for name, other in others.items()}, fits)
        rough[joint.spec.chain] = {others[name]: model for name, model in models.items()}
        if models:
            progress(f"explain: {' and '.join(models)}: roughly with {' and '.join(found.effects)} as well")

    def one(joint: Joint, explained: Explained, own: Explanation | None = None) -> Explanation:
        chain = team.bench.chains[joint.spec.chain]
        if joint.spec.chain in masses:
            text = f"the plain model is within the noise floor {masses[joint.spec.chain].text}"
            progress(f"explain: {joint.name}: no_gap: {text}")
            return Explanation(joint.fit, joint.fit, "no_gap", text)
        # What is none of the table on one joint is none on the others, and what is chance on one is chance on
        # all: what is plain to see is enough there.
        unknown = any(found.verdict == "unknown" for _, found in explained)
        chance = (added(found.final) for _, found in explained if RANDOM in found.final.effects)
        random = next(chance, ((), {}))
        hidden = unknown or bool(random[0])
        rng = np.random.default_rng([seed, joint.spec.chain, joint.spec.joint])
        # Chance is none here where it was tried there and refused, not where too little was left to try it.
        refused = any(row.name == RANDOM for _, found in explained for row in found.trials)
        refused = refused and not random[0]
        # Nor where another is explained without: commands go out together.
        refused = (unknown and refused) or any(steady(other, found) for other, found in explained)
        names = [n for n in candidates(chain, effects) if n != RANDOM or not refused]
        told = vetoes(recording, chain, joint.spec, joint.fit.rows)
        pairs = alike(effects, recording.model).items()
        same = {name: others for name, others in pairs if not {name, *others} & set(told)}
        selection = Selection(
            run=lambda calls: team.run(joint.spec, calls),
            joint=joint.spec.joint,
            others=others_in(chain, joint.spec.joint),
            candidates=names,
            equivalent=same,
            seed=seed,
            nominal={
                key: float(chain.start_row[joint.spec.joint, BASELINE_PARAMETERS[key].column])
                for key in joint.spec.baseline
            },
            floor=joint.spec.floor,
            scales=joint.scales,
            weights=resamples(len(joint.spec.trajectories), rng),
            refits=REFITS,
            restarts=0 if hidden else RESTARTS,
            looks=0 if hidden else LOOKS,
            vetoes={**stood_for(same), **told},
            report=lambda line: progress(f"explain: {joint.name}: {line}"),
            rest=_rest(recording, int(chain.columns[joint.spec.joint]), joint.spec.trajectories),
            moves=_moves(recording, int(chain.columns[joint.spec.joint]), joint.spec.trajectories),
            when=when[list(joint.spec.trajectories)],
            like=next((like for _, found in explained if (like := lacking(found))[0]), ((), {})),
            changing=next((added(found.final) for _, found in explained if found.warms), ((), {})),
            random=random,
        )
        baseline = plain(joint, explained)
        if own is not None:
            return as_random(selection, baseline, selection.undetermined(baseline)) or own
        found = None if explained else outline(selection, baseline)
        if found is not None:
            sketch(joint, found)
            baseline = plain(joint, explained)
            (found,) = selection.run(
                [selection.call(baseline, found.effects, [found.values], FULL_ITERATIONS)]
            )
        veil = None if found is None else swayed(selection, found)
        result = explain_weighted(selection, baseline, veil) if veil else selection.explain(baseline)
        progress(f"explain: {joint.name}: {result.verdict}: {result.reason}")
        return result

    floors, fingers = ([getattr(j.spec, name) for j in joints] for name in ("floor", "chain"))
    alone = _in_turn(joints, one)
    known = list(zip(joints, alone, strict=True))

    def fitted(joint: Joint, effects: tuple[str, ...], starts: Sequence[Mapping[str, float]]) -> JointFit:
        rows = _beside(joint, known)
        call = {"base": rows, "effects": effects, "starts": list(starts), "scales": joint.scales}
        call |= {"iterations": FULL_ITERATIONS, "refits": REFITS}
        seen = _seen(next(found for other, found in known if other is joint))
        whole = team.run(joint.spec, [("fit", {**call, **seen})])[0]
        return team.run(joint.spec, [("refine", {"fit": whole, "scales": joint.scales, **seen})])[0]

    def finished(joint: Joint, fit: JointFit) -> JointFit:
        return fitted(joint, fit.effects, [fit.values])

    ends = [partial(finished, joint) for joint in joints]
    shared = share(alone, floors, fingers, ends)
    agreed = agree(shared, floors, fingers, [partial(fitted, joint) for joint in joints])
    found = _consistent(team, joints, _beside_masses(team, joints, agreed))
    return no_constant_friction(no_spring(found, fingers), fingers)


def steady(joint: Joint, explanation: Explanation) -> bool:
    """Whether a joint is explained down to noise with neither random delays nor a fixed one, their mean."""
    final = explanation.final
    return (
        explanation.verdict == "effects"
        and not {RANDOM, FIXED} & {*final.effects}
        and final.rmse < EXPLAINED * joint.spec.floor
    )


class _Explain(Protocol):
    """Explains a joint, knowing those of its finger that are explained already."""

    def __call__(
        self, joint: Joint, explained: Explained, own: Explanation | None = None, /
    ) -> Explanation: ...


def _in_turn(joints: Sequence[Joint], explain: _Explain) -> list[Explanation]:
    """Explanations of all joints: of each finger from its tip on, as a joint's motion shakes those before it.

    Args:
        joints: The joints.
        explain: Explains a joint, knowing those of its finger that are explained already; one that was
            explained before random delays were found on another once more.
    """

    def finger(chain: int) -> Explained:
        found: Explained = []
        own = [joint for joint in joints if joint.spec.chain == chain]
        for joint in sorted(own, key=lambda each: -each.spec.joint):
            found.append((joint, explain(joint, found)))
        chance = [RANDOM in explanation.final.effects for _, explanation in found]
        for i, (joint, before) in enumerate(found[: chance.index(True) if any(chance) else 0]):
            # What a late command is the mean of, or what nothing explained.
            if FIXED in before.final.effects or before.verdict in ("unknown", "ambiguous"):
                found[i] = joint, explain(joint, [*found[:i], *found[i + 1 :]], before)
        return found

    explained = parallel(finger, sorted({joint.spec.chain for joint in joints}))
    by_name = {joint.name: found for each in explained for joint, found in each}
    return [by_name[joint.name] for joint in joints]


def _beside(joint: Joint, explained: Explained) -> np.ndarray:
    """Rows of a joint's chain with its plain model, the others as they were found to be, chance aside."""
    rows = joint.fit.rows.copy()
    for other, found in explained:
        if other is not joint and other.spec.chain == joint.spec.chain and found.final.effects:
            rows[other.spec.joint] = found.final.rows[other.spec.joint]
            for parameter in EFFECTS[RANDOM].parameters:
                rows[other.spec.joint, parameter.column] = parameter.neutral
    return rows


def _seen(found: Explanation) -> dict[str, Any]:
    """What the samples of an explained joint are to be seen through, as an argument of a call."""
    return {} if found.veil is None else {"veil": found.veil}


def _masses(team: Team, joints: Sequence[Joint]) -> dict[int, Masses]:
    """By chain, the masses of links that explain a gap on all joints that have one."""
    result = {}
    for index, chain in enumerate(team.bench.chains):
        own = [joint for joint in joints if joint.spec.chain == index]
        floors = np.array([NO_GAP * joint.spec.floor for joint in own])
        if not chain.bodies or all(j.fit.held_out_rmse < floor for j, floor in zip(own, floors, strict=True)):
            continue
        masses = fit_masses([team.bench.problem(joint.spec) for joint in own], [joint.fit for joint in own])
        if (masses.errors < floors).all():
            result[index] = masses
    return result


def _beside_masses(
    team: Team, joints: Sequence[Joint], explanations: Sequence[Explanation]
) -> list[Explanation]:
    """Only what all joints of a finger lack, where other masses of its links are the rest.

    What slightly heavier links leave beside an effect is imitated by a second effect, another on each joint,
    or has something else imitate the effect better.
    """
    result = list(explanations)
    for index, chain in enumerate(team.bench.chains):
        own = [i for i, joint in enumerate(joints) if joint.spec.chain == index]
        known = [(joints[i], explanations[i]) for i in own]
        models = {frozenset(found.final.effects) for _, found in known if found.verdict != "no_gap"}
        certain = all(found.verdict in ("effects", "no_gap") for _, found in known)
        warms = any(found.warms for _, found in known)
        if not chain.bodies or not models or warms or (certain and len(models) == 1):
            continue
        told = [found for core in _cores(known) if (found := _all_with(team, known, core))]
        fewest = min((found.effects for found in told), default=0)
        best = sorted((found for found in told if found.effects == fewest), key=lambda found: found.left)
        if best and (len(best) == 1 or best[1].left - best[0].left > EXCESS_FLOORS**2):
            problems = [team.bench.problem(joint.spec) for joint, _ in known]
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
    return [core for core in cores if core and RANDOM not in core]


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


def _all_with(team: Team, known: Explained, core: tuple[str, ...]) -> _Finger | None:
    """The joints of a finger with these effects alone, if links of other mass then leave noise on all."""
    start: dict[str, float] = {}
    accepted: list[Accepted] = []
    for name in core:
        one, values = next((one for _, found in known for one in _can_have(found, name)), (None, {}))
        if one is None:
            return None
        start |= {key: value for key, value in values.items() if key.startswith(f"{name}.")}
        accepted.append(replace(one, tied=(), confidence=max(one.confidence, NAMED)))
    rows = known[0][0].fit.rows.copy()
    for joint, found in known:
        row = (found.final if {*core} <= {*found.final.effects} else joint.fit).rows[joint.spec.joint].copy()
        for name in {*found.final.effects} - {*core}:
            for parameter in EFFECTS[name].parameters:
                row[parameter.column] = parameter.neutral
        rows[joint.spec.joint] = row

    def fitted(one: tuple[Joint, Explanation]) -> JointFit:
        joint, found = one
        if found.verdict == "no_gap":
            return joint.fit
        starts = [{}] if {*core} <= {*found.final.effects} else [start]
        call = {"base": rows, "effects": core, "starts": starts, "scales": joint.scales}
        call |= {"iterations": FULL_ITERATIONS, "refits": REFITS}
        return team.run(joint.spec, [("fit", call)])[0]

    fits = parallel(fitted, known)
    problems = [team.bench.problem(joint.spec) for joint, _ in known]
    masses = fit_masses(problems, fits)
    floors = np.array([joint.spec.floor for joint, _ in known])
    if not masses.other or (masses.errors >= NO_GAP * floors).any():
        return None
    reason, explanations = f"{explains(core)}, {masses.text}", []
    for (joint, found), fit, structure in zip(known, fits, masses.structure, strict=True):
        weights = resamples(len(fit.sse), np.random.default_rng(joint.spec.joint))
        judge = Verdicts(floor=joint.spec.floor, weights=weights, whole=joint.fit.held_out_rmse)
        if judge.lack_of_fit(replace(fit, structure=structure)):
            return None  # other masses are not the rest either
        column = int(team.bench.chains[joint.spec.chain].columns[joint.spec.joint])
        rest = _rest(team.bench.recording, column, joint.spec.trajectories)
        if cancelled(fit, joint.spec.joint, rest):
            return None  # a spring, and no load and offset
        if found.verdict != "no_gap":
            plain = replace(found, accepted=tuple(accepted), verdict="effects", reason=reason)
            found = polished(plain, fit, joint.spec.floor)
        explanations.append(found)
    left = float(np.sum((masses.errors / floors) ** 2))
    return _Finger(len(core), left, explanations, list(fits), masses)


def _can_have(found: Explanation, name: str) -> Iterator[tuple[Accepted, dict[str, float]]]:
    """An effect as a joint has it, or could have it in the place of another that it is not told from."""
    for one in found.accepted:
        if one.at_bound or one.doubt:
            continue
        if one.name == name:
            yield one, found.final.values
        for fit in found.rivals.get(one.name, ()):
            if fit.effects[-1] == name and name in one.tied and not fit.at_bound:
                yield replace(one, name=name, alternatives=(), equivalent=()), fit.values


def _rest(recording: Recording, column: int, trajectories: Sequence[int]) -> float:
    """Where a joint begins most of its motions [rad]."""
    return float(np.median([recording.trajectories[i].position[0, column] for i in trajectories]))


def _moves(recording: Recording, column: int, trajectories: Sequence[int]) -> np.ndarray:
    """Whether a joint's command changes in each trajectory [S]."""
    return np.array([bool(np.ptp(recording.trajectories[i].command[:, column])) for i in trajectories])


def _consistent(
    team: Team, joints: Sequence[Joint], explanations: Sequence[Explanation]
) -> list[Explanation]:
    """Final models with the other joints of their chain as these are in the end, not without effects.

    Joints that drive or load each other are else fitted to motions that the others do not make.
    """
    known = list(zip(joints, explanations, strict=True))

    def again(index: int) -> Explanation:
        joint, own = known[index]
        rows = _beside(joint, known)
        changed = not np.array_equal(rows, joint.fit.rows)
        if not changed or not own.final.effects or RANDOM in own.final.effects:
            return own
        rows[joint.spec.joint] = own.final.rows[joint.spec.joint]
        call = {"fit": replace(own.final, rows=rows), "scales": joint.scales, **_seen(own)}
        fit = team.run(joint.spec, [("refine", call)])[0]
        if own.final.extents:
            fit = widened(fit, joint.spec.floor, own.final.extents)
        return polished(own, fit, joint.spec.floor)

    return parallel(again, range(len(joints)))


def parallel(work: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
    """Results in order; threads, since the work waits for processes."""
    pool = ThreadPoolExecutor(max(len(items), 1))
    try:
        return list(pool.map(work, items))
    finally:
        # Nobody waits for the others after a failure or Ctrl-C: they end with the team's processes.
        pool.shutdown(wait=False, cancel_futures=True)
