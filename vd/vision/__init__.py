"""Finding an object by the cloud of its goal.

A network that turns one cloud onto another, and its search.
"""
