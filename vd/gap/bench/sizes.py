"""Hidden effects at four sizes: parameters at which the gap is a given multiple of the noise floor.

The gap is what remains after the base parameters have done their best under the paper's excitation:
1.5, 3, 6 and 12 noise floors, root mean square.
"""

from collections.abc import Mapping

import numpy as np

from vd.gap.bench.hide import effect_parameters
from vd.kernels.servo.effects import EFFECTS

WEAKER: Mapping[tuple[str, str], float] = {
    ("acceleration_limit", "a_max_rad_s2"): -1.0,
    ("torque_limit", "tau_max_nm"): -1.0,
    ("torque_speed_limit", "tau_stall_nm"): -1.0,
    ("torque_speed_limit", "omega_0_rad_s"): -0.5,
    ("torque_saturation", "tau_s_nm"): -1.0,
    ("stribeck_friction", "v_s_rad_s"): 0.0,
    ("gravity_load", "phase_rad"): 0.0,
    ("cogging", "per_turn"): 0.0,
    ("cable_spring", "slack_rad"): 0.0,
    ("temperature_friction", "time_s"): 0.0,
}
"""Exponents with which parameters follow the strength of their effect; 1 where absent."""
PHASE_RAD = 0.4
"""Phase of a hidden gravity load: a centre of mass off the link's axis."""
SPRING_NM_RAD = 1.0
"""Stiffness of a hidden transmission: soft enough to ring within a finger servo's bandwidth.
It follows the strength as inertia and damping do, so that the resonance stays where it is."""
SCALES: dict[str, dict[str, tuple[float, ...]]] = {
    "servo": {
        "command_delay": (0.0969, 0.24814, 0.54933, 1.22729),
        "read_delay": (0.09688, 0.24851, 0.54919, 1.22776),
        "command_jitter": (0.05615, 0.16669, 0.36421, 0.68638),
        "command_filter": (0.05888, 0.28067, 0.48637, 0.80049),
        "acceleration_limit": (0.05, 0.15, 0.45, 1.35),
        "torque_limit": (0.23442, 0.39956, 0.67253, 1.19224),
        "torque_speed_limit": (0.311, 0.45361, 0.59184, 0.74712),
        "torque_saturation": (0.42031, 0.76506, 1.32181, 2.38744),
        "supply_sag": (0.36519, 0.92859, 1.9712, 4.1002),
        "thermal_drift": (4.63612, 10.07627, 17.33059, 26.21214),
        "coulomb_friction": (0.05065, 0.12823, 0.26855, 0.54408),
        "stribeck_friction": (0.03533, 0.08939, 0.18695, 0.37734),
        "load_friction": (1.05552, 2.28092, 3.57072, 4.72435),
        "asymmetric_friction": (0.03966, 0.1002, 0.20927, 0.42224),
        "backlash": (0.05455, 0.13848, 0.29069, 0.59091),
        "dead_zone": (0.05624, 0.14238, 0.29821, 0.60423),
        "integral_action": (0.01462, 0.03749, 0.07994, 0.16617),
        "encoder_bias": (0.02994, 0.07574, 0.15842, 0.32022),
        "gravity_load": (0.05866, 0.1485, 0.31102, 0.63026),
        "elastic_transmission": (0.10246, 0.27852, 0.64284, 1.43247),
        "cogging": (0.08126, 0.20607, 0.43271, 0.88068),
        "cable_spring": (0.00957, 0.02426, 0.05098, 0.10396),
        "temperature_friction": (0.02705, 0.06847, 0.14335, 0.29025),
    },
    "dclaw3": {
        "command_delay": (0.02603, 0.06566, 0.1371, 0.27813),
        "read_delay": (0.02582, 0.06539, 0.13687, 0.27812),
        "command_jitter": (0.02873, 0.07122, 0.14252, 0.29233),
        "command_filter": (0.01072, 0.02718, 0.05719, 0.11865),
        "acceleration_limit": (0.05, 0.15, 0.45, 1.35),
        "torque_limit": (0.32709, 0.48086, 0.7917, 1.43384),
        "torque_speed_limit": (0.36144, 0.43672, 0.5076, 0.64032),
        "torque_saturation": (0.59877, 0.94087, 1.57347, 2.86598),
        "supply_sag": (0.58051, 1.26476, 2.41737, 4.55459),
        "thermal_drift": (1.01463, 2.41583, 4.6112, 8.13569),
        "coulomb_friction": (0.05572, 0.14131, 0.29659, 0.6026),
        "stribeck_friction": (0.03807, 0.09663, 0.20282, 0.41162),
        "load_friction": (0.21865, 0.55416, 1.14276, 2.15998),
        "asymmetric_friction": (0.04737, 0.1201, 0.25198, 0.51187),
        "backlash": (0.05521, 0.14043, 0.29586, 0.60414),
        "dead_zone": (0.06395, 0.16216, 0.34051, 0.69288),
        "integral_action": (0.00876, 0.02308, 0.0519, 0.12022),
        "encoder_bias": (0.03549, 0.08978, 0.18778, 0.37957),
        "gravity_load": (0.07977, 0.20192, 0.42278, 0.85637),
        "payload_inertia": (0.09471, 0.23873, 0.49671, 0.99524),
        "elastic_transmission": (0.06665, 0.17173, 0.3689, 0.77381),
        "joint_coupling": (0.0357, 0.08985, 0.18619, 0.36933),
        "cogging": (0.07999, 0.20243, 0.42368, 0.85863),
        "cable_spring": (0.01009, 0.02558, 0.05371, 0.1094),
        "temperature_friction": (0.03941, 0.09998, 0.20998, 0.42718),
    },
}
"""Model and effect to strengths of the four sizes, as multiples of typical parameters; an effect
that cannot show on a model is absent. Measured to first order against the base parameters' own
sensitivities. An acceleration limit shows at every size that a firmware would have: its are 600,
200, 67 and 22 rad/s^2.
"""


def effect_at(name: str, strength: float) -> dict[str, float]:
    """Parameters of an effect at a multiple of its typical strength, within the searched bounds."""
    values = effect_parameters(name)
    if name == "gravity_load":
        values["phase_rad"] = PHASE_RAD
    if name == "elastic_transmission":
        values["k_nm_rad"] = SPRING_NM_RAD
    bounds = (
        {p.name: (p.lower, p.upper) for p in EFFECTS[name].parameters} if name in EFFECTS else {}
    )
    for key, value in values.items():
        scaled = value * strength ** WEAKER.get((name, key), 1.0)
        values[key] = float(np.clip(scaled, *bounds.get(key, (-np.inf, np.inf))))
    return values


def sized_effect(name: str, size: int, model: str = "dclaw3") -> dict[str, float]:
    """Parameters of an effect at one of four sizes.

    Args:
        name: Effect, of the table or outside.
        size: 0 .. 3, a gap of about 1.5, 3, 6, 12 noise floors; less where the effect cannot do
            more.
        model: ``dclaw3`` (also for ``dclaw4``) or ``servo``.

    Raises:
        ValueError: The effect cannot show on the model.
    """
    scales = SCALES["dclaw3" if model.startswith("dclaw") else model].get(name)
    if scales is None:
        raise ValueError(f"{name} does not show on a {model}; choose another effect or model")
    return effect_at(name, scales[size])


def showing(model: str) -> tuple[str, ...]:
    """The effects of the table that can show on a model under the paper's excitation."""
    scales = SCALES["dclaw3" if model.startswith("dclaw") else model]
    return tuple(name for name in EFFECTS if name in scales)
