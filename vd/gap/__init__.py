"""The gap workflow: where simulation and measurement disagree, what is missing, by name, and how much it closes."""
