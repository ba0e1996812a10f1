"""Configuration to device memory: the parameter structs that kernels read and curricula change."""

from typing import Any

import numpy as np
import warp as wp

from vd.assets_usd.hand_data import HandModel
from vd.envs.cfg import ReorientCfg
from vd.envs.curriculum import Stage, blend
from vd.kernels.task.actions import ActionParams
from vd.kernels.task.observations import ObservationParams
from vd.kernels.task.randomisation import ForceParams, RandomisationParams
from vd.kernels.task.resets import GoalParams, StartParams
from vd.kernels.task.rewards import FINGERTIP_MEAN, FINGERTIP_SQUARED_SUM, RewardParams
from vd.kernels.task.success import SuccessParams
from vd.paper import PAPER

STILLNESS_START = 12.0
"""Factor on the four stillness thresholds at difficulty 0 (ours): what moving fingers can keep."""
GOAL_START_RAD = 1.0
"""Largest goal angle at difficulty 0 [rad] (ours)."""
LIFT_M = 0.02
"""Height from which more is worth nothing [m]; as far as a finger can give way without a fall."""


class TaskParameters:
    """All parameter structs of the task, each an array of length 1 on the device.

    Arrays because a CUDA graph bakes scalar arguments in; a curriculum writes into them instead.
    """

    def __init__(self, cfg: ReorientCfg, hand: HandModel, device: Any):
        """Put the configuration at full difficulty on ``device``."""
        self.cfg, self._hand = cfg, hand
        random = cfg.randomisation
        on = 1.0 if random.enabled else 0.0

        def array(struct_type: Any, **values: Any) -> wp.array:
            struct = struct_type()
            for name, value in values.items():
                setattr(struct, name, value)
            return wp.array([struct], dtype=struct_type, device=device)

        self.action = array(
            ActionParams,
            alpha=cfg.action.ema_alpha,
            step_rad=cfg.action.scale_rad_s * cfg.sim.control_dt,
            noise_std=on * random.action_noise_std,
        )
        self.observation, self.exact_observation = (
            array(
                ObservationParams,
                velocity_scale=PAPER.observation.velocity_scale,
                noise_mean=noise * random.observation_noise_mean,
                noise_std=noise * random.observation_noise_std,
                file_axes=float(cfg.observation.file_axes),
                canonical=float(cfg.observation.canonical),
            )
            for noise in (on, 0.0)
        )
        self.start = array(
            StartParams,
            position=wp.vec3(*hand.workspace.drop_m),
            noise=PAPER.scene.object_start_noise_m,
        )
        self.force = array(
            ForceParams,
            probability=on * random.force_probability,
            # Of the impulse that is asked for, whatever the physics step.
            force_per_mass=random.force_n_per_kg
            * random.force_s
            / (random.force_steps(cfg.sim) * cfg.sim.physics_dt),
            decay=random.force_decay,
        )
        materials = PAPER.materials

        def span(value: tuple[float, float], nominal: float) -> wp.vec2:
            return wp.vec2(*value) if random.enabled else wp.vec2(nominal, nominal)

        self.randomisation = array(
            RandomisationParams,
            friction=span(random.friction, materials.friction),
            link_mass_scale=span(random.link_mass_scale, 1.0),
            action_offset_std=on * random.action_offset_std,
            observation_offset_std=on * random.observation_offset_std,
        )
        self.reward = array(RewardParams)
        self.success = array(SuccessParams)
        self.goal = array(GoalParams)
        self.weight = wp.ones(1, dtype=float, device=device)
        """Share of its weight that an object which has to be lifted has, shape [1]."""
        self._staging = {
            name: getattr(self, name).numpy() for name in ("reward", "success", "goal")
        }
        self.set_stage(Stage())

    def set_stage(self, stage: Stage) -> None:
        """Write reward, success and goal parameters for a stage of the curriculum."""
        cfg, difficulty = self.cfg, stage.difficulty
        loose = cfg.curriculum.tightening
        # Thresholds shrink geometrically: each step of difficulty tightens by the same factor.
        slack = STILLNESS_START ** (1.0 - difficulty)
        start = min(GOAL_START_RAD, cfg.goal.max_angle_rad)
        reward, success = cfg.reward, cfg.success

        def threshold(tightest: float, loosest: float) -> float:
            return slack * blend(loosest, tightest, stage.tightness) if tightest > 0.0 else 0.0

        self._write(
            "reward",
            success=reward.success,
            rotation=reward.rotation,
            rotation_epsilon=reward.rotation_epsilon_rad,
            fingertip=reward.fingertip,
            fingertip_form=FINGERTIP_MEAN
            if reward.fingertip_mean_distance
            else FINGERTIP_SQUARED_SUM,
            energy=reward.energy * difficulty,
            energy_clip=reward.energy_clip_w,
            fall=reward.fall,
            table_contact=reward.table_contact,
            table_contact_force=PAPER.reward.table_contact_force_n,
            fingertip_height=0.0 if self._hand.palm_up else PAPER.reward.fingertip_height,
            height_limit=PAPER.reward.fingertip_height_m,
            progress=reward.progress,
            lift=reward.lift,
            lift_height=LIFT_M,
            scale=reward.scale,
        )
        self._write(
            "success",
            rotation=blend(loose.rotation_rad, success.rotation_rad, stage.tightness),
            joint_speed=threshold(success.joint_speed_rad_s, loose.joint_speed_rad_s),
            object_speed=threshold(success.object_speed_m_s, loose.object_speed_m_s),
            object_spin=threshold(success.object_spin_rad_s, loose.object_spin_rad_s),
            action_norm=threshold(success.action_norm, loose.action_norm),
            table_contact_force=PAPER.reward.table_contact_force_n,
            fall_distance=success.fall_of(self._hand.workspace),
            fall_center=np.array(self._hand.workspace.goal_m, dtype=np.float32),
        )
        self._write(
            "goal",
            max_angle=start + (cfg.goal.max_angle_rad - start) * difficulty,
            about_vertical=int(cfg.goal.about_vertical),
        )

        self.weight.fill_(blend(loose.object_weight, 1.0, stage.tightness))

    def _write(self, name: str, **values: Any) -> None:
        staging = self._staging[name]
        for field, value in values.items():
            staging[field][0] = value
        getattr(self, name).assign(staging)
