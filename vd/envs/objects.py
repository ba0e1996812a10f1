"""Which objects the worlds hold: how many worlds of each, and of which sizes."""

from collections.abc import Sequence

import numpy as np

from vd.envs.cfg import FocusCfg, RandomisationCfg

_NAMED = 3
"""Objects that an error names."""


def object_weights(names: Sequence[str], focus: FocusCfg) -> np.ndarray | None:
    """Share of the worlds for each object, their sum 1, shape [K]; None where all get the same.

    With failure rates f of K objects, and the share s of the worlds that goes by failure:
    (1 - s) / K + s f / sum(f).

    Args:
        names: K names, in the order of the objects.
        focus: Success rates and share.

    Raises:
        ValueError: An object has no success rate.
    """
    if not focus.success or focus.share == 0.0:
        return None
    missing = [name for name in names if name not in focus.success]
    if missing:
        raise ValueError(
            f"focus.success has no rate of {len(missing)} of the {len(names)} objects "
            f"({', '.join(missing[:_NAMED])}); evaluate on all that are trained on"
        )
    failure = 1.0 - np.array([focus.success[name] for name in names])
    if not failure.any():
        return None
    return (1.0 - focus.share) / len(names) + focus.share * failure / failure.sum()


def object_scales(random: RandomisationCfg) -> list[float]:
    """Size factors of the objects; 1 alone where nothing is randomised."""
    if not random.enabled:
        return [1.0]
    return [float(scale) for scale in np.linspace(*random.object_scale, random.object_scale_count)]
