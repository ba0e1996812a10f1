"""Episodes that nothing stops: what happened at every step, so that any rule for stopping can be judged.

Whoever stops a policy, its own prediction or the true distance, does not change what it does before: one run
serves all rules. K objects, M episodes each, T steps; angles in radians, quaternions xyzw.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from vd.evaluate.result import Episode
from vd.evaluate.rollout import episode_rounds, unit_quats
from vd.evaluate.statistics import rotation_angle, symmetric_error
from vd.student.stopping import StoppingRule

NEVER_RAD = 1e-9
"""Orientation tolerance that no state meets: an environment with it stops no episode."""


@dataclass(frozen=True)
class Trace:
    """Episodes to their falls or time limits.

    Attributes:
        start_quat: Orientation of the object at the reset [K, M, 4].
        goal_quat: Wanted orientation [K, M, 4].
        error: Orientation error after t steps, up to the object's symmetry, NaN after the end [K, M, T + 1].
        exact: The same without symmetry [K, M, T + 1].
        action_norm: Norm of the smoothed action that led there, NaN after the end [K, M, T + 1].
        predicted: What a student predicts of ``error`` there; None for other policies [K, M, T + 1].
        steps: Steps to the fall or the time limit [K, M].
        fell: Whether the object was lost [K, M].
    """

    start_quat: np.ndarray
    goal_quat: np.ndarray
    error: np.ndarray
    exact: np.ndarray
    action_norm: np.ndarray
    predicted: np.ndarray | None
    steps: np.ndarray
    fell: np.ndarray

    def of(self, objects: Sequence[int]) -> "Trace":
        """The episodes of some objects."""
        chosen = list(objects)
        parts: dict[str, Any] = {k: None if v is None else v[chosen] for k, v in vars(self).items()}
        return Trace(**parts)

    def ends(self, rule: StoppingRule, *, by_prediction: bool) -> tuple[np.ndarray, np.ndarray]:
        """Where a rule ends every episode.

        Args:
            rule: Bounds of distance and action norm.
            by_prediction: Ask the student's prediction, or the true distance.

        Returns:
            Steps to the stop, fall or time limit, and whether the rule stopped it, shape [K, M] each.
        """
        distance = self.predicted if by_prediction else self.error
        if distance is None:
            raise ValueError("only a student predicts distances; stop by the true distance")
        with np.errstate(invalid="ignore"):  # NaN stops nothing
            stops = (distance < rule.distance_rad) & (self.action_norm < rule.action_norm)
        stops[..., 0] = False  # before the first action there is nothing to stop
        after = np.arange(stops.shape[-1])
        stops &= after < self.steps[..., None]  # nobody sees the state after the last step
        stopped: np.ndarray = np.asarray(stops.any(axis=-1))
        return np.where(stopped, stops.argmax(axis=-1), self.steps), stopped

    def episodes(self, rule: StoppingRule, *, by_prediction: bool) -> tuple[Episode, ...]:
        """The episodes as a rule ends them, object by object; arguments as of :meth:`ends`."""
        steps, stopped = self.ends(rule, by_prediction=by_prediction)
        error = np.take_along_axis(self.error, steps[..., None], axis=-1)[..., 0]
        return tuple(
            Episode(
                object_index=k,
                start_quat=_quat(self.start_quat[k, m]),
                goal_quat=_quat(self.goal_quat[k, m]),
                start_error_rad=float(self.error[k, m, 0]),
                error_rad=float(error[k, m]),
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
    on_step: Callable[[], object] = lambda: None,
) -> Trace:
    """Run a policy and write down what happens.

    Errors are up to the symmetry that ``env.objects`` declare.

    Args:
        env: An environment that no state ends (``success.rotation_rad`` of NEVER_RAD), as it was built.
        policy: What acts; one with ``predicted`` is a student, and is told where it need not act any more.
        episodes: M.
        starts: Initial orientations [K, M, 4]; None: the environment draws them, all before the first step.
        goals: Goal orientations [K, M, 4], with ``starts``.
        table_steps: Steps after which the table is taken away; None: never.
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
    )
    rounds = episode_rounds(world_object, *shape)
    drawn = []
    if starts is None:
        for _ in rounds:
            env.reset()
            drawn.append(env.state_dict())
    for index, numbers in enumerate(rounds):
        if table_steps is not None:
            env.sim.place_table(present=True)
        if starts is None:
            env.load_state_dict(drawn[index])
        else:
            assert goals is not None
            chosen = world_object, np.maximum(numbers, 0)
            env.reset(
                object_quat=starts[chosen].astype(np.float32), goal_quat=goals[chosen].astype(np.float32)
            )
        _record_round(env, policy, numbers, trace, symmetry, table_steps, on_step)
    if table_steps is not None:
        env.sim.place_table(present=True)
    return trace


def _record_round(
    env: Any,
    policy: Any,
    numbers: np.ndarray,
    trace: Trace,
    symmetry: Sequence[np.ndarray],
    table_steps: int | None,
    on_step: Callable[[], object],
) -> None:
    """One episode in every world that has one; ``numbers`` [N]: its place among its object's, -1 for none."""
    worlds = np.flatnonzero(numbers >= 0)
    place = np.asarray(env.world_object)[worlds], numbers[worlds]
    goal = unit_quats(env.goal_quat.numpy())[worlds]
    quat = unit_quats(env.object_pose()[:, 3:7])[worlds]
    trace.start_quat[place], trace.goal_quat[place] = quat, goal
    _write_errors(trace, symmetry, place, 0, quat, goal)
    alive = np.ones(len(worlds), dtype=bool)
    smoothed = wp.to_torch(env.smoothed)
    for step in range(env.max_episode_steps):
        if step == table_steps:
            env.sim.place_table(present=False)
        living = place[0][alive], place[1][alive]
        trace.action_norm[(*living, step)] = smoothed.norm(dim=-1).cpu().numpy()[worlds][alive]
        if trace.predicted is not None:
            policy.active = _mask(worlds[alive], env.num_worlds, smoothed.device)
        action = policy.act(wp.to_torch(env.observation))
        if trace.predicted is not None:
            trace.predicted[(*living, step)] = policy.predicted.cpu().numpy()[worlds][alive]
        env.step(wp.from_torch(action.detach().contiguous().float(), dtype=wp.float32))
        quat = unit_quats(env.object_pose_end.numpy()[:, 3:7])[worlds]
        _write_errors(trace, symmetry, living, step + 1, quat[alive], goal[alive])
        fell = (env.fell.numpy()[worlds] != 0) & alive
        trace.fell[place[0][fell], place[1][fell]] = True
        trace.steps[place[0][fell], place[1][fell]] = step + 1
        alive &= ~fell
        on_step()
        if not alive.any():
            return


def _mask(worlds: np.ndarray, count: int, device: torch.device) -> torch.Tensor:
    """True at some worlds [N]."""
    mask = torch.zeros(count, dtype=torch.bool, device=device)
    mask[torch.from_numpy(worlds).to(device)] = True
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
