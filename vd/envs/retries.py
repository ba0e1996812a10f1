"""Hands that open and try again where they are stuck; see :func:`vd.kernels.retries.retry_kernel`."""

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from vd.kernels.retries import ANY_DISTANCE, RetryParams, retry_kernel
from vd.paper import PAPER

if TYPE_CHECKING:
    from vd.envs.reorient import ReorientEnv

NO_PREDICTION = -1.0


def retry_params(cfg: Any, control_dt: float, step_rad: float, device: str) -> wp.array:
    """Settings of the kernel, shape [1], from those of :class:`vd.envs.cfg.RetryCfg`.

    Args:
        cfg: The settings.
        control_dt: Length of a control step [s].
        step_rad: Joint increment of an action of 1 [rad per control step].
        device: Warp device.
    """
    params = RetryParams()
    params.beyond, params.progress = cfg.beyond_rad, cfg.progress_rad
    params.patience, params.open_steps = (max(1, round(s / control_dt)) for s in (cfg.patience_s, cfg.open_s))
    params.step_rad = step_rad
    return wp.array([params], dtype=RetryParams, device=device)


class Retries:
    """What decides in every world whether the policy acts or the hand opens.

    Attributes:
        predicted: Distance to the goal as a student predicts it [rad], shape [N]; negative where nothing is
            predicted, and the true distance counts.
    """

    def __init__(self, env: "ReorientEnv"):
        n, d, cfg = env.num_worlds, env.num_actions, env.cfg
        step_rad = cfg.action.scale_rad_s * cfg.sim.control_dt
        self._env = env
        self._params = retry_params(cfg.retry, cfg.sim.control_dt, step_rad, env.device)
        open_q = np.tile(PAPER.scene.reset_joint_rad, env.num_fingers)
        self._open_q = wp.array(open_q, dtype=float, device=env.device)
        self.predicted = wp.full(n, NO_PREDICTION, dtype=float, device=env.device)
        self._least = wp.full(n, ANY_DISTANCE, dtype=float, device=env.device)
        self._waited = wp.zeros(n, dtype=wp.int32, device=env.device)
        self._opening = wp.zeros(n, dtype=wp.int32, device=env.device)
        self._action = wp.zeros((n, d), dtype=float, device=env.device)

    def world_action(self, action: wp.array, new_goal: wp.array) -> wp.array:
        """Actions to apply, shape [N, D].

        Args:
            action: Those of the policy, joints in the world's order, shape [N, D].
            new_goal: 1 where the goal is new, shape [N].
        """
        env = self._env
        wp.launch(
            retry_kernel,
            dim=env.num_worlds,
            inputs=[
                self._open_q,
                self._params,
                action,
                env.measured_q,
                env.previous_error,
                self.predicted,
                env.step_count,
                new_goal,
                self._least,
                self._waited,
                self._opening,
            ],
            outputs=[self._action],
            device=env.device,
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
