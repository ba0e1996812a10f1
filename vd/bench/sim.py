"""``vd-bench sim``: control steps per second, memory and start-up, all measured in one run.

Every row says what it includes. Physics only replays the solver's steps of a control step; the
whole step adds actions, observations, rewards, resets and randomisation; with a policy adds its
network. States come from that policy's own actions in contact: those of a stand-in for an untrained one,
with its noise, or the mean actions of a trained teacher, whose fingers touch more and for longer.
"""

import dataclasses
import gc
import importlib
import pkgutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from vd.envs.cfg import ReorientCfg, RewardCfg
from vd.envs.curriculum import Stage
from vd.envs.reorient import ReorientEnv

if TYPE_CHECKING:
    from vd.policy import TrainedPolicy

WARM_UP_STEPS = 36
"""Control steps before timing: objects have landed and fingers reached them (3 s)."""


@dataclass(frozen=True)
class KernelRow:
    """What one kernel takes of a control step."""

    kernel: str
    """Its name, as Warp reports it."""
    launches: int
    """Launches in the step."""
    seconds: float
    """Device time of all of them [s]."""
    share: float
    """Of the device time of all kernels, in [0, 1]."""


@dataclass(frozen=True)
class SimRow:
    """One measured configuration."""

    scene: str
    """What was simulated."""
    envs: int
    """Environments side by side."""
    physics_only: float
    """Control steps/s of the physics alone, over all environments."""
    whole_step: float
    """Control steps/s of the environment's step."""
    with_policy: float
    """Control steps/s with a policy network and, of the stand-in for an untrained one, its noise."""
    own_kernels: float
    """Share of our kernels in the device time of a control step, in [0, 1]; 0 on the CPU, not measured."""
    memory_gb: float
    """Device memory of simulation and environment [GB]; 0 on the CPU."""
    start_s: float
    """From an empty process state to the first finished step, kernels included [s]."""
    contacts_mean: float
    """Contacts per world, mean over environments at the end."""
    rows_max: int
    """Most constraint rows in any world at the end."""
    kernels: tuple[KernelRow, ...]
    """Every kernel of a control step, the longest first; none on the CPU, not measured."""


def seconds_per_call(
    function: Any, calls: int, device: str, *, before: Callable[[], object] = lambda: None
) -> float:
    """Mean wall time of ``calls`` calls [s], device work included; ``before`` each of them is not timed."""
    elapsed = 0.0
    for _ in range(calls):
        before()
        wp.synchronize_device(device)
        start = time.perf_counter()
        function()
        wp.synchronize_device(device)
        elapsed += time.perf_counter() - start
    return elapsed / calls


def captured(function: Any, device: str) -> Any:
    """``function`` as the launch of one graph."""
    with wp.ScopedCapture(device=device) as capture:
        function()
    return lambda: wp.capture_launch(capture.graph)


def reaching_policy(env: ReorientEnv, seed: int) -> Any:
    """A stand-in for an untrained teacher: its network with random weights, noisy, biased to close the hand.

    The bias bends every finger inward for half of each second, so that fingers push the object around.
    """
    import torch

    generator = torch.Generator().manual_seed(seed)
    sizes = [env.num_observations, 512, 256, 256, env.num_actions]
    layers: list[Any] = []
    for inputs, outputs in pairwise(sizes):
        layers += [torch.nn.Linear(inputs, outputs), torch.nn.ELU()]
    network = torch.nn.Sequential(*layers[:-1])
    for parameter in network.parameters():
        parameter.data = 0.1 * torch.randn(parameter.shape, generator=generator)
    network.to(torch.device(str(env.device)))
    observation, action = wp.to_torch(env.observation), wp.to_torch(env.action)
    inward = torch.tensor([0.0, -1.0, -0.6] * env.num_fingers, device=action.device)
    period = round(env.cfg.sim.control_hz)
    count = 0

    def act() -> None:
        nonlocal count
        closing = 1.0 if (count // (period // 2)) % 2 == 0 else -0.5
        with torch.no_grad():
            noise = 0.6 * torch.randn_like(action)
            action.copy_((torch.tanh(network(observation)) * 0.3 + closing * inward + noise).clamp(-1.0, 1.0))
        count += 1

    return act


def teacher_policy(env: ReorientEnv, policy: "TrainedPolicy") -> Callable[[], None]:
    """A teacher's mean actions, as a call that writes them where the next step reads them."""
    observation, action = wp.to_torch(env.observation), wp.to_torch(env.action)

    def act() -> None:
        action.copy_(policy.act(observation).clamp(-1.0, 1.0))

    return act


def kernel_rows(env: ReorientEnv) -> tuple[KernelRow, ...]:
    """Device time of one control step by kernel, by a timer around every launch.

    Launched without the graph, in which the passes of a solver's loop cannot be told apart; idle gaps do not
    count.
    """
    with wp.ScopedTimer("step", cuda_filter=wp.TIMING_KERNEL, print=False, synchronize=True) as timer:
        env.launch_step()
    seconds: dict[str, list[float]] = {}
    for result in timer.timing_results:  # "forward kernel NAME_HASH", milliseconds
        seconds.setdefault(result.name.split()[-1], []).append(1e-3 * result.elapsed)
    total = sum(map(sum, seconds.values()))
    rows = [KernelRow(name, len(times), sum(times), sum(times) / total) for name, times in seconds.items()]
    return tuple(sorted(rows, key=lambda row: row.seconds, reverse=True))


def own_share(rows: tuple[KernelRow, ...]) -> float:
    """Share of our kernels in the device time of a step."""
    own = tuple(f"{name}_" for name in own_kernel_names())
    return sum((row.share for row in rows if row.kernel.startswith(own)), start=0.0)


def own_kernel_names() -> set[str]:
    """Names of all kernels of :mod:`vd.kernels`."""
    import vd.kernels

    names = set()
    for info in pkgutil.walk_packages(vd.kernels.__path__, "vd.kernels."):
        module = importlib.import_module(info.name)
        names |= {value.key for value in vars(module).values() if isinstance(value, wp.Kernel)}
    return names


def measure(
    cfg: ReorientCfg,
    device: str,
    *,
    teacher: "TrainedPolicy | None" = None,
    calls: int = 24,
    seed: int = 0,
    label: str = "mixed",
) -> SimRow:
    """Measure one configuration; raises if any contact was lost.

    Args:
        cfg: Task.
        device: Warp device.
        teacher: A policy trained in that task, on the device; a stand-in for an untrained one if None.
        calls: Control steps to time, each way.
        seed: Of the stand-in.
        label: Name of the row's scene.
    """
    begin = time.perf_counter()
    on_gpu = device != "cpu"
    before = free_memory(device) if on_gpu else 0
    env = ReorientEnv(cfg, device)
    env.step(env.action)
    wp.synchronize_device(device)
    start_s = time.perf_counter() - begin
    for _ in range(WARM_UP_STEPS):
        env.step(env.action)
    # Before the policy, whose network and matrix workspace are no part of the simulation.
    memory = (before - free_memory(device)) / 1e9 if on_gpu else 0.0
    if teacher is None:
        policy = reaching_policy(env, seed)
    else:
        env.set_stage(Stage())  # a teacher has learned the task as it is configured
        policy = teacher_policy(env, teacher)
    for _ in range(WARM_UP_STEPS):
        policy()
        env.step(env.action)
    env.check()

    def physics_seconds() -> float:
        return seconds_per_call(captured(env.launch_physics, device), calls, device, before=policy)

    # The same policy acts in all of them, so that the hand moves and pushes alike.
    policy_s = seconds_per_call(policy, calls, device)
    step_s = seconds_per_call(lambda: env.step(env.action), calls, device, before=policy)
    physics_s, solver = physics_seconds(), env.sim.solver
    env.check()
    data = solver.mjw_data
    contacts, rows = float(data.nacon.numpy()[0]), int(np.max(data.nefc.numpy()))
    kernels = kernel_rows(env) if on_gpu else ()
    n = cfg.num_envs
    return SimRow(
        scene=label,
        envs=n,
        physics_only=n / physics_s,
        whole_step=n / step_s,
        with_policy=n / (policy_s + step_s),
        own_kernels=own_share(kernels),
        memory_gb=memory,
        start_s=start_s,
        contacts_mean=contacts / n,
        rows_max=rows,
        kernels=kernels,
    )


def free_memory(device: str) -> int:
    """Free memory of a CUDA device [bytes], after returning what allocators hold back."""
    import torch

    gc.collect()  # an earlier row's simulation may still wait for it
    torch.cuda.empty_cache()
    wp.set_mempool_release_threshold(device, 0)
    wp.synchronize_device(device)
    return int(wp.get_device(device).free_memory)


def teacher_task(policy: "TrainedPolicy", objects: tuple[str, ...], envs: int) -> ReorientCfg:
    """The task a teacher was trained in, on these objects.

    Raises:
        ValueError: It is not one of this version.
    """
    from vd.evaluate.agents import trained_task

    return dataclasses.replace(trained_task(policy), objects=objects, num_envs=envs)


def task(objects: tuple[str, ...], envs: int, hand: str, randomise: bool) -> ReorientCfg:
    """The benchmark's task: the paper's, with table support so that contacts are many."""
    cfg = ReorientCfg(hand=hand, objects=objects, num_envs=envs, reward=RewardCfg(table_contact=0.0))
    return dataclasses.replace(cfg, randomisation=dataclasses.replace(cfg.randomisation, enabled=randomise))
