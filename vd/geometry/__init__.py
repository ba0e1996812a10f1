"""Rotations, clouds and symmetry frames, without a simulator."""
