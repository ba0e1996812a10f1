"""A controller that plans by sampling, with the simulator itself as its model.

It needs no training, so what it can do tells what the hand, the object and the physics allow, and
what is left to learn. It sees the whole state and simulates hundreds of futures for every step.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
import warp as wp

from vd.envs.cfg import TOWARDS_GOAL, CurriculumCfg, RandomisationCfg, SuccessCfg
from vd.envs.reorient import ReorientEnv

NEVER_S = 1e6
"""Time limit of an episode in the model [s]: a plan goes on beyond the end of the real one."""


@dataclass(frozen=True)
class SamplingCfg:
    """Sizes of model-predictive path integral control.

    Chosen once and not tuned. Half of the samples over twice the horizon does as well on validation
    meshes; half and twice of the others were not tried.
    """

    samples: int = 256
    """Futures of every environment in every control step."""
    horizon: int = 12
    """Control steps of a future: one second."""
    knot_steps: int = 3
    """Noise is drawn this many steps apart and interpolated: fingers need time to get somewhere."""
    std: float = 0.7
    """Standard deviation of the noise about the plan."""
    policy_std: float = 0.3
    """The same about a policy's actions, where one proposes half of the futures."""
    temperature: float = 0.1
    """Of the weights, in standard deviations of the returns: the best few futures count."""
    discount: float = 0.98
    """Per control step, so that a goal is better reached early."""
    rotation_rad: float = 0.3
    """A future ends, paid, where the paper's test holds within this error [rad]."""


class SamplingController:
    """Model-predictive path integral control (MPPI) of all environments side by side.

    Each control step it copies the state of every environment into ``samples`` environments of its
    model, simulates a future in each, and moves its plan to the average of the futures, weighted by
    their returns, of the reward from which teachers learn (``TOWARDS_GOAL``). Source: Williams et
    al., Information Theoretic MPC, ICRA 2017.
    """

    def __init__(
        self, env: ReorientEnv, cfg: SamplingCfg | None = None, policy: Any = None, seed: int = 0
    ) -> None:
        """Build the model.

        Args:
            env: What is controlled: N environments, a multiple of the number of objects, so that
                the model's blocks of ``samples`` hold the same objects. The model is nominal.
            cfg: Sizes.
            policy: A teacher that proposes half of the futures; None: all are about the plan.
            seed: Of the noise.
        """
        self.cfg = cfg or SamplingCfg()
        self._env = env
        self._policy = policy
        if env.num_envs % len(env.objects):
            raise ValueError(
                f"{env.num_envs} environments for {len(env.objects)} objects; give each object the "
                "same number of them"
            )
        task = replace(
            env.cfg,
            num_envs=env.num_envs * self.cfg.samples,
            episode_s=NEVER_S,
            success_ends_episode=True,
            success=replace(SuccessCfg(), rotation_rad=self.cfg.rotation_rad),
            reward=TOWARDS_GOAL,
            curriculum=CurriculumCfg(),
            randomisation=RandomisationCfg(enabled=False),
        )
        self._model = ReorientEnv(task, env.device)
        self._pairs = list(self._state_pairs())
        device = torch.device(env.device)
        self._generator = torch.Generator(device=device).manual_seed(seed)
        self._plan = torch.zeros(env.num_envs, self.cfg.horizon, env.num_actions, device=device)

    def _state_pairs(self) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """What changes from step to step with a row for each environment, of task and model.

        What the task alone has is drawn in it and unknown to the model, such as late commands.
        """
        known = self._model.changing_arrays()
        for name, source in self._env.changing_arrays().items():
            target = known.get(name)
            per_environment = source.shape[0] == self._env.num_envs
            if per_environment and target is not None and target.shape[1:] == source.shape[1:]:
                yield wp.to_torch(source), wp.to_torch(target)

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """The first actions of the new plans, shape [N, A]; observations are not read."""
        fresh = wp.to_torch(self._env.step_count) == 0
        self._plan[fresh] = 0.0
        self._restore()
        actions, returns = self._simulate(self._noise())
        spread = returns.std(dim=1, keepdim=True).clamp_min(1e-6)
        weights = torch.softmax(returns / (self.cfg.temperature * spread), dim=1)
        self._plan = torch.einsum("ns,nsha->nha", weights, actions)
        first = self._plan[:, 0].clone()
        self._plan = torch.cat([self._plan[:, 1:], self._plan[:, -1:]], dim=1)
        return first

    def _restore(self) -> None:
        """Put every environment of the model into the state of the one that it belongs to."""
        samples = self.cfg.samples
        for source, target in self._pairs:
            target.view(len(source), samples, *source.shape[1:]).copy_(source[:, None])
        self._model.sim.forward_kinematics()

    def _noise(self) -> torch.Tensor:
        """Noise of standard deviation 1, smooth in time [N, S, H, A]; that of the first is 0."""
        cfg = self.cfg
        envs = self._env.num_envs
        knots = torch.randn(
            envs * cfg.samples,
            self._env.num_actions,
            -(-cfg.horizon // cfg.knot_steps) + 1,
            generator=self._generator,
            device=self._plan.device,
        )
        smooth = torch.nn.functional.interpolate(knots, size=cfg.horizon, mode="linear")
        noise = smooth.transpose(1, 2).unflatten(0, (envs, cfg.samples))
        noise[:, 0] = 0.0
        return noise

    def _simulate(self, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Simulate all futures; their actions [N, S, H, A] and returns [N, S]."""
        cfg = self.cfg
        model = self._model
        shape = (self._env.num_envs, cfg.samples)
        taken = torch.empty_like(noise)
        returns = torch.zeros(shape, device=noise.device)
        alive = torch.ones(shape, device=noise.device)
        guided = 0 if self._policy is None else cfg.samples // 2
        for step in range(cfg.horizon):
            action = self._plan[:, None, step] + cfg.std * noise[:, :, step]
            if guided:
                proposed = self._policy.act(wp.to_torch(model.observation)).view(*shape, -1)
                proposed = proposed + cfg.policy_std * noise[:, :, step]
                action[:, -guided:] = proposed[:, -guided:]
            taken[:, :, step] = action.clamp(-1.0, 1.0)
            flat = taken[:, :, step].reshape(-1, taken.shape[-1]).contiguous()
            model.step(wp.from_torch(flat, dtype=wp.float32))
            reward = wp.to_torch(model.reward).view(shape)
            returns += cfg.discount**step * alive * reward
            alive *= (wp.to_torch(model.ended).view(shape) == 0).float()
        return taken, returns
