"""The teacher's own layers, acting on an estimate of what the teacher observes.

A teacher's actions turn sharply with its state, and labels alone teach a new network to turn so only after a
great many of them. Its layers do already, and they bear an estimate that is off
(docs/student.md): what is left to learn is to see. A teacher that sees its goals in views is shown the
estimate in the view that the estimate calls for. O values of the observation, D actions.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import nn

from vd.kernels.observations import JOINTS_PER_FINGER, teacher_observation_slices
from vd.paper import PAPER
from vd.policy import MeanAction, PolicySpec, perceptron
from vd.student.cfg import StateCfg
from vd.student.fingertips import Fingertips
from vd.student.object_sense import observed
from vd.student.quaternions import canonical
from vd.student.views import ViewMaps

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
        found: Column of the features at which the sense of the object begins, if there is one: what it tells
            of the observation stands, and the estimate is added to it.
        joints: Columns of the features at which positions and velocities of the joints begin, as the senses
            give them; only where ``cfg.fingertips`` are to be computed from them.

    Attributes:
        critic: The teacher's critic, if it is kept.
        views: The teacher's views, if it sees its goals in them.
        look: What chooses views [M] for estimates in the world frame [M, O]; None: each is the nearest.
    """

    offset: torch.Tensor
    scale: torch.Tensor
    fitted: torch.Tensor
    view_offset: torch.Tensor
    view_scale: torch.Tensor
    known: torch.Tensor
    factor: torch.Tensor
    source: torch.Tensor
    told: torch.Tensor

    def __init__(
        self,
        cfg: StateCfg,
        width: int,
        num_actions: int,
        *,
        found: int | None = None,
        joints: tuple[int, int] | None = None,
    ) -> None:
        super().__init__()
        self.inside = nn.Sequential(nn.Linear(width, cfg.inside), nn.GELU())
        self.estimate = nn.Linear(width + cfg.inside, cfg.values)
        acts = PolicySpec(cfg.values, num_actions, cfg.hidden, cfg.activation, "gaussian", False)
        self.teacher = perceptron(acts).requires_grad_(False)
        self.critic: MeanAction | None = None
        if cfg.critic:
            expects = replace(acts, num_actions=1)
            layers = perceptron(expects).state_dict(prefix="mlp.")
            self.critic = MeanAction(expects, layers)
        self.register_buffer("offset", torch.zeros(cfg.values))
        self.register_buffer("scale", torch.ones(cfg.values))
        self.register_buffer("fitted", torch.tensor(False))
        self.views = ViewMaps(cfg.views, cfg.values, num_actions) if cfg.views else None
        self.look: Callable[[torch.Tensor], torch.Tensor] | None = None
        if self.views is not None:
            self.register_buffer("view_offset", torch.zeros(cfg.values))
            self.register_buffer("view_scale", torch.ones(cfg.values))
        columns = teacher_observation_slices(num_actions // JOINTS_PER_FINGER)
        self._turn = columns["relative_orientation"]
        known = torch.ones(cfg.values)
        for name in UNSEEN:
            known[columns[name]] = 0.0
        self.register_buffer("known", known, persistent=False)
        told, source, factor = observed(num_actions, cfg.values) if found is not None else ([], [], [])
        self.fingertips = Fingertips(num_actions) if joints is not None else None
        self._joints = [slice(first, first + num_actions) for first in joints or ()]
        if self.fingertips is not None:
            told = [*told, *range(columns["fingertips"].start, columns["fingertips"].stop)]
        for name, values in (
            ("factor", torch.tensor(factor, dtype=torch.float)),
            ("source", torch.tensor([(found or 0) + column for column in source], dtype=torch.long)),
            ("told", torch.tensor(told, dtype=torch.long)),
        ):
            self.register_buffer(name, values, persistent=False)

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

    def follow(self, teacher: MeanAction) -> bool:
        """Take over a teacher that has gone on since, and estimate the same of the world as before.

        What the estimate is measured in changes with the teacher's normalisation, so it is measured anew,
        exactly; nothing has to be learned again.

        Args:
            teacher: The teacher, of the same hand, task and layers.

        Returns:
            Whether it is another one than before.

        Raises:
            RuntimeError: Its layers are of other sizes.
        """
        # Value = offset + scale * (W f + b), of the same features f before and after.
        offset, scale, fitted = self.offset.clone(), self.scale.clone(), self.fitted.clone()
        other = self.adopt(teacher)
        with torch.no_grad():
            shift = offset - self.offset
            shift[self.told] = 0.0  # the estimate only adds to what is told of these, in the world
            self.estimate.weight.mul_((scale / self.scale)[:, None])
            self.estimate.bias.mul_(scale).add_(shift).div_(self.scale)
        self.fitted.copy_(fitted)
        return other

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
        if self.look is None:
            view = self.views.choose(world)
        else:
            view = self.look(world.flatten(0, -2)).reshape(world.shape[:-1])
        seen = (self.views.take(world, view) - self.view_offset) / self.view_scale
        return self.views.world_action(self.teacher(self.known * seen), view), view

    def value(self, seen: torch.Tensor) -> torch.Tensor:
        """The return that the critic expects [N] of observations in a view [N, O]."""
        assert self.critic is not None
        with torch.no_grad():
            return self.critic(seen)[:, 0]

    def guessed(self, seen: torch.Tensor) -> torch.Tensor:
        """Observations in a view [.., O] with the mean in place of what a student cannot see."""
        return self.view_offset + self.known * (seen - self.view_offset)

    def fit(self, features: torch.Tensor, observation: torch.Tensor) -> None:
        """Begin with the estimate that is best in least squares: gradients would take long to what is exact.

        How much it is held back (ridge) is decided by the last states, which are to be of other worlds.

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
            # Least squares would make less of an object for the few that are found on the wrong side.
            self.add_nothing_to_told()
            self.fitted.fill_(True)

    def add_nothing_to_told(self) -> None:
        """Let what need not be estimated stand as it is told."""
        with torch.no_grad():
            self.estimate.weight[self.told] = 0.0
            self.estimate.bias[self.told] = 0.0

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Estimated observation, normalised [.., O], and what :meth:`act` says of it."""
        estimate = self.estimate(torch.cat([features, self.inside(features)], dim=-1))
        normal = (self._told(features) - self.offset[self.told]) / self.scale[self.told]
        estimate = estimate.index_add(-1, self.told, normal)
        return estimate, *self.act(estimate)

    def _told(self, features: torch.Tensor) -> torch.Tensor:
        """What need not be estimated of the observation, columns ``told``: object found, and fingertips."""
        values = self.factor * features[..., self.source]
        if self.fingertips is None:
            return values
        position, velocity = (features[..., columns] for columns in self._joints)
        tips = self.fingertips(position, velocity / PAPER.observation.velocity_scale)
        return torch.cat([values, tips], dim=-1)


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
