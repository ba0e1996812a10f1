"""Sizes of the objects that the environments hold."""

import numpy as np

from vd.envs.cfg import RandomisationCfg


def object_scales(random: RandomisationCfg) -> list[float]:
    """Size factors of the objects; 1 alone where nothing is randomised."""
    if not random.enabled:
        return [1.0]
    return [float(scale) for scale in np.linspace(*random.object_scale, random.object_scale_count)]
