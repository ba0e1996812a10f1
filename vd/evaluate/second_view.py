"""A policy that has not come to its goal looks at it from another side, and asks a critic which is better.

A policy of views (``observation.view`` goal) knows a scene that is turned from finger to finger, or seen in
the mirror, as another scene: where it is stuck in one it may not be in the other, and what its critic expects
of each says where to go on.
"""

from dataclasses import replace

import torch
import warp as wp

from vd.envs.cfg import ObservationCfg
from vd.envs.reorient import ReorientEnv
from vd.paper import PAPER
from vd.policy import TrainedPolicy
from vd.views import ViewMaps, ViewSelection


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
    return ViewMaps(env.views.tables, device=wp.device_to_torch(env.device))


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
        self._selection = ViewSelection(view_maps(env), env.cfg.sim.control_hz)
        self._goal_steps = wp.to_torch(env.goal_steps)
        assert env.views is not None  # or there would be no maps
        self.num_actions = policy.num_actions
        self._env, self._views, self._policy = env, env.views, policy
        self._world, self._view = wp.to_torch(env.world_observation), wp.to_torch(env.views.view)
        self._error = wp.to_torch(env.rotation_error)
        policy.value(self._world[:1])  # refuses a policy without a critic, before anything slow

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """Mean actions [N, D] in the views, for the environment's observation [N, O]."""
        again = self._selection.due(self._goal_steps) & (self._error > PAPER.success.rotation_rad)
        if bool(again.any()):
            view = self._selection.better(self._world[again], self._policy.value)
            self._view[again] = view.to(self._view.dtype)
            self._views.observe()
            observation = wp.to_torch(self._env.observation)
        return self._policy.act(observation)
