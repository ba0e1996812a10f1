"""Episodes as they happened, so that any rule for stopping can be judged on the record.

Of one goal an episode goes on whatever happens: who stops a policy, its own prediction or the true
distance, does not change what it does before, so one run serves all rules. Of goals in a row the
record is that of the first; the next comes once a rule has stopped the policy near enough. What
comes after a stop is simulated apart: the hand keeps its last targets. K objects, M episodes each,
T steps; angles in radians, quaternions xyzw.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
import warp as wp
from scipy.spatial.transform import Rotation

from vd.evaluate.goals import ONE_GOAL, GoalSchedule
from vd.evaluate.rollout import episode_rounds, unit_quats
from vd.evaluate.statistics import symmetric_error
from vd.geometry.quaternions import rotation_distance
from vd.paper import PAPER
from vd.policy.stopping import StoppingRule

if TYPE_CHECKING:
    from vd.envs.reorient import ReorientEnv

StopsBy = Literal["predicted", "exact", "error", "success"]
"""What a rule asks for: a distance, which is a camera policy's prediction, or the true one to the
very goal, or to what looks like it; or the success criteria of training, which are the true one and
stillness.
"""
Way = tuple[StoppingRule, StopsBy]
"""A rule, and what it asks for."""
NEVER_RAD = 1e-9
"""Orientation tolerance that no state meets: an environment with it stops no episode."""


@dataclass(frozen=True)
class Episode:
    """One start and one goal of one object, to its end or stop."""

    object_index: int
    start_quat: tuple[float, ...]
    """Object orientation at the reset."""
    goal_quat: tuple[float, ...]
    """Goal orientation."""
    start_error_rad: float
    """Orientation error at the reset, up to the object's symmetry."""
    error_rad: float
    """Orientation error at the last step of the episode, up to the object's symmetry."""
    exact_error_rad: float
    """The same to the very goal, which is what counts."""
    steps: int
    """Control steps simulated."""
    stopped: bool
    """The rule that was asked for stopped it at the last step."""
    fell: bool
    """The object left the hand."""


@dataclass(frozen=True)
class Trace:
    """Episodes to their falls or time limits, of goals in a row to the end of the first.

    Attributes:
        schedule: The goals.
        first_step: Steps after which the first goal that counts was given.
        start_quat: Orientation of the object there, at the reset if it was lost before [K, M, 4].
        goal_quat: Wanted orientation [K, M, 4].
        error: Orientation error after t steps, up to the object's symmetry, NaN after the end [K,
            M, T + 1].
        exact: The same without symmetry [K, M, T + 1].
        action_norm: Norm of the smoothed action that led there, NaN after the end [K, M, T + 1].
        predicted: What a camera policy predicts of ``error`` there; None for other policies [K, M,
            T + 1].
        steps: Steps to the end of the record [K, M].
        fell: Whether the object was lost, with whatever goal [K, M].
        failed: Whether the physics failed, which ends an episode like the time limit [K, M].
        still: Whether hand and object are as still after t steps as success asks [K, M, T + 1].
        reached: Goals in a row that were reached [K, M].
        held: By the way to stop that was to be held: error to the very goal after the hold, pi
            where the object was lost, NaN where nothing stopped [K, M].
    """

    schedule: GoalSchedule
    first_step: int
    start_quat: np.ndarray
    goal_quat: np.ndarray
    error: np.ndarray
    exact: np.ndarray
    action_norm: np.ndarray
    predicted: np.ndarray | None
    steps: np.ndarray
    fell: np.ndarray
    failed: np.ndarray
    still: np.ndarray
    reached: np.ndarray
    held: dict[Way, np.ndarray] = field(default_factory=dict)

    @property
    def given(self) -> np.ndarray:
        """Whether the object was still there when the first goal was given, bool [K, M]."""
        return self.steps > self.first_step

    def of(self, objects: Sequence[int]) -> "Trace":
        """The episodes of some objects."""
        chosen = list(objects)
        parts: dict[str, Any] = dict(vars(self))
        for name, value in parts.items():
            if isinstance(value, np.ndarray):
                parts[name] = value[chosen]
        parts["held"] = {way: error[chosen] for way, error in self.held.items()}
        return Trace(**parts)

    def ends(self, rule: StoppingRule, by: StopsBy) -> tuple[np.ndarray, np.ndarray]:
        """Where a rule ends every episode.

        Args:
            rule: Bounds of distance and action norm.
            by: What it asks for; of success the bound of the action's norm is the environment's.

        Returns:
            Steps to the stop or the end of the record, and whether the rule stopped it, shape
            [K, M] each.
        """
        if by == "success":
            stops = (self.exact <= rule.distance_rad) & self.still
            last = self.steps - self.fell  # a fall is no success
        else:
            stops = rule.stops(getattr(self, by), self.action_norm)
            last = self.steps - 1  # nobody acts on, or predicts, the state after the last step
        step = np.arange(stops.shape[-1])
        stops &= step > self.first_step  # before an action there is nothing to stop
        stops &= step <= last[..., None]
        stopped: np.ndarray = np.asarray(stops.any(axis=-1))
        return np.where(stopped, stops.argmax(axis=-1), self.steps), stopped

    def episodes(self, rule: StoppingRule, by: StopsBy) -> tuple[Episode, ...]:
        """The episodes as a rule ends them, object by object; arguments as of :meth:`ends`."""
        steps, stopped = self.ends(rule, by)
        begin = np.minimum(self.first_step, self.steps)
        columns = {
            "start_quat": self.start_quat,
            "goal_quat": self.goal_quat,
            "start_error_rad": at_steps(self.error, begin),
            "error_rad": at_steps(self.error, steps),
            "exact_error_rad": at_steps(self.exact, steps),
            "steps": steps - begin,
            "stopped": stopped,
            "fell": self.fell & ~stopped,
        }
        episodes = []
        for k, m in np.ndindex(*steps.shape):
            row: dict[str, Any] = {name: values[k, m].tolist() for name, values in columns.items()}
            start_quat = tuple(row.pop("start_quat"))
            goal_quat = tuple(row.pop("goal_quat"))
            episodes.append(Episode(k, start_quat, goal_quat, **row))
        return tuple(episodes)


def at_steps(values: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Of values after t steps [K, M, T + 1] those after ``steps`` [K, M]."""
    return np.take_along_axis(values, steps[..., None], axis=-1)[..., 0]


def record(
    env: "ReorientEnv",
    policy: Any,
    episodes: int,
    schedule: GoalSchedule = ONE_GOAL,
    *,
    ways: Sequence[Way] = (),
    tolerance: float = PAPER.success.rotation_rad,
    turns: np.ndarray | None = None,
    starts: np.ndarray | None = None,
    goals: np.ndarray | None = None,
    on_step: Callable[[], object] = lambda: None,
) -> Trace:
    """Run a policy and write down what happens.

    Errors are up to the symmetry that ``env.objects`` declare. All rounds are drawn before the
    first step, since how often environments reset depends on the policy and moves the random
    streams: so starts, goals and noise depend on the environment's configuration (seed and number
    of environments included), not on the policy.

    Args:
        env: An environment that no state ends (``success.rotation_rad`` of NEVER_RAD), as it was
            built; it knows the length of an episode.
        policy: What acts; one with ``predicted`` is told where it need not act any more.
        episodes: M.
        schedule: The goals.
        ways: What they stop at the first goal is held. Of goals in a row the first of them says
            when each is reached, if the true distance is within ``tolerance`` [rad].
        tolerance: See ``ways``.
        turns: Of goals in a row the rotations to each from where the object is then, ``draw_turns``
            [K, M, most, 4].
        starts: Initial orientations [K, M, 4]; None: the environment draws them.
        goals: Goal orientations [K, M, 4], with ``starts``.
        on_step: Called after every control step.
    """
    shape = (len(env.objects), episodes)
    hz = env.cfg.sim.control_hz
    first_step = round(schedule.first_s * hz)
    goal_steps = env.max_episode_steps if schedule.most == 1 else round(schedule.goal_s * hz)
    states = (*shape, first_step + goal_steps + 1)
    trace = Trace(
        schedule=schedule,
        first_step=first_step,
        start_quat=np.empty((*shape, 4)),
        goal_quat=np.empty((*shape, 4)),
        error=np.full(states, np.nan),
        exact=np.full(states, np.nan),
        action_norm=np.full(states, np.nan),
        predicted=np.full(states, np.nan) if hasattr(policy, "predicted") else None,
        steps=np.full(shape, first_step + goal_steps),
        fell=np.zeros(shape, dtype=bool),
        failed=np.zeros(shape, dtype=bool),
        still=np.zeros(states, dtype=bool),
        reached=np.zeros(shape, dtype=int),
        held={way: np.full(shape, np.nan) for way in ways if schedule.hold_s},
    )
    for numbers, state in drawn_rounds(env, episodes, starts, goals):
        env.load_state_dict(state)
        _Round(env, trace, numbers, goal_steps).run(policy, ways, tolerance, turns, on_step)
        if schedule.table_s is not None:
            env.sim.place_table(present=True)
    return trace


def drawn_rounds(
    env: "ReorientEnv", episodes: int, starts: np.ndarray | None, goals: np.ndarray | None
) -> list[tuple[np.ndarray, dict[str, Any]]]:
    """For every round the environments' episode numbers, -1 for none [N], and first state."""
    world_object = np.asarray(env.world_object)
    drawn = []
    for numbers in episode_rounds(world_object, len(env.objects), episodes):
        chosen = (world_object, np.maximum(numbers, 0))
        if starts is None or goals is None:
            env.reset()
        else:
            env.reset(starts[chosen].astype(np.float32), goals[chosen].astype(np.float32))
        drawn.append((numbers, env.state_dict()))
    return drawn


def motion_of(env: "ReorientEnv", *, copy: bool = False) -> dict[str, torch.Tensor]:
    """What moves, with a row for each environment, sharing the environment's memory or copied."""
    motion = {}
    for name, array in env.motion().items():
        rows = wp.to_torch(array).view(env.num_envs, -1)
        if rows.dtype == torch.uint32:  # which torch cannot index
            rows = rows.view(torch.int32)
        motion[name] = rows.clone() if copy else rows
    return motion


def copy_motion(
    out: dict[str, torch.Tensor], motion: dict[str, torch.Tensor], envs: np.ndarray
) -> None:
    """Copy the motion of some environments, by number, of what :func:`motion_of` gave."""
    for name, values in motion.items():
        rows = torch.from_numpy(envs).to(values.device)
        out[name][rows] = values[rows]


def act_in(env: "ReorientEnv", policy: Any, envs: np.ndarray) -> torch.Tensor:
    """Actions [N, D]; a policy with ``predicted`` is told that only some environments matter."""
    if hasattr(policy, "predicted"):
        policy.active = torch.zeros_like(policy.predicted, dtype=torch.bool)
        policy.active[torch.from_numpy(envs).to(policy.active.device)] = True
    action: torch.Tensor = policy.act(wp.to_torch(env.observation))
    return action


def advance(env: "ReorientEnv", action: torch.Tensor) -> None:
    """One control step of all environments with actions [N, D]."""
    env.step(wp.from_torch(action.detach().contiguous().float(), dtype=wp.float32))


def out_of_hand(env: "ReorientEnv") -> np.ndarray:
    """Whether each object is where it counts as lost, bool [N].

    What is not a number is lost too.
    """
    away = env.object_pose()[:, :3] - np.array(env.hand.workspace.goal_m)
    within = np.linalg.norm(away, axis=-1) < env.cfg.success.fall_of(env.hand.workspace)
    return np.asarray(~within)


class _Round:
    """One episode in every environment that has one.

    ``numbers`` [N], place among its object's, else -1.
    """

    def __init__(
        self, env: "ReorientEnv", trace: Trace, numbers: np.ndarray, goal_steps: int
    ) -> None:
        self._env = env
        self._trace = trace
        self._numbers = numbers
        self._objects = np.asarray(env.world_object)
        self._goal_steps = goal_steps
        table_s = trace.schedule.table_s
        self._table_step = None if table_s is None else round(table_s * env.cfg.sim.control_hz)
        self._goal = unit_quats(env.goal_quat.numpy())
        # When each environment's present goal was given, and the distance to it.
        self._given_at = np.full(env.num_envs, trace.first_step)
        self._exact = np.zeros(env.num_envs)
        # The state in which each way to stop ends an environment, after how many steps; -1: not
        # yet.
        self._stopped: dict[Way, tuple[np.ndarray, dict[str, torch.Tensor]]] = {}
        for way in trace.held:
            self._stopped[way] = (np.full(env.num_envs, -1), motion_of(env, copy=True))

    def run(
        self,
        policy: Any,
        ways: Sequence[Way],
        tolerance: float,
        turns: np.ndarray | None,
        on_step: Callable[[], object],
    ) -> None:
        """Go to the ends, then go on from the stops that are to be held."""
        env = self._env
        trace = self._trace
        envs = np.flatnonzero(self._numbers >= 0)
        self._begin(envs, 0, unit_quats(env.object_pose()[:, 3:7]))
        smoothed = wp.to_torch(env.smoothed)
        for step in range(env.max_episode_steps):
            if step == self._table_step:
                env.sim.place_table(present=False)
            norm = smoothed.norm(dim=-1).cpu().numpy()
            action = act_in(env, policy, envs)
            predicted = None if trace.predicted is None else policy.predicted.cpu().numpy()
            self._write_decision(envs, step, norm, predicted)
            acted = envs[step > self._given_at[envs]]  # before an action there is nothing to stop
            stops = {}
            for way in ways:
                rule, by = way
                distance = self._exact
                if by == "predicted":
                    assert predicted is not None
                    distance = predicted
                stopping = rule.stops(distance, norm)
                stops[way] = acted[stopping[acted]]
            self._keep_stops(stops, step)
            due = np.array([], dtype=int)
            if trace.schedule.most > 1:
                stopped = stops[ways[0]]
                due = stopped[self._exact[stopped] <= tolerance]
                self._close(stopped, step + 1)
                trace.reached[self._place(due)] += 1
                envs = np.setdiff1d(envs, np.setdiff1d(stopped, due))
            advance(env, action)
            quat = unit_quats(env.object_pose_end.numpy()[:, 3:7])
            envs = self._write_outcome(envs, step + 1, quat)
            if turns is not None:
                if step + 1 == trace.first_step:
                    due = envs
                self._give(np.intersect1d(due, envs), step + 1, quat, turns)
                late = envs[step + 1 - self._given_at[envs] >= self._goal_steps]
                self._close(late, step + 1)
                envs = np.setdiff1d(envs, late)
            on_step()
            if not len(envs):
                break
        for way in trace.held:
            self._hold(way)

    def _place(self, envs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Object and number of the episodes of environments."""
        return self._objects[envs], self._numbers[envs]

    def _at_first(self, envs: np.ndarray) -> np.ndarray:
        """The environments that have reached no goal yet: there is a record of these alone."""
        return envs[self._trace.reached[self._place(envs)] == 0]

    def _begin(self, envs: np.ndarray, step: int, quat: np.ndarray) -> None:
        """Write down where the first goal begins; ``quat`` [N, 4] are the objects' orientations."""
        self._trace.start_quat[self._place(envs)] = quat[envs]
        self._trace.goal_quat[self._place(envs)] = self._goal[envs]
        self._write_errors(envs, step, quat)

    def _write_decision(
        self, envs: np.ndarray, step: int, norm: np.ndarray, predicted: np.ndarray | None
    ) -> None:
        """Write what led to the state after ``step`` steps, and what a policy predicts there."""
        envs = self._at_first(envs)
        if not len(envs):
            return
        place = (*self._place(envs), step)
        self._trace.action_norm[place] = norm[envs]
        if predicted is not None:
            assert self._trace.predicted is not None
            self._trace.predicted[place] = predicted[envs]

    def _write_errors(self, envs: np.ndarray, step: int, quat: np.ndarray) -> None:
        """Write the errors of environments after ``step`` steps."""
        trace = self._trace
        self._exact[envs] = rotation_distance(quat[envs], self._goal[envs])
        envs = self._at_first(envs)
        if not len(envs):
            return
        objects, numbers = self._place(envs)
        trace.exact[objects, numbers, step] = self._exact[envs]
        for k in np.unique(objects):
            rows = objects == k
            symmetry = self._env.objects[k].symmetry
            error = symmetric_error(quat[envs[rows]], self._goal[envs[rows]], symmetry)
            trace.error[k, numbers[rows], step] = error

    def _write_outcome(self, envs: np.ndarray, step: int, quat: np.ndarray) -> np.ndarray:
        """Write what a step led to; the environments whose episodes go on."""
        env = self._env
        trace = self._trace
        self._write_errors(envs, step, quat)
        first = self._at_first(envs)
        if len(first):
            trace.still[(*self._place(first), step)] = env.still.numpy()[first] != 0
        trace.failed[self._place(envs)] = env.sim.failed.numpy()[envs] != 0
        done = envs[env.done.numpy()[envs] != 0]
        trace.fell[self._place(done)] = env.fell.numpy()[done] != 0
        self._close(done, step)
        envs = np.setdiff1d(envs, done)
        return envs[trace.reached[self._place(envs)] < trace.schedule.most]

    def _close(self, envs: np.ndarray, step: int) -> None:
        """End the records of the environments that have one, after ``step`` steps."""
        self._trace.steps[self._place(self._at_first(envs))] = step

    def _give(self, envs: np.ndarray, step: int, quat: np.ndarray, turns: np.ndarray) -> None:
        """Give environments their next goals, each turned from where the object is."""
        if not len(envs):
            return
        place = self._place(envs)
        turn = Rotation.from_quat(turns[(*place, self._trace.reached[place])])
        present = Rotation.from_quat(self._env.object_pose()[envs, 3:7])
        self._goal[envs] = (turn * present).as_quat()
        self._env.give_goals(envs, self._goal[envs])
        self._given_at[envs] = step
        if step == self._trace.first_step:
            self._begin(envs, step, quat)
        else:
            self._write_errors(envs, step, quat)

    def _keep_stops(self, stops: dict[Way, np.ndarray], step: int) -> None:
        """Keep the states of environments that a way to stop ends after ``step`` steps."""
        for way, (after, state) in self._stopped.items():
            chosen = stops[way]
            chosen = chosen[after[chosen] < 0]
            after[chosen] = step
            if len(chosen):
                copy_motion(state, motion_of(self._env), chosen)

    def _hold(self, way: Way) -> None:
        """Go on from the stops with the last targets, and write down what came of them."""
        env = self._env
        after, state = self._stopped[way]
        envs = np.flatnonzero(after >= 0)
        if not len(envs):
            return
        live = motion_of(env)
        everywhere = np.arange(env.num_envs)
        copy_motion(live, state, everywhere)
        lost = np.zeros(env.num_envs, dtype=bool)
        for step in range(round(self._trace.schedule.hold_s * env.cfg.sim.control_hz)):
            if self._table_step is not None:
                steps = wp.array(after + step, dtype=wp.int32, device=env.device)
                last = np.full(env.num_envs, self._table_step)
                env.sim.place_tables(steps, wp.array(last, dtype=wp.int32, device=env.device))
            env.hold()
            away = out_of_hand(env)
            lost |= away
            copy_motion(live, state, np.flatnonzero(away))  # or it would fall for half a minute
        place = self._place(envs)
        quat = unit_quats(env.object_pose()[envs, 3:7])
        error = rotation_distance(quat, self._trace.goal_quat[place])
        self._trace.held[way][place] = np.where(lost[envs], np.pi, error)
