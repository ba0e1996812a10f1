"""Strengths measured by ``python -m vd.gap.sizes``, as multiples of an effect's typical parameters."""

SCALES: dict[str, dict[str, tuple[float, ...]]] = {
    "dclaw3": {},
    "servo": {},
    "pendulum": {},
}
"""Model and effect to strengths of the four sizes; effects that cannot show on a model are absent."""
