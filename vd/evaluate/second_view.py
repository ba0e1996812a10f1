"""A teacher that has not come to its goal looks at it from another side, and asks its critic which is better.

A policy of views (``observation.view`` goal) knows a scene that is turned from finger to finger, or seen in
the mirror, as another scene: where it is stuck in one it may not be in the other, and what its critic expects
of each says where to go on.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
import warp as wp

from vd.envs.cfg import ObservationCfg
from vd.paper import PAPER
from vd.policy import TrainedPolicy
from vd.student.views import ViewMaps

if TYPE_CHECKING:
    from vd.envs.reorient import ReorientEnv

AFTER_S = 3.0
"""Time after which a goal that is not reached is looked at again [s] (ours): four in five are by then."""
EVERY_S = 1.0
"""Between two looks [s] (ours). Chosen with AFTER_S on 636 episodes, judged on others
(docs/evaluation.md)."""


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
    return replace(seen, view="either") if seen.view == "goal" else seen


class OtherViews:
    """Which worlds look at their goals again, and in which views they may.

    Args:
        env: The environment, which chooses a view for each goal: ``observation.view`` either or mirrored.

    Raises:
        ValueError: The environment has no second view.
    """

    def __init__(self, env: "ReorientEnv") -> None:
        if env.views is None or env.cfg.observation.view not in ("either", "mirrored"):
            raise ValueError(
                f"observation.view is {env.cfg.observation.view}; a second view is there with either or "
                "mirrored"
            )
        self._fingers = env.num_fingers
        self.maps = ViewMaps(len(env.views.tables.sector), env.num_observations, env.num_actions)
        self.maps.adopt(env.views.tables)
        self.maps.to(wp.device_to_torch(env.device))
        self._error = wp.to_torch(env.rotation_error)
        self._steps, self._reached = wp.to_torch(env.step_count), wp.to_torch(env.goals_reached)
        self._counted = self._reached.clone()
        self._since = torch.zeros_like(self._steps)
        hz = env.cfg.sim.control_hz
        self._after, self._every = round(AFTER_S * hz), round(EVERY_S * hz)

    def due(self) -> torch.Tensor:
        """Worlds that look again now, bool [N]; to be asked once in every control step."""
        fresh = (self._steps == 0) | (self._reached != self._counted)
        self._since = torch.where(fresh, 0, self._since + 1)
        self._counted.copy_(self._reached)
        late = self._since - self._after
        return (late >= 0) & (late % self._every == 0) & (self._error > PAPER.success.rotation_rad)

    def of(self, world: torch.Tensor) -> torch.Tensor:
        """Views to choose from [C, M] for observations in the world frame [M, O].

        They are, of a hand that is its own mirror image, the view in whose sector the goal lies now and that
        in the mirror; else all views.
        """
        if len(self.maps) > self._fingers:
            near = self.maps.nearness(world).unflatten(-1, (2, self._fingers)).argmax(dim=-1)
            return torch.stack((near[:, 0], near[:, 1] + self._fingers))
        return torch.arange(self._fingers, device=world.device)[:, None].expand(-1, len(world))


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

    def __init__(self, env: "ReorientEnv", policy: TrainedPolicy) -> None:
        self._others = OtherViews(env)
        self.num_actions = policy.num_actions
        self._env, self._policy = env, policy
        self._world, self._view = wp.to_torch(env.world_observation), wp.to_torch(env.views.view)
        policy.value(self._world[:1])  # refuses a policy without a critic, before anything slow

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """Mean actions [N, D] in the views, for the environment's observation [N, O]."""
        again = self._others.due()
        if bool(again.any()):
            self._view[again] = self._better(self._world[again]).to(self._view.dtype)
            self._env.views.observe()
            observation = wp.to_torch(self._env.observation)
        return self._policy.act(observation)

    def _better(self, world: torch.Tensor) -> torch.Tensor:
        """Views [M] of which the critic expects most, for observations in the world frame [M, O]."""
        views = self._others.of(world)
        expected = torch.stack([self._policy.value(self._others.maps.take(world, view)) for view in views])
        return views.gather(0, expected.argmax(dim=0, keepdim=True))[0]
