"""Kernels of the task: actions, randomisation, success, rewards, resets, observations."""
