"""From the name of any policy to its bundle."""

from pathlib import Path

from vd.bundle import is_bundle
from vd.bundle.contract import Contract
from vd.bundle.store import write_student, write_teacher, write_tracking
from vd.config import from_dict
from vd.envs.cfg import ReorientCfg


def write_bundle(name: str, folder: Path) -> Contract:
    """Write the bundle of a policy.

    Args:
        name: the file of a policy, a checkpoint, a run's folder, or the name of an installed policy.
        folder: To write.

    Raises:
        FileNotFoundError: There is no such policy.
        ValueError: It is none, or cannot act.
    """
    from vd.assets_usd.hands import load_hand
    from vd.evaluate.agents import find_policy, is_saved_student, is_tracking_policy, open_policy
    from vd.policy import TrainedPolicy

    path = find_policy(name)
    if is_bundle(path):
        raise ValueError(f"{path} is a bundle already; give the file it was made from")
    policy = open_policy(name, "cpu")
    assert policy is not None
    task = from_dict(ReorientCfg, policy.task, where="task of the policy")
    hand = load_hand(task.hand, task.fingertip, task.hand_layer)
    if isinstance(policy, TrainedPolicy):
        return write_teacher(folder, policy, hand)
    if is_tracking_policy(policy):
        return write_tracking(folder, policy, hand)
    assert is_saved_student(policy)
    return write_student(folder, policy, hand)
