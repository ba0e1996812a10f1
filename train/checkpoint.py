"""Checkpoints: whole or absent, readable without running code, with the random state."""

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from vd.command.files import atomic_path
from vd.policy import SUFFIX, has_suffix
from vd.policy.actor import read_state

CHECKPOINT_FOLDER = "checkpoints"
BEST_NAME = "best.pt"
POLICY_NAME = f"policy{SUFFIX}"
"""The policy of a run, in its folder: what vd-eval, vd-play and deployment read."""
KEEP_LAST = 3
"""Periodic checkpoints to keep besides the best: one to go on from, and others should it be
damaged.
"""
AUTO = "auto"
"""``--resume auto`` goes on with a run where there is one, and starts it otherwise."""
_NEEDED = {
    "actor": ("policy", "task", "iter", "env_steps"),
    "alignment": ("spec", "task", "iter", "env_steps"),
    "student": ("contract", "task", "iter", "env_steps"),
}
"""What belongs to the weights of each network. Other projects' files have an actor too.
"""
_ARRAY = "__numpy__"
_WORLDS = "arrays"
"""Key in the environment's state under which that of its environments lies."""


def checkpoint_path(run_dir: Path, iteration: int) -> Path:
    """File of the checkpoint after ``iteration`` iterations."""
    return run_dir / CHECKPOINT_FOLDER / f"model_{iteration:07d}.pt"


def list_checkpoints(run_dir: Path) -> list[Path]:
    """Periodic checkpoints of a run, oldest first (``best.pt`` is not among them)."""
    return sorted((run_dir / CHECKPOINT_FOLDER).glob(f"model_{'[0-9]' * 7}.pt"))


def find_checkpoint(run_dir: Path, which: str | None, network: str = "actor") -> Path | None:
    """The checkpoint that ``--resume`` names; None for a new run.

    Args:
        run_dir: Folder of the run.
        which: ``latest``: the newest that is sound. ``auto``: the same, or none in a folder without
            any. ``best``, or a file. None: a new run.
        network: What has to be in it, as in :func:`load_checkpoint`.

    Raises:
        FileExistsError: A new run is asked for in a folder that holds one.
        FileNotFoundError: There is none; the message says what is there.
        ValueError: None is sound.
    """
    best = run_dir / CHECKPOINT_FOLDER / BEST_NAME
    files = [*([best] if best.is_file() else []), *list_checkpoints(run_dir)]
    if which is None and files:
        raise FileExistsError(
            f"{run_dir} holds a run; add --resume to go on with it, or choose another --out"
        )
    if which is None or (which == AUTO and not files):
        return None
    if which in (AUTO, "latest") and files:
        return _newest_sound(files, network)
    path = best if which in ("best", "latest") else Path(which)
    if not path.is_file():
        present = ", ".join(p.name for p in files) or "none; leave --resume out to start"
        raise FileNotFoundError(f"--resume: no file {path}; checkpoints of {run_dir}: {present}")
    return path


def _newest_sound(files: list[Path], network: str) -> Path:
    """The last of ``files`` that can be read; those after it are named on stderr."""
    reasons: list[str] = []
    for path in reversed(files):
        try:
            load_checkpoint(path, network=network)
        except ValueError as error:
            reasons.append(str(error).partition(";")[0])
            continue
        if reasons and os.environ.get("RANK", "0") == "0":
            print(
                f"{'; '.join(reasons)}; {path.name}, which is sound, takes its place",
                file=sys.stderr,
            )
        return path
    raise ValueError(
        f"--resume: no checkpoint is sound ({', '.join(reasons)}); start anew with another --out"
    )


def prune_checkpoints(run_dir: Path, newest: int) -> None:
    """Delete old checkpoints up to iteration ``newest``, and what a killed run left half-written.

    What a run that went on from an older checkpoint finds after that stays.
    """
    last = checkpoint_path(run_dir, newest)
    old = [path for path in list_checkpoints(run_dir) if path <= last][:-KEEP_LAST]
    for path in (*old, *(run_dir / CHECKPOINT_FOLDER).glob(".*.pt")):
        path.unlink(missing_ok=True)


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write ``state`` (tensors, arrays, plain values).

    ``path`` is the old file or the whole new one.
    """
    with atomic_path(path) as temporary:
        with temporary.open("wb") as file:
            torch.save(_plain(state), file)
            file.flush()
            os.fsync(file.fileno())  # a rename alone may survive a power cut without the data


def load_checkpoint(
    path: Path, device: str = "cpu", *, network: str = "actor", flag: str = "--resume"
) -> dict[str, Any]:
    """Read a checkpoint with weights of a network, executing nothing in it.

    ``network`` is ``actor`` (of a teacher), ``alignment`` or ``student``; ``flag`` is what asked
    for it, for messages.

    Raises:
        ValueError: The file is damaged or not a checkpoint.
    """
    if has_suffix(path, SUFFIX):
        raise ValueError(
            f"{path} is a policy, which nothing can resume; --init begins a new run from it"
        )
    state = read_state(path, device, remedy=f"give {flag} another file of its folder")
    if not {f"{network}_state_dict", *_NEEDED[network]} <= state.keys():
        command = "teacher" if network == "actor" else network
        raise ValueError(
            f"{path} holds no {network}; give {flag} a file that vd-train {command} wrote in "
            f"{CHECKPOINT_FOLDER}/"
        )
    return _restored(state)


def without_worlds(state: dict[str, Any]) -> dict[str, Any]:
    """A checkpoint without what each process simulates.

    A tenth in size, and of any number of processes.

    Networks, optimiser, curriculum and counters stay; a run that goes on from it starts its
    episodes anew.
    """
    kept = []
    for rank in state["ranks"]:
        env = dict(rank["env"])
        env.pop(_WORLDS, None)
        kept.append({"env": env})
    return state | {"ranks": kept}


def saved_worlds(rank: dict[str, Any]) -> int:
    """Environments in one process's part of a checkpoint (an item of ``ranks``).

    0 if it was left out.
    """
    arrays = rank["env"].get(_WORLDS)
    return 0 if arrays is None else len(arrays["step_count"])


def random_state(device: str) -> dict[str, Any]:
    """State of torch's random generators: of the CPU, and of ``device`` if it is a GPU."""
    state = {"torch": torch.get_rng_state()}
    if device.startswith("cuda"):
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


def set_random_state(state: dict[str, Any], device: str) -> None:
    """Restore what :func:`random_state` gave. A GPU state is skipped where there is no GPU."""
    torch.set_rng_state(state["torch"].cpu())
    if device.startswith("cuda") and "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"].cpu(), device)


def _plain(value: Any) -> Any:
    """``value`` with NumPy arrays as tensors, which load without running code."""
    if isinstance(value, np.ndarray):
        return {_ARRAY: torch.from_numpy(np.ascontiguousarray(value)), "shape": list(value.shape)}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(map(_plain, value))
    return value


def _restored(value: Any) -> Any:
    """The inverse of :func:`_plain`."""
    if isinstance(value, dict):
        if _ARRAY in value:
            return value[_ARRAY].cpu().numpy().reshape(value["shape"])
        return {key: _restored(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(map(_restored, value))
    return value
