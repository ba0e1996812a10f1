"""Gaussians of actions that are sampled without a wait for the device."""

import math

import torch
from rsl_rl.modules.distribution import GaussianDistribution, HeteroscedasticGaussianDistribution
from torch.distributions import Normal


class _Drawn:
    """Samples the same numbers as ``torch.normal``, which looks whether every std is positive.

    So it waits for the device, at every control step.
    """

    mean: torch.Tensor
    std: torch.Tensor

    def sample(self) -> torch.Tensor:
        """One draw for every state."""
        with torch.no_grad():
            return torch.randn_like(self.mean) * self.std + self.mean


class FreeStdGaussian(_Drawn, GaussianDistribution):
    """rsl-rl's Gaussian of one std per action."""


class BoundedStdGaussian(_Drawn, HeteroscedasticGaussianDistribution):
    """Gaussian with ``log std = low + (high - low) * sigmoid(x)``, ``x`` from the network.

    rsl-rl's own state-dependent Gaussian clamps ``log std``: outside the range the gradient is
    zero, so a state whose std has reached a bound stays there whatever the reward says. A sigmoid
    has the same range and always a gradient. A bounded std matters here: unbounded it drifts
    upwards, and success asks for slow fingers, which exploration noise at a std of 0.1 already
    hides.

    ``init_std`` is that of every action in every state at the start, ``std_range`` an open
    interval.
    """

    log_floor: torch.Tensor
    """Logarithm of the least std: a tensor, since a CUDA graph bakes numbers in."""

    def __init__(
        self, output_dim: int, init_std: float = 0.5, std_range: tuple[float, float] = (0.02, 1.0)
    ) -> None:
        low, high = std_range
        super().__init__(output_dim, init_std=init_std, std_range=std_range, std_type="log")
        self._log_ceiling = math.log(high)
        # No part of a checkpoint: it follows from the settings and the curriculum.
        self.register_buffer("log_floor", torch.tensor(math.log(low)), persistent=False)

    def set_floor(self, std: float) -> None:
        """Lower the standard deviation's least value to ``std``, or raise it.

        Those above move with it.
        """
        self.log_floor.fill_(math.log(std))

    def update(self, mlp_output: torch.Tensor) -> None:
        """Set mean and standard deviation from the network's output, shape ``[..., 2, D]``."""
        mean, raw = torch.unbind(mlp_output, dim=-2)
        low = self.log_floor
        high = self._log_ceiling
        self._distribution = Normal(mean, torch.exp(low + (high - low) * torch.sigmoid(raw)))

    def init_mlp_weights(self, mlp: torch.nn.Module) -> None:
        """Make the standard deviation ``init_std`` everywhere.

        Zero weights, and the bias that gives it.
        """
        low, high = map(math.log, self.std_range)
        share = (math.log(self.init_std) - low) / (high - low)
        head = mlp[-2]  # the linear layer before the reshape to [2, D]
        torch.nn.init.zeros_(head.weight[self.output_dim :])
        torch.nn.init.constant_(head.bias[self.output_dim :], math.log(share / (1.0 - share)))
