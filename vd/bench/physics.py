"""``vd-bench physics``: does the simulated contact behave as the world does?

Small scenes with the project's contact settings and nothing else: objects dropped on the table, a box
sliding to a stop, a cube held between fingertips, a free fall. SI units, world frame, z up.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import newton
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from vd.assets_usd.objects.model import ObjectModel
from vd.paper import PAPER
from vd.sim.cfg import SimCfg
from vd.sim.restitution import Restitution
from vd.sim.scene import (
    CONDIM_TORSIONAL,
    PRIORITY_HAND,
    PRIORITY_OBJECT,
    SHAPE_OBJECT,
    SHAPE_TABLE,
    add_object,
    add_table,
    contact_attributes,
    new_builder,
    shape_cfg,
)
from vd.sim.simulator import make_solver

GRAVITY = 9.81
"""Newton's default gravity [m/s^2]."""
FINGERTIP_RADIUS_M = 0.0101
"""Radius of the D'Claw's fingertip, for the stand-in fingers of the pinch."""
FINGER_MASS_KG = 0.1
"""Mass of a stand-in finger: about what a D'Claw finger weighs at its tip."""
REST_SPIN, REST_SPEED = 0.01, 1e-3
"""An object rests below these [rad/s], [m/s]."""
BALL_RADIUS_M = 0.03
"""Radius of the ball that is dropped."""
DROP_HEIGHTS_M = tuple(float(h) for h in np.linspace(0.03, 0.3, 25))
"""It meets the table at 0.77 to 2.4 m/s, and between two physics steps at many moments."""


class SmallScene:
    """A model stepped on its own, with contact distances read from the solver."""

    def __init__(self, builder: newton.ModelBuilder, cfg: SimCfg, device: str):
        """Finalize ``builder`` and make the solver."""
        self.model = builder.finalize(device=device)
        self.cfg, self.device = cfg, device
        self.solver = make_solver(self.model, cfg)
        self.state, self._next = self.model.state(), self.model.state()
        self.control = self.model.control()
        self.restitution: Restitution | None = None
        """As the simulator's; None: contacts without."""
        newton.eval_fk(self.model, self.state.joint_q, self.state.joint_qd, self.state)

    def run(self, seconds: float) -> None:
        """Step for ``seconds``."""
        for _ in range(round(seconds * self.cfg.physics_hz)):
            if self.restitution is not None:
                self.restitution.apply(self.state.joint_qd.reshape((self.model.world_count, -1)))
            self.solver.step(self.state, self._next, self.control, None, self.cfg.physics_dt)
            self.state, self._next = self._next, self.state

    def set_restitution(self, restitution: float) -> None:
        """Let the first body bounce on what is fixed, with this coefficient of both."""
        shapes = self.solver.mjc_geom_to_newton_shape.numpy()
        fixed = self.model.shape_body.numpy()[shapes] < 0
        kind = wp.array(np.where(fixed, SHAPE_TABLE, SHAPE_OBJECT), dtype=wp.int32, device=self.device)
        self.restitution = Restitution(self.solver, kind, 0)
        self.restitution.object.fill_(restitution)
        self.restitution.table.fill_(restitution)

    def deepest(self) -> np.ndarray:
        """Deepest penetration of any contact in each world [m], shape [N]."""
        data = self.solver.mjw_data
        count = int(data.nacon.numpy()[0])
        deepest = np.zeros(data.nworld)
        depth = -data.contact.dist.numpy()[:count]
        np.maximum.at(deepest, data.contact.worldid.numpy()[:count], depth)
        return deepest

    def body(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Poses [N, 7] and velocities [N, 6] (linear, angular) of a body of every world."""
        n = self.model.world_count
        pose = self.state.body_q.numpy().reshape(n, -1, 7)[:, index]
        velocity = self.state.body_qd.numpy().reshape(n, -1, 6)[:, index]
        return pose.copy(), velocity.copy()


@dataclass(frozen=True)
class RestResult:
    """How one object lay after the drop."""

    name: str
    """Object."""
    spin: float
    """Largest angular speed over the last half second [rad/s]."""
    speed: float
    """Largest speed over the last half second [m/s]."""
    penetration: float
    """Deepest contact at the end [m]."""

    @property
    def rests(self) -> bool:
        """Whether it came to rest."""
        return self.spin < REST_SPIN and self.speed < REST_SPEED


def rest(
    objects: Sequence[ObjectModel], cfg: SimCfg, *, device: str = "cpu", seed: int = 0
) -> list[RestResult]:
    """Drop every object on the table from just above it, with no hand, and look at it after 3 s.

    Args:
        objects: Objects, one world each.
        cfg: Contact settings.
        device: Warp device.
        seed: Of their orientations.
    """
    builder = new_builder()
    turns = Rotation.random(len(objects), random_state=seed).as_quat()
    for item, turn in zip(objects, turns, strict=True):
        world = new_builder()
        add_table(world, cfg, visible=False)
        body = add_object(world, item, cfg, scale=1.0, visuals=False)
        lowest = Rotation.from_quat(turn).apply(np.concatenate([v for v, _ in item.hulls]))[:, 2].min()
        start = world.joint_q_start[world.joint_child.index(body)]
        world.joint_q[start : start + 7] = [0.0, 0.0, 0.01 - lowest, *turn]
        builder.add_world(world)
    scene = SmallScene(builder, cfg, device)
    tail, steps = 0.5, 6
    scene.run(3.0 - tail)
    fastest = np.zeros((2, len(objects)))
    for _ in range(steps):
        scene.run(tail / steps)
        velocity = scene.body(0)[1].reshape(-1, 2, 3)
        fastest = np.maximum(fastest, np.linalg.norm(velocity, axis=2).T)
    (speed, spin), deepest = fastest.tolist(), scene.deepest().tolist()
    return [RestResult(item.name, *row) for item, *row in zip(objects, spin, speed, deepest, strict=True)]


@dataclass(frozen=True)
class PinchResult:
    """A cube held against gravity by opposing fingertips."""

    force: float
    """Normal force of each fingertip [N]."""
    creep: float
    """Speed at which it slid down over the last two seconds [m/s]."""
    penetration: float
    """Deepest contact at the end [m]."""


def pinch(item: ObjectModel, cfg: SimCfg, *, force: float = 10.0, device: str = "cpu") -> PinchResult:
    """Hold an object by four fingertips around it on horizontal rails, each pushed with a constant force.

    Args:
        item: An object that is symmetric under quarter turns about z.
        cfg: Contact settings.
        force: Force of each fingertip [N].
        device: Warp device.
    """
    half = 0.5 * float(np.ptp(item.vertices[:, 0]))
    world = new_builder()
    rails = []
    for angle in 0.5 * np.pi * np.arange(4):
        outward = np.array([np.cos(angle), np.sin(angle), 0.0])
        tip = world.add_link(mass=FINGER_MASS_KG, inertia=wp.mat33(np.eye(3) * 1e-5), lock_inertia=True)
        position = wp.vec3(*(outward * (half + FINGERTIP_RADIUS_M) + [0.0, 0.0, 0.3]))
        joint = world.add_joint_prismatic(
            parent=-1,
            child=tip,
            axis=wp.vec3(*(-outward)),
            parent_xform=wp.transform(position, wp.quat_identity()),
        )
        world.add_articulation([joint])
        rails.append(joint)
        world.add_shape_sphere(
            tip,
            radius=FINGERTIP_RADIUS_M,
            cfg=shape_cfg(cfg, PAPER.materials.friction),
            custom_attributes=contact_attributes(PRIORITY_HAND, CONDIM_TORSIONAL),
        )
    body = add_object(world, item, cfg, scale=1.0, visuals=False)
    start = world.joint_q_start[world.joint_child.index(body)]
    world.joint_q[start : start + 3] = [0.0, 0.0, 0.3]
    builder = new_builder()
    builder.add_world(world)
    scene = SmallScene(builder, cfg, device)
    push = np.zeros(scene.model.joint_dof_count, dtype=np.float32)
    push[[world.joint_qd_start[j] for j in rails]] = force
    scene.control.joint_f.assign(push)
    scene.run(1.0)
    before = scene.body(body)[0][0, 2]
    scene.run(2.0)
    after = scene.body(body)[0][0, 2]
    return PinchResult(force, float(before - after) / 2.0, float(scene.deepest()[0]))


def slide(cfg: SimCfg, *, device: str = "cpu") -> tuple[float, float]:
    """Slide a flat box over the table, at 1 m/s at first, until it stops.

    Returns:
        The distance it took and Coulomb's: v^2 / (2 mu g) [m].
    """
    friction, speed = PAPER.materials.table_friction, 1.0
    world = new_builder()
    add_table(world, cfg, visible=False)
    side, height = 0.06, 0.02
    body = world.add_body(
        xform=wp.transform(wp.vec3(-0.2, 0.0, 0.5 * height), wp.quat_identity()),
        mass=PAPER.materials.object_mass_kg,
        inertia=wp.mat33(np.diag([3e-5, 3e-5, 6e-5])),
        lock_inertia=True,
    )
    world.add_shape_box(
        body,
        hx=0.5 * side,
        hy=0.5 * side,
        hz=0.5 * height,
        cfg=shape_cfg(cfg, friction),
        custom_attributes=contact_attributes(PRIORITY_OBJECT),
    )
    start = world.joint_qd_start[world.joint_child.index(body)]
    world.joint_qd[start] = speed
    builder = new_builder()
    builder.add_world(world)
    scene = SmallScene(builder, cfg, device)
    begin = scene.body(0)[0][0, 0]
    scene.run(1.0)
    return float(scene.body(0)[0][0, 0] - begin), speed**2 / (2.0 * friction * GRAVITY)


@dataclass(frozen=True)
class BounceResult:
    """A ball dropped from many heights."""

    restitution: float
    """Coefficient asked for."""
    rebound: float
    """Speed after the first contact over that before it, by energy; mean over the heights."""
    rebound_most: float
    """Most over the heights: the moment of touching within a physics step differs."""
    energy_most: float
    """Most energy at any later time over that at the start."""
    rest_speed: float
    """Largest speed in the last half second [m/s]."""
    rest_penetration: float
    """Deepest contact in the last half second [m]."""


def bounce(
    cfg: SimCfg, restitution: float, *, seconds: float = 4.0, device: str = "cpu", plain: bool = False
) -> BounceResult:
    """Drop a ball on the table.

    Args:
        cfg: Contact settings.
        restitution: Coefficient of ball and table, in [0, 1].
        seconds: Time to come to rest.
        device: Warp device.
        plain: Leave contacts as they are, whatever the coefficient.
    """
    builder = new_builder()
    mass = PAPER.materials.object_mass_kg
    for start_height in DROP_HEIGHTS_M:
        world = new_builder()
        add_table(world, cfg, visible=False)
        body = world.add_body(
            xform=wp.transform(wp.vec3(0.0, 0.0, BALL_RADIUS_M + start_height), wp.quat_identity()),
            mass=mass,
            inertia=wp.mat33(np.eye(3) * 0.4 * mass * BALL_RADIUS_M**2),
            lock_inertia=True,
        )
        world.add_shape_sphere(
            body,
            radius=BALL_RADIUS_M,
            cfg=shape_cfg(cfg, PAPER.materials.friction),
            custom_attributes=contact_attributes(PRIORITY_OBJECT),
        )
        builder.add_world(world)
    scene = SmallScene(builder, cfg, device)
    if not plain:
        scene.set_restitution(restitution)
    heights, speeds = [], []
    for _ in range(round(seconds * cfg.physics_hz)):
        scene.run(cfg.physics_dt)
        pose, velocity = scene.body(0)
        heights.append(pose[:, 2] - BALL_RADIUS_M)
        speeds.append(velocity[:, 2])
    height, speed = np.array(heights), np.array(speeds)
    start = GRAVITY * np.array(DROP_HEIGHTS_M)
    energy = np.where(height > 0.0, 0.5 * speed**2 + GRAVITY * height, 0.0) / start  # springs hold some below
    touched = np.maximum.accumulate(height <= 0.0, axis=0)
    left = touched & (height > 0.0)
    columns = np.arange(len(start))
    rebound = np.sqrt(np.where(left.any(axis=0), energy[left.argmax(axis=0), columns], 0.0))
    tail = round(0.5 * cfg.physics_hz)
    return BounceResult(
        restitution,
        float(rebound.mean()),
        float(rebound.max()),
        float(np.where(left, energy, 0.0).max()),
        float(np.abs(speed[-tail:]).max()),
        float(-height[-tail:].min()),
    )
