"""The table of effects: names, parameters, units, neutral values and where they can lie.

A contract that scripts rely on: effect and parameter names are those of USD attributes, reports and
command lines. Physics: :mod:`vd.kernels.servo.actuators`.
"""

from dataclasses import dataclass

import vd.kernels.servo.actuators as servo


@dataclass(frozen=True)
class Parameter:
    """One number of a joint's servo model."""

    name: str  # in USD, reports and on command lines
    unit: str  # SI
    column: int  # of the parameter row
    lower: float  # smallest value searched; an estimate at a bound is no estimate
    upper: float  # largest value searched
    typical: float  # a size at which the effect matters in a hand's servo, where searches start
    neutral: float = 0.0  # value at which it does nothing
    signed: bool = False  # whether the negative range is searched too

    @property
    def of_torque(self) -> bool:
        """Whether it is a torque, or what torques are divided by: a stiffness, an inertia."""
        return "N m" in self.unit or "kg" in self.unit


@dataclass(frozen=True)
class Effect:
    """A physical effect that the plain servo model lacks."""

    name: str  # in USD, reports and on command lines
    meaning: str  # one line for people
    parameters: tuple[Parameter, ...]


BASELINE = (
    Parameter("kp", "N m/rad", servo.KP, 1e-3, 1e3, 3.0),
    Parameter("kd", "N m s/rad", servo.KD, 1e-5, 1e2, 0.3),
    Parameter("velocity_limit", "rad/s", servo.VELOCITY_LIMIT, 0.05, 100.0, 7.0, neutral=1e6),
    Parameter("inertia", "kg m^2", servo.INERTIA, 1e-6, 10.0, 1e-3),
    Parameter("kd_off", "N m s/rad", servo.OFF_DAMPING, 0.0, 1e2, 0.0),
)
"""The paper's identification; the inertia (the drive's armature) is fitted for bare servos only, as
is ``kd_off``, the damping that is left with the torque off, where a recording has such motion."""

EFFECTS: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        Effect(
            "command_delay",
            "transport delay between command and servo",
            (Parameter("delay_s", "s", servo.COMMAND_DELAY, 0.0, 0.3, 0.02),),
        ),
        Effect(
            "read_delay",
            "the recorded position is old, or stamped early",
            (Parameter("delay_s", "s", servo.READ_DELAY, 0.0, 0.3, 0.02),),
        ),
        Effect(
            "command_jitter",
            "the delay varies from command to command, and some commands are dropped",
            (
                Parameter("sigma_s", "s", servo.JITTER_SIGMA, 0.0, 0.2, 0.02),
                Parameter("p_drop", "1", servo.JITTER_DROP, 0.0, 0.9, 0.1),
            ),
        ),
        Effect(
            "command_filter",
            "first-order low-pass on the command",
            (Parameter("tau_s", "s", servo.FILTER_TAU, 0.0, 1.0, 0.05),),
        ),
        Effect(
            "acceleration_limit",
            "profile acceleration in the firmware",
            (Parameter("a_max_rad_s2", "rad/s^2", servo.ACCELERATION_LIMIT, 0.5, 1e3, 30.0),),
        ),
        Effect(
            "torque_limit",
            "hard limit of torque or current",
            (Parameter("tau_max_nm", "N m", servo.TORQUE_LIMIT, 1e-3, 50.0, 0.5),),
        ),
        Effect(
            "torque_speed_limit",
            "the available torque falls with speed (back-EMF, supply)",
            (
                Parameter("tau_stall_nm", "N m", servo.STALL_TORQUE, 1e-3, 50.0, 1.0),
                Parameter("omega_0_rad_s", "rad/s", servo.NO_LOAD_SPEED, 0.1, 100.0, 5.0),
            ),
        ),
        Effect(
            "torque_saturation",
            "soft loss at high torque, tau_s tanh(tau / tau_s)",
            (Parameter("tau_s_nm", "N m", servo.SATURATION_TORQUE, 1e-3, 50.0, 1.0),),
        ),
        Effect(
            "supply_sag",
            "the voltage falls with the current: tau / (1 + r |tau|)",
            (Parameter("relative", "1/(N m)", servo.SUPPLY_SAG, 0.0, 50.0, 0.5),),
        ),
        Effect(
            "thermal_drift",
            "the gain falls as the motor warms, exp(-rate t)",
            (Parameter("rate_per_s", "1/s", servo.THERMAL_RATE, 0.0, 0.5, 0.01),),
        ),
        Effect(
            "coulomb_friction",
            "constant friction",
            (Parameter("tau_c_nm", "N m", servo.COULOMB_TORQUE, 0.0, 5.0, 0.05),),
        ),
        Effect(
            "stribeck_friction",
            "breakaway above sliding friction, with a speed scale",
            (
                Parameter("tau_s_nm", "N m", servo.STRIBECK_STATIC, 0.0, 5.0, 0.1),
                Parameter("tau_c_nm", "N m", servo.STRIBECK_SLIDING, 0.0, 5.0, 0.03),
                Parameter("v_s_rad_s", "rad/s", servo.STRIBECK_SPEED, 0.01, 10.0, 0.2, neutral=1.0),
            ),
        ),
        Effect(
            "load_friction",
            "friction in proportion to the torque carried",
            (Parameter("k_load", "1", servo.LOAD_FRICTION, 0.0, 0.95, 0.15),),
        ),
        Effect(
            "asymmetric_friction",
            "friction that differs between the two directions",
            (
                Parameter("tau_plus_nm", "N m", servo.FRICTION_PLUS, 0.0, 5.0, 0.08),
                Parameter("tau_minus_nm", "N m", servo.FRICTION_MINUS, 0.0, 5.0, 0.03),
            ),
        ),
        Effect(
            "backlash",
            "play at reversals",
            (Parameter("width_rad", "rad", servo.BACKLASH_WIDTH, 0.0, 0.5, 0.03),),
        ),
        Effect(
            "dead_zone",
            "the controller ignores small errors",
            (Parameter("width_rad", "rad", servo.DEAD_ZONE_WIDTH, 0.0, 0.5, 0.03),),
        ),
        Effect(
            "integral_action",
            "the loop creeps to its target",
            (Parameter("k_i", "N m/(rad s)", servo.INTEGRAL_GAIN, 0.0, 100.0, 2.0),),
        ),
        Effect(
            "encoder_bias",
            "constant offset of the recorded position",
            (Parameter("bias_rad", "rad", servo.ENCODER_BIAS, 0.0, 0.5, 0.02, signed=True),),
        ),
        Effect(
            "gravity_load",
            "mass or centre of mass of the links wrong, -tau_g sin(q + phase)",
            (
                Parameter("tau_g_nm", "N m", servo.GRAVITY_TORQUE, 0.0, 10.0, 0.05),
                Parameter("phase_rad", "rad", servo.GRAVITY_PHASE, 0.0, 3.2, 0.0, signed=True),
            ),
        ),
        Effect(
            "payload_inertia",
            "inertia beyond the model's",
            (Parameter("j_kgm2", "kg m^2", servo.PAYLOAD_INERTIA, 0.0, 1.0, 2e-3),),
        ),
        Effect(
            "elastic_transmission",
            "a second mass behind a spring",
            (
                Parameter("k_nm_rad", "N m/rad", servo.ELASTIC_STIFFNESS, 1e-2, 1e3, 3.0),
                Parameter("c_nms_rad", "N m s/rad", servo.ELASTIC_DAMPING, 0.0, 1.0, 5e-3),
                Parameter("j_kgm2", "kg m^2", servo.ELASTIC_INERTIA, 1e-6, 1.0, 2e-3, neutral=1e-3),
            ),
        ),
        Effect(
            "joint_coupling",
            "the motion of another joint of the chain drives this one",
            tuple(
                Parameter(
                    f"from_{i + 1}", "rad/rad", servo.COUPLING_0 + i, 0.0, 1.0, 0.05, signed=True
                )
                for i in range(servo.MAX_JOINTS)
            ),
        ),
    )
}
"""Every effect by name, in the order in which a signal meets them, roughly."""


EQUIVALENT: dict[str, tuple[str, ...]] = {"command_delay": ("read_delay",)}
"""Effects that stand for others which leave the same positions, whatever the motion.

A servo that does not change with time, and is commanded rather than steered by what it reports,
shifts its whole motion in time either way. By convention the shift is one of the command.
"""

ON_A_PENDULUM: dict[str, tuple[str, ...]] = {"encoder_bias": ("gravity_load",)}
"""Nearly the same on a pendulum, whose own load is part of the plain model: whether its zero is not
where the arm hangs, or a further load hangs off the arm, moves it alike but for how the load
changes with the angle.
"""


def equivalent(model: str) -> dict[str, tuple[str, ...]]:
    """Effects that stand for others in a recording of a ``model``."""
    return {**EQUIVALENT, **ON_A_PENDULUM} if model == "pendulum" else {**EQUIVALENT}


TOGETHER: dict[str, tuple[str, ...]] = {
    "asymmetric_friction": ("coulomb_friction", "encoder_bias"),
}
"""Effects that are the same as two others together: friction that differs between the directions is
friction that does not, and an offset."""


def neutral_row() -> list[float]:
    """A parameter row with every effect off and no drive, ``PARAMETER_COLUMNS`` values."""
    row = [0.0] * servo.PARAMETER_COLUMNS
    for parameter in (*BASELINE, *(p for effect in EFFECTS.values() for p in effect.parameters)):
        row[parameter.column] = parameter.neutral
    return row
