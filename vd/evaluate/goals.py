"""What camera policies know of shapes and goals, and goals in a row; a leaf, for command lines."""

from dataclasses import dataclass
from typing import Literal

from vd.paper import PAPER

Goals = Literal["mesh", "points", "scan"]
"""What a camera policy knows of a shape and its goal: the mesh, 500 exact points of it, or a
scan's.
"""


@dataclass(frozen=True)
class GoalSeries:
    """Goals that follow one another, until one is not reached or the object is lost."""

    most: int
    """Goals at most."""
    goal_s: float
    """Time for each [s]."""
    first_s: float = 0.0
    """When the first is given [s]; before, there is another, and a table that goes after 2 s. 0:
    the first is that of the start, and the table, if any, stays."""
    hold_s: float = 0.0
    """For how long the hand then holds its object where it reached the first of them [s]."""

    @property
    def length_s(self) -> float:
        """Longest episode [s]."""
        return self.first_s + self.most * self.goal_s


AIR_GOALS = GoalSeries(3, 12.0, PAPER.scene.air_table_s + 1.0, 30.0)
"""In the air (ours): a second alone with the object, and 12 s to the 15 s of the paper for the
first.
"""
CONSECUTIVE = GoalSeries(50, PAPER.scene.episode_s)
"""Consecutive successes: 50 at most, as OpenAI's Learning Dexterity counts them, each in the
paper's time.
"""
