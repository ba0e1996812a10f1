"""What students know of shapes and goals; a leaf, so that a command line can name them at once."""

from typing import Literal

Goals = Literal["mesh", "points", "scan"]
"""What a student knows of a shape and its goal: the exact mesh, 500 exact points of it, or those of a scan.
"""
