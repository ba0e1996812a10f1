"""A student whose teacher has gone on: it gets the teacher's layers of now, without training.

What it does comes from these layers, at what it estimates of the world (:mod:`vd.student.state`). Seeing does
not change when the teacher gets better; when to stop may.
"""

from dataclasses import replace
from pathlib import Path

from vd.assets_usd.hand_data import HandModel
from vd.assets_usd.hands import load_hand
from vd.config import from_dict, to_dict
from vd.envs.cfg import ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.envs.symmetry import view_tables
from vd.evaluate.agents import is_saved_student, open_policy, open_teacher, policy_name, trained_task
from vd.policy import TrainedPolicy
from vd.sim.scene import hand_mount
from vd.student.network import Student
from vd.student.saved import student_export
from vd.train.checkpoint import save_checkpoint
from vd.train.student.build import head_of


def follow_teacher(student: str, teacher: str, output: Path) -> bool:
    """Write a student with the layers of a newer version of its teacher.

    It gets its critic too, for second views. Its stopping rules stay, to be calibrated anew. One that
    estimated its fingertips computes them from then on.

    Args:
        student: student.pt, a run's folder, a bundle, or the name of an installed student.
        teacher: One of the same hand and observation: a file, a run's folder, or an installed one's name.
        output: File to write, small as those installed.

    Returns:
        Whether the teacher differs from the one that it has followed.

    Raises:
        FileNotFoundError: There is no such student or teacher.
        ValueError: The student is none, or does not act by its teacher's layers, or the teacher is of another
            kind.
    """
    saved, policy = open_policy(student, "cpu"), open_teacher(teacher, "cpu")
    if not is_saved_student(saved):
        raise ValueError(f"{student} is no student; give a student.pt or the name of an installed student")
    if policy is None:
        raise ValueError(f"{teacher} has no layers; give a trained teacher")
    network = saved.network
    if network.state is None:
        raise ValueError(
            f"{student} does not act by its teacher's layers (dagger.state-weight 0), so there is nothing to "
            "exchange; train it: vd-train student --init"
        )
    hand = str(saved.task.get("hand", ""))
    if hand != policy.hand:
        raise ValueError(f"{student} moves {hand}, {teacher} {policy.hand}; give a teacher of the same hand")
    own, wanted = network.cfg.state, head_of(policy)
    kept = replace(wanted, inside=own.inside, fingertips=own.fingertips, views=own.views, critic=own.critic)
    if kept != own:
        raise ValueError(
            f"{teacher} observes other things than the teacher of {student}, or has other layers; train a "
            "student of it"
        )
    if policy.task.get("action") != saved.task.get("action"):
        raise ValueError(
            f"an action of {teacher} means {policy.task.get('action')}, one of {student} "
            f"{saved.task.get('action')}; train a student of it"
        )
    if wanted.views != own.views:
        network = with_views(network, trained_task(policy))
    head = network.state
    assert head is not None
    other = head.follow(policy.network)
    if other:
        network.forget_correction()
    if not own.fingertips and network.cfg.senses_joints:
        task = from_dict(ReorientCfg, saved.task, where="task of the student")
        network = with_fingertips(network, load_hand(task.hand, task.fingertip, task.hand_layer))
    network = with_critic(network, policy)
    spec = replace(saved.spec, network=network.cfg, teacher=policy_name(teacher), calibrated_on="")
    state = {
        "spec": to_dict(spec),
        "task": saved.task,
        "depth": saved.depth,
        "iter": saved.iteration,
        "env_steps": saved.env_steps,
        "student_state_dict": network.state_dict(),
    }
    save_checkpoint(output, student_export(state, small=True))
    return other


def with_views(student: Student, task: ReorientCfg) -> Student:
    """A student that sees its goals in other views: those of ``task``, its teacher's."""
    cfg = student.cfg
    one = replace(task, objects=("cube",), num_worlds=1)
    env = ReorientEnv(one, "cpu")
    views = one.observation.views(env.num_fingers)
    network = Student(replace(cfg, state=replace(cfg.state, views=views)), student.num_actions)
    weights = {name: w for name, w in student.state_dict().items() if not name.startswith("state.views.")}
    network.load_state_dict(weights, strict=False)
    head = network.state
    if views:
        assert head is not None and head.views is not None
        head.views.adopt(view_tables(env.state, one.observation.view))
    return network.eval().requires_grad_(False)


def with_critic(student: Student, teacher: TrainedPolicy) -> Student:
    """A student with the critic of its teacher, if that has one, so that it needs no other file to ask."""
    cfg = student.cfg
    network = Student(replace(cfg, state=replace(cfg.state, critic=teacher.has_critic)), student.num_actions)
    weights = {name: w for name, w in student.state_dict().items() if not name.startswith("state.critic.")}
    network.load_state_dict(weights, strict=False)
    if teacher.has_critic:
        assert network.state is not None and network.state.critic is not None
        network.state.critic.load_state_dict(teacher.critic.state_dict())
    return network.eval().requires_grad_(False)


def with_fingertips(student: Student, hand: HandModel) -> Student:
    """A student that estimates its fingertips, computing them from its joints in place of that."""
    cfg = student.cfg
    network = Student(replace(cfg, state=replace(cfg.state, fingertips=True)), student.num_actions)
    network.load_state_dict(student.state_dict(), strict=False)
    head = network.state
    assert head is not None and head.fingertips is not None
    head.fingertips.adopt(hand, list(hand_mount()))
    head.add_nothing_to_told()
    return network.eval().requires_grad_(False)
