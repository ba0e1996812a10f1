"""What the fingers do in a control step: where their tips are, and the torques of their joints."""

import warp as wp

from vd.assets_usd.hand_model import HandModel
from vd.kernels.launch import launch
from vd.kernels.task.actions import joint_effort_kernel
from vd.kernels.task.environments import copy_columns_kernel
from vd.kernels.task.observations import fingertip_kernel
from vd.sim.scene import Scene
from vd.sim.simulator import Simulator


class Fingers:
    """Fingertips and torques of N environments, F fingers with D joints in all.

    Args:
        hand: The hand.
        scene: Scene with N hands.
        sim: Its simulator.

    Attributes:
        tip_body: Link of each fingertip, an index within a world, shape [F].
        tip_offset: Fingertip frames in the frames of their links, shape [F].
        tip_pos: Fingertip positions [m], shape [N, F].
        effort: Joint torques [N m], shape [N, D].
    """

    def __init__(self, hand: HandModel, scene: Scene, sim: Simulator):
        self._sim = sim
        device = sim.joint_q.device
        self.tip_body = wp.array(scene.link_body[hand.tip_link], dtype=wp.int32, device=device)
        self.tip_offset = wp.array(hand.tip_frame, dtype=wp.transform, device=device)
        self._effort_limit = wp.array(hand.effort, dtype=float, device=device)
        self.tip_pos = wp.zeros((scene.num_envs, hand.num_fingers), dtype=wp.vec3, device=device)
        self.effort = wp.zeros((scene.num_envs, hand.num_joints), dtype=float, device=device)

    def measure(self, kp: wp.array, kd: wp.array) -> None:
        """Refresh positions and torques from the present state. Device work only.

        Args:
            kp: Joint stiffness [N m/rad], shape [N, D].
            kd: Joint damping [N m s/rad], shape [N, D].
        """
        sim = self._sim
        tips = [self.tip_body, self.tip_offset, sim.body_q]
        launch(fingertip_kernel, self.tip_pos.shape, tips, [self.tip_pos])
        if sim.servo is not None:
            # Only the servo knows what it had in the last physics step: a late command, a limited
            # torque.
            torque = sim.solver.mjw_data.qfrc_actuator
            launch(copy_columns_kernel, self.effort.shape, [torque], [self.effort])
            return
        joints = [self._effort_limit, kp, kd, sim.target, sim.joint_q, sim.joint_qd]
        launch(joint_effort_kernel, self.effort.shape, joints, [self.effort])
