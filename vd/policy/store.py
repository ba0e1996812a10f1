"""``vd-policies``: policies in folders, at URLs and in Hugging Face repositories, with their SHA-256.

Such a place holds ``NAME.safetensors`` for each policy, and ``policies.json``, which tells of them all.
"""

import dataclasses
import hashlib
import json
import os
import re
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from http.client import HTTPException
from pathlib import Path
from typing import Annotated
from urllib.request import Request, urlopen

import tyro

from vd.command import interrupt
from vd.command.config import from_dict, to_dict
from vd.command.files import atomic_path, write_json
from vd.command.line import parse
from vd.policy import SUFFIX, has_suffix
from vd.policy.agents import (
    BUILT_IN,
    POLICY_FOLDER,
    POLICY_LIST,
    SHIPPED_POLICIES,
    find_policy,
    installed_policies,
    policy_name,
    pulled_folder,
)

STORE_FORMAT = "visual-dexterity policies 1"
HUB, HUB_URL = "hf://", "https://huggingface.co"
TIMEOUT_S = 60.0
"""Longest silence of a server."""
_DIGEST = re.compile(r"[0-9a-f]{64}")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
PLACE = "a folder, a URL, or hf://OWNER/NAME of Hugging Face"


@dataclass(frozen=True)
class Entry:
    """What is told of a policy."""

    sha256: str
    bytes: int
    kind: str
    """teacher, tracking or vision."""
    hand: str


@dataclass(frozen=True)
class Store:
    """The whole of ``policies.json``."""

    policies: dict[str, Entry] = field(default_factory=dict)
    format: str = STORE_FORMAT


def read_store(place: str | Path) -> Store:
    """What there is at a place.

    Raises:
        FileNotFoundError: There is no list.
        OSError: The place does not answer.
        ValueError: Its list is none.
    """
    try:
        values = json.loads(_read(str(place), POLICY_LIST))
        if not isinstance(values, dict):
            raise ValueError("it is no list of policies; vd-policies push makes one")
        store = from_dict(Store, values)
        if store.format != STORE_FORMAT:
            raise ValueError(f"format is {store.format!r}, this version reads {STORE_FORMAT!r}")
        for name, entry in store.policies.items():
            check_name(name)
            if not _DIGEST.fullmatch(entry.sha256):
                raise ValueError(f"sha256 of {name} is {entry.sha256!r}, not 64 digits of 0 to f")
    except (ValueError, TypeError) as error:
        raise ValueError(f"{place}/{POLICY_LIST}: {error}") from error
    return store


def installed_entries() -> dict[str, Entry]:
    """What is told of the policies that are installed, by name.

    Raises:
        ValueError: A list is damaged.
    """
    told: dict[str, Entry] = {}
    for folder in (POLICY_FOLDER, pulled_folder()):
        if (folder / POLICY_LIST).exists():
            told = read_store(folder).policies | told
    return {name: told[name] for name in sorted(told.keys() & installed_policies().keys())}


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


def pull(name: str, place: str, *, replace: bool = False) -> Path:
    """Fetch a policy.

    Raises:
        FileExistsError: There is another policy of this name, and ``replace`` is not set.
        OSError: The place does not answer, or the file cannot be written.
        ValueError: There is no such policy, or it is not the one that the list tells of.
    """
    found = read_store(place).policies
    if name not in found:
        raise ValueError(f"{place} has no policy {name}; it has {', '.join(found) or 'none'}")
    entry, target = found[name], pulled_folder() / f"{name}{SUFFIX}"
    here = SHIPPED_POLICIES.get(name, target)
    if here.exists() and _digest(here) == entry.sha256:
        if here == target:  # its list may be lost
            _tell(target.parent, name, dataclasses.replace(entry, bytes=target.stat().st_size))
        return here
    if here.exists() and (name in SHIPPED_POLICIES or not replace):
        remedy = "which stays" if name in SHIPPED_POLICIES else "--replace takes the one there"
        raise FileExistsError(f"{here} is another policy than {name} at {place}; {remedy}")
    data = _read(place, f"{name}{SUFFIX}")
    if hashlib.sha256(data).hexdigest() != entry.sha256:
        raise ValueError(
            f"{place}/{name}{SUFFIX} is not the file that {POLICY_LIST} there tells of (SHA-256 differs)"
        )
    with atomic_path(target) as temporary:
        temporary.write_bytes(data)
    _tell(target.parent, name, dataclasses.replace(entry, bytes=len(data)))
    return target


def push(path: Path, name: str, place: str, entry: Entry, *, replace: bool = False) -> bool:
    """Put a policy into a folder or repository; false if it is there already.

    Raises:
        FileExistsError: There is another policy of this name, and ``replace`` is not set.
        OSError: The place does not answer, or cannot be written to.
        ValueError: Nothing can be pushed there.
    """
    check_name(name)
    if "://" in place and not place.startswith(HUB):
        raise ValueError(
            f"--at {place}: a URL can only be read; push to the folder it serves, or to hf://"
        )
    try:
        there = read_store(place)
    except FileNotFoundError:
        there = Store()
    before = there.policies.get(name, entry)
    if before.sha256 != entry.sha256 and not replace:
        raise FileExistsError(
            f"{name} at {place} is another policy; give another --name, or --replace"
        )
    if name in there.policies and before == entry:
        return False
    if place.startswith(HUB):
        _commit(place.removeprefix(HUB), path, name, Store(there.policies | {name: entry}))
        return True
    target = Path(place) / f"{name}{SUFFIX}"
    if not (target.exists() and _digest(target) == entry.sha256):
        with atomic_path(target) as temporary:
            shutil.copyfile(path, temporary)
    _tell(Path(place), name, entry)
    return True


def describe(path: Path) -> Entry:
    """What is to be told of a policy that can be read.

    Raises:
        ValueError: It is no policy's file, or names a folder of this machine.
    """
    from vd.policy.bundle import read_policy
    from vd.policy.contract import without_folders

    remedy = f"vd-train export {path} FILE{SUFFIX} writes one without that, for others"
    if not has_suffix(path, SUFFIX):
        raise ValueError(f"{path} has the state of a training; {remedy}")
    policy = read_policy(path)
    if without_folders(policy.contract) != policy.contract:
        raise ValueError(f"{path} names folders of this machine; {remedy}")
    return Entry(_digest(path), path.stat().st_size, policy.kind, policy.hand)


def _tell(folder: Path, name: str, entry: Entry) -> None:
    """Note a policy in the list of a folder."""
    try:
        store = read_store(folder)
    except FileNotFoundError:
        store = Store()
    write_json(
        folder / POLICY_LIST, to_dict(Store(dict(sorted((store.policies | {name: entry}).items()))))
    )


def _commit(repository: str, path: Path, name: str, store: Store) -> None:
    """Put a policy and the new list into a repository at once."""
    try:
        from huggingface_hub import CommitOperationAdd, HfApi
    except ImportError as error:
        raise ValueError(
            "pushing to Hugging Face needs huggingface_hub: pip install huggingface_hub, then hf "
            "auth login"
        ) from error
    text = json.dumps(to_dict(store), indent=1) + "\n"
    HfApi().create_commit(
        repo_id=repository,
        operations=[
            CommitOperationAdd(f"{name}{SUFFIX}", str(path)),
            CommitOperationAdd(POLICY_LIST, text.encode()),
        ],
        commit_message=f"Add {name}",
    )


def _read(place: str, file: str) -> bytes:
    """A file of a place."""
    try:
        if "://" not in place:
            return (Path(place) / file).read_bytes()
        hub, token = place.startswith(HUB), os.environ.get("HF_TOKEN")
        url = f"{HUB_URL}/{place.removeprefix(HUB)}/resolve/main" if hub else place.rstrip("/")
        request = Request(f"{url}/{file}")
        if hub and token:  # of private repositories; not for who they redirect to
            request.add_unredirected_header("Authorization", f"Bearer {token}")
        with urlopen(request, timeout=TIMEOUT_S) as stream:
            data: bytes = stream.read()
            return data
    except (OSError, HTTPException) as error:
        missing = isinstance(error, FileNotFoundError) or getattr(error, "code", None) == 404
        kind = FileNotFoundError if missing else ConnectionError
        raise kind(f"{place}/{file} cannot be read ({error}); --at names {PLACE}") from error


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclass(frozen=True)
class List:
    """Show the policies that commands know by name, and with --at those of a place."""

    at: str | None = None
    """A folder, a URL, or hf://OWNER/NAME of Hugging Face."""

    def run(self) -> int:
        """Print a line for each."""
        there = {} if self.at is None else read_store(self.at).policies
        for name, entry in installed_entries().items():
            same = there.pop(name, entry).sha256 == entry.sha256
            _show(name, entry, "installed" if same else f"installed; another one at {self.at}")
        for name, entry in there.items():
            _show(name, entry, f"vd-policies pull {name} --at {self.at}")
        return 0


@dataclass(frozen=True)
class Pull:
    """Fetch policies; commands then know them by name."""

    names: tyro.conf.Positional[tuple[str, ...]]
    """Policies, as vd-policies list --at names them."""
    at: str
    """A folder, a URL, or hf://OWNER/NAME of Hugging Face (of a private one with HF_TOKEN)."""
    replace: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Let one that was pulled before go."""

    def run(self) -> int:
        """Fetch each and print where it is."""
        if not self.names:
            raise ValueError(f"name what to pull: {', '.join(read_store(self.at).policies)}")
        for name in self.names:
            print(f"{name}: {pull(name, self.at, replace=self.replace)}", flush=True)
        return 0


@dataclass(frozen=True)
class Push:
    """Give a policy to others: its file, and its SHA-256 in policies.json beside it."""

    policy: Annotated[str, tyro.conf.Positional]
    """A policy.safetensors, a run's folder, or the name of an installed policy."""
    at: str
    """Folder, made if it is not there, or hf://OWNER/NAME, a repository of Hugging Face that is
    there.
    """
    name: str | None = None
    """Name under which others find it; that of an installed policy by default."""
    replace: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Take the place of another policy of this name."""

    def run(self) -> int:
        """Check that it is a policy, then write."""
        path = find_policy(self.policy)
        name = self.name or policy_name(path)
        if self.name is None and name not in installed_policies():
            raise ValueError(f"--name says how others call {path}; give one")
        done = push(path, name, self.at, describe(path), replace=self.replace)
        print(f"{self.at}: {name} {'is written' if done else 'is there already'}")
        return 0


Command = (
    Annotated[List, tyro.conf.subcommand("list")]
    | Annotated[Pull, tyro.conf.subcommand("pull")]
    | Annotated[Push, tyro.conf.subcommand("push")]
)


def _show(name: str, entry: Entry, where: str) -> None:
    print(f"{name:<24} {entry.kind:<9} {entry.hand:<10} {entry.bytes / 1e6:5.1f} MB  {where}")


@interrupt.command("vd-policies")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``vd-policies``; returns the exit status."""
    command: List | Pull | Push = parse(Command, arguments, prog="vd-policies", description=__doc__)
    return command.run()


if __name__ == "__main__":
    sys.exit(main())
