"""The engines that step the physics of a Newton model: MuJoCo Warp, and MuJoCo's own in C.

Newton translates in both: its state, controls and model into MuJoCo's arrays, and the state back. What lies
between is one method, and all else reads those arrays, whichever engine filled them.
"""

import math
import os
from collections.abc import Iterable
from dataclasses import fields
from functools import partial
from typing import Any

import mujoco
import newton
import numpy as np
import warp as wp
from mujoco.batch import MODEL_FIELDS, Batch
from newton.solvers import SolverMuJoCo

from vd.sim.cfg import CONE, IMPRATIO, JACOBIAN, TOLERANCE, SimCfg

# Work space of convex pairs (5 kB each) is shared by all worlds; few worlds have no average to rely on:
# 60 of objects wedged between the fingers filled three for each (our choice).
FEWEST_CONVEX_PAIRS = 1024

# Convex parts of an object up to which sim.nconmax and sim.nccdmax are as they are set: one of 32 parts
# touches table and fingers at 25 places, one of 8 at 9.
USUAL_PARTS = 8
# Constraint rows for each part more that any world's object has: a dish of 32 took 170 within 10 s.
ROWS_A_PART = 8

STATE = ("qpos", "qvel", "qacc_warmstart")
INPUTS = ("ctrl", "qfrc_applied", "xfrc_applied")
DRIVES = ("actuator_gainprm", "actuator_biasprm", "dof_frictionloss", "dof_solref", "dof_solimp")
"""What :class:`vd.sim.actuators.JointServo` writes into the model in every physics step."""


class WarpSolver(SolverMuJoCo):
    """MuJoCo Warp."""

    captured = True
    """Whether a step is device work alone, which a graph replays."""

    def publish_contacts(self) -> None:
        """Have the contacts of the last step, with their normal forces, in ``mjw_data``: they are there."""


class CSolver(WarpSolver):
    """MuJoCo's own engine, in double precision, with one simulation for each world.

    MuJoCo Warp's arrays stay what everything reads and writes; on a CPU they are the host's.
    """

    captured = False

    def __init__(self, model: newton.Model, physics_dt: float, **settings: Any):
        """Take over what Newton has made; arguments as of :class:`SolverMuJoCo`, and the physics step [s].

        Raises:
            ValueError: The model is not on the CPU.
        """
        if model.device.is_cuda:
            raise ValueError(
                f"sim.engine = mujoco steps on the CPU, not on {model.device}; give --device cpu"
            )
        self._model_changed = True
        super().__init__(model, **settings)
        template, shapes = self.mj_model, self.mjc_geom_to_newton_shape.numpy()
        template.opt.timestep = physics_dt
        template.opt.jacobian = mujoco.mjtJacobian.mjJAC_AUTO  # dense: faster on a CPU
        # A state that is not finite is for the guard to see.
        template.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        # What was compiled of hulls fits the first world's object: the tree of their bounds, and their graphs,
        # which the hulls of other objects lack. Without, all of their corners are looked at.
        template.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
        template.mesh_graphadr[:] = -1
        self._batch = Batch(template, len(shapes), nthread=threads(), persistent=True)
        for mask in ("geom_contype", "geom_conaffinity"):
            self._batch.expand(mask)[shapes < 0] = 0
        self._fixed = template.geom_bodyid == 0
        self._scratch = mujoco.MjData(template)

    def notify_model_changed(self, flags: newton.ModelFlags | int) -> None:
        """As of SolverMuJoCo."""
        super().notify_model_changed(flags)
        self._model_changed = True

    def _mujoco_warp_step(self) -> None:
        """In place of Newton's method of this name: one step of all worlds, from its arrays into them."""
        batch, data = self._batch, self.mjw_data
        self._copy_model(DRIVES)
        if self._model_changed:
            everything = [field.name for field in fields(self.mjw_model) if field.name in MODEL_FIELDS]
            self._copy_model(everything)
            batch.set_const()
            self._copy_model(everything)  # bounds of hulls are those of the first world's again
            # Tables are moved: their place counts, also if it was that of their body when this was computed.
            batch.expand("geom_sameframe")[:, self._fixed] = 0
            self._model_changed = False
        batch.expand("geom_pos")[:, self._fixed] = data.geom_xpos.numpy()[:, self._fixed]
        for name in (*STATE, *INPUTS):
            batch.bind(name)[:] = getattr(data, name).numpy()
        batch.step()
        for name in (*STATE, "qfrc_actuator"):
            getattr(data, name).numpy()[:] = batch.bind(name)

    def _copy_model(self, names: Iterable[str]) -> None:
        """Copy fields that MuJoCo Warp has for each world; all others are as they were exported."""
        for name in names:
            ours, exported = getattr(self.mjw_model, name), getattr(self.mj_model, name)
            values = ours.numpy() if isinstance(ours, wp.array) else np.empty(0)
            if exported.size and len(values) in (1, self._batch.nsim) and values[0].size == exported.size:
                copied = self._batch.expand(name)
                copied[:] = values.reshape((len(values), *copied.shape[1:]))

    def publish_contacts(self) -> None:
        """Have the contacts of the last step, with their normal forces, in ``mjw_data``."""
        contact, found = self.mjw_data.contact, 0
        for world in range(self._batch.nsim):
            data = self._batch.get_data(world, self._scratch)
            rows = data.contact.efc_address
            active = rows >= 0
            place = np.arange(active.sum())
            end = found + len(place)
            self.mjw_data.efc.force.numpy()[world, place] = data.efc_force[rows[active]]
            contact.efc_address.numpy()[found:end, 0] = place
            contact.geom.numpy()[found:end] = data.contact.geom[active]
            contact.worldid.numpy()[found:end] = world
            found = end
        self.mjw_data.nacon.fill_(found)


def threads() -> int:
    """Threads that step worlds: the CPUs of this process, or what OMP_NUM_THREADS says."""
    return int(os.environ.get("OMP_NUM_THREADS") or len(os.sched_getaffinity(0)))


def make_solver(model: newton.Model, cfg: SimCfg) -> WarpSolver:
    """The solver of ``sim.engine`` with the project's settings.

    Overflow is left to the guards, which need no prints. Room for contacts, which worlds share, grows with
    the convex parts of a world on average; that for constraint rows, which each has for itself, with the most
    parts of any.

    Raises:
        ValueError: The engine does not run on the device of the model.
    """
    convex = model.shape_type.numpy() == newton.GeoType.CONVEX_MESH
    parts = np.bincount(model.shape_world.numpy()[convex], minlength=model.world_count)
    room = max(1.0, parts.mean() / USUAL_PARTS)
    rows = cfg.njmax + ROWS_A_PART * max(0, int(parts.max()) - USUAL_PARTS)
    engine = WarpSolver if cfg.engine == "newton" else partial(CSolver, physics_dt=cfg.physics_dt)
    solver = engine(
        model,
        solver="newton",
        integrator="implicitfast",
        cone=CONE,
        impratio=IMPRATIO,
        iterations=cfg.iterations,
        ls_iterations=cfg.ls_iterations,
        tolerance=TOLERANCE,
        jacobian=JACOBIAN,
        njmax=rows,
        nconmax=math.ceil(room * cfg.nconmax),
        enable_multiccd=False,  # the table is a plane, whose contacts are exact, and fingertips are round
        kinematic_switchable_roots=False,
    )
    solver.mjw_model.opt.warn_overflow = False
    # The solver would take one for each contact, and has no argument for it.
    solver.mjw_data.naccdmax = max(math.ceil(room * cfg.nccdmax) * model.world_count, FEWEST_CONVEX_PAIRS)
    return solver
