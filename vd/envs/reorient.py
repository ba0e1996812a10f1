"""The in-hand reorientation environment: one call is one 12 Hz control step of N environments.

World frame: z up, table top at z = 0. SI units, radians, quaternions xyzw. Everything but the
physics is Warp kernels; a step copies nothing to the host, and it is one captured graph, on CPU and
CUDA. What a step does stands in :meth:`ReorientEnv.launch_step`, in its order.
"""

from typing import Any

import newton
import numpy as np
import warp as wp

from vd.command.device import warp_device
from vd.envs.cfg import ReorientCfg
from vd.envs.curriculum import Levels, moving_levels, next_levels
from vd.envs.followers import ActuatedActions
from vd.envs.observer import Observer
from vd.envs.randomise import Randomiser
from vd.envs.saved_state import load_arrays, save_state, saved_levels
from vd.envs.spin import Spin
from vd.envs.starts import FreeStarts
from vd.envs.task_state import build_task
from vd.kernels.rng import init_rng_kernel
from vd.kernels.task.actions import apply_action_kernel
from vd.kernels.task.environments import keep_object_pose_kernel
from vd.kernels.task.guard import void_step_kernel
from vd.kernels.task.resets import episode_kernel, reset_kernel
from vd.kernels.task.rewards import REWARD_TERMS, reward_kernel
from vd.kernels.task.spin import SPIN_TERMS
from vd.kernels.task.success import success_kernel
from vd.sim.graphs import Graphs
from vd.sim.simulator import CHECKED

SETTLE_S = 1.5
"""Time an object has to come to rest after a drop [s]; some slim ones still rock then."""
FAILURES_AT_FIRST = 10.0
"""Steps of environments that may fail beside those that ``failures_per_million`` allows (ours): one
object in an unlucky start fails in the first step, again whenever the run is started anew, and is
no rate.
"""


class ReorientEnv:
    """N environments of a hand (F fingers, D joints, A of them actuated) and an object to reorient.

    Objects are over a table, but rest in a hand whose palm looks up, and then there is none.
    All arrays are Warp arrays on ``device``; ``wp.to_torch`` views them without copying.

    Programs and own terms use :meth:`reset`, :meth:`step`, its halves :meth:`advance` and
    :meth:`renew`, :meth:`give_goals`, :meth:`object_pose`, :meth:`check`, :meth:`close`, and:

    Attributes:
        observation, privileged: What the actor reads, and the critic alone besides, shapes [N, O],
            [N, P].
        action, smoothed: Actions of the step [N, A], and their moving average over all joints [N,
            D].
        reward, reward_terms: Reward, and its terms (``reward_term_names``) unscaled, shapes [N],
            [N, T].
        success, fell: 1 where the goal was reached, the object was lost, in this step, int32, shape
            [N].
        timed_out: 1 where the episode ended by its length alone, int32, shape [N].
        ended: Not 0 where the episode ended, and the environment was reset, int32, shape [N].
        rotation_error: Angle to the goal at the end of the step, before resets [rad], shape [N].
        step_count: Control steps since the reset, int32, shape [N].
        goal_quat: Wanted orientation of the object, xyzw, shape [N].
        measured_q, measured_qd: Joints as encoders report them [rad, rad/s], in the first D
            columns.
        sim.joint_q, sim.joint_qd: Joints [rad, rad/s], then pose and velocity of the object
            (position [m] and quaternion; linear [m/s] and angular [rad/s]), shapes [N, D + 7], [N,
            D + 6].
        fingers.tip_pos: Fingertips in the world frame [m], shape [N, F].
    """

    def __init__(self, cfg: ReorientCfg, device: str | None = None):
        """Build the environments and reset them.

        Args:
            cfg: The task.
            device: cpu or cuda:N; by default, and for auto, the first GPU, or else the CPU.

        Raises:
            ValueError: For a configuration that cannot work, naming field and remedy.
        """
        cfg.validate()
        self.cfg = cfg
        self._terms: Any = None
        if cfg.reward.terms or cfg.observation.own:
            from vd.envs.terms import OwnTerms  # needs torch, which the task alone does not

            self._terms = OwnTerms(cfg)
        self.device = warp_device(device)
        self.state = state = build_task(cfg, self.device)
        """What this and its parts share."""
        self._launch = state.launch
        self.hand = state.hand
        self.objects = state.objects
        self.scene = state.scene
        self.sim = state.sim
        self.fingers = state.fingers
        self.parameters = state.parameters
        self.measured_q = state.measured_q
        self.measured_qd = state.measured_qd
        self.smoothed = state.smoothed
        self.goal_quat = state.goal_quat

        self.num_envs = cfg.num_envs
        self.num_fingers = self.hand.num_fingers
        self.num_joints = self.hand.num_joints
        self.num_actions = len(self.hand.actuated)
        self.max_episode_steps = cfg.max_episode_steps
        self.world_object = self.scene.world_object
        spun = SPIN_TERMS if cfg.reward.spin.rate else ()
        self.reward_term_names = (*REWARD_TERMS, *spun, *cfg.reward.terms)

        self._allocate()
        self._lifts = cfg.reward.lift != 0.0
        self.randomiser = Randomiser(state)
        shapes = cfg.observation.shape != "none" or self._lifts
        self.observer = Observer(state, self.randomiser, shapes=shapes)
        """Writes what is observed."""
        self.num_observations = self.observer.num_observations
        self.observation, self.privileged = self.observer.split(self.observer.all_values)
        """Teacher observation, fresh after resets and new goals, shape [N, O]: state and shape;
        and what the critic alone is told, shape [N, P]."""
        self.world_observation, _ = self.observer.split(self.observer.world_values)
        """Observation in the world frame, shape [N, O]."""
        self.symmetry_frames = self.observer.symmetry_frames
        """The symmetry frames in which the policy observes and acts; None where that is the world
        frame.
        """
        self.acts_in_frame = True
        """Whether :meth:`step` takes actions in the symmetry frames, if any, or in the world's
        order.
        """
        self._table_leaves = cfg.table.away_share > 0.0
        self._moving = moving_levels(cfg)
        self.levels = Levels()
        """How hard the task is at present; all ones is the configured task."""
        self.set_levels(Levels(**dict.fromkeys(self._moving, 0.0)))
        self._graphs = Graphs(self.device, captured=self.sim.solver.captured)
        self.steps = 0
        """Control steps of all environments since the begin of the run, with those of a
        checkpoint.
        """
        self._own_steps = 0
        if cfg.start.at_rest:
            self._rest_poses = wp.array(self._dropped(), dtype=wp.transform, device=self.device)
        self.reset()

    def _allocate(self) -> None:
        """Arrays of what a step decides, and of its counts."""
        n = self.num_envs
        zeros = self.state.zeros
        self.action = zeros(n, self.num_actions)
        self.reward = zeros(n)
        self.reward_terms = zeros(n, len(self.reward_term_names))
        self.spin: Spin | None = None
        """Measures how far objects turn; None where they have goals."""
        if self.cfg.reward.spin.rate:
            self.spin = Spin(self.state, len(REWARD_TERMS))
        self.rotation_error = zeros(n)
        self.still = zeros(n, dtype=wp.int32)
        """1 where all of success holds but the rotation's threshold, shape [N]."""
        self.success = zeros(n, dtype=wp.int32)
        self.fell = zeros(n, dtype=wp.int32)
        self.timed_out = zeros(n, dtype=wp.int32)
        self.done = zeros(n, dtype=wp.int32)
        """1 where the return ends: success, fall or time-out, shape [N]."""
        self.step_count = zeros(n, dtype=wp.int32, saved="step_count")
        self.goal_steps = zeros(n, dtype=wp.int32, saved="goal_steps")
        """Control steps since the environment's goal was given, shape [N]."""
        self.object_pose_end = zeros(n, dtype=wp.transform)
        """Object pose at the end of the step, before resets, shape [N]."""
        self.goal_counts = zeros(3, saved="goal_counts")
        """Goals ended, goals reached and objects lost since cleared, over all environments, shape
        [3].
        """
        self.clearance = zeros(n)
        """Height of the object's lowest point above the table [m], shape [N]; 0 unless it is
        rewarded.
        """
        self.previous_error = zeros(n, saved="previous_error")
        """Rotation error at the end of the last step, for the progress in it [rad], shape [N]."""
        self.ended = zeros(n, dtype=wp.int32)
        self._new_goal = zeros(n, dtype=wp.int32)
        self._env_mask = zeros(n + 1, dtype=wp.bool)
        self._given_start = zeros(n, dtype=wp.quat)
        self._given_goal = zeros(n, dtype=wp.quat)
        self._rest_poses = zeros(n, 0, dtype=wp.transform)
        self._reset_q = wp.array(self.hand.start, dtype=float, device=self.device)
        self._free_starts = FreeStarts(self.state, self.hand.start)
        self._actuated = ActuatedActions(self.state)
        self.refused = zeros(n, dtype=wp.int32)
        """Actions that were not finite since that was told, shape [N]."""

    def _dropped(self) -> np.ndarray:
        """Where objects come to lie that are dropped a few times, shape [N, K, 7].

        A drop that left the claw is replaced by one of the same environment that did not, or, if
        all did, by the start. Each is a position [m] and a quaternion xyzw.
        """
        workspace = self.hand.workspace
        dropped = []
        for _ in range(self.cfg.start.poses):
            self.reset()
            for _ in range(round(SETTLE_S * self.cfg.sim.control_hz)):
                wp.copy(self.sim.target, self.sim.joint_q)
                self.sim.step()
            if self.cfg.failures_per_million > 0.0:  # what failed lies nowhere
                self.sim.failures.zero_()
            self.check()
            dropped.append(self.object_pose())
        landed = np.stack(dropped, axis=1)
        away_m = np.linalg.norm(landed[:, :, :3] - workspace.goal_m, axis=2)
        inside = away_m < self.cfg.success.fall_of(workspace)
        # Choose, for every slot, the slot itself or the first good one of the environment.
        slot = np.where(inside, np.arange(len(dropped)), np.argmax(inside, axis=1)[:, None])
        poses = np.take_along_axis(landed, slot[:, :, None], axis=1)
        poses[~inside.any(axis=1)] = [*workspace.drop_m, 0.0, 0.0, 0.0, 1.0]
        return poses

    # Stepping

    def reset(
        self,
        object_quat: np.ndarray | None = None,
        goal_quat: np.ndarray | None = None,
        seed: int | None = None,
    ) -> None:
        """Reset all environments.

        Args:
            object_quat: Start orientations of the objects, xyzw, shape [N, 4]; random by default.
            goal_quat: Goal orientations, xyzw, either sign, shape [N, 4]; drawn as configured by
                default.
            seed: Begin the random streams anew from this; None: they go on.
        """
        if seed is not None:
            self._launch(init_rng_kernel, [seed], [self.state.rng])
        for given, buffer in ((object_quat, self._given_start), (goal_quat, self._given_goal)):
            if given is not None:
                given = np.asarray(given, dtype=np.float32)
                if given.shape != (self.num_envs, 4):
                    raise ValueError(
                        f"reset() takes orientations of shape ({self.num_envs}, 4), not "
                        f"{given.shape}"
                    )
                buffer.assign(given)
        self.ended.fill_(1)
        self._new_goal.zero_()
        self.randomiser.draw(self.ended)
        self._reset_envs(use_start=object_quat is not None, use_goal=goal_quat is not None)
        self.randomiser.write_model()
        self.observe()

    def give_goals(self, envs: np.ndarray, goal_quat: np.ndarray) -> None:
        """Give new goals to some environments in the middle of their episodes.

        The observation is fresh.

        Args:
            envs: Their numbers, shape [E].
            goal_quat: Goal orientations, xyzw, shape [E, 4].
        """
        mask = np.zeros(self.num_envs, np.int32)
        goals = self.goal_quat.numpy()
        mask[envs] = 1
        goals[envs] = goal_quat
        self.ended.zero_()
        self._new_goal.assign(mask)
        self._given_goal.assign(goals)
        self._reset_envs(use_goal=True)
        self.observe()

    def step(self, action: Any) -> None:
        """Simulate one control step; environments that end are reset, and the observation is fresh.

        Args:
            action: Actions in [-1, 1], shape [N, A]: a Warp array; ``wp.from_torch`` makes one of a
                tensor.
        """
        if self._terms is None:
            self._take(action)
            self._graphs.replay(self.launch_step)
            self.randomiser.after_step(self.steps)
        else:
            self.advance(action)
            self.renew()

    def advance(self, action: Any) -> None:
        """The first half of :meth:`step`: simulate and judge.

        ``ended`` says where an episode is over.

        Arguments are those of :meth:`step`.
        """
        self._take(action)
        self._graphs.replay(self._launch_judged)
        if self._terms is not None:
            self._terms.pay(self)

    def renew(self, reset: wp.array | None = None) -> None:
        """The other half of :meth:`step`.

        New goals where one was reached, resets, and the observation.

        Args:
            reset: 1 where to reset, int32, shape [N]; by default ``ended``, which becomes this.
        """
        if reset is not None:
            wp.copy(self.ended, reset)
        self._graphs.replay(self._launch_renewal)
        self._new_goal.zero_()
        if self._terms is not None:
            self._terms.observe(self)
        self.randomiser.after_step(self.steps)

    def _take(self, action: Any) -> None:
        """Put the actions of a step where the graph reads them."""
        if getattr(action, "ptr", None) is None or action.shape != self.action.shape:
            raise ValueError(
                f"actions are an array {self.action.shape} of wp.from_torch, not {action!r:.40}"
            )
        if action.ptr != self.action.ptr:
            wp.copy(self.action, action)
        if self.device == "cpu" or self.steps % CHECKED == 0:
            self._check_actions()
        self.steps += 1
        self._own_steps += 1

    def motion(self) -> dict[str, wp.array]:
        """What the motion goes on from, the last targets included: arrays with a row for each.

        Not copies.
        """
        sim = self.sim
        return {
            "joint_q": sim.joint_q,
            "joint_qd": sim.joint_qd,
            "target": sim.target,
            "warm_start": sim.solver.mjw_data.qacc_warmstart,
            **({} if sim.servo is None else sim.servo.stateful()),
        }

    def hold(self) -> None:
        """One control step in which no policy acts and the hand keeps its last targets.

        Nothing is reset.
        """
        self._graphs.replay(self.sim.step)

    def _apply_action(self) -> None:
        p = self.parameters
        sim = self.sim
        action = self._actuated.all_joints(self.action)
        if self.symmetry_frames is not None and self.acts_in_frame:
            action = self.symmetry_frames.world_action(action)
        self._launch(
            apply_action_kernel,
            [
                self.state.lower,
                self.state.upper,
                p.action,
                action,
                self.randomiser.action_offset,
                self.measured_q,
                self.smoothed,
                self.state.rng,
                self.refused,
            ],
            [sim.target],
        )

    def launch_step(self) -> None:
        """Launch every kernel of a control step; :meth:`step` replays them as one graph."""
        self._launch_judged()
        self._launch_renewal()

    def _launch_judged(self) -> None:
        """Move, and judge the state that is reached."""
        sim = self.sim
        self._apply_action()
        self.randomiser.disturb()
        if self._table_leaves:
            sim.place_tables(self.step_count, self.parameters.table_steps)
        sim.step()
        if self.cfg.failures_per_million > 0.0:
            sim.put_back(self.step_count, self.max_episode_steps - 1)
        self.fingers.measure(self.randomiser.kp, self.randomiser.kd)
        if self._lifts and self.observer.shapes is not None:
            self.observer.shapes.measure_clearance(sim.joint_q, self.num_joints, self.clearance)
        self._judge()
        self._end_episodes()
        self._launch(
            keep_object_pose_kernel, [sim.joint_q, self.num_joints], [self.object_pose_end]
        )

    def _launch_renewal(self) -> None:
        """Give new goals, reset what has ended, and observe."""
        self.randomiser.redraw(self.ended)
        self._reset_envs()
        self.observer.observe()

    def _judge(self) -> None:
        """Success and reward of the step, before resets."""
        p = self.parameters
        sim = self.sim
        self._launch(
            success_kernel,
            [
                p.success,
                sim.joint_q,
                sim.joint_qd,
                self.goal_quat,
                self.smoothed,
                sim.table_force,
                self.parameters.must_lift,
            ],
            [self.rotation_error, self.still, self.success, self.fell],
        )
        self._launch(
            reward_kernel,
            [
                p.reward,
                sim.joint_q,
                sim.joint_qd,
                self.fingers.tip_pos,
                self.fingers.effort,
                sim.table_force,
                self.clearance,
                self.rotation_error,
                self.success,
                self.fell,
                self.previous_error,
            ],
            [self.reward, self.reward_terms],
        )
        if self.spin is not None:
            self.spin.pay(self.reward, self.reward_terms)
        if self.cfg.failures_per_million > 0.0:
            self._launch(
                void_step_kernel,
                [sim.failed],
                [self.reward, self.reward_terms, self.still, self.success, self.fell],
            )

    def _end_episodes(self) -> None:
        """Which episodes end and which goals are new, and counts of goals."""
        self._launch(
            episode_kernel,
            [
                self.success,
                self.fell,
                self.max_episode_steps,
                int(self.cfg.success_ends_episode),
                self.step_count,
                self.goal_steps,
                self.goal_counts,
            ],
            [self.timed_out, self.done, self.ended, self._new_goal],
        )

    def _reset_envs(self, *, use_start: bool = False, use_goal: bool = False) -> None:
        """Reset the environments of ``ended``, give a goal to those of ``_new_goal`` too."""
        sim = self.sim
        p = self.parameters
        self._launch(
            reset_kernel,
            [
                self._reset_q,
                p.start,
                p.goal,
                self._rest_poses,
                self.ended,
                self._new_goal,
                self._given_start,
                int(use_start),
                self._given_goal,
                int(use_goal),
                sim.joint_q,
                self.state.rng,
            ],
            [
                sim.joint_qd,
                self.smoothed,
                self.step_count,
                self.goal_steps,
                self.goal_quat,
                self.previous_error,
                self._env_mask,
            ],
        )
        self._free_starts.move(self.ended)
        if self.symmetry_frames is not None:
            self.symmetry_frames.choose(self.ended, self._new_goal)
        # The solver warm-starts from the last accelerations, which mean nothing after a reset.
        sim.solver.reset(sim.state, world_mask=self._env_mask, flags=newton.StateFlags(0))
        sim.forward_kinematics()
        if sim.servo is not None:
            sim.servo.reset(self.ended)
        self.observer.begin(self.ended)
        if self.spin is not None:
            self.spin.begin(self.ended)

    def observe(self) -> None:
        """Refresh the observation from the present state.

        :meth:`step` and :meth:`reset` have done so.
        """
        self.observer.observe()
        if self._terms is not None:
            self._terms.observe(self)

    # Reading

    def has_table(self) -> np.ndarray:
        """Whether each table was there in the last step, bool, shape [N] (host copy)."""
        if self.hand.palm_up:
            return np.zeros(self.num_envs, bool)
        return np.asarray(self.step_count.numpy() <= self.parameters.table_steps.numpy())

    def object_pose(self) -> np.ndarray:
        """Present object poses, position [m] and quaternion xyzw, shape [N, 7] (host copy)."""
        return self.sim.joint_q.numpy()[:, self.num_joints : self.num_joints + 7].copy()

    def _check_actions(self) -> None:
        """Raise ValueError if an action was refused."""
        refused = self.refused.numpy().copy()
        if refused.any():
            self.refused.zero_()
            first = int(np.flatnonzero(refused)[0])
            raise ValueError(
                f"{int(refused.sum())} actions were not finite (first: environment {first}), and "
                "were not taken; mend the policy"
            )

    def check(self) -> None:
        """Raise what went wrong since the environment was made.

        Raises:
            ValueError: An action was not finite.
            vd.sim.simulator.SimulationError: Contacts were lost, or too many steps failed.
        """
        self._check_actions()
        if self._terms is not None:
            self._terms.check()
        rate = self.cfg.failures_per_million
        expected = rate * 1e-6 * self._own_steps * self.num_envs
        self.sim.check(FAILURES_AT_FIRST + expected if rate > 0.0 else 0.0)

    def failed_steps(self) -> int:
        """Steps of environments that failed and were put back (``failures_per_million``)."""
        return int(self.sim.failures.numpy().sum())

    # Curriculum and checkpoints

    def update_curriculum(self) -> dict[str, float]:
        """Move the levels by the success rate since the last call; returns numbers to log."""
        ended, reached, dropped = map(float, self.goal_counts.numpy())
        self.goal_counts.zero_()
        rate = reached / max(ended, 1.0)
        levels = next_levels(self.levels, rate, self._moving) if ended > 0 else self.levels
        if levels != self.levels:
            self.set_levels(levels)
        return {
            "success_per_goal": rate,
            "drop_per_goal": dropped / max(ended, 1.0),
            "goals_ended": ended,
        }

    def set_levels(self, levels: Levels) -> None:
        """Go to these levels of the curriculum."""
        if levels.physics != self.levels.physics:
            self.randomiser.set_masses(levels.physics)
        self.levels = levels
        self.parameters.set_levels(levels)

    @property
    def progress(self) -> float:
        """How far all levels that move have come together, in [0, 1]; 1: the configured task."""
        if not self._moving:
            return 1.0
        return sum(getattr(self.levels, name) for name in self._moving) / len(self._moving)

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue exactly, see :func:`vd.envs.saved_state.save_state`."""
        return save_state(self.state, self.changing_arrays(), self.levels, self.steps)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`, see :func:`vd.envs.saved_state.load_arrays`."""
        load_arrays(self.state, self.changing_arrays(), state)
        self.steps = int(state["steps"])
        self.set_levels(self.levels_of(state))
        self.randomiser.write_model()
        self.sim.forward_kinematics()

    def levels_of(self, state: dict[str, Any]) -> Levels:
        """The levels at which this environment goes on from a :meth:`state_dict`."""
        return saved_levels(state, self._moving)

    def changing_arrays(self) -> dict[str, wp.array]:
        """What changes from step to step: simulation, episodes, randomisation, random streams."""
        return {
            **self.motion(),
            "smoothed": self.smoothed,
            "goal_quat": self.goal_quat,
            "rng": self.state.rng,
            **self.state.saved,
        }

    def close(self) -> None:
        """Release the captured graphs."""
        self._graphs.clear()
