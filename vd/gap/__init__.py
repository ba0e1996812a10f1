"""The gap workflow: where simulation and measurement disagree, what is missing, how much it closes."""
