"""What camera policies know of shapes and goals; a leaf, so that a command line can name them at once."""

from typing import Literal

Goals = Literal["mesh", "points", "scan"]
"""What a camera policy knows of a shape and its goal: the mesh, 500 exact points of it, or a scan's."""
