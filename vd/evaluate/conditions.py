"""Conditions to evaluate a policy in, by name, whatever its training.

Those of ``vd-eval --condition``.
"""

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Literal

from vd.envs.cfg import RandomisationCfg, ReorientCfg, TrackedPoseCfg
from vd.paper import PAPER

_MATERIALS = PAPER.materials
_FRICTION = PAPER.randomisation.friction


def _at(value: float) -> tuple[float, float]:
    """The range that is one value."""
    return value, value


EXACT = RandomisationCfg(
    stiffness_scale=_at(1.0),
    damping_scale=_at(1.0),
    link_mass_scale=_at(1.0),
    friction=_at(_MATERIALS.friction),
    table_friction=_at(_MATERIALS.table_friction),
    object_scale=_at(1.0),
    object_scale_count=1,
    object_mass_kg=_at(_MATERIALS.object_mass_kg),
    action_noise_std=0.0,
    observation_noise_mean=0.0,
    observation_noise_std=0.0,
    force_probability=0.0,
)
"""Nothing varies: the base of conditions that change one thing."""
_only = partial(replace, EXACT)
STEP_LATE_S = 1.0 / PAPER.scene.control_hz
"""One control step, 83 ms: a camera and the loop behind it are this late at worst."""
_LATE = _at(STEP_LATE_S)
FRICTION_NM = 0.15
"""Largest dry friction of a joint [N m] (ours; identified servos have up to half)."""
PLAY_RAD = 0.03
"""Largest backlash of a joint [rad] (ours; identified servos have up to half)."""
COMMAND_DELAY_S = 0.04
"""Largest delay of commands [s] (ours): the motor bus."""
OBSERVATION_LATENCY_S = 0.12
"""Largest latency of the object [s] (ours): depth camera and its loop."""

MASS_KG = (0.03, 0.18)
"""The paper's base range of the object's mass [kg]."""
OFF_CENTRE_M = 0.01
"""How far the centre of mass is off [m] (ours): objects are 10 to 16 cm long."""

TRACKED_POSE = TrackedPoseCfg(rate_hz=(10.0, 30.0))
"""A tracker outside, as vd-deploy --pose has it."""
_MIXED = RandomisationCfg(
    effects={
        "command_delay.delay_s": (0.0, COMMAND_DELAY_S),
        "coulomb_friction.tau_c_nm": (0.0, FRICTION_NM),
        "backlash.width_rad": (0.0, PLAY_RAD),
    },
    observation_latency_s=(0.0, OBSERVATION_LATENCY_S),
)

_NAMED: dict[str, tuple[str, RandomisationCfg]] = {
    "nominal": ("nothing", _only(enabled=False)),
    "s3": ("all of Table S3", RandomisationCfg()),
    "hard": (
        "Table S3, forces last a control step",
        RandomisationCfg(force_s=1.0 / PAPER.scene.control_hz),
    ),
    "mixed": (
        "Table S3, friction, backlash, late commands, late object",
        _MIXED,
    ),
    "hora": (
        "sizes, masses, centres of mass and frictions about as HORA draws them, and Table S3",
        RandomisationCfg(
            friction=(0.3, 3.0),
            object_mass_kg=(0.01, 0.25),
            object_scale=(0.8, 1.2),
            object_scale_count=5,
            object_com_m=OFF_CENTRE_M,
        ),
    ),
    "tracked": (
        "object seen by a tracker: late, 10 to 30 Hz, gaps and jumps",
        _only(tracked_pose=TRACKED_POSE),
    ),
    "mixed-tracked": (
        "mixed, and the object seen by a tracker",
        replace(_MIXED, observation_latency_s=_at(0.0), tracked_pose=TRACKED_POSE),
    ),
    "observation-late": (
        f"object seen {STEP_LATE_S:.3f} s late",
        _only(observation_latency_s=_LATE),
    ),
    "all-late": (
        f"object and joints seen {STEP_LATE_S:.3f} s late",
        _only(observation_latency_s=_LATE, encoder_latency_s=_LATE),
    ),
    "command-late": (
        f"commands {STEP_LATE_S:.3f} s late",
        _only(effects={"command_delay.delay_s": _LATE}),
    ),
    "joint-friction": (
        f"friction of {FRICTION_NM:g} N m in every joint",
        _only(effects={"coulomb_friction.tau_c_nm": _at(FRICTION_NM)}),
    ),
    "light": (f"objects of {MASS_KG[0]:g} kg", _only(object_mass_kg=_at(MASS_KG[0]))),
    "heavy": (f"objects of {MASS_KG[1]:g} kg", _only(object_mass_kg=_at(MASS_KG[1]))),
    "slippery": (
        f"friction of hand and object {_FRICTION[0]:g}",
        _only(friction=_at(_FRICTION[0])),
    ),
    "grippy": (f"friction of hand and object {_FRICTION[1]:g}", _only(friction=_at(_FRICTION[1]))),
    "sizes": (
        "objects of five sizes, from the smallest to the largest of the hand's file",
        _only(object_sizes=5),
    ),
    "off-centre": (f"centre of mass {OFF_CENTRE_M:g} m off", _only(object_com_m=OFF_CENTRE_M)),
    "soft-tips": ("soft fingertips", _only(enabled=False)),
    "stiff-contacts": ("contacts twice as stiff, physics steps half as long", _only(enabled=False)),
}
"""What is changed, in words, and what is drawn; two changes are no draws (:func:`in_condition`)."""
CHANGED = {name: words for name, (words, _) in _NAMED.items()}
"""What each condition changes, in words."""
CONDITIONS = {name: drawn for name, (_, drawn) in _NAMED.items()}
"""What is drawn in each."""
if TYPE_CHECKING:
    Condition = str
else:
    Condition = Literal[tuple(CONDITIONS)]


def in_condition(task: ReorientCfg, name: Condition) -> ReorientCfg:
    """A task with what a condition changes beside the draws.

    The fingertips, or how stiff contacts are.
    """
    if name == "soft-tips":
        return replace(task, fingertip="soft")
    if name == "stiff-contacts":  # two physics steps are the least time constant
        sim = replace(
            task.sim,
            physics_hz=2.0 * task.sim.physics_hz,
            contact_time_constant_s=0.5 * task.sim.contact_time_constant_s,
        )
        return replace(task, sim=sim)
    return task
