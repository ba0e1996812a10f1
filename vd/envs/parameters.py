"""Configuration to device memory: the parameter structs that kernels read and curricula change."""

from typing import Any

import numpy as np
import warp as wp

from vd.assets_usd.hand_data import HandModel
from vd.envs.cfg import ReorientCfg
from vd.envs.curriculum import Levels, blend
from vd.envs.setup import chosen, table_steps
from vd.kernels.task.actions import ActionParams
from vd.kernels.task.observations import ObservationParams
from vd.kernels.task.randomisation import ForceParams, RandomisationParams
from vd.kernels.task.resets import GoalParams, StartParams
from vd.kernels.task.rewards import FINGERTIP_MEAN, FINGERTIP_SQUARED_SUM, RewardParams
from vd.kernels.task.success import SuccessParams
from vd.kernels.task.tracked_pose import TrackedPoseParams
from vd.paper import PAPER

STILLNESS_START = 12.0
"""Factor on the four stillness thresholds at level 0 of goals (ours): what moving fingers can
keep."""
GOAL_START_RAD = 1.0
"""Largest goal angle at level 0 of goals [rad] (ours)."""
NO_GOAL = -1.0
"""Rotation error that no object reaches [rad]: what spins has no goal to end at."""
LIFT_M = 0.02
"""Height from which more is worth nothing [m]; as far as a finger can give way without a fall."""

_STRUCTS: dict[str, Any] = {
    "action": ActionParams,
    "observation": ObservationParams,
    "exact_observation": ObservationParams,
    "start": StartParams,
    "force": ForceParams,
    "randomisation": RandomisationParams,
    "reward": RewardParams,
    "success": SuccessParams,
    "goal": GoalParams,
    "tracked_pose": TrackedPoseParams,
}


class TaskParameters:
    """All parameter structs of the task, each an array of length 1 on the device.

    Arrays because a CUDA graph bakes scalar arguments in; a curriculum writes into them instead.

    Attributes:
        action, observation, exact_observation, start, force, randomisation, reward, success, goal,
            tracked_pose: The structs; ``exact_observation`` is without noise.
        weight: Share of its weight that an object which has to be lifted has, shape [1].
        must_lift: 1 where success asks that the object does not touch the table, int32, shape [N].
        table_steps: Control steps of an episode for which the table stays, int32, shape [N].
    """

    action: wp.array
    observation: wp.array
    exact_observation: wp.array
    start: wp.array
    force: wp.array
    randomisation: wp.array
    reward: wp.array
    success: wp.array
    goal: wp.array
    tracked_pose: wp.array

    def __init__(self, cfg: ReorientCfg, hand: HandModel, device: Any):
        """Put the configuration at full difficulty on ``device``."""
        self.cfg = cfg
        self._hand = hand
        self._device = device
        self._staging: dict[str, np.ndarray] = {}
        for name, struct in _STRUCTS.items():
            array = wp.array([struct()], dtype=struct, device=device)
            setattr(self, name, array)
            self._staging[name] = array.numpy()
        self._blended: list[tuple[wp.array, np.ndarray, np.ndarray]] = []
        self.weight = wp.ones(1, dtype=float, device=device)
        self.must_lift = wp.zeros(cfg.num_envs, dtype=wp.int32, device=device)
        self.table_steps = wp.zeros(cfg.num_envs, dtype=wp.int32, device=device)
        self._write(
            "start",
            position=np.array(hand.workspace.drop_m, dtype=np.float32),
            noise=PAPER.scene.object_start_noise_m,
        )
        self.set_levels(Levels())

    def blended(self, nominal: Any, drawn: Any, dtype: Any) -> wp.array:
        """Numbers that the level of physics takes from ``nominal`` to ``drawn``, of like shapes.

        Returns:
            Their array on the device. It is written anew with every level.
        """
        begin, end = np.broadcast_arrays(np.asarray(nominal, float), np.asarray(drawn, float))
        array = wp.array(end, dtype=dtype, device=self._device)
        self._blended.append((array, begin, end))
        return array

    def set_levels(self, levels: Levels) -> None:
        """Write all that depends on the levels of the curriculum."""
        self._set_task(levels)
        self._set_physics(levels.physics)
        cfg = self.cfg
        self.table_steps.assign(table_steps(cfg, levels.air))
        self.must_lift.assign(chosen(cfg, levels.air * cfg.table.lift_share))
        self.weight.fill_(blend(cfg.curriculum.object_weight, 1.0, levels.air))

    def _set_task(self, levels: Levels) -> None:
        """Reward, success and goals."""
        cfg = self.cfg
        level = levels.goals
        loose = cfg.curriculum.loose
        # Thresholds shrink geometrically: each step of the level tightens by the same factor.
        slack = STILLNESS_START ** (1.0 - level)
        start = min(GOAL_START_RAD, cfg.goal.max_angle_rad)
        reward = cfg.reward
        success = cfg.success

        def threshold(tightest: float, loosest: float) -> float:
            return slack * blend(loosest, tightest, levels.stillness) if tightest > 0.0 else 0.0

        self._write(
            "reward",
            success=reward.success,
            rotation=reward.rotation,
            rotation_epsilon=reward.rotation_epsilon_rad,
            fingertip=reward.fingertip,
            fingertip_form=FINGERTIP_MEAN
            if reward.fingertip_mean_distance
            else FINGERTIP_SQUARED_SUM,
            energy=reward.energy * level,
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
            rotation=NO_GOAL
            if reward.spin.rate
            else blend(loose.rotation_rad, success.rotation_rad, levels.stillness),
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
            max_angle=start + (cfg.goal.max_angle_rad - start) * level,
            about_vertical=int(cfg.goal.about_vertical),
        )

    def _set_physics(self, level: float) -> None:
        """Noise, disturbances and all ranges of what is drawn."""
        cfg = self.cfg
        random = self.cfg.randomisation
        materials = PAPER.materials
        share = level if random.enabled else 0.0
        self._write(
            "action",
            alpha=cfg.action.ema_alpha,
            step_rad=cfg.action.scale_rad_s * cfg.sim.control_dt,
            noise_std=share * random.action_noise_std,
        )
        for name, noise in (("observation", share), ("exact_observation", 0.0)):
            self._write(
                name,
                velocity_scale=PAPER.observation.velocity_scale,
                noise_mean=noise * random.observation_noise_mean,
                noise_std=noise * random.observation_noise_std,
                file_axes=float(cfg.observation.file_axes),
                canonical=float(cfg.observation.canonical),
            )
        # Of the impulse that is asked for, whatever the physics step.
        longest_s = random.force_steps(cfg.sim) * cfg.sim.physics_dt
        self._write(
            "force",
            probability=random.force_probability if random.enabled else 0.0,
            force_per_mass=share * random.force_n_per_kg * random.force_s / longest_s,
            decay=random.force_decay,
        )
        self._write(
            "randomisation",
            friction=_between((materials.friction,) * 2, random.friction, share),
            link_mass_scale=random.link_mass_scale if random.enabled else (1.0, 1.0),
            action_offset_std=share * random.action_offset_std,
            observation_offset_std=share * random.observation_offset_std,
        )
        tracker = random.tracked_pose
        # At level 0 a pose comes with every physics step, at once and true.
        self._write(
            "tracked_pose",
            rate_hz=_between((cfg.sim.physics_hz,) * 2, tracker.rate_hz, share),
            age_s=_between(0.0, tracker.age_s, share),
            dropped=share * tracker.dropped,
            jumping=share * tracker.jumping,
            jump=tracker.jump,
            noise=_between(0.0, tracker.noise, share),
        )
        for array, nominal, drawn in self._blended:
            array.assign(_between(nominal, drawn, level).astype(np.float32))

    def _write(self, name: str, **values: Any) -> None:
        staging = self._staging[name]
        for field, value in values.items():
            staging[field][0] = value
        getattr(self, name).assign(staging)


def _between(nominal: Any, drawn: Any, level: float) -> np.ndarray:
    """From ``nominal`` at level 0 to exactly ``drawn`` at 1."""
    return (1.0 - level) * np.asarray(nominal, float) + level * np.asarray(drawn, float)
