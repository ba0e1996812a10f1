"""From the name of a policy to what runs it in the control loop."""

from dataclasses import replace
from typing import Any

from vd.assets_usd.hand_data import HandModel
from vd.assets_usd.objects.model import ObjectModel
from vd.deploy.loop.policy_runner import ZERO, PolicyRunner, StudentRunner, TrackingRunner
from vd.deploy.loop.teacher_runner import TeacherRunner
from vd.envs.cfg import ReorientCfg
from vd.evaluate.agents import check_bundle, is_saved_student, is_tracking_policy, open_policy, trained_task
from vd.paper import PAPER
from vd.stopping import StoppingRule


def load_runner(
    name: str,
    hand_name: str,
    item_name: str,
    hand: HandModel,
    item: ObjectModel,
    *,
    tolerance_rad: float = PAPER.success.rotation_rad,
    second_view: bool = False,
    seed: int = 0,
) -> PolicyRunner:
    """Load a policy for the loop.

    Args:
        name: Bundle, file of a policy, installed policy, or ``zero``.
        hand_name: Name of the hand or its USD.
        item_name: Name of the object's set or its USD.
        hand: The hand.
        item: The object.
        tolerance_rad: How near to the goal it is to stop [rad].
        second_view: Select symmetry views by the critic (:mod:`vd.evaluate.second_view`).
        seed: Of the choice of camera points.

    Raises:
        ValueError: It is for another hand, or cannot act, or has no second view.
    """
    policy: Any = None if name == ZERO else open_policy(name, "cpu")
    student = is_saved_student(policy)
    if second_view and (policy is None or student):
        raise ValueError(f"--second-view: {name} has no views to select; give a teacher or a tracking policy")
    if policy is None:
        if name != ZERO:
            raise ValueError(f"{name} is not for a hand; give a bundle, a policy's file, or {ZERO}")
        return PolicyRunner(ReorientCfg(hand=hand_name), StoppingRule())
    moves = policy.spec.num_actions if student else policy.num_actions
    if moves != hand.num_joints:
        raise ValueError(f"{name} moves {moves} joints, the hand {hand.name} has {hand.num_joints}")
    check_bundle(name, replace(trained_task(policy), hand=hand_name))
    if student:
        return StudentRunner(policy, hand, item, tolerance_rad=tolerance_rad, seed=seed)
    if is_tracking_policy(policy):
        return TrackingRunner(
            policy, hand, item, tolerance_rad=tolerance_rad, second_view=second_view, seed=seed
        )
    return TeacherRunner(policy, hand_name, item_name, tolerance_rad, second_view=second_view)
