"""Whether other masses of a finger's links are all that its plain model lacks.

The masses of a hand are those of its drawing. What links of slightly other mass leave, once stiffness and
damping have made up for most of it, is near the noise floor and smooth, so that a short filter or delay
imitates it better than any one effect of mass does: it takes a load and an inertia on every joint at once.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vd.gap.chain import Chain
from vd.gap.coordinates import Coordinate
from vd.gap.descent import LeastSquares
from vd.gap.explanation import intervals
from vd.gap.fit import FINER, JointProblem
from vd.gap.joint_fit import JointFit
from vd.gap.rollout import Rollouts
from vd.gap.statistics import covariance, half_width
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
