"""Limits and a watchdog that hold whatever decides on goals."""
