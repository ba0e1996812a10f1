"""Episodes that nothing stops: what happened at every step, so that any rule for stopping can be judged.

Whoever stops a policy, its own prediction or the true distance, does not change what it does before: one run
serves all rules. What comes after a stop is simulated apart: the hand keeps its last targets for HOLD_S.
K objects, M episodes each, T steps; angles in radians, quaternions xyzw.
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
"""What a rule asks for: a distance, which is a camera policy's prediction, or the true one to the very goal,
or to what looks like it; or the success criteria of training, which are the true one and stillness."""
NEVER_RAD = 1e-9
"""Orientation tolerance that no state meets: an environment with it stops no episode."""


def air_table_steps(control_hz: float) -> int:
    """Control steps at this rate [Hz] after which the paper's in-air test takes the table away."""
    return round(PAPER.scene.air_table_s * control_hz)


@dataclass(frozen=True)
class Episode:
    """One start and one goal of one object, to its end or stop."""

    object_index: int
    start_quat: tuple[float, float, float, float]
    """Object orientation at the reset."""
    goal_quat: tuple[float, float, float, float]
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
class Hold:
    """What became of stopped episodes while the hand held its last targets; NaN where nothing stopped [K, M].

    Attributes:
        rule: What stopped them.
        by: The distance it asked for.
        error: Orientation error afterwards, up to the object's symmetry; pi where it was lost.
        exact: The same to the very goal.
    """

    rule: StoppingRule
    by: StopsBy
    error: np.ndarray
    exact: np.ndarray


@dataclass(frozen=True)
class Trace:
    """Episodes to their falls or time limits.

    Attributes:
        start_quat: Orientation of the object at the reset [K, M, 4].
        goal_quat: Wanted orientation [K, M, 4].
        error: Orientation error after t steps, up to the object's symmetry, NaN after the end [K, M, T + 1].
        exact: The same without symmetry [K, M, T + 1].
        action_norm: Norm of the smoothed action that led there, NaN after the end [K, M, T + 1].
        predicted: What a camera policy predicts of ``error`` there; None for other policies [K, M, T + 1].
        steps: Steps to the fall or the time limit [K, M].
        fell: Whether the object was lost [K, M].
        still: Whether hand and object are as still after t steps as success asks; None: not known
            [K, M, T + 1].
        holds: What came after the stops, of the rules that were to be held.
    """

    start_quat: np.ndarray
    goal_quat: np.ndarray
    error: np.ndarray
    exact: np.ndarray
    action_norm: np.ndarray
    predicted: np.ndarray | None
    steps: np.ndarray
    fell: np.ndarray
    still: np.ndarray | None = None
    holds: list[Hold] = field(default_factory=list)

    def of(self, objects: Sequence[int]) -> "Trace":
        """The episodes of some objects."""
        chosen = list(objects)
        parts: dict[str, Any] = {
            k: v[chosen] if isinstance(v, np.ndarray) else v for k, v in vars(self).items()
        }
        parts["holds"] = [Hold(h.rule, h.by, h.error[chosen], h.exact[chosen]) for h in self.holds]
        return Trace(**parts)

    def hold(self, rule: StoppingRule, by: StopsBy) -> Hold | None:
        """What came after the stops of a rule; None if that was not to be held."""
        return next((hold for hold in self.holds if (hold.rule, hold.by) == (rule, by)), None)

    def ends(self, rule: StoppingRule, by: StopsBy) -> tuple[np.ndarray, np.ndarray]:
        """Where a rule ends every episode.

        Args:
            rule: Bounds of distance and action norm.
            by: What it asks for; of success the bound of the action's norm is the environment's.

        Returns:
            Steps to the stop, fall or time limit, and whether the rule stopped it, shape [K, M] each.

        Raises:
            ValueError: The record does not have what it asks for.
        """
        last = self.steps - 1  # nobody acts on, or predicts, the state after the last step
        with np.errstate(invalid="ignore"):  # NaN stops nothing
            if by == "success":
                if self.still is None:
                    raise ValueError("this record does not know what is still; stop by the true distance")
                stops = (self.exact <= rule.distance_rad) & self.still
                last = self.steps - self.fell  # but the environment sees it; a fall is no success
            else:
                distance = {"predicted": self.predicted, "exact": self.exact, "error": self.error}[by]
                if distance is None:
                    raise ValueError("only camera policies predict distances; stop by the true distance")
                stops = (distance < rule.distance_rad) & (self.action_norm < rule.action_norm)
        stops[..., 0] = False  # before the first action there is nothing to stop
        stops &= np.arange(stops.shape[-1]) <= last[..., None]
        stopped: np.ndarray = np.asarray(stops.any(axis=-1))
        return np.where(stopped, stops.argmax(axis=-1), self.steps), stopped

    def episodes(self, rule: StoppingRule, by: StopsBy) -> tuple[Episode, ...]:
        """The episodes as a rule ends them, object by object; arguments as of :meth:`ends`."""
        steps, stopped = self.ends(rule, by)
        error, exact = (
            np.take_along_axis(values, steps[..., None], axis=-1)[..., 0]
            for values in (self.error, self.exact)
        )
        return tuple(
            Episode(
                object_index=k,
                start_quat=_quat(self.start_quat[k, m]),
                goal_quat=_quat(self.goal_quat[k, m]),
                start_error_rad=float(self.error[k, m, 0]),
                error_rad=float(error[k, m]),
                exact_error_rad=float(exact[k, m]),
                steps=int(steps[k, m]),
                stopped=bool(stopped[k, m]),
                fell=bool(self.fell[k, m] and not stopped[k, m]),
            )
            for k, m in np.ndindex(*steps.shape)
        )


def record(
    env: Any,
    policy: Any,
    episodes: int,
    *,
    starts: np.ndarray | None = None,
    goals: np.ndarray | None = None,
    table_steps: int | None = None,
    held: Sequence[tuple[StoppingRule, StopsBy]] = (),
    on_step: Callable[[], object] = lambda: None,
) -> Trace:
    """Run a policy and write down what happens.

    Errors are up to the symmetry that ``env.objects`` declare. All rounds are drawn before the first step,
    since how often environments reset depends on the policy and moves the random streams: so starts, goals
    and noise depend on the environment's configuration (seed and number of environments included), not on the
    policy.

    Args:
        env: An environment that no state ends (``success.rotation_rad`` of NEVER_RAD), as it was built.
        policy: What acts; one with ``predicted`` is told where it need not act any more.
        episodes: M.
        starts: Initial orientations [K, M, 4]; None: the environment draws them.
        goals: Goal orientations [K, M, 4], with ``starts``.
        table_steps: Steps after which the table is taken away; None: never.
        held: Rules whose stops are to be held for HOLD_S.
        on_step: Called after every control step.
    """
    world_object = np.asarray(env.world_object)
    symmetry = [item.symmetry for item in env.objects]
    shape = (len(env.objects), episodes)
    length = env.max_episode_steps + 1
    predicts = hasattr(policy, "predicted")
    trace = Trace(
        start_quat=np.empty((*shape, 4)),
        goal_quat=np.empty((*shape, 4)),
        error=np.full((*shape, length), np.nan),
        exact=np.full((*shape, length), np.nan),
        action_norm=np.full((*shape, length), np.nan),
        predicted=np.full((*shape, length), np.nan) if predicts else None,
        steps=np.full(shape, env.max_episode_steps),
        fell=np.zeros(shape, dtype=bool),
        still=np.zeros((*shape, length), dtype=bool),
        holds=[Hold(rule, by, np.full(shape, np.nan), np.full(shape, np.nan)) for rule, by in held],
    )
    rounds, drawn = episode_rounds(world_object, *shape), []
    for numbers in rounds:
        chosen = world_object, np.maximum(numbers, 0)
        env.reset(*(None if quat is None else quat[chosen].astype(np.float32) for quat in (starts, goals)))
        drawn.append(env.state_dict())
    for numbers, state in zip(rounds, drawn, strict=True):
        if table_steps is not None:
            env.sim.place_table(present=True)
        env.load_state_dict(state)
        stops = [_Stops(env, hold) for hold in trace.holds]
        _record_round(env, policy, numbers, trace, symmetry, table_steps, on_step, stops)
        for one in stops:
            one.hold(numbers, trace.goal_quat, symmetry, table_steps)
    if table_steps is not None:
        env.sim.place_table(present=True)
    return trace


class _Stops:
    """The states in which a rule stops the environments of a round; of others those of its beginning."""

    def __init__(self, env: Any, hold: Hold) -> None:
        self._env, self._hold = env, hold
        self._state = {name: _rows(array, env.num_envs).clone() for name, array in env.motion().items()}
        self._after = np.full(env.num_envs, -1)

    def look(self, step: int, trace: Trace, envs: np.ndarray, place: tuple[np.ndarray, np.ndarray]) -> None:
        """Keep the states of environments, those of ``place``, that the rule stops after ``step`` steps."""
        rule, by = self._hold.rule, self._hold.by
        distance = {"predicted": trace.predicted, "exact": trace.exact, "error": trace.error}.get(by)
        assert distance is not None  # what success criteria stop is not held
        near = distance[(*place, step)] < rule.distance_rad
        stops = near & (trace.action_norm[(*place, step)] < rule.action_norm) & (self._after[envs] < 0)
        if step == 0 or not stops.any():
            return
        self._after[envs[stops]] = step
        for name, array in self._env.motion().items():
            live, kept = _rows(array, self._env.num_envs), self._state[name]
            rows = torch.from_numpy(envs[stops]).to(kept.device)
            kept[rows] = live[rows]

    def hold(
        self,
        numbers: np.ndarray,
        goals: np.ndarray,
        symmetry: Sequence[np.ndarray],
        table_steps: int | None,
    ) -> None:
        """Go on from the stops with the last targets, and write down what came of them."""
        env = self._env
        envs = np.flatnonzero(self._after >= 0)
        if not len(envs):
            return
        for name, array in env.motion().items():
            _rows(array, env.num_envs).copy_(self._state[name])
        place = np.asarray(env.world_object)[envs], numbers[envs]
        lost = np.zeros(len(envs), dtype=bool)
        for step in range(round(HOLD_S * env.cfg.sim.control_hz)):
            if table_steps is not None:
                env.sim.place_tables(*_int_arrays(env, self._after + step, table_steps))
            env.hold()
            away = env.object_pose()[envs, :3] - np.array(PAPER.scene.goal_position_m)
            lost |= ~(np.linalg.norm(away, axis=-1) < env.cfg.success.fall_m)  # not a number is lost too
        quat, goal = unit_quats(env.object_pose()[envs, 3:7]), goals[place]
        exact = rotation_angle(quat, goal)
        error = np.array(
            [symmetric_error(q, g, symmetry[k]) for q, g, k in zip(quat, goal, place[0], strict=True)]
        )
        self._hold.exact[place] = np.where(lost, np.pi, exact)
        self._hold.error[place] = np.where(lost, np.pi, error)


def _rows(array: wp.array, envs: int) -> torch.Tensor:
    """An array of all environments with a row for each, sharing its memory."""
    rows = wp.to_torch(array).view(envs, -1)
    return rows.view(torch.int32) if rows.dtype == torch.uint32 else rows  # torch cannot index the other


def _int_arrays(env: Any, *values: Any) -> list[wp.array]:
    """One number, or one of each environment, as device arrays [N]."""
    rows = (np.broadcast_to(np.asarray(value, dtype=np.int32), env.num_envs) for value in values)
    return [wp.array(row, dtype=wp.int32, device=env.device) for row in rows]


def _record_round(
    env: Any,
    policy: Any,
    numbers: np.ndarray,
    trace: Trace,
    symmetry: Sequence[np.ndarray],
    table_steps: int | None,
    on_step: Callable[[], object],
    stops: Sequence[_Stops],
) -> None:
    """One episode in environments that have one; ``numbers`` [N]: place among its object's, -1 for none."""
    envs = np.flatnonzero(numbers >= 0)
    place = np.asarray(env.world_object)[envs], numbers[envs]
    goal = unit_quats(env.goal_quat.numpy())[envs]
    quat = unit_quats(env.object_pose()[:, 3:7])[envs]
    trace.start_quat[place], trace.goal_quat[place] = quat, goal
    _write_errors(trace, symmetry, place, 0, quat, goal)
    alive = np.ones(len(envs), dtype=bool)
    smoothed = wp.to_torch(env.smoothed)
    for step in range(env.max_episode_steps):
        if step == table_steps:
            env.sim.place_table(present=False)
        living = place[0][alive], place[1][alive]
        trace.action_norm[(*living, step)] = smoothed.norm(dim=-1).cpu().numpy()[envs][alive]
        if trace.predicted is not None:
            policy.active = _mask(envs[alive], env.num_envs, smoothed.device)
        action = policy.act(wp.to_torch(env.observation))
        if trace.predicted is not None:
            trace.predicted[(*living, step)] = policy.predicted.cpu().numpy()[envs][alive]
        for one in stops:
            one.look(step, trace, envs[alive], living)
        env.step(wp.from_torch(action.detach().contiguous().float(), dtype=wp.float32))
        quat = unit_quats(env.object_pose_end.numpy()[:, 3:7])[envs]
        _write_errors(trace, symmetry, living, step + 1, quat[alive], goal[alive])
        assert trace.still is not None
        trace.still[(*living, step + 1)] = env.still.numpy()[envs][alive] != 0
        ended = (env.done.numpy()[envs] != 0) & alive
        last = place[0][ended], place[1][ended]
        trace.fell[last] = env.fell.numpy()[envs][ended] != 0
        trace.steps[last] = step + 1
        alive &= ~ended
        on_step()
        if not alive.any():
            return


def _mask(envs: np.ndarray, count: int, device: torch.device) -> torch.Tensor:
    """True at some environments [N]."""
    mask = torch.zeros(count, dtype=torch.bool, device=device)
    mask[torch.from_numpy(envs).to(device)] = True
    return mask


def _write_errors(
    trace: Trace,
    symmetry: Sequence[np.ndarray],
    place: tuple[np.ndarray, np.ndarray],
    step: int,
    quat: np.ndarray,
    goal: np.ndarray,
) -> None:
    """Write the errors of some episodes after ``step`` steps."""
    trace.exact[(*place, step)] = rotation_angle(quat, goal)
    for k in np.unique(place[0]):
        rows = place[0] == k
        error = symmetric_error(quat[rows], goal[rows], symmetry[k])
        trace.error[k, place[1][rows], step] = error


def _quat(values: np.ndarray) -> tuple[float, float, float, float]:
    x, y, z, w = (float(value) for value in values)
    return x, y, z, w
