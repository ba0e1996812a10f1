"""Hands that are moved at random where they are caught, see :mod:`vd.kernels.nudges`."""

from typing import TYPE_CHECKING, Any

import warp as wp

from vd.kernels.nudges import UNKNOWN, NudgeParams, explore_kernel, nudge_kernel
from vd.kernels.rng import init_rng_kernel

if TYPE_CHECKING:
    from vd.envs.cfg import ReorientCfg


def nudge_params(task: "ReorientCfg", device: str) -> wp.array:
    """Settings of the kernel, shape [1], for those of a task."""
    cfg, dt = task.nudge, task.sim.control_dt
    params = NudgeParams()
    params.beyond, params.still, params.std = cfg.beyond_rad, cfg.still_rad_s * dt, cfg.action_std
    params.still_steps, params.nudge_steps = (max(1, round(s / dt)) for s in (cfg.still_s, cfg.nudge_s))
    return wp.array([params], dtype=NudgeParams, device=device)


class Nudges:
    """What decides in every world whether the policy acts alone, with noise, or the hand is nudged.

    Args:
        task: The task, with its settings of nudges (``nudge``) and noise (``explore``) and its seed.
        num_joints: D.
        num_worlds: N.
        device: Warp device.

    Attributes:
        predicted: Distance to the goal as a student predicts it [rad], shape [N]; negative where nothing is
            predicted, and the true distance counts.
    """

    def __init__(self, task: "ReorientCfg", num_joints: int, num_worlds: int, device: str):
        self._params, self._device = nudge_params(task, device), device
        self._nudge, self._explore = task.nudge, task.explore

        def full(value: float, dtype: Any = float) -> wp.array:
            return wp.full(num_worlds, value, dtype=dtype, device=device)

        self.predicted, self._last = full(UNKNOWN), full(UNKNOWN)
        self._waited, self._left, self._rng = full(0, wp.int32), full(0, wp.int32), full(0, wp.uint32)
        self._kick, self._action = (
            wp.zeros((num_worlds, num_joints), dtype=float, device=device) for _ in range(2)
        )
        wp.launch(init_rng_kernel, dim=num_worlds, inputs=[task.seed], outputs=[self._rng], device=device)

    def action(
        self, action: wp.array, distance: wp.array, step_count: wp.array, new_goal: wp.array
    ) -> wp.array:
        """Actions to apply, shape [N, D]; device work only.

        Args:
            action: Those of the policy, shape [N, D].
            distance: True distance to the goal [rad], shape [N].
            step_count: Control steps since the reset, shape [N].
            new_goal: 1 where the goal is new, shape [N].
        """
        worlds, goal = len(self._waited), [distance, self.predicted]
        if self._explore.enabled:
            settings = [self._explore.beyond_rad, self._explore.action_std]
            wp.launch(
                explore_kernel,
                dim=worlds,
                inputs=[*settings, action, *goal, self._rng],
                outputs=[self._action],
                device=self._device,
            )
            action = self._action
        if self._nudge.enabled:  # a nudge takes the place of an action, its noise included
            state = [self._last, self._waited, self._left, self._kick, self._rng]
            wp.launch(
                nudge_kernel,
                dim=worlds,
                inputs=[self._params, action, *goal, step_count, new_goal, *state],
                outputs=[self._action],
                device=self._device,
            )
            action = self._action
        return action

    def predict(self, distance: Any) -> None:
        """Go by a student's distance to the goal [rad], shape [N] (torch), until told otherwise."""
        wp.copy(self.predicted, wp.from_torch(distance.contiguous(), dtype=wp.float32))

    def forget(self) -> None:
        """Go by the true distance again."""
        self.predicted.fill_(UNKNOWN)

    def stateful(self) -> dict[str, wp.array]:
        """What a saved environment has to keep."""
        names = ("last", "waited", "left", "kick", "rng")
        return {f"nudge_{name}": getattr(self, f"_{name}") for name in names}
