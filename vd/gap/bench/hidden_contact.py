"""An object on a table in MuJoCo's own engine.

Slid, pushed, pressed, dropped, seen by an imperfect tracker.

It shares nothing with the analysis (:mod:`vd.gap.contact`), which simulates nothing. World frame: z
up, the table's top at z = 0; SI units, quaternions xyzw.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.objects.contact_layer import CONTACT, contact_of, damping_ratio
from vd.assets_usd.objects.model import ObjectModel
from vd.command.files import write_json
from vd.gap.bench.hidden_finger import GRAVITY_M_S2
from vd.gap.bench.hide import truth_path
from vd.logs.contact_recording import ContactMotion, Kind, write_contact_recording

OUTSIDE = {
    "speed_friction": "table_friction",
    "stiffening_tip": "tip_compliance",
    "tilted_table": "table_friction",
}
"""Causes that no parameter describes, and the parameter that is nearest: friction that grows with
the speed, a tip that stiffens, a table that is not level."""
CONTACT_RATE = 800.0
"""Natural frequency of the table's contact [rad/s]: an impact lasts 4 ms."""
TIP_KG = 0.01
"""Mass of the pusher [kg]."""
TIP_RADIUS_M = 0.008
"""Radius of the pusher [m]."""
TIP_DAMPING = 0.3
"""Damping ratio of the pusher on its spring."""
RIGID_N_M = 2.0e4
"""Stiffness of a pusher without compliance [N/m]: no real one is rigid."""
CORNER_M = 2.0e-4
"""Radius of an object's corners [m]."""
PUSH_OFF_S = 0.15
"""Time in which a hand brings an object to its speed [s]."""
COUNTS: Mapping[Kind, int] = {"drop": 12, "slide": 8, "push": 8, "press": 6}
"""Motions of a recording."""

Truth = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""A motion as it is: time [T], pose [T, 7], pusher [T, 3], its force [T, 3]."""
Way = Callable[[float], np.ndarray]
"""Position of the pusher's rigid part over time [3]."""


@dataclass(frozen=True)
class ContactPlant:
    """What the table, the object and the finger are.

    Attributes:
        item: The object as its file has it.
        values: What differs, by names of :data:`vd.assets_usd.objects.contact_layer.CONTACT`.
        outside: Causes of :data:`OUTSIDE` by name, with their size.
        seed: Of motions, solver and tracker.
    """

    item: ObjectModel
    values: Mapping[str, Any] = field(default_factory=dict)
    outside: Mapping[str, float] = field(default_factory=dict)
    seed: int = 0

    def value(self, name: str) -> Any:
        """A parameter, a number or three of them."""
        nominal = contact_of(self.item, name).tolist()
        value = self.values.get(name, nominal if len(nominal) > 1 else nominal[0])
        return value + 1.0 / RIGID_N_M if name == "tip_compliance" else value


SCENE = """
<mujoco>
  <option timestep="{step}" integrator="{integrator}" gravity="{gravity}"/>
  <asset>{meshes}</asset>
  <worldbody>
    <geom name="table" type="plane" size="2 2 0.1" contype="0" conaffinity="0"/>
    <body name="object">
      <freejoint/>
      <inertial pos="{centre}" quat="{axes}" mass="{mass}" diaginertia="{inertia}"/>
      {geoms}
    </body>
    {tip}
  </worldbody>
  <contact>{pairs}</contact>
</mujoco>
"""
"""The object on the table: hulls for the finger, a small sphere at each corner for the table. Between
a mesh and a plane MuJoCo finds three contacts, on which a cube rocks."""
TIP = f"""
    <body name="tip" gravcomp="1">
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 1 0"/>
      <joint type="slide" axis="0 0 1"/>
      <geom type="sphere" size="{TIP_RADIUS_M}" mass="{TIP_KG}" contype="0" priority="2"
            solref="0.002 1" solimp="0.99 0.999 0.001 0.5 2"/>
    </body>
"""
"""The pusher."""
HULL = """
      <geom type="mesh" mesh="hull_{0}" contype="1" conaffinity="0"/>
"""
CORNER = """
      <geom name="corner_{0}" type="sphere" size="{1}" pos="{2}" contype="0" conaffinity="0"/>
"""
PAIR = """
    <pair geom1="table" geom2="corner_{0}" condim="1" solref="{1}" solimp="0.999 0.999 0.001 0.5 2"/>
"""


def _text(values: Any) -> str:
    """Numbers as MuJoCo's files have them."""
    return " ".join(map(str, np.ravel(values).tolist()))


class World:
    """The compiled scene of one motion, and what happens in it step by step."""

    def __init__(self, plant: ContactPlant, rng: np.random.Generator, *, finger: bool):
        self.friction = plant.value("table_friction")
        outside = plant.outside
        self.speed_friction = outside.get("speed_friction", 0.0)
        self.stiffening = outside.get("stiffening_tip", 0.0)
        self.stiffness = 1.0 / plant.value("tip_compliance")
        self.damping = 2.0 * TIP_DAMPING * math.sqrt(self.stiffness * TIP_KG)
        self.step = float(rng.choice([4.0e-4, 5.0e-4]))
        item = plant.item
        mass = plant.value("mass")
        tilt = outside.get("tilted_table", 0.0)
        meshes = ""
        geoms = ""
        points = []
        for i, (vertices, faces) in enumerate(item.hulls):
            points.append(vertices)
            meshes += f'<mesh name="hull_{i}" vertex="{_text(vertices)}" face="{_text(faces)}"/>'
            geoms += HULL.format(i)
        self.corners = np.unique(np.concatenate(points), axis=0)
        ratio = damping_ratio(plant.value("restitution"))
        bounce = _text([1.0 / (ratio * CONTACT_RATE), ratio])
        pairs = ""
        for i, corner in enumerate(self.corners):
            geoms += CORNER.format(i, CORNER_M, _text(corner))
            pairs += PAIR.format(i, bounce)
        scene = SCENE.format(
            step=self.step,
            integrator=rng.choice(["Euler", "implicitfast"]),
            gravity=_text(GRAVITY_M_S2 * np.array([math.sin(tilt), 0.0, -math.cos(tilt)])),
            meshes=meshes,
            centre=_text(plant.value("centre_of_mass")),
            axes=_text(np.roll(item.inertia_quat, 1)),
            mass=mass,
            inertia=_text(item.inertia * mass / item.mass_kg),
            geoms=geoms,
            tip=TIP if finger else "",
            pairs=pairs,
        )
        self.model = mujoco.MjModel.from_xml_string(scene)
        self.data = mujoco.MjData(self.model)
        self._first_corner = int(self.model.geom("corner_0").id)
        self.carriage = np.zeros(3)

    def place(
        self, position: np.ndarray, rotation: Rotation, velocity: np.ndarray, spin: np.ndarray
    ) -> None:
        """Put the object; velocity of its frame and spin in the world frame."""
        self.data.qpos[:7] = [*position, *np.roll(rotation.as_quat(), 1)]
        self.data.qvel[:6] = [*velocity, *rotation.inv().apply(spin)]
        mujoco.mj_forward(self.model, self.data)

    def run(self, seconds: float, way: Way | None = None, hand: np.ndarray | None = None) -> Truth:
        """Steps with the pusher's rigid part on its way, or a hand's wrench [6] during PUSH_OFF_S."""
        rows = []
        data = self.data
        if way is not None:
            self.carriage = data.qpos[7:10] = way(0.0)
        for i in range(round(seconds / self.step)):
            if hand is not None:
                data.xfrc_applied[1] = hand * (i * self.step < PUSH_OFF_S)
            data.qfrc_applied[:] = 0.0
            self._slip()
            force = np.zeros(3) if way is None else self._pull(way(i * self.step))
            x, y, z, *turn = data.qpos[:7]
            rows.append([i * self.step, x, y, z, *np.roll(turn, -1), *self.carriage, *force])
            mujoco.mj_step(self.model, data)
        table = np.array(rows)
        return table[:, 0], table[:, 1:8], table[:, 8:11], table[:, 11:14]

    def _pull(self, carriage: np.ndarray) -> np.ndarray:
        """Move the rigid part of the pusher, whose spring pulls its tip; returns that force [N]."""
        stretch = carriage - self.data.qpos[7:10]
        stiffness = self.stiffness * (1.0 + self.stiffening * float(np.linalg.norm(stretch)))
        speed = (carriage - self.carriage) / self.step - self.data.qvel[6:9]
        self.data.qfrc_applied[6:9] += (force := stiffness * stretch + self.damping * speed)
        self.carriage = carriage
        return force

    def _slip(self) -> None:
        """Coulomb friction of the table at every corner that touches it, from the last step's normal forces.

        MuJoCo's own couples slip and gap: what slides fast hops, and slows down by up to a third
        less.
        """
        data = self.data
        touching = data.contact.geom1 == 0
        if not touching.any():
            return
        normal = data.efc_force[data.contact.efc_address[touching]]
        turn = data.xmat[1].reshape(3, 3)
        x, y, z = turn @ self.corners[data.contact.geom2[touching] - self._first_corner].T
        vx, vy, _ = data.qvel[:3]
        wx, wy, wz = turn @ data.qvel[3:6]
        slip = np.array([vx + wy * z - wz * y, vy + wz * x - wx * z])
        speed = np.sqrt((slip**2).sum(0)) + 1e-9
        size = self.friction * (1.0 + self.speed_friction * speed) * normal
        # What stops a quarter of the object within four steps is enough, and stable.
        size = np.minimum(size, 0.25 * self.model.body_mass[1] * speed / (4.0 * self.step))
        px, py = -slip * size / speed
        data.qfrc_applied[:2] += px.sum(), py.sum()
        data.qfrc_applied[3:6] += np.array([-(z @ py), z @ px, x @ py - y @ px]) @ turn


def _motion(plant: ContactPlant, kind: Kind, number: int, rng: np.random.Generator) -> Truth:
    """One motion of a kind as it truly is; every other drop is a toss."""
    world = World(plant, rng, finger=kind in ("push", "press"))
    low = world.corners[:, 2].min() - CORNER_M
    high = world.corners[:, 2].max()
    upright = Rotation.from_euler("z", rng.uniform(-math.pi, math.pi))
    if kind == "drop":
        return _drop(world, upright, rng, flat=number % 2 == 0)
    none = np.zeros(3)
    world.place(np.array([0.0, 0.0, -low]), upright, none, none)
    ahead = upright.apply([1.0, 0.0, 0.0])
    if kind == "slide":
        speed = rng.uniform(0.8, 1.6)
        mass = world.model.body_mass[1]
        inertia = world.model.body_inertia[1, 2]
        ahead = Rotation.from_euler("z", rng.uniform(-math.pi, math.pi)).apply(ahead)
        push = mass * (speed / PUSH_OFF_S + world.friction * GRAVITY_M_S2) * ahead
        twist = inertia * rng.normal(0.0, 0.5) / PUSH_OFF_S
        return world.run(0.6, hand=np.array([*push, 0.0, 0.0, twist]))
    if kind == "press":
        above = np.array([0.0, 0.0, high - low + TIP_RADIUS_M + 0.004])
        force = rng.uniform(3.0, 8.0)
        down = np.array([0.0, 0.0, 0.004 + force * plant.value("tip_compliance")])
        return world.run(0.6, lambda t: above - down * math.sin(math.pi * t / 0.6) ** 2)
    reach = float(np.linalg.norm(world.corners[:, :2], axis=1).max()) + TIP_RADIUS_M + 0.01
    behind = upright.apply([-reach, rng.normal(0.0, 0.002), 0.4 * (high - low)])
    speed = rng.uniform(0.08, 0.15)
    acceleration = rng.uniform(0.0, 0.3)
    return world.run(0.9, lambda t: behind + ahead * (speed * t + 0.5 * acceleration * t**2))


def _drop(world: World, upright: Rotation, rng: np.random.Generator, *, flat: bool) -> Truth:
    """Let go flat, or tossed with a spin.

    Before that a hand holds it, or brings it to its speed.
    """
    tilt = Rotation.from_rotvec(rng.normal(0.0, 0.02 if flat else 1.0, 3)) * upright
    place = np.array([0.0, 0.0, rng.uniform(0.15, 0.3) - tilt.apply(world.corners)[:, 2].min()])
    velocity = np.array([*rng.normal(0.0, 0.1, 2), 0.0 if flat else rng.uniform(0.8, 1.6)])
    spin = rng.normal(0.0, 0.1 if flat else 5.0, 3)
    world.place(place, tilt, velocity, spin)
    time, pose, _, _ = world.run(0.8)
    before = np.arange(0.0, PUSH_OFF_S, world.step)
    way = 0.5 * before**2 / PUSH_OFF_S - 0.5 * PUSH_OFF_S
    turned = Rotation.from_rotvec(np.outer(way, spin)) * tilt
    held = np.hstack([place + np.outer(way, velocity), turned.as_quat()])
    time = np.concatenate([before, time + PUSH_OFF_S])
    nothing = np.zeros((len(time), 3))
    return time, np.concatenate([held, pose]), nothing, nothing


class ImperfectTracker:
    """What is recorded of a motion, by one of the trackers that there are.

    Motion capture or a camera.
    """

    def __init__(self, rng: np.random.Generator):
        self._rng = rng
        self.rate = rng.uniform(100.0, 240.0)
        self.position_m = rng.uniform(1e-4, 6e-4)
        self.rotation_rad = rng.uniform(1e-3, 8e-3)
        self.late_s = rng.uniform(0.0, 1e-3)
        self.force_n = rng.uniform(0.005, 0.02)

    def see(self, truth: Truth, kind: Kind, file: str) -> ContactMotion:
        """States are late, some by a frame, and stamped with when they were asked for.

        Some are missing.
        """
        rng = self._rng
        time, pose, pusher, force = truth
        asked = np.arange(0.0, time[-1], 1.0 / self.rate)
        asked = asked[rng.uniform(size=len(asked)) > 0.02]
        late = rng.exponential(self.late_s, len(asked))
        late += (rng.uniform(size=len(asked)) < 1 / 30) / self.rate
        at = np.searchsorted(time, asked - late).clip(0, len(time) - 1)

        def noisy(values: np.ndarray, deviation: float) -> np.ndarray:
            return values[at, :3] + rng.normal(0.0, deviation, (len(at), 3))

        turned = Rotation.from_rotvec(rng.normal(0.0, self.rotation_rad, (len(at), 3)))
        position = noisy(pose, self.position_m)
        rotation = turned * Rotation.from_quat(pose[at, 3:])
        bias = rng.normal(0.0, self.force_n / 3.0, 3)
        pusher = noisy(pusher, self.position_m)
        force = noisy(force, self.force_n) + bias
        if kind not in ("push", "press"):
            pusher = force = np.empty((0, 3))
        return ContactMotion(file, kind, asked, position, rotation, pusher, force)


def hide_contact(
    plant: ContactPlant, out: Path, counts: Mapping[Kind, int] = COUNTS
) -> dict[str, Any]:
    """Write a recording of a plant, and beside the folder what is hidden; returns that.

    Args:
        plant: The plant.
        out: Folder of the recording.
        counts: Motions of each kind.
    """
    rng = np.random.default_rng(plant.seed)
    tracker = ImperfectTracker(rng)
    motions = []
    for kind, count in counts.items():
        for i in range(count):
            truly = _motion(plant, kind, i, rng)
            motions.append(tracker.see(truly, kind, f"{kind}_{i}.csv"))
    write_contact_recording(out, motions)
    truth = {
        "object": plant.item.name,
        "hidden": [*plant.values, *plant.outside],
        "parameters": {name: np.atleast_1d(plant.value(name)).tolist() for name in CONTACT},
        "outside": dict(plant.outside),
        "seed": plant.seed,
    }
    write_json(truth_path(out), truth)
    return truth
