"""Does the simulated contact behave as the world does?

Small scenes with the project's contact settings and nothing else: objects dropped on the table, a
cube held between fingertips. SI units, world frame, z up.
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
from vd.sim.engine import make_solver
from vd.sim.scene import (
    CONDIM_TORSIONAL,
    PRIORITY_HAND,
    add_object,
    add_table,
    contact_attributes,
    new_builder,
    shape_cfg,
)

FINGERTIP_RADIUS_M = 0.0101
"""Radius of the D'Claw's fingertip, for the stand-in fingers of the pinch."""
FINGER_MASS_KG = 0.1
"""Mass of a stand-in finger: about what a D'Claw finger weighs at its tip."""
REST_SPIN, REST_SPEED = 0.01, 1e-3
"""An object rests below these [rad/s], [m/s]."""


class SmallScene:
    """A model stepped on its own, with contact distances read from the solver."""

    def __init__(self, builder: newton.ModelBuilder, cfg: SimCfg, device: str):
        """Finalize ``builder`` and make the solver."""
        self.model = builder.finalize(device=device)
        self.cfg = cfg
        self.solver = make_solver(self.model, cfg)
        self.state, self._next = self.model.state(), self.model.state()
        self.control = self.model.control()
        newton.eval_fk(self.model, self.state.joint_q, self.state.joint_qd, self.state)

    def run(self, seconds: float) -> None:
        """Step for ``seconds``."""
        for _ in range(round(seconds * self.cfg.physics_hz)):
            self.solver.step(self.state, self._next, self.control, None, self.cfg.physics_dt)
            self.state, self._next = self._next, self.state

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
        lowest = (
            Rotation.from_quat(turn).apply(np.concatenate([v for v, _ in item.hulls]))[:, 2].min()
        )
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
    return [
        RestResult(item.name, *row)
        for item, *row in zip(objects, spin, speed, deepest, strict=True)
    ]


@dataclass(frozen=True)
class PinchResult:
    """A cube held against gravity by opposing fingertips."""

    force: float
    """Normal force of each fingertip [N]."""
    creep: float
    """Speed at which it slid down over the last two seconds [m/s]."""
    penetration: float
    """Deepest contact at the end [m]."""


def pinch(
    item: ObjectModel, cfg: SimCfg, *, force: float = 10.0, device: str = "cpu"
) -> PinchResult:
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
        tip = world.add_link(
            mass=FINGER_MASS_KG, inertia=wp.mat33(np.eye(3) * 1e-5), lock_inertia=True
        )
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
