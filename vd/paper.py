"""Every constant of the task, in one place, with where it comes from.

Units are SI and radians; quaternions are xyzw. Where the released code and the paper disagree,
the default is the paper's value and the code's value is kept as a ``*_code`` alternative.

Tags used in ``source(...)``:

* ``P``: the paper (Visual Dexterity, Science Robotics 2023), with the equation or table,
* ``C``: the paper's released code (dexenv),
* ``U``: the public four-finger URDF of that code,
* ``D``: derived from the above; the derivation is in the text.

Dimensions, limits, masses and gains of the hands are not here, nor their mount, start pose and
workspace: they live in their USD files, ``assets_usd/usd``, with their sources.
"""

from dataclasses import dataclass, field, fields
from typing import Any


def source(value: Any, tag: str, note: str) -> Any:
    """A dataclass field with a default and its provenance.

    Args:
        value: The default value (immutable).
        tag: Where the value comes from: ``P``, ``C``, ``U`` or ``D``.
        note: Equation, table or derivation.
    """
    return field(default=value, metadata={"tag": tag, "note": note})


@dataclass(frozen=True)
class SceneConstants:
    """Geometry and timing of the scene, world frame (z up, table top at z = 0)."""

    physics_hz: float = source(120.0, "C", "60 Hz with two PhysX substeps")
    control_hz: float = source(12.0, "P", "position controllers at 12 Hz (Methods, action space)")
    episode_s: float = source(10.0, "C", "resetTime: 120 control steps")
    air_episode_s: float = source(15.0, "P", "in-air test: 180 control steps")
    air_table_s: float = source(
        2.0, "P", "in-air test: the table is taken away after 24 control steps"
    )
    table_size_m: tuple[float, float, float] = source((0.6, 0.6, 0.1), "C", "fixed box")
    table_top_m: float = source(0.0, "C", "table box centred at z = -0.05")
    object_start_noise_m: float = source(0.01, "C", "uniform, per axis")


@dataclass(frozen=True)
class ActionConstants:
    """Smoothed relative joint increments (paper, Methods, action space)."""

    ema_alpha: float = source(0.8, "P", "abar = alpha a + (1 - alpha) abar_prev")
    scale_rad_s: float = source(
        3.5, "C", "target = q + abar * 3.5 rad/s / 12 Hz; nowhere in the paper"
    )


@dataclass(frozen=True)
class ObservationConstants:
    """Scales of the teacher observation (19G + 21 values, plus the previous action)."""

    velocity_scale: float = source(
        0.2, "C", "joint and object angular velocity are multiplied by it"
    )
    noise_mean: float = source(-0.002, "P", "Table S3, state observation N(-0.002, 0.002)")
    noise_std: float = source(0.002, "P", "Table S3")
    noise_offset_std_code: float = source(0.001, "C", "offset fixed between re-draws")


@dataclass(frozen=True)
class RewardConstants:
    """Equations 1-5, 7 and 8 with the coefficients of Table S1."""

    success: float = source(800.0, "P", "c1, eq. 1, Table S1")
    rotation: float = source(1.0, "P", "c2, eq. 2, Table S1")
    rotation_epsilon_rad: float = source(0.4, "P", "epsilon_theta, eq. 2, Table S1")
    rotation_epsilon_rad_code: float = source(0.1, "C", "0.4 is the success tolerance in the code")
    fingertip: float = source(-1.0, "P", "c3, eq. 3: summed squared distances; code: mean distance")
    energy: float = source(-20.0, "P", "c4, eq. 4")
    energy_clip_w_code: float = source(
        10.0, "C", "the code clips sum |qd tau| at 10 W; the paper does not"
    )
    fall: float = source(-100.0, "P", "c5, eq. 5")
    table_contact: float = source(-1.0, "P", "c6, eq. 7; off by default in the code")
    fingertip_height: float = source(-2.0, "P", "c7, eq. 8; absent from the code")
    fingertip_height_m: float = source(0.16, "P", "p_z of eq. 8, world z in this frame")
    table_contact_force_n: float = source(0.2, "C", "net table force that counts as contact")


@dataclass(frozen=True)
class SuccessConstants:
    """Success and fall thresholds (paper, Supplementary Methods, success criteria; Table S1)."""

    rotation_rad: float = source(0.4, "P", "theta")
    precise_rad: float = source(0.1, "P", "theta in the precise variant")
    joint_speed_rad_s: float = source(0.25, "P", "norm of qd")
    object_speed_m_s: float = source(0.04, "P", "norm of v")
    object_spin_rad_s: float = source(0.5, "P", "norm of omega")
    action_norm: float = source(1.0, "C", "norm of the smoothed action; threshold only in the code")
    fall_m: float = source(
        0.15, "P", "p-bar, eq. 5; distance from where objects are handled, not squared"
    )


@dataclass(frozen=True)
class RandomisationConstants:
    """Table S3 and the disturbance force (Supplementary Methods, robust policy learning)."""

    action_noise_std: float = source(0.05, "P", "Table S3")
    action_offset_std_code: float = source(0.015, "C", "offset fixed between re-draws")
    stiffness_scale: tuple[float, float] = source((0.8, 1.2), "P", "Table S3")
    damping_scale: tuple[float, float] = source((0.8, 1.2), "P", "Table S3")
    link_mass_scale: tuple[float, float] = source((0.8, 1.2), "P", "Table S3")
    friction: tuple[float, float] = source((0.24, 1.6), "P", "Table S3, robot and objects")
    table_friction: tuple[float, float] = source((0.05, 1.0), "P", "Table S3")
    object_scale: tuple[float, float] = source((0.95, 1.05), "P", "Table S3")
    object_mass_kg: tuple[float, float] = source((0.009, 0.324), "P", "Table S3")
    force_probability: float = source(0.2, "P", "per control step")
    force_n_per_kg: float = source(15.0, "P", "c_d, Table S1: F = 15 m")
    force_s_code: float = source(
        1.0 / 60.0, "C", "set once a control step, so one of 5 steps of 1/60 s has it"
    )
    redraw_s: float = source(
        100.0, "C", "dynamics are drawn anew at a reset after 1200 control steps"
    )


@dataclass(frozen=True)
class NominalMaterials:
    """Material values without randomisation."""

    friction: float = source(0.8, "C", "hand and object")
    table_friction: float = source(0.5, "C", "table")
    object_mass_kg: float = source(
        0.1, "D", "middle of the paper's base range U(0.03, 0.18) kg, rounded"
    )


@dataclass(frozen=True)
class TeacherConstants:
    """PPO of the teacher (Table S1)."""

    num_envs: int = source(32000, "P", "Table S1; the code uses 8000")
    rollout_steps: int = source(8, "P", "Table S1")
    minibatch_size: int = source(64000, "P", "Table S1: 4 minibatches of 32000 x 8")
    epochs: int = source(12, "P", "Table S1")
    actor_learning_rate: float = source(3e-4, "P", "Table S1")
    critic_learning_rate: float = source(1e-3, "P", "Table S1")
    clip: float = source(0.1, "P", "Table S1")
    gamma: float = source(0.99, "P", "Table S1")
    gae_lambda: float = source(0.95, "P", "Table S1")
    hidden: tuple[int, ...] = source((512, 256, 256), "P", "MLP 512-256-256 ELU")
    value_coefficient_code: float = source(5e-4, "C", "unclipped MSE; not given in the paper")
    grad_norm_code: float = source(1.0, "C", "joint norm of actor and critic")
    initial_log_std_code: float = source(-0.2, "C", "state-independent")


@dataclass(frozen=True)
class CameraConstants:
    """Depth camera and its cloud; pose, size and focal length are the hand's (its USD)."""

    points: int = source(
        6000, "C", "camera points of a cloud, drawn with replacement after the crop"
    )
    crop_m: tuple[float, float] = source(
        (0.005, 0.2), "C", "world z that is kept: no table, no palm"
    )


@dataclass(frozen=True)
class CloudConstants:
    """Point clouds, their voxels and their noise (Methods, point cloud voxelization)."""

    object_points: int = source(500, "C", "samples of the object, and of the goal")
    voxel_m: float = source(0.005, "P", "point cloud voxelization; true floor, the code truncates")
    jitter_std_m: float = source(0.004, "P", "N(0, 0.004) on point positions")
    dropout_ratio: tuple[float, float] = source((0.0, 0.2), "P", "share of the points that is lost")


@dataclass(frozen=True)
class ResultConstants:
    """What the paper reports of its policies in simulation.

    Each is ``(value,)``, value and 95 % interval, or, of medians, the interval alone.

    Rates are shares of episodes. On the table the policy is the three-finger student of stage 2, on
    seven objects of the training set and five of the test set; in the air the four-finger one, on
    these twelve, 100 episodes each.
    """

    table_training: tuple[float, ...] = source(
        (0.96, 0.94, 0.97), "P", "Table 1: error at most 0.4 rad"
    )
    table_training_rad08: tuple[float, ...] = source(
        (0.98, 0.97, 0.99), "P", "Table 1: at most 0.8 rad"
    )
    table_training_median_rad: tuple[float, ...] = source(
        (0.12, 0.13), "P", "Table 1: interval alone"
    )
    table_held_out: tuple[float, ...] = source(
        (0.85, 0.82, 0.88), "P", "Table 1: error at most 0.4 rad"
    )
    table_held_out_rad08: tuple[float, ...] = source(
        (0.87, 0.84, 0.90), "P", "Table 1: at most 0.8 rad"
    )
    table_held_out_median_rad: tuple[float, ...] = source(
        (0.15, 0.18), "P", "Table 1: interval alone"
    )
    air_by_prediction: tuple[float, ...] = source(
        (0.723,), "P", "precise manipulation: within 0.4 rad"
    )
    air_by_prediction_rad01: tuple[float, ...] = source(
        (0.259,), "P", "precise manipulation: 0.1 rad"
    )
    air_by_truth: tuple[float, ...] = source((0.809,), "P", "precise manipulation: within 0.4 rad")
    air_by_truth_rad01: tuple[float, ...] = source((0.674,), "P", "precise manipulation: 0.1 rad")
    air_dropped: tuple[float, ...] = source((0.10,), "P", "Figure S12b: around 90 % not dropped")
    air_dropped_at_once: tuple[float, ...] = source((0.103,), "P", "Supplement: steps 24 to 30")
    air_time_s: tuple[float, ...] = source((7.0,), "P", "Figure 4D: the median is below")
    near_seen_rad01: tuple[float, ...] = source((0.294,), "P", "states within 0.1 rad predicted so")
    near_seen: tuple[float, ...] = source((0.859,), "P", "states within 0.4 rad predicted so")


@dataclass(frozen=True)
class PaperConstants:
    """All constants; ``PAPER`` is the one instance."""

    scene: SceneConstants = SceneConstants()
    action: ActionConstants = ActionConstants()
    observation: ObservationConstants = ObservationConstants()
    reward: RewardConstants = RewardConstants()
    success: SuccessConstants = SuccessConstants()
    randomisation: RandomisationConstants = RandomisationConstants()
    materials: NominalMaterials = NominalMaterials()
    teacher: TeacherConstants = TeacherConstants()
    camera: CameraConstants = CameraConstants()
    cloud: CloudConstants = CloudConstants()
    results: ResultConstants = ResultConstants()


PAPER = PaperConstants()
"""The one instance of every constant."""


def provenance() -> list[tuple[str, Any, str, str]]:
    """Every constant as ``(dotted name, value, tag, note)``, for tables and tests."""
    rows = []
    for group in fields(PAPER):
        constants = getattr(PAPER, group.name)
        for item in fields(constants):
            value = getattr(constants, item.name)
            rows.append(
                (f"{group.name}.{item.name}", value, item.metadata["tag"], item.metadata["note"])
            )
    return rows
