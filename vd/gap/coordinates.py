"""Coordinates in which the servo model is fitted, and sizes at which the search for an effect starts."""

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

import vd.kernels.servo.actuators as servo
from vd.kernels.servo.effects import BASELINE, EFFECTS, Parameter

GRAVITY, _ = EFFECTS["gravity_load"].parameters
PARAMETERS: dict[str, Parameter] = {p.name: p for p in (*BASELINE, GRAVITY)}
"""Everything that can be fitted, by key: ``kp`` of a baseline, ``effect.parameter`` of effects."""
for _effect in EFFECTS.values():
    for _parameter in _effect.parameters:
        PARAMETERS[f"{_effect.name}.{_parameter.name}"] = _parameter

LOG_STEP = 0.01
"""Finite-difference step of a logarithmic coordinate: above the noise of single precision. Not
tuned.
"""
LINEAR_STEP = 0.05
"""The same of a linear coordinate, in its scale or in its value if that is larger. Not tuned."""
SLOWING = (
    "torque_limit",
    "torque_speed_limit",
    "torque_saturation",
    "supply_sag",
    "acceleration_limit",
)
"""Effects whose work a speed limit does in part."""
SMOOTHING = ("command_filter", "elastic_transmission")
"""Effects whose work a free inertia does in part: a lag is a lag, on which side of the motor it
is.
"""
LIGHT = 0.1
"""An inertia that does none of it, in fitted ones. Not tuned."""
FREE_SPEED = 3.0
"""A speed limit that does not bind, in largest speeds. Not tuned; without starts there the XL330
keeps 45 mrad for 30 at one gain."""

STARTS: dict[str, tuple[str, tuple[float, ...]]] = {
    "command_delay.delay_s": ("period", (0.3, 1.0, 3.0, 6.0)),
    "read_delay.delay_s": ("period", (0.3, 1.0, 3.0, 6.0)),
    "command_filter.tau_s": ("period", (0.3, 1.0, 3.0, 10.0)),
    "acceleration_limit.a_max_rad_s2": ("acceleration", (2.0, 1.0, 0.5, 0.25, 0.1)),
    "torque_limit.tau_max_nm": ("peak", (0.9, 0.6, 0.35, 0.2)),
    "torque_speed_limit.tau_stall_nm": ("peak", (1.0, 1.0, 0.5, 0.5, 0.25)),
    "torque_speed_limit.omega_0_rad_s": ("speed", (1.1, 2.0, 1.2, 2.5, 1.5)),
    "torque_saturation.tau_s_nm": ("peak", (1.5, 0.7, 0.35, 0.2)),
    "supply_sag.relative": ("sag", (0.1, 0.4, 1.2, 4.0)),
    "thermal_drift.rate_per_s": ("rate", (0.1, 0.5, 1.5)),
    "coulomb_friction.tau_c_nm": ("torque", (0.03, 0.1, 0.3, 0.7)),
    "stribeck_friction.tau_s_nm": ("torque", (0.1, 0.3, 0.3, 0.7)),
    "stribeck_friction.tau_c_nm": ("torque", (0.02, 0.1, 0.05, 0.2)),
    "stribeck_friction.v_s_rad_s": ("speed", (0.05, 0.05, 0.2, 0.05)),
    "load_friction.k_load": ("one", (0.05, 0.15, 0.4)),
    "asymmetric_friction.tau_plus_nm": ("torque", (0.1, 0.03, 0.4, 0.1)),
    "asymmetric_friction.tau_minus_nm": ("torque", (0.03, 0.1, 0.1, 0.4)),
    "backlash.width_rad": ("residual", (0.7, 2.0, 5.0)),
    "dead_zone.width_rad": ("residual", (0.7, 2.0, 5.0)),
    "integral_action.k_i": ("kp", (0.1, 0.5, 2.0, 8.0)),
    "encoder_bias.bias_rad": ("residual", (0.5, -0.5, 1.5, -1.5)),
    "gravity_load.tau_g_nm": ("torque", (0.1, 0.1, 0.1, 0.1, 0.5, 0.5, 0.5, 0.5)),
    "gravity_load.phase_rad": ("one", (0.0, 1.57, -1.57, 3.1, 0.0, 1.57, -1.57, 3.1)),
    "payload_inertia.j_kgm2": ("inertia", (0.1, 0.5, 2.0)),
    "elastic_transmission.k_nm_rad": ("kp", (0.3, 0.3, 1.0, 1.0, 3.0, 3.0)),
    "elastic_transmission.c_nms_rad": ("damping", (0.03, 0.03, 0.1, 0.1, 0.3, 0.3)),
    "elastic_transmission.j_kgm2": ("inertia", (0.3, 0.6, 0.3, 1.0, 0.3, 2.0)),
}
"""Where the search for an effect starts: the unit of each parameter, and multiples of it. Those of one
effect belong together. Not tuned."""


@dataclass(frozen=True)
class Coordinate:
    """One fitted number: value = exp(x) or x times scale.

    Attributes:
        key: ``kp``, or ``effect.parameter``.
        column: Column of the parameter row.
        log: Whether x is the logarithm.
        scale: Value at x = 1 of a linear coordinate.
        lower: Smallest x.
        upper: Largest x.
    """

    key: str
    column: int
    log: bool
    scale: float
    lower: float
    upper: float

    def value(self, x: np.ndarray | float) -> np.ndarray:
        """Parameter values at coordinates."""
        return np.exp(x) if self.log else np.asarray(x) * self.scale

    def inverse(self, value: float) -> float:
        """Coordinate of a parameter value, within the bounds."""
        x = math.log(max(value, 1e-12)) if self.log else value / self.scale
        return min(max(x, self.lower), self.upper)

    def step(self, x: float, widen: float = 1.0) -> float:
        """Finite-difference step at x, times a factor.

        The other way where it would leave the bounds.
        """
        size = widen * (LOG_STEP if self.log else LINEAR_STEP * max(1.0, abs(x)))
        return size if self.lower <= x + size <= self.upper else -size

    def bound(self, x: float) -> bool:
        """Whether x is at the far end of its range.

        0 of an effect and half a turn are values like others.
        """
        if self.column == servo.GRAVITY_PHASE:
            return False
        margin = 1e-3 * (self.upper - self.lower)
        return x > self.upper - margin or (self.log and x < self.lower + margin)


@dataclass(frozen=True)
class Scales:
    """Sizes of a joint's motion, from which searches start.

    Attributes:
        kp: Stiffness [N m/rad].
        torque: Typical torque of the drive [N m].
        peak: Largest torque of the drive [N m].
        speed: Largest speed, noise aside [rad/s].
        acceleration: Largest acceleration, noise aside [rad/s^2].
        inertia: Effective inertia [kg m^2].
        residual: RMS of what the baseline leaves [rad].
        duration: Of the longest trajectory [s].
    """

    kp: float
    torque: float
    peak: float
    speed: float
    acceleration: float
    inertia: float
    residual: float
    duration: float


def coordinate(key: str, scales: Scales) -> Coordinate:
    """The coordinate of a parameter by its key."""
    parameter = PARAMETERS[key]
    if parameter.lower > 0.0:
        bounds = math.log(parameter.lower), math.log(parameter.upper)
        return Coordinate(key, parameter.column, True, 1.0, *bounds)
    scale = _scale(parameter, scales)
    low = -parameter.upper if parameter.signed else 0.0
    return Coordinate(key, parameter.column, False, scale, low / scale, parameter.upper / scale)


def torque_power(key: str) -> int:
    """Power with which a parameter follows the unit of torque: 1, 0, or -1."""
    parameter = PARAMETERS[key]
    return -1 if parameter.unit == "1/(N m)" else int(parameter.of_torque)


def keys_of(effects: Collection[str]) -> list[str]:
    """Keys of the parameters of effects, in the order of the table."""
    return [key for key in PARAMETERS if key.rpartition(".")[0] in effects]


def values_of(row: np.ndarray, keys: Iterable[str]) -> dict[str, float]:
    """Values of some parameters in a row [PARAMETER_COLUMNS], by key."""
    return {key: float(row[PARAMETERS[key].column]) for key in keys}


def _scale(parameter: Parameter, scales: Scales) -> float:
    if parameter.unit == "N m":
        return max(0.3 * scales.torque, 1e-4)
    if parameter.column in (servo.BACKLASH_WIDTH, servo.DEAD_ZONE_WIDTH, servo.ENCODER_BIAS):
        return scales.residual
    if parameter.column == servo.OFF_DAMPING:
        return 0.1 * max(scales.torque, 1e-4) / scales.speed
    if parameter.column == servo.SUPPLY_SAG:
        return 0.3 / max(scales.peak, 1e-6)
    if parameter.column == servo.INTEGRAL_GAIN:
        return scales.kp
    if parameter.column == servo.PAYLOAD_INERTIA:
        return max(0.3 * scales.inertia, 1e-6)
    if parameter.column == servo.THERMAL_RATE:
        return 0.3 / scales.duration
    return parameter.typical if parameter.typical > 0.0 else 1.0


def sizes(effect: str, others: Sequence[int], scales: Scales) -> list[dict[str, float]]:
    """Starting values of an effect's parameters, by key, from small to large.

    Args:
        effect: Name of the effect.
        others: Slots of the other joints of the chain.
        scales: Sizes of the joint's motion.
    """
    if effect == "joint_coupling":
        blank = dict.fromkeys([f"{effect}.from_{slot + 1}" for slot in others], 0.0)
        return [{**blank, key: factor} for key in blank for factor in (0.05, -0.05)]
    period = EFFECTS["command_delay"].parameters[0].typical
    units = {
        **vars(scales),
        "one": 1.0,
        "period": period,
        "damping": scales.kp * period,
        "sag": 1.0 / scales.peak,
        "rate": 1.0 / scales.duration,
    }
    names = keys_of([effect])
    columns = []
    for key in names:
        unit, factors = STARTS[key]
        values = units[unit] * np.array(factors)
        inside = np.clip(values, PARAMETERS[key].lower, PARAMETERS[key].upper)
        columns.append(np.where(values > 0.0, inside, values))
    starts = [dict(zip(names, row, strict=True)) for row in np.transpose(columns).tolist()]
    also = {}
    if effect in SLOWING:
        # The baseline's speed limit took the effect's place: let go of it as well.
        also["velocity_limit"] = FREE_SPEED * scales.speed
    if effect in SMOOTHING:
        also["inertia"] = LIGHT * scales.inertia
    return starts + [start | also for start in starts if also]
