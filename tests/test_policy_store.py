"""Policies fetched from folders, servers and repositories, and given to others."""

import functools
import re
import shutil
import sys
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread
from unittest.mock import MagicMock

import pytest

from vd.policy import agents
from vd.policy.agents import SHIPPED_POLICIES, find_policy, pulled_folder
from vd.policy.store import main

CUBE, OTHER = (SHIPPED_POLICIES[name].read_bytes() for name in ("dclaw4-cube", "dclaw4"))


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with one policy, ``mine``; none is pulled yet."""
    monkeypatch.setenv("VD_ASSETS", str(tmp_path / "cache"))
    assert main(["push", "dclaw4-cube", "--at", str(tmp_path / "place"), "--name", "mine"]) == 0
    return tmp_path / "place"


@pytest.fixture
def served(place):
    """The folder behind a server: its URL, what was asked of it, and how it behaves."""
    asked, how = [], {"most": None}

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append((self.path, dict(self.headers)))
            data = (place / Path(self.path).name).read_bytes()
            self.send_response(200)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data[: how["most"]] if self.path.endswith(".safetensors") else data)

    server = HTTPServer(("127.0.0.1", 0), Handler)
    Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}", asked, how
    server.shutdown()


def refused(capsys, *words):
    """What a command line that cannot be says."""
    assert main(words) == 1
    return capsys.readouterr().err


def test_a_pulled_policy_has_a_name_and_nothing_takes_its_place_unasked(place, capsys):
    pull, push = (
        ["pull", "mine", "--at", str(place)],
        ["push", "dclaw4", "--at", str(place), "--name"],
    )
    assert main(pull) == 0
    (pulled_folder() / "policies.json").unlink()
    assert main(pull) == main(["list", "--at", str(place)]) == 0
    assert find_policy("mine") == pulled_folder() / "mine.safetensors"
    assert re.search(
        r"^mine +teacher +dclaw4 +0\.5 MB  installed$", capsys.readouterr().out, re.MULTILINE
    )

    assert "another policy" in refused(capsys, *push, "mine")
    assert main([*push, "mine", "--replace"]) == main([*push, "mine"]) == 0
    assert "is there already" in capsys.readouterr().out
    assert "--replace" in refused(capsys, *pull) and find_policy("mine").read_bytes() == CUBE
    assert main([*pull, "--replace"]) == 0 and find_policy("mine").read_bytes() == OTHER
    assert main([*push, "dclaw4-cube"]) == 0
    assert "which stays" in refused(capsys, "pull", "dclaw4-cube", "--at", str(place))


def test_a_download_that_broke_off_leaves_nothing_and_sizes_of_a_list_do_not_matter(
    served, place, capsys
):
    url, _, how = served
    how["most"] = 300_000
    assert "IncompleteRead(300000 bytes read" in refused(capsys, "pull", "mine", "--at", url)
    assert not pulled_folder().exists()
    how["most"], listed = None, place / "policies.json"
    listed.write_text(listed.read_text().replace(str(len(CUBE)), "5"))
    assert main(["pull", "mine", "--at", url]) == 0 and find_policy("mine").read_bytes() == CUBE
    assert f'"bytes": {len(CUBE)}' in (pulled_folder() / "policies.json").read_text()


def test_what_is_not_as_listed_or_has_no_name_is_refused(place, capsys, monkeypatch):
    said, at = functools.partial(refused, capsys), ("--at", str(place))
    shutil.copy(SHIPPED_POLICIES["dclaw4"], place / "mine.safetensors")
    assert "SHA-256 differs" in said("pull", "mine", *at) and not pulled_folder().exists()
    assert "has no policy yours; it has mine" in said("pull", "yours", *at)
    assert "--name says how" in said("push", str(place / "mine.safetensors"), *at)
    assert "no .safetensors at its end" in said(
        "push", "dclaw4", *at, "--name", "yours.safetensors"
    )
    assert "a URL can only be read" in said("push", "dclaw4", "--at", "http://127.0.0.1:1")
    listed = place / "policies.json"
    listed.write_text(listed.read_text().replace('"mine"', '"../mine"'))
    assert "'../mine' is no name of a policy" in said("pull", "../mine", *at)
    listed.unlink()
    assert "policies.json cannot be read" in said("list", *at)
    monkeypatch.setattr(agents, "SHIPPED_POLICIES", {})  # as in a wheel
    with pytest.raises(
        ValueError, match=r"dclaw3 is not on this machine: vd-policies pull dclaw3 --at"
    ):
        find_policy("dclaw3")


def test_a_repository_of_hugging_face_is_read_and_gets_policy_and_list_at_once(
    served, monkeypatch, capsys
):
    url, asked, _ = served
    monkeypatch.setattr("vd.policy.store.HUB_URL", url)
    monkeypatch.setenv("HF_TOKEN", "secret")
    assert main(["pull", "mine", "--at", "hf://me/hands"]) == 0
    path, headers = asked[-1]
    assert (
        path == "/me/hands/resolve/main/mine.safetensors"
        and headers["Authorization"] == "Bearer secret"
    )
    push = ["push", "dclaw4", "--at", "hf://me/hands"]
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    assert "pip install huggingface_hub" in refused(capsys, *push)
    hub = MagicMock(CommitOperationAdd=lambda *file: file)
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    assert main(push) == 0
    commit = hub.HfApi().create_commit.call_args.kwargs
    (file, path), (listed, text) = commit["operations"]
    assert (commit["repo_id"], file, listed) == ("me/hands", "dclaw4.safetensors", "policies.json")
    assert Path(path) == SHIPPED_POLICIES["dclaw4"] and b'"mine"' in text and b'"dclaw4"' in text
