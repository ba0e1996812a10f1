"""The gap workflow: where simulation and measurement disagree, which effect is missing, how much it closes."""
