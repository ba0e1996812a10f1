"""The engines that step the physics of a Newton model: MuJoCo Warp, and MuJoCo's own in C.

Newton translates in both: its state, controls and model into MuJoCo's arrays, and the state back.
What lies between is one method, and all else reads those arrays, whichever engine filled them.
"""

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import fields
from functools import partial
from typing import Any

import mujoco
import newton
import numpy as np
import warp as wp
from mujoco.batch import MODEL_FIELDS, Batch
from newton.solvers import SolverMuJoCo

from vd.kernels.inverse_weights import LEAST_LEVER_M, inverse_weights_kernel
from vd.kernels.launch import launch
from vd.sim.cfg import CONE, IMPRATIO, JACOBIAN, TOLERANCE, SimCfg

# Work space of convex pairs (5 kB each) is shared by all worlds; few worlds have no average to rely
# on: 60 of objects wedged between the fingers filled three for each (our choice).
FEWEST_CONVEX_PAIRS = 1024

# Convex parts of an object up to which sim.nconmax and sim.nccdmax are as they are set: one of 32
# parts touches table and fingers at 25 places, one of 8 at 9.
USUAL_PARTS = 8
# Constraint rows for each part more that any world's object has: a dish of 32 took 170 within 10 s.
ROWS_A_PART = 8

STATE = ("qpos", "qvel", "qacc_warmstart")
INPUTS = ("ctrl", "qfrc_applied", "xfrc_applied")
DRIVES = ("actuator_gainprm", "actuator_biasprm", "dof_frictionloss", "dof_solref", "dof_solimp")
"""What :class:`vd.sim.joint_servo.JointServo` writes into the model in every physics step."""


class WarpSolver(SolverMuJoCo):
    """MuJoCo Warp."""

    captured = True
    """Whether a step is device work alone, which a graph replays."""

    def notify_model_changed(self, flags: newton.ModelFlags | int) -> None:
        """As of SolverMuJoCo, without inverse weights that are rounding errors."""
        super().notify_model_changed(flags)
        weights = self.mjw_model.body_invweight0
        launch(inverse_weights_kernel, weights.shape, [], [weights])

    def publish_contacts(self) -> None:
        """Have the contacts of the last step, with their normal forces, in ``mjw_data``.

        They are there.
        """


class CSolver(WarpSolver):
    """MuJoCo's own engine, in double precision.

    MuJoCo Warp's arrays stay what everything reads and writes; on a CPU they are the host's.
    """

    captured = False

    def __init__(
        self,
        model: newton.Model,
        worlds: Sequence[tuple[newton.ModelBuilder, int]],
        physics_dt: float,
        **settings: Any,
    ):
        """Have each kind of world compiled by MuJoCo.

        Args:
            model: The model of all worlds.
            worlds: Runs of equal worlds in their order: what builds one of them, and how many they
                are.
            physics_dt: Physics step [s].
            settings: Of :class:`SolverMuJoCo`.

        Raises:
            ValueError: The model is not on the CPU.
        """
        if model.device.is_cuda:
            raise ValueError(
                f"sim.engine = mujoco steps on the CPU, not on {model.device}; give --device cpu"
            )
        self._model_changed = True
        super().__init__(model, **settings)
        shapes = self.mjc_geom_to_newton_shape.numpy()
        first = 0
        self._runs = []
        for builder, count in worlds:
            one = newton.ModelBuilder()
            one.replicate(builder, 1)
            exported = WarpSolver(one.finalize(device="cpu"), **settings)
            exported.mj_model.opt.timestep = physics_dt
            begin = np.flatnonzero(model.shape_world.numpy() == first)[0]
            wanted = begin + exported.mjc_geom_to_newton_shape.numpy()[0]
            geoms = np.array([np.flatnonzero(shapes[first] == shape)[0] for shape in wanted])
            self._runs.append(_Run(exported.mj_model, slice(first, first + count), geoms))
            first += count

    def notify_model_changed(self, flags: newton.ModelFlags | int) -> None:
        """As of SolverMuJoCo."""
        super().notify_model_changed(flags)
        self._model_changed = True

    def _mujoco_warp_step(self) -> None:
        """In place of Newton's method of this name.

        One step of all worlds, from its arrays into them.
        """
        for run in self._runs:
            run.step(self.mjw_model, self.mjw_data, model_changed=self._model_changed)
        self._model_changed = False

    def publish_contacts(self) -> None:
        """Have the contacts of the last step, with their normal forces, in ``mjw_data``."""
        found = 0
        for run in self._runs:
            found = run.publish_contacts(self.mjw_data, found)
        self.mjw_data.nacon.fill_(found)


class _Run:
    """Equal worlds in MuJoCo.

    Those of ``rows`` of MuJoCo Warp's arrays, with those of its geoms.
    """

    def __init__(self, exported: mujoco.MjModel, rows: slice, geoms: np.ndarray):
        self._exported = exported
        self._rows = rows
        self._geoms = geoms
        self._worlds = rows.stop - rows.start
        exported.opt.jacobian = mujoco.mjtJacobian.mjJAC_AUTO  # dense: faster on a CPU
        # A state that is not finite is for the guard to see; bounding volumes do not follow centres
        # of mass.
        exported.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        exported.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
        self._batch = Batch(exported, self._worlds, nthread=threads(), persistent=True)
        self._fixed = np.flatnonzero(exported.geom_bodyid == 0)
        self._scratch = mujoco.MjData(exported)

    def step(self, model: Any, data: Any, *, model_changed: bool) -> None:
        """One step from MuJoCo Warp's arrays into them."""
        batch = self._batch
        rows = self._rows
        self._copy_model(model, DRIVES)
        if model_changed:
            self._copy_model(
                model, [field.name for field in fields(model) if field.name in MODEL_FIELDS]
            )
            batch.set_const()
            mend_weights(batch.expand("body_invweight0"))
            # Tables are moved: their place counts, also if it was that of their body when this was
            # computed.
            batch.expand("geom_sameframe")[:, self._fixed] = 0
        places = data.geom_xpos.numpy()[rows, self._geoms[self._fixed]]
        batch.expand("geom_pos")[:, self._fixed] = places
        for name in (*STATE, *INPUTS):
            batch.bind(name)[:] = getattr(data, name).numpy()[rows]
        batch.step()
        for name in (*STATE, "qfrc_actuator"):
            getattr(data, name).numpy()[rows] = batch.bind(name)

    def _copy_model(self, model: Any, names: Iterable[str]) -> None:
        """Copy numbers that MuJoCo Warp has for each world.

        All others are as they were exported.
        """
        for name in names:
            ours = getattr(model, name)
            exported = getattr(self._exported, name)
            if not exported.size or not isinstance(ours, wp.array) or ours.dtype is wp.int32:
                continue
            values = ours.numpy()
            if values.ndim > exported.ndim and len(values) >= self._rows.stop:
                values = values[self._rows]
                if name.startswith("geom_"):
                    values = values[:, self._geoms]
                self._batch.expand(name)[:] = values.reshape((self._worlds, *exported.shape))

    def publish_contacts(self, data: Any, found: int) -> int:
        """Write contacts behind those already ``found``; returns how many there are then."""
        contact = data.contact
        for world in range(self._worlds):
            own = self._batch.get_data(world, self._scratch)
            active = own.contact.efc_address >= 0
            place = np.arange(active.sum())
            end = found + len(place)
            forces = own.efc_force[own.contact.efc_address[active]]
            data.efc.force.numpy()[self._rows.start + world, place] = forces
            contact.efc_address.numpy()[found:end, 0] = place
            contact.geom.numpy()[found:end] = self._geoms[own.contact.geom[active]]
            contact.worldid.numpy()[found:end] = self._rows.start + world
            found = end
        return found


def mend_weights(weights: np.ndarray) -> None:
    """:func:`inverse_weights_kernel` for MuJoCo's arrays, in place; shape [N, B, 2]."""
    lost = weights[..., 0] < LEAST_LEVER_M**2 * weights[..., 1]
    weights[lost, 0] = weights[lost, 1]


def threads() -> int:
    """Threads that step worlds: the CPUs of this process, or what OMP_NUM_THREADS says."""
    return int(os.environ.get("OMP_NUM_THREADS") or len(os.sched_getaffinity(0)))


def make_solver(
    model: newton.Model, cfg: SimCfg, worlds: Sequence[tuple[newton.ModelBuilder, int]] = ()
) -> WarpSolver:
    """The solver of ``sim.engine`` with the project's settings.

    Overflow is left to the guards, which need no prints. Room for contacts, which worlds share,
    grows with the convex parts of a world on average; that for constraint rows, which each has for
    itself, with the most parts of any.

    Raises:
        ValueError: The engine does not run on the device of the model.
    """
    convex = model.shape_type.numpy() == newton.GeoType.CONVEX_MESH
    parts = np.bincount(model.shape_world.numpy()[convex], minlength=model.world_count)
    room = max(1.0, parts.mean() / USUAL_PARTS)
    rows = cfg.njmax + ROWS_A_PART * max(0, int(parts.max()) - USUAL_PARTS)
    engine = (
        WarpSolver
        if cfg.engine == "newton"
        else partial(CSolver, worlds=worlds, physics_dt=cfg.physics_dt)
    )
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
    solver.mjw_data.naccdmax = max(
        math.ceil(room * cfg.nccdmax) * model.world_count, FEWEST_CONVEX_PAIRS
    )
    return solver
