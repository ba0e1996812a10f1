"""What camera policies know of shapes and goals, and goals in a row; a leaf, for command lines."""

from typing import Literal

from vd.paper import PAPER

Goals = Literal["mesh", "points", "scan"]
"""What a camera policy knows of a shape and its goal: the mesh, 500 exact points of it, or a scan's."""

IN_A_ROW = 3
"""Goals in a row in the air (ours)."""
GOAL_S, ALONE_S = 12.0, 1.0
"""Time for each goal, to the 15 s of the paper for the first; and from the table's going to it [s] (ours)."""
AIR_S = PAPER.scene.air_table_s + ALONE_S + IN_A_ROW * GOAL_S
"""Length of an episode with goals in a row [s]."""
AIR_HOLD_S = 30.0
"""For how long a hand holds its object where it reached the first of them [s] (ours)."""
