"""Agents by name or file, and the task they act in: shared by vd-eval and vd-play."""

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vd.assets_usd.cache import assets_dir
from vd.envs.cfg import (
    CurriculumCfg,
    ObservationCfg,
    RandomisationCfg,
    ReorientCfg,
    SuccessCfg,
    TableCfg,
)
from vd.policy import ONNX_SUFFIX, SUFFIX, has_suffix

if TYPE_CHECKING:
    from vd.policy.actor import TrainedPolicy
    from vd.tracking.policy import TrackingPolicy

BUILT_IN = ("zero", "random")
"""Agents without a file: no action, and uniform noise."""


def has_no_file(name: str | Path) -> bool:
    """Whether an agent is built in, or a function of a user, ``module:function``."""
    text = str(name)
    return text in BUILT_IN or (":" in text and not Path(text).exists())


POLICY_FOLDER = Path(__file__).parents[1] / "policies"
"""Policies of the package, and POLICY_LIST. A wheel has two of them, a checkout all."""
POLICY_LIST = "policies.json"
"""Tells of the policies of a folder (:mod:`vd.policy.store`), in a wheel also of those that it
lacks.
"""
SHIPPED_POLICIES = {path.stem: path for path in sorted(POLICY_FOLDER.glob(f"*{SUFFIX}"))}
"""Trained policies that are installed with the package, by name: ``<hand>`` or
``<hand>-<task>``.
"""

DEFAULT_POLICY = "dclaw4"
DEFAULT_HAND = "dclaw4"
NO_LAYER = "none"
"""What --hand-layer is to be for the hand as it is, whatever the training."""
# What a run's folder holds, best first.
_RUN_FILES = (f"policy{SUFFIX}", "checkpoints/best.pt")


def pulled_folder() -> Path:
    """Where ``vd-policies pull`` puts policies."""
    return assets_dir() / "policies"


def installed_policies() -> dict[str, Path]:
    """Policies by name: those of the package, and those that were pulled."""
    pulled = {path.stem: path for path in sorted(pulled_folder().glob(f"[!.]*{SUFFIX}"))}
    return pulled | SHIPPED_POLICIES


def find_policy(name: str | Path) -> Path:
    """The file that ``name`` means: of an installed policy, itself, or the best of a run's folder.

    A ``Path``, and text with a slash, are paths. Other text is the name of an installed policy if
    there is one, and a path otherwise.

    Raises:
        FileNotFoundError: There is none.
        ValueError: A policy of that name has to be pulled.
    """
    installed, path = installed_policies(), Path(name)
    bare = isinstance(name, str) and name == path.name
    if bare and name in installed:
        return installed[name]
    if path.is_file():
        return path
    known = json.loads((POLICY_FOLDER / POLICY_LIST).read_text())["policies"]
    if bare and not path.exists() and name in known:
        raise ValueError(
            f"the policy {name} is not on this machine: vd-policies pull {name} --at PLACE, such "
            f"as the folder vd/policies of a checkout"
        )
    if not path.is_dir():
        raise FileNotFoundError(
            f"no policy at {path}; give a policy{SUFFIX}, a file of a run's checkpoints folder, a "
            f"run's folder, or the name of an installed policy: {', '.join(installed)}"
        )
    for candidate in _RUN_FILES:
        if (path / candidate).is_file():
            return path / candidate
    raise FileNotFoundError(
        f"{path} holds no {' or '.join(_RUN_FILES)}; give a policy{SUFFIX} or a checkpoint"
    )


def check_names(agents: Iterable[str], objects: Iterable[str], hand: str | None = None) -> None:
    """Refuse agents, object sets and a hand that are not there, before anything slow is imported."""
    from vd.assets_usd.hands import check_hand_name
    from vd.assets_usd.objects.sets import check_sets

    for name in agents:
        if not has_no_file(name):
            find_policy(name)
    check_sets(objects)
    if hand is not None:
        check_hand_name(hand)


def policy_at(path: Path) -> str:
    """A path as text that is no policy's name."""
    return str(path) if path.is_absolute() else f"./{path}"


def policy_name(name: str | Path) -> str:
    """``name`` as it is told to others.

    The name of an installed policy if it is the file of one.
    """
    path = Path(name).resolve()
    return next(
        (known for known, file in installed_policies().items() if file.resolve() == path), str(name)
    )


def open_policy(name: str | Path, device: str) -> "TrainedPolicy | TrackingPolicy | None":
    """Load what :func:`find_policy` finds.

    None for an agent without a file, which has to know its task first.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is no policy.
    """
    if has_no_file(name):
        return None
    path = find_policy(name)
    if has_suffix(path, ONNX_SUFFIX):
        raise ValueError(f"{path} is for vd-deploy; give the policy that it was made of")
    from vd.policy.bundle import read_policy

    return read_policy(path, device)


def sees_clouds(policy: Any | None) -> bool:
    """Whether what :func:`open_policy` gave sees point clouds."""
    return policy is not None and policy.kind != "teacher"


def open_teacher(name: str, device: str) -> "TrainedPolicy | None":
    """:func:`open_policy` where only a teacher, which sees the simulator's state, will do.

    Raises:
        ValueError: It sees point clouds.
    """
    from vd.policy.actor import TrainedPolicy

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
        vd.policy.contract.ContractError: The hand is not as in the policy's training; names field,
            found, expected and remedy.
        ValueError: The hand has another name, or cannot be read.
    """
    if policy is None:
        return
    from vd.assets_usd.hands import load_hand
    from vd.policy.contract import check_hand

    own = ReorientCfg.of(policy)
    task = _on_hand(own, hand, hand_layer)
    load_hand(task.hand, task.fingertip, task.hand_layer)
    model = load_hand(task.hand, task.fingertip)
    trained = policy.contract.interface["hand"]["name"]
    if trained != model.name:
        raise ValueError(
            f"{name} was trained for {trained} ({policy.num_actions} motors), not for {model.name} "
            f"({len(model.actuated)}); use the hand it was trained for: --hand {own.hand}"
        )
    check_hand(policy.contract, model, name)


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
        start=replace(
            base.start,
            at_rest=base.start.at_rest if at_rest is None else at_rest,
            reached_share=0.0,
        ),
        goal=base.goal
        if max_goal_angle_rad is None
        else replace(base.goal, max_angle_rad=max_goal_angle_rad),
        curriculum=CurriculumCfg(),
        table=TableCfg(),
        randomisation=condition or replace(base.randomisation, enabled=randomised),
        **settings,
    )
