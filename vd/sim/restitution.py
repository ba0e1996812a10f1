"""Restitution: contacts that throw a fast object back, within what soft contacts at 120 Hz can do.

MuJoCo's contacts are damped springs, not impulses. A spring of damping ratio z throws back with
e = exp(-pi z / sqrt(1 - z^2)) of the speed; here z is lowered at equal stiffness, so that an object at rest
sinks in as before. Two limits (``tests/test_sim_physics.py``):

* z is at least :data:`LOWEST_RATIO`. A contact lasts six physics steps, and with less damping sampling alone
  could add energy.
* Below :data:`BOUNCE_THRESHOLD` contacts are as without restitution. Otherwise an object on the table hops
  for ever by the speed that gravity adds in one step (0.08 m/s), and friction, which the solver damps by the
  same number, holds worse. The paper's engine has the same rule, for the speed of approach of each contact;
  here the speed of the object's centre of mass decides for all contacts of its world, because the solver
  makes contacts and solves them in one step.

Above the threshold that weaker damping of friction stays: a box that slides at 1 m/s goes on for 1.7 times
Coulomb's distance with coefficients of 1, and for 0.97 times with 0.6, as without restitution.
"""

import warp as wp
from newton.solvers import SolverMuJoCo

from vd.kernels.launch import launch
from vd.kernels.task.contacts import restitution_kernel
from vd.sim.scene import SHAPE_HAND, SHAPE_TABLE

BOUNCE_THRESHOLD = 0.2
"""Speed of the object below which nothing bounces [m/s]: the bounce threshold of the released code."""
LOWEST_RATIO = 0.05
"""Least damping ratio relative to the contact's own: throws back with 0.88."""


class Restitution:
    """Coefficients of every world and what they make of the solver's contacts. Plain contacts until drawn."""

    def __init__(self, solver: SolverMuJoCo, geom_kind: wp.array2d, object_column: int):
        """Keep the solver's present contact references as those without restitution.

        Args:
            solver: Solver of N worlds.
            geom_kind: Kind of each geom (``vd.sim.scene.SHAPE_*``), shape [N, G].
            object_column: Column of the object's linear velocity in ``joint_qd``.
        """
        self._solref = solver.mjw_model.geom_solref
        self._nominal = wp.clone(self._solref)
        self._geom_kind, self._object_column = geom_kind, object_column
        self.hand, self.object, self.table = (
            wp.zeros(len(geom_kind), dtype=float, device=geom_kind.device) for _ in range(3)
        )
        """Coefficients of restitution, shape [N] each."""

    def apply(self, joint_qd: wp.array2d) -> None:
        """Set the contacts of the next physics step from the velocities before it, shape [N, D + 6]."""
        kinds = [self._geom_kind, SHAPE_TABLE, SHAPE_HAND, self._object_column]
        launch(
            restitution_kernel,
            self._geom_kind.shape,
            [self._nominal, *kinds, BOUNCE_THRESHOLD, LOWEST_RATIO, joint_qd, *self.stateful().values()],
            [self._solref],
        )

    def stateful(self) -> dict[str, wp.array]:
        """Arrays to save with a checkpoint."""
        return {
            "hand_restitution": self.hand,
            "object_restitution": self.object,
            "table_restitution": self.table,
        }
