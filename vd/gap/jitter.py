"""Fit a delay that varies by chance: no single prediction is right, so the spread is compared too.

Many draws of the delays give the mean and variance of the position at every sample. The likelihood of
what was measured, under a normal distribution with that mean and that variance on top of the noise
floor, is maximised over the jitter's two parameters; the rest of the model is that of the best constant
delay. Its result stands in the table as the RMSE that a normal distribution of constant width would need for
the same likelihood.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from vd.gap.coordinates import Coordinate, Scales, coordinate
from vd.gap.fit import JointProblem
from vd.gap.joint_fit import JointFit
from vd.gap.rollout import Rollouts

DRAWS = 16
"""Realisations of the delays."""
SMOOTH = 9
"""Samples over which the variance is averaged: 16 draws alone leave a third of error in it."""
START_SIGMA_DROP = tuple((sigma, drop) for sigma in (0.0015, 0.005, 0.015) for drop in (0.01, 0.1, 0.4))
"""Where the search starts: [s] and the share of commands dropped."""
ROUNDS = 2
"""Searches, with the rest of the model linearised anew before the second."""
NOT_NEAR = 1.5
"""Error of the best start, in that of a model without chance, from which a search has nothing to find. One of
1.2 has come down to 0.9."""
LARGEST = 2.0
"""Logarithm of the largest equivalent error squared [rad^2]: as good as none."""
DAMPING = 1e-4
TRUST = 0.5
"""Largest shift of a coordinate of the rest of the model in a round."""
EVALUATIONS = 30
STEP = 0.1
"""Relative step of the finite differences of the likelihood: above the error of the draws."""
LEAST_DROP = 1e-4
FACTORS = (0.5, 0.71, 0.85, 1.0, 1.18, 1.41, 2.0)
"""Multiples of the best standard deviation at which the likelihood is looked at for the intervals ..."""
DROPS = (0.003, 0.01, 0.03, 0.1, 0.3)
"""... and shares of commands dropped."""
NOT_WORSE = 2.0
"""A pair of values is within the intervals if its likelihood is not worse, by this many standard
deviations over the trajectories: within one, samples say the same thing over and over."""
SURE = 1.92
"""Loss of log-likelihood at the 95 % interval of one parameter, if all samples counted."""


class JitterFit:
    """The jitter of one joint.

    Args:
        problem: The joint's data.
        base: Fit with a constant command delay besides the effects that the joint has.
        scales: Sizes of the joint's motion.
    """

    def __init__(self, problem: JointProblem, base: JointFit, scales: Scales):
        self.problem, self.base = problem, base
        self.coordinates = [coordinate(f"command_jitter.{name}", scales) for name in ("sigma_s", "p_drop")]
        recording = problem.rollouts.recording
        chosen = [recording.trajectories[int(t)] for t in problem.trajectories]
        self.size = len(chosen)
        # A trajectory's name seeds its draws.
        copies = tuple(replace(t, file=f"{t.file}#{draw}") for draw in range(DRAWS) for t in chosen)
        self.rollouts = Rollouts(
            problem.rollouts.chain,
            replace(recording, trajectories=copies),
            dt=problem.rollouts.dt,
            device=problem.rollouts.device,
            crowd=problem.rollouts.crowd,
        )
        self.measured = np.concatenate([t.position[:, self._column] for t in chosen])
        self.ends = np.cumsum([len(t.time) for t in chosen])[:-1]
        self.keep = [i for i, c in enumerate(base.coordinates) if c.key != "command_delay.delay_s"]
        self.jacobian = problem.jacobian(base)[self.keep]
        self.shift = np.zeros(len(self.keep))

    @property
    def _column(self) -> int:
        return int(self.problem.rollouts.chain.columns[self.problem.joint])

    def row(self, sigma: float, drop: float) -> np.ndarray:
        """Rows of the chain with the jitter in place of the constant delay."""
        rows = self.base.rows.copy()
        for c in self.base.coordinates:
            if c.key == "command_delay.delay_s":
                rows[self.problem.joint, c.column] = 0.0
        for c, value in zip(self.coordinates, (sigma, drop), strict=True):
            rows[self.problem.joint, c.column] = value
        return rows

    def losses(self, sigma: float, drop: float) -> np.ndarray:
        """Negative log-likelihood of each trajectory [S], less a constant that all models share.

        The rest of the model moves along, to first order, by weighted least squares.
        """
        predicted = self.rollouts.predict(self.row(sigma, drop)[None], joint=self.problem.joint)[0]
        self.problem.simulated += DRAWS * self.size
        draws = predicted.reshape(DRAWS, -1).astype(float)
        error = self.measured - draws.mean(axis=0)
        spread = np.split(draws.var(axis=0, ddof=1), self.ends)
        kernel = np.ones(SMOOTH) / SMOOTH
        smooth = np.concatenate([np.convolve(part, kernel, mode="same") for part in spread])
        # The mean of the draws has an error of its own.
        variance = self.problem.floor**2 + (1.0 + 1.0 / DRAWS) * smooth
        weighted = self.jacobian / variance
        gram = weighted @ self.jacobian.T
        gram += np.diag(DAMPING * np.diag(gram) + DAMPING)
        self.shift = np.clip(np.linalg.solve(gram, weighted @ error), -TRUST, TRUST)
        error = error - self.shift @ self.jacobian
        losses = 0.5 * (np.log(variance) + error**2 / variance)
        return np.array([part.sum() for part in np.split(losses, self.ends)])

    def fit(self, worst: float) -> JointFit:
        """The jitter with the largest likelihood, as a fit like any other.

        Args:
            worst: Squared error of a model without chance [rad^2]. Where no start of the search comes near
                that (``NOT_NEAR``) there is no jitter to be found.
        """

        def total(x: np.ndarray) -> float:
            return float(self.losses(*self._values(x)).sum())

        starts = np.log(np.array(START_SIGMA_DROP))
        totals = [total(x) for x in starts]
        start = starts[int(np.argmin(totals))]
        sigma, drop = self._values(start)
        here = self.losses(sigma, drop)
        if self._equivalent(here).sum() > NOT_NEAR**2 * worst:
            return self._as_fit(sigma, drop, here)
        for _ in range(ROUNDS):
            simplex = start + np.array([[0.0, 0.0], [0.4, 0.0], [0.0, 1.0]])
            options = {"maxfev": EVALUATIONS, "initial_simplex": simplex, "xatol": 0.02, "fatol": 0.5}
            start = minimize(total, start, method="Nelder-Mead", options=options).x
            sigma, drop = self._values(start)
            self.losses(sigma, drop)
            self._move(self.shift)
        return self._result(sigma, drop)

    def _equivalent(self, losses: np.ndarray) -> np.ndarray:
        """Squared errors that a normal distribution of constant width has at the same likelihood [S]."""
        count = self.problem.count
        return count * np.exp(np.minimum(2.0 * losses / count - 1.0, LARGEST))

    def _extents(self, sigma: float, drop: float, here: np.ndarray) -> dict[str, tuple[float, float]]:
        """Intervals of both parameters: the values of the pairs that the trajectories do not reject.

        Delays and losses stand in for each other in part, so that the pairs are what is judged; each end
        is half way to the first value that is rejected with every other.
        """
        sigmas = [sigma * f for f in FACTORS]
        drops = sorted({max(drop, LEAST_DROP), *DROPS})
        kept = np.zeros((len(sigmas), len(drops)), bool)
        for i, one in enumerate(sigmas):
            for k, other in enumerate(drops):
                pair = self._limited(one, other)
                worse = self.losses(*pair) - here
                spread = np.sqrt(len(worse)) * float(np.std(worse, ddof=1)) if len(worse) > 1 else 0.0
                kept[i, k] = float(worse.sum()) < SURE + NOT_WORSE * spread
        kept[FACTORS.index(1.0), drops.index(max(drop, LEAST_DROP))] = True
        ranges = {}
        for name, values, inside in (
            ("sigma_s", sigmas, kept.any(axis=1)),
            ("p_drop", drops, kept.any(axis=0)),
        ):
            first, last = int(np.flatnonzero(inside)[0]), int(np.flatnonzero(inside)[-1])
            low = np.sqrt(values[first] * values[first - 1]) if first > 0 else 0.0
            high = np.sqrt(values[last] * values[last + 1]) if last + 1 < len(values) else 2.0 * values[last]
            ranges[f"command_jitter.{name}"] = float(low), float(high)
        return ranges

    def _limited(self, sigma: float, drop: float) -> tuple[float, float]:
        limits = [float(c.value(c.upper)) for c in self.coordinates]
        return min(sigma, limits[0]), min(drop, limits[1])

    def _move(self, shift: np.ndarray) -> None:
        """Take the shift of the rest of the model, and linearise it there."""
        x = self.base.x.copy()
        for i, change in zip(self.keep, shift, strict=True):
            c = self.base.coordinates[i]
            x[i] = min(max(x[i] + change, c.lower), c.upper)
        rows = self.problem.rows(self.base.rows, self.base.coordinates, x[None])[0]
        self.base = replace(self.base, x=x, rows=rows)
        self.jacobian = self.problem.jacobian(self.base)[self.keep]

    def _values(self, x: np.ndarray) -> tuple[float, float]:
        sigma, drop = (float(v) for v in np.exp(x))
        return self._limited(sigma, drop)

    def _result(self, sigma: float, drop: float) -> JointFit:
        """Equivalent errors, and the likelihood's curvature in the place of the Gauss-Newton matrices."""
        x = np.array([c.inverse(v) for c, v in zip(self.coordinates, (sigma, drop), strict=True)])
        steps = np.maximum(STEP * x, [c.inverse(LEAST_DROP) for c in self.coordinates])
        here = self.losses(sigma, drop)
        sides = np.empty((2, 2, self.size))
        for i in range(2):
            for k, sign in enumerate((1.0, -1.0)):
                moved = x.copy()
                moved[i] = max(moved[i] + sign * steps[i], 0.0)
                pair = [float(c.value(v)) for c, v in zip(self.coordinates, moved, strict=True)]
                sides[i, k] = self.losses(pair[0], pair[1])
        curved, slope = np.empty((2, self.size)), np.empty((2, self.size))
        for i in range(2):
            curvature = (sides[i, 0] + sides[i, 1] - 2.0 * here) / steps[i] ** 2
            # No trajectory alone may bend the wrong way by the error of the draws; the sum is what counts.
            curved[i] = max(float(curvature.sum()), 1e-6) / self.size
            slope[i] = -(sides[i, 0] - sides[i, 1]) / (2.0 * steps[i])
        fit = self._as_fit(sigma, drop, here)
        floor = self.problem.floor**2
        for i in range(2):
            fit.gram[:, i - 2, i - 2], fit.gradient[:, i - 2] = curved[i] * floor, slope[i] * floor
        return replace(fit, extents=self._extents(sigma, drop, here))

    def _as_fit(self, sigma: float, drop: float, here: np.ndarray) -> JointFit:
        """A pair of values, and the losses there, as a fit whose matrices leave them out."""
        keep = self.keep
        x = [c.inverse(v) for c, v in zip(self.coordinates, (sigma, drop), strict=True)]
        size, equivalent = len(keep) + 2, self._equivalent(here)
        gram, gradient = np.zeros((self.size, size, size)), np.zeros((self.size, size))
        gram[:, : size - 2, : size - 2] = self.base.gram[:, keep][:, :, keep]
        gradient[:, : size - 2] = self.base.gradient[:, keep]
        coordinates: list[Coordinate] = [*(self.base.coordinates[i] for i in keep), *self.coordinates]
        effects = tuple(e for e in self.base.effects if e != "command_delay")
        return JointFit(
            effects=(*effects, "command_jitter"),
            coordinates=tuple(coordinates),
            x=np.concatenate([self.base.x[keep], x]),
            rows=self.row(sigma, drop),
            sse=equivalent,
            held_out=equivalent,
            count=self.problem.count,
            gram=gram,
            gradient=gradient,
        )


def fit_jitter(
    problem: JointProblem,
    base: np.ndarray,
    effects: Sequence[str],
    starts: Sequence[Mapping[str, float]],
    scales: Scales,
    iterations: int,
) -> JointFit:
    """Fit ``effects`` and jitter: first with a constant delay for its mean, then its spread."""
    fit = problem.fit(base, (*effects, "command_delay"), starts, scales, iterations=iterations)
    left = problem.residuals(base[None])[0]
    return JitterFit(problem, fit, scales).fit(float(left @ left))
