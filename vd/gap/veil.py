"""What random delays do to a recording's samples, so that the rest of a model can be fitted through them."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Veil:
    """The mean and the spread that chance adds to N samples.

    Seen through it a sample counts by how surely it is known: a residual, less the mean of what chance does,
    is divided by the growth of its standard deviation. What a right model leaves is the noise floor again.

    Attributes:
        shift: Mean change of the position [N] [rad].
        growth: Standard deviation with chance, in that of the noise alone [N].
    """

    shift: np.ndarray
    growth: np.ndarray
