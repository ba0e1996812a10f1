"""A pilot that is stuck is nudged, as in the simulated environment."""

import numpy as np
import pytest

from vd.assets_usd.hands import load_hand
from vd.deploy.nudging import NudgedPilot
from vd.deploy.observation import Sensed
from vd.deploy.pilot import Decision
from vd.envs.cfg import ExploreCfg, NudgeCfg, ReorientCfg
from vd.student.stopping import StoppingRule

HAND = load_hand("dclaw3", "rigid", None)
TASK = ReorientCfg(hand="dclaw3", nudge=NudgeCfg(enabled=True))
WAITS, NUDGES = (round(s * TASK.sim.control_hz) for s in (TASK.nudge.still_s, TASK.nudge.nudge_s))
OWN = np.full(9, 0.125)


class Stubborn:
    """Always the same action, and the distance it is told to say."""

    def __init__(self) -> None:
        self.rule, self.distance, self.calls = StoppingRule(), 2.0, []

    def begin(self) -> None:
        """As a pilot's."""
        self.calls.append("begin")

    def new_goal(self) -> None:
        """As a pilot's."""
        self.calls.append("new goal")

    def decide(self, sensed: Sensed) -> Decision:
        """As a pilot's."""
        return Decision(OWN, self.distance)


@pytest.fixture
def pilots():
    stubborn = Stubborn()
    nudged = NudgedPilot(stubborn, HAND, TASK)
    nudged.begin()
    return stubborn, nudged


def nudged_in(pilot: NudgedPilot, steps: int) -> list[bool]:
    """Whether each of the next actions is another than the policy's own."""
    still = Sensed(np.zeros(9), np.zeros(9), np.zeros(9), np.array([0.0, 0.0, 0.0, 1.0]))
    found = []
    for _ in range(steps):
        decision = pilot.decide(still)
        found.append(not np.allclose(decision.action, OWN))
        assert np.abs(decision.action).max() <= 1.0 and decision.distance is pilot.pilot.distance
    return found


def test_it_acts_then_is_nudged_then_acts(pilots):
    """The first distance stands still beside none, so the wait begins with the second."""
    _, nudged = pilots
    once = [False] * (WAITS - 1) + [True] * NUDGES
    assert nudged_in(nudged, 1 + 2 * len(once)) == [False] + 2 * once


def test_a_pilot_whose_object_moves_or_has_arrived_is_left_alone(pilots):
    stubborn, nudged = pilots
    found = []
    for distance in np.arange(3.0, 0.5, -0.11).tolist() + [0.3] * 3 * WAITS:
        stubborn.distance = distance
        found += nudged_in(nudged, 1)
    assert not any(found)


def test_a_new_goal_begins_anew(pilots):
    stubborn, nudged = pilots
    assert not any(nudged_in(nudged, WAITS))
    nudged.new_goal()
    assert not any(nudged_in(nudged, WAITS)) and all(nudged_in(nudged, NUDGES))
    assert stubborn.calls == ["begin", "new goal"]


def test_a_pilot_that_knows_no_distance_is_left_alone(pilots):
    stubborn, nudged = pilots
    stubborn.distance = float("nan")
    assert not any(nudged_in(nudged, 3 * WAITS))


def test_a_pilot_that_explores_has_noise_until_it_has_arrived():
    stubborn = Stubborn()
    noisy = NudgedPilot(stubborn, HAND, ReorientCfg(hand="dclaw3", explore=ExploreCfg(enabled=True)))
    noisy.begin()
    assert all(nudged_in(noisy, 2 * WAITS))
    for distance in (0.3, float("nan")):
        stubborn.distance = distance
        assert not any(nudged_in(noisy, 5))
