"""An object on a table in MuJoCo's own engine, pushed, pressed, dropped and seen by an imperfect tracker.

It shares no code with the analysis (:mod:`vd.gap.contact`), which integrates nothing. World frame: z up, the
table's top at z = 0; SI units, quaternions xyzw.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.objects.contact_layer import CONTACT
from vd.assets_usd.objects.model import ObjectModel
from vd.bench.hide import truth_path
from vd.files import write_json
from vd.gap.contact_recording import ContactMotion, Kind, write_contact_recording
from vd.sim.scene import damping_ratio

OUTSIDE = {"speed_friction": "coefficient", "stiffening_tip": "coefficient", "tilted_table": "angle"}
"""Causes that no parameter describes: friction that grows with speed, a tip that stiffens, a table not level."""
CONTACT_RATE = 800.0
"""Natural frequency of the table's contact [rad/s]: an impact lasts some milliseconds."""
TIP_KG, TIP_RADIUS_M, TIP_DAMPING = 0.01, 0.008, 0.3
"""Pusher: its mass, radius, and damping ratio on its spring."""
PUSH_OFF_S = 0.15
"""Time in which a hand brings a sliding object to its speed [s]."""
CORNER_M = 2.0e-4
"""Radius of an object's corners [m]."""
RIGID_N_M = 2.0e4
"""Stiffness of a pusher without compliance [N/m]."""
COUNTS: Mapping[Kind, int] = {"drop": 12, "slide": 8, "push": 6, "press": 6}
"""Motions of a recording."""


@dataclass(frozen=True)
class ContactPlant:
    """What the table, the object and the finger are, and how they are seen.

    Attributes:
        item: The object as its file has it.
        values: Parameters of :data:`vd.assets_usd.objects.contact_layer.CONTACT` that differ from the nominal.
        outside: Causes of :data:`OUTSIDE` by name, with their size.
        seed: Of motions, solver and tracker.
    """

    item: ObjectModel
    values: Mapping[str, Any] = field(default_factory=dict)
    outside: Mapping[str, float] = field(default_factory=dict)
    seed: int = 0

    def value(self, name: str) -> Any:
        """A parameter, nominal where it is not hidden."""
        nominal = CONTACT[name].nominal
        return self.values.get(name, nominal if len(nominal) > 1 else nominal[0])

    @property
    def compliance(self) -> float:
        """Of the pusher [m/N]: no real one is rigid."""
        return float(self.value("tip_compliance")) + 1.0 / RIGID_N_M


class World:
    """The compiled scene of one motion, and what happens in it step by step."""

    def __init__(self, plant: ContactPlant, rng: np.random.Generator, *, finger: bool):
        item, spec = plant.item, mujoco.MjSpec()
        spec.option.timestep = rng.choice([4.0e-4, 5.0e-4])
        spec.option.integrator = rng.choice(
            [mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtIntegrator.mjINT_EULER]
        )
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        tilt = plant.outside.get("tilted_table", 0.0)
        spec.option.gravity = [9.81 * math.sin(tilt), 0.0, -9.81 * math.cos(tilt)]
        ratio = damping_ratio(plant.value("restitution"))
        self.friction = plant.value("table_friction")
        self.speed_friction = plant.outside.get("speed_friction", 0.0)
        self.stiffening = plant.outside.get("stiffening_tip", 0.0)
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(name="table", type=plane, size=[2.0, 2.0, 0.1], contype=0, conaffinity=0)
        body = spec.worldbody.add_body(name="object")
        body.add_freejoint()
        body.explicitinertial = True
        body.mass, body.ipos = plant.value("mass"), plant.value("centre_of_mass")
        x, y, z, w = item.inertia_quat
        body.inertia, body.iquat = item.inertia * plant.value("mass") / item.mass_kg, [w, x, y, z]
        for i, (vertices, faces) in enumerate(item.hulls):
            spec.add_mesh(name=f"hull_{i}", uservert=vertices.flatten(), userface=faces.flatten())
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"hull_{i}", contype=1, conaffinity=0)
        # Between a mesh and a plane MuJoCo finds three contacts, on which a cube rocks: every corner gets its own.
        self.corners = np.unique(np.concatenate([vertices for vertices, _ in item.hulls]), axis=0)
        for i, corner in enumerate(self.corners):
            name, size = f"corner_{i}", [CORNER_M, 0.0, 0.0]
            body.add_geom(
                name=name, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=size, pos=corner, contype=0, conaffinity=0
            )
            solref = [1.0 / (ratio * CONTACT_RATE), ratio]
            spec.add_pair(
                geomname1="table",
                geomname2=name,
                condim=1,
                solref=solref,
                solimp=[0.999, 0.999, 0.001, 0.5, 2.0],
            )
        if finger:
            tip = spec.worldbody.add_body(name="tip")
            for axis in np.eye(3):
                tip.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
            tip.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[TIP_RADIUS_M, 0, 0],
                mass=TIP_KG,
                contype=0,
                conaffinity=1,
                priority=2,
                friction=[0.9, 0.0, 0.0],
                solref=[0.002, 1.0],
                solimp=[0.99, 0.999, 1e-3, 0.5, 2.0],
            )
            tip.gravcomp = 1.0
        self.model = spec.compile()
        self._first_corner = int(self.model.geom("corner_0").id)
        self.data = mujoco.MjData(self.model)
        self.stiffness, self.step = 1.0 / plant.compliance, self.model.opt.timestep
        self.damping = 2.0 * TIP_DAMPING * math.sqrt(self.stiffness * TIP_KG)
        self.carriage = np.zeros(3)

    def place(self, position: np.ndarray, rotation: Rotation, velocity: np.ndarray, spin: np.ndarray) -> None:
        """Put the object; velocity of its frame and spin in the world frame."""
        x, y, z, w = rotation.as_quat()
        self.data.qpos[:7] = [*position, w, x, y, z]
        self.data.qvel[:6] = [*velocity, *rotation.inv().apply(spin)]
        mujoco.mj_forward(self.model, self.data)

    def put_tip(self, position: np.ndarray) -> None:
        """Put the pusher, at rest on its spring."""
        self.carriage = np.array(position, dtype=float)
        self.data.qpos[7:10] = position
        self.data.qvel[6:9] = 0.0

    def advance(self, carriage: np.ndarray | None) -> np.ndarray:
        """One step with the pusher's rigid part at a place; returns the spring's force on the tip [N]."""
        force = np.zeros(3)
        self.data.qfrc_applied[:] = 0.0
        self._slip()
        if carriage is not None:
            speed = (carriage - self.carriage) / self.step
            stretch = carriage - self.data.qpos[7:10]
            stiffness = self.stiffness * (1.0 + self.stiffening * float(np.linalg.norm(stretch)))
            force = stiffness * stretch + self.damping * (speed - self.data.qvel[6:9])
            self.data.qfrc_applied[6:9] += force
            self.carriage = carriage.copy()
        mujoco.mj_step(self.model, self.data)
        return force

    def _slip(self) -> None:
        """Coulomb friction of the table at every corner that touches it, from the last step's normal forces.

        MuJoCo's own couples slip and gap: what slides fast hops, and slows down by up to a third less.
        """
        data = self.data
        touching = data.contact.geom1 == 0
        if not touching.any():
            return
        normal = data.efc_force[data.contact.efc_address[touching]]
        turn = data.xmat[1].reshape(3, 3)
        x, y, z = turn @ self.corners[data.contact.geom2[touching] - self._first_corner].T
        (vx, vy, _), (wx, wy, wz) = data.qvel[:3], turn @ data.qvel[3:6]
        slip = np.array([vx + wy * z - wz * y, vy + wz * x - wx * z])
        speed = np.sqrt((slip**2).sum(0)) + 1e-9
        size = self.friction * (1.0 + self.speed_friction * speed) * normal
        # What stops a quarter of the object within four steps is enough, and stable.
        size = np.minimum(size, 0.25 * self.model.body_mass[1] * speed / (4.0 * self.step))
        px, py = -slip * size / speed
        data.qfrc_applied[:2] += px.sum(), py.sum()
        data.qfrc_applied[3:6] += np.array([-(z @ py), z @ px, x @ py - y @ px]) @ turn


Path3 = Callable[[float], np.ndarray]


def _run(
    world: World, seconds: float, carriage: Path3 | None, hand: np.ndarray | None = None
) -> tuple[np.ndarray, ...]:
    """True time, pose [T, 7] xyzw, pusher and force of every step; a hand's wrench [6] ends after PUSH_OFF_S."""
    rows = []
    for i in range(round(seconds / world.step)):
        if hand is not None:
            world.data.xfrc_applied[1] = hand * (i * world.step < PUSH_OFF_S)
        at = None if carriage is None else carriage(i * world.step)
        pose = world.data.qpos[:7].copy()
        force = world.advance(at)
        rows.append(np.concatenate([[i * world.step], pose[:3], pose[[4, 5, 6, 3]], world.carriage, force]))
    table = np.array(rows)
    return table[:, 0], table[:, 1:8], table[:, 8:11], table[:, 11:14]


def _motion(plant: ContactPlant, kind: Kind, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """One motion of a kind as it truly is."""
    lowest = min(float(vertices[:, 2].min()) for vertices, _ in plant.item.hulls)
    highest = max(float(vertices[:, 2].max()) for vertices, _ in plant.item.hulls)
    upright = Rotation.from_euler("z", rng.uniform(-math.pi, math.pi))
    heading = rng.uniform(-math.pi, math.pi)
    ahead = np.array([math.cos(heading), math.sin(heading), 0.0])
    rest, none = np.array([0.0, 0.0, -lowest + 2e-4]), np.zeros(3)
    world = World(plant, rng, finger=kind in ("push", "press"))
    if kind == "drop":
        return _drop(world, plant.item, upright, rng)
    if kind == "slide":
        world.place(rest, upright, none, none)
        # A hand brings it to its speed: MuJoCo lets what is thrown onto the table hop.
        speed = rng.uniform(0.8, 1.6)
        force = world.model.body_mass[1] * (speed / PUSH_OFF_S + world.friction * 9.81) * ahead
        spin = rng.normal(0.0, 0.5)
        return _run(
            world,
            0.9,
            None,
            hand=np.array([*force, 0.0, 0.0, world.model.body_inertia[1, 2] * spin / PUSH_OFF_S]),
        )
    world.place(rest, upright, none, none)
    if kind == "press":
        start, depth = np.array([0.0, 0.0, highest - lowest + TIP_RADIUS_M + 0.004]), rng.uniform(3.0, 8.0)
        travel = 0.004 + depth * plant.compliance
        world.put_tip(start)
        return _run(world, 1.0, lambda t: start - np.array([0, 0, travel * math.sin(math.pi * t) ** 2]))
    reach = (
        max(float(np.linalg.norm(v[:, :2], axis=1).max()) for v, _ in plant.item.hulls) + TIP_RADIUS_M + 0.01
    )
    face = upright.apply([1.0, 0.0, 0.0])
    start = np.array([0.0, 0.0, 0.4 * (highest - lowest)]) - face * reach
    start += upright.apply([0.0, rng.normal(0.0, 0.002), 0.0])
    world.put_tip(start)
    speed, acceleration = rng.uniform(0.08, 0.15), rng.uniform(0.0, 0.3)
    return _run(world, 1.0, lambda t: start + face * (speed * t + 0.5 * acceleration * t**2))


def _drop(
    world: World, item: ObjectModel, upright: Rotation, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Let go flat, or tossed with a spin; before that a hand holds it, or brings it to its speed."""
    flat = rng.uniform() < 0.5
    tilt = Rotation.from_rotvec(rng.normal(0.0, 0.02 if flat else 1.0, 3)) * upright
    under = tilt.apply(np.concatenate([vertices for vertices, _ in item.hulls]))[:, 2].min()
    place = np.array([0.0, 0.0, rng.uniform(0.15, 0.3) - under])
    velocity = np.array([*rng.normal(0.0, 0.1, 2), 0.0 if flat else rng.uniform(0.8, 1.6)])
    spin = rng.normal(0.0, 0.1 if flat else 5.0, 3)
    world.place(place, tilt, velocity, spin)
    time, pose, pusher, force = _run(world, 1.0, None)
    before = np.arange(0.0, PUSH_OFF_S, world.step)
    way = 0.5 * before**2 / PUSH_OFF_S - 0.5 * PUSH_OFF_S
    turns = (Rotation.from_rotvec(np.outer(way, spin)) * tilt).as_quat()
    held = np.hstack([place + np.outer(way, velocity), turns])
    nothing = np.zeros((len(before), 3))
    return (
        np.concatenate([before, time + PUSH_OFF_S]),
        np.concatenate([held, pose]),
        np.concatenate([nothing, pusher]),
        np.concatenate([nothing, force]),
    )


@dataclass(frozen=True)
class Tracker:
    """Errors of what is recorded, drawn for a recording.

    Attributes:
        rate: Samples a second [Hz].
        position_m, rotation_rad: Standard deviations of the pose.
        late_s: Mean lateness of a sample, exponential [s]; every 30th is a frame late.
        force_n: Standard deviation of the force; its bias is a third of that.
    """

    rate: float
    position_m: float
    rotation_rad: float
    late_s: float
    force_n: float

    @staticmethod
    def draw(rng: np.random.Generator) -> "Tracker":
        """One of those that there are, from motion capture to a camera with markers."""
        return Tracker(
            rng.uniform(100.0, 240.0),
            rng.uniform(1e-4, 6e-4),
            rng.uniform(1e-3, 8e-3),
            rng.uniform(0.0, 1e-3),
            rng.uniform(0.005, 0.02),
        )

    def see(
        self, truth: tuple[np.ndarray, ...], kind: Kind, file: str, rng: np.random.Generator
    ) -> ContactMotion:
        """A motion as it is recorded: a state is taken late, and stamped with the time it was asked for."""
        time, pose, pusher, force = truth
        asked = np.arange(0.0, time[-1], 1.0 / self.rate)
        asked = asked[rng.uniform(size=len(asked)) > 0.02]
        late = rng.exponential(self.late_s, len(asked)) + (rng.uniform(size=len(asked)) < 1 / 30) / self.rate
        index = np.searchsorted(time, asked - late).clip(0, len(time) - 1)
        noise = Rotation.from_rotvec(rng.normal(0.0, self.rotation_rad, (len(index), 3)))
        measured = kind in ("push", "press")
        bias = rng.normal(0.0, self.force_n / 3.0, 3)
        return ContactMotion(
            file,
            kind,
            asked,
            pose[index, :3] + rng.normal(0.0, self.position_m, (len(index), 3)),
            noise * Rotation.from_quat(pose[index, 3:]),
            pusher[index] + rng.normal(0.0, self.position_m, (len(index), 3))
            if measured
            else np.empty((0, 3)),
            force[index] + bias + rng.normal(0.0, self.force_n, (len(index), 3))
            if measured
            else np.empty((0, 3)),
        )


def hide_contact(plant: ContactPlant, out: Path, counts: Mapping[Kind, int] = COUNTS) -> dict[str, Any]:
    """Write a recording of a plant, and beside the folder what is hidden; returns that.

    Args:
        plant: The plant.
        out: Folder of the recording.
        counts: Motions of each kind.
    """
    rng = np.random.default_rng(plant.seed)
    tracker = Tracker.draw(rng)
    motions = [
        tracker.see(_motion(plant, kind, rng), kind, f"{kind}_{i}.csv", rng)
        for kind, count in counts.items()
        for i in range(count)
    ]
    write_contact_recording(out, motions)
    truth = {
        "object": plant.item.name,
        "hidden": [*plant.values, *plant.outside],
        "parameters": {name: np.array(plant.value(name)).tolist() for name in CONTACT}
        | {"tip_compliance": plant.compliance},
        "outside": dict(plant.outside),
        "seed": plant.seed,
    }
    write_json(truth_path(out), truth)
    return truth
