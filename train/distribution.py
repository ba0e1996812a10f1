"""A Gaussian whose standard deviation depends on the state and stays inside its range smoothly."""

import math

import torch
from rsl_rl.modules.distribution import HeteroscedasticGaussianDistribution
from torch.distributions import Normal


class BoundedStdGaussian(HeteroscedasticGaussianDistribution):
    """Gaussian with ``log std = low + (high - low) * sigmoid(x)``, ``x`` from the network.

    rsl-rl's own state-dependent Gaussian clamps ``log std``: outside the range the gradient is zero, so a
    state whose std has reached a bound stays there whatever the reward says. A sigmoid has the same range
    and always a gradient. A bounded std matters here: unbounded it drifts upwards, and success asks for
    slow fingers, which exploration noise at a std of 0.1 already hides.

    Args:
        output_dim: Number of actions D.
        init_std: Standard deviation of every action in every state at the start.
        std_range: Open interval ``(low, high)`` of the standard deviation.
    """

    log_std_range: list[float]

    def __init__(
        self, output_dim: int, init_std: float = 0.5, std_range: tuple[float, float] = (0.02, 1.0)
    ) -> None:
        low, high = std_range
        if not 0.0 < low < init_std < high:
            raise ValueError(
                f"the std range {low} to {high} has to be positive and hold the initial std {init_std} inside"
            )
        super().__init__(output_dim, init_std=init_std, std_range=std_range, std_type="log")

    def set_floor(self, std: float) -> None:
        """Lower the standard deviation's least value to ``std``, or raise it; those above move with it."""
        self.log_std_range = [math.log(std), self.log_std_range[1]]

    def update(self, mlp_output: torch.Tensor) -> None:
        """Set mean and standard deviation from the network's output, shape ``[..., 2, D]``."""
        mean, raw = torch.unbind(mlp_output, dim=-2)
        low, high = self.log_std_range
        self._distribution = Normal(mean, torch.exp(low + (high - low) * torch.sigmoid(raw)))

    def init_mlp_weights(self, mlp: torch.nn.Module) -> None:
        """Make the standard deviation ``init_std`` everywhere: zero weights, and the bias that gives it."""
        low, high = self.log_std_range
        share = (math.log(self.init_std) - low) / (high - low)
        head = mlp[-2]  # the linear layer before the reshape to [2, D]
        torch.nn.init.zeros_(head.weight[self.output_dim :])
        torch.nn.init.constant_(head.bias[self.output_dim :], math.log(share / (1.0 - share)))
