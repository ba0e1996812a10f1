"""Conditions to evaluate a policy in, by name, whatever its training: those of ``vd-eval --condition``."""

from dataclasses import replace
from typing import Literal

from vd.envs.cfg import RandomisationCfg
from vd.paper import PAPER

_MATERIALS = PAPER.materials
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

_LATE = (STEP_LATE_S, STEP_LATE_S)

Condition = Literal["nominal", "s3", "hard", "mixed", "observation-late", "all-late", "command-late"]
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
}
"""Nothing drawn; Table S3; the same with forces that last a control step; Table S3, friction, backlash, late
commands and a late object; and 83 ms late and nothing else: the object, object and joints, commands."""
