"""Depth by ray casting against closed forms; against Newton's camera see test_depth_camera.py.

Rule of the silhouette: a pixel is left out of a comparison if the oracle, cast through four points
a hundredth of a pixel around its centre, does not see one flat surface, or sees it at the very end
of the camera's range. Single precision cannot say there.
"""

import numpy as np
import trimesh
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from kernel_oracle import EXAMPLES, device_array, floats, quaternions
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import CameraModel
from vd.paper import PAPER
from vd.sensors.cfg import DepthCameraCfg
from vd.sensors.depth_camera import DepthCamera
from vd.sensors.surfaces import Surface, SurfaceSet

WIDTH, HEIGHT = 37, 23  # neither is a multiple of a tile
NEAR, FAR = 0.0437, 1.5  # no round number: surfaces should not lie there by chance
DEPTH_TOLERANCE = 2e-6  # metres: single precision at half a metre, and a dozen operations
NUDGE_PX = 0.01
NUDGED_DEPTH = 2e-3  # a surface that a hundredth of a pixel takes this far is seen along its edge


def camera(width=WIDTH, height=HEIGHT, focal=30.0, near=NEAR, far=FAR):
    """A small camera at the origin that looks along z, off the middle by a fraction of a pixel."""
    return CameraModel(
        width=width,
        height=height,
        fx=focal,
        fy=1.1 * focal,
        cx=0.5 * width + 0.3,
        cy=0.5 * height - 0.4,
        near=near,
        far=far,
        position=np.zeros(3),
        quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
    )


def directions(model, shift=(0.0, 0.0)):
    """Directions through the pixels (moved by ``shift`` pixels), z = 1, shape [H, W, 3]."""
    u, v = np.meshgrid(
        np.arange(model.width) + 0.5 + shift[0], np.arange(model.height) + 0.5 + shift[1]
    )
    return np.stack(
        [(u - model.cx) / model.fx, (v - model.cy) / model.fy, np.ones_like(u)], axis=-1
    )


def shoot(device, meshes, poses, scales, *, model=None, eye=None, table=False):
    """Depth image [H, W] of meshes at ``poses`` [S, 7].

    The camera's pose ``eye`` [7] in the world.
    """
    count = len(meshes)
    surfaces = SurfaceSet(
        meshes, np.arange(count), np.arange(count)[None], np.asarray(scales)[None], device=device
    )
    body_q = device_array(np.asarray(poses)[None], wp.transform, device)
    depth_camera = DepthCamera(surfaces, model or camera(), body_q, cfg=DepthCameraCfg(points=0))
    if eye is not None:
        depth_camera.extrinsics.assign(np.asarray(eye, np.float32)[None])
    depth_camera.table.fill_(int(table))
    depth_camera.true_depth.fill_(np.nan)
    depth_camera.capture()
    return depth_camera.depth.numpy()[0]


def in_range(depth, model=None):
    """What a camera reports of true depths (infinite for nothing)."""
    model = model or camera()
    return np.where((depth >= model.near) & (depth <= model.far), depth, 0.0)


def compare(depth, oracle, model=None, *, atol=DEPTH_TOLERANCE, least_share=0.6):
    """Assert that an image agrees with ``oracle(directions) -> depth`` but at silhouettes."""
    model = model or camera()
    assert np.isfinite(depth).all()
    true = oracle(directions(model))
    wanted = in_range(true, model)
    inside = (np.abs(true - model.near) > atol) & (np.abs(true - model.far) > atol)
    for shift in [(NUDGE_PX, 0), (-NUDGE_PX, 0), (0, NUDGE_PX), (0, -NUDGE_PX)]:
        inside &= np.abs(in_range(oracle(directions(model, shift)), model) - wanted) < NUDGED_DEPTH
    assert inside.mean() > least_share, "too little is left to compare"
    np.testing.assert_allclose(depth[inside], wanted[inside], rtol=0, atol=atol)


def solid(mesh):
    """A trimesh mesh as a surface."""
    return Surface(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32))


BOX = trimesh.creation.box(extents=(0.2, 0.12, 0.3))


@st.composite
def placements(draw, count=1):
    """Poses [count, 7] of things of 0.3 m in front of the camera, some around it, and scales [count]."""
    position = draw(floats((count, 3), -0.3, 0.3)) + np.array([0.0, 0.0, draw(st.floats(0.0, 1.2))])
    return np.concatenate([position, draw(quaternions((count,)))], axis=1), draw(
        floats((count,), 0.5, 1.5)
    )


def box_oracle(pose, scale, half):
    """Depth of a box's surface along each direction, by slabs in float64.

    Inf where it is missed.
    """

    def depth(rays):
        turn = Rotation.from_quat(pose[3:])
        origin = turn.inv().apply(-np.asarray(pose[:3], float))
        ray = turn.inv().apply(rays.reshape(-1, 3)).reshape(rays.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            bounds = np.stack([(-half * scale - origin) / ray, (half * scale - origin) / ray])
        enter, leave = bounds.min(axis=0).max(axis=-1), bounds.max(axis=0).min(axis=-1)
        first = np.where(enter > 0, enter, leave)  # from inside, the far wall is seen
        return np.where((enter <= leave) & (leave > 0), first, np.inf)

    return depth


@EXAMPLES
@given(place=placements())
def test_box_by_slabs_from_anywhere_even_inside(device, place):
    poses, scales = place
    depth = shoot(device, [solid(BOX)], poses, scales)
    compare(depth, box_oracle(poses[0], scales[0], np.array([0.1, 0.06, 0.15])))


@EXAMPLES
@given(height=st.floats(0.1, 1.0), tilt=floats((2,), -0.6, 0.6))
def test_table_is_a_box_seen_from_above(device, height, tilt):
    # Looking down (pi about x), then tilted; the far mesh only fills the set.
    eye_turn = Rotation.from_euler("x", np.pi) * Rotation.from_euler("xy", tilt)
    eye = np.array([0.1, -0.05, height, *eye_turn.as_quat()])
    far_away = [[0.0, 0.0, 100.0, 0, 0, 0, 1]]
    depth = shoot(device, [solid(BOX)], far_away, [1.0], eye=eye, table=True)
    half = 0.5 * np.array(PAPER.scene.table_size_m)
    middle = np.array([0.0, 0.0, PAPER.scene.table_top_m - half[2]])
    pose = np.concatenate([eye_turn.inv().apply(middle - eye[:3]), eye_turn.inv().as_quat()])
    compare(depth, box_oracle(pose, 1.0, half), atol=1e-5)
    bare = shoot(device, [solid(BOX)], far_away, [1.0], eye=eye, table=False)
    assert not bare.any()


def test_closed_surfaces_have_no_cracks(device):
    # The inside of a sphere of 5120 triangles around the camera: a ray between two of them would
    # show.
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    model = camera(width=301, height=203, focal=150.0)
    for seed in range(3):
        turn = Rotation.random(random_state=seed).as_quat()
        depth = shoot(device, [solid(ball)], [[0.02, 0.01, 0.03, *turn]], [1.0], model=model)
        assert (depth > 0.2).all()
