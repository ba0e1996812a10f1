"""Hands from URDF and MJCF: read, welded to fingers, authored as USD."""
