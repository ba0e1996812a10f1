"""What the data can carry.

Noise floor, bootstrap over trajectories, intervals that allow for few of them.

Residuals within a trajectory are strongly correlated, so the unit of every interval is the
trajectory, never the sample.
"""

import numpy as np
from scipy.stats import chi2
from scipy.stats import t as student

from vd.logs.motions import FLICKER_COUNTS, Recording, Trajectory
from vd.logs.recording_checks import MIN_SAMPLES

CONFIDENCE = 0.95
"""Of every interval: the field's custom."""
OWN_ERROR = 0.02
"""A model's own error, as a share of the whole gap and of each parameter: no fit of a large effect
is better. Beside a friction of 97 noise floors a second effect came with a share of 0.015 that was
not there. Of 178 parameters of the development battery 96 % are in their 95 % intervals, with half
of it 93, twice 98 %.
"""
REPEATABLE = 2.0
"""Error, in noise floors, up to which residuals are held against noise alone, and no phase of
motion or model in question stands out. A real machine that is farther from it does not repeat its
motions that well; how well is not known from one recording of each."""
BOOTSTRAP = 2000
"""Resamples of whole trajectories. Not tuned: quantiles are known to half a percent."""
SMOOTH_S = 0.05
"""Window over which speeds are taken [s]: longer than an encoder count at low speed. Not tuned."""
HOLD_S = 0.25
"""The command must have been constant for this long before a sample counts as held. Not tuned."""


def speed_of(time: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Speed over ``SMOOTH_S`` [T] [rad/s], without the noise of encoder counts."""
    before = np.interp(time - 0.5 * SMOOTH_S, time, position)
    after = np.interp(time + 0.5 * SMOOTH_S, time, position)
    return (after - before) / SMOOTH_S


def held(trajectory: Trajectory, joint: int, resolution: float) -> np.ndarray:
    """Samples at which command and position both rest, shape [T] bool."""
    time = trajectory.time
    command = trajectory.command[:, joint]
    first = np.searchsorted(time, time - HOLD_S)
    changes = np.cumsum(np.diff(command, prepend=command[0]) != 0.0)
    still = (changes == changes[first]) & (time >= HOLD_S)
    # Averages of the two halves of the window: slow motion moves them, noise does not.
    window = np.arange(len(time)) - first
    half = max(int(np.median(window)) // 2, 1)
    smooth = np.convolve(trajectory.position[:, joint], np.full(half, 1.0 / half))
    smooth = smooth[: len(time)]
    travel = np.full(len(time), np.inf)
    travel[2 * half :] = np.abs(smooth[2 * half :] - smooth[half:-half])
    return still & (travel < FLICKER_COUNTS * resolution)


def noise_floor(recording: Recording, joint: int) -> float:
    """Smallest RMS residual that a perfect model can have on a joint [rad].

    The largest of the encoder's quantisation, of the noise in second differences at rest (which do
    not contain it while noise is less than a count), and of what a parabola leaves of slow motion
    (which contains both).
    """
    resolution = recording.encoder_resolution_rad
    resting: list[float] = []
    moving: list[float] = []
    for trajectory in recording.trajectories:
        position = trajectory.position[:, joint]
        rest = held(trajectory, joint, resolution)[1:-1]
        second = np.diff(position, 2)[rest]
        resting += (second**2 / 6.0).tolist()  # of white noise of variance 1
        moving += _slow_noise(trajectory.time, position, resolution)
    variances = [resolution**2 / 12.0]  # of a uniform error of one count
    if len(resting) >= MIN_SAMPLES:
        variances.append(float(np.mean(resting)))
    if len(moving) >= MIN_SAMPLES:
        # Motion disturbs many windows: the lower quartile, as far below the mean as of white noise.
        freedom = MIN_SAMPLES - 3
        low = float(chi2.ppf(0.25, freedom)) / freedom
        variances.append(float(np.quantile(moving, 0.25)) / low)
    return float(np.sqrt(max(variances)))


def _slow_noise(time: np.ndarray, position: np.ndarray, resolution: float) -> list[float]:
    """Variances about a parabola in windows of slow steady motion [rad^2].

    At most two counts a sample.
    """
    result = []
    for first in range(0, len(time) - MIN_SAMPLES + 1, MIN_SAMPLES):
        here = position[first : first + MIN_SAMPLES]
        since = time[first : first + MIN_SAMPLES] - time[first]
        travel = abs(here[-1] - here[0]) / resolution
        if FLICKER_COUNTS < travel <= 2 * MIN_SAMPLES:
            left = here - np.polyval(np.polyfit(since, here, 2), since)
            result.append(float(left @ left) / (MIN_SAMPLES - 3))
    return result


def resamples(units: int, rng: np.random.Generator) -> np.ndarray:
    """Weights of the units in each bootstrap resample, [BOOTSTRAP, units].

    Every row sums to ``units``.
    """
    return rng.multinomial(units, np.full(units, 1.0 / units), size=BOOTSTRAP).astype(float)


def interval(samples: np.ndarray) -> tuple[float, float]:
    """Central 95 % interval of bootstrap samples."""
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(samples, [tail, 100.0 - tail])
    return float(low), float(high)


def rmse(sse: np.ndarray, count: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Root mean square over trajectories.

    Args:
        sse: Sum of squared errors of each trajectory, shape [..., S].
        count: Samples of each trajectory, shape [S].
        weights: Weights of the trajectories, shape [R, S]; the result then has a last axis R.
    """
    if weights is None:
        weights = np.ones(len(count))
    return np.sqrt(sse @ weights.T / (weights @ count))


def half_width(variance: np.ndarray, units: float) -> np.ndarray:
    """Half the 95 % interval of estimates, their variance from ``units`` parts of the data."""
    quantile = float(student.ppf(0.5 + 0.5 * CONFIDENCE, max(units - 1, 1)))
    return quantile * np.sqrt(np.maximum(variance, 0.0))
