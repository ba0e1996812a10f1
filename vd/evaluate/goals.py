"""What camera policies know of shapes and goals, and schedules of goals; for command lines."""

from dataclasses import dataclass
from typing import Literal

from vd.paper import PAPER

Goals = Literal["points", "scan"]
"""What a camera policy knows of a shape and its goal: 500 exact points of it, or a scan's."""
HOLD_S = 2.0
"""For how long a hand holds its object after a stop, before it is looked at again [s] (ours)."""


@dataclass(frozen=True)
class GoalSchedule:
    """The goals of an episode: one, to the end, or one after the other until one is not reached."""

    most: int = 1
    """Goals at most."""
    goal_s: float = PAPER.scene.episode_s
    """Time for each [s]."""
    first_s: float = 0.0
    """When the first goal that counts is given [s]; 0: at the start. Before, there is another."""
    table_s: float | None = None
    """When the table is taken away [s]; None: never."""
    hold_s: float = HOLD_S
    """For how long the hand then holds its object where it stopped at the first goal [s]."""
    distance_alone: bool = False
    """Whether a goal is reached whatever the action."""

    @property
    def length_s(self) -> float:
        """Longest episode [s]."""
        return self.first_s + self.most * self.goal_s


ONE_GOAL = GoalSchedule()
"""The paper's evaluation on the table."""
_TABLE_S = PAPER.scene.air_table_s
AIR_GOALS = GoalSchedule(3, 12.0, first_s=_TABLE_S + 1.0, table_s=_TABLE_S, hold_s=30.0)
"""In the air (ours): a second alone with the object, and 12 s to the 15 s of the paper for the
first.
"""
CONSECUTIVE = GoalSchedule(50, hold_s=0.0, distance_alone=True)
"""Consecutive successes: 50 at most, as OpenAI's Learning Dexterity counts them, each in the
paper's time.
"""
