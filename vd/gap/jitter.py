"""Fit a delay that varies at random: no single prediction is right, so the spread is compared too.

Many draws of the delays give the mean and variance of the position at every sample. The likelihood
of what was measured, under a normal distribution with that mean and that variance on top of the
noise floor, is maximised over the jitter's two parameters; the rest of the model is fitted through
what the delays do to the samples (:class:`vd.gap.models.SampleWeighting`). The result stands in the
table as the RMSE that a normal distribution of constant width would need for the same likelihood.
"""

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.optimize import Bounds, minimize

from vd.gap.coordinates import Scales, coordinate, sizes
from vd.gap.fit import JointProblem
from vd.gap.models import RIDGE, JointFit, SampleWeighting
from vd.gap.rollout import Rollouts
from vd.gap.rules import JITTER, MEMORY
from vd.gap.statistics import half_width

SIGMA = f"{JITTER}.sigma_s"
DROP = f"{JITTER}.p_drop"
DRAWS = 16
"""Realisations of the delays; alone they leave a third of error in the variance. Not tuned."""
NARROW = 0.5
"""Share of the first guess that is believed: behind more jitter than there is an effect would not
show. Half and twice were not tried."""
FACTORS = (0.0, 0.5, 0.71, 1.0, 1.41, 2.0)
"""Multiples of the best values at which the likelihood is looked at for the intervals. Not tuned:
finer ones end closer to where the likelihood does."""


class JitterFit:
    """The jitter of one joint.

    Args:
        problem: The joint's data.
        base: Fit of the rest of the model.
        scales: Sizes of the joint's motion.
    """

    def __init__(self, problem: JointProblem, base: JointFit, scales: Scales):
        self.problem, self.base, self.scales = problem, base, scales
        self.coordinates = [coordinate(key, scales) for key in (SIGMA, DROP)]
        recording = problem.rollouts.recording
        chosen = [recording.trajectories[int(t)] for t in problem.trajectories]
        # A trajectory's name seeds its draws.
        copies = tuple(replace(t, file=f"{t.file}#{draw}") for draw in range(DRAWS) for t in chosen)
        self.rollouts = Rollouts(
            problem.rollouts.chain,
            replace(recording, trajectories=copies),
            dt=problem.rollouts.dt,
            device=problem.rollouts.device,
        )
        self.measured = np.concatenate([t.position[:, self._column] for t in chosen])
        self.ends = np.cumsum([len(t.time) for t in chosen])[:-1]
        self.shift = np.zeros(len(base.x))

    @cached_property
    def jacobian(self) -> np.ndarray:
        """d(predicted)/dx of the rest of the model [P, N]; a weighting alone needs none."""
        return self.problem.jacobian(self.base)

    @property
    def _column(self) -> int:
        return int(self.problem.rollouts.chain.columns[self.problem.joint])

    def row(self, sigma: float, drop: float) -> np.ndarray:
        """Rows of the chain with the jitter."""
        rows = self.base.rows.copy()
        for c, value in zip(self.coordinates, (sigma, drop), strict=True):
            rows[self.problem.joint, c.column] = value
        return rows

    def draws(self, sigma: float, drop: float) -> tuple[np.ndarray, np.ndarray]:
        """Mean of the positions [N] [rad] over draws of the delays, and their variance [N] [rad^2]."""
        rows = self.row(sigma, drop)[None]
        draws = (
            self.rollouts.predict(rows, joint=self.problem.joint)[0]
            .astype(float)
            .reshape(DRAWS, -1)
        )
        spread = np.split(draws.var(axis=0, ddof=1), self.ends)
        kernel = np.ones(MEMORY) / MEMORY
        smooth = np.concatenate([np.convolve(part, kernel, mode="same") for part in spread])
        # The mean of the draws has an error of its own.
        return draws.mean(axis=0), (1.0 + 1.0 / DRAWS) * smooth

    def losses(self, sigma: float, drop: float, noises: Iterable[float] = (1.0,)) -> np.ndarray:
        """Negative log-likelihood of each trajectory [S], less a constant that all models share.

        The rest of the model moves along, to first order, by weighted least squares.

        Args:
            sigma: Standard deviation of the delays [s].
            drop: Share of commands dropped.
            noises: Factors on the noise floor; the likeliest counts.
        """
        mean, spread = self.draws(sigma, drop)
        tried = [
            self._likelihood(self.measured - mean, spread + (n * self.problem.floor) ** 2)
            for n in noises
        ]
        return min(tried, key=lambda losses: float(losses.sum()))

    def _likelihood(self, error: np.ndarray, variance: np.ndarray) -> np.ndarray:
        weighted = self.jacobian / variance
        gram = weighted @ self.jacobian.T + RIDGE * np.eye(len(weighted))
        self.shift = np.linalg.solve(gram, weighted @ error)
        error = error - self.shift @ self.jacobian
        losses = 0.5 * (np.log(variance) + error**2 / variance)
        return np.array([part.sum() for part in np.split(losses, self.ends)])

    def guess(self) -> tuple[float, float]:
        """Less than the likeliest of the starts, whatever else the model lacks.

        That can count as noise.
        """
        noises = np.geomspace(1.0, max(self.base.rmse / self.problem.floor, 1.0), 3)
        starts = [tuple(start.values()) for start in sizes(JITTER, (), self.scales)]
        totals = [float(self.losses(sigma, drop, noises).sum()) for sigma, drop in starts]
        sigma, drop = starts[int(np.argmin(totals))]
        return NARROW * sigma, NARROW * drop

    def weighting(self, sigma: float, drop: float) -> SampleWeighting:
        """What the delays do to the samples, for fits of the rest of the model."""
        mean, spread = self.draws(sigma, drop)
        without = self.measured - self.problem.residuals(self.base.rows[None])[0]
        return SampleWeighting(mean - without, np.sqrt(1.0 + spread / self.problem.floor**2))

    def search(self, start: tuple[float, float]) -> tuple[float, float]:
        """The values of the largest likelihood; the rest of the model moves along."""

        def total(x: np.ndarray) -> float:
            return float(self.losses(*np.exp(x)).sum())

        x, upper = np.log(start), np.log([c.value(c.upper) for c in self.coordinates])
        simplex = x + np.array([[0.0, 0.0], [0.4, 0.0], [0.0, 1.0]])
        options = {"initial_simplex": simplex, "xatol": 0.02, "fatol": 0.5}
        x = minimize(
            total, x, method="Nelder-Mead", bounds=Bounds(-np.inf, upper), options=options
        ).x
        total(x)
        bounds = np.array([(c.lower, c.upper) for c in self.base.coordinates]).T
        moved = np.clip(self.base.x + self.shift, *bounds)
        rows = self.problem.rows(self.base.rows, self.base.coordinates, moved[None])[0]
        self.base = replace(self.base, x=moved, rows=rows)
        self.jacobian = self.problem.jacobian(self.base)
        sigma, drop = np.exp(x).tolist()
        return sigma, drop

    def extents(self, sigma: float, drop: float) -> dict[str, tuple[float, float]]:
        """Intervals of both parameters.

        The values of the pairs that the trajectories do not reject.

        Delays and losses stand in for each other in part, so that the pairs are what is judged: by
        the sum of their losses of likelihood over the trajectories, and its interval, since the
        model is not quite right (Vuong 1989). Each end is half way to the first value that is
        rejected with every other.
        """
        here, sigmas = self.losses(sigma, drop), [sigma * f for f in FACTORS]
        # A share that is found too small says nothing of larger ones by its multiples.
        starts = [start[DROP] for start in sizes(JITTER, (), self.scales)]
        drops = sorted({*starts, *(drop * f for f in FACTORS)})
        worse = np.array([[self.losses(s, d) - here for d in drops] for s in sigmas])
        kept = worse.sum(axis=-1) < half_width(len(here) * worse.var(axis=-1, ddof=1), len(here))
        kept[sigmas.index(sigma), drops.index(drop)] = True
        ranges = {}
        for key, values, inside in ((SIGMA, sigmas, kept.any(1)), (DROP, drops, kept.any(0))):
            first, last = np.flatnonzero(inside)[[0, -1]]
            ends = np.interp(
                [first - 0.5, last + 0.5], range(len(values) + 1), [*values, 2.0 * values[-1]]
            )
            ranges[key] = float(ends[0]), float(ends[1])
        return ranges

    def result(self, sigma: float, drop: float) -> JointFit:
        """A pair of values as any other fit, with the errors that a constant width has at its likelihood."""
        x = np.array([c.inverse(v) for c, v in zip(self.coordinates, (sigma, drop), strict=True)])
        count = self.problem.count
        # A motion that is far from its prediction has an error of a radian: as good as none.
        errors = count * np.exp(np.minimum(2.0 * self.losses(sigma, drop) / count - 1.0, 0.0))
        refits = self.base.refits
        return JointFit(
            effects=(*self.base.effects, JITTER),
            coordinates=(*self.base.coordinates, *self.coordinates),
            x=np.concatenate([self.base.x, x]),
            rows=self.row(sigma, drop),
            sse=errors,
            held_out=errors,
            count=count,
            gram=np.pad(self.base.gram, (0, 2)),
            refits=np.hstack([refits, np.tile(x, (len(refits), 1))]),
        )


def look(
    problem: JointProblem, fit: JointFit, scales: Scales
) -> tuple[tuple[float, float], SampleWeighting]:
    """A first guess of the jitter of a model, and what it does to the samples."""
    jitter = JitterFit(problem, fit, scales)
    values = jitter.guess()
    return values, jitter.weighting(*values)


def fit_jitter(
    problem: JointProblem, fit: JointFit, scales: Scales, start: tuple[float, float]
) -> tuple[JointFit, SampleWeighting]:
    """The model with jitter of the largest likelihood, as any other fit, and what it does to the samples."""
    jitter = JitterFit(problem, fit, scales)
    values = jitter.search(start)
    return jitter.result(*values), jitter.weighting(*values)


def bound_jitter(problem: JointProblem, fit: JointFit, scales: Scales) -> JointFit:
    """A fitted model with the intervals of its jitter, which take longer than the fit."""
    rows, values = fit.rows.copy(), fit.values
    for c in fit.coordinates[-2:]:
        rows[problem.joint, c.column] = 0.0
    rest = replace(
        fit, effects=fit.effects[:-1], coordinates=fit.coordinates[:-2], x=fit.x[:-2], rows=rows
    )
    sigma, drop = (values[c.key] for c in fit.coordinates[-2:])
    return replace(fit, extents=JitterFit(problem, rest, scales).extents(sigma, drop))
