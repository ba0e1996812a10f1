"""Policies fetched from folders and repositories, and given to others."""

import functools
import re
import shutil
import sys
from types import SimpleNamespace

import pytest

from vd.policy.agents import SHIPPED_POLICIES, default_policy, find_policy, pulled_folder
from vd.policy.contract import UNSEALED, sealed
from vd.policy.store import main

CUBE, OTHER = (SHIPPED_POLICIES[name].read_bytes() for name in ("dclaw4-cube", "dclaw4"))


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with one policy, ``mine``; none is pulled yet."""
    monkeypatch.setenv("VD_ASSETS", str(tmp_path / "cache"))
    assert main(["push", "dclaw4-cube", "--at", str(tmp_path / "place"), "--name", "mine"]) == 0
    return tmp_path / "place"


def refused(capsys, *words):
    """What a command line that cannot be says."""
    assert main(words) == 1
    return capsys.readouterr().err


def test_a_pulled_policy_has_a_name_and_nothing_takes_its_place_unasked(place, capsys):
    pull = ["pull", "mine", "--at", str(place)]
    push = ["push", "dclaw4", "--at", str(place), "--name"]
    assert main(pull) == main(pull) == main(["list", "--at", str(place)]) == 0
    assert find_policy("mine") == pulled_folder() / "mine.safetensors"
    listed = capsys.readouterr().out
    assert re.search(r"^mine +teacher +dclaw4 +0\.5 MB  cube$", listed, re.MULTILINE)
    assert re.search(r"^leap-cube .* cube, 5 sizes from the hand's smallest ", listed, re.MULTILINE)

    assert "another policy" in refused(capsys, *push, "mine")
    assert main([*push, "mine", "--replace"]) == main([*push, "mine"]) == 0
    assert "is there already" in capsys.readouterr().out
    assert "--replace" in refused(capsys, *pull) and find_policy("mine").read_bytes() == CUBE
    assert main([*pull, "--replace"]) == 0 and find_policy("mine").read_bytes() == OTHER
    assert main(["push", "dclaw4", "--at", str(place), "--name", "dclaw4-cube"]) == 0
    assert "stays" in refused(capsys, "pull", "dclaw4-cube", "--at", str(place))


def test_what_is_damaged_or_has_no_name_is_refused(place, tmp_path, capsys):
    said = functools.partial(refused, capsys)
    at = ("--at", str(place))
    (place / "mine.safetensors").write_bytes(CUBE[:300_000])
    assert "is damaged" in said("pull", "mine", *at) and not pulled_folder().exists()
    assert "yours; it has mine" in said("pull", "yours", *at)
    assert "policy ../mine" in said("pull", "../mine", *at)
    assert "--name says how" in said("push", str(place / "mine.safetensors"), *at)
    assert "at its end" in said("push", "dclaw4", *at, "--name", "yours.safetensors")
    assert "no such folder" in said("list", "--at", str(tmp_path / "nowhere"))
    with pytest.raises(FileNotFoundError, match="vd-policies pull NAME --at PLACE"):
        find_policy("nobody")


def test_a_policy_of_another_version_is_not_pulled_and_hinders_no_other(place, capsys):
    changed = CUBE.replace(b"visual-dexterity policy 1", b"visual-dexterity policy 9")
    (place / "mine.safetensors").write_bytes(sealed(changed[: -len(UNSEALED)] + UNSEALED))
    pull = ("pull", "mine", "--at", str(place))
    assert "take the version" in refused(capsys, *pull) and not pulled_folder().exists()
    shutil.copytree(place, pulled_folder())
    assert main(["list"]) == 0
    assert re.search(r"^mine +cannot be used: .*this version reads", capsys.readouterr().out, re.M)
    assert default_policy("dclaw4", "teacher") == "dclaw4"


def test_a_repository_of_hugging_face_is_read_and_written_by_its_own_library(
    place, monkeypatch, capsys
):
    push = ["push", "dclaw4", "--at", "hf://me/hands"]
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    assert "pip install huggingface_hub" in refused(capsys, *push)
    files = {"mine.safetensors": place / "mine.safetensors"}

    def upload_file(*, path_or_fileobj, path_in_repo, repo_id, commit_message):
        assert repo_id == "me/hands"
        files[path_in_repo] = shutil.copy(path_or_fileobj, place)

    library = SimpleNamespace(
        list_repo_files=lambda repository: [*files, "README.md", "old/mine.safetensors"],
        hf_hub_download=lambda repository, file: str(files[file]),
        upload_file=upload_file,
    )
    monkeypatch.setitem(sys.modules, "huggingface_hub", library)
    assert main(["pull", "mine", "--at", "hf://me/hands"]) == 0
    assert find_policy("mine").read_bytes() == CUBE
    assert main(push) == 0 and files["dclaw4.safetensors"] == str(place / "dclaw4.safetensors")
    assert "another policy" in refused(capsys, "push", "mine", "--name", "dclaw4", *push[2:])
    assert main(["list", "--at", "hf://me/hands"]) == 0
