"""The environment for Gymnasium.

``gymnasium.make_vec("vd.gym:VisualDexterity-v0", num_envs=4096)``.

Needs the extra ``gym``: pip install 'visual-dexterity[gym]'.
"""

from typing import Any

import numpy as np
import torch
import warp as wp

from vd.command.config import from_dict, to_dict
from vd.command.interrupt import remedy
from vd.envs.cfg import ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.sim.simulator import CHECKED

try:
    import gymnasium
    from gymnasium.spaces import Box
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(f"{error.name} is not installed: {remedy('gymnasium')}") from error

ID = "VisualDexterity-v0"
"""What ``make_vec`` is told; ``vd.gym:`` before it imports this module."""


class ReorientVectorEnv(VectorEnv):
    """N environments of a :class:`ReorientEnv`.

    All values are torch tensors on its device, and copies.

    An episode terminates where the object falls, and at a success if ``success_ends_episode``; its
    time limit truncates it. Another success gives a new goal. ``info`` has ``success`` [N],
    ``rotation_error`` [rad] [N] and with SAME_STEP ``final_obs`` [N, O], which means something
    where ``_final_obs`` [N] is true.

    Attributes:
        env: The environment itself.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        cfg: ReorientCfg | None = None,
        device: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        **settings: Any,
    ):
        """Build the environments.

        Args:
            num_envs: N.
            cfg: The task; the paper's by default.
            device: As of :class:`ReorientEnv`.
            autoreset_mode: SAME_STEP is the fastest. DISABLED: ``reset(options={"reset_mask":
                ..})`` resets.
            settings: Fields of the task to replace, such as ``objects``; of a group some, by name.

        Raises:
            ValueError: For a task that cannot work, naming field and remedy.
        """
        self._mode = AutoresetMode(autoreset_mode)
        fields = {"num_envs": num_envs, **to_dict(settings)}
        task = from_dict(ReorientCfg, fields, over=cfg or ReorientCfg())
        self.metadata = {"autoreset_mode": self._mode, "torch": True}
        self.env = env = ReorientEnv(task, device)
        self.num_envs = num_envs
        self.single_observation_space = Box(-np.inf, np.inf, (env.num_observations,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (env.num_actions,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._action = wp.to_torch(env.action)
        self._observation, self._reward = wp.to_torch(env.observation), wp.to_torch(env.reward)
        self._error = wp.to_torch(env.rotation_error)
        self._flags = list(map(wp.to_torch, (env.ended, env.success, env.fell)))
        self._over = torch.zeros_like(self._reward, dtype=torch.bool)
        self._bad = torch.zeros((), dtype=torch.bool, device=self._action.device)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[torch.Tensor, dict[str, Any]]:
        """Reset all environments, or those of ``options["reset_mask"]``, bool [N]."""
        super().reset(seed=seed)
        self._bad.zero_()
        mask = (options or {}).get("reset_mask")
        if mask is None:
            self.env.reset(seed=seed)
            self._over.zero_()
        else:
            chosen = torch.as_tensor(mask, device=self._over.device)
            if chosen.dtype != torch.bool or chosen.shape != self._over.shape:
                raise ValueError(
                    f"reset_mask is {chosen.dtype} {tuple(chosen.shape)}; give booleans, "
                    f"({self.num_envs},)"
                )
            self.env.renew(wp.from_torch(chosen.int()))
            self._over &= ~chosen
        return self._observation.clone(), {}

    def step(
        self, actions: Any
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """One control step with actions [N, A] in [-1, 1]; those beyond are clipped.

        Raises:
            ValueError: Actions have another shape or are not finite; a GPU tells within 128 steps.
            gymnasium.error.ClosedEnvironmentError: After :meth:`close`.
        """
        if self.closed:
            raise gymnasium.error.ClosedEnvironmentError(
                "step() after close(); make the environment anew"
            )
        given = torch.as_tensor(actions)
        if given.shape != self._action.shape:
            raise ValueError(
                f"actions have shape {tuple(given.shape)}, not {tuple(self._action.shape)}"
            )
        self._action.copy_(given)
        self._bad |= ~self._action.isfinite().all()
        if (not self._bad.is_cuda or self.env.steps % CHECKED == 0) and self._bad:
            raise ValueError("actions are not finite; mend the policy, then reset()")
        self.env.advance(self.env.action)
        ended, success, fell = (flag > 0 for flag in self._flags)
        reward, terminated = self._reward.clone(), fell.clone()
        if self.env.cfg.success_ends_episode:
            terminated |= success
        truncated = ended & ~terminated
        info: dict[str, Any] = {"success": success, "rotation_error": self._error.clone()}
        if self._mode == AutoresetMode.SAME_STEP:
            self.env.observe()
            info |= {"final_obs": self._observation.clone(), "_final_obs": ended}
            self.env.renew()
        elif self._mode == AutoresetMode.DISABLED:
            self.env.renew(wp.zeros_like(self.env.ended))
        else:  # what ended in the last step has now come to its reset
            self.env.renew(wp.from_torch(self._over.int()))
            reward.masked_fill_(self._over, 0.0)
            for flag in (terminated, truncated, success):
                flag &= ~self._over
            self._over = terminated | truncated
        return self._observation.clone(), reward, terminated, truncated, info

    def close_extras(self) -> None:
        """Release the captured graphs."""
        self.env.close()


def _single(**_: Any) -> Any:
    """What ``gymnasium.make`` calls, which asks for a single environment.

    Raises:
        gymnasium.error.Error: Names the function to call.
    """
    raise gymnasium.error.Error(
        f'environments are simulated side by side: gymnasium.make_vec("vd.gym:{ID}", num_envs=1)'
    )


gymnasium.register(ID, entry_point=_single, vector_entry_point=ReorientVectorEnv)
