"""Hidden effects at four sizes: parameters at which the gap is a given multiple of the noise floor.

The gap is what remains after the base parameters have done their best under the paper's excitation:
1.5, 3, 6 and 12 noise floors, root mean square.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml

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
SCALES: dict[str, dict[str, list[float]]] = yaml.safe_load(
    Path(__file__).with_name("sizes.yaml").read_text()
)
"""Strengths of the four sizes, as multiples of typical parameters, by model and effect."""


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
