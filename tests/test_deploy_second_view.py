"""Second views on a hand: when a goal is looked at again, and that it is as in the simulator."""

import numpy as np
import pytest
import warp as wp
from sensed_world import state_of

from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.deploy.loop.policy_runner import Sensed, TrackingRunner
from vd.deploy.loop.teacher_runner import TeacherRunner
from vd.envs.cfg import ReorientCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.agents import open_policy
from vd.evaluate.second_view import SecondView
from vd.tracking.tracker import NEAREST
from vd.tracking.views import AFTER_S, EVERY_S

HZ = ReorientCfg().sim.control_hz
AFTER, EVERY = round(AFTER_S * HZ), round(EVERY_S * HZ)


@pytest.mark.parametrize("hand", ["dclaw3", "dclaw4"])
def test_a_teacher_takes_the_views_on_a_twin_that_it_takes_in_the_simulator(hand):
    """The hand does nothing, so that no goal is reached, and the critic says the contrary: views change."""
    policy = open_policy(f"{hand}-table", "cpu")
    last = max(name for name in policy._critic if name.startswith("mlp.") and name.endswith(".weight"))
    policy._critic[last] = -policy._critic[last]
    runner = TeacherRunner(policy, hand, "cuboid", second_view=True)
    env = ReorientEnv(runner.task, "cpu")
    actor, mirror, seen = SecondView(env, policy), runner.mirror.env, set()
    for goal in range(2):
        env.reset()
        runner.new_goal()
        for step in range(AFTER + EVERY + 2):
            ours = runner.decide(state_of(env)).action
            theirs = actor.act(wp.to_torch(env.observation)).contiguous()
            view = int(env.views.view.numpy()[0])
            assert int(mirror.views.view.numpy()[0]) == view
            np.testing.assert_allclose(
                ours, env.views.world_action(wp.from_torch(theirs)).numpy()[0], atol=1e-3
            )
            seen.add((goal, step >= AFTER, view))
            env.step(wp.zeros((1, env.num_actions), dtype=float, device="cpu"))
    first, later = ({(number, view) for number, at, view in seen if at is late} for late in (False, True))
    assert later - first, "some goal is looked at in another view"


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
