"""Agents by name or file, and the task they act in, for all commands that let one act."""

import re
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
    from vd.policy.bundle import AnyPolicy

BUILT_IN = ("zero", "random")
"""Agents without a file: no action, and uniform noise."""


def has_no_file(name: str | Path) -> bool:
    """Whether an agent is built in, or a function of a user, ``module:function``."""
    text = str(name)
    return text in BUILT_IN or (":" in text and not Path(text).exists())


POLICY_FOLDER = Path(__file__).parents[1] / "policies"
"""Policies of the package. A wheel has two of them, a checkout all."""
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
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def check_name(name: str) -> None:
    """Refuse what cannot be a policy's name, such as a path.

    Raises:
        ValueError: It cannot.
    """
    if not _NAME.fullmatch(name) or name in BUILT_IN or name.endswith(SUFFIX):
        raise ValueError(
            f"{name!r} is no name of a policy: letters, digits, and . _ - between them; no {SUFFIX} "
            f"at its end"
        )


def pulled_folder() -> Path:
    """Where ``vd-policies pull`` puts policies."""
    return assets_dir() / "policies"


def installed_policies() -> dict[str, Path]:
    """Files of policies by name: those of the package, and those that were pulled."""
    pulled = {path.stem: path for path in pulled_folder().glob(f"[!.]*{SUFFIX}")}
    return dict(sorted((pulled | SHIPPED_POLICIES).items()))


def default_policy(hand: str, *kinds: str) -> str:
    """Name of the installed policy of a hand, of the first of these kinds that there is.

    Of several of a kind that with the shortest name, which is the one for most objects.

    Args:
        hand: Name or USD of the hand.
        kinds: ``teacher``, ``vision`` or ``student``.

    Raises:
        ValueError: The hand has none.
    """
    from vd.assets_usd.hands import root_name
    from vd.policy.contract import ContractError, installed_contract

    kind_of = {}
    for name, path in installed_policies().items():
        try:
            contract = installed_contract(path)
        except ContractError:
            continue  # of another version; who names it is told so
        if contract.task["hand"] == root_name(hand):
            kind_of[name] = contract.kind
    for kind in kinds:
        names = [name for name in kind_of if kind_of[name] == kind]
        if names:
            return min(names, key=len)
    others = "vd-policies list shows what there is"
    if kind_of:
        others = f"there are {', '.join(kind_of)}"
    raise ValueError(
        f"no {' or '.join(kinds)} policy of {hand} is installed ({others}); name a policy, or train "
        "one with vd-train"
    )


def find_policy(name: str | Path) -> Path:
    """The file that ``name`` means: of an installed policy, itself, or the best of a run's folder.

    A ``Path``, and text with a slash, are paths. Other text is the name of an installed policy if
    there is one, and a path otherwise.

    Raises:
        FileNotFoundError: There is none.
    """
    installed = installed_policies()
    path = Path(name)
    if isinstance(name, str) and name == path.name and name in installed:
        return installed[name]
    if path.is_file():
        return path
    if not path.is_dir():
        raise FileNotFoundError(
            f"no policy at {path}; give a policy{SUFFIX}, a file of a run's checkpoints folder, a "
            f"run's folder, or the name of an installed policy: {', '.join(installed)}; "
            "vd-policies pull NAME --at PLACE fetches others"
        )
    for file in _RUN_FILES:
        if (path / file).is_file():
            return path / file
    raise FileNotFoundError(
        f"{path} holds no {' or '.join(_RUN_FILES)}; give a policy{SUFFIX} or a checkpoint"
    )


def check_names(agents: Iterable[str], objects: Iterable[str], hand: str | None = None) -> None:
    """Refuse agents, object sets and a hand that are not there, before slow imports."""
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
    """The name of the installed policy whose file ``name`` is, or else ``name`` itself."""
    path = Path(name).resolve()
    for installed, file in installed_policies().items():
        if file.resolve() == path:
            return installed
    return str(name)


def open_policy(name: str | Path, device: str) -> "AnyPolicy | None":
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

    trained_in = ReorientCfg.of(policy)
    task = _on_hand(trained_in, hand, hand_layer)
    load_hand(task.hand, task.fingertip, task.hand_layer)  # the layer can be read
    model = load_hand(task.hand, task.fingertip)
    trained_hand = policy.contract.interface["hand"]["name"]
    if trained_hand != model.name:
        raise ValueError(
            f"{name} was trained for {trained_hand} ({policy.num_actions} motors), not for "
            f"{model.name} ({len(model.actuated)}); use the hand it was trained for: "
            f"--hand {trained_in.hand}"
        )
    check_hand(policy.contract, model, name)


def _on_hand(task: ReorientCfg, hand: str | None, hand_layer: str | None) -> ReorientCfg:
    """A task with the hand and layer that were asked for; None: as trained."""
    if hand is not None:
        task = replace(task, hand=hand)
    if hand_layer is not None:
        task = replace(task, hand_layer=None if hand_layer == NO_LAYER else hand_layer)
    return task


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
    task = ReorientCfg(hand=DEFAULT_HAND) if policy is None else ReorientCfg.of(policy)
    observation = task.observation
    if sees_clouds(policy):  # its teacher's observation is not read
        observation = ObservationCfg()
    # Neither the critic nor the reward is asked for.
    observation = replace(observation, dynamics="none", critic_terms={})
    task = replace(task, observation=observation, reward=replace(task.reward, terms={}))
    task = _on_hand(task, hand, hand_layer)
    if at_rest is not None:
        task = replace(task, start=replace(task.start, at_rest=at_rest))
    if max_goal_angle_rad is not None:
        task = replace(task, goal=replace(task.goal, max_angle_rad=max_goal_angle_rad))
    return replace(
        task,
        success=replace(SuccessCfg(), rotation_rad=stop_tolerance_rad),
        curriculum=CurriculumCfg(),
        table=TableCfg(),
        randomisation=condition or replace(task.randomisation, enabled=randomised),
        **settings,
    )
