"""A teacher that has not come to its goal looks at it from another side, and asks its critic which is better.

A policy of views (``observation.view`` goal) knows a scene that is turned from finger to finger, or seen in
the mirror, as another scene: where it is stuck in one it may not be in the other, and what its critic expects
of each says where to go on.
"""

from typing import TYPE_CHECKING

import torch
import warp as wp

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


class SecondView:
    """Acts as its policy, in the views of an environment with ``observation.view`` either.

    Args:
        env: The environment, which chooses a view for each goal.
        policy: The teacher, with its critic.

    Attributes:
        num_actions: D.

    Raises:
        ValueError: The environment has no second view, or the policy no critic.
    """

    def __init__(self, env: "ReorientEnv", policy: TrainedPolicy) -> None:
        if env.views is None or env.cfg.observation.view != "either":
            raise ValueError(
                f"observation.view is {env.cfg.observation.view}; a second view is there with either"
            )
        self.num_actions = policy.num_actions
        self._env, self._views, self._policy = env, env.views, policy
        self._world = wp.to_torch(env.world_observation)
        policy.value(self._world[:1])  # refuses a policy without a critic, before anything slow
        self._maps = ViewMaps(len(env.views.tables.sector), env.num_observations, env.num_actions)
        self._maps.adopt(env.views.tables)
        self._maps.to(self._world.device)
        self._view, self._error = wp.to_torch(env.views.view), wp.to_torch(env.rotation_error)
        self._steps, self._reached = wp.to_torch(env.step_count), wp.to_torch(env.goals_reached)
        self._counted = self._reached.clone()
        self._since = torch.zeros_like(self._steps)
        hz = env.cfg.sim.control_hz
        self._after, self._every = round(AFTER_S * hz), round(EVERY_S * hz)

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """Mean actions [N, D] in the views, for the environment's observation [N, O]."""
        fresh = (self._steps == 0) | (self._reached != self._counted)
        self._since = torch.where(fresh, 0, self._since + 1)
        self._counted.copy_(self._reached)
        late = self._since - self._after
        again = (late >= 0) & (late % self._every == 0) & (self._error > PAPER.success.rotation_rad)
        if bool(again.any()):
            self._view[again] = self._better(self._world[again]).to(self._view.dtype)
            self._views.observe()
            observation = wp.to_torch(self._env.observation)
        return self._policy.act(observation)

    def _better(self, world: torch.Tensor) -> torch.Tensor:
        """Views [M] for observations in the world frame [M, O].

        To choose from are, of a hand that is its own mirror image, the view in whose sector the goal lies now
        and that in the mirror; else all views.
        """
        fingers = self._env.num_fingers
        if len(self._maps) > fingers:
            near = self._maps.nearness(world).unflatten(-1, (2, fingers)).argmax(dim=-1)
            views = torch.stack((near[:, 0], near[:, 1] + fingers))
        else:
            views = torch.arange(fingers, device=world.device)[:, None].expand(-1, len(world))
        expected = torch.stack([self._policy.value(self._maps.take(world, view)) for view in views])
        return views.gather(0, expected.argmax(dim=0, keepdim=True))[0]
