"""Whether a friction that a model takes for constant changes from motion to motion.

Dry friction falls as grease warms, which none of the effects does: one value for all motions is then near the
noise floor on most of them, and what it leaves is made up for by a play or a coupling that are not there.
"""

import numpy as np

from vd.gap.fit import RIDGE
from vd.gap.joint_fit import JointFit
from vd.gap.recording import Recording
from vd.gap.statistics import covariance, half_width

LEVELS = {
    "coulomb_friction": ("tau_c_nm",),
    "stribeck_friction": ("tau_s_nm", "tau_c_nm"),
    "asymmetric_friction": ("tau_plus_nm", "tau_minus_nm"),
    "load_friction": ("k_load",),
}
"""Parameters of each friction that change together."""
LEAST = 0.2
"""Change over a recording, as a share of the friction, that is more than a model may miss."""
SURE = 2.0
"""Half widths of its 95 % interval that it is from 0 at least: all frictions of all joints are looked at."""


def middles(recording: Recording) -> np.ndarray:
    """When each trajectory was half way, if they followed each other as they are listed [T] [s]."""
    lengths = np.array([float(trajectory.time[-1]) for trajectory in recording.trajectories])
    return np.cumsum(lengths) - 0.5 * lengths


def change(fit: JointFit, friction: str, when: np.ndarray, floor: float) -> tuple[float, float]:
    """Change of a friction from the first motion to the last, as a share of it, and half its 95 % interval.

    To first order, from the matrices of the fit: a further coordinate scales the friction in proportion to
    the time, and the others are readjusted.

    Args:
        fit: The model.
        friction: One of its effects.
        when: Time of each trajectory [S] [s].
        floor: Noise floor [rad].
    """
    keys = {f"{friction}.{name}" for name in LEVELS[friction]}
    slope = [
        (1.0 if c.log else float(x)) if c.key in keys else 0.0
        for c, x in zip(fit.coordinates, fit.x, strict=True)
    ]
    size = len(slope)
    basis = np.zeros((len(when), size, size + 1))
    basis[:, :, :size] = np.eye(size)
    basis[:, :, size] = ((when - when.mean()) / max(float(np.ptp(when)), 1e-9))[:, None] * slope
    gram = np.einsum("spa,spq,sqb->sab", basis, fit.gram, basis)
    gradient = np.einsum("spa,sp->sa", basis, fit.gradient)
    ridge = np.full(size + 1, RIDGE * floor**2)
    share = np.linalg.solve(gram.sum(0) + np.diag(ridge), gradient.sum(0))[size]
    width = half_width(np.diag(covariance(gram, gradient, ridge, floor)), len(when))[size]
    return float(share), float(width)


def warming(fit: JointFit, when: np.ndarray, floor: float) -> str:
    """Which friction of a model is sure to change over the recording, in words; empty if none is."""
    for name in (effect for effect in fit.effects if effect in LEVELS):
        share, width = change(fit, name, when, floor)
        if abs(share) - width > LEAST and abs(share) > SURE * width:
            way = "falls" if share < 0.0 else "rises"
            return f"{name} {way} over the recording by {100.0 * abs(share):.0f} % of its mean"
    return ""
