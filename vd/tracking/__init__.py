"""Policies that see: the object found by its known shape or its goal's cloud, and a teacher acting on it.

One control step, top to bottom: :meth:`vd.tracking.tracker.Tracker.step`.
"""
