"""Kernels compiled for a GPU while they are launched on the CPU."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from vd.train.cli import main
from vd.train.precompile import compiling

ARCH = 90

wp.init()  # without it Warp knows no GPU
pytestmark = pytest.mark.skipif(
    ARCH not in wp.get_cuda_supported_archs(), reason="this build of Warp compiles for no GPU"
)


@wp.kernel(module="unique", enable_backward=False)
def double_kernel(values: wp.array[float]):
    i = wp.tid()
    values[i] = 2.0 * values[i]


def doubled(block_dim: int | None = None) -> np.ndarray:
    values = wp.array([1.0, 2.0], dtype=float, device="cpu")
    wp.launch(double_kernel, dim=2, outputs=[values], device="cpu", block_dim=block_dim)
    return values.numpy()


def test_what_is_launched_on_the_cpu_is_compiled_for_the_gpu(tmp_path: Path):
    plain = wp.launch
    with compiling(tmp_path, ARCH) as names:
        np.testing.assert_array_equal(doubled(), [2.0, 4.0])
        np.testing.assert_array_equal(doubled(), [2.0, 4.0])
        doubled(block_dim=64)
    assert wp.launch is plain
    assert len(names) == 2 and names[0].endswith("256 threads") and names[1].endswith("64 threads")
    binaries = sorted(tmp_path.rglob(f"*.sm{ARCH}.cubin"))
    assert len(binaries) == 2 and all(file.read_bytes()[:4] == b"\x7fELF" for file in binaries)
    # As Warp looks them up: a folder for each module, named by the hash of what was compiled.
    module = double_kernel.module
    assert {file.parent.name for file in binaries} == {module.get_module_identifier(n) for n in (64, 256)}
    looked_in = subprocess.run(
        [sys.executable, "-c", "import warp as wp; wp.init(); print('in', wp.config.kernel_cache_dir)"],
        env=os.environ | {"WARP_CACHE_PATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split("in ")[-1]
    assert {file.parent.parent for file in binaries} == {Path(looked_in.strip())}
    assert module.options["block_dim"] == 256
    # What is there is not compiled again.
    before = [file.stat().st_mtime_ns for file in binaries]
    with compiling(tmp_path, ARCH):
        doubled()
    assert [file.stat().st_mtime_ns for file in binaries] == before


def test_ptx_is_text(tmp_path: Path):
    with compiling(tmp_path, ARCH, ptx=True):
        doubled()
    (file,) = tmp_path.rglob(f"*.sm{ARCH}.ptx")
    assert f".target sm_{ARCH}" in file.read_text(errors="replace")


def test_launching_is_plain_again_after_a_failure(tmp_path: Path):
    plain = wp.launch, wp.launch_tiled
    with pytest.raises(RuntimeError, match="on purpose"), compiling(tmp_path, ARCH):
        raise RuntimeError("on purpose")
    assert (wp.launch, wp.launch_tiled) == plain


def test_a_training_is_taken_through_all_that_it_launches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    asked: list[str] = []

    def note(module: wp.Module, *, arch: int, module_dir: Path, use_ptx: bool) -> None:
        assert arch == ARCH and not use_ptx and module_dir.parent.parent == Path("kernels")
        asked.append(module.name)

    monkeypatch.setattr(wp, "compile_aot_module", note)  # NVRTC would take minutes
    monkeypatch.chdir(tmp_path)
    flags = ["--preset", "gpu", "--hand", "dclaw3", "--objects", "cube"]
    assert main(["precompile", "kernels", *flags]) == 0
    for part in (
        "vd.kernels.task.actions",
        "vd.kernels.task.observations",
        "vd.kernels.task.rewards",
        "vd.kernels.task.resets",
        "vd.kernels.task.symmetry",
        "vd.kernels.pair_order",
        "ccd_kernel",
        "linesearch",
        "cholesky",
    ):
        assert any(part in name for name in asked), part
    assert f"modules for sm_{ARCH}" in capsys.readouterr().out
    assert not (tmp_path / "runs").exists()


def test_an_unknown_gpu_is_refused(capsys: pytest.CaptureFixture[str]):
    assert main(["precompile", "kernels", "--arch", "12", "--preset", "gpu"]) == 1
    error = capsys.readouterr().err
    assert "--arch is 12" in error and str(ARCH) in error
