"""A user's own terms of reward and observation.

Functions of the environment, named by the configuration.

A function takes the :class:`vd.envs.reorient.ReorientEnv` and gives a torch tensor on its device:
[N] for the reward, [N] or [N, K] for the observation. It reads the environment and writes nothing
to it.
"""

from typing import Any, Protocol

import torch
import warp as wp

from vd.command.functions import named_function
from vd.envs.cfg import ReorientCfg
from vd.envs.observer import Observer
from vd.sim.simulator import CHECKED, Simulator


class TermEnv(Protocol):
    """What is read of a :class:`vd.envs.reorient.ReorientEnv` here; functions read all of it."""

    num_envs: int
    device: str
    sim: Simulator
    observer: Observer
    reward: Any
    reward_terms: Any
    reward_term_names: tuple[str, ...]


class OwnTerms:
    """The own terms of a task.

    Raises:
        ValueError: A name means no function, or is there twice; a number of values is not positive.
    """

    def __init__(self, cfg: ReorientCfg):
        self._coefficients = cfg.reward.terms
        self._scale = cfg.reward.scale
        seen = cfg.observation.terms
        told = cfg.observation.critic_terms
        if twice := sorted(seen.keys() & told.keys()):
            raise ValueError(
                f"observation.critic_terms has {twice[0]}, which the critic is shown already"
            )
        self._sizes = cfg.observation.own
        self._told = told
        if wrong := [name for name, size in self._sizes.items() if size < 1]:
            raise ValueError(f"observation.terms: {wrong[0]} has to give 1 value or more")
        self._functions = {
            name: named_function(name, "the own term")
            for name in self._coefficients.keys() | self._sizes.keys()
        }
        self._not_finite: dict[str, torch.Tensor] = {}
        self._steps = 0

    @torch.no_grad()
    def pay(self, env: TermEnv) -> None:
        """Add to the reward of a step what own terms give for the state before resets."""
        reward = wp.to_torch(env.reward)
        terms = wp.to_torch(env.reward_terms)
        failed = wp.to_torch(env.sim.failed) > 0
        first = len(env.reward_term_names) - len(self._coefficients)
        for column, (name, coefficient) in enumerate(self._coefficients.items(), first):
            paid = (coefficient * self._value(env, name, 1)[:, 0]).masked_fill(failed, 0.0)
            terms[:, column] = paid
            reward += self._scale * paid

    @torch.no_grad()
    def observe(self, env: TermEnv) -> None:
        """Write own values of the present state into the observation, alike in every frame."""
        observer = env.observer
        first = {part: columns.start for part, columns in observer.parts.items()}
        for name, size in self._sizes.items():
            value = self._value(env, name, size)
            part = "critic_terms" if name in self._told else "terms"
            for array in (observer.world_values, observer.all_values):
                wp.to_torch(array)[:, first[part] : first[part] + size] = value
            first[part] += size
        self._steps += 1
        if not env.sim.failed.device.is_cuda or self._steps % CHECKED == 0:
            self.check()

    def check(self) -> None:
        """Refuse values that were not finite; waits for the device.

        Raises:
            ValueError: It names the term.
        """
        for name, seen in self._not_finite.items():
            if bool(seen):
                raise ValueError(
                    f"the own term {name} gave a value that is not finite; mend the function"
                )

    def _value(self, env: TermEnv, name: str, size: int) -> torch.Tensor:
        """What a function gives [N, K]."""
        try:
            value = self._functions[name](env)
        except Exception as error:
            raise ValueError(
                f"the own term {name} raised {type(error).__name__}: {error}"
            ) from error
        shape: object = type(value).__name__
        if isinstance(value, torch.Tensor):
            shape = tuple(value.shape)
        fits = shape == (env.num_envs, size) or (size == 1 and shape == (env.num_envs,))
        if not fits or value.device != torch.device(env.device):
            where = f" on {value.device}" if fits else ""
            raise ValueError(
                f"the own term {name} gave {shape}{where}; return a torch tensor of shape "
                f"({env.num_envs}, {size}) on {env.device}"
            )
        bad = ~torch.isfinite(value).all()
        self._not_finite[name] = self._not_finite.get(name, bad) | bad
        return value.reshape(env.num_envs, size).float()
