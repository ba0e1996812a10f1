"""Settings of the physics, each with the reason for its value."""

from dataclasses import dataclass, replace
from typing import Literal

from vd.paper import PAPER

Engine = Literal["newton", "mujoco"]

# Of a light object (0.1 kg) pinched by strong fingers (2.6 N m), measured in
# docs/concepts/physics.md.
CONE = "elliptic"
"""Friction cone. A pyramidal one lets a pinched object creep by millimetres per second."""
IMPRATIO = 10.0
"""Frictional over normal impedance. 1 creeps an order of magnitude faster than 10."""
TOLERANCE = 1e-6
"""Solver tolerance; single precision gains nothing below it."""
JACOBIAN = "sparse"
"""How the solver keeps the constraints' Jacobian. A contact moves one finger and the object, of
four fingers 9 of 18 coordinates; sparse, the solver passes over these alone: the same steps, to
rounding.
"""
CONTACT_IMPEDANCE = (0.99, 0.995)
"""Contact ``solimp`` d0 and dmax of hand and object. Contact stiffness scales with the object's
mass, so the default (0.9, 0.95) lets fingers sink more than a millimetre into a 0.1 kg object."""
TABLE_IMPEDANCE = (0.97, 0.99)
"""The same for contacts with the table: stiffer ones keep some light, slim objects rocking, softer
ones let more of them roll on."""
IMPEDANCE_WIDTH_M = 0.001
"""Penetration over which the impedance rises from d0 to dmax [m]."""
GAP_M = 0.002
"""Detection distance beyond touching [m]. The default of 0.1 m, the size of the whole scene, makes
hundreds of candidate contacts a world that never touch."""
FINGERTIP_TORSION_M = 0.005
"""Torsional friction radius of the fingertips [m], about the radius of their contact patch;
fingertip contacts have condim 4, all others 3."""


@dataclass(frozen=True)
class SimCfg:
    """Rates, sizes and limits of the physics.

    What is the same in every run is a constant of this module.
    """

    engine: Engine = "newton"
    """What steps the physics: Newton on MuJoCo Warp, or MuJoCo's own engine in C, on the CPU
    alone.
    """
    physics_hz: float = PAPER.scene.physics_hz
    """Physics rate [Hz]; a whole, even multiple of ``control_hz``."""
    control_hz: float = PAPER.scene.control_hz
    """Policy rate [Hz]."""
    iterations: int = 10
    """Newton solver iterations at most; it stops earlier by ``tolerance``. Contact quality is that
    of 100 iterations (rest, creep, penetration); 20 cost a fifth of the speed: all wait for the
    slowest.
    """
    ls_iterations: int = 10
    """Line-search iterations at most."""
    contact_time_constant_s: float = 2.0 / 120.0
    """Contact ``solref`` time constant [s]: two physics steps, the stiffest that is stable."""
    njmax: int = 160
    """Constraint rows an environment may use; an overflow stops the run and names this setting."""
    nconmax: int = 32
    """Contacts an environment may use, averaged over all (about 10 are used, 20 in a handful);
    likewise. Of objects of more than 8 convex parts in proportion more."""
    nccdmax: int = 3
    """Pairs of convex shapes, of any one combination of kinds, that may overlap in an environment,
    averaged over all (0.1 to 0.25 do while fingers push); likewise. Each takes 5 kB of work space:
    with one for each contact, the solver's choice, they were most of the memory."""

    @property
    def physics_dt(self) -> float:
        """Physics step [s]."""
        return 1.0 / self.physics_hz

    @property
    def control_dt(self) -> float:
        """Control step [s]."""
        return 1.0 / self.control_hz

    @property
    def substeps(self) -> int:
        """Physics steps per control step."""
        return round(self.physics_hz / self.control_hz)

    def validate(self) -> None:
        """Raise ValueError for settings that cannot work, naming the field and the remedy."""
        ratio = self.physics_hz / self.control_hz
        if abs(ratio - round(ratio)) > 1e-6 or round(ratio) < 2 or round(ratio) % 2:
            raise ValueError(
                f"sim.physics_hz = {self.physics_hz} must be an even multiple of sim.control_hz = "
                f"{self.control_hz} (states are swapped every physics step and must end where they "
                f"began); set sim.physics_hz to {self.control_hz * max(2, 2 * round(ratio / 2))}"
            )
        if self.contact_time_constant_s < 2.0 * self.physics_dt * (1.0 - 1e-6):
            raise ValueError(
                f"sim.contact_time_constant_s = {self.contact_time_constant_s} is below two "
                f"physics steps; set it to {2.0 * self.physics_dt} or raise sim.physics_hz"
            )


MANY_COLLIDERS = SimCfg(njmax=320, nconmax=48, nccdmax=12)
"""Room for the contacts of LEAP's 71 colliders: none was lost in 252 M steps. Too little stops a
run.
"""
COARSE_PHYSICS_HZ = 96.0
"""Physics rate to learn in [Hz]; at 72 a policy that learned in 120 loses twice as many objects."""
COARSE_ITERATIONS = 4
"""Iterations of the solver, and of its line search, to learn in."""


def coarser(cfg: SimCfg) -> SimCfg:
    """Cheaper physics to learn in, which trained policies cannot tell from the default.

    The contacts' time constant stays two physics steps. What is coarser already stays as it is.

    Args:
        cfg: Physics of the task.
    """
    if cfg.physics_hz <= COARSE_PHYSICS_HZ:
        return cfg
    return replace(
        cfg,
        physics_hz=COARSE_PHYSICS_HZ,
        contact_time_constant_s=max(cfg.contact_time_constant_s, 2.0 / COARSE_PHYSICS_HZ),
        iterations=min(cfg.iterations, COARSE_ITERATIONS),
        ls_iterations=min(cfg.ls_iterations, COARSE_ITERATIONS),
    )


MUJOCO_PHYSICS_HZ = 1008.0
"""Physics rate in MuJoCo's engine [Hz]: the even multiple of the control rate next to a step of 1
ms.
"""
MUJOCO_ITERATIONS, MUJOCO_LS_ITERATIONS = 100, 50
"""MuJoCo's defaults. With 10 iterations of its line search the solver stops at wrong answers."""


def in_mujoco(cfg: SimCfg, physics_hz: float = MUJOCO_PHYSICS_HZ) -> SimCfg:
    """The same contacts, joints and shapes in MuJoCo's own engine.

    Args:
        cfg: Physics of the task.
        physics_hz: Physics rate [Hz].
    """
    return replace(
        cfg,
        engine="mujoco",
        physics_hz=physics_hz,
        iterations=MUJOCO_ITERATIONS,
        ls_iterations=MUJOCO_LS_ITERATIONS,
    )
