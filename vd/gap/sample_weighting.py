"""How samples of a recording are weighted, so that a model can be fitted beside delays that vary."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class SampleWeighting:
    """The mean and the spread that random delays, or errors of the clock, add to N samples.

    A sample counts by how surely it is known: a residual, less the mean of what delays do, is divided by the
    growth of its standard deviation. What a right model leaves is the noise floor again.

    Attributes:
        shift: Mean change of the position [N] [rad].
        growth: Standard deviation with them, in that of the noise alone [N].
    """

    shift: np.ndarray
    growth: np.ndarray
