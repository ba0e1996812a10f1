"""A pilot that gets help from chance while its object is far from the goal."""

import numpy as np
import warp as wp

from vd.assets_usd.hand_data import HandModel
from vd.deploy.observation import Sensed
from vd.deploy.pilot import Decision, Pilot
from vd.envs.cfg import ReorientCfg
from vd.envs.nudges import Nudges


class NudgedPilot:
    """A policy, and the kernels that add noise to it or act in its place (``kernels/nudges.py``).

    Args:
        pilot: The policy.
        hand: The hand.
        task: The task it was trained in; its settings ``nudge`` and ``explore`` count.
    """

    def __init__(self, pilot: Pilot, hand: HandModel, task: ReorientCfg):
        self.rule, self.pilot = pilot.rule, pilot
        self._nudges = Nudges(task, hand.num_joints, 1, "cpu")
        self._action = wp.zeros((1, hand.num_joints), dtype=float, device="cpu")
        self._distance = wp.zeros(1, dtype=float, device="cpu")
        self._steps, self._new_goal = (wp.zeros(1, dtype=wp.int32, device="cpu") for _ in range(2))

    def begin(self) -> None:
        """A flight begins."""
        self.pilot.begin()
        self._steps.zero_()

    def new_goal(self) -> None:
        """A new goal: how long the last one was missed says nothing of it."""
        self.pilot.new_goal()
        self._new_goal.fill_(1)

    def decide(self, sensed: Sensed) -> Decision:
        """The policy's action, with noise or a random one as the task says; the policy's distance."""
        decision = self.pilot.decide(sensed)
        self._action.assign(decision.action.astype(np.float32)[None])
        known = not np.isnan(decision.distance)  # who knows no distance is never far
        self._distance.fill_(decision.distance if known else 0.0)
        action = self._nudges.action(self._action, self._distance, self._steps, self._new_goal)
        self._steps.fill_(1)
        self._new_goal.zero_()
        return Decision(action.numpy()[0].copy(), decision.distance)
