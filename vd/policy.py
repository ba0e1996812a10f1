"""Policies for evaluation, the viewer and the robot.

A trained actor from a file, zero or random actions.

Reading a policy needs torch only, no simulator and no rsl-rl, and executes nothing in the file.
"""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

import torch
from torch import nn

from vd.config import from_dict

POLICY_FORMAT = "visual-dexterity policy 1"
_STAGE = ("difficulty", "tightness", "tightening")
"""What says how far the curriculum has come, in the state of an environment."""
_WEIGHTS = "_state_dict"
"""How the names of what holds weights end."""
REMEDY = "copy it again, or give another file of its run"
"""What to do about a policy that cannot be read."""
_NORMALISER_EPSILON = 1e-2
"""Added to the running std by the normaliser that trained the actor (rsl-rl's
EmpiricalNormalization).
"""


class Policy(Protocol):
    """Anything that acts on observations."""

    num_actions: int

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """Actions [N, D] in about [-1, 1] for observations [N, O], on the same device."""
        ...


@dataclass(frozen=True)
class PolicySpec:
    """What is needed to rebuild an actor around its weights: O observations, D actions."""

    RETIRED: ClassVar[dict[str, Any]] = {"activation": "elu"}
    num_observations: int
    num_actions: int
    hidden: tuple[int, ...]
    """Widths of the hidden layers."""
    distribution: str
    """``gaussian``, the network gives the mean, or ``state-dependent``: mean, then std."""
    normalise_observations: bool
    """Whether a running normalisation belongs to the actor."""


class MeanAction(nn.Module):
    """Normalisation of observations, if it belongs to the actor, its perceptron, and the mean it gives."""

    def __init__(self, spec: PolicySpec, weights: dict[str, torch.Tensor]) -> None:
        super().__init__()
        self.num_actions = spec.num_actions
        offset, scale = torch.zeros(1, spec.num_observations), torch.ones(1, spec.num_observations)
        if spec.normalise_observations:
            offset = weights["obs_normalizer._mean"].clone()
            scale = weights["obs_normalizer._std"] + _NORMALISER_EPSILON
        self.register_buffer("offset", offset)
        self.register_buffer("scale", scale)
        self.layers = perceptron(spec)
        inside = {
            key.removeprefix("mlp."): value
            for key, value in weights.items()
            if key.startswith("mlp.")
        }
        self.layers.load_state_dict(inside)
        self.eval().requires_grad_(False)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Mean actions [N, D] of observations [N, O]."""
        output = self.layers((observation - self.offset) / self.scale)
        # A state-dependent std is the second half of the output.
        return output[:, : self.num_actions]


class TrainedPolicy:
    """The deterministic policy of a trained actor: the mean of its action distribution.

    ``weights`` are the state of rsl-rl's actor: ``mlp.*`` and, if it normalises,
    ``obs_normalizer.*``; ``task`` is the configuration of the environment it was trained in, as a
    dictionary.

    Attributes:
        hand: Name of the hand it moves, as ``task`` says ("" if it does not).
        trained_hand: What that was in training (:func:`vd.bundle.contract.trained_hand`); empty in
            files of earlier versions.
        network: From observations [N, O] to mean actions [N, D]; what an exporter needs.
    """

    kind: Literal["teacher"] = "teacher"

    def __init__(
        self,
        spec: PolicySpec,
        weights: dict[str, torch.Tensor],
        *,
        task: dict[str, Any],
        iteration: int = 0,
        env_steps: int = 0,
        trained_hand: dict[str, Any] | None = None,
        device: str = "cpu",
    ) -> None:
        self.trained_hand = trained_hand or {}
        self.spec, self.task, self.iteration, self.env_steps = spec, task, iteration, env_steps
        self.hand = str(task.get("hand", ""))
        self.num_observations, self.num_actions = spec.num_observations, spec.num_actions
        self.weights = weights
        self.network = MeanAction(spec, weights).to(device)

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
        self.num_actions, self._still = num_actions, name == "zero"
        self._generator = torch.Generator(device=device).manual_seed(seed)

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """Actions [N, D]."""
        shape = (observation.shape[0], self.num_actions)
        if self._still:
            return observation.new_zeros(shape)
        return torch.rand(shape, generator=self._generator, device=observation.device) * 2.0 - 1.0


def read_state(path: str | Path, device: str = "cpu", *, remedy: str) -> dict[str, Any]:
    """What torch saved in a file, its weights whole. Nothing in it is executed.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, or has weights that are not finite; with ``remedy``.
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
    if not isinstance(state, dict):
        raise ValueError(f"{path} is no file that vd-train wrote; {remedy}")
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


def load_policy(path: str | Path, device: str = "cpu") -> TrainedPolicy:
    """Rebuild the actor from a checkpoint of ``vd-train`` or from an exported ``policy.pt``.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is damaged, or not a policy.
    """
    return teacher_in(read_state(path, device, remedy=REMEDY), path, device)


def teacher_in(state: dict[str, Any], path: str | Path, device: str) -> TrainedPolicy:
    """The same from what was read of ``path``."""
    if "student_state_dict" in state and "spec" in state:
        raise ValueError(
            f"{path} is a student or its checkpoint, which does not act by itself; vd-train "
            f"tracker TEACHER "
            "--alignment alignment.pt makes a policy of a student that vd-train student trained"
        )
    if not {"policy", "actor_state_dict", "task"} <= state.keys():
        raise ValueError(f"{path} holds no policy; give a file that vd-train wrote")
    try:
        return policy_of(state, device)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"{path}: the weights do not fit the network it describes ({error})"
        ) from error


def policy_of(state: dict[str, Any], device: str) -> TrainedPolicy:
    """The policy in the contents of a file; raises what the reading of a wrong one raises."""
    return TrainedPolicy(
        from_dict(PolicySpec, state["policy"], where="policy"),
        state["actor_state_dict"],
        task=state["task"],
        iteration=int(state["iter"]),
        env_steps=int(state["env_steps"]),
        trained_hand=state.get("trained_hand"),
        device=device,
    )


def policy_export(state: dict[str, Any]) -> dict[str, Any]:
    """The part of a checkpoint that others need: networks, task, how it was trained; no optimiser.

    :func:`load_policy` reads the actor. The rest is for a run that begins from it (``vd-train
    teacher --init``): the critic, unless it is still warming up and so worth nothing, the stage of
    the curriculum and the settings of the learner. ``state`` is a checkpoint, or what this function
    gave.
    """
    exported = {"format": POLICY_FORMAT} | {
        key: state[key] for key in ("policy", "task", "iter", "env_steps")
    }
    for key in ("actor_state_dict", "critic_state_dict"):
        if key == "actor_state_dict" or (key in state and not state.get("critic_warmup", 0)):
            exported[key] = {name: value.detach().cpu() for name, value in state[key].items()}
    if "ranks" in state:
        environment = state["ranks"][0]["env"]
        exported["stage"] = {key: environment[key] for key in _STAGE if key in environment}
    return exported | {
        key: state[key] for key in ("stage", "learner", "trained_hand") if key in state
    }


def perceptron(spec: PolicySpec) -> nn.Sequential:
    """The multilayer perceptron with the layer names rsl-rl gives it, ELU between them as in the paper."""
    outputs = spec.num_actions * (2 if spec.distribution == "state-dependent" else 1)
    layers: list[nn.Module] = []
    width = spec.num_observations
    for hidden in spec.hidden:
        layers += [nn.Linear(width, hidden), nn.ELU()]
        width = hidden
    return nn.Sequential(*layers, nn.Linear(width, outputs))
