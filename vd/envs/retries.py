"""Hands that open and try again where they are stuck; see :func:`vd.kernels.retries.retry_kernel`."""

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from vd.kernels.retries import ANY_DISTANCE, RetryParams, retry_kernel
from vd.paper import PAPER

if TYPE_CHECKING:
    from vd.envs.cfg import ReorientCfg

NO_PREDICTION = -1.0


def retry_params(task: "ReorientCfg", device: str) -> wp.array:
    """Settings of the kernel, shape [1], for those of a task."""
    cfg, dt = task.retry, task.sim.control_dt
    params = RetryParams()
    params.beyond, params.progress = cfg.beyond_rad, cfg.progress_rad
    params.patience, params.open_steps = (max(1, round(s / dt)) for s in (cfg.patience_s, cfg.open_s))
    params.step_rad = task.action.scale_rad_s * dt
    return wp.array([params], dtype=RetryParams, device=device)


class Retries:
    """What decides in every world whether the policy acts or the hand opens.

    Args:
        task: The task, with its settings of retries.
        num_fingers: F.
        num_worlds: N.
        device: Warp device.

    Attributes:
        predicted: Distance to the goal as a student predicts it [rad], shape [N]; negative where nothing is
            predicted, and the true distance counts.
    """

    def __init__(self, task: "ReorientCfg", num_fingers: int, num_worlds: int, device: str):
        self._params, self._device = retry_params(task, device), device
        open_q = np.tile(PAPER.scene.reset_joint_rad, num_fingers)
        self._open_q = wp.array(open_q, dtype=float, device=device)
        self.predicted = wp.full(num_worlds, NO_PREDICTION, dtype=float, device=device)
        self._least = wp.full(num_worlds, ANY_DISTANCE, dtype=float, device=device)
        self._waited, self._opening = (wp.zeros(num_worlds, dtype=wp.int32, device=device) for _ in range(2))
        self._action = wp.zeros((num_worlds, len(open_q)), dtype=float, device=device)

    def world_action(
        self,
        action: wp.array,
        joint_q: wp.array,
        distance: wp.array,
        step_count: wp.array,
        new_goal: wp.array,
    ) -> wp.array:
        """Actions to apply, shape [N, D]; device work only.

        Args:
            action: Those of the policy, joints in the world's order, shape [N, D].
            joint_q: Joint positions as measured [rad], shape [N, *].
            distance: True distance to the goal [rad], shape [N].
            step_count: Control steps since the reset, shape [N].
            new_goal: 1 where the goal is new, shape [N].
        """
        wp.launch(
            retry_kernel,
            dim=len(self._waited),
            inputs=[
                self._open_q,
                self._params,
                action,
                joint_q,
                distance,
                self.predicted,
                step_count,
                new_goal,
                self._least,
                self._waited,
                self._opening,
            ],
            outputs=[self._action],
            device=self._device,
        )
        return self._action

    def predict(self, distance: Any) -> None:
        """Go by a student's distance to the goal [rad], shape [N] (torch), until told otherwise."""
        wp.copy(self.predicted, wp.from_torch(distance.contiguous(), dtype=wp.float32))

    def forget(self) -> None:
        """Go by the true distance again."""
        self.predicted.fill_(NO_PREDICTION)

    def stateful(self) -> dict[str, wp.array]:
        """What a saved environment has to keep."""
        return {
            "retry_least": self._least,
            "retry_waited": self._waited,
            "retry_opening": self._opening,
        }
