"""The depth camera on the hand's scene.

Against Newton's camera, its clouds, viewpoints and late images.

Rule of the edge: in comparisons with Newton a pixel is left out if Newton's inverse depth, which is
affine on a plane, bends by more than 0.001 / m at it (0.4 mm at 0.6 m), along its row or its
column. None of the others may differ, and of all pixels one in a thousand.
"""

import numpy as np
import pytest
import trimesh
import warp as wp
from newton.sensors import SensorCamera
from posed_scenes import pose, posed_scene
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from vd.assets_usd.objects.geometry import Surface
from vd.assets_usd.objects.sets import load_set
from vd.paper import PAPER
from vd.sensors import surfaces
from vd.sensors.cfg import DepthCameraCfg, DepthSensorCfg
from vd.sensors.depth_camera import DepthCamera
from vd.sensors.depth_cloud import CameraCloud

WORLDS = 3
EDGE_BEND = 0.001
TOLERANCE_M = 2e-5  # single precision of both cameras at 0.6 m


@pytest.fixture(scope="module")
def scenes():
    """Scene and state on each device, with visual shapes for Newton; built once."""
    built = {}

    def get(device):
        if device not in built:
            objects = load_set("procedural-24-seed0")[::8]
            built[device] = posed_scene(objects, WORLDS, "dclaw4", device, 3, visuals=True)
        return built[device]

    return get


def make(scene, state, **settings):
    return DepthCamera.of_scene(
        scene, state.body_q.reshape((scene.num_envs, -1)), DepthCameraCfg(**settings), seed=5
    )


def host(array):
    """A copy: on the CPU ``numpy()`` is a view of what the next capture overwrites."""
    return array.numpy().copy()


def smooth(depth):
    """Pixels that are no edge.

    Not at the border, inverse depth even along row and column, [N, H, W].
    """
    inverse = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0.0)
    bend = np.full(depth.shape, np.inf)
    middle = 2 * inverse[:, 1:-1, 1:-1]
    bend[:, 1:-1, 1:-1] = np.maximum(
        np.abs(inverse[:, :-2, 1:-1] + inverse[:, 2:, 1:-1] - middle),
        np.abs(inverse[:, 1:-1, :-2] + inverse[:, 1:-1, 2:] - middle),
    )
    return bend < EDGE_BEND


def newton_depth(scene, state, camera_q):
    """Newton's depth images from the hand's camera in every world, which looks along -z with +y up there."""
    camera, sensor = scene.hand.camera, SensorCamera(scene.model, load_textures=False)
    rays = SensorCamera.compute_camera_rays_pinhole(
        camera.width,
        camera.height,
        focal_length=camera.fx,
        horizontal_aperture=float(camera.width),
        vertical_aperture=camera.height * camera.fx / camera.fy,
        device=str(scene.model.device),
    )
    turned = (
        Rotation.from_quat(camera_q[:, 3:]) * Rotation.from_euler("x", 180, degrees=True)
    ).as_quat()
    poses = np.concatenate([camera_q[:, :3], turned], axis=1).astype(np.float32)
    depth = sensor.allocate_image_depth_forward(len(poses), camera.width, camera.height)
    scene.model.bvh_refit_shapes(state)
    poses = wp.array(poses, dtype=wp.transformf, device=scene.model.device)
    sensor.update(state, poses, rays, forward_depth_image=depth)
    return host(depth)


def test_image_is_that_of_newtons_camera(device, scenes):
    scene, state = scenes(device)
    ours = make(scene, state)
    ours.true_depth.fill_(np.nan)
    ours.capture()
    reference = newton_depth(scene, state, host(ours.camera_q))
    reference = np.where(reference > scene.hand.camera.far, 0.0, reference)
    keep = smooth(reference)
    assert keep.mean() > 0.7
    np.testing.assert_allclose(host(ours.depth)[keep], reference[keep], rtol=0, atol=TOLERANCE_M)
    assert np.mean(np.abs(host(ours.depth) - reference) > TOLERANCE_M) < 1e-3
    seen = reference[:, 40:140, 100:220]
    assert np.ptp(seen) > 0.1, "the picture shows a hand, not a table alone"


def image_points(hand, depth):
    """World points [H, W, 3] of a depth image at the camera of the USD."""
    m, mount = hand.camera, wp.transform(*hand.mount)
    v, u = np.mgrid[: m.height, : m.width] + 0.5
    rays = np.stack([(u - m.cx) / m.fx, (v - m.cy) / m.fy, np.ones_like(u)], axis=-1)
    base = (
        Rotation.from_quat(m.quaternion).apply((rays * depth[..., None]).reshape(-1, 3))
        + m.position
    )
    world = Rotation.from_quat(mount.q).apply(base) + np.array(mount.p)
    return base.reshape(rays.shape), world.reshape(rays.shape)


def test_cloud_is_the_crop_of_the_image_in_the_frame_of_the_base(device, scenes):
    scene, state = scenes(device)
    camera = make(scene, state)
    camera.points.fill_(7.0)
    camera.capture()
    depth, count, points = host(camera.depth), host(camera.count), host(camera.points)
    assert points.shape == (WORLDS, PAPER.camera.points, 3)
    low, high = PAPER.camera.crop_m
    for world in range(WORLDS):
        base, in_world = image_points(scene.hand, depth[world].astype(float))
        kept = (depth[world] > 0) & (in_world[..., 2] >= low) & (in_world[..., 2] <= high)
        assert abs(kept.sum() - count[world]) <= 2, "single precision at the crop's edge"
        assert 1000 < count[world] < PAPER.camera.points
        # All pixels are there, in the order of tiles, and nothing beyond them.
        cloud = points[world, : count[world]]
        distance, pixel = cKDTree(base[depth[world] > 0]).query(cloud)
        assert distance.max() < 1e-6 and len(set(pixel)) == count[world]
        assert np.isfinite(cloud).all() and np.isnan(points[world, count[world] :]).all()


def test_a_smaller_cloud_takes_each_pixel_once_and_evenly(device, scenes):
    scene, state = scenes(device)
    wanted, frames = 500, 40
    camera = make(scene, state, points=wanted)
    whole = make(scene, state)
    whole.capture()
    pixels = {tuple(p) for p in host(whole.points)[0, : host(whole.count)[0]]}
    hits: dict[tuple, int] = {}
    for _ in range(frames):
        camera.capture()
        assert host(camera.count)[0] == wanted
        chosen = [tuple(p) for p in host(camera.points)[0]]
        assert len(set(chosen)) == wanted and set(chosen) <= pixels
        for p in chosen:
            hits[p] = hits.get(p, 0) + 1
    # Each pixel is chosen with probability wanted / available in each frame.
    mean = frames * wanted / host(camera.available)[0]
    assert len(hits) > 0.9 * (1 - np.exp(-mean)) * len(pixels)
    assert max(hits.values()) < mean + 8 * np.sqrt(mean)


def test_table_can_be_taken_away_world_by_world(device, scenes):
    scene, state = scenes(device)
    camera = make(scene, state, points=0)
    camera.capture()
    there = host(camera.depth)
    camera.table.assign(np.array([1, 0, 1], np.int32))
    camera.capture()
    gone = host(camera.depth)
    np.testing.assert_array_equal(gone[[0, 2]], there[[0, 2]])
    assert (gone[1] == 0).mean() > (there[1] == 0).mean() + 0.2
    kept = gone[1] > 0
    np.testing.assert_array_equal(gone[1][kept], there[1][kept])


def test_viewpoints_differ_between_worlds_as_asked(device, scenes):
    scene, state = scenes(device)
    body_q = state.body_q.reshape((WORLDS, -1))
    cfg = DepthCameraCfg(position_noise_m=0.01, rotation_noise_rad=0.02, points=0)
    camera = DepthCamera.of_scene(scene, body_q, cfg, seed=1)
    same = DepthCamera.of_scene(scene, body_q, cfg, seed=1)
    for one in (camera, same):
        one.capture()
    np.testing.assert_array_equal(host(camera.depth), host(same.depth))
    poses = host(camera.extrinsics)
    nominal = scene.hand.camera
    moved = np.linalg.norm(poses[:, :3] - nominal.position, axis=1)
    turned = (
        Rotation.from_quat(poses[:, 3:]) * Rotation.from_quat(nominal.quaternion).inv()
    ).magnitude()
    assert (moved > 0).all() and moved.max() < 0.06 and (turned > 0).all() and turned.max() < 0.12
    assert len(np.unique(np.round(host(camera.camera_q)[:, 0], 6))) == WORLDS


def test_clouds_do_not_know_that_the_camera_has_moved(device, scenes):
    """The same image, seen from where the camera is, is laid out from where it should be."""
    scene, state = scenes(device)
    body_q = state.body_q.reshape((WORLDS, -1))
    cfg = DepthCameraCfg(position_noise_m=0.01, points=2000)
    camera = DepthCamera.of_scene(scene, body_q, cfg, seed=1)
    camera.capture()
    moved, nominal = host(camera.extrinsics)[:, :3], scene.hand.camera.position
    base = host(body_q)[:, int(scene.link_body[0])]
    for world in range(WORLDS):
        cloud = host(camera.points)[world, : host(camera.count)[world]]
        away = moved[world] - nominal
        turn, place = Rotation.from_quat(base[world, 3:]), base[world, :3]
        depth = host(camera.depth)[world].astype(float)
        seen = image_points(scene.hand, depth)[0][depth > 0]
        assert cKDTree(seen).query(cloud)[0].max() < 1e-5
        assert np.median(cKDTree(seen + away).query(cloud)[0]) > 1e-4, "it would lie elsewhere"
        heights = (turn.apply(cloud) + place)[:, 2]
        low, high = PAPER.camera.crop_m
        assert heights.min() > low - 1e-5 and heights.max() < high + 1e-5


def test_clouds_know_the_place_that_was_drawn_for_the_camera(device, scenes):
    """What is seen lies on what the camera sees from where it was meant to be."""
    scene, state = scenes(device)
    body_q = state.body_q.reshape((WORLDS, -1))
    most = 0.02, 0.04
    cfg = DepthCameraCfg(place_range=most, points=2000)
    camera = DepthCamera.of_scene(scene, body_q, cfg, seed=1)
    camera.capture()
    poses = host(camera.extrinsics)
    nominal = scene.hand.camera
    about = Rotation.from_quat(nominal.quaternion)
    shift = about.inv().apply(poses[:, :3] - nominal.position)
    turn = (about.inv() * Rotation.from_quat(poses[:, 3:])).as_rotvec()
    assert (np.abs(shift) < most[0] + 1e-6).all() and (np.abs(turn) < most[1] + 1e-5).all()
    assert np.ptp(shift, axis=0).min() > 1e-3 and np.ptp(turn, axis=0).min() > 1e-3
    for world in range(WORLDS):
        cloud = host(camera.points)[world, : host(camera.count)[world]]
        there = nominal.at(poses[world])
        depth = host(camera.depth)[world]
        column, row, away = there.project(cloud).T
        seen = depth[row.astype(int), column.astype(int)]
        np.testing.assert_allclose(seen, away, atol=1e-5)


def test_late_images_are_past_images(device, scenes):
    scene, state = scenes(device)
    frame_s = 1.0 / PAPER.scene.control_hz
    now = make(scene, state, points=0)
    late = make(scene, state, points=0, latency_s=(0.0, 2 * frame_s))
    late.delay.assign(np.array([0.0, 1.0, 2.0], np.float32))
    generator = np.random.default_rng(8)
    start = host(state.joint_q)
    history = []
    for _ in range(5):
        pose(scene, state, generator)
        now.capture()
        late.capture()
        history.append(host(now.depth))
        for world, delay in enumerate((0, 1, 2)):
            if len(history) > delay:
                np.testing.assert_allclose(
                    host(late.depth)[world], history[-1 - delay][world], atol=1e-5
                )
    # After a reset of world 2, its past is gone; that of world 1 is not.
    pose(scene, state, generator)
    late.reset(wp.array([0, 0, 1], dtype=wp.int32, device=device))
    now.capture()
    late.capture()
    np.testing.assert_allclose(host(late.depth)[2], host(now.depth)[2], atol=1e-5)
    np.testing.assert_allclose(host(late.depth)[1], history[-1][1], atol=1e-5)
    state.joint_q.assign(start)
    pose(scene, state, np.random.default_rng(3))


def test_a_real_cameras_image_makes_the_same_cloud(device, scenes):
    scene, state = scenes(device)
    simulated = make(scene, state)
    simulated.capture()
    real = CameraCloud(scene.hand.camera, scene.hand.mount, device=device)
    points = real.seen(host(simulated.depth)[0])
    assert host(real.cloud.count)[0] == host(simulated.count)[0]
    np.testing.assert_allclose(host(points)[0], host(simulated.points)[0], atol=1e-6)
    with pytest.raises(ValueError, match="resample"):
        real.seen(np.zeros((90, 160)))


def test_a_camera_goes_on_where_another_stopped(device, scenes):
    scene, state = scenes(device)
    settings = {"sensor": DepthSensorCfg.realistic(), "latency_s": (0.05, 0.1), "points": 300}
    one, other = make(scene, state, **settings), make(scene, state, **settings)
    for _ in range(3):
        one.capture()
    for name, array in other.stateful().items():
        array.assign(host(one.stateful()[name]))
    for camera in (one, other):
        camera.capture()
    assert (
        np.isfinite(host(one.depth)).all()
        and (host(one.depth) != host(one.true_depth)).mean() > 0.3
    )
    np.testing.assert_array_equal(host(other.depth), host(one.depth))
    np.testing.assert_array_equal(host(other.points), host(one.points))


def test_a_link_of_many_triangles_is_drawn_coarser_and_looks_the_same():
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.02)
    fine = Surface(ball.vertices.astype(np.float32), ball.faces.astype(np.int32))
    coarse = surfaces.coarse(fine)
    assert len(coarse.faces) < 0.5 * len(fine.faces)
    mesh = trimesh.Trimesh(*coarse, process=False)
    points, _ = trimesh.sample.sample_surface(mesh, 5000, seed=0)
    assert np.abs(np.linalg.norm(points, axis=1) - 0.02).max() < 1e-3
    few = Surface(fine.vertices, fine.faces[: surfaces.MANY_FACES])
    assert surfaces.coarse(few) is few
