"""Configuration of the reorientation task; every default is the paper's."""

from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass, field, replace
from math import pi
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from vd.command.config import from_dict, require
from vd.paper import PAPER
from vd.sim.cfg import SimCfg

if TYPE_CHECKING:
    from vd.assets_usd.hand_data import Workspace

MAX_LATENCY_S = 0.5
"""Largest latency of what is seen that can be drawn [s] (ours): environments keep all of it in
memory.
"""
SLOWEST_POSES_HZ = 2.0
"""Fewest poses a second of a tracker (ours): as much of the past is kept in memory."""
View = Literal["world", "goal", "mirrored"]
"""What a policy sees its goals in, see :attr:`ObservationCfg.view`."""


@dataclass(frozen=True)
class ActionCfg:
    """Smoothed relative joint increments."""

    ema_alpha: float = PAPER.action.ema_alpha
    """Weight of the new action in the moving average."""
    scale_rad_s: float = PAPER.action.scale_rad_s
    """Joint speed that an action of 1 asks for [rad/s]."""


@dataclass(frozen=True)
class SpinCfg:
    """Ours: turn about an axis without a goal, with the terms of HORA (arXiv 2210.04887).

    Off by default. Its work is ``energy``, which is linear.
    """

    rate: float = 0.0
    """Times the speed about the axis [s/rad]; 0: there are goals."""
    axis: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """About which, in the world; the default is clockwise from above, as in HORA."""
    clip_rad_s: float = 1.0
    """Speed about it from which more is worth nothing [rad/s]; HORA: 0.5."""
    object_speed: float = -0.3
    """Times the sum of the absolute components of the object's velocity [s/m]."""
    posture: float = -0.02
    """Times the summed squared distance of the joints from their start [1/rad^2]; HORA: -0.3."""
    torque: float = -0.1
    """Times the summed squared torque of the joints [1/(N m)^2]."""

    def validate(self) -> None:
        """Raise ValueError naming the field and the remedy."""
        require(self, "reward.spin.", "positive", "clip_rad_s")
        if not any(self.axis):
            raise ValueError("reward.spin.axis is 0 0 0; give a direction, such as 0 0 1")


@dataclass(frozen=True)
class RewardCfg:
    """Coefficients of equations 1-5, 7 and 8, and of our own shaping (off by default)."""

    success: float = PAPER.reward.success
    """c1: once for each goal reached."""
    rotation: float = PAPER.reward.rotation
    """c2: times 1 / (error + rotation_epsilon_rad)."""
    rotation_epsilon_rad: float = PAPER.reward.rotation_epsilon_rad
    """epsilon_theta [rad]; the released code uses 0.1."""
    fingertip: float = PAPER.reward.fingertip
    """c3: times the summed squared distance of fingertips and object."""
    fingertip_mean_distance: bool = False
    """Use the released code's form of c3: the mean distance."""
    energy: float = PAPER.reward.energy
    """c4: times the mechanical power [W]."""
    energy_clip_w: float = 0.0
    """Largest power that is counted [W]; 0 counts all (paper). The released code clips at 10."""
    fall: float = PAPER.reward.fall
    """c5: when the object leaves the workspace."""
    table_contact: float = PAPER.reward.table_contact
    """c6: while the object touches the table. Set 0 to learn with table support."""
    progress: float = 0.0
    """Ours: per radian by which the error fell since the last step."""
    lift: float = 0.0
    """Ours: times the height of the object's lowest point above the table (there or not), 1 from 2
    cm on.
    """
    scale: float = 1.0
    """Ours: factor on the sum; changes no optimum, keeps value targets near 1."""
    spin: SpinCfg = field(default_factory=SpinCfg)
    """Ours: in place of goals."""
    terms: MutableMapping[str, float] = field(default_factory=dict)
    """Your own terms: functions (module:function) with their coefficients
    (docs/tutorials/terms.md).
    """


TOWARDS_GOAL = RewardCfg(
    rotation_epsilon_rad=PAPER.reward.rotation_epsilon_rad_code,
    fingertip=-10.0,
    fingertip_mean_distance=True,
    energy=-1.0,
    energy_clip_w=PAPER.reward.energy_clip_w_code,
    fall=-300.0,
    table_contact=0.0,
    progress=300.0,
    scale=0.01,
)
"""Forms of the released code, and ours: a reward for turning towards the goal, dear falls, and
cheap energy and table contact."""


@dataclass(frozen=True)
class SuccessCfg:
    """When a goal counts as reached, and when the object counts as lost."""

    rotation_rad: float = PAPER.success.rotation_rad
    """Largest rotation error [rad]."""
    joint_speed_rad_s: float = PAPER.success.joint_speed_rad_s
    """Largest norm of the joint velocities [rad/s]; 0 does not ask."""
    object_speed_m_s: float = PAPER.success.object_speed_m_s
    """Largest speed of the object [m/s]; 0 does not ask."""
    object_spin_rad_s: float = PAPER.success.object_spin_rad_s
    """Largest angular speed of the object [rad/s]; 0 does not ask."""
    action_norm: float = PAPER.success.action_norm
    """Largest norm of the smoothed action; 0 does not ask."""
    fall_m: float | None = None
    """Distance from the goal position at which the object counts as lost [m]; None: the hand's."""

    def fall_of(self, workspace: "Workspace") -> float:
        """Distance at which objects are lost by a hand with this workspace [m]."""
        return workspace.fall_m if self.fall_m is None else self.fall_m


@dataclass(frozen=True)
class ObservationCfg:
    """What the teacher sees besides the paper's state."""

    shape: Literal["none", "full"] = "none"
    """none: nothing of the object's shape, as in the paper. full: the vector from each fingertip to
    the nearest point of the surface, and how far the object extends in 9 directions for each
    finger, up and down, now and at the goal; exact, privileged."""
    view: View = "world"
    """world: one frame for all goals, as in the paper. goal: for each goal the scene is seen turned
    about the vertical from finger to finger, and the fingers renamed, so that the axis of the
    wanted rotation lies in one sector: an F-th of the goals to learn. The fingers must be spaced
    evenly. mirrored: in the mirror too, where the wanted rotation would be clockwise from above:
    half of that. The hand must be its own mirror image, as dclaw3 is; of dclaw4 all fingers lean
    the same way round."""
    file_axes: bool = True
    """See how the axes of the object's file lie, now and at the goal, as in the paper. No cloud
    shows which they are; a camera shows the rotation from one to the other alone. Ours: without
    them a teacher sees zeros in their place, and knows no more of them than a camera shows."""
    canonical: bool = False
    """Of the two quaternions of a rotation see always the same, of object, goal and the rotation
    between them. On in all presets; policies that were trained without have learned the signs.
    """
    dynamics: Literal["none", "critic"] = "none"
    """Ours, privileged: whether the critic is told what was drawn (gains, delay, friction and
    backlash of joints, frictions, mass, latency), and the present state and shape, without
    noise.
    """
    history: int = 0
    """Ours: of how many control steps the policy sees joint positions and actions, and nothing
    else; the critic sees all of the rest. 0: it sees the state."""
    terms: MutableMapping[str, int] = field(default_factory=dict)
    """Your own values: functions (module:function), and how many values each gives. Symmetry frames
    show them as they are, without latency and noise."""
    critic_terms: MutableMapping[str, int] = field(default_factory=dict)
    """The same, for the critic alone."""

    @property
    def own(self) -> dict[str, int]:
        """All own values, those of the actor first."""
        return {**self.terms, **self.critic_terms}

    def num_frames(self, fingers: int) -> int:
        """Symmetry frames of a hand of so many fingers; 0: it sees the world as it is."""
        return {"world": 0, "goal": fingers, "mirrored": 2 * fingers}[self.view]


@dataclass(frozen=True)
class GoalCfg:
    """Which goals are drawn."""

    max_angle_rad: float = pi
    """Goals lie within this angle of the object's present orientation, uniform (Haar); pi is all of
    SO(3).
    """
    about_vertical: bool = False
    """Goals only turn the object about the vertical, uniform in the angle (an easier task)."""


@dataclass(frozen=True)
class StartCfg:
    """How the object starts."""

    GONE: ClassVar = {"reached_share": 0.0}
    """Fields of earlier versions, and what they were where they did nothing."""
    at_rest: bool = False
    """Start at rest on the table, turned about the vertical at random, rather than falling (paper).
    Goals near the start are then near a pose that lasts."""
    poses: int = 4
    """Poses at rest of each environment, to choose from; found by dropping the object at the
    beginning.
    """


@dataclass(frozen=True)
class TableCfg:
    """Ours: environments whose table is taken away, as in in-air tests, or does not help.

    None by default.
    """

    away_share: float = 0.0
    """Share of the environments whose episodes lose the table; the same environments throughout."""
    away_s: tuple[float, float] = (PAPER.scene.air_table_s, PAPER.scene.air_table_s)
    """Times in the episode at which it goes, uniform over these environments [s]."""
    lift_share: float = 0.0
    """Share of the environments in which success asks that the object does not touch the table:
    those that lose it first, then others."""

    def validate(self) -> None:
        """Raise ValueError naming the field and the remedy."""
        require(self, "table.", "in [0, 1]", "away_share lift_share")
        if not 0.0 < self.away_s[0] <= self.away_s[1]:
            raise ValueError(
                f"table.away_s is {self.away_s[0]:g} {self.away_s[1]:g}; it has to rise, and be "
                f"positive"
            )


@dataclass(frozen=True)
class LevelCfg:
    """Ours: how a level of the curriculum moves between 0 and 1, in each training iteration."""

    rate: float = 0.0
    """Change of the level in an iteration; at 0 the level is 1 from the beginning."""
    raise_at: float = 0.4
    """Success rate of goals above which it rises."""
    lower_at: float = 0.0
    """Success rate of goals below which it falls."""

    def validate(self, name: str) -> None:
        """Raise ValueError naming the field and the remedy."""
        require(self, f"curriculum.{name}.", "in [0, 1]", "rate")
        if not 0.0 <= self.lower_at <= self.raise_at <= 1.0:
            raise ValueError(
                f"curriculum.{name}.lower_at is {self.lower_at:g} and raise_at {self.raise_at:g}; "
                "they have to rise within 0 and 1"
            )


@dataclass(frozen=True)
class LooseCfg:
    """Ours: the thresholds of success where the level of stillness is 0; geometric in between.

    Noise in the actions moves the fingers more than the paper's success allows, and without noise
    nothing is learned, so both have to fall together (``policy.quiet_std``).
    """

    joint_speed_rad_s: float = 3.0
    """Largest norm of the joint velocities [rad/s]; fingers at a std of 0.2 have about 1."""
    object_speed_m_s: float = 0.16
    """Largest speed of the object [m/s]."""
    object_spin_rad_s: float = 2.0
    """Largest angular speed of the object [rad/s]."""
    action_norm: float = 3.5
    """Largest norm of the smoothed action; that of twelve actions of 1 is 3.46."""
    rotation_rad: float = PAPER.success.rotation_rad
    """Largest rotation error [rad]; a smaller success.rotation_rad makes it finer."""

    def validate(self) -> None:
        """Raise ValueError naming the field and the remedy."""
        thresholds = "joint_speed_rad_s object_speed_m_s object_spin_rad_s action_norm rotation_rad"
        require(self, "curriculum.loose.", "positive", thresholds)


@dataclass(frozen=True)
class CurriculumCfg:
    """Ours: levels from 0 to 1 that rise one after the other, as measured success allows.

    Off by default. The first level below 1 rises while the success rate of goals is above its
    ``raise_at``; the last one above 0 falls while it is below its ``lower_at``.
    """

    goals: LevelCfg = field(default_factory=LevelCfg)
    """From near goals, hardly any stillness and free energy to those of the task."""
    stillness: LevelCfg = field(default_factory=LevelCfg)
    """From the thresholds of ``loose`` to those of ``success``."""
    physics: LevelCfg = field(default_factory=LevelCfg)
    """From nothing to what ``randomisation`` draws. Sizes are compiled, so they vary all along."""
    air: LevelCfg = field(default_factory=LevelCfg)
    """From no environment to the shares of ``table``."""
    loose: LooseCfg = field(default_factory=LooseCfg)
    object_weight: float = 1.0
    """Share of its weight that the object has at air 0 in the environments of table.lift_share:
    what is light is easily held, and not lost before it is."""

    @property
    def lightens(self) -> bool:
        """Whether objects that have to be lifted are lighter at first."""
        return self.object_weight != 1.0 and self.air.rate > 0.0

    def validate(self) -> None:
        """Raise ValueError naming the field and the remedy."""
        for name in ("goals", "stillness", "physics", "air"):
            getattr(self, name).validate(name)
        self.loose.validate()
        require(self, "curriculum.", "positive", "object_weight")


@dataclass(frozen=True)
class TrackedPoseCfg:
    """Ours: the object's pose as a tracker outside tells it. Off by default.

    Defaults beside the rate are our guesses of AprilTags, FoundationPose and motion capture; none
    was measured.
    """

    rate_hz: tuple[float, float] = (0.0, 0.0)
    """Poses a second, drawn for each episode and held in between: 10 30; 0 0: there is no tracker.
    Velocities are the differences of two poses."""
    age_s: tuple[float, float] = (0.03, 0.15)
    """How old poses are when they come [s], drawn for each episode."""
    dropped: float = 0.1
    """Share of the poses that do not come."""
    jumping: float = 0.02
    """Share of the poses that are wrong by ``jump``."""
    jump: tuple[float, float] = (0.02, 0.5)
    """By how much these are wrong, in any direction [m] [rad]."""
    noise: tuple[float, float] = (0.001, 0.02)
    """Standard deviation of each pose in each axis [m] [rad]."""

    @property
    def enabled(self) -> bool:
        """Whether there is a tracker."""
        return self.rate_hz[1] > 0.0

    def validate(self) -> None:
        """Raise ValueError naming the field and the remedy."""
        where = "randomisation.tracked_pose."
        require(self, where, "in [0, 1]", "dropped jumping")
        low, high = self.rate_hz
        if self.enabled and not SLOWEST_POSES_HZ <= low <= high:
            raise ValueError(
                f"{where}rate_hz is {low:g} {high:g}; it has to rise from {SLOWEST_POSES_HZ:g}"
            )
        low, high = self.age_s
        if not 0.0 <= low <= high <= MAX_LATENCY_S:
            raise ValueError(
                f"{where}age_s is {low:g} {high:g}; it has to rise within 0 and {MAX_LATENCY_S:g}"
            )


@dataclass(frozen=True)
class RandomisationCfg:
    """Table S3 and the disturbance force."""

    GONE: ClassVar = {"observation_jitter_s": 0.0, "object_pose_error": [0.0, 0.0]}
    """Fields of earlier versions, and what they were where they did nothing."""
    enabled: bool = True
    """Randomise at all."""
    stiffness_scale: tuple[float, float] = PAPER.randomisation.stiffness_scale
    """Factors on the stiffness of each joint's drive."""
    damping_scale: tuple[float, float] = PAPER.randomisation.damping_scale
    """Factors on the damping of each joint's drive."""
    link_mass_scale: tuple[float, float] = PAPER.randomisation.link_mass_scale
    """Factors on the mass of each link of the hand."""
    friction: tuple[float, float] = PAPER.randomisation.friction
    """Friction coefficients of hand and object."""
    table_friction: tuple[float, float] = PAPER.randomisation.table_friction
    """Friction coefficients of the table."""
    object_scale: tuple[float, float] = PAPER.randomisation.object_scale
    """Factors on the size of the object."""
    object_scale_count: int = 3
    """Object sizes are this many even steps of ``object_scale``: every size is a set of compiled
    meshes.
    """
    object_sizes: int = 0
    """Ours: so many sizes, even steps over those in the hand's USD, in place of ``object_scale``;
    0: none."""
    object_mass_kg: tuple[float, float] = PAPER.randomisation.object_mass_kg
    """Masses of the object [kg]."""
    object_com_m: float = 0.0
    """Ours: how far the object's centre of mass is from where its file has it [m], to a side drawn
    once.
    """
    action_noise_std: float = PAPER.randomisation.action_noise_std
    """Standard deviation of the noise of each action, drawn anew in every control step; 1 is
    action.scale_rad_s."""
    action_offset_std: float = 0.0
    """The released code adds a constant offset of std 0.015."""
    observation_noise_mean: float = PAPER.observation.noise_mean
    """Mean of the noise of each observed value of hand and object, in its own unit."""
    observation_noise_std: float = PAPER.observation.noise_std
    """Standard deviation of that noise, drawn anew in every control step."""
    observation_offset_std: float = 0.0
    """The released code adds a constant offset of std 0.001."""
    force_probability: float = PAPER.randomisation.force_probability
    """Chance in a control step that a force begins to act on the object."""
    force_n_per_kg: float = PAPER.randomisation.force_n_per_kg
    """Size of that force [N per kg of the object]; its direction is uniform."""
    force_s: float = PAPER.randomisation.force_s_code
    """How long a new force acts in its control step [s]. The default is one of five simulation
    steps, as in the released code; a whole control step, 1/12, gives five times the impulse
    (condition ``hard``).
    """
    force_decay: float = 0.0
    """What remains of a force in the next control step: 0 in the paper, 0.998 in the released
    code.
    """
    effects: MutableMapping[str, tuple[float, float]] = field(default_factory=dict)
    """Effects of servos to draw for every joint in each episode, by name and parameter:
    command_delay.delay_s 0 0.04 draws a delay of up to 40 ms. Those given are all: others of --init
    or a preset go. They replace what a hand layer says about the same parameter. Delays are of the
    bus: all joints of an environment have the same share of their range."""
    observation_latency_s: tuple[float, float] = (0.0, 0.0)
    """How old the object's state is that the policy sees [s], drawn for each episode, to the
    nearest physics step: a camera and its loop. Rewards and success are of the true state."""
    encoder_latency_s: tuple[float, float] = (0.0, 0.0)
    """How old joints and fingertips are that the policy sees [s]; a loop reads them when its step
    begins. Drawn at the same share of its range as the object's."""
    tracked_pose: TrackedPoseCfg = field(default_factory=TrackedPoseCfg)
    """The object's pose as a tracker tells it, in place of ``observation_latency_s``."""
    redraw_s: float = PAPER.randomisation.redraw_s
    """Gains, contact frictions and constant errors are drawn anew at the first reset after this
    time [s]: the solver takes them once a second. Servos (``effects``) and latency are drawn at
    every reset.
    """

    def force_steps(self, sim: SimCfg) -> int:
        """Physics steps for which a new force acts."""
        return min(sim.substeps, max(1, round(self.force_s * sim.physics_hz)))

    def validate(self) -> None:
        """Raise ValueError naming the field and the remedy."""
        for name in ("observation_latency_s", "encoder_latency_s"):
            low, high = getattr(self, name)
            if not 0.0 <= low <= high <= MAX_LATENCY_S:
                raise ValueError(
                    f"randomisation.{name} is {low:g} {high:g}; it has to rise within 0 and "
                    f"{MAX_LATENCY_S:g}"
                )
        require(self, "randomisation.", "zero or positive", "object_sizes")
        self.tracked_pose.validate()
        if self.tracked_pose.enabled and self.observation_latency_s[1] > 0.0:
            raise ValueError(
                "randomisation.tracked_pose has ages of its own: leave observation_latency_s at 0"
            )
        require(self, "randomisation.", "positive", "force_s")
        from vd.envs.effects import check_effects  # needs Warp, which settings alone do not

        check_effects(self.effects)


@dataclass(frozen=True)
class ReorientCfg:
    """The in-hand reorientation task: hand, objects, environments and all terms.

    Fields are those of ``--env`` in ``vd-train teacher --help-all``; :meth:`of` takes a policy's.
    """

    hand: str = "dclaw4"
    """Name of a hand (dclaw3, dclaw4) or path of a hand's USD."""
    fingertip: str = "rigid"
    """Fingertip variant: rigid or soft."""
    hand_layer: str | None = None
    """Layer over the hand with an identified servo model: identified.usda of vd-gap."""
    objects: tuple[str, ...] = ("cube",)
    """Object sets: names or folders of object USDs."""
    fit_objects: bool = False
    """Scale objects as little as makes them fit the hand (the sizes in its USD): sets are made for
    D'Claw.
    """
    num_envs: int = 4096
    """Environments simulated side by side."""
    seed: int = 0
    """Seed of every random draw of the environment."""
    episode_s: float = PAPER.scene.episode_s
    """Length of an episode [s]."""
    success_ends_episode: bool = False
    """Reset the environment on success (evaluation) instead of giving a new goal (training)."""
    visuals: bool = False
    """Keep visual shapes, for rendering."""
    table_friction: float = PAPER.materials.table_friction
    """Friction coefficient of the table where nothing is randomised; its contacts get the mean of
    the two.
    """
    failures_per_million: float = 0.0
    """Steps of environments in a million that may leave the finite numbers or become too fast:
    their episode ends like one that times out. Ten more (few steps say little) stop the run, at 0
    the first one does.
    """
    sim: SimCfg = field(default_factory=SimCfg)
    action: ActionCfg = field(default_factory=ActionCfg)
    observation: ObservationCfg = field(default_factory=ObservationCfg)
    reward: RewardCfg = field(default_factory=RewardCfg)
    success: SuccessCfg = field(default_factory=SuccessCfg)
    start: StartCfg = field(default_factory=StartCfg)
    goal: GoalCfg = field(default_factory=GoalCfg)
    table: TableCfg = field(default_factory=TableCfg)
    curriculum: CurriculumCfg = field(default_factory=CurriculumCfg)
    randomisation: RandomisationCfg = field(default_factory=RandomisationCfg)

    @classmethod
    def of(cls, policy: Any, **changes: Any) -> "ReorientCfg":
        """The task in which a policy was trained, with some fields changed.

        Raises:
            ValueError: It is of another version.
        """
        return replace(cls.of_task(policy.task, where="task of the policy"), **changes)

    @classmethod
    def of_task(cls, task: Mapping[str, Any], where: str = "task") -> "ReorientCfg":
        """The task that a policy or checkpoint notes, without the curriculum of its training.

        Raises:
            ValueError: It is of another version; ``where`` says what it is.
        """
        kept = {name: value for name, value in task.items() if name != "curriculum"}
        return from_dict(cls, kept, where=where)

    @property
    def max_episode_steps(self) -> int:
        """Control steps of an episode."""
        return round(self.episode_s * self.sim.control_hz)

    def validate(self) -> None:
        """Raise ValueError naming the field and the remedy."""
        self.sim.validate()
        self.randomisation.validate()
        self.curriculum.validate()
        self.table.validate()
        self.reward.spin.validate()
        require(self.observation, "observation.", "zero or positive", "history")
        if self.observation.history and self.observation.view != "world":
            raise ValueError(
                "observation.history knows no goal to turn the view to; leave observation.view world"
            )
        if self.start.at_rest and self.start.poses < 1:
            raise ValueError(f"start.at_rest needs start.poses >= 1 (now {self.start.poses})")
        if isinstance(self.objects, str):
            raise ValueError(f"objects is {self.objects!r}; write ({self.objects!r},)")
        require(self, "", "positive", "num_envs")
        if self.max_episode_steps < 1:
            raise ValueError(f"episode_s = {self.episode_s} is shorter than one control step")
        require(self, "", "zero or positive", "failures_per_million table_friction seed")
        require(self.goal, "goal.", "an angle", "max_angle_rad")
        require(self.success, "success.", "an angle", "rotation_rad")
        if self.fingertip not in ("rigid", "soft"):
            raise ValueError(f"fingertip = {self.fingertip!r}; choose rigid or soft")
        self._check_curriculum()

    def _check_curriculum(self) -> None:
        """Refuse a curriculum that would loosen or do nothing."""
        curriculum = self.curriculum
        rises = curriculum.stillness.rate > 0.0
        if rises and self.success.rotation_rad > curriculum.loose.rotation_rad:
            raise ValueError(
                f"success.rotation_rad is {self.success.rotation_rad:g}, looser than where it "
                f"begins, curriculum.loose.rotation_rad {curriculum.loose.rotation_rad:g}; raise "
                "the latter"
            )
        if curriculum.lightens and self.table.lift_share == 0.0:
            raise ValueError(
                f"curriculum.object_weight is {curriculum.object_weight:g}, but no "
                "environment asks for objects off the table, and only there are they light; give "
                "table.lift_share"
            )
