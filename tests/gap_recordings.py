"""Recordings of a servo that is simulated, and fits that are made up, for the tests of the gap workflow."""

from dataclasses import replace
from pathlib import Path

import numpy as np

import vd.kernels.servo.actuators as servo
from vd.gap.chain import chains
from vd.gap.coordinates import Coordinate, keys_of
from vd.gap.design import design
from vd.gap.fit import JointFit, JointProblem, JointSpec
from vd.gap.rollout import Rollouts
from vd.gap.statistics import noise_floor
from vd.gap.workflow import baseline_of
from vd.logs.recording import Recording, Trajectory

ENCODER_COUNT = 2.0 * np.pi / 4096
TRUE = {servo.KP: 3.0, servo.KD: 0.25, servo.VELOCITY_LIMIT: 7.0, servo.INERTIA: 2.5e-3}
"""Columns of the servo that every recording is of."""
FLOOR = 1e-3
"""Noise floor of fits that are made up [rad]."""
COUNT = np.full(10, 500.0)
"""Samples of their trajectories."""


def blank(gains: tuple[float, ...] = (), model: str = "servo") -> Recording:
    """Two steps and three sines of one joint, at each gain, without an answer."""
    time = np.arange(0.0, 3.0, 0.01)
    step = np.where(time > 0.3, 0.8, 0.0) - np.where(time > 1.6, 1.3, 0.0)
    motions = {"step": step, "step_small": 0.2 * step}
    for size, hertz in ((0.7, 0.3), (0.7, 0.8), (0.6, 1.5)):
        motions[f"sine_{hertz}"] = size * np.sin(2 * np.pi * hertz * time)
    parts = [
        Trajectory(
            file=f"{name}_{gain}.csv",
            excitation=name,
            joints=("j",),
            conditions={} if gain is None else {"p_gain": gain},
            time=time,
            command=command[:, None],
            position=np.zeros((len(time), 1)),
            enabled=np.ones((len(time), 1), bool),
        )
        for name, command in motions.items()
        for gain in gains or (None,)
    ]
    return Recording(Path("made up"), model, ("j",), {}, ENCODER_COUNT, tuple(parts))


def recorded(extra: dict[int, float], noise: float = 3e-4, model: str = "servo") -> Recording:
    """What the servo with ``extra`` columns would have answered."""
    recording = blank(model=model)
    (chain,) = chains(recording)
    rollouts = Rollouts(chain, recording)
    path = rollouts.predict(true_row(chain.start_row, extra)[None])[0].astype(float)
    path += np.random.default_rng(0).normal(0.0, noise, path.shape)
    path = np.round(path / ENCODER_COUNT) * ENCODER_COUNT
    parts = [
        replace(t, position=path[rollouts.sample_trajectory == i])
        for i, t in enumerate(recording.trajectories)
    ]
    return replace(recording, trajectories=tuple(parts))


def true_row(start: np.ndarray, extra: dict[int, float]) -> np.ndarray:
    """Rows of a chain of one joint with the columns of the servo and others [1, PARAMETER_COLUMNS]."""
    row = start.copy()
    for column, value in {**TRUE, **extra}.items():
        row[0, column] = value
    return row


def problem_of(recording: Recording) -> JointProblem:
    """What is to be fitted on the only joint of a recording."""
    (chain,) = chains(recording)
    trajectories, folds, _ = design(recording, chain, 0)
    spec = JointSpec(0, 0, trajectories, folds, noise_floor(recording, 0), baseline_of(chain))
    return JointProblem(Rollouts(chain, recording), spec)


def made_up(
    effects: tuple[str, ...], errors: np.ndarray | float, fitted: float | None = None
) -> JointFit:
    """A fit with given held-out RMSE of each trajectory, and on what was fitted [rad]."""
    held_out = COUNT * np.broadcast_to(errors, COUNT.shape) ** 2
    keys = ["p0", "p1", "p2", *keys_of(effects)]
    size = len(keys)
    return JointFit(
        effects=effects,
        coordinates=tuple(Coordinate(key, i, False, 1.0, -9.0, 9.0) for i, key in enumerate(keys)),
        x=np.array([float("." in key) for key in keys]),
        rows=np.zeros((1, servo.PARAMETER_COLUMNS)),
        sse=held_out if fitted is None else COUNT * fitted**2,
        absolute=held_out,
        held_out=held_out,
        held_out_abs=held_out,
        count=COUNT,
        gram=10.0 * np.eye(size),
        refits=np.zeros((2, size)),
        step_error=np.zeros(size),
    )
