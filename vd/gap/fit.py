"""Fit the servo model of one joint to its motions by least squares, by scipy's trust-region method.

Every simulation is a rollout of whole trajectories; all perturbed parameter sets of a step go
through one call of :class:`vd.gap.rollout.Rollouts`.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

import vd.kernels.servo.actuators as servo
from vd.gap.chain import Chain, others_in
from vd.gap.coordinates import FREE_SPEED, PARAMETERS, Coordinate, Scales, coordinate, keys_of
from vd.gap.rollout import Rollouts
from vd.gap.statistics import OWN_ERROR, half_width, rmse, speed_of
from vd.logs.recording import Recording

ITERATIONS = 12
"""Trials of a fit at most. Not tuned."""
SHORT = 4
"""Trials after which the worse half of several starts ends, and of a refit near its start. Not
tuned.
"""
WIDEN = -3.0
"""Factor on the finite-difference steps of a second descent: dry friction and limits make the
squared error rugged at the scale of the first one's. Less than 0: to the other side. Without the
second descent a limit of 10 comes out as 10.19; other factors were not tried."""
TOLERANCE = 1e-4
"""Relative improvement of the squared error at which a fit has converged. Not tuned."""
RIDGE = 0.01
"""Pull towards the start, as information in units of the noise floor: holds directions that the
data leave free (the torque scale of a bare servo), moves no others. Not tuned."""
FINER = (2, 4)
"""Divisors of the time step for estimates: what the last one changes is their error. Not tuned."""


@dataclass(frozen=True, eq=False)
class JointFit:
    """A fitted model of one joint; S trajectories, P parameters.

    Attributes:
        effects: Names of the effects in the model.
        coordinates: What was fitted.
        x: Fitted coordinates [P].
        rows: Parameter rows of the chain's joints, shape [n, PARAMETER_COLUMNS].
        sse: Sum of squared errors of each trajectory [S] [rad^2].
        absolute: Sum of absolute errors of each trajectory [S] [rad].
        held_out: Sum of squared errors, each trajectory predicted by a fit without its group [S].
        held_out_abs: Sum of absolute errors of held-out trajectories [S] [rad].
        count: Samples of each trajectory [S].
        gram: J^T J [P, P].
        refits: Coordinates of the fits without each fold [F, P].
        step_error: What the time step of the rollouts leaves open in ``x`` [P].
    """

    effects: tuple[str, ...]
    coordinates: tuple[Coordinate, ...]
    x: np.ndarray
    rows: np.ndarray
    sse: np.ndarray
    absolute: np.ndarray
    held_out: np.ndarray
    held_out_abs: np.ndarray
    count: np.ndarray
    gram: np.ndarray
    refits: np.ndarray
    step_error: np.ndarray

    @property
    def values(self) -> dict[str, float]:
        """Parameter values by key."""
        result = {}
        for c, x in zip(self.coordinates, self.x, strict=True):
            result[c.key] = float(c.value(x))
        return result

    @property
    def rmse(self) -> float:
        """RMSE on what was fitted [rad]."""
        return float(rmse(self.sse, self.count))

    @property
    def mean_square(self) -> np.ndarray:
        """Mean squared error of each held-out trajectory [S] [rad^2]."""
        return self.held_out / self.count

    @property
    def mean_absolute(self) -> np.ndarray:
        """Mean absolute error of each held-out trajectory [S] [rad]."""
        return self.held_out_abs / self.count

    @property
    def held_out_rmse(self) -> float:
        """RMSE on held-out trajectories [rad]."""
        return float(rmse(self.held_out, self.count))


def intervals(fit: JointFit, floor: float) -> dict[str, tuple[float, float]]:
    """95 % intervals by key.

    Of the jackknife over folds, or of white noise at the floor if that is wider. To these come the
    error of the time step and the model's own, which all motions share.
    """
    folds = len(fit.refits)
    ridge = RIDGE * floor**2 * np.eye(len(fit.x))
    white = floor**2 * np.diag(np.linalg.inv(fit.gram + ridge))
    jackknife = (folds - 1) * fit.refits.var(axis=0)
    width = half_width(np.maximum(jackknife, white), folds)
    own = half_width(np.square(OWN_ERROR), np.inf)
    result = {}
    for c, x, half, step in zip(fit.coordinates, fit.x, width, fit.step_error, strict=True):
        size = 1.0 if c.log else x
        w = np.hypot(np.hypot(half, own * size), step)
        low = c.value(max(x - w, c.lower))
        high = c.value(min(x + w, c.upper))
        result[c.key] = (float(low), float(high))
    return result


@dataclass(frozen=True, eq=False)
class JointSpec:
    """What makes the problem of one joint.

    Attributes:
        chain: Index of the chain.
        joint: Index of the joint in the chain.
        trajectories: Indices of the trajectories used, ascending.
        folds: Fold of each; a fold is held out as a whole.
        floor: Noise floor [rad].
        baseline: Keys of the fitted baseline parameters.
        pieces: Samples ``(first, end)`` of each trajectory that are analysed; empty: all.
        aside: Index of the trajectory that no fit sees; None where there are too few.
    """

    chain: int
    joint: int
    trajectories: tuple[int, ...]
    folds: tuple[int, ...]
    floor: float
    baseline: tuple[str, ...]
    pieces: tuple[tuple[int, int], ...] = ()
    aside: int | None = None


class JointProblem:
    """The data of one joint, and fits of models to it.

    Args:
        rollouts: Simulation of the joint's chain.
        spec: What makes the problem.
    """

    def __init__(self, rollouts: Rollouts, spec: JointSpec):
        self.rollouts = rollouts
        self.slopes = rollouts  # simulates for Jacobians, which need no finer step
        self.joint = spec.joint
        self.trajectories = spec.trajectories
        self.folds = np.array(spec.folds)
        self.floor = spec.floor
        self.baseline = spec.baseline
        parts = []
        counts = []
        for trajectory in spec.trajectories:
            own = rollouts.sample_trajectory == trajectory
            parts.append(rollouts.measured[own, spec.joint])
            counts.append(own.sum())
        self._measured = np.concatenate(parts)
        self.count = np.array(counts)

    def residuals(
        self, rows: np.ndarray, keep: np.ndarray | None = None, rollouts: Rollouts | None = None
    ) -> np.ndarray:
        """Measured minus predicted position of the joint for C chains [C, n, PARAMETER_COLUMNS].

        Args:
            rows: The chains.
            keep: What is simulated of the trajectories [C, S]; the rest is 0. All by default.
            rollouts: The simulation, another than the problem's.

        Returns:
            Residuals [C, N] [rad].
        """
        simulation = rollouts or self.rollouts
        predicted = simulation.predict(rows, self.trajectories, joint=self.joint, keep=keep)
        residual = self._measured - predicted
        if keep is not None:
            residual *= np.repeat(keep, self.count, axis=1)
        return residual

    def rows(
        self, base: np.ndarray, coordinates: Sequence[Coordinate], x: np.ndarray
    ) -> np.ndarray:
        """Chains [C, n, PARAMETER_COLUMNS] with this joint's parameters at coordinates [C, P]."""
        rows = np.repeat(base[None], len(x), axis=0)
        for i, c in enumerate(coordinates):
            rows[:, self.joint, c.column] = c.value(x[:, i])
        return rows

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Sums over the samples of each trajectory [.., S] of values [.., N]."""
        starts = np.cumsum(self.count) - self.count
        return np.add.reduceat(values, starts, axis=-1)

    def scales(self, row: np.ndarray, residual: float) -> Scales:
        """Sizes of the joint's motion with a baseline row [PARAMETER_COLUMNS]."""
        chain = self.rollouts.chain
        column = int(chain.columns[self.joint])
        parts = []
        duration = 0.0
        for index in self.trajectories:
            trajectory = self.rollouts.recording.trajectories[index]
            position = trajectory.position[:, column]
            speed = speed_of(trajectory.time, position)
            torque = row[servo.KP] * (trajectory.command[:, column] - position)
            parts.append([speed, speed_of(trajectory.time, speed), torque])
            duration = max(duration, trajectory.duration)
        motion = np.concatenate(parts, axis=1)
        top_speed, acceleration, peak = np.percentile(np.abs(motion), 99.5, axis=1).tolist()
        return Scales(
            kp=float(row[servo.KP]),
            torque=float(np.sqrt(np.mean(motion[2] ** 2))) + 1e-9,
            peak=peak + 1e-9,
            speed=top_speed + 1e-3,
            acceleration=acceleration + 0.1,
            inertia=max(float(row[servo.INERTIA]) + chain.inertia_scale(self.joint), 1e-6),
            residual=residual,
            duration=duration,
        )

    def fitted(self, effects: Sequence[str]) -> list[str]:
        """Keys of what a model with these effects fits on this joint."""
        keys = [*self.baseline, *keys_of(effects)]
        for slot in range(servo.MAX_JOINTS):
            coupling = f"joint_coupling.from_{slot + 1}"
            if coupling in keys and slot not in others_in(self.rollouts.chain, self.joint):
                keys.remove(coupling)
        return keys

    def plain(
        self, base: np.ndarray, start: Mapping[str, float] | None = None
    ) -> tuple[JointFit, Scales]:
        """The plain model, and the sizes of the joint's motion with it.

        Args:
            base: Rows of the chain's joints [n, PARAMETER_COLUMNS].
            start: Starting values by key; ``base`` and some speed limits without.
        """
        row = base[self.joint].copy()
        for key, value in (start or {}).items():
            row[PARAMETERS[key].column] = value
        scales = self.scales(row, self.floor)
        # One speed limit as it is, one that binds, one that does not.
        binding = {"velocity_limit": scales.speed}
        free = {"velocity_limit": FREE_SPEED * scales.speed}
        fit = self.fit(base, (), [{}, binding, free] if start is None else [start], scales)
        return fit, self.scales(fit.rows[self.joint], fit.rmse)

    def fit(
        self,
        base: np.ndarray,
        effects: Sequence[str],
        starts: Sequence[Mapping[str, float]],
        scales: Scales,
        *,
        iterations: int = ITERATIONS,
    ) -> JointFit:
        """Fit a model from several starts, and predict every fold by a fit without it.

        Args:
            base: Rows of the chain's joints [n, PARAMETER_COLUMNS], this joint's without effects.
            effects: Effects in the model besides the baseline.
            starts: Starting values by key; what is absent starts at ``base``.
            scales: Sizes of the joint's motion.
            iterations: Steps at most.

        Returns:
            The best.
        """
        coordinates = [coordinate(key, scales) for key in self.fitted(effects)]
        x0 = np.empty((len(starts), len(coordinates)))
        for i, c in enumerate(coordinates):
            for row, start in zip(x0, starts, strict=True):
                row[i] = c.inverse(float(start.get(c.key, base[self.joint, c.column])))
        x = _Descent(self, base, coordinates).best([*x0], iterations)
        return self._judged(base, tuple(effects), coordinates, x)

    def _judged(
        self,
        base: np.ndarray,
        effects: tuple[str, ...],
        coordinates: Sequence[Coordinate],
        x: np.ndarray,
    ) -> JointFit:
        """The fit at coordinates [P], with its errors on all and on held-out motions.

        Refits go on from there with the slopes that they have there.
        """
        descent = _Descent(self, base, coordinates)
        jacobian = descent.jacobian(x)
        out = np.unique(self.folds)[:, None] == self.folds
        refits = []
        for fold in out:
            slopes = jacobian * np.repeat(~fold, self.count)
            refits.append(descent.descend(x, SHORT, ~fold, slopes))
        unseen = self.residuals(self.rows(base, coordinates, np.array(refits)), out).sum(axis=0)
        rows = self.rows(base, coordinates, x[None])
        residual = self.residuals(rows)[0]
        return JointFit(
            effects=effects,
            coordinates=tuple(coordinates),
            x=x,
            rows=rows[0],
            sse=self.sums(residual**2),
            absolute=self.sums(np.abs(residual)),
            held_out=self.sums(unseen**2),
            held_out_abs=self.sums(np.abs(unseen)),
            count=self.count.astype(float),
            gram=jacobian @ jacobian.T,
            refits=np.array(refits),
            step_error=np.zeros(len(x)),
        )

    def refine(self, fit: JointFit) -> JointFit:
        """The same model fitted on with finer time steps, for values that do not depend on the step.

        What the last halving changes is kept as the error that is left. Slopes are those of the
        problem's own time step. Held-out errors are those of ``fit``, to be compared with other
        models'.
        """
        fine = copy.copy(self)
        x = fit.x
        error = np.zeros(len(fit.x))
        for divisor in FINER:
            fine.rollouts = self.rollouts.at(self.rollouts.dt / divisor)
            moved = _Descent(fine, fit.rows, fit.coordinates).best([x], ITERATIONS)
            error = np.abs(moved - x)
            x = moved
        rows = self.rows(fit.rows, fit.coordinates, x[None])
        residual = fine.residuals(rows)[0]
        return replace(
            fit,
            x=x,
            rows=rows[0],
            sse=self.sums(residual**2),
            absolute=self.sums(np.abs(residual)),
            step_error=error,
        )

    def promise(
        self, fit: JointFit, starts: Sequence[Mapping[str, float]], scales: Scales
    ) -> np.ndarray:
        """Share of the squared error that each start could remove, the present parameters readjusted.

        A linear estimate from one rollout per start: the start's change of the prediction, less
        what the fitted parameters can imitate, against the residual.

        Args:
            fit: Present model.
            starts: Values that each start changes, by key.
            scales: Sizes of the joint's motion.
        """
        residual = self.residuals(fit.rows[None])[0]
        jacobian = _Descent(self, fit.rows, fit.coordinates).jacobian(fit.x)
        basis = np.linalg.svd(jacobian, full_matrices=False)[2]
        left = residual - basis.T @ (basis @ residual)
        rows = np.repeat(fit.rows[None], len(starts), axis=0)
        for row, start in zip(rows, starts, strict=True):
            for key, value in start.items():
                if "." in key or key in self.baseline:
                    row[self.joint, coordinate(key, scales).column] = value
        change = residual - self.residuals(rows)
        change -= (change @ basis.T) @ basis
        along = change @ left
        power = np.einsum("cn,cn->c", change, change)
        # A multiple within a factor of a few of the start; more is another size, and less than 0 no
        # effect.
        factor = np.clip(along / np.maximum(power, 1e-300), 0.0, 3.0)
        gain = 2.0 * factor * along - factor**2 * power
        return gain / max(float(residual @ residual), 1e-300)


class _Descent:
    """Least squares of a problem in coordinates, the other parameters being those of ``base``."""

    def __init__(self, problem: JointProblem, base: np.ndarray, coordinates: Sequence[Coordinate]):
        self.problem = problem
        self.base = base
        self.coordinates = coordinates
        bounds = np.array([(c.lower, c.upper) for c in coordinates])
        self.lower = bounds[:, 0]
        self.upper = bounds[:, 1]
        self.pull = np.sqrt(RIDGE) * problem.floor

    def residuals(self, x: np.ndarray, keep: np.ndarray | None = None) -> np.ndarray:
        """Residuals [N] at coordinates [P], those of trajectories that ``keep`` [S] leaves out 0."""
        rows = self.problem.rows(self.base, self.coordinates, x[None])
        return self.problem.residuals(rows, None if keep is None else keep[None])[0]

    def jacobian(
        self, x: np.ndarray, keep: np.ndarray | None = None, widen: float = 1.0
    ) -> np.ndarray:
        """d(predicted)/dx [P, N] at coordinates [P] by one-sided differences, their steps times a factor."""
        steps = np.empty(len(x))
        for i, c in enumerate(self.coordinates):
            steps[i] = c.step(float(x[i]), widen)
        moved = np.vstack([x, x + np.diag(steps)])
        rows = self.problem.rows(self.base, self.coordinates, moved)
        mask = None if keep is None else np.repeat(keep[None], len(moved), axis=0)
        residuals = self.problem.residuals(rows, mask, self.problem.slopes)
        return (residuals[0] - residuals[1:]) / steps[:, None]

    def descend(
        self,
        start: np.ndarray,
        iterations: int,
        keep: np.ndarray | None = None,
        slopes: np.ndarray | None = None,
        widen: float = 1.0,
    ) -> np.ndarray:
        """Coordinates [P] of a local minimum.

        Args:
            start: Where to start [P].
            iterations: Trials at most.
            keep: Trajectories that count [S]; all by default.
            slopes: A Jacobian [P, N] to keep.
            widen: Factor on finite-difference steps.
        """
        # In units of what is left, by which the first step may change the prediction at most.
        left = max(float(np.linalg.norm(self.residuals(start, keep))), 1e-12)

        def residuals(moved: np.ndarray) -> np.ndarray:
            return np.concatenate([self.residuals(start + moved, keep), self.pull * moved]) / left

        def jacobian(moved: np.ndarray) -> np.ndarray:
            rows = self.jacobian(start + moved, keep, widen) if slopes is None else slopes
            return np.vstack([-rows.T, self.pull * np.eye(len(start))]) / left

        solution = least_squares(
            residuals,
            np.zeros(len(start)),
            jacobian,
            bounds=(self.lower - start, self.upper - start),
            method="dogbox",
            x_scale="jac",
            ftol=TOLERANCE,
            gtol=None,
            max_nfev=iterations,
        )
        return np.clip(start + solution.x, self.lower, self.upper)

    def best(self, starts: Sequence[np.ndarray], iterations: int) -> np.ndarray:
        """Coordinates [P] of the least minimum from several starts [P].

        The worse half ends early.
        """
        left = list(starts)
        while len(left) > 1:
            ends = [self.descend(x, SHORT) for x in left]
            ends.sort(key=lambda x: float(np.sum(self.residuals(x) ** 2)))
            left = ends[: (len(ends) + 1) // 2]
        x = self.descend(left[0], iterations)
        return self.descend(x, iterations, widen=WIDEN)


class Problems:
    """The problems of a recording, made when they are first asked for.

    Args:
        recording: The recording.
        chains: Its chains.
        dt: Time step of the rollouts [s].
        device: Warp device.
    """

    def __init__(self, recording: Recording, chains: Sequence[Chain], dt: float, device: str):
        self.recording = recording
        self.chains = chains
        self.dt = dt
        self.device = device
        self._rollouts: dict[tuple[int, int | None], Rollouts] = {}
        self._problems: dict[tuple[int, int], JointProblem] = {}

    def of(self, spec: JointSpec) -> JointProblem:
        """The problem of a joint."""
        key = (spec.chain, spec.joint)
        if key not in self._problems:
            # Whole trajectories are shared by the joints of a chain, pieces are each joint's own.
            shared = (spec.chain, spec.joint if spec.pieces else None)
            if shared not in self._rollouts:
                parts = dict(zip(spec.trajectories, spec.pieces, strict=bool(spec.pieces)))
                recording = self.recording.cut(parts)
                chain = self.chains[spec.chain]
                self._rollouts[shared] = Rollouts(chain, recording, dt=self.dt, device=self.device)
            self._problems[key] = JointProblem(self._rollouts[shared], spec)
        return self._problems[key]
