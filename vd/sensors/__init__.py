"""Sensors of the robot, simulated: the depth camera."""
