"""CUDA kernels of a training, compiled where there is no GPU to wait for them.

A training launches some 85 modules of kernels, which NVRTC compiles one after the other at the first start:
about three minutes for which the GPU stands idle. Warp brings NVRTC along, and it needs no GPU. So a few
steps of the training are taken on the CPU, and each module is compiled for the GPU too when it is first
launched. What follows the number of environments, or is launched on a GPU alone, is not met: two small
modules.
"""

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from vd.train.progress import waiting

if TYPE_CHECKING:
    from vd.train.presets import TeacherCfg
    from vd.train.runner import TeacherRunner

DEFAULT_BLOCK = 256
"""Threads of a block where a launch on a GPU asks for no number of its own: Warp's."""
STEPS = 2
"""Control steps to take: the first resets environments, the second goes on (ours)."""


@dataclass
class PrecompileCfg:
    """Compile the CUDA kernels of a training, on a machine with or without a GPU.

    All other flags are those of the training, vd-train teacher, with its own objects: kernels depend on
    them. On the machine that trains, with the same versions of Warp, Newton and this package, name the
    folder: WARP_CACHE_PATH=FOLDER vd-train teacher ... Kernels of one version of Warp lie in a folder of
    its name.
    """

    output: Annotated[Path, tyro.conf.Positional]
    """Folder for the kernels, a cache of Warp's; what it holds already is kept."""
    arch: int = 90
    """Compute capability of the GPU, without its point: 90 for H100 and H200, 80 for A100, 89 for RTX 40."""
    ptx: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Write PTX in place of binaries: what Warp looks for where the driver's CUDA version (nvidia-smi) is
    that of Warp's own toolkit, or later."""


@contextmanager
def compiling(folder: Path, arch: int, *, ptx: bool = False) -> Iterator[list[str]]:
    """Compile what is launched in the block, on whichever device, for a GPU too.

    Args:
        folder: A cache of Warp's (``WARP_CACHE_PATH``); modules that it holds are not compiled anew.
        arch: Compute capability, 90 for 9.0.
        ptx: Whether to write PTX rather than binaries.

    Yields:
        Names of the modules that have been compiled or found, each with its number of threads a block.
    """
    import warp as wp

    done: set[tuple[str, int, bytes]] = set()
    names: list[str] = []

    def compile_for(kernel: Any, block_dim: int | None) -> None:
        module, block = kernel.module, int(block_dim or 0)
        block = block if block > 0 else DEFAULT_BLOCK
        key = (module.name, block, module.get_module_hash(block))
        if key in done:
            return
        done.add(key)
        before = module.options["block_dim"]
        module.options["block_dim"] = block  # what is compiled, and its hash, depend on it
        try:
            place = folder / wp.config.version / module.get_module_identifier(block)
            wp.compile_aot_module(module, arch=arch, module_dir=place, use_ptx=ptx)
        finally:
            module.options["block_dim"] = before
        names.append(f"{module.name}, {block} threads")

    def watched(launch: Callable[..., Any]) -> Callable[..., Any]:
        def launch_and_compile(*args: Any, **kwargs: Any) -> Any:
            result = launch(*args, **kwargs)  # first: it gives a generic kernel its overload
            compile_for(args[0] if args else kwargs["kernel"], kwargs.get("block_dim"))
            return result

        return launch_and_compile

    plain = {name: getattr(wp, name) for name in ("launch", "launch_tiled")}
    for name, launch in plain.items():
        setattr(wp, name, watched(launch))
    try:
        yield names
    finally:
        for name, launch in plain.items():
            setattr(wp, name, launch)


def precompile(
    cfg: PrecompileCfg, teacher: "TeacherCfg", build_teacher: Callable[["TeacherCfg"], "TeacherRunner"]
) -> list[str]:
    """Compile the kernels that a training launches, by taking a few of its steps on the CPU.

    Args:
        cfg: Where to, and for which GPU.
        teacher: The training, which is not begun; its run's folder is not touched.
        build_teacher: Builds it.

    Returns:
        The modules, as :func:`compiling` names them.

    Raises:
        ValueError: Warp's NVRTC does not know this GPU.
    """
    import torch
    import warp as wp

    from vd.assets_usd.objects.sets import load_set
    from vd.sim.pair_order import sort_pairs

    wp.init()
    known = wp.get_cuda_supported_archs()
    if cfg.arch not in known:
        raise ValueError(
            f"--arch is {cfg.arch}; Warp here compiles for {', '.join(map(str, known)) or 'none'}"
        )
    envs = len(load_set(teacher.env.objects))  # one of each: kinds of shapes decide which kernels there are
    with tempfile.TemporaryDirectory() as folder, compiling(cfg.output, cfg.arch, ptx=cfg.ptx) as names:
        small = replace(
            teacher,
            resume=None,
            init=None,  # networks have no kernels of Warp's
            init_stage=None,
            run=replace(teacher.run, out=Path(folder), device="cpu", tensorboard=False),
            ppo=replace(teacher.ppo, minibatch_size=envs * teacher.ppo.rollout_steps, cuda_graph=False),
            env=replace(teacher.env, num_envs=envs),
        )
        runner = build_teacher(small)
        simulation = runner.env.env.sim
        sort_pairs(simulation.solver.mjw_model, simulation.solver.mjw_data)  # as on a GPU
        for _ in range(STEPS):
            runner.env.step(torch.zeros(envs, runner.env.num_actions))
        runner.env.end_iteration()
        runner.env.close()
    return names


def precompile_command(
    arguments: list[str],
    parse_teacher: Callable[[list[str]], "TeacherCfg"],
    build_teacher: Callable[["TeacherCfg"], "TeacherRunner"],
) -> int:
    """``vd-train precompile``."""
    cfg, rest = tyro.cli(PrecompileCfg, args=arguments, prog="vd-train precompile", return_unknown_args=True)
    teacher = parse_teacher(rest)
    started = time.monotonic()
    with waiting("compiling (some minutes of a core, less where the folder holds kernels)"):
        names = precompile(cfg, teacher, build_teacher)
    size = sum(file.stat().st_size for file in cfg.output.rglob("*") if file.is_file()) / 2**20
    spent = time.monotonic() - started
    print(f"{cfg.output}: {len(names)} modules for sm_{cfg.arch}, {size:.0f} MiB, {spent:.0f} s")
    print(f"train with them: WARP_CACHE_PATH={cfg.output} vd-train teacher ...")
    return 0
