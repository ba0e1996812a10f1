"""``vd-bench sim``: control steps per second and memory, all measured in one run.

The whole step has physics, actions, observations, rewards, resets and randomisation; with a policy
adds its network. States come from a teacher's mean actions, in contact, in the task of its
training.
"""

import gc
import time
from collections.abc import Callable
from typing import Any

import torch
import warp as wp

from vd.envs.cfg import ReorientCfg
from vd.envs.curriculum import Levels
from vd.envs.reorient import ReorientEnv
from vd.policy.actor import TrainedPolicy

WARM_UP_STEPS = 36
"""Control steps before timing: objects have landed and fingers reached them (3 s)."""


def seconds_per_call(
    function: Any, calls: int, device: str, *, before: Callable[[], object] = lambda: None
) -> float:
    """Mean wall time of ``calls`` calls [s], device work included.

    ``before`` each of them is not timed.
    """
    elapsed = 0.0
    for _ in range(calls):
        before()
        wp.synchronize_device(device)
        start = time.perf_counter()
        function()
        wp.synchronize_device(device)
        elapsed += time.perf_counter() - start
    return elapsed / calls


def measure(
    cfg: ReorientCfg, device: str, *, teacher: TrainedPolicy, calls: int = 24
) -> dict[str, float]:
    """Measure one configuration; raises if any contact was lost.

    Args:
        cfg: Task.
        device: Warp device.
        teacher: A policy trained in that task, on the device.
        calls: Control steps to time, each way.

    Returns:
        ``envs``; control steps/s over all of them: ``whole_step`` of the environment, and
        ``with_policy``; ``memory_gb`` of simulation and environment, 0 on the CPU.
    """
    on_gpu = device != "cpu"
    before = free_memory(device) if on_gpu else 0
    env = ReorientEnv(cfg, device)
    for _ in range(WARM_UP_STEPS):
        env.step(env.action)
    # Before the policy, whose network and matrix workspace are no part of the simulation.
    memory = (before - free_memory(device)) / 1e9 if on_gpu else 0.0
    env.set_levels(Levels())  # a teacher has learned the task as it is configured
    observation = wp.to_torch(env.observation)
    action = wp.to_torch(env.action)

    def policy() -> None:
        """The teacher's mean actions, where the next step reads them."""
        action.copy_(teacher.act(observation).clamp(-1.0, 1.0))

    for _ in range(WARM_UP_STEPS):
        policy()
        env.step(env.action)
    env.check()

    # The same policy acts in all of them, so that the hand moves and pushes alike.
    policy_s = seconds_per_call(policy, calls, device)
    step_s = seconds_per_call(lambda: env.step(env.action), calls, device, before=policy)
    env.check()
    envs = cfg.num_envs
    return {
        "envs": envs,
        "whole_step": envs / step_s,
        "with_policy": envs / (policy_s + step_s),
        "memory_gb": memory,
    }


def free_memory(device: str) -> int:
    """Free memory of a CUDA device [bytes], after returning what allocators hold back."""
    gc.collect()  # an earlier row's simulation may still wait for it
    torch.cuda.empty_cache()
    wp.set_mempool_release_threshold(device, 0)
    wp.synchronize_device(device)
    return int(wp.get_device(device).free_memory)
