"""Writing files: a reader sees the old file or the whole new one.

What cannot be written is said.
"""

import errno
import fcntl
import json
import os
import shlex
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}
"""What can go wrong while a file grows."""
LOCK = ".lock"
"""File of a folder that a process has for itself; it names that."""
PROBE_BYTES = 1 << 20
"""What is written to ask whether a disk still takes something. Writers give up within a block of
the end.
"""


class OutputError(OSError):
    """Something cannot be written; the message says what, why, and the remedy."""


def output_error(path: Path, error: OSError) -> OutputError:
    """``error``, met while ``path`` was to be written, in words."""
    there = _nearest(Path(path))
    reason = os.strerror(error.errno) if error.errno else str(error) or type(error).__name__
    if there != Path(path) and not there.is_dir():
        reason = f"{there} is a file"
    remedy = f"{'free some space, or ' if error.errno in _FULL else ''}choose another path"
    result = OutputError(f"cannot write {path}: {reason}; {remedy}")
    result.errno = error.errno
    return result


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an ``OSError`` of the block into an :class:`OutputError` that names ``path``."""
    try:
        yield
    except OSError as error:
        raise output_error(path, error) from error


def make_folder(folder: Path) -> Path:
    """``folder``, made if it is not there."""
    with writing(folder):
        Path(folder).mkdir(parents=True, exist_ok=True)
    return Path(folder)


def check_folder(folder: Path) -> None:
    """Refuse a folder that can be neither written to nor made; nothing is written."""
    there = _nearest(Path(folder))
    if not there.is_dir():
        raise output_error(folder, OSError(errno.ENOTDIR, ""))
    if not os.access(there, os.W_OK | os.X_OK, effective_ids=True):
        read_only = os.statvfs(there).f_flag & os.ST_RDONLY
        raise output_error(folder, OSError(errno.EROFS if read_only else errno.EACCES, ""))


def check_file(path: Path) -> None:
    """Refuse a file that cannot be written to, as :func:`check_folder` does.

    Say if one is there already.
    """
    if Path(path).is_dir():
        raise output_error(path, OSError(errno.EISDIR, ""))
    try:
        check_folder(Path(path).parent)
    except OutputError as error:
        raise output_error(path, error) from error
    if Path(path).exists():
        print(f"{path} is there, and will be replaced", file=sys.stderr, flush=True)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Have ``folder``, made if it is not there, for this process alone while the block lasts.

    The system frees the folders of a process that died. One that stays empty goes again.

    Raises:
        FileExistsError: Another process has it; names that.
    """
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    make_folder(folder)
    path = folder / LOCK
    with writing(path):
        file = path.open("a+")
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise FileExistsError(
                f"{folder} is in use by {file.read() or 'another process'}; wait for its end, or "
                "choose another --out"
            ) from None
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()} ({shlex.join(sys.argv)})")
        file.flush()
        try:
            yield
        finally:
            if [*folder.iterdir()] == [path]:
                path.unlink()
                with suppress(OSError):
                    for place in made:
                        place.rmdir()


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; move it over ``path`` if the block succeeds.

    The temporary name keeps the suffix, since writers such as matplotlib choose a format by it.

    Raises:
        OutputError: The folder cannot be made or written to, or its disk took no more.
    """
    path = Path(path)
    make_folder(path.parent)
    temporary = path.with_name(f".{path.stem}.{uuid4().hex}{path.suffix}")
    with writing(path):
        temporary.touch()
    try:
        try:
            yield temporary
        except Exception as error:
            # Writers in other languages lose the reason, so the disk is asked.
            reason: BaseException | None = error
            if not isinstance(error, OSError) or error.errno not in _FULL:
                reason = _refusal(temporary)
            if isinstance(reason, OSError):
                raise output_error(path, reason) from error
            raise
        with writing(path):
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as indented JSON to ``path`` atomically. NaN and infinity are refused."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def _nearest(path: Path) -> Path:
    """``path``, or the nearest of its parents that is there."""
    return next(place for place in (path, *path.parents) if os.path.lexists(place))


def _refusal(file: Path) -> OSError | None:
    """Why ``file`` cannot grow any more; ``None`` if it can."""
    try:
        with file.open("ab") as grown:
            grown.write(bytes(PROBE_BYTES))
            grown.flush()
            os.fsync(grown.fileno())
    except OSError as error:
        return error
    return None
