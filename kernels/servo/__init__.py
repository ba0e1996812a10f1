"""Kernels of the servos: the drive of a joint, its effects, and rollouts of chains."""
