"""The teacher's own layers, acting on an estimate of what the teacher observes.

A teacher's actions turn sharply with its state, and labels alone teach a new network to turn so only after a
great many of them. Its layers do already, and they bear an estimate that is off
(docs/results/student.md): what is left to learn is to see. O values of the observation, D actions.
"""

import torch
from torch import nn

from vd.kernels.observations import JOINTS_PER_FINGER, teacher_observation_slices
from vd.policy import MeanAction, PolicySpec, perceptron
from vd.student.cfg import StateCfg

UNSEEN = ("object_orientation", "goal_orientation")
"""Orientations in the axes of the object's file, which no cloud shows; the teacher hardly uses them."""

RIDGE = 1e-4
"""Variance of noise that the first estimate is made to bear, in features of about one."""


def state_cfg(teacher: PolicySpec) -> StateCfg:
    """The head that estimates what a teacher observes, with layers like the teacher's."""
    return StateCfg(values=teacher.num_observations, hidden=teacher.hidden, activation=teacher.activation)


class StateHead(nn.Module):
    """From features to an estimate of the teacher's observation, and to what the teacher does there.

    Values are normalised as the teacher's: zero is the mean of its training, which the values that cannot be
    seen are left at. The teacher's layers are not trained; they are random until :meth:`adopt`.

    Args:
        cfg: Sizes.
        width: Width of the features.
        num_actions: D.
    """

    offset: torch.Tensor
    scale: torch.Tensor
    fitted: torch.Tensor

    def __init__(self, cfg: StateCfg, width: int, num_actions: int) -> None:
        super().__init__()
        self.inside = nn.Sequential(nn.Linear(width, cfg.inside), nn.GELU())
        self.estimate = nn.Linear(width + cfg.inside, cfg.values)
        self.teacher = perceptron(
            PolicySpec(cfg.values, num_actions, cfg.hidden, cfg.activation, "gaussian", False)
        ).requires_grad_(False)
        self.register_buffer("offset", torch.zeros(cfg.values))
        self.register_buffer("scale", torch.ones(cfg.values))
        self.register_buffer("fitted", torch.tensor(False))
        columns = teacher_observation_slices(num_actions // JOINTS_PER_FINGER)
        self._turn = columns["relative_orientation"]
        self._unseen = [columns[name] for name in UNSEEN]

    def adopt(self, teacher: MeanAction) -> None:
        """Take over the layers of a teacher and the scales of its observation.

        Raises:
            RuntimeError: Its layers are of other sizes.
        """
        weights = teacher.layers.state_dict()
        # A state-dependent std is the second half of the teacher's outputs.
        for name, value in self.teacher[-1].state_dict(prefix=f"{len(self.teacher) - 1}.").items():
            weights[name] = weights[name][: len(value)]
        self.teacher.load_state_dict(weights)
        self.offset.copy_(teacher.offset[0])
        self.scale.copy_(teacher.scale[0])

    def target(self, observation: torch.Tensor) -> torch.Tensor:
        """What the estimate of an observation [.., O] should be, normalised.

        Of a rotation's two quaternions the one of less than half a turn; of what cannot be seen, the mean.
        """
        wanted = observation.clone()
        turn = wanted[..., self._turn]
        wanted[..., self._turn] = torch.where(turn[..., 3:] < 0.0, -turn, turn)
        wanted = (wanted - self.offset) / self.scale
        for columns in self._unseen:
            wanted[..., columns] = 0.0
        return wanted

    def fit(self, features: torch.Tensor, observation: torch.Tensor) -> None:
        """Begin with the estimate that is best in least squares: gradients would take long to what is exact.

        Args:
            features: Features of some states [R, width].
            observation: The teacher's observation of them [R, O].
        """
        with torch.no_grad():
            inputs = torch.cat([features, self.inside(features)], dim=-1).double()
            middle = inputs.mean(dim=0)
            target = self.target(observation).double()
            mean, spread = target.mean(dim=0), inputs - middle
            products = spread.T @ spread
            products.diagonal().add_(RIDGE * len(inputs))
            slope = torch.linalg.solve(products, spread.T @ (target - mean))
            self.estimate.weight.copy_(slope.T)
            self.estimate.bias.copy_(mean - middle @ slope)
            self.fitted.fill_(True)

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Estimated observation, normalised [.., O], and the teacher's mean action there [.., D]."""
        estimate = self.estimate(torch.cat([features, self.inside(features)], dim=-1))
        return estimate, self.teacher(estimate)
