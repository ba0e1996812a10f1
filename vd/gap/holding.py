"""Joints that hold while others move: what friction and play keep of the error of their first reading."""

from collections.abc import Sequence

import numpy as np

from vd.gap.recording import Recording

STILL_COUNTS = 0.05
"""Encoder counts within which a prediction stands still."""


class Holding:
    """The trajectories in which a joint's command never changes.

    A rollout starts at the first reading. Where dry friction holds the joint, the prediction stays there,
    with the reading's error of up to a count, although the model is right; and so does the middle of what
    play or a dead zone leave free, however the joint is shaken within.

    Args:
        recording: The recording.
        column: The joint's column in it.
        trajectories: Indices of the trajectories that are used.
    """

    def __init__(self, recording: Recording, column: int, trajectories: Sequence[int] | np.ndarray):
        parts = {int(t): recording.trajectories[int(t)] for t in trajectories}
        self._holds = {t: not np.ptp(part.command[:, column]) for t, part in parts.items()}
        self._length = {t: len(part.time) for t, part in parts.items()}
        self._least = STILL_COUNTS * recording.encoder_resolution_rad

    def forgive(
        self, residual: np.ndarray, predicted: np.ndarray, chosen: Sequence[int], free: np.ndarray
    ) -> None:
        """Take the mean from the residuals [C, N] of held motions, as far as the start can be its cause.

        Args:
            residual: Measured minus predicted, trajectory by trajectory; changed in place.
            predicted: Predicted positions [C, N] [rad].
            chosen: Indices of the trajectories.
            free: Width in which nothing holds the joint [C] [rad]; all of a mean can be the start's where the
                prediction stands still.
        """
        ends = np.cumsum([self._length[t] for t in chosen])[:-1]
        parts = zip(chosen, np.split(residual, ends, axis=1), np.split(predicted, ends, axis=1), strict=True)
        for trajectory, part, path in parts:
            if self._holds[trajectory]:
                still = np.ptp(path, axis=1) < self._least
                most, mean = np.where(still, np.inf, free), part.mean(axis=1)
                part -= np.clip(mean, -most, most)[:, None]
