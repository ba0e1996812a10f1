"""Effects of servos by the names that a configuration gives them."""

from collections.abc import Mapping

from vd.kernels.servo.effects import EFFECTS, Parameter

PARAMETERS: dict[str, Parameter] = {
    f"{name}.{p.name}": p for name, effect in EFFECTS.items() for p in effect.parameters
}
"""Every parameter of every effect, by the name ``effect.parameter``."""


def check_effects(effects: Mapping[str, tuple[float, float]]) -> None:
    """Raise ValueError for ranges that cannot be drawn, naming the parameter and the remedy.

    Args:
        effects: Ranges (low, high) by ``effect.parameter``.
    """
    for name, (low, high) in effects.items():
        if name not in PARAMETERS:
            raise ValueError(
                f"randomisation.effects: no parameter {name!r}; one of {', '.join(PARAMETERS)}"
            )
        parameter = PARAMETERS[name]
        lowest = -parameter.upper if parameter.signed else parameter.lower
        if not lowest <= low <= high <= parameter.upper:
            raise ValueError(
                f"randomisation.effects: {name} from {low:g} to {high:g}; the low end comes first, "
                f"and both lie between {lowest:g} and {parameter.upper:g} {parameter.unit}"
            )
