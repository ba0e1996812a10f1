"""A policy that has not come to its goal looks at it from another side, and asks a critic which is better.

A policy of views (``observation.view`` goal) knows a scene that is turned from finger to finger, or seen in
the mirror, as another scene: where it is stuck in one it may not be in the other, and what its critic expects
of each says where to go on. A student, which acts by its teacher's layers, asks its teacher's critic.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
import warp as wp

from vd.envs.cfg import ObservationCfg, ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.kernels.observations import teacher_observation_slices
from vd.paper import PAPER
from vd.policy import TrainedPolicy
from vd.student.state import StateHead
from vd.student.views import ViewMaps

AFTER_S = 3.0
"""Time after which a goal that is not reached is looked at again [s] (ours): four in five are by then."""
EVERY_S = 1.0
"""Between two looks [s] (ours). Chosen with AFTER_S on 636 episodes, judged on others
(docs/evaluation.md)."""
NEAREST = -1
"""In place of a view: that in whose sector the goal is believed to lie."""


def with_second_view(seen: ObservationCfg) -> ObservationCfg:
    """The same observation in an environment that has other views for a goal than the first.

    Raises:
        ValueError: Goals are not seen in views.
    """
    if seen.view == "world":
        raise ValueError(
            "a second view is for policies that see their goals in views (observation.view goal or "
            "mirrored); this one sees them in observation.view world"
        )
    if seen.dynamics != "none":
        raise ValueError(
            "a second view asks the critic, and this one's was told what no sensor knows "
            f"(observation.dynamics {seen.dynamics}); leave out --second-view"
        )
    return replace(seen, view="either") if seen.view == "goal" else seen


def view_maps(env: ReorientEnv) -> ViewMaps:
    """All views of an environment that has others than the first.

    Raises:
        ValueError: It has none.
    """
    if env.views is None or env.cfg.observation.view not in ("either", "mirrored"):
        raise ValueError(
            f"observation.view is {env.cfg.observation.view}; a second view is there with either or mirrored"
        )
    maps = ViewMaps(len(env.views.tables.sector), env.num_observations, env.num_actions)
    maps.adopt(env.views.tables)
    return maps.to(wp.device_to_torch(env.device))


@dataclass(frozen=True)
class GoalClock:
    """For how long each world has pursued its goal: a simulator's clock, or that of a hand."""

    steps: torch.Tensor
    """Control steps, 0 in the first, shape [N]; kept up to date by who owns them."""
    control_hz: float
    """How many of them there are in a second."""

    @classmethod
    def of(cls, env: ReorientEnv) -> "GoalClock":
        """That of an environment."""
        return cls(wp.to_torch(env.goal_steps), env.cfg.sim.control_hz)


class OtherViews:
    """Which worlds look at their goals again, and in which views they may.

    Args:
        clock: The time of their goals.
        maps: The views of their hand, :func:`view_maps`.

    Attributes:
        maps: These.
    """

    def __init__(self, clock: GoalClock, maps: ViewMaps) -> None:
        self.maps = maps
        self._goal_steps = clock.steps
        hz = clock.control_hz
        self._after, self._every = round(AFTER_S * hz), round(EVERY_S * hz)

    def due(self) -> torch.Tensor:
        """Worlds that look again now if they are far, bool [N]."""
        late = self._goal_steps - self._after
        return (late >= 0) & (late % self._every == 0)

    def fresh(self) -> torch.Tensor:
        """Worlds whose goal has just been given, bool [N]."""
        return self._goal_steps == 0

    def of(self, world: torch.Tensor) -> torch.Tensor:
        """Views to choose from [C, M] for observations in the world frame [M, O].

        They are, of a hand that is its own mirror image, the view in whose sector the goal lies now and that
        in the mirror; else all views.
        """
        fingers = self.maps.fingers
        if len(self.maps) > fingers:
            near = self.maps.nearness(world).unflatten(-1, (2, fingers)).argmax(dim=-1)
            return torch.stack((near[:, 0], near[:, 1] + fingers))
        return torch.arange(fingers, device=world.device)[:, None].expand(-1, len(world))

    def better(self, world: torch.Tensor, value: Callable[[torch.Tensor], torch.Tensor]) -> torch.Tensor:
        """Views [M] of which most is expected; ``value`` [M] is that of observations as a view shows them."""
        views = self.of(world)
        expected = torch.stack([value(self.maps.take(world, view)) for view in views])
        return views.gather(0, expected.argmax(dim=0, keepdim=True))[0]


class SecondView:
    """Acts as its policy, in the views of an environment that has others.

    Args:
        env: The environment, which chooses a view for each goal.
        policy: The teacher, with its critic.

    Attributes:
        num_actions: D.

    Raises:
        ValueError: The environment has no second view, or the policy no critic.
    """

    def __init__(self, env: ReorientEnv, policy: TrainedPolicy) -> None:
        self._others = OtherViews(GoalClock.of(env), view_maps(env))
        assert env.views is not None  # or there would be no maps
        self.num_actions = policy.num_actions
        self._env, self._views, self._policy = env, env.views, policy
        self._world, self._view = wp.to_torch(env.world_observation), wp.to_torch(env.views.view)
        self._error = wp.to_torch(env.rotation_error)
        policy.value(self._world[:1])  # refuses a policy without a critic, before anything slow

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """Mean actions [N, D] in the views, for the environment's observation [N, O]."""
        again = self._others.due() & (self._error > PAPER.success.rotation_rad)
        if bool(again.any()):
            view = self._others.better(self._world[again], self._policy.value)
            self._view[again] = view.to(self._view.dtype)
            self._views.observe()
            observation = wp.to_torch(self._env.observation)
        return self._policy.act(observation)


class StudentSecondView:
    """The views that a student acts in: the nearest, and where it does not come to its goal another.

    It knows no state: how far the goal is, and what its teacher's critic would see, is what it estimates.

    Args:
        clock: The time of its goals.
        head: Where it estimates its teacher's observation, in views; from now on they are chosen here.
        task: Its task: that of its hand, with its teacher's observation.
        value: What its teacher's critic expects [M] of observations as a view shows them [M, O]
            (:func:`vd.evaluate.agents.open_critic`).

    Attributes:
        rows: Worlds that the next estimates are of [M].

    Raises:
        ValueError: The student does not act in views.
    """

    def __init__(
        self,
        clock: GoalClock,
        head: StateHead | None,
        task: ReorientCfg,
        value: Callable[[torch.Tensor], torch.Tensor],
    ) -> None:
        if head is None or head.views is None:
            raise ValueError(
                "--second-view: this student does not act by the layers of a teacher that sees its goals in "
                "views (observation.view goal or mirrored)"
            )
        mirrored = len(head.views) > head.views.fingers
        seen = replace(task.observation, view="mirrored" if mirrored else "either")
        device, worlds = clock.steps.device, len(clock.steps)
        one = ReorientEnv(replace(task, objects=("cube",), num_worlds=1, observation=seen), str(device))
        maps = view_maps(one).adopt_first(head.views)
        self._others = OtherViews(clock, maps)
        one.close()
        self._head, self._value, self._first = head, value, head.views
        head.views, head.look = maps, self._views
        self._again = torch.zeros(worlds, dtype=torch.bool, device=device)
        self._taken = torch.full((worlds,), NEAREST, device=device)
        self.rows = torch.arange(worlds, device=device)

    def begin_step(self) -> None:
        """To be called once in every control step, before the student acts."""
        self._taken[self._others.fresh()] = NEAREST
        self._again = self._others.due()

    def _views(self, world: torch.Tensor) -> torch.Tensor:
        """Views [M] for estimates in the world frame [M, O], of the worlds ``rows``."""
        head, rows = self._head, self.rows
        turn = world[:, teacher_observation_slices(self._first.fingers)["relative_orientation"]]
        angle = 2.0 * torch.atan2(turn[:, :3].norm(dim=-1), turn[:, 3].abs())
        again = self._again[rows] & (angle > PAPER.success.rotation_rad)
        if bool(again.any()):
            self._taken[rows[again]] = self._others.better(
                world[again], lambda seen: self._value(head.guessed(seen))
            )
        taken = self._taken[rows]
        return torch.where(taken == NEAREST, self._first.choose(world), taken)
