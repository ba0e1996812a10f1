"""Second views on a hand: when a goal is looked at again, and that it is as in the simulator."""

import numpy as np

from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.deploy.loop.policy_runner import Sensed, TrackingRunner
from vd.envs.cfg import ReorientCfg
from vd.evaluate.agents import open_policy
from vd.tracking.tracker import NEAREST
from vd.tracking.views import AFTER_S, EVERY_S

HZ = ReorientCfg().sim.control_hz
AFTER, EVERY = round(AFTER_S * HZ), round(EVERY_S * HZ)


def test_a_tracker_looks_again_after_a_while_and_begins_anew_with_a_new_goal():
    policy, hand, (item,) = open_policy("dclaw3-tracking", "cpu"), load_hand("dclaw3"), load_set("cube")
    plain, runner = (TrackingRunner(policy, hand, item, second_view=second) for second in (False, True))
    zero = np.zeros(9)
    image = np.full((hand.camera.height, hand.camera.width), 0.6, dtype=np.float32)
    sensed = Sensed(zero, zero, zero, np.array([np.sin(1.0), 0.0, 0.0, np.cos(1.0)]), depth=image)

    def played(steps: int) -> tuple[list[bool], list[int]]:
        """Whether both act alike in each of so many steps, and the views that were taken."""
        alike, taken = [], []
        for _ in range(steps):
            one, other = plain.decide(sensed).action, runner.decide(sensed).action
            alike.append(np.allclose(one, other, atol=1e-5))
            taken.append(int(runner._tracker._selected[0]))
        return alike, taken

    for begin in ("begin", "new_goal"):
        for each in (plain, runner):
            getattr(each, begin)()
        alike, taken = played(AFTER + 1)
        assert all(alike[:AFTER]) and set(taken[:AFTER]) == {NEAREST}
        assert taken[AFTER] != NEAREST
