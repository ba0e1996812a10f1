"""A student whose teacher has gone on: it gets the teacher's layers of now, without training.

What it does comes from these layers, at what it estimates of the world (:mod:`vd.student.state`). Seeing does
not change when the teacher gets better; when to stop may.
"""

from dataclasses import replace
from pathlib import Path

from vd.config import to_dict
from vd.evaluate.agents import find_policy, open_teacher, policy_name
from vd.student.network import Student
from vd.student.saved import read_student, saved_spec, student_export
from vd.train.checkpoint import save_checkpoint


def follow_teacher(student: str, teacher: str, output: Path) -> bool:
    """Write a student with the layers of a newer version of its teacher.

    Its stopping rules stay, to be calibrated anew.

    Args:
        student: student.pt, a run's folder, or the name of an installed student.
        teacher: One of the same hand and observation: a file, a run's folder, or an installed one's name.
        output: File to write, small as those installed.

    Returns:
        Whether the teacher differs from the one that it has followed.

    Raises:
        FileNotFoundError: There is no such student or teacher.
        ValueError: The student does not act by its teacher's layers, or the teacher is of another kind.
    """
    path = find_policy(student)
    state, policy = read_student(path), open_teacher(teacher, "cpu")
    if policy is None:
        raise ValueError(f"{teacher} has no layers; give a trained teacher")
    spec = saved_spec(state, path)
    network = Student(spec.network, spec.num_actions)
    network.load_state_dict(state["student_state_dict"])
    if network.state is None:
        raise ValueError(
            f"{path} does not act by its teacher's layers (dagger.state-weight 0), so there is nothing to "
            "exchange; train it: vd-train student --init"
        )
    hands = (str(state["task"].get("hand", "")), policy.hand)
    if hands[0] != hands[1]:
        raise ValueError(f"{path} moves {hands[0]}, {teacher} {hands[1]}; give a teacher of the same hand")
    views = policy.task.get("observation", {}).get("view") == "goal"
    if views != (network.state.views is not None) or policy.num_observations != spec.network.state.values:
        raise ValueError(f"{teacher} observes other things than the teacher of {path}; train a student of it")
    try:
        other = network.state.follow(policy.network)
    except RuntimeError as error:
        raise ValueError(f"{teacher} has other layers than the teacher of {path} ({error})") from error
    followed = replace(spec, teacher=policy_name(teacher), calibrated_on="")
    kept = {**state, "spec": to_dict(followed), "student_state_dict": network.state_dict()}
    save_checkpoint(output, student_export(kept, small=True))
    return other
