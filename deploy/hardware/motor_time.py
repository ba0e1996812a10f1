"""When states were measured, by the clocks of the motors themselves.

Between a program and its motors lie an adapter, a driver and a scheduler, which pass a packet on when they
come to it: milliseconds later on a busy machine. A recording says when something was measured, and the
motors know: each has a clock of its own in its state.
"""

import numpy as np
from scipy.stats import theilslopes

from vd.deploy.hardware.control_table import TICK_MODULUS

TICK_S = 1e-3
"""Motors count whole milliseconds, each from a moment of its own: the mean of nine is as good as 0.1 ms."""
SAMPLES = 200
"""By which two clocks are compared."""


def measured_at(asked_s: np.ndarray, ticks: np.ndarray) -> np.ndarray:
    """Times of states on this computer's clock.

    Args:
        asked_s: When each was asked for [T] [s].
        ticks: What the motors' clocks said [T, D] [ms], which start again at their modulus.

    Returns:
        When each was measured [T] [s]: as long after it was asked for as most of them were.
    """
    gone = np.diff(ticks, axis=0) % TICK_MODULUS
    own = np.concatenate([[0.0], TICK_S * gone.mean(axis=1).cumsum()])
    # The rates of two clocks differ; a share of the packets that comes late must not count. All pairs of some
    # samples: those of all take longer than a hand may wait for its loop.
    some = np.unique(np.linspace(0, len(own) - 1, SAMPLES).astype(int))
    rate, begin, *_ = theilslopes((asked_s - own)[some], own[some])
    return np.asarray(own * (1.0 + rate) + begin)
