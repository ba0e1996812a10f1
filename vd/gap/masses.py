"""Whether other masses of a finger's links are all that its plain model lacks.

The masses of a hand are those of its drawing. What links of slightly other mass leave, once stiffness and
damping have made up for most of it, is near the noise floor and smooth, so that a short filter or delay
imitates it better than any one effect of mass does: it takes a load and an inertia on every joint at once.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vd.gap.candidates import FULL_ITERATIONS
from vd.gap.chain import Chain
from vd.gap.coordinates import Coordinate
from vd.gap.descent import LeastSquares
from vd.gap.evidence import EXCESS_FLOORS, JITTER, NESTED, NO_GAP, cancelled, explains
from vd.gap.explain import REFITS, Explained, Joint, rest
from vd.gap.explanation import NAMED, Accepted, Explanation, intervals, polished
from vd.gap.fit import FINER, JointProblem
from vd.gap.joint_fit import JointFit
from vd.gap.rollout import Rollouts
from vd.gap.statistics import covariance, half_width
from vd.gap.worker_pool import WorkerPool, parallel
from vd.kernels.servo.effects import EFFECTS
from vd.paper import PAPER

RANGE = PAPER.randomisation.link_mass_scale
"""Masses that are no finding, as a share of the model's: policies are trained on all of them."""
LEAST_OFF = 0.05
"""Share by which a mass is other than the model's at least: what less does is not what a finger lacks."""
ITERATIONS = 8
FINER_ITERATIONS = 8
"""Steps of the same with a finer time step, from where that one ends."""
RIDGE = 0.01
"""Pull of the logarithms towards the start, as information in units of the noise floor."""


@dataclass(frozen=True, eq=False)
class Masses:
    """A finger's plain model with links of other mass.

    Attributes:
        factors: Masses as shares of the model's, one a joint [n].
        errors: RMSE of each joint's motions [J] [rad].
        x: Coordinates: logarithms of the factors [n], and those of the joints' fits one after the other.
    """

    factors: np.ndarray
    errors: np.ndarray
    x: np.ndarray

    @property
    def other(self) -> bool:
        """Whether a mass is another than the model's."""
        return bool(np.abs(self.factors - 1.0).max() > LEAST_OFF)

    @property
    def text(self) -> str:
        """By how much they are off, in words."""
        percent = ", ".join(f"{100.0 * (factor - 1.0):+.0f}" for factor in self.factors)
        return f"with the masses of its links {percent} % off"


def fit_masses(problems: Sequence[JointProblem], fits: Sequence[JointFit]) -> Masses:
    """Fit the links' masses of one chain, within :data:`RANGE`, and the plain models of all its joints again.

    Args:
        problems: Of the chain's joints that were excited.
        fits: Their plain models, in the same order.
    """
    model = _squares(problems, fits)
    links = len(problems[0].rollouts.chain.joints)
    start = np.concatenate([np.zeros(links), *(fit.x for fit in fits)])
    found = model.descend(start[None], ITERATIONS)
    parts = [part * p.floor for part, p in zip(_split(problems, found.residual[0]), problems, strict=True)]
    return Masses(
        factors=np.exp(found.x[0, :links]),
        errors=np.array([np.sqrt(np.mean(part**2)) for part in parts]),
        x=found.x[0],
    )


def with_free_masses(
    problems: Sequence[JointProblem], fits: Sequence[JointFit], masses: Masses
) -> list[dict[str, tuple[float, float]]]:
    """95 % intervals of what was fitted on each joint, by key, where nothing is known of the links' masses.

    From a fit with a finer time step: what drives and links of one scale do differs by the drives' own
    inertia alone, by tens of microseconds of lag, so that the step of the search moves all masses with
    stiffness and damping by a percent.

    Args:
        problems: Of the chain's joints.
        fits: Their models.
        masses: What :func:`fit_masses` has found with these.
    """
    fine = [problem.finer() for problem in problems]
    model = _squares(fine, fits)
    found = model.descend(masses.x[None], FINER_ITERATIONS)
    slopes = model.jacobian(found.x, found.residual)[0]
    units = [
        (part @ part.T, part @ left)
        for problem, jacobian, residual in zip(
            problems, _split(problems, slopes), _split(problems, found.residual[0]), strict=True
        )
        for part, left in zip(problem.split(jacobian), problem.split(residual), strict=True)
    ]
    gram, gradient = (np.stack(each) for each in zip(*units, strict=True))
    spread = covariance(gram, gradient, np.full(len(masses.x), RIDGE), 1.0)
    left_open = np.abs(found.x[0] - masses.x) / (FINER[-1] - 1)
    width = np.hypot(half_width(np.diag(spread), len(gram)), left_open)
    ends = np.cumsum([len(masses.factors), *(len(fit.x) for fit in fits)])[:-1]
    lows, highs = (np.split(found.x[0] + side * width, ends)[1:] for side in (-1.0, 1.0))
    return [
        {
            c.key: (float(c.value(max(low, c.lower))), float(c.value(min(high, c.upper))))
            for c, low, high in zip(fit.coordinates, *bounds, strict=True)
        }
        for fit, *bounds in zip(fits, lows, highs, strict=True)
    ]


def widened(fit: JointFit, floor: float, extents: Mapping[str, tuple[float, float]]) -> JointFit:
    """A fit whose intervals reach as far as others by key do.

    Args:
        fit: The fit.
        floor: Its joint's noise floor [rad].
        extents: The others.
    """
    own = intervals(fit, floor)
    both = {key: (own[key], other) for key, other in extents.items() if key in own}
    return replace(fit, extents={key: (min(a[0], b[0]), max(a[1], b[1])) for key, (a, b) in both.items()})


def _squares(problems: Sequence[JointProblem], fits: Sequence[JointFit]) -> LeastSquares:
    """The squared errors of all joints, in squared noise floors, of masses and their models together."""
    chain, rows = problems[0].rollouts.chain, fits[0].rows.copy()
    for problem, fit in zip(problems, fits, strict=True):
        rows[problem.joint] = fit.rows[problem.joint]
    links = [Coordinate(f"mass_{i}", -1, True, 1.0, *np.log(RANGE)) for i in range(len(chain.joints))]
    own = [(p.joint, c) for p, fit in zip(problems, fits, strict=True) for c in fit.coordinates]
    widths = np.concatenate([np.full(int(p.count.sum()), p.floor) for p in problems])

    def residuals(x: np.ndarray, given: Sequence[Rollouts]) -> np.ndarray:
        """Of all joints, in noise floors [C, N]; sets with the same masses are simulated together."""
        result = np.empty((len(x), len(widths)))
        masses, which = np.unique(x[:, : len(links)], axis=0, return_inverse=True)
        for index, factors in enumerate(np.exp(masses)):
            chosen = np.flatnonzero(which.ravel() == index)
            sets = np.repeat(rows[None], len(chosen), axis=0)
            for column, (joint, c) in enumerate(own, start=len(links)):
                sets[:, joint, c.column] = c.value(x[chosen, column])
            heavier = _with_masses(given, chain, factors)
            parts = [p.residuals(sets, rollouts=r) for p, r in zip(problems, heavier, strict=True)]
            result[chosen] = np.concatenate(parts, axis=1) / widths
        return result

    coarse = [problem.coarse for problem in problems if problem.coarse is not None]
    return LeastSquares(
        [*links, *(c for _, c in own)],
        lambda x, _: residuals(x, [problem.rollouts for problem in problems]),
        RIDGE,
        (lambda x, _: residuals(x, coarse)) if coarse else None,
    )


def _split(problems: Sequence[JointProblem], samples: np.ndarray) -> list[np.ndarray]:
    """Cut the last axis into joints."""
    return np.split(samples, np.cumsum([int(p.count.sum()) for p in problems])[:-1], axis=-1)


def _with_masses(given: Sequence[Rollouts], chain: Chain, factors: np.ndarray) -> list[Rollouts]:
    """Rollouts with the links' masses and inertias times factors [n]."""
    other = replace(chain, mass=chain.mass * factors, inertia=chain.inertia * factors[:, None, None])
    made: dict[int, Rollouts] = {}
    for known in given:
        if id(known) not in made:
            made[id(known)] = known.with_chain(other)
    return [made[id(known)] for known in given]


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
