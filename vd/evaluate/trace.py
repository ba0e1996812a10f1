"""Episodes that nothing stops.

What happened at every step, so that any rule for stopping can be judged.

Whoever stops a policy, its own prediction or the true distance, does not change what it does
before: one run
serves all rules. What comes after a stop is simulated apart: the hand keeps its last targets for
HOLD_S. K objects, M episodes each, T steps; angles in radians, quaternions xyzw.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
import warp as wp

from vd.evaluate.rollout import episode_rounds, unit_quats
from vd.evaluate.statistics import rotation_angle, symmetric_error
from vd.paper import PAPER
from vd.stopping import StoppingRule

HOLD_S = 2.0
"""For how long a hand holds its object after a stop, before it is looked at again [s] (ours)."""
StopsBy = Literal["predicted", "exact", "error", "success"]
"""What a rule asks for: a distance, which is a camera policy's prediction, or the true one to the
very goal, or to what looks like it; or the success criteria of training, which are the true one and
stillness.
"""
Way = tuple[StoppingRule, StopsBy]
"""A rule, and what it asks for."""
NEVER_RAD = 1e-9
"""Orientation tolerance that no state meets: an environment with it stops no episode."""


def air_table_steps(control_hz: float) -> int:
    """Control steps at this rate [Hz] after which the paper's in-air test takes the table away."""
    return round(PAPER.scene.air_table_s * control_hz)


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
    """Episodes to their falls or time limits.

    Attributes:
        start_quat: Orientation of the object at the reset [K, M, 4].
        goal_quat: Wanted orientation [K, M, 4].
        error: Orientation error after t steps, up to the object's symmetry, NaN after the end [K,
            M, T + 1].
        exact: The same without symmetry [K, M, T + 1].
        action_norm: Norm of the smoothed action that led there, NaN after the end [K, M, T + 1].
        predicted: What a camera policy predicts of ``error`` there; None for other policies [K, M,
            T + 1].
        steps: Steps to the fall or the time limit [K, M].
        fell: Whether the object was lost [K, M].
        failed: Whether the physics failed, which ends an episode like the time limit [K, M].
        still: Whether hand and object are as still after t steps as success asks [K, M, T + 1].
        held: By the way to stop that was to be held: error to the very goal after the hold, pi
            where the object was lost, NaN where nothing stopped [K, M].
    """

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
    held: dict[Way, np.ndarray] = field(default_factory=dict)

    def of(self, objects: Sequence[int]) -> "Trace":
        """The episodes of some objects."""
        chosen = list(objects)
        parts: dict[str, Any] = {
            name: value[chosen] if isinstance(value, np.ndarray) else value
            for name, value in vars(self).items()
        }
        return Trace(**parts | {"held": {way: error[chosen] for way, error in self.held.items()}})

    def ends(self, rule: StoppingRule, by: StopsBy) -> tuple[np.ndarray, np.ndarray]:
        """Where a rule ends every episode.

        Args:
            rule: Bounds of distance and action norm.
            by: What it asks for; of success the bound of the action's norm is the environment's.

        Returns:
            Steps to the stop, fall or time limit, and whether the rule stopped it, shape [K, M]
            each.
        """
        if by == "success":
            stops = (self.exact <= rule.distance_rad) & self.still
            last = self.steps - self.fell  # a fall is no success
        else:
            stops = rule.stops(getattr(self, by), self.action_norm)
            last = self.steps - 1  # nobody acts on, or predicts, the state after the last step
        stops[..., 0] = False  # before the first action there is nothing to stop
        stops &= np.arange(stops.shape[-1]) <= last[..., None]
        stopped: np.ndarray = np.asarray(stops.any(axis=-1))
        return np.where(stopped, stops.argmax(axis=-1), self.steps), stopped

    def episodes(self, rule: StoppingRule, by: StopsBy) -> tuple[Episode, ...]:
        """The episodes as a rule ends them, object by object; arguments as of :meth:`ends`."""
        steps, stopped = self.ends(rule, by)
        return episodes_of(
            start_quat=self.start_quat,
            goal_quat=self.goal_quat,
            start_error_rad=self.error[..., 0],
            error_rad=at_steps(self.error, steps),
            exact_error_rad=at_steps(self.exact, steps),
            steps=steps,
            stopped=stopped,
            fell=self.fell & ~stopped,
        )


def at_steps(values: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Of values after t steps [K, M, T + 1] those after ``steps`` [K, M]."""
    return np.take_along_axis(values, steps[..., None], axis=-1)[..., 0]


def episodes_of(**columns: np.ndarray) -> tuple[Episode, ...]:
    """Episodes, object by object, from columns [K, M, ..] of all their fields but the first."""
    places = np.ndindex(*columns["steps"].shape)
    rows = (
        (k, {name: values[k, m].tolist() for name, values in columns.items()}) for k, m in places
    )
    return tuple(
        Episode(k, **row | {name: tuple(row[name]) for name in ("start_quat", "goal_quat")})
        for k, row in rows
    )


def record(
    env: Any,
    policy: Any,
    episodes: int,
    *,
    starts: np.ndarray | None = None,
    goals: np.ndarray | None = None,
    table_steps: int | None = None,
    held: Sequence[Way] = (),
    on_step: Callable[[], object] = lambda: None,
) -> Trace:
    """Run a policy and write down what happens.

    Errors are up to the symmetry that ``env.objects`` declare. All rounds are drawn before the
    first step, since how often environments reset depends on the policy and moves the random
    streams: so starts, goals and noise depend on the environment's configuration (seed and number
    of environments included), not on the policy.

    Args:
        env: An environment that no state ends (``success.rotation_rad`` of NEVER_RAD), as it was
            built.
        policy: What acts; one with ``predicted`` is told where it need not act any more.
        episodes: M.
        starts: Initial orientations [K, M, 4]; None: the environment draws them.
        goals: Goal orientations [K, M, 4], with ``starts``.
        table_steps: Steps after which the table is taken away; None: never.
        held: What stops is to be held for HOLD_S.
        on_step: Called after every control step.
    """
    shape = (len(env.objects), episodes)

    def blank() -> np.ndarray:
        return np.full((*shape, env.max_episode_steps + 1), np.nan)

    trace = Trace(
        start_quat=np.empty((*shape, 4)),
        goal_quat=np.empty((*shape, 4)),
        error=blank(),
        exact=blank(),
        action_norm=blank(),
        predicted=blank() if hasattr(policy, "predicted") else None,
        steps=np.full(shape, env.max_episode_steps),
        fell=np.zeros(shape, dtype=bool),
        failed=np.zeros(shape, dtype=bool),
        still=np.zeros((*shape, env.max_episode_steps + 1), dtype=bool),
        held={way: np.full(shape, np.nan) for way in held},
    )
    for numbers, state in drawn_rounds(env, episodes, starts, goals):
        if table_steps is not None:
            env.sim.place_table(present=True)
        env.load_state_dict(state)
        _Round(env, trace, numbers, table_steps).run(policy, on_step)
    if table_steps is not None:
        env.sim.place_table(present=True)
    return trace


def drawn_rounds(
    env: Any, episodes: int, starts: np.ndarray | None, goals: np.ndarray | None
) -> list[tuple[np.ndarray, dict[str, Any]]]:
    """Episode number of each environment, -1 for none [N], and its state at the begin, for every round."""
    world_object, drawn = np.asarray(env.world_object), []
    for numbers in episode_rounds(world_object, len(env.objects), episodes):
        chosen = world_object, np.maximum(numbers, 0)
        env.reset(
            *(None if quat is None else quat[chosen].astype(np.float32) for quat in (starts, goals))
        )
        drawn.append((numbers, env.state_dict()))
    return drawn


def motion_of(env: Any, *, copy: bool = False) -> dict[str, torch.Tensor]:
    """What moves, with a row for each environment, sharing the environment's memory or copied."""
    found = {}
    for name, array in env.motion().items():
        rows = wp.to_torch(array).view(env.num_envs, -1)
        rows = (
            rows.view(torch.int32) if rows.dtype == torch.uint32 else rows
        )  # the other has no index
        found[name] = rows.clone() if copy else rows
    return found


def copy_motion(
    out: dict[str, torch.Tensor], motion: dict[str, torch.Tensor], envs: np.ndarray
) -> None:
    """Copy the motion of some environments, by number, of what :func:`motion_of` gave."""
    for name, values in motion.items():
        rows = torch.from_numpy(envs).to(values.device)
        out[name][rows] = values[rows]


def act_in(env: Any, policy: Any, envs: np.ndarray) -> torch.Tensor:
    """Actions [N, D]; a policy with ``predicted`` is told that it need not act but in some environments."""
    if hasattr(policy, "predicted"):
        policy.active = torch.zeros_like(policy.predicted, dtype=torch.bool)
        policy.active[torch.from_numpy(envs).to(policy.active.device)] = True
    action: torch.Tensor = policy.act(wp.to_torch(env.observation))
    return action


def advance(env: Any, action: torch.Tensor) -> None:
    """One control step of all environments with actions [N, D]."""
    env.step(wp.from_torch(action.detach().contiguous().float(), dtype=wp.float32))


def out_of_hand(env: Any) -> np.ndarray:
    """Whether each object is where it counts as lost, bool [N].

    What is not a number is lost too.
    """
    away = env.object_pose()[:, :3] - np.array(env.hand.workspace.goal_m)
    return np.asarray(
        ~(np.linalg.norm(away, axis=-1) < env.cfg.success.fall_of(env.hand.workspace))
    )


class _Round:
    """One episode in every environment that has one.

    ``numbers`` [N], place among its object's, else -1.
    """

    def __init__(
        self, env: Any, trace: Trace, numbers: np.ndarray, table_steps: int | None
    ) -> None:
        self._env, self._trace, self._numbers, self._table_steps = env, trace, numbers, table_steps
        self._objects = np.asarray(env.world_object)
        # The state in which each way to stop ends an environment, after how many steps; -1: not
        # yet.
        self._stopped = {
            way: (np.full(env.num_envs, -1), motion_of(env, copy=True)) for way in trace.held
        }

    def run(self, policy: Any, on_step: Callable[[], object]) -> None:
        """Go to the ends, then go on from the stops that are to be held."""
        env, trace = self._env, self._trace
        envs = np.flatnonzero(self._numbers >= 0)
        trace.start_quat[self._place(envs)] = quat = unit_quats(env.object_pose()[envs, 3:7])
        trace.goal_quat[self._place(envs)] = unit_quats(env.goal_quat.numpy()[envs])
        self._write_errors(envs, 0, quat)
        smoothed = wp.to_torch(env.smoothed)
        for step in range(env.max_episode_steps):
            if step == self._table_steps:
                env.sim.place_table(present=False)
            place = self._place(envs)
            trace.action_norm[(*place, step)] = smoothed.norm(dim=-1).cpu().numpy()[envs]
            action = act_in(env, policy, envs)
            if trace.predicted is not None:
                trace.predicted[(*place, step)] = policy.predicted.cpu().numpy()[envs]
            self._keep_stops(envs, step)
            advance(env, action)
            self._write_errors(envs, step + 1, unit_quats(env.object_pose_end.numpy()[envs, 3:7]))
            trace.still[(*place, step + 1)] = env.still.numpy()[envs] != 0
            trace.failed[place] = env.sim.failed.numpy()[envs] != 0
            done = env.done.numpy()[envs] != 0
            trace.fell[self._place(envs[done])] = env.fell.numpy()[envs[done]] != 0
            trace.steps[self._place(envs[done])] = step + 1
            envs = envs[~done]
            on_step()
            if not len(envs):
                break
        for way in trace.held:
            self._hold(way)

    def _place(self, envs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Object and number of the episodes of environments."""
        return self._objects[envs], self._numbers[envs]

    def _write_errors(self, envs: np.ndarray, step: int, quat: np.ndarray) -> None:
        """Write the errors of environments after ``step`` steps."""
        trace, (objects, numbers) = self._trace, self._place(envs)
        goal = trace.goal_quat[objects, numbers]
        trace.exact[objects, numbers, step] = rotation_angle(quat, goal)
        for k in np.unique(objects):
            rows = objects == k
            error = symmetric_error(quat[rows], goal[rows], self._env.objects[k].symmetry)
            trace.error[k, numbers[rows], step] = error

    def _keep_stops(self, envs: np.ndarray, step: int) -> None:
        """Keep the states of environments that are stopped after ``step`` steps."""
        place = (*self._place(envs), step)
        for (rule, by), (after, state) in self._stopped.items():
            stops = rule.stops(getattr(self._trace, by)[place], self._trace.action_norm[place])
            chosen = envs[stops & (after[envs] < 0)]
            if step == 0 or not len(chosen):
                continue
            after[chosen] = step
            copy_motion(state, motion_of(self._env), chosen)

    def _hold(self, way: Way) -> None:
        """Go on from the stops with the last targets, and write down what came of them."""
        env, (after, state) = self._env, self._stopped[way]
        envs = np.flatnonzero(after >= 0)
        if not len(envs):
            return
        for name, live in motion_of(env).items():
            live.copy_(state[name])
        lost = np.zeros(len(envs), dtype=bool)
        for step in range(round(HOLD_S * env.cfg.sim.control_hz)):
            if self._table_steps is not None:
                counts = (after + step, np.full(env.num_envs, self._table_steps))
                env.sim.place_tables(
                    *(wp.array(count, dtype=wp.int32, device=env.device) for count in counts)
                )
            env.hold()
            lost |= out_of_hand(env)[envs]
        place = self._place(envs)
        error = rotation_angle(
            unit_quats(env.object_pose()[envs, 3:7]), self._trace.goal_quat[place]
        )
        self._trace.held[way][place] = np.where(lost, np.pi, error)
