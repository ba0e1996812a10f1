"""Fixtures shared by all tests: devices, and the optional folder of real meshes."""

import os
import signal
from collections import Counter
from pathlib import Path

if (
    "PYTEST_XDIST_WORKER" in os.environ
):  # before anything reads it: of shared cores each gets one thread
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import warp as wp

from vd.warp_quiet import quiet_warp

quiet_warp()
# What a shell starts in the background, or nohup, is deaf to these; the tests and what they start
# are not.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


def devices() -> list[str]:
    """Every Warp device present: the CPU and each CUDA device."""
    wp.init()
    return ["cpu", *(d.alias for d in wp.get_cuda_devices())]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run every test that asks for ``device`` on each device present."""
    if "device" in metafunc.fixturenames:
        metafunc.parametrize("device", devices())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files of slow tests: one that began last would keep a single process busy."""
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder of measured data and meshes that is not part of the project (VD_SHARED, or ../shared)."""
    folder = Path(os.environ.get("VD_SHARED", Path(__file__).resolve().parents[2] / "shared"))
    if not folder.is_dir():
        pytest.skip(
            f"no shared data at {folder}; set VD_SHARED to a folder with objects/ and dclaw/"
        )
    return folder
