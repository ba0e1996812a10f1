"""Hidden effects at four sizes: parameters at which the gap is a given multiple of the noise floor.

The gap is what remains after the base parameters have done their best, to first order: the difference
between the plant with and without the effect, less its projection on the sensitivities of stiffness,
damping, speed limit (and a bare servo's inertia and gravity). ``calibrate`` measures; :data:`SIZES`
holds its answers for the paper's excitation, so that nothing has to be measured again.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from vd.bench.gap_sizes_table import SCALES
from vd.bench.hidden_plant import OUTSIDE, Plant, Run, simulate
from vd.bench.hide import Hiding, effect_parameters, machine, noise_floor
from vd.gap.excitations import excitation_set
from vd.kernels.servo.effects import EFFECTS

GAPS = (1.5, 3.0, 6.0, 12.0)
"""Root-mean-square residual of the refitted base model, in noise floors."""
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
STRENGTHS = np.geomspace(0.002, 65.0, 16)
"""Multiples of the typical strength that calibration tries."""
FIXED = {"acceleration_limit": (0.05, 0.15, 0.45, 1.35)}
"""Strengths of what shows at every size that a firmware would have: at 1000 rad/s^2 a step of 2 rad is
still 90 ms late. These are 600, 200, 67 and 22 rad/s^2."""
ABSORBED = {("servo", "payload_inertia"), ("pendulum", "payload_inertia")}
"""What the base parameters of a model are."""
CALIBRATION_STEP_S = 8.0e-4
"""Twice the plant's step: sizes need two digits."""
NUDGE = 0.02
"""Relative change of a base parameter for its sensitivity."""
MODELS = ("servo", "pendulum", "dclaw3")


def effect_at(name: str, strength: float) -> dict[str, float]:
    """Parameters of an effect at a multiple of its typical strength, within the searched bounds."""
    values = effect_parameters(name)
    if name == "gravity_load":
        values["phase_rad"] = PHASE_RAD
    if name == "elastic_transmission":
        values["k_nm_rad"] = SPRING_NM_RAD
    bounds = {p.name: (p.lower, p.upper) for p in EFFECTS[name].parameters} if name in EFFECTS else {}
    for key, value in values.items():
        scaled = value * strength ** WEAKER.get((name, key), 1.0)
        values[key] = float(np.clip(scaled, *bounds.get(key, (-np.inf, np.inf))))
    return values


def sized_effect(name: str, size: int, model: str = "dclaw3") -> dict[str, float]:
    """Parameters of an effect at one of four sizes.

    Args:
        name: Effect, of the table or outside.
        size: 0 .. 3, a gap of about 1.5, 3, 6, 12 noise floors; less where the effect cannot do more.
        model: ``dclaw3`` (also for ``dclaw4``), ``servo`` or ``pendulum``.

    Raises:
        ValueError: The effect is unknown, or cannot show on the model.
    """
    effect_parameters(name)
    scales = SCALES["dclaw3" if model.startswith("dclaw") else model].get(name)
    if scales is None:
        raise ValueError(f"{name} does not show on a {model}; choose another effect or model")
    return effect_at(name, scales[size])


def showing(model: str) -> tuple[str, ...]:
    """The effects of the table that can show on a model under the paper's excitation."""
    scales = SCALES["dclaw3" if model.startswith("dclaw") else model]
    return tuple(name for name in EFFECTS if name in scales)


def calibrate(model: str, name: str) -> tuple[float, ...] | None:
    """Strengths at which an effect leaves gaps of :data:`GAPS`; None if it never reaches the second.

    Where the largest gap is out of reach, the strength of the largest reached takes its place.
    """
    if (model, name) in ABSORBED:
        return None
    if name in FIXED:
        return FIXED[name]
    base = Hiding(model=model, base_spread=0.0)
    reach, plain = machine(base, np.random.default_rng(0))
    motions = excitation_set(reach)
    variants = [plain, *nudged(plain)]
    for strength in STRENGTHS:
        hiding = replace(base, effects={name: effect_at(name, float(strength))})
        variants.append(machine(hiding, np.random.default_rng(0))[1])
    per_motion = []
    for kind in dict.fromkeys(motion.name for motion in motions):  # equally long, so one batch each
        group = [(number, motion) for number, motion in enumerate(motions) if motion.name == kind]
        runs = [
            Run(plant, motion.time, motion.command, motion.enabled, motion.conditions, 8.0 * number, number)
            for number, motion in group
            for plant in variants
        ]
        paths = simulate(runs, dt=CALIBRATION_STEP_S)
        for i, (_, motion) in enumerate(group):
            joint = plain.joints.index(motion.joints[0])
            part = paths[i * len(variants) : (i + 1) * len(variants)]
            per_motion.append((joint, np.stack([path[:, joint] for path in part])))
    nudges = len(nudged(plain))
    answers = np.concatenate([path for _, path in per_motion], axis=1)
    owner = np.concatenate([np.full(path.shape[1], joint) for joint, path in per_motion])
    sensitivity = answers[1 : 1 + nudges] - answers[0]
    columns = np.concatenate([sensitivity * (owner == j) for j in range(len(plain.joints))]).T
    columns = columns[:, np.abs(columns).max(axis=0) > 0.0]
    basis, _ = np.linalg.qr(columns)
    difference = (answers[1 + nudges :] - answers[0]).T
    left = difference - basis @ (basis.T @ difference)
    gap = np.sqrt(np.mean(left**2, axis=0)) / noise_floor()
    return _inverse(gap)


def _inverse(gap: np.ndarray) -> tuple[float, ...] | None:
    """Strengths of the wanted gaps, by interpolation up to the first maximum."""
    rising = np.maximum.accumulate(gap)
    found: list[float] = []
    for wanted in GAPS:
        alone = np.sqrt(wanted**2 - 1.0)  # the noise adds its own floor
        above = np.flatnonzero(rising >= alone)
        if not len(above):
            if len(found) < 2:
                return None
            found.append(float(STRENGTHS[int(np.argmax(gap))]))
            continue
        i = int(above[0])
        if i == 0:
            found.append(float(STRENGTHS[0]))
            continue
        low = max(rising[i - 1], 1e-3)  # an effect that is off leaves nothing, which has no logarithm
        share = np.log(alone / low) / np.log(rising[i] / low)
        found.append(float(STRENGTHS[i - 1] * (STRENGTHS[i] / STRENGTHS[i - 1]) ** share))
    return tuple(round(value, 5) for value in found)


def nudged(plant: Plant) -> list[Plant]:
    """The plant with each base parameter that an identification fits raised a little."""
    names = ["kp", "kd", "velocity_limit"]
    if plant.body is None:
        names += ["inertia"]
        if plant.gravity_torque.any():
            names += ["gravity_torque"]
    return [replace(plant, **{name: getattr(plant, name) * (1.0 + NUDGE)}) for name in names]


def main() -> None:
    """Measure every effect on every model, and print the table."""
    for model in MODELS:
        print(f'    "{model}": {{', flush=True)
        for name in (*EFFECTS, *OUTSIDE):
            scales = calibrate(model, name)
            if scales is not None:
                print(f'        "{name}": {scales},', flush=True)
        print("    },", flush=True)


if __name__ == "__main__":
    main()
