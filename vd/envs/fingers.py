"""What the fingers do in a control step: where their tips are, and the torques of their joints."""

from typing import TYPE_CHECKING

import warp as wp

from vd.kernels.actions import joint_effort_kernel
from vd.kernels.observations import fingertip_kernel
from vd.kernels.worlds import copy_columns_kernel

if TYPE_CHECKING:
    from vd.envs.reorient import ReorientEnv


class Fingers:
    """Fingertips and torques of N worlds, F fingers with D joints in all.

    Args:
        env: The environment, whose hand, scene and simulator exist.

    Attributes:
        tip_body: Link of each fingertip, an index within a world, shape [F].
        tip_offset: Fingertip frames in the frames of their links, shape [F].
        tip_pos: Fingertip positions [m], shape [N, F].
        effort: Joint torques [N m], shape [N, D].
    """

    def __init__(self, env: "ReorientEnv"):
        self._env, hand, device = env, env.hand, env.device
        self.tip_body = wp.array(env.scene.link_body[hand.tip_link], dtype=wp.int32, device=device)
        self.tip_offset = wp.array(hand.tip_frame, dtype=wp.transform, device=device)
        self._effort_limit = wp.array(hand.effort, dtype=float, device=device)
        self.tip_pos = wp.zeros((env.num_worlds, hand.num_fingers), dtype=wp.vec3, device=device)
        self.effort = wp.zeros((env.num_worlds, hand.num_joints), dtype=float, device=device)

    def measure(self) -> None:
        """Refresh positions and torques from the present state. Device work only."""
        env = self._env
        wp.launch(
            fingertip_kernel,
            dim=self.tip_pos.shape,
            inputs=[self.tip_body, self.tip_offset, env.sim.body_q],
            outputs=[self.tip_pos],
            device=env.device,
        )
        self._measure_effort()

    def _measure_effort(self) -> None:
        env, sim = self._env, self._env.sim
        if sim.servo is not None:
            # Only the servo knows what it had in the last physics step: a late command, a limited torque.
            torque = sim.solver.mjw_data.qfrc_actuator
            wp.launch(
                copy_columns_kernel,
                dim=self.effort.shape,
                inputs=[torque],
                outputs=[self.effort],
                device=env.device,
            )
            return
        wp.launch(
            joint_effort_kernel,
            dim=self.effort.shape,
            inputs=[
                self._effort_limit,
                env.randomiser.kp,
                env.randomiser.kd,
                sim.target,
                sim.joint_q,
                sim.joint_qd,
            ],
            outputs=[self.effort],
            device=env.device,
        )
