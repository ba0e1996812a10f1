"""Finding an object by the cloud of its goal: a network that turns one cloud onto another, and its search."""
