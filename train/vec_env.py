"""The environment as rsl-rl sees it.

A vectorised environment of torch tensors on the simulator's device.
"""

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import torch
import warp as wp
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from vd.command.config import to_dict
from vd.paper import PAPER

if TYPE_CHECKING:
    from vd.envs.reorient import ReorientEnv

OBSERVATION_GROUP = "policy"
"""What actor and critic both read; all there is in the paper."""
PRIVILEGED_GROUP = "privileged"
"""What the critic alone reads besides (``ObservationCfg.dynamics``, ``critic_terms``)."""


class ReorientVecEnv(VecEnv):
    """N environments of a :class:`vd.envs.reorient.ReorientEnv` behind rsl-rl's interface.

    Rewards and flags are torch views of the environment's Warp arrays, without a copy. Observations
    are copied once, on the device: rsl-rl stores the observation of a step only *after* the next
    step has overwritten the environment's array, so a view would silently pair each action with the
    observation that followed it.

    Warp and torch work on different CUDA streams. Warp's are ordered against torch's default stream
    by CUDA itself, so torch has to stay on that stream, and nothing waits on the host.

    ``done`` for PPO is success, fall or time-out. A success gives a new goal and no reset, but ends
    the goal's return: it is not bootstrapped. Only a time-out without success or fall is
    (``extras["time_outs"]``). The observation returned is always that of the next action, after a
    reset or with the new goal.
    """

    def __init__(self, env: "ReorientEnv") -> None:
        self.env = env
        self.num_envs = env.num_envs
        self.num_actions = env.num_actions
        self.max_episode_length = env.max_episode_steps
        self.device = str(wp.device_to_torch(env.device))
        self.cfg: dict[str, Any] = to_dict(env.cfg)
        self._observed = {OBSERVATION_GROUP: wp.to_torch(env.observation)}
        if env.privileged.shape[1]:
            self._observed[PRIVILEGED_GROUP] = wp.to_torch(env.privileged)
        self._reward = wp.to_torch(env.reward)
        self._reward_terms = wp.to_torch(env.reward_terms)
        self._success = wp.to_torch(env.success)
        self._fell = wp.to_torch(env.fell)
        self._timed_out = wp.to_torch(env.timed_out)
        self._rotation_error = wp.to_torch(env.rotation_error)
        self._step_count = wp.to_torch(env.step_count)
        # The environment's own buffer: a captured CUDA graph reads its input from a fixed address.
        self._action = wp.to_torch(env.action)
        self.log_names = (
            "reward/total",
            *(f"reward/{name}" for name in env.reward_term_names),
            "task/rotation_error",
            "task/within_tolerance",
            "task/reached",
            "task/dropped",
            "task/timed_out",
            "policy/action_norm",
        )

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Control steps since the last reset of every environment [N], a view.

        Assigning copies into it.
        """
        return self._step_count

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        self._step_count.copy_(value)

    def get_observations(self) -> TensorDict:
        """The observation for the next action, ``{"policy": [N, O]}``, a copy on the device.

        Where the critic is told more also ``"privileged"``, [N, P].
        """
        copies = {group: values.clone() for group, values in self._observed.items()}
        return TensorDict(copies, batch_size=[self.num_envs])

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Simulate one control step.

        Args:
            actions: Actions [N, D]; the environment clips them to [-1, 1].

        Returns:
            Observation for the next action; reward [N] (view); done [N] (int64); and extras with
            ``time_outs`` [N] (float) and ``log``: scalars on the device, the same keys from the
            first step. ``reward/*`` and ``task/rotation_error`` [rad] are means over environments,
            ``task/reached``, ``task/dropped``, ``task/timed_out`` the share of environments whose
            goal ended that way in this step, ``task/within_tolerance`` the share within the paper's
            success tolerance, moving or not.
        """
        self._action.copy_(actions)
        self.env.step(self.env.action)
        reached = self._success > 0
        dropped = (self._fell > 0) & ~reached
        timed_out = (self._timed_out > 0) & ~reached & ~dropped
        done = reached | dropped | timed_out
        shares = torch.stack(
            (
                self._rotation_error,
                (self._rotation_error <= PAPER.success.rotation_rad).float(),
                reached.float(),
                dropped.float(),
                timed_out.float(),
                actions.norm(dim=-1),
            )
        ).mean(dim=1)
        values = torch.cat((self._reward.mean()[None], self._reward_terms.mean(dim=0), shares))
        log = dict(zip(self.log_names, values.unbind(), strict=True))
        return (
            self.get_observations(),
            self._reward,
            done.long(),
            {"time_outs": timed_out.float(), "log": log},
        )

    def end_iteration(self) -> dict[str, float]:
        """Once an iteration: move the curriculum.

        Returns:
            ``level/*``: the levels of the curriculum; ``task/failed_steps``: steps of environments
            here that were put back since the begin (``ReorientCfg.failures_per_million``).
        """
        if torch.distributed.is_initialized():
            # Every process counts all goals, and so comes to the same levels.
            torch.distributed.all_reduce(wp.to_torch(self.env.goal_counts))
        self.env.update_curriculum()
        levels = {f"level/{name}": value for name, value in asdict(self.env.levels).items()}
        return levels | {"task/failed_steps": float(self.env.failed_steps())}

    def start_anew(self, state: dict[str, Any]) -> None:
        """Begin new episodes in all environments, at a state's levels of the curriculum."""
        self.env.set_levels(self.env.levels_of(state))
        self.env.reset()
