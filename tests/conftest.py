"""Fixtures shared by all tests: devices, and the optional folder of real meshes."""

import os
import signal
import time
from collections import Counter
from functools import wraps
from pathlib import Path
from typing import Any

# Before anything reads it: of shared cores each gets one thread.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pytest
import torch
import warp as wp

from vd.command.warp_quiet import quiet_warp
from vd.kernels.rng import init_rng_kernel

quiet_warp()
# What a shell starts in the background, or nohup, is deaf to these; the tests and what they start
# are not.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


_SHOWN: dict[str, Any] = {"started": time.monotonic()}
"""The terminal's reporter, when the tests began [s], and files that have been named."""


def devices() -> list[str]:
    """Every Warp device present: the CPU and each CUDA device."""
    wp.init()
    return ["cpu", *(d.alias for d in wp.get_cuda_devices())]


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--reseed N`` asks for other draws than those of the seeds that tests name."""
    parser.addoption("--reseed", type=int, default=0, help="shift all seeds; failures test luck")


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """Find where progress is shown; shift the seeds of all generators by ``--reseed``."""
    _SHOWN["reporter"] = config.pluginmanager.get_plugin("terminalreporter")
    shift = config.getoption("--reseed")
    if not shift:
        return
    numpy_generator, launch = np.random.default_rng, wp.launch

    @wraps(numpy_generator)
    def default_rng(seed: Any = None) -> np.random.Generator:
        named = isinstance(seed, int | np.integer | list | tuple)
        return numpy_generator([shift, *np.atleast_1d(seed)] if named else seed)

    def manual_seed(seed: int) -> torch.Generator:
        return torch.default_generator.manual_seed(seed + shift)

    @wraps(launch)
    def shifted_launch(kernel: wp.Kernel, *args: Any, **kwargs: Any) -> Any:
        if kernel is init_rng_kernel:
            kwargs["inputs"] = [kwargs["inputs"][0] + shift]
        return launch(kernel, *args, **kwargs)

    np.random.default_rng = default_rng
    torch.manual_seed = manual_seed
    wp.launch = shifted_launch


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run every test that asks for ``device`` on each device present."""
    if "device" in metafunc.fixturenames:
        metafunc.parametrize("device", devices())


def pytest_runtest_logstart(nodeid: str, location: tuple[str, int | None, str]) -> None:
    """Name each file as its first test begins: some take minutes."""
    if reporter := _SHOWN.get("reporter"):
        file = nodeid.partition("::")[0]
        if file not in _SHOWN:
            _SHOWN[file] = True
            reporter.ensure_newline()
            reporter.write_line(f"{time.monotonic() - _SHOWN['started']:4.0f} s  {file}")


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
