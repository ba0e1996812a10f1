"""How hidden plants differ in what is no effect: the solver, friction at zero speed, noise, the gears."""

from dataclasses import dataclass

STEP_S = 4.0e-4
"""Time step [s]: five times finer than the fitted model's, second order where the motion is smooth."""


@dataclass(frozen=True)
class Physics:
    """How a plant obeys the same laws otherwise than the one that the analysis was tuned on (the default).

    Attributes:
        step_s: Time step [s].
        presliding_rad: Travel over which dry friction builds up, as the teeth of a gear bend [rad]; 0: none.
        noise_s: Correlation time of the reading's noise [s]; 0: white.
        ripple_nm: Amplitude of a torque that the gears of every joint add [N m].
        ripple_per_turn: Its periods in a radian of travel.
    """

    step_s: float = STEP_S
    presliding_rad: float = 0.0
    noise_s: float = 0.0
    ripple_nm: float = 0.0
    ripple_per_turn: float = 0.0


TUNED = Physics()
"""The plant that the rules of the search were tuned on."""
