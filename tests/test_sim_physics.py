"""Physics against what can be known: closed forms, Coulomb, energy, rest and grip."""

import dataclasses

import newton
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from small_scenes import SmallScene, pinch, rest

from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.geometry import Hull
from vd.assets_usd.objects.sets import load_set
from vd.assets_usd.objects.settings import ImportSettings
from vd.paper import PAPER
from vd.sim.cfg import SimCfg
from vd.sim.scene import (
    PRIORITY_OBJECT,
    add_object,
    add_table,
    build_hand,
    build_scene,
    contact_attributes,
    new_builder,
    shape_cfg,
)
from vd.sim.simulator import Simulator

CFG = SimCfg()
GRAVITY = 9.81
"""Newton's default gravity [m/s^2]."""


@pytest.fixture(scope="module")
def cube():
    return load_set("cube")[0]


def test_free_fall(cube):
    builder, world = new_builder(), new_builder()
    add_object(world, cube, CFG, scale=1.0, visuals=False)
    builder.add_world(world)
    scene = SmallScene(builder, CFG, "cpu")
    seconds = 0.5
    scene.run(seconds)
    pose, velocity = scene.body(0)
    fallen = -pose[0, 2]
    # Semi-implicit Euler falls one half step further than the closed form.
    assert fallen == pytest.approx(0.5 * GRAVITY * seconds**2, rel=2.0 * CFG.physics_dt / seconds)
    assert velocity[0, 2] == pytest.approx(-GRAVITY * seconds, rel=1e-4)
    assert np.abs(pose[0, :2]).max() < 1e-6
    assert np.abs(velocity[0, 3:]).max() < 1e-6


def inertia_about(hand, q: np.ndarray, joint: int) -> float:
    """Inertia of all that a joint moves about its axis, rotor included [kg m^2].

    Sum of I + m r^2.
    """
    poses = hand.forward_kinematics(q)
    parent, frame = poses[hand.joint_parent[joint]], hand.joint_parent_frame[joint]
    turn = Rotation.from_quat(parent[3:])
    origin = parent[:3] + turn.apply(frame[:3])
    axis = (turn * Rotation.from_quat(frame[3:])).apply(hand.joint_axis[joint])
    total = float(hand.armature[joint])
    for link in range(hand.joint_child[joint], 3 * (joint // 3) + 4):
        rotation = Rotation.from_quat(poses[link, 3:])
        arm = poses[link, :3] + rotation.apply(hand.link_com[link]) - origin
        local_axis = rotation.inv().apply(axis)
        total += local_axis @ hand.link_inertia[link] @ local_axis
        total += hand.link_mass[link] * np.sum(np.cross(axis, arm) ** 2)
    return total


def sliced(cube, count):
    """The cube cut into slabs."""
    (hull,) = cube.hulls
    low, high = hull.vertices.min(axis=0), hull.vertices.max(axis=0)
    slabs = []
    for k in range(count):
        ends = low[0] + (high[0] - low[0]) * np.array([k, k + 1]) / count
        slabs.append(
            Hull(np.where(hull.vertices > 0, [ends[1], *high[1:]], [ends[0], *low[1:]]), hull.faces)
        )
    return dataclasses.replace(cube, hulls=tuple(slabs))


@pytest.mark.parametrize("hand", ["dclaw3", "dclaw4"])
def test_an_object_of_as_many_parts_as_an_import_makes_fits_beside_a_hand(cube, hand):
    """MuJoCo's masks have 32 bits for who touches whom.

    Parts of one object need none among themselves.
    """
    item = sliced(cube, ImportSettings().max_hulls)
    scene = build_scene(hand=load_hand(hand), objects=[item], num_envs=1, cfg=CFG, device="cpu")
    model = Simulator(scene, CFG).solver.mj_model
    meets = (model.geom_contype[:, None] & model.geom_conaffinity[None]) != 0
    on_object = model.geom_bodyid == model.geom_bodyid[-1]
    assert on_object.sum() == len(item.hulls)
    assert (meets | meets.T)[np.ix_(on_object, ~on_object)].all()


@pytest.mark.parametrize("joint", [0, 1, 2])
def test_step_response_of_a_joint_is_the_pd_closed_form(joint):
    """A joint with inertia J follows J q'' + kd q' + kp q = kp target.

    Gravity off, the others hold.
    """
    hand = load_hand("dclaw4")
    world = build_hand(hand, CFG, visuals=False)
    world.gravity = (0.0, 0.0, 0.0)
    builder = new_builder()
    builder.add_world(world)
    scene = SmallScene(builder, CFG, "cpu")
    start = hand.start.astype(np.float32)
    scene.state.joint_q.assign(start)
    target = start.copy()
    step = 0.2
    target[joint] += step
    scene.control.joint_target_q.assign(target)
    times = np.arange(1, 37) * CFG.physics_dt
    measured = []
    for _ in times:
        scene.run(CFG.physics_dt)
        measured.append(scene.state.joint_q.numpy()[joint] - start[joint])
    kp, kd, inertia = (
        float(hand.kp[joint]),
        float(hand.kd[joint]),
        inertia_about(hand, start, joint),
    )
    slow, fast = sorted(-np.roots([inertia, kd, kp]).real)
    closed = step * (
        1.0 + (slow * np.exp(-fast * times) - fast * np.exp(-slow * times)) / (fast - slow)
    )
    # The implicit integrator blurs the start by about one physics step.
    assert np.abs(np.array(measured) - closed).max() < 0.05 * step
    assert np.abs(np.array(measured) - closed)[len(times) // 2 :].max() < 0.02 * step


def body_on_table(height: float, inertia: list[float]) -> tuple[newton.ModelBuilder, int]:
    """A world with a table and a body of the paper's mass, without a shape yet, so high above it [m]."""
    world = new_builder()
    add_table(world, CFG, visible=False)
    body = world.add_body(
        xform=wp.transform(wp.vec3(-0.2, 0.0, height), wp.quat_identity()),
        mass=PAPER.materials.object_mass_kg,
        inertia=wp.mat33(np.diag(inertia)),
        lock_inertia=True,
    )
    return world, body


def test_sliding_follows_coulomb():
    """A flat box slides v^2 / (2 mu g)."""
    friction, speed = PAPER.materials.table_friction, 1.0
    world, body = body_on_table(0.01, [3e-5, 3e-5, 6e-5])
    priority = contact_attributes(PRIORITY_OBJECT)
    world.add_shape_box(
        body, hx=0.03, hy=0.03, hz=0.01, cfg=shape_cfg(CFG, friction), custom_attributes=priority
    )
    world.joint_qd[0] = speed
    builder = new_builder()
    builder.add_world(world)
    scene = SmallScene(builder, CFG, "cpu")
    begin = scene.body(0)[0][0, 0]
    scene.run(1.0)
    coulomb = speed**2 / (2.0 * friction * GRAVITY)
    # The integrator's velocity is half a step ahead: v dt / 2 less.
    assert scene.body(0)[0][0, 0] - begin == pytest.approx(coulomb - 0.5 * CFG.physics_dt, rel=0.02)


def test_a_pinch_holds_and_a_slippery_one_lets_go(cube):
    """Of the second the friction is less than the weight."""
    assert pinch(cube, CFG).creep < 0.2e-3
    assert pinch(cube, CFG, force=0.2).creep > 0.05


def test_procedural_objects_come_to_rest():
    objects = load_set("procedural-24-seed0")[::2]
    results = rest(objects, CFG)
    resting = [r for r in results if r.rests]
    assert len(resting) >= 0.9 * len(results), [r for r in results if not r.rests]
    assert max(r.penetration for r in results) < 1e-3


def test_energy_does_not_grow(cube):
    """A cube tumbling on the table only loses mechanical energy (samples may ripple by contact springs)."""
    world, builder = new_builder(), new_builder()
    add_table(world, CFG, visible=False)
    body = add_object(world, cube, CFG, at=(0.0, 0.0, 0.12), scale=1.0, visuals=False)
    start = world.joint_qd_start[world.joint_child.index(body)]
    world.joint_qd[start : start + 6] = [0.3, 0.1, 0.0, 3.0, -6.0, 2.0]
    builder.add_world(world)
    scene = SmallScene(builder, CFG, "cpu")
    mass, inertia = cube.mass_kg, float(cube.inertia.mean())

    def energy() -> float:
        pose, velocity = scene.body(0)
        linear, angular = velocity[0, :3], velocity[0, 3:]
        kinetic = 0.5 * mass * linear @ linear + 0.5 * inertia * angular @ angular
        return float(kinetic + mass * GRAVITY * pose[0, 2])

    first = energy()
    history = [first]
    for _ in range(180):
        scene.run(CFG.physics_dt)
        history.append(energy())
    lowest = np.minimum.accumulate(history)
    assert np.max(np.array(history) - lowest) < 0.02 * first
    assert history[-1] < 0.5 * first


def test_velocity_limits_hold(device):
    """A hand told to jump exceeds no joint's speed limit; without the kernel it would."""
    hand = load_hand("dclaw4")
    fast = dataclasses.replace(hand, velocity_limit=np.full_like(hand.velocity_limit, 1.0))
    scene = build_scene(hand=fast, objects=load_set("cube"), num_envs=2, cfg=CFG, device=device)
    sim = Simulator(scene, CFG)
    target = sim.joint_q.numpy().copy()
    target[:, :12] += 1.0
    sim.target.assign(target)
    sim.step()
    assert np.abs(sim.joint_qd.numpy()[:, :12]).max() <= 1.0 + 1e-5
    sim.velocity_limit.fill_(100.0)
    sim.step()
    assert np.abs(sim.joint_qd.numpy()[:, :12]).max() > 1.0
