"""Networks of alignment in files. Reading one executes nothing in it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vd.command.config import from_dict
from vd.policy.actor import read_state
from vd.vision.alignment import AlignmentNetwork
from vd.vision.cfg import AlignmentCfg

ALIGNMENT_FORMAT = "visual-dexterity alignment 1"
REMEDY = "give an alignment.pt of vd-train alignment"


@dataclass(frozen=True, kw_only=True)
class AlignmentSpec:
    """Everything about a network of alignment but its weights."""

    network: AlignmentCfg
    """Its sizes."""
    points: int
    """Points of the clouds it learned from; others do, it reads patches of them."""
    hand: str
    """The hand that hid them."""
    camera: tuple[float, ...] | None = None
    """Pose of the optical frame in the base frame, position [m] and quaternion xyzw; None: the
    hand's.
    """


def alignment_export(state: dict[str, Any]) -> dict[str, Any]:
    """The part of a checkpoint that :func:`load_alignment` needs."""
    learned = state["alignment_state_dict"]
    weights = {name: value.detach().cpu() for name, value in learned.items()}
    kept = {key: state[key] for key in ("spec", "iter", "env_steps")}
    return {"format": ALIGNMENT_FORMAT, **kept, "alignment_state_dict": weights}


def load_alignment(path: str | Path, device: str = "cpu") -> tuple[AlignmentNetwork, AlignmentSpec]:
    """Rebuild the network of an ``alignment.pt``, in evaluation mode and without gradients.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, or of another kind or version.
    """
    state = read_state(path, device, remedy=REMEDY, wanted=ALIGNMENT_FORMAT)
    try:
        spec = from_dict(AlignmentSpec, state["spec"], where="spec")
        return alignment_network(spec.network, state["alignment_state_dict"], device), spec
    except (ValueError, TypeError, RuntimeError) as error:
        raise ValueError(f"{path}: {error}; take the version that wrote it") from error


def alignment_network(cfg: AlignmentCfg, weights: dict[str, Any], device: str) -> AlignmentNetwork:
    """A network of alignment with weights, in evaluation mode and without gradients."""
    network = AlignmentNetwork(cfg).to(device)
    network.load_state_dict(weights)
    return network.eval().requires_grad_(False)
