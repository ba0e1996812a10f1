"""Running a policy on hardware.

So far the motors: their bus, and a twin of it to try everything on.
"""
