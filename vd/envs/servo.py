"""Which servo models the environments draw.

A hand layer's values and intervals, Table S3, chosen effects.
"""

import numpy as np

from vd.assets_usd.hand_data import HandModel
from vd.envs.cfg import RandomisationCfg
from vd.envs.effects import PARAMETERS
from vd.kernels.servo import actuators
from vd.sim.joint_servo import has_effects


def gain_scales(hand: HandModel, cfg: RandomisationCfg) -> tuple[np.ndarray, np.ndarray]:
    """Ranges of the factors on stiffness and damping, [D, 2] each.

    The 95 % interval where the hand's layer has one, or else the configured range around the
    nominal value.
    """
    scales = []
    for column, nominal, span in (
        (actuators.KP, hand.kp, cfg.stiffness_scale),
        (actuators.KD, hand.kd, cfg.damping_scale),
    ):
        interval = hand.servo_interval[:, column] / nominal[:, None]
        scale = np.where(np.isnan(interval), span, interval)
        scales.append(scale if cfg.enabled else np.ones_like(scale))
    return scales[0], scales[1]


def servo_ranges(hand: HandModel, cfg: RandomisationCfg) -> np.ndarray:
    """Range (low, high) from which each parameter of each joint is drawn, [D, P, 2].

    Equal ends are fixed.

    Raises:
        ValueError: An effect to draw lacks a parameter without which it cannot be.
    """
    ranges = np.repeat(hand.servo[:, :, None], 2, axis=2)
    if cfg.enabled:
        ranges = np.where(np.isnan(hand.servo_interval), ranges, hand.servo_interval)
        for name, span in cfg.effects.items():
            ranges[:, PARAMETERS[name].column] = span
        _check_complete(ranges, cfg)
    return ranges


def plain_servos(hand: HandModel, ranges: np.ndarray) -> np.ndarray:
    """What each parameter of each joint is where nothing is drawn yet, [D, P, 2].

    A parameter for which the hand's own value is no possible one, such as a torque limit that is
    off at zero, has no way from there: it is as drawn, ``ranges`` [D, P, 2], all along.
    """
    plain = ranges.copy()
    for parameter in PARAMETERS.values():
        own = hand.servo[:, parameter.column]
        possible = (np.abs(own) >= parameter.lower) & (np.abs(own) <= parameter.upper)
        plain[possible, parameter.column] = own[possible, None]
    return plain


def needs_servo(ranges: np.ndarray) -> bool:
    """Whether any joint in any environment has more than a plain drive.

    Stiffness and damping are randomised in the plain model too; a speed limit or an armature that
    differs between environments takes the servo.
    """
    drives = ranges[:, [actuators.VELOCITY_LIMIT, actuators.INERTIA]]
    return has_effects(np.moveaxis(ranges, 2, 0)) or bool(np.any(drives[..., 0] != drives[..., 1]))


def _check_complete(ranges: np.ndarray, cfg: RandomisationCfg) -> None:
    """Refuse an effect of which a parameter that has to be positive is left at zero."""
    for name in cfg.effects:
        effect = name.partition(".")[0]
        for other, parameter in PARAMETERS.items():
            if other.partition(".")[0] != effect or parameter.lower <= 0.0:
                continue
            if (ranges[:, parameter.column, 0] <= 0.0).any():
                raise ValueError(
                    f"randomisation.effects has {name} but not {other}; give its range too"
                )
