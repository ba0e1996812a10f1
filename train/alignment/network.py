"""The network of alignment that a name means: of a run, or of an installed vision policy."""

from pathlib import Path

from vd.policy import SUFFIX, has_suffix
from vd.train.alignment.config import ALIGNMENT_NAME, PRESETS
from vd.vision.alignment import AlignmentNetwork
from vd.vision.saved import load_alignment


def open_network(
    name: str, device: str = "cpu"
) -> tuple[AlignmentNetwork, tuple[float, ...] | None]:
    """A network of alignment, and the camera of its training (None: the hand's).

    Args:
        name: An ``alignment.pt`` of vd-train alignment, or a vision policy, by its name or file.
        device: Torch device.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It holds no such network.
    """
    from vd.policy.agents import installed_policies, open_policy
    from vd.vision.acting_teacher import VisionPolicy

    if name not in installed_policies() and not has_suffix(name, SUFFIX):
        network, learned = load_alignment(name, device)
        return network, learned.camera
    policy = open_policy(name, device)
    if not isinstance(policy, VisionPolicy):
        raise ValueError(f"{name} finds nothing by its goal's points; name a vision policy")
    return policy.alignment, policy.spec.camera


def default_network(hand: str, preset: str) -> str:
    """Where stage 1 begins if nothing is named: stage 0 of the same preset, or the installed one.

    Args:
        hand: The hand that acts; a network of another is not taken.
        preset: Name of the preset.

    Raises:
        ValueError: There is neither.
    """
    from vd.policy.agents import default_policy

    own = Path(PRESETS[preset](0).run.out) / ALIGNMENT_NAME
    if own.is_file() and load_alignment(own)[1].hand == hand:
        return str(own)
    return default_policy(hand, "vision")
