"""Fit the servo model of one joint to its trajectories by least squares.

Every simulation is a rollout of the whole trajectory; all perturbed parameter sets of a step go
through one call of :class:`vd.gap.rollout.Rollouts`.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

import vd.kernels.servo.actuators as servo
from vd.gap.chain import Chain, others_in
from vd.gap.coordinates import Coordinate, Scales, coordinate, keys
from vd.gap.descent import SHORT, LeastSquares
from vd.gap.models import RIDGE, JointFit, SampleWeighting
from vd.gap.rollout import Rollouts
from vd.gap.statistics import speed_of
from vd.logs.recording import Recording

ITERATIONS = 12
"""Trials of a fit at most. Not tuned."""
FINER = (2, 4)
"""Divisors of the time step for estimates: what the last one changes is their error. Not tuned."""


class JointProblem:
    """The data of one joint, and fits of models to it.

    Args:
        rollouts: Simulation of the joint's chain.
        joint: Index of the joint in the chain.
        trajectories: Indices of the trajectories used, ascending.
        folds: Fold of each of them, shape [S]; a fold is held out as a whole.
        floor: Noise floor [rad].
        baseline: Keys of the baseline's parameters.
    """

    def __init__(
        self,
        rollouts: Rollouts,
        joint: int,
        trajectories: Sequence[int],
        folds: Sequence[int],
        floor: float,
        baseline: Sequence[str],
    ):
        self.rollouts = rollouts
        self.coarse: Rollouts | None = None  # simulates for slopes, where it may be another
        self.joint = joint
        self.trajectories = np.asarray(trajectories)
        self.folds = np.asarray(folds)
        self.floor = floor
        self.baseline = tuple(baseline)
        self._measured = {
            int(t): rollouts.measured[rollouts.sample_trajectory == t, joint]
            for t in self.trajectories
        }
        self.count = np.array([len(self._measured[int(t)]) for t in self.trajectories], float)
        self._growth: dict[int, np.ndarray] = {}

    def weighted(self, weighting: SampleWeighting) -> "JointProblem":
        """The same data, samples weighted by how surely they are known."""
        seen = copy.copy(self)
        names = [int(t) for t in self.trajectories]
        shift = dict(zip(names, self.split(weighting.shift), strict=True))
        seen._measured = {t: self._measured[t] - shift[t] for t in names}
        seen._growth = dict(zip(names, self.split(weighting.growth), strict=True))
        return seen

    def residuals(
        self,
        rows: np.ndarray,
        trajectories: np.ndarray | None = None,
        keep: np.ndarray | None = None,
        *,
        rollouts: Rollouts | None = None,
    ) -> np.ndarray:
        """Measured minus predicted position of the joint for C chains [C, n, PARAMETER_COLUMNS].

        [C, N].

        What ``keep`` [C, S] leaves out of the trajectories is not simulated, and is 0.
        """
        chosen = [int(t) for t in (self.trajectories if trajectories is None else trajectories)]
        measured = np.concatenate([self._measured[t] for t in chosen])
        simulation = self.rollouts if rollouts is None else rollouts
        predicted = simulation.predict(rows, chosen, joint=self.joint, keep=keep)
        residual = measured - predicted
        if self._growth:
            residual /= np.concatenate([self._growth[t] for t in chosen])
        if keep is not None:
            residual *= np.repeat(keep, [len(self._measured[t]) for t in chosen], axis=1)
        return residual

    def squares(
        self,
        base: np.ndarray,
        coordinates: Sequence[Coordinate],
        trajectories: np.ndarray | None = None,
    ) -> LeastSquares:
        """The squared error of the model whose other parameters are those of ``base``."""

        def residuals(
            x: np.ndarray, keep: np.ndarray | None, rollouts: Rollouts | None = None
        ) -> np.ndarray:
            rows = self.rows(base, coordinates, x)
            mask = None if keep is None else np.repeat(keep[None], len(x), axis=0)
            return self.residuals(rows, trajectories, mask, rollouts=rollouts)

        slopes = partial(residuals, rollouts=self.coarse)
        return LeastSquares(coordinates, residuals, RIDGE * self.floor**2, slopes)

    def rows(
        self, base: np.ndarray, coordinates: Sequence[Coordinate], x: np.ndarray
    ) -> np.ndarray:
        """Chains [C, n, PARAMETER_COLUMNS] with this joint's parameters at coordinates [C, P]."""
        rows = np.repeat(base[None], len(x), axis=0)
        for i, c in enumerate(coordinates):
            rows[:, self.joint, c.column] = c.value(x[:, i])
        return rows

    def split(
        self, samples: np.ndarray, trajectories: np.ndarray | None = None
    ) -> list[np.ndarray]:
        """Cut the last axis into trajectories."""
        chosen = self.trajectories if trajectories is None else trajectories
        ends = np.cumsum([len(self._measured[int(t)]) for t in chosen])[:-1]
        return np.split(samples, ends, axis=-1)

    def scales(self, row: np.ndarray, residual: float) -> Scales:
        """Sizes of the joint's motion with a baseline row [PARAMETER_COLUMNS]."""
        chain, recording = self.rollouts.chain, self.rollouts.recording
        column, parts = (
            int(chain.columns[self.joint]),
            [recording.trajectories[t] for t in self.trajectories],
        )
        speeds = [speed_of(t.time, t.position[:, column]) for t in parts]
        changes = [speed_of(t.time, speed) for t, speed in zip(parts, speeds, strict=True)]
        torque = row[servo.KP] * np.concatenate(
            [t.command[:, column] - t.position[:, column] for t in parts]
        )
        peak, speed, acceleration = (
            float(np.percentile(np.abs(values), 99.5))
            for values in (torque, np.concatenate(speeds), np.concatenate(changes))
        )
        return Scales(
            kp=float(row[servo.KP]),
            torque=float(np.sqrt(np.mean(torque**2))) + 1e-9,
            peak=peak + 1e-9,
            speed=speed + 1e-3,
            acceleration=acceleration + 0.1,
            inertia=max(float(row[servo.INERTIA]) + chain.inertia_scale(self.joint), 1e-6),
            residual=residual,
            duration=max(t.duration for t in parts),
        )

    def fit(
        self,
        base: np.ndarray,
        effects: Sequence[str],
        starts: Sequence[Mapping[str, float]],
        scales: Scales,
        *,
        iterations: int = ITERATIONS,
        trajectories: np.ndarray | None = None,
    ) -> JointFit:
        """Fit a model from several starts by least squares.

        Args:
            base: Rows of the chain's joints [n, PARAMETER_COLUMNS]; this joint's parameters start
                there.
            effects: Effects in the model besides the baseline.
            starts: Starting values by key; what is absent starts at ``base``.
            scales: Sizes of the joint's motion.
            iterations: Steps at most.
            trajectories: Subset to fit to, without held-out errors; all of the problem's if None.

        Returns:
            The best.
        """
        coordinates = [coordinate(key, scales) for key in self.fitted(effects)]
        x0 = np.array(
            [
                [
                    c.inverse(float(start.get(c.key, base[self.joint, c.column])))
                    for c in coordinates
                ]
                for start in starts
            ]
        )
        chosen = self.trajectories if trajectories is None else np.asarray(trajectories)
        model = self.squares(base, coordinates, chosen)
        x = model.best(x0, iterations)
        jacobian = model.jacobian(x)
        errors = self.split(model.residuals(x[None], None)[0], chosen)
        fit = JointFit(
            effects=tuple(effects),
            coordinates=tuple(coordinates),
            x=x,
            rows=self.rows(base, coordinates, x[None])[0],
            sse=np.array([e @ e for e in errors]),
            held_out=np.full(len(chosen), np.nan),
            count=np.array([len(e) for e in errors], float),
            gram=jacobian @ jacobian.T,
            refits=x[None],
        )
        if trajectories is not None:
            return fit
        return self.cross_validate(fit, jacobian)

    def fitted(self, effects: Sequence[str]) -> list[str]:
        """Keys of what a model with these effects fits on this joint."""
        others = others_in(self.rollouts.chain, self.joint)
        absent = {
            f"joint_coupling.from_{slot + 1}"
            for slot in range(servo.MAX_JOINTS)
            if slot not in others
        }
        return [key for key in keys(effects, self.baseline) if key not in absent]

    def jacobian(self, fit: JointFit) -> np.ndarray:
        """d(predicted)/dx at a fit, shape [P, N]."""
        return self.squares(fit.rows, fit.coordinates).jacobian(fit.x)

    def cross_validate(self, fit: JointFit, jacobian: np.ndarray) -> JointFit:
        """A fit with the errors of each trajectory as a fit without its fold predicts it.

        Args:
            fit: The fit to all folds.
            jacobian: Its d(predicted)/dx [P, N], which the refits keep.
        """
        out = np.unique(self.folds)[:, None] == self.folds
        model = self.squares(fit.rows, fit.coordinates)
        x = np.array(
            [
                model.descend(
                    fit.x, SHORT, ~fold, jacobian * np.repeat(~fold, self.count.astype(int))
                )
                for fold in out
            ]
        )
        residual = self.residuals(self.rows(fit.rows, fit.coordinates, x), keep=out)
        parts = self.split(residual.sum(0))
        squared, absolute = (
            np.array([np.sum(abs(part) ** power) for part in parts]) for power in (2, 1)
        )
        return replace(fit, held_out=squared, held_out_abs=absolute, refits=x)

    def refine(self, fit: JointFit, scales: Scales) -> JointFit:
        """The same model fitted on with finer time steps, for values that do not depend on the step.

        What the last halving changes is kept as the error that is left. Slopes are those of the
        problem's own time step: they need not be finer. Held-out errors are those of
        ``fit``, to be compared with other models'.
        """
        result, error, fine = fit, np.zeros(len(fit.x)), copy.copy(self)
        fine.coarse = self.rollouts
        for divisor in FINER:
            fine.rollouts = self.rollouts.at(self.rollouts.dt / divisor)
            before, given = result.x, [result.values]
            result = fine.fit(fit.rows, fit.effects, given, scales, trajectories=self.trajectories)
            error = np.abs(result.x - before)
        held_out = {name: getattr(fit, name) for name in ("held_out", "held_out_abs", "refits")}
        return replace(result, **held_out, step_error=error)

    def promise(
        self, fit: JointFit, starts: Sequence[Mapping[str, float]], scales: Scales
    ) -> np.ndarray:
        """Share of the squared error that each start could remove, the present parameters readjusted.

        A linear estimate from one rollout per start: the start's change of the prediction, less
            what
        the fitted parameters can imitate, against the residual.

        Args:
            fit: Present model.
            starts: Starting values of the effect that each start adds, by key.
            scales: Sizes of the joint's motion.
        """
        residual = self.residuals(fit.rows[None])
        jacobian = self.jacobian(fit)
        basis = np.linalg.svd(jacobian, full_matrices=False)[2]
        left = residual[0] - basis.T @ (basis @ residual[0])
        rows = np.repeat(fit.rows[None], len(starts), axis=0)
        for i, start in enumerate(starts):
            for key, value in start.items():
                if "." not in key and key not in self.baseline:
                    continue  # not free in this chain
                rows[i, self.joint, coordinate(key, scales).column] = value
        change = residual - self.residuals(rows)
        change -= (change @ basis.T) @ basis
        along = change @ left
        power = np.einsum("cn,cn->c", change, change)
        # A multiple within a factor of a few of the start; more is another size, and less than 0 no
        # effect.
        factor = np.clip(along / np.maximum(power, 1e-300), 0.0, 3.0)
        gain = 2.0 * factor * along - factor**2 * power
        return gain / max(float(residual[0] @ residual[0]), 1e-300)


@dataclass(frozen=True, eq=False)
class JointSpec:
    """What makes the problem of one joint.

    Attributes:
        chain: Index of the chain.
        joint: Index of the joint in the chain.
        trajectories: Indices of the trajectories used.
        folds: Fold of each.
        floor: Noise floor [rad].
        baseline: Keys of the fitted baseline parameters.
        pieces: Samples ``(first, end)`` of each trajectory that are analysed; empty: all.
    """

    chain: int
    joint: int
    trajectories: tuple[int, ...]
    folds: tuple[int, ...]
    floor: float
    baseline: tuple[str, ...]
    pieces: tuple[tuple[int, int], ...] = ()


class Problems:
    """The problems of a recording, made when they are first asked for.

    Args:
        recording: The recording.
        chains: Its chains.
        dt: Time step of the rollouts [s].
        device: Warp device.
    """

    def __init__(self, recording: Recording, chains: Sequence[Chain], dt: float, device: str):
        self.recording, self.chains, self.dt, self.device = recording, chains, dt, device
        self._rollouts: dict[tuple[int, int | None], Rollouts] = {}
        self._problems: dict[tuple[int, int], JointProblem] = {}

    def of(self, spec: JointSpec) -> JointProblem:
        """The problem of a joint."""
        key = spec.chain, spec.joint
        if key not in self._problems:
            # Whole trajectories are shared by the joints of a chain, pieces are each joint's own.
            shared = spec.chain, None if not spec.pieces else spec.joint
            if shared not in self._rollouts:
                parts = dict(zip(spec.trajectories, spec.pieces, strict=bool(spec.pieces)))
                recording, chain = self.recording.cut(parts), self.chains[spec.chain]
                self._rollouts[shared] = Rollouts(chain, recording, dt=self.dt, device=self.device)
            self._problems[key] = JointProblem(
                self._rollouts[shared],
                spec.joint,
                spec.trajectories,
                spec.folds,
                spec.floor,
                spec.baseline,
            )
        return self._problems[key]
