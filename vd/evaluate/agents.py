"""Agents by name or file, and the task they act in: shared by vd-eval and vd-play."""

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vd.assets_usd.cache import assets_dir
from vd.bundle import is_bundle
from vd.envs.cfg import (
    CurriculumCfg,
    ObservationCfg,
    RandomisationCfg,
    ReorientCfg,
    SuccessCfg,
    TableCfg,
)

if TYPE_CHECKING:
    from vd.policy import TrainedPolicy
    from vd.tracking.policy import TrackingPolicy

BUILT_IN = ("zero", "random")
"""Agents without a file: no action, and uniform noise."""

POLICY_FOLDER = Path(__file__).parents[1] / "policies"
"""Policies of the package, and POLICY_LIST. A wheel has two of them, a checkout all."""
POLICY_LIST = "policies.json"
"""Tells of the policies of a folder (:mod:`vd.policy_store`), in a wheel also of those that it
lacks.
"""
SHIPPED_POLICIES = {path.stem: path for path in sorted(POLICY_FOLDER.glob("*.pt"))}
"""Trained policies that are installed with the package, by name: ``<hand>`` or
``<hand>-<task>``.
"""

REPLACED = {
    "dclaw3-student": "dclaw3-tracking",
    "dclaw4-table-student": "dclaw4-tracking",
    "dclaw4-student": "dclaw4-tracking",
    "dclaw4-air-tracking": "dclaw4-tracking",
    "dclaw3-procedural": "dclaw3",
    "dclaw3-table": "dclaw3",
    "dclaw4-table": "dclaw4",
    "dclaw4-air": "dclaw4",
}
"""Names of policies that were installed once, and what to take instead."""

DEFAULT_POLICY = "dclaw4"
DEFAULT_HAND = "dclaw4"
NO_LAYER = "none"
"""What --hand-layer is to be for the hand as it is, whatever the training."""
# What a run's folder holds, best first.
_RUN_FILES = ("policy.pt", "checkpoints/best.pt")


def pulled_folder() -> Path:
    """Where ``vd-policies pull`` puts policies."""
    return assets_dir() / "policies"


def installed_policies() -> dict[str, Path]:
    """Policies by name: those of the package, and those that were pulled."""
    return {path.stem: path for path in sorted(pulled_folder().glob("[!.]*.pt"))} | SHIPPED_POLICIES


def find_policy(name: str | Path) -> Path:
    """The policy file that ``name`` means.

    One that is installed, a file, or the best one of a run's folder.

    The name of an installed policy means that one; write ``./name`` for a folder called the same.

    Raises:
        FileNotFoundError: There is none.
        ValueError: A policy of that name was installed once, or has to be pulled.
    """
    if str(name) in REPLACED:
        raise ValueError(f"the policy {name} is not installed any more; take {REPLACED[str(name)]}")
    installed = installed_policies()
    if str(name) in installed:
        return installed[str(name)]
    path = Path(name)
    if path.is_file() or is_bundle(path):
        return path
    known = json.loads((POLICY_FOLDER / POLICY_LIST).read_text())["policies"]
    if not path.exists() and str(name) in known:
        raise ValueError(
            f"the policy {name} is not on this machine: vd-policies pull {name} --at PLACE, such "
            f"as the "
            "folder vd/policies of a checkout"
        )
    if not path.is_dir():
        raise FileNotFoundError(
            f"no policy at {path}; give a policy.pt, a bundle's folder, a file of a run's "
            f"checkpoints folder, a run's folder, or the name of an installed policy: "
            f"{', '.join(installed)}"
        )
    for candidate in _RUN_FILES:
        if (path / candidate).is_file():
            return path / candidate
    raise FileNotFoundError(
        f"{path} holds no {' or '.join(_RUN_FILES)}; give a policy.pt or a checkpoint"
    )


def check_names(agents: Iterable[str], objects: Iterable[str], hand: str | None = None) -> None:
    """Refuse agents, object sets and a hand that are not there, before anything slow is imported."""
    from vd.assets_usd.hands import check_hand_name
    from vd.assets_usd.objects.sets import check_sets

    for name in agents:
        if name not in BUILT_IN:
            find_policy(name)
    check_sets(objects)
    if hand is not None:
        check_hand_name(hand)


def policy_name(name: str | Path) -> str:
    """``name`` as it is told to others.

    The name of an installed policy if it is the file of one.
    """
    path = Path(name).resolve()
    return next(
        (known for known, file in installed_policies().items() if file.resolve() == path), str(name)
    )


def open_policy(name: str, device: str) -> "TrainedPolicy | TrackingPolicy | None":
    """Load what :func:`find_policy` finds.

    None for a built-in agent, which has to know its task first.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is no policy.
    """
    if name in BUILT_IN:
        return None
    path = find_policy(name)
    if is_bundle(path):
        from vd.bundle.store import read_bundle

        return read_bundle(path, device)
    if path.suffix == ".onnx":
        raise ValueError(f"{path} is for vd-deploy; give the policy that it was made of")
    from vd.tracking.policy import read_policy

    return read_policy(path, device)


def sees_clouds(policy: Any | None) -> bool:
    """Whether what :func:`open_policy` gave sees point clouds."""
    return policy is not None and policy.kind != "teacher"


def open_teacher(name: str, device: str) -> "TrainedPolicy | None":
    """:func:`open_policy` where only a teacher, which sees the simulator's state, will do.

    Raises:
        ValueError: It sees point clouds.
    """
    from vd.policy import TrainedPolicy

    policy = open_policy(name, device)
    if not isinstance(policy, TrainedPolicy | None):
        raise ValueError(f"{name} sees point clouds; give a teacher, or use vd-eval")
    return policy


def check_fits(
    name: str, policy: Any | None, hand: str | None = None, hand_layer: str | None = None
) -> None:
    """Refuse a policy that moves another hand, before anything slow.

    Agents without a file move any.

    Raises:
        vd.bundle.contract.ContractError: A bundle of another hand, or a policy whose hand has
            changed since; names field, found, expected and remedy.
        ValueError: The hand has another name or number of joints, or cannot be read.
    """
    if policy is None:
        return
    from vd.assets_usd.hands import load_hand, root_name

    task = _on_hand(ReorientCfg.of(policy), hand, hand_layer)
    model, path = load_hand(task.hand, task.fingertip, task.hand_layer), find_policy(name)
    if is_bundle(path):
        from vd.bundle.contract import check_hand
        from vd.bundle.store import read_contract

        return check_hand(read_contract(path), model, path)
    own = ReorientCfg.of(policy).hand
    if policy.num_actions != len(model.actuated) or (
        task.hand != own and root_name(own) != model.name
    ):
        raise ValueError(
            f"{name} was trained for {own} ({policy.num_actions} motors), not for {model.name} "
            f"({len(model.actuated)}); use the hand it was trained for: --hand {own}"
        )
    if policy.kind == "teacher" and policy.trained_hand:
        from vd.bundle.contract import check_trained_hand

        check_trained_hand(policy.trained_hand, load_hand(task.hand, task.fingertip), name)


def _on_hand(task: ReorientCfg, hand: str | None, hand_layer: str | None) -> ReorientCfg:
    """A task with the hand and layer that were asked for; None: as trained."""
    layer = (
        task.hand_layer if hand_layer is None else None if hand_layer == NO_LAYER else hand_layer
    )
    return replace(task, hand=hand or task.hand, hand_layer=layer)


def task_for(
    policy: Any | None,
    *,
    stop_tolerance_rad: float,
    randomised: bool,
    hand: str | None = None,
    hand_layer: str | None = None,
    max_goal_angle_rad: float | None = None,
    at_rest: bool | None = None,
    condition: RandomisationCfg | None = None,
    **settings: Any,
) -> ReorientCfg:
    """The task in which an agent is evaluated or watched.

    Physics, actions and rewards are those of the training; the success criteria are the paper's,
    whatever the policy was trained with, so that rates can be compared; there is no curriculum.

    Args:
        policy: A trained policy, or None.
        stop_tolerance_rad: Orientation tolerance of success [rad].
        randomised: Domain randomisation, noise and disturbances.
        hand: Hand name; None, here and below: as trained.
        hand_layer: Layer over the hand with an identified servo model; ``none``: the hand as it is.
        max_goal_angle_rad: Largest angle from an object to a goal the environment draws [rad].
        at_rest: Start at rest on the table rather than from a drop.
        condition: What is drawn, in place of ``randomised`` (:mod:`vd.evaluate.conditions`).
        settings: Other fields of the task.
    """
    base = ReorientCfg.of(policy) if policy is not None else ReorientCfg(hand=DEFAULT_HAND)
    if sees_clouds(policy):  # who does not look at its teacher's observation
        base = replace(base, observation=ObservationCfg())
    seen = replace(
        base.observation, dynamics="none", critic_terms={}
    )  # nobody asks the critic here
    base = replace(
        base, observation=seen, reward=replace(base.reward, terms={})
    )  # and nobody is paid
    return replace(
        _on_hand(base, hand, hand_layer),
        success=replace(SuccessCfg(), rotation_rad=stop_tolerance_rad),
        start=base.start if at_rest is None else replace(base.start, at_rest=at_rest),
        goal=base.goal
        if max_goal_angle_rad is None
        else replace(base.goal, max_angle_rad=max_goal_angle_rad),
        curriculum=CurriculumCfg(),
        table=TableCfg(),
        randomisation=condition or replace(base.randomisation, enabled=randomised),
        **settings,
    )
