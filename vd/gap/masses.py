"""Whether other masses of a finger's links are all that its plain model lacks.

The masses of a hand are those of its drawing. What links of slightly other mass leave, once stiffness and
damping have made up for most of it, is near the noise floor and smooth, so that a short filter or delay
imitates it better than any one effect of mass does: it takes a load and an inertia on every joint at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vd.gap.chain import Chain
from vd.gap.coordinates import Coordinate
from vd.gap.descent import LeastSquares
from vd.gap.fit import JointProblem
from vd.gap.joint_fit import JointFit
from vd.gap.rollout import Rollouts
from vd.paper import PAPER

RANGE = PAPER.randomisation.link_mass_scale
"""Masses that are no finding, as a share of the model's: policies are trained on all of them."""
LEAST_OFF = 0.05
"""Share by which a mass is other than the model's at least: what less does is not what a finger lacks."""
ITERATIONS = 8
RIDGE = 0.01
"""Pull of the logarithms towards the start, as information in units of the noise floor."""


@dataclass(frozen=True, eq=False)
class Masses:
    """A finger's plain model with links of other mass.

    Attributes:
        factors: Masses as shares of the model's, one a joint [n].
        errors: RMSE of each joint's motions [J] [rad].
        structure: Of what is left of each joint's motions, as in :class:`~vd.gap.joint_fit.JointFit`.
    """

    factors: np.ndarray
    errors: np.ndarray
    structure: tuple[np.ndarray, ...]

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
    chain, rows = problems[0].rollouts.chain, fits[0].rows.copy()
    for problem, fit in zip(problems, fits, strict=True):
        rows[problem.joint] = fit.rows[problem.joint]
    links = [Coordinate(f"mass_{i}", -1, True, 1.0, *np.log(RANGE)) for i in range(len(chain.joints))]
    own = [(p.joint, c) for p, fit in zip(problems, fits, strict=True) for c in fit.coordinates]
    coordinates = [*links, *(c for _, c in own)]
    widths = np.concatenate([np.full(int(p.count.sum()), p.floor) for p in problems])

    def residuals(x: np.ndarray, _: np.ndarray | None) -> np.ndarray:
        """Of all joints, in noise floors [C, N]; sets with the same masses are simulated together."""
        result = np.empty((len(x), len(widths)))
        masses, which = np.unique(x[:, : len(links)], axis=0, return_inverse=True)
        for index, factors in enumerate(np.exp(masses)):
            chosen = np.flatnonzero(which.ravel() == index)
            sets = np.repeat(rows[None], len(chosen), axis=0)
            for column, (joint, c) in enumerate(own, start=len(links)):
                sets[:, joint, c.column] = c.value(x[chosen, column])
            heavier = _with_masses(problems, chain, factors)
            parts = [p.residuals(sets, rollouts=r) for p, r in zip(problems, heavier, strict=True)]
            result[chosen] = np.concatenate(parts, axis=1) / widths
        return result

    start = np.concatenate([np.zeros(len(links)), *(fit.x for fit in fits)])
    found = LeastSquares(coordinates, residuals, RIDGE).descend(start[None], ITERATIONS)
    ends = np.cumsum([int(p.count.sum()) for p in problems])[:-1]
    parts = np.split(found.residual[0] * widths, ends)
    return Masses(
        factors=np.exp(found.x[0, : len(links)]),
        errors=np.array([np.sqrt(np.mean(part**2)) for part in parts]),
        structure=tuple(p.structure(part) for p, part in zip(problems, parts, strict=True)),
    )


def _with_masses(problems: Sequence[JointProblem], chain: Chain, factors: np.ndarray) -> list[Rollouts]:
    """The rollouts of each problem with the links' masses and inertias times factors [n]."""
    other = replace(chain, mass=chain.mass * factors, inertia=chain.inertia * factors[:, None, None])
    made: dict[int, Rollouts] = {}
    for problem in problems:
        known = problem.rollouts
        if id(known) not in made:
            made[id(known)] = known.with_chain(other)
    return [made[id(problem.rollouts)] for problem in problems]
