"""Newton's own Allegro example, stepped with its own settings, as the yardstick of ``vd-bench sim``.

Always the example's code: its solver, contact numbers, drives, motion, substeps and CUDA graph. Its hand is
one of boxes, of the Allegro's size, a person's file of the hand, or, where that is asked for, the example's
own asset of 17.8 MB, which Newton downloads. SI units, quaternions xyzw.
"""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

FRAMES = 24
"""Timed frames of the example (1/50 s each, eight physics steps)."""

FROM_NEWTON = "newton-assets/wonik_allegro"
"""What a row calls the example's own asset."""
OF_BOXES = "boxes of the Allegro's size"
"""What a row calls the hand that is made here."""

HAND_POSE = wp.transform(wp.vec3(0.0, 0.0, 1.0), wp.quat(0.21643, 0.706218, -0.648166, 0.185191))
"""Where the example holds its asset's base; it writes the rotation again in every physics step."""
CUBE_SIDE_M, CUBE_MASS_KG = 0.06, 0.1
"""The cube of the example; its mass is our choice, for a hollow cube of that size."""
CUBE_IN_BASE_M = (0.045, 0.0, 0.01)
"""Where the cube starts in the frame of the base, on the roots of the fingers; the example adds 5 cm."""

# The Allegro's dimensions [m], masses [kg] and limits [rad] as its maker publishes them. Frame of the base:
# fingers along +z, palm facing +x. Links lie along their z; all but a finger's first joint bend about y.
PALM_BOXES = (
    ((0.0414, 0.112, 0.0448), (-0.009, 0.0, -0.023)),
    ((0.0414, 0.0538, 0.0428), (-0.009, 0.0253, -0.0667)),
    ((0.0414, 0.0720, 0.013), (-0.0093, 0.00557, -0.0887)),
)
"""Sides and centres of the palm's boxes."""
PALM_MASS_KG = 0.4154
LINK_WIDTH_M = (0.0196, 0.0275)
"""Sides of a finger's cross section."""
FINGER_LENGTHS_M = (0.0164, 0.054, 0.0384, 0.0267)
"""Links of a finger, from the palm to the centre of the fingertip."""
FINGER_MASSES_KG = (0.0119, 0.065, 0.0355, 0.0304)
FINGER_LIMITS = ((-0.47, 0.47), (-0.196, 1.61), (-0.174, 1.709), (-0.227, 1.618))
FINGER_ROOTS = (
    ((0.0, 0.0435, -0.001542), -0.0873),
    ((0.0, 0.0, 0.0007), 0.0),
    ((0.0, -0.0435, -0.001542), 0.0873),
)
"""Roots of the fingers and how they are spread about x [rad]."""
THUMB_ROOT = (-0.0182, -0.019333, -0.045987)
THUMB_TURN = (0.0, -1.65806, 1.5708)
"""Angles of the thumb's root about the fixed axes x, y, z [rad]."""
THUMB_OFFSETS_M = ((-0.027, 0.005, 0.0399), (0.0, 0.0, 0.0177), (0.0, 0.0, 0.0514))
"""From each joint of the thumb to the next."""
THUMB_BOX = ((0.0358, 0.034, 0.0455), (-0.0179, 0.009, 0.0145))
THUMB_LENGTHS_M = (0.0, 0.0177, 0.0514, 0.0423)
THUMB_MASSES_KG = (0.0176, 0.0119, 0.038, 0.0556)
THUMB_LIMITS = ((0.263, 1.396), (-0.105, 1.163), (-0.189, 1.644), (-0.162, 1.719))
THUMB_AXES = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0), (0.0, 1.0, 0.0))
FINGER_AXES = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.0, 1.0, 0.0), (0.0, 1.0, 0.0))
TIP_RADIUS_M = 0.012
PALM_UP = Rotation.from_matrix(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
"""The base in the world as the example means it: palm up, fingers along -y."""


@dataclass(frozen=True)
class AllegroRate:
    """What the example did."""

    physics_steps_s: float
    """Physics steps per second over all environments."""
    dt_s: float
    """Length of its physics step [s]."""
    hand: str
    """Which hand it had: :data:`FROM_NEWTON`, a file's name or :data:`OF_BOXES`."""


def allegro_rate(envs: int, device: str, *, file: Path | None = None, fetch: bool = False) -> AllegroRate:
    """Physics steps per second of the example over all environments.

    Args:
        envs: World count.
        device: Warp device.
        file: URDF of an Allegro hand, in its maker's frame, in place of the boxes.
        fetch: Let Newton download the example's asset, which is then the hand.

    Raises:
        RuntimeError: The example cannot run here: it is not installed, or fails on this device.
        ValueError: The file cannot be the hand.
    """
    if file is not None and not (file.suffix == ".urdf" and file.is_file()):
        raise ValueError(f"--allegro-file {file}: no such file, or its name does not end in .urdf")
    # A yardstick that is missing must not end the benchmark, for whatever reason it is missing.
    try:
        with wp.ScopedDevice(device):
            if file is not None:
                with _in_place_of_the_asset(lambda builder: _add_file(builder, file)):
                    return _measure(envs, device, file.name)
            if fetch:
                with redirect_stdout(sys.stderr):  # standard output is for the rows
                    return _measure(envs, device, FROM_NEWTON)
            with _in_place_of_the_asset(add_hand_of_boxes):
                return _measure(envs, device, OF_BOXES)
    except Exception as error:
        raise RuntimeError(f"Newton's Allegro example cannot run here: {error}") from error


def _measure(envs: int, device: str, hand: str) -> AllegroRate:
    example = make_example(envs)
    for _ in range(FRAMES):
        example.step()
    wp.synchronize_device(device)
    start = time.perf_counter()
    for _ in range(FRAMES):
        example.step()
    wp.synchronize_device(device)
    elapsed = time.perf_counter() - start
    return AllegroRate(envs * FRAMES * example.sim_substeps / elapsed, example.sim_dt, hand)


def make_example(envs: int) -> Any:
    """The example, with a viewer that shows nothing."""
    from newton.examples.robot.example_robot_allegro_hand import Example

    arguments = Example.create_parser().parse_args(["--viewer", "null", "--world-count", str(envs)])
    viewer: Any = newton.viewer.ViewerNull(num_frames=FRAMES)
    return Example(viewer, arguments)


@contextmanager
def _in_place_of_the_asset(add_hand: Callable[[newton.ModelBuilder], None]) -> Iterator[None]:
    """The example meanwhile gets what ``add_hand`` puts into its builder where it reads its asset."""
    replaced = {
        (newton.utils, "download_asset"): lambda *_args, **_kwargs: Path(),
        (newton.ModelBuilder, "add_usd"): lambda builder, *_args, **_kwargs: add_hand(builder),
    }
    before = {place: getattr(*place) for place in replaced}
    try:
        for place, function in replaced.items():
            setattr(*place, function)
        yield
    finally:
        for place, function in before.items():
            setattr(*place, function)


def _add_file(builder: newton.ModelBuilder, file: Path) -> None:
    """A hand from a file and the cube."""
    first = builder.joint_count
    builder.add_urdf(str(file), xform=HAND_POSE, floating=False, enable_self_collisions=False)
    _turn_palm_up(builder, first)
    _add_cube(builder)


def add_hand_of_boxes(builder: newton.ModelBuilder) -> None:
    """Add a hand of the Allegro's joints, masses and sizes, made of 19 boxes and 4 spheres, and the cube."""
    first = builder.joint_count
    base = builder.add_link(
        mass=PALM_MASS_KG, inertia=_box_inertia(PALM_MASS_KG, PALM_BOXES[0][0]), label="base"
    )
    for sides, centre in PALM_BOXES:
        _add_box(builder, base, sides, centre)
    joints = [builder.add_joint_fixed(parent=-1, child=base, parent_xform=HAND_POSE, label="root")]
    for index, (root, spread) in enumerate(FINGER_ROOTS):
        at_root = wp.transform(wp.vec3(*root), wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), spread))
        frames = [at_root, *(_shift(0.0, 0.0, length) for length in FINGER_LENGTHS_M[:3])]
        rows = (FINGER_AXES, FINGER_LIMITS, FINGER_MASSES_KG, FINGER_LENGTHS_M)
        joints += _add_finger(builder, f"finger_{index}", base, frames, rows)
    at_root = wp.transform(wp.vec3(*THUMB_ROOT), wp.quat(*Rotation.from_euler("xyz", THUMB_TURN).as_quat()))
    frames = [at_root, *(_shift(*offset) for offset in THUMB_OFFSETS_M)]
    rows = (THUMB_AXES, THUMB_LIMITS, THUMB_MASSES_KG, THUMB_LENGTHS_M)
    joints += _add_finger(builder, "thumb", base, frames, rows)
    builder.add_articulation(joints)
    for a in range(builder.shape_count):  # as the example, which reads its asset without self-collision
        for b in range(a):
            builder.add_shape_collision_filter_pair(b, a)
    _turn_palm_up(builder, first)
    _add_cube(builder)


def _add_finger(
    builder: newton.ModelBuilder, name: str, base: int, frames: list[Any], rows: tuple[Any, Any, Any, Any]
) -> list[int]:
    """Add four links from the palm to the tip, each with its joint; returns the joints."""
    joints, parent = [], base
    for k, (frame, axis, limits, mass, length) in enumerate(zip(frames, *rows, strict=True)):
        sides = (*LINK_WIDTH_M, length) if length else THUMB_BOX[0]
        link = builder.add_link(mass=mass, inertia=_box_inertia(mass, sides), label=f"{name}_link_{k}")
        _add_box(builder, link, sides, (0.0, 0.0, 0.5 * length) if length else THUMB_BOX[1])
        joints.append(
            builder.add_joint_revolute(
                parent=parent,
                child=link,
                parent_xform=frame,
                axis=wp.vec3(*axis),
                limit_lower=limits[0],
                limit_upper=limits[1],
                label=f"{name}_joint_{k}",
            )
        )
        parent = link
    tip = _shift(0.0, 0.0, rows[3][-1])
    builder.add_shape_sphere(parent, xform=tip, radius=TIP_RADIUS_M, cfg=_massless(builder))
    return joints


def _turn_palm_up(builder: newton.ModelBuilder, joint: int) -> None:
    """Turn the base in its fixed joint, so that the example's rotation of its asset holds this palm up."""
    wanted = Rotation.from_quat(np.array(HAND_POSE.q)).inv() * PALM_UP
    builder.joint_X_c[joint] = wp.transform(wp.vec3(), wp.quat(*wanted.inv().as_quat()))


def _add_cube(builder: newton.ModelBuilder) -> None:
    position = np.array(HAND_POSE.p) + PALM_UP.apply(np.array(CUBE_IN_BASE_M))
    inertia = _box_inertia(CUBE_MASS_KG, (CUBE_SIDE_M,) * 3)
    cube = builder.add_body(xform=_shift(*position), mass=CUBE_MASS_KG, inertia=inertia, label="cube")
    _add_box(builder, cube, (CUBE_SIDE_M,) * 3, (0.0, 0.0, 0.0))


def _add_box(
    builder: newton.ModelBuilder, body: int, sides: tuple[float, ...], centre: tuple[float, ...]
) -> None:
    hx, hy, hz = (0.5 * side for side in sides)
    builder.add_shape_box(body, xform=_shift(*centre), hx=hx, hy=hy, hz=hz, cfg=_massless(builder))


def _shift(x: float, y: float, z: float) -> wp.transform:
    return wp.transform(wp.vec3(x, y, z), wp.quat_identity())


def _massless(builder: newton.ModelBuilder) -> newton.ModelBuilder.ShapeConfig:
    """The example's contact numbers for a shape whose body's mass is given."""
    cfg = builder.default_shape_cfg.copy()
    cfg.density = 0.0
    return cfg


def _box_inertia(mass: float, sides: tuple[float, ...]) -> wp.mat33:
    square = np.array(sides) ** 2
    return wp.mat33(np.diag(mass / 12.0 * (square.sum() - square)))
