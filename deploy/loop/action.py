"""From a policy's action to joint goals, by the kernel of the simulated environment."""

from typing import Any

import numpy as np
import warp as wp

from vd.assets_usd.hand_data import HandModel
from vd.envs.cfg import ReorientCfg
from vd.kernels.task.actions import ActionParams, apply_action_kernel


class ActionFilter:
    """Clip, moving average and increment of the training whose environment is ``task``."""

    def __init__(self, hand: HandModel, task: ReorientCfg):
        params = ActionParams()
        params.alpha = task.action.ema_alpha
        params.noise_std = 0.0
        params.step_rad = task.action.scale_rad_s * task.sim.control_dt
        count = hand.num_joints

        def array(values: Any, dtype: Any = float) -> wp.array:
            return wp.array(values, dtype=dtype, device="cpu")

        self._model = [array(hand.lower), array(hand.upper), array([params], ActionParams)]
        self._action, self._offset, self._q, self._smoothed, self._target = (
            wp.zeros((1, count), dtype=float, device="cpu") for _ in range(5)
        )
        self._rng = wp.zeros(1, dtype=wp.uint32, device="cpu")
        self._refused = wp.zeros(1, dtype=wp.int32, device="cpu")

    @property
    def smoothed(self) -> np.ndarray:
        """Moving average of the actions so far [D]; what a policy sees as its previous action."""
        return self._smoothed.numpy()[0].copy()

    def reset(self) -> None:
        """Forget the actions so far, as at the start of an episode."""
        self._smoothed.zero_()

    def goal(self, action: np.ndarray, joint_q: np.ndarray) -> np.ndarray:
        """Joint goals [rad] [D] for an action [D] taken at joint positions [rad] [D]."""
        self._action.assign(np.asarray(action, dtype=np.float32)[None])
        self._q.assign(np.asarray(joint_q, dtype=np.float32)[None])
        wp.launch(
            apply_action_kernel,
            dim=1,
            inputs=[*self._model, self._action, self._offset, self._q],
            outputs=[self._smoothed, self._rng, self._refused, self._target],
            device="cpu",
        )
        return self._target.numpy()[0].astype(float)
