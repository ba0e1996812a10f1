"""The student's benchmark measures the networks it names, and says what it could not measure."""

import json

import pytest
import torch

from vd.bench.cli import StudentCommand
from vd.bench.student import open_network, take_turns


@pytest.fixture(autouse=True)
def threads():
    """One thread, quicker for so little on busy cores; put back what it was, and what a benchmark changes."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_latency_rows(tmp_path, capsys):
    out = tmp_path / "rows.json"
    networks = ("small", "dclaw3-tracking")
    StudentCommand(networks=networks, objects=("cube",), hand="dclaw3", calls=2, threads=1, json=out).run()
    for row in json.loads(out.read_text())["rows"]:
        assert 0.0 < row["median_ms"] <= row["p99_ms"] and row["parameters"] > 1000
        assert row["cpu_ms"] > 0.0 and set(row["parts_cpu_ms"]) == set(row["parts_ms"])
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["network"] == "dclaw3-tracking"


def test_turns_are_taken():
    order = []
    times = take_turns({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 3)
    assert order[:4] == ["a", "b", "a", "b"]
    assert {name: values.shape for name, values in times.items()} == {"a": (3, 2), "b": (3, 2)}


def test_refuses_an_unknown_network():
    with pytest.raises(ValueError, match="paper"):
        StudentCommand(networks=("fat",)).run()
    with pytest.raises(ValueError, match="a teacher"):
        open_network("dclaw3-table", "dclaw3")
