"""The teacher's own layers, acting on an estimate of what the teacher observes.

A teacher's actions turn sharply with its state, and labels alone teach a new network to turn so only after a
great many of them. Its layers do already, and they bear an estimate that is off: what is left to learn is to
see. A teacher that sees its goals in views is shown the estimate in the view that it calls for. O values of
the observation, D actions.
"""

from typing import Any

import torch
from torch import nn

from vd.kernels.task.observations import JOINTS_PER_FINGER, teacher_observation_slices
from vd.policy import MeanAction, PolicySpec, perceptron
from vd.quaternions import canonical
from vd.views import ViewMaps
from vd.vision.cfg import StateCfg

UNSEEN = ("object_orientation", "goal_orientation")
"""Orientations in the axes of the object's file, which no cloud shows; the teacher hardly uses them."""

RIDGES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""What may be added to the variance of each input in the first least squares; few states ask for much."""
LEFT_OUT = 4
"""One in so many of the states, the last ones, decides which."""


def state_cfg(teacher: PolicySpec, *, views: int = 0) -> StateCfg:
    """The head that estimates what a teacher observes, with layers like the teacher's.

    Args:
        teacher: The teacher.
        views: Views in which it sees its goals; 0: it sees the world as it is.
    """
    return StateCfg(
        values=teacher.num_observations, hidden=teacher.hidden, activation=teacher.activation, views=views
    )


class StateHead(nn.Module):
    """From features to an estimate of the teacher's observation, and to what the teacher does there.

    The estimate is of the observation in the world frame, normalised: zero is its mean in the teacher's
    training. Values that cannot be seen are at the mean for the teacher, whatever the estimate says of them.
    The teacher's layers are not trained; they are random until :meth:`adopt`.

    Args:
        cfg: Sizes.
        width: Width of the features.
        num_actions: D.

    Attributes:
        views: The teacher's views, if it sees its goals in them.
    """

    offset: torch.Tensor
    scale: torch.Tensor
    fitted: torch.Tensor
    view_offset: torch.Tensor
    view_scale: torch.Tensor
    known: torch.Tensor

    def __init__(self, cfg: StateCfg, width: int, num_actions: int) -> None:
        super().__init__()
        self.inside = nn.Sequential(nn.Linear(width, cfg.inside), nn.GELU())
        self.estimate = nn.Linear(width + cfg.inside, cfg.values)
        acts = PolicySpec(cfg.values, num_actions, cfg.hidden, cfg.activation, "gaussian", False)
        self.teacher = perceptron(acts).requires_grad_(False)
        self.register_buffer("offset", torch.zeros(cfg.values))
        self.register_buffer("scale", torch.ones(cfg.values))
        self.register_buffer("fitted", torch.tensor(False))
        self.views = ViewMaps(cfg.views, cfg.values, num_actions) if cfg.views else None
        if self.views is not None:
            self.register_buffer("view_offset", torch.zeros(cfg.values))
            self.register_buffer("view_scale", torch.ones(cfg.values))
        columns = teacher_observation_slices(num_actions // JOINTS_PER_FINGER)
        self._turn = columns["relative_orientation"]
        known = torch.ones(cfg.values)
        for name in UNSEEN:
            known[columns[name]] = 0.0
        self.register_buffer("known", known, persistent=False)

    def adopt(self, teacher: MeanAction, tables: Any = None) -> bool:
        """Take over the layers of a teacher, the scales of its observation, and its views.

        Args:
            teacher: The teacher.
            tables: The views of its hand (``vd.envs.symmetry.ViewTables``), if it sees its goals in them;
                None keeps those there are.

        Returns:
            Whether it is another one than before; the estimate then is to be fitted anew.

        Raises:
            RuntimeError: Its layers are of other sizes.
        """
        before = [weight.clone() for weight in self.teacher.parameters()]
        weights = teacher.layers.state_dict()
        # A state-dependent std is the second half of the teacher's outputs.
        for name, value in self.teacher[-1].state_dict(prefix=f"{len(self.teacher) - 1}.").items():
            weights[name] = weights[name][: len(value)]
        self.teacher.load_state_dict(weights)
        offset, scale = teacher.offset[0], teacher.scale[0]
        if self.views is not None:
            if tables is not None:
                self.views.adopt(tables)
            self.view_offset.copy_(offset)
            self.view_scale.copy_(scale)
            offset, scale = self.views.world_moments(offset, scale)
        self.offset.copy_(offset)
        self.scale.copy_(scale)
        if all(torch.equal(old, new) for old, new in zip(before, self.teacher.parameters(), strict=True)):
            return False
        self.fitted.fill_(False)
        return True

    def target(self, observation: torch.Tensor) -> torch.Tensor:
        """What the estimate of an observation in the world frame [.., O] should be, normalised.

        Of a rotation's two quaternions the one of less than half a turn; of what cannot be seen, the mean.
        """
        wanted = observation.clone()
        wanted[..., self._turn] = canonical(wanted[..., self._turn])
        return self.known * (wanted - self.offset) / self.scale

    def act(self, estimate: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """What the teacher does at an estimate [.., O].

        Returns:
            Its mean action, in the world's order [.., D], and the view it takes [..], 0 where it has none.
        """
        if self.views is None:
            return self.teacher(self.known * estimate), estimate.new_zeros(
                estimate.shape[:-1], dtype=torch.long
            )
        world = self.offset + self.scale * estimate
        view = self.views.choose(world)
        seen = (self.views.take(world, view) - self.view_offset) / self.view_scale
        return self.views.world_action(self.teacher(self.known * seen), view), view

    def fit(self, features: torch.Tensor, observation: torch.Tensor) -> None:
        """Begin with the estimate that is best in least squares: gradients would take long to what is exact.

        How much it is held back (ridge) is decided by the last states, which are to be of other environments.

        Args:
            features: Features of some states [R, width].
            observation: The teacher's observation of them [R, O].
        """
        with torch.no_grad():
            inputs = torch.cat([features, self.inside(features)], dim=-1).double()
            target = self.target(observation).double()
            known = len(inputs) - len(inputs) // LEFT_OUT
            part, rest = (inputs[:known], target[:known]), (inputs[known:], target[known:])
            ridge = min(RIDGES, key=lambda value: _left(_least_squares(*part, value), *rest))
            slope, bias = _least_squares(inputs, target, ridge)
            self.estimate.weight.copy_(slope.T)
            self.estimate.bias.copy_(bias)
            self.fitted.fill_(True)

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Estimated observation, normalised [.., O], and what :meth:`act` says of it."""
        estimate = self.estimate(torch.cat([features, self.inside(features)], dim=-1))
        return estimate, *self.act(estimate)


def _least_squares(
    inputs: torch.Tensor, target: torch.Tensor, ridge: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Slope [I, O] and bias [O] of what is nearest to targets [R, O] of inputs [R, I]."""
    middle, mean = inputs.mean(dim=0), target.mean(dim=0)
    spread = inputs - middle
    products = spread.T @ spread
    products.diagonal().add_(ridge * len(inputs))
    slope = torch.linalg.solve(products, spread.T @ (target - mean))
    return slope, mean - middle @ slope


def _left(line: tuple[torch.Tensor, torch.Tensor], inputs: torch.Tensor, target: torch.Tensor) -> float:
    """Sum of the squares that a slope and bias leave of other states."""
    slope, bias = line
    return float((target - inputs @ slope - bias).square().sum())
