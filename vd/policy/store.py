"""``vd-policies``: policies in folders and in Hugging Face repositories, by name.

Such a place holds ``NAME.safetensors`` for each policy. Every file ends with the SHA-256 of its
content, so a damaged one is refused.
"""

import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from vd.command import interrupt
from vd.command.files import atomic_path
from vd.command.line import parse
from vd.policy import SUFFIX, has_suffix
from vd.policy.agents import (
    SHIPPED_POLICIES,
    check_name,
    find_policy,
    installed_policies,
    policy_name,
    pulled_folder,
)
from vd.policy.contract import ContractError, installed_contract, read_sealed, without_folders

HUB = "hf://"
"""How the name of a repository of Hugging Face begins."""


def hub() -> Any:
    """The library of Hugging Face, which knows its logins, caches and interrupted downloads.

    Raises:
        ValueError: It is not installed.
    """
    try:
        import huggingface_hub
    except ImportError as error:
        raise ValueError(
            f"{HUB} needs huggingface_hub: pip install huggingface_hub, then hf auth login"
        ) from error
    return huggingface_hub


def names_at(place: str) -> list[str]:
    """Names of the policies at a place.

    Raises:
        FileNotFoundError: There is no such folder.
        OSError: Hugging Face does not answer.
    """
    if place.startswith(HUB):
        files = hub().list_repo_files(place.removeprefix(HUB))
    elif Path(place).is_dir():
        files = [path.name for path in Path(place).iterdir()]
    else:
        raise FileNotFoundError(
            f"--at {place}: there is no such folder; give one, or {HUB}OWNER/NAME"
        )
    return sorted(Path(file).stem for file in files if has_suffix(file, SUFFIX) and "/" not in file)


def fetch(name: str, place: str) -> Path:
    """A policy's file at a place, of Hugging Face a copy of it."""
    file = f"{name}{SUFFIX}"
    if place.startswith(HUB):
        return Path(hub().hf_hub_download(place.removeprefix(HUB), file))
    return Path(place) / file


def pull(name: str, place: str, *, replace: bool = False) -> Path:
    """Fetch a policy.

    Raises:
        FileExistsError: There is another policy of this name, and ``replace`` is not set.
        OSError: The place does not answer, or the file cannot be written.
        ValueError: There is no such policy, it is damaged, or of another version.
    """
    available = names_at(place)
    if name not in available:
        raise ValueError(f"{place} has no policy {name}; it has {', '.join(available) or 'none'}")
    check_name(name)
    file = fetch(name, place)
    content = read_sealed(file)
    installed_contract(file)
    target = pulled_folder() / f"{name}{SUFFIX}"
    present = SHIPPED_POLICIES.get(name, target)
    if present.exists():
        if present.read_bytes() == content:
            return present
        if name in SHIPPED_POLICIES:
            raise FileExistsError(f"{present} is another policy than {name} at {place}, and stays")
        if not replace:
            raise FileExistsError(
                f"{present} is another policy than {name} at {place}; --replace takes the one there"
            )
    with atomic_path(target) as temporary:
        temporary.write_bytes(content)
    return target


def push(path: Path, name: str, place: str, *, replace: bool = False) -> bool:
    """Put a policy into a folder or repository; false if it is there already.

    Raises:
        FileExistsError: There is another policy of this name, and ``replace`` is not set.
        OSError: The place does not answer, or cannot be written to.
        ValueError: It is not for others, or has no name.
    """
    check_name(name)
    check_for_others(path)
    to_hub = place.startswith(HUB)
    if (to_hub or Path(place).is_dir()) and name in names_at(place):
        if fetch(name, place).read_bytes() == path.read_bytes():
            return False
        if not replace:
            raise FileExistsError(
                f"{name} at {place} is another policy; give another --name, or --replace"
            )
    if to_hub:
        hub().upload_file(
            path_or_fileobj=path,
            path_in_repo=f"{name}{SUFFIX}",
            repo_id=place.removeprefix(HUB),
            commit_message=f"Add {name}",
        )
        return True
    with atomic_path(Path(place) / f"{name}{SUFFIX}") as temporary:
        shutil.copyfile(path, temporary)
    return True


def check_for_others(path: Path) -> None:
    """Refuse what is no policy's file, or names a folder of this machine.

    Raises:
        ValueError: It is, with the remedy.
    """
    remedy = f"vd-train export {path} FILE{SUFFIX} writes one without that, for others"
    if not has_suffix(path, SUFFIX):
        raise ValueError(f"{path} has the state of a training; {remedy}")
    read_sealed(path)
    contract = installed_contract(path)
    if without_folders(contract) != contract:
        raise ValueError(f"{path} names folders of this machine; {remedy}")


@dataclass(frozen=True)
class List:
    """Show the policies that commands know by name, and the objects that each was trained with.

    With --at also those of a place.
    """

    at: str | None = None
    """A folder, or hf://OWNER/NAME of Hugging Face."""

    def run(self) -> int:
        """Print a line for each."""
        installed = installed_policies()
        for name, path in installed.items():
            try:
                contract = installed_contract(path)
            except ContractError as error:
                print(f"{name:<24} cannot be used: {error}")
                continue
            size = f"{path.stat().st_size / 1e6:5.1f} MB"
            objects = ", ".join(contract.task["objects"]) + _sizes(contract.task["randomisation"])
            print(f"{name:<24} {contract.kind:<9} {contract.task['hand']:<10} {size}  {objects}")
        if self.at is None:
            return 0
        for name in names_at(self.at):
            if name not in installed:
                print(f"{name:<24} vd-policies pull {name} --at {self.at}")
        return 0


def _sizes(drawn: Mapping[str, Any]) -> str:
    """In what other sizes than their own objects were drawn."""
    if not drawn["enabled"]:
        return ""
    if count := drawn.get("object_sizes"):
        return f", {count} sizes from the hand's smallest to its largest"
    low, high = drawn["object_scale"]
    return "" if low == high == 1.0 else f", {low:g} to {high:g} times their size"


@dataclass(frozen=True)
class Pull:
    """Fetch policies; commands then know them by name."""

    names: tyro.conf.Positional[tuple[str, ...]]
    """Policies, as vd-policies list --at names them."""
    at: str
    """A folder, or hf://OWNER/NAME of Hugging Face."""
    replace: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Let one that was pulled before go."""

    def run(self) -> int:
        """Fetch each and print where it is."""
        if not self.names:
            raise ValueError(f"name what to pull: {', '.join(names_at(self.at))}")
        for name in self.names:
            print(f"{name}: {pull(name, self.at, replace=self.replace)}", flush=True)
        return 0


@dataclass(frozen=True)
class Push:
    """Give a policy to others."""

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
        written = push(path, name, self.at, replace=self.replace)
        print(f"{self.at}: {name} {'is written' if written else 'is there already'}")
        return 0


Command = (
    Annotated[List, tyro.conf.subcommand("list")]
    | Annotated[Pull, tyro.conf.subcommand("pull")]
    | Annotated[Push, tyro.conf.subcommand("push")]
)


@interrupt.command("vd-policies")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``vd-policies``; returns the exit status."""
    command: List | Pull | Push = parse(Command, arguments, prog="vd-policies", description=__doc__)
    return command.run()


if __name__ == "__main__":
    sys.exit(main())
