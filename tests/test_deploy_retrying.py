"""A pilot that is stuck opens the hand, as the simulated environment does."""

import numpy as np
import pytest

from vd.assets_usd.hands import load_hand
from vd.deploy.observation import Sensed
from vd.deploy.pilot import Decision
from vd.deploy.retrying import RetryingPilot
from vd.envs.cfg import ReorientCfg
from vd.paper import PAPER
from vd.student.stopping import StoppingRule

HAND = load_hand("dclaw3", "rigid", None)
TASK = ReorientCfg(hand="dclaw3")
PATIENCE, OPENS = (round(s * TASK.sim.control_hz) for s in (TASK.retry.patience_s, TASK.retry.open_s))
OPEN = np.tile(PAPER.scene.reset_joint_rad, 3)
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
    retrying = RetryingPilot(stubborn, HAND, TASK)
    retrying.begin()
    return stubborn, retrying


def sensed(q: np.ndarray) -> Sensed:
    return Sensed(q, np.zeros(9), np.zeros(9), np.array([0.0, 0.0, 0.0, 1.0]))


def opens(pilot: RetryingPilot, steps: int) -> list[bool]:
    """Whether each of the next actions is one towards the open hand, from joints 0.05 rad above it."""
    found = []
    for _ in range(steps):
        decision = pilot.decide(sensed(OPEN + 0.05))
        found.append(not np.allclose(decision.action, OWN))
        if found[-1]:
            assert (decision.action < 0.0).all() and (np.abs(decision.action) <= 1.0).all()
        assert decision.distance is pilot.pilot.distance
    return found


def test_it_acts_until_its_patience_ends_then_opens_then_acts(pilots):
    """The first distance is progress on none, so patience counts from the second step."""
    _, retrying = pilots
    once = [False] * PATIENCE + [True] * OPENS
    assert opens(retrying, 2 * len(once)) == 2 * once


def test_a_pilot_that_gets_nearer_is_left_alone(pilots):
    stubborn, retrying = pilots
    found = []
    for distance in np.arange(3.0, 0.5, -0.11).tolist() + [0.3] * 3 * PATIENCE:
        stubborn.distance = distance
        found += opens(retrying, 1)
    assert not any(found)


def test_a_new_goal_begins_anew(pilots):
    stubborn, retrying = pilots
    assert not any(opens(retrying, PATIENCE - 1))
    retrying.new_goal()
    assert not any(opens(retrying, PATIENCE)) and all(opens(retrying, OPENS))
    assert stubborn.calls == ["begin", "new goal"]


def test_a_pilot_that_knows_no_distance_is_left_alone(pilots):
    stubborn, retrying = pilots
    stubborn.distance = float("nan")
    assert not any(opens(retrying, 3 * PATIENCE))
