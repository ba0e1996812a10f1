"""Tracking policies: the object found by its known shape, and a teacher acting on it; no network that sees.

One control step, top to bottom: :meth:`vd.tracking.tracker.Tracker.step`.
"""
