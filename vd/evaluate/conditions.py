"""Conditions to evaluate a policy in, by name, whatever its training: those of ``vd-eval --condition``."""

from dataclasses import replace
from typing import Literal

from vd.envs.cfg import RandomisationCfg, ReorientCfg
from vd.paper import PAPER

_MATERIALS = PAPER.materials
_FRICTION = PAPER.randomisation.friction
EXACT = RandomisationCfg(
    stiffness_scale=(1.0, 1.0),
    damping_scale=(1.0, 1.0),
    link_mass_scale=(1.0, 1.0),
    friction=(_MATERIALS.friction, _MATERIALS.friction),
    table_friction=(_MATERIALS.table_friction, _MATERIALS.table_friction),
    object_scale=(1.0, 1.0),
    object_scale_count=1,
    object_mass_kg=(_MATERIALS.object_mass_kg, _MATERIALS.object_mass_kg),
    action_noise_std=0.0,
    observation_noise_mean=0.0,
    observation_noise_std=0.0,
    force_probability=0.0,
)
"""Nothing varies: the base of conditions that change one thing."""
STEP_LATE_S = 1.0 / PAPER.scene.control_hz
"""One control step, 83 ms: a camera and the loop behind it are this late at worst."""
FRICTION_NM, PLAY_RAD = 0.15, 0.03
"""Largest dry friction [N m] and backlash [rad] of a joint (ours; identified servos have up to half)."""
COMMAND_DELAY_S, OBSERVATION_LATENCY_S = 0.04, 0.12
"""Largest delay of commands, latency of the object [s] (ours): motor bus; depth camera and its loop."""

MASS_KG = (0.03, 0.18)
"""The paper's base range of the object's mass [kg]."""
OFF_CENTRE_M = 0.01
"""How far the centre of mass is off [m] (ours): objects are 10 to 16 cm long."""
POSE_ERROR = (0.005, 0.1)
"""Errors of the object's pose [m] [rad] (ours), all through an episode: a bad registration."""

_LATE = (STEP_LATE_S, STEP_LATE_S)

Condition = Literal[
    "nominal",
    "s3",
    "hard",
    "mixed",
    "observation-late",
    "all-late",
    "command-late",
    "joint-friction",
    "light",
    "heavy",
    "slippery",
    "grippy",
    "off-centre",
    "soft-tips",
    "stiff-contacts",
    "pose-error",
]
CONDITIONS: dict[Condition, RandomisationCfg] = {
    "nominal": replace(EXACT, enabled=False),
    "s3": RandomisationCfg(),
    "hard": RandomisationCfg(force_s=1.0 / PAPER.scene.control_hz),
    "mixed": RandomisationCfg(
        effects={
            "command_delay.delay_s": (0.0, COMMAND_DELAY_S),
            "coulomb_friction.tau_c_nm": (0.0, FRICTION_NM),
            "backlash.width_rad": (0.0, PLAY_RAD),
        },
        observation_latency_s=(0.0, OBSERVATION_LATENCY_S),
    ),
    "observation-late": replace(EXACT, observation_latency_s=_LATE),
    "all-late": replace(EXACT, observation_latency_s=_LATE, encoder_latency_s=_LATE),
    "command-late": replace(EXACT, effects={"command_delay.delay_s": _LATE}),
    "joint-friction": replace(EXACT, effects={"coulomb_friction.tau_c_nm": (FRICTION_NM, FRICTION_NM)}),
    "light": replace(EXACT, object_mass_kg=(MASS_KG[0], MASS_KG[0])),
    "heavy": replace(EXACT, object_mass_kg=(MASS_KG[1], MASS_KG[1])),
    "slippery": replace(EXACT, friction=(_FRICTION[0], _FRICTION[0])),
    "grippy": replace(EXACT, friction=(_FRICTION[1], _FRICTION[1])),
    "off-centre": replace(EXACT, object_com_m=OFF_CENTRE_M),
    "soft-tips": replace(EXACT, enabled=False),
    "stiff-contacts": replace(EXACT, enabled=False),
    "pose-error": replace(EXACT, object_pose_error=POSE_ERROR),
}
"""Nothing drawn; Table S3; the same with forces that last a control step; Table S3, friction, backlash, late
commands and a late object; the object, object and joints, commands a control step late; then one thing each,
of which two are no draws (:func:`in_condition`)."""


def in_condition(task: ReorientCfg, name: Condition) -> ReorientCfg:
    """A task with what a condition changes beside the draws: the fingertips, or how stiff contacts are."""
    if name == "soft-tips":
        return replace(task, fingertip="soft")
    if name == "stiff-contacts":  # two physics steps are the least time constant
        hz, constant_s = 2.0 * task.sim.physics_hz, 0.5 * task.sim.contact_time_constant_s
        return replace(task, sim=replace(task.sim, physics_hz=hz, contact_time_constant_s=constant_s))
    return task
