"""What the package offers to programs, where no other module has it under its stable name (:mod:`vd`)."""

import contextlib
import json
import multiprocessing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from vd.assets_usd.hand_data import CameraModel, HandModel
    from vd.assets_usd.objects.model import ObjectModel
    from vd.envs.cfg import ReorientCfg
    from vd.envs.reorient import ReorientEnv
    from vd.evaluate.result import Result
    from vd.gap.result import Report


def load_policy(name: str | Path, env: "ReorientEnv | None" = None, device: str = "auto") -> Any:
    """A policy from a file, to look at, or to act in an environment.

    Args:
        name: An installed policy such as ``dclaw4``, the path of a ``policy.safetensors`` or of a
            run's folder; with an environment also ``zero`` and ``random``. A ``Path``, and text
            with a slash, are paths.
        env: Where it acts. A policy that sees by a camera opens its eyes in there, and acts there
            alone.
        device: Of the policy, without an environment: auto, cpu or cuda:N.

    Returns:
        A policy: ``act(observation)`` gives actions [N, A] for observations [N, O], torch tensors.
        Without an environment it has ``task``, for :meth:`ReorientCfg.of`, and a policy by camera
        does not act.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is no policy.
    """
    from vd.command.device import resolve_device
    from vd.evaluate.compare import actor_of
    from vd.policy.agents import open_policy

    policy = open_policy(name, resolve_device(device) if env is None else env.device)
    if env is not None:
        return actor_of(str(name), policy, env)[0]
    if policy is None:
        raise ValueError(f"{name} acts in any environment, and has to know which; give env")
    return policy


def evaluate_policies(*policies: str | Path, **settings: Any) -> "Result":
    """Run policies through the same episodes, as ``vd-eval`` does, and write ``eval.json`` into ``out``.

    Args:
        policies: As of :func:`load_policy`, with ``zero`` and ``random``.
        settings: Long flags of ``vd-eval`` with underscores: ``objects``, ``episodes``, ``out``.

    Returns:
        The result: ``rows``, one of each policy, group of objects and way to stop.

    Raises:
        FileNotFoundError: There is no such policy.
        ValueError: A setting or a set of objects cannot be used.
    """
    from vd.command.config import from_dict
    from vd.evaluate.cfg import EvalCfg, parse_groups
    from vd.evaluate.compare import compare
    from vd.policy.agents import check_names, policy_at

    names = [name if isinstance(name, str) else policy_at(name) for name in policies]
    cfg = from_dict(EvalCfg, {"policies": names, **settings})
    cfg.validate()
    check_names(
        cfg.agent_names,
        [s for sets in parse_groups(cfg.object_sets).values() for s in sets],
        cfg.hand,
    )
    return compare(cfg)


def observation_layout(cfg: "ReorientCfg") -> dict[str, slice]:
    """Which columns of an observation hold what, by name, in order.

    ``env.observation`` [N, O] has those that a policy reads, ``env.privileged`` what only the
    critic reads besides; names of the latter begin with ``critic/``, and their columns go on
    counting behind O. Meanings and units: the table of the reference.

    Args:
        cfg: The task; hand and ``observation`` decide.

    Raises:
        ValueError: There is no such hand.
    """
    from vd.assets_usd.hands import load_hand
    from vd.envs.parts import observation_columns

    hand = load_hand(cfg.hand, cfg.fingertip)
    return observation_columns(cfg.observation, hand.num_fingers, hand.num_joints)


class ObjectTracker:
    """Finds an object in depth images beside the hand, by points of its surface.

    :meth:`look` takes the next.
    """

    def __init__(
        self,
        hand: "HandModel",
        item: "ObjectModel",
        camera: "CameraModel | None" = None,
        *,
        policy: str | Path | None = None,
        device: str = "cpu",
    ):
        """Load the network.

        Args:
            hand: The hand (:func:`load_hand`), whose own points are left out.
            item: The object (:func:`load_objects`), of which the surface points are known.
            camera: Lens, and pose in the base frame; the policy's by default.
            policy: A vision policy, whose network finds the object; the hand's installed one by
                default.
            device: auto, cpu or cuda:N.

        Raises:
            FileNotFoundError: There is no such policy.
            ValueError: It is no vision policy, or none of this hand is installed.
        """
        import torch

        from vd.command.device import resolve_device
        from vd.kernels.task.observations import teacher_observation_size
        from vd.paper import PAPER
        from vd.policy.agents import default_policy, open_policy
        from vd.sensors.depth_cloud import CameraCloud
        from vd.vision.acting_teacher import VisionPolicy
        from vd.vision.camera_observer import CameraObserver

        device = resolve_device(device)
        name = policy or default_policy(hand.name, "vision")
        seeing = open_policy(name, device)
        if not isinstance(seeing, VisionPolicy):
            raise ValueError(f"{name} finds nothing by points; name a vision policy")
        camera = camera or hand.camera.at(seeing.spec.camera)
        self._cloud = CameraCloud(camera, np.asarray(hand.mount), device=device)
        self._observer = CameraObserver(
            hand,
            seeing.alignment,
            torch.tensor(item.surface_points[None], dtype=torch.float32, device=device),
            num_observations=teacher_observation_size(hand.num_fingers, hand.num_joints),
            control_hz=PAPER.scene.control_hz,
        )

    def look(self, depth: np.ndarray, joint_q: np.ndarray, *, fresh: bool = False) -> np.ndarray:
        """Find the object in the next image.

        Args:
            depth: Depth along the optical axis [m], 0 for none, shape [H, W].
            joint_q: Joint positions [rad], shape [D].
            fresh: Forget where it was.

        Returns:
            Position [m] and quaternion xyzw in the world frame, shape [7]; of a symmetric object
            one of the orientations in which it looks like this. As before where nothing is seen of
            it.

        Raises:
            ValueError: The image has another size than the camera.
        """
        import torch
        import warp as wp

        from vd.policy.senses import Senses

        points = wp.to_torch(self._cloud.seen(depth))
        joints = torch.as_tensor(joint_q, dtype=torch.float32, device=points.device)[None]
        still, anywhere = torch.zeros_like(joints), points.new_tensor([[0.0, 0.0, 0.0, 1.0]])
        begins = torch.tensor([fresh], device=points.device)
        self._observer(Senses(joints, still, still, anywhere, points, begins))
        found = self._observer.found
        assert found is not None
        return torch.cat([found.position[0], found.orientation[0]]).cpu().numpy()


def analyse_gap(recording: str | Path, out: str | Path, **settings: Any) -> "Report":
    """Find, explain and close the gap of a recording, as ``vd-gap run`` does.

    Finished steps are kept.

    Args:
        recording: Folder of the recording.
        out: Folder for ``report.json``, ``report.html`` and the identified model,
            ``identified.usda``.
        settings: ``hand``, ``hand_layer``, ``effects``, ``seed``, ``device``, as the flags of
            ``vd-gap run``.

    Returns:
        The report: ``verdict``, ``effects`` and how much closer the identified model is,
            ``closing``.

    Raises:
        RuntimeError: A script calls it without ``if __name__ == "__main__":``; worker processes
            import it.
        ValueError: The recording or a setting cannot be used.
    """
    # A worker that imports the script.
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise RuntimeError(
            'analyse_gap() starts processes: call it under if __name__ == "__main__":'
        )
    from vd.gap.result import Report
    from vd.gap.steps import Analysis, Settings

    Analysis(Settings(Path(recording), **settings), Path(out)).run("report")
    return Report.read(Path(out) / "report.json")


def gap_verdict(report: str | Path) -> str:
    """The verdict in ``report.json`` of ``vd-gap``, in one or two sentences.

    Raises:
        ValueError: Not such a file.
    """
    from vd.gap.result import Report
    from vd.gap.words import verdict_sentence

    return verdict_sentence(Report.read(Path(report)))


def read(path: str | Path) -> Any:
    """Read a file or folder of any of the formats, as its own content says which.

    Args:
        path: Folder of a recording, or the log of a run; a ``policy.safetensors``;
            ``report.json`` of ``vd-gap``; ``eval.json`` of ``vd-eval``.

    Returns:
        A recording, a policy, a log, a report or a result.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is none of these, damaged, or of another version.
    """
    from vd.evaluate.result import Result
    from vd.gap.result import Report
    from vd.logs.hand_log import is_log, read_log
    from vd.logs.recording import read_recording
    from vd.policy import SUFFIX, has_suffix

    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no {path}")
    if has_suffix(path, SUFFIX):
        from vd.policy.bundle import read_policy

        return read_policy(path)
    if is_log(path):
        return read_log(path)
    if path.is_dir():
        return read_recording(path)
    found = ""
    with contextlib.suppress(ValueError, LookupError, TypeError):
        found = str(json.loads(path.read_text())["format"])
    for start, kind in (("vd-gap", Report), ("visual-dexterity evaluation", Result)):
        if found.startswith(start):
            return kind.read(path)
    raise ValueError(
        f"{path} has {f'the format {found!r}' if found else 'no format'}; give the folder of a "
        f"recording or log, a policy.safetensors, report.json or eval.json (load_policy reads "
        f"policies, load_hand and load_objects USD)"
    )


def write(value: Any, path: str | Path) -> None:
    """Write what :func:`read` reads.

    A recording into a folder, a policy, report or result into a file.

    Raises:
        OutputError: It cannot be written.
        TypeError: There is no format for such a value.
        ValueError: The name is not that of a policy's file.
    """
    from vd.evaluate.result import Result
    from vd.gap.result import Report
    from vd.logs.recording import Recording, write_recording

    if isinstance(value, Recording):
        write_recording(value, path)
    elif isinstance(value, Report | Result):
        value.write(Path(path))
    elif hasattr(value, "task"):
        from vd.policy.bundle import write_policy
        from vd.policy.contract import without_folders

        write_policy(value, Path(path), without_folders(value.contract))
    else:
        raise TypeError(
            f"there is no format for a {type(value).__name__}; give a recording, policy or result"
        )
