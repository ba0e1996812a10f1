"""In the air, goal after goal: the table goes, and only then come the goals that count.

The paper's in-air test is mostly won before the table goes. Here a policy has the table for 2 s, as there,
and 1 s to hold the object without it. Then it gets goals, each drawn once the last is reached. What comes
after a stop is simulated apart, as in :mod:`vd.evaluate.trace`. K objects, M episodes; quaternions xyzw.
"""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from scipy.spatial.transform import Rotation

from vd.evaluate.rollout import draw_goals, unit_quats
from vd.evaluate.statistics import rotation_angle
from vd.evaluate.trace import Way, air_table_steps, drawn_rounds, keep_motion, motion, out_of_hand
from vd.paper import PAPER

GOALS = 3
"""Goals in a row (ours)."""
GOAL_S = 12.0
"""Time for each [s]: for the first what is left of the paper's 15 s."""
ALONE_S = 1.0
"""Time from the table's going to the first goal [s] (ours)."""
HOLD_S = 30.0
"""For how long a hand holds its object where it reached the first goal [s] (ours)."""
AIR_S = PAPER.scene.air_table_s + ALONE_S + GOALS * GOAL_S
"""Length of an episode [s]."""


@dataclass(frozen=True)
class AirTrace:
    """What became of the episodes.

    Attributes:
        held: Whether the object was still there when the first goal was drawn, bool [K, M].
        reached: Goals reached, one after the other, int [K, M].
        lost: Whether the object was lost, bool [K, M].
        let_go: Of objects with which the first goal was reached, whether they were lost within HOLD_S of
            holding: 0 or 1; NaN for the others [K, M].
    """

    held: np.ndarray
    reached: np.ndarray
    lost: np.ndarray
    let_go: np.ndarray


def air_turns(names: Sequence[str], episodes: int, *, seed: int, max_goal_angle: float) -> np.ndarray:
    """Rotations from where objects are to their goals [K, M, GOALS, 4], by name, seed and episode alone."""
    turns = []
    for name in names:
        rng = np.random.default_rng([seed, zlib.crc32(name.encode()), GOALS])
        at = np.tile([0.0, 0.0, 0.0, 1.0], (episodes * GOALS, 1))
        turns.append(draw_goals(at, rng, max_goal_angle).reshape(episodes, GOALS, 4))
    return np.stack(turns)


def record_in_air(
    env: Any,
    policy: Any,
    turns: np.ndarray,
    way: Way,
    *,
    tolerance: float,
    starts: np.ndarray | None = None,
    goals: np.ndarray | None = None,
    on_step: Callable[[], object] = lambda: None,
) -> AirTrace:
    """Run a policy and write down what becomes of its objects.

    Args:
        env: As of :func:`vd.evaluate.trace.record`, with episodes of AIR_S.
        policy: What acts.
        turns: What :func:`air_turns` gave, of the objects of the environment.
        way: When it is stopped, and gets the next goal.
        tolerance: Largest true distance at which a stop reaches its goal [rad]; after others nothing follows.
        starts: Initial orientations [K, M, 4]; None: the environment draws them.
        goals: Goals while the table is there [K, M, 4], with ``starts``.
        on_step: Called after every control step.
    """
    shape = turns.shape[:2]
    trace = AirTrace(
        held=np.zeros(shape, dtype=bool),
        reached=np.zeros(shape, dtype=int),
        lost=np.zeros(shape, dtype=bool),
        let_go=np.full(shape, np.nan),
    )
    for numbers, state in drawn_rounds(env, shape[1], starts, goals):
        env.sim.place_table(present=True)
        env.load_state_dict(state)
        _Flight(env, trace, numbers, way, tolerance).run(policy, turns, on_step)
    env.sim.place_table(present=True)
    return trace


class _Flight:
    """One episode in every environment that has one: ``numbers`` [N], place among its object's, else -1."""

    def __init__(self, env: Any, trace: AirTrace, numbers: np.ndarray, way: Way, tolerance: float) -> None:
        self._env, self._trace, self._way, self._tolerance = env, trace, way, tolerance
        self._place = np.asarray(env.world_object), np.maximum(numbers, 0)
        self._envs = self._all = np.flatnonzero(numbers >= 0)
        # Steps since the present goal was given; -1: none of the air yet.
        self._age = np.full(env.num_envs, -1)
        self._kept = motion(env, copy=True)

    def run(self, policy: Any, turns: np.ndarray, on_step: Callable[[], object]) -> None:
        """Go to the ends, then hold what reached its first goal."""
        env, trace = self._env, self._trace
        hz = env.cfg.sim.control_hz
        table, most = air_table_steps(hz), round(GOAL_S * hz)
        first = table + round(ALONE_S * hz)
        for step in range(first + GOALS * most):
            if step == table:
                env.sim.place_table(present=False)
            due = self._act(policy)
            on_step()
            self._age[self._age >= 0] += 1
            trace.lost[self._of(self._envs[env.fell.numpy()[self._envs] != 0])] = True
            self._go_on((env.done.numpy() == 0) & (trace.reached[self._place] < GOALS))
            if step == first - 1:
                due = self._envs
                trace.held[self._of(due)] = True
            due = np.intersect1d(due, self._envs)
            if len(due):
                turn = Rotation.from_quat(turns[(*self._of(due), trace.reached[self._of(due)])])
                goal = turn * Rotation.from_quat(env.object_pose()[due, 3:7])
                env.give_goals(due, goal.as_quat())
                self._age[due] = 0
            self._go_on(self._age < most)
            if not len(self._envs):
                break
        self._hold()

    def _of(self, envs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Object and number of the episodes of environments."""
        return self._place[0][envs], self._place[1][envs]

    def _go_on(self, where: np.ndarray) -> None:
        """End the episodes that do not go on, ``where`` being [N]."""
        self._envs = self._envs[where[self._envs]]

    def _act(self, policy: Any) -> np.ndarray:
        """One control step; the environments whose goal was reached before it."""
        env, (rule, by) = self._env, self._way
        smoothed = wp.to_torch(env.smoothed)
        norm = smoothed.norm(dim=-1).cpu().numpy()
        if by == "predicted":
            policy.active = torch.zeros(env.num_envs, dtype=torch.bool, device=smoothed.device)
            policy.active[torch.from_numpy(self._envs).to(smoothed.device)] = True
        true = rotation_angle(unit_quats(env.object_pose()[:, 3:7]), unit_quats(env.goal_quat.numpy()))
        action = policy.act(wp.to_torch(env.observation))
        seen = policy.predicted.cpu().numpy() if by == "predicted" else true
        stops = rule.stops(seen, norm) & (self._age > 0)
        self._go_on(~stops | (true <= self._tolerance))
        reached = self._envs[stops[self._envs]]
        self._trace.reached[self._of(reached)] += 1
        keep_motion(env, self._kept, reached[self._trace.reached[self._of(reached)] == 1])
        env.step(wp.from_torch(action.detach().contiguous().float(), dtype=wp.float32))
        return reached

    def _hold(self) -> None:
        """Go on from where the first goals were reached, with the last targets."""
        env = self._env
        for name, live in motion(env).items():
            live.copy_(self._kept[name])
        held = self._all[self._trace.reached[self._of(self._all)] > 0]
        lost = np.zeros(env.num_envs, dtype=bool)
        for _ in range(round(HOLD_S * env.cfg.sim.control_hz)):
            env.hold()
            lost |= out_of_hand(env)
        self._trace.let_go[self._of(held)] = lost[held]
