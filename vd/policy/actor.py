"""Policies for evaluation, the viewer and the robot.

A trained actor, zero or random actions. They need torch only, no simulator and no rsl-rl.
"""

import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import torch
from torch import nn

from vd.command.config import from_dict
from vd.command.versions import installed_versions
from vd.envs.cfg import ReorientCfg
from vd.policy import SUFFIX
from vd.policy.contract import Contract, Contracted, PolicySpec

CHECKPOINT_FORMAT = "visual-dexterity checkpoint 1"
PACKAGES = ("visual-dexterity", "torch", "warp-lang", "newton", "safetensors")
"""Those of which a policy notes the versions."""
_WEIGHTS = "_state_dict"
"""How the names of what holds weights end."""
REMEDY = "copy it again, or give another file of its run"
"""What to do about a policy that cannot be read."""
_NORMALISER_EPSILON = 1e-2
"""Added to the running std by the normaliser that trained the actor (rsl-rl's
EmpiricalNormalization).
"""


class MeanAction(nn.Module):
    """An actor's perceptron, its normalisation of observations if it has one, and its mean."""

    def __init__(self, spec: PolicySpec, weights: dict[str, torch.Tensor]) -> None:
        super().__init__()
        self.num_actions = spec.num_actions
        offset = torch.zeros(1, spec.num_observations)
        scale = torch.ones(1, spec.num_observations)
        if spec.normalise_observations:
            offset = weights["obs_normalizer._mean"].clone()
            scale = weights["obs_normalizer._std"] + _NORMALISER_EPSILON
        self.register_buffer("offset", offset)
        self.register_buffer("scale", scale)
        with torch.device("meta"):  # drawn weights would take random numbers of a training
            self.layers = perceptron(spec)
        inside = {
            key.removeprefix("mlp."): value.float()
            for key, value in weights.items()
            if key.startswith("mlp.")
        }
        self.layers.load_state_dict(inside, assign=True)
        self.eval().requires_grad_(False)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Mean actions [N, D] of observations [N, O]."""
        output = self.layers((observation - self.offset) / self.scale)
        # A state-dependent std is the second half of the output.
        return output[:, : self.num_actions]


class TrainedPolicy(Contracted):
    """The deterministic policy of a trained actor: the mean of its action distribution.

    Attributes:
        contract: What it is and was made for.
        weights: State of rsl-rl's actor: ``mlp.*`` and, if it normalises, ``obs_normalizer.*``.
        critic: State of its critic, for a run that goes on from it; empty where there is none.
        network: From observations [N, O] to mean actions [N, D]; what an exporter needs.
    """

    kind: Literal["teacher"] = "teacher"

    def __init__(
        self,
        contract: Contract,
        weights: dict[str, torch.Tensor],
        critic: dict[str, torch.Tensor] | None = None,
        device: str = "cpu",
    ) -> None:
        self.contract = contract
        self.weights = weights
        self.critic = critic or {}
        self.network = MeanAction(contract.network, weights).to(device)

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """Mean actions [N, D] for observations [N, O] on the policy's device.

        Raises:
            ValueError: The observation has another length than the policy was trained on.
        """
        if observation.ndim != 2 or observation.shape[1] != self.num_observations:
            raise ValueError(
                f"the policy was trained on observations [N, {self.num_observations}] of hand "
                f"'{self.hand}', but got {tuple(observation.shape)}; use the hand it was trained "
                f"for"
            )
        with torch.no_grad():
            return self.network(observation)


class BuiltIn:
    """An agent without a file, ``zero`` or ``random``: every action is zero, or uniform in [-1, 1].

    Actions of a seed are the same on the same device, that of the observations.
    """

    def __init__(self, name: str, num_actions: int, *, seed: int = 0, device: str = "cpu") -> None:
        self.num_actions = num_actions
        self._still = name == "zero"
        self._generator = torch.Generator(device=device).manual_seed(seed)

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """Actions [N, D]."""
        shape = (observation.shape[0], self.num_actions)
        if self._still:
            return observation.new_zeros(shape)
        return torch.rand(shape, generator=self._generator, device=observation.device) * 2.0 - 1.0


class FunctionPolicy:
    """A function of a user, from observations [N, O] to actions [N, A], tensors of one device."""

    def __init__(self, function: Callable[[torch.Tensor], torch.Tensor], num_actions: int) -> None:
        self._function = function
        self.num_actions = num_actions

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """Actions [N, A].

        Raises:
            ValueError: The function gave something of another shape.
        """
        with torch.no_grad():
            action = torch.as_tensor(self._function(observation), device=observation.device)
        wanted = (len(observation), self.num_actions)
        if tuple(action.shape) != wanted:
            raise ValueError(
                f"the policy gave actions {tuple(action.shape)}, not {wanted}; mend it"
            )
        return action.float()


def read_state(
    path: str | Path, device: str = "cpu", *, remedy: str, wanted: str = CHECKPOINT_FORMAT
) -> dict[str, Any]:
    """What torch saved in a file of the format ``wanted``, its weights whole.

    Executes nothing in it.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, is of another format, or has weights that are not finite;
            with ``remedy``.
    """
    path = Path(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch tells how to load what executes
            state = torch.load(path, map_location=device, weights_only=True)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"there is no file {path}; {remedy}") from error
    except Exception as error:
        raise ValueError(f"{path} {_damage(path, error)}; {remedy}") from error
    version = state.get("format") if isinstance(state, dict) else None
    if version != wanted:
        raise ValueError(f"{path}: format is {version!r}, not {wanted!r}; {remedy}")
    for part, weights in state.items():
        if str(part).endswith(_WEIGHTS) and not all(_tensors_finite(weights)):
            raise ValueError(f"{path} is damaged: {part} has weights that are not finite; {remedy}")
    return state


def _damage(path: Path, error: Exception) -> str:
    """What is wrong with a file that torch cannot read."""
    if isinstance(error, OSError) and error.filename:
        return f"cannot be read ({error.strerror})"
    if path.stat().st_size == 0:
        return "is damaged: it is empty"
    return "is damaged, or holds more than weights, which is not loaded since it could run programs"


def _tensors_finite(value: Any) -> Iterator[bool]:
    """Whether each tensor in nested dictionaries and lists is finite."""
    if isinstance(value, torch.Tensor):
        yield bool(torch.isfinite(value).all()) if value.is_floating_point() else True
    elif isinstance(value, (dict, list, tuple)):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _tensors_finite(item)


def teacher_in(state: dict[str, Any], path: str | Path, device: str) -> TrainedPolicy:
    """The teacher of a checkpoint, whose ``state`` was read from ``path``.

    A critic that is still warming up is worth nothing, and left out.

    Raises:
        ValueError: It is not a teacher's, no checkpoint, or of another version.
    """
    if "student_state_dict" in state or "alignment_state_dict" in state:
        raise ValueError(
            f"{path} is of vd-train student or alignment, and does not act by itself; give the "
            f"student's policy{SUFFIX}, or make a policy: vd-train tracker TEACHER --alignment "
            "alignment.pt"
        )
    critic = {} if state.get("critic_warmup", 0) else state.get("critic_state_dict", {})
    try:
        contract = Contract(
            interface=state["interface"],
            network=from_dict(PolicySpec, state["policy"], where="policy"),
            task=state["task"],
            iterations=int(state["iter"]),
            env_steps=int(state["env_steps"]),
            learner=state["learner"],
            stage=stage_of(state),
            software=installed_versions(PACKAGES),
        )
        ReorientCfg.of_task(contract.task)
        return TrainedPolicy(contract, state["actor_state_dict"], critic, device)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: {error}; take the version that wrote it") from error


def stage_of(state: dict[str, Any]) -> dict[str, Any]:
    """How far the curriculum of a checkpoint has come."""
    levels: dict[str, Any] = state["ranks"][0]["env"].get("levels", {})
    return levels


def perceptron(spec: PolicySpec) -> nn.Sequential:
    """The multilayer perceptron with rsl-rl's names of layers, ELU between them as in the paper."""
    outputs = spec.num_actions * (2 if spec.distribution == "state-dependent" else 1)
    layers: list[nn.Module] = []
    width = spec.num_observations
    for hidden in spec.hidden:
        layers += [nn.Linear(width, hidden), nn.ELU()]
        width = hidden
    return nn.Sequential(*layers, nn.Linear(width, outputs))
