"""Students in files: network, weights, and what belongs to them. Reading one executes nothing in it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

from vd.config import from_dict
from vd.policy import holds, read_state
from vd.stopping import StoppingRules
from vd.vision.cfg import StudentCfg
from vd.vision.network import Student

STUDENT_FORMAT = "visual-dexterity student 1"


@dataclass(frozen=True, kw_only=True)
class StudentSpec(StoppingRules):
    """Everything about a student but its weights and its task."""

    network: StudentCfg
    """The network."""
    num_actions: int
    """Actions D."""
    stage: int
    """Stage of the training it comes from: 0, 1 or 2."""
    teacher: str = ""
    """Name of the policy it imitates."""
    camera: tuple[float, ...] | None = None
    """Pose of the optical frame in the base frame, position [m] and quaternion xyzw; None: the hand's."""


@dataclass(frozen=True)
class SavedStudent:
    """A student that was read from a file."""

    kind: ClassVar[Literal["student"]] = "student"
    spec: StudentSpec
    network: Student
    """In evaluation mode, without gradients."""
    task: dict[str, Any]
    """Configuration of the environment it was trained in, as a dictionary."""
    depth: dict[str, Any]
    """Configuration of its depth camera, as a dictionary; of no meaning before stage 2."""
    iteration: int
    """Iterations it was trained for."""
    env_steps: int
    """Control steps it was trained for (clouds in stage 0)."""

    @property
    def num_actions(self) -> int:
        """Actions D."""
        return self.spec.num_actions


def is_student(path: Path) -> bool:
    """Whether a file is a student, as far as it can be read."""
    return holds(path, "student_state_dict")


def student_export(state: dict[str, Any]) -> dict[str, Any]:
    """The part of a checkpoint that :func:`load_student` needs."""
    weights = {name: value.detach().cpu() for name, value in state["student_state_dict"].items()}
    kept = {key: state[key] for key in ("spec", "task", "depth", "iter", "env_steps")}
    return {"format": STUDENT_FORMAT, **kept, "student_state_dict": weights}


def read_student(path: Path, device: str = "cpu") -> dict[str, Any]:
    """The contents of ``student.pt`` or of a checkpoint, without building the network.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, or no student.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"no student at {path}; give a student.pt or a checkpoint of vd-train student"
        )
    state = read_state(path, device, remedy="copy it again, or give another file of its run")
    if not {"spec", "student_state_dict", "task", "depth"} <= state.keys():
        raise ValueError(f"{path} holds no student; give a file that vd-train student wrote")
    return state


def saved_spec(state: dict[str, Any], path: Path) -> StudentSpec:
    """The description in what :func:`read_student` gave.

    Raises:
        ValueError: It is of another version.
    """
    if "object" in state["spec"]["network"].get("senses", ()):
        raise ValueError(
            f"{path} finds its object by a known shape: that is a tracking policy now. Write one of its "
            f"teacher: vd-train tracker {state['spec'].get('teacher') or 'TEACHER'} --objects SET"
        )
    try:
        return from_dict(StudentSpec, state["spec"], where="spec")
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}; it was written by another version") from error


def load_student(path: str | Path, device: str = "cpu") -> SavedStudent:
    """Rebuild a student.

    Args:
        path: ``student.pt``, or a checkpoint of ``vd-train student``.
        device: Torch device.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, or no student.
    """
    path = Path(path)
    state = read_student(path, device)
    spec = saved_spec(state, path)
    network = Student(spec.network, spec.num_actions).to(device)
    try:
        network.load_state_dict(state["student_state_dict"])
    except RuntimeError as error:
        raise ValueError(f"{path}: the weights do not fit the network it describes ({error})") from error
    network.eval().requires_grad_(False)
    return SavedStudent(
        spec, network, state["task"], state["depth"], int(state["iter"]), int(state["env_steps"])
    )
