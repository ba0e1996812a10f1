"""Policies that see by a camera: the object found by its goal's cloud, and who acts on it.

Teachers act by a network that turns one cloud onto another, students by networks of their own.
"""
