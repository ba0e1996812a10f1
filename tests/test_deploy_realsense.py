"""A RealSense through the SDK: its software device stands for the camera, everything else is what meets one.

Oracles: an inclined plane, whose depth is known in every pixel, and the renderer's image of a held object.
"""

import dataclasses
import gzip
import time
from pathlib import Path

import numpy as np
import pytest
from camera_sdk import camera_sdk
from scipy.spatial import cKDTree

from vd.assets_usd.hand_data import Intrinsics
from vd.assets_usd.hands import load_hand
from vd.assets_usd.objects.sets import load_set
from vd.bench.depth import bench_scene
from vd.deploy.camera.camera import CameraError, StaleCamera
from vd.deploy.camera.realsense import (
    ClockMap,
    FilterCfg,
    RealSense,
    RealSenseCfg,
    RealSenseInfrared,
    describe,
    find_device,
    open_recording,
)
from vd.deploy.twin.camera_twin import CameraTwin
from vd.sensors.cfg import D415, DepthCameraCfg, DepthSensorCfg, StereoImager
from vd.sensors.depth_camera import DepthCamera
from vd.sensors.depth_cloud import CameraCloud
from vd.sensors.surfaces import scene_surfaces

rs = camera_sdk()

LENS = Intrinsics(640, 360, 455.0, 456.0, 323.5, 177.0)
NORMAL, DISTANCE = np.array([0.3, -0.2, 1.0]), 0.7
"""An inclined plane: NORMAL . p = DISTANCE in the optical frame [m]."""
PATIENCE_S = 10.0
BAG = Path(__file__).parent / "data" / "realsense-2.54.bag.gz"
OFF = FilterCfg(decimation=1)


@pytest.fixture
def twin():
    return CameraTwin(LENS)


def cfg(filters=OFF, **settings):
    return RealSenseCfg(filters=filters, **settings)


def rays(lens):
    """Directions of pixel centres with z = 1, [H, W, 3]."""
    x = (np.arange(lens.width) + 0.5 - lens.cx) / lens.fx
    y = (np.arange(lens.height) + 0.5 - lens.cy) / lens.fy
    return np.stack([*np.meshgrid(x, y), np.ones((lens.height, lens.width))], axis=2)


def plane(lens=LENS):
    return DISTANCE / (rays(lens) @ NORMAL)


@pytest.mark.parametrize("side", [1, 2, 3, 4, 5])
def test_points_of_a_plane_lie_on_it_whatever_the_decimation(twin, side):
    camera = RealSense(twin.device, cfg(FilterCfg(decimation=side), depth_unit_m=1e-4))
    twin.show(plane())
    depth, lens = camera.read(PATIENCE_S).depth_m, camera.intrinsics
    camera.close()
    assert depth.shape == (lens.height, lens.width) == (360 // side, 640 // side)
    assert depth.dtype == np.float32
    assert (depth > 0).all()
    off = ((rays(lens) * depth[..., None]) @ NORMAL - DISTANCE) / np.linalg.norm(NORMAL)
    assert abs(off.mean()) < 1e-4  # a shift of half a pixel, as in the SDK's own intrinsics, is 2e-4 and more
    assert np.abs(off).max() < 2e-4  # steps of 0.1 mm, and the mean of a block on an inclined plane


def test_sizes_the_sdk_pads_are_cut_back(twin):
    camera = RealSense(twin.device, cfg(FilterCfg(decimation=8)))  # 360 / 8 = 45, padded to 48
    twin.show(plane())
    depth = camera.read(PATIENCE_S).depth_m
    camera.close()
    assert depth.shape == (45, 80)
    assert (depth > 0).all()


def test_filters_do_what_they_are_named_after(twin):
    generator = np.random.default_rng(0)
    flat = np.full((360, 640), 0.6)
    flat[100:104, 200:204] = 0.0
    flat[200:, :] = 1.2

    def seen(**filters):
        camera = RealSense(twin.device, cfg(FilterCfg(decimation=1, **filters)))
        for _ in range(4):
            twin.show(np.where(flat > 0, flat + 0.003 * generator.standard_normal(flat.shape), 0.0))
            depth = camera.read(PATIENCE_S).depth_m
        camera.close()
        return depth

    plain = seen()
    assert (plain[100:104, 200:204] == 0).all()
    spread = plain[:90].std()
    assert seen(spatial=True)[:90].std() < 0.7 * spread
    assert seen(temporal=True)[:90].std() < 0.8 * spread
    assert (seen(hole_filling="nearest")[100:104, 200:204] > 0.55).all()
    near = seen(threshold_m=(0.1, 1.0))
    assert (near[210:] == 0).all()
    assert (near[:90] > 0).all()


def test_the_newest_image_comes_once_with_its_time(twin):
    camera = RealSense(twin.device, cfg())
    for depth in (0.5, 0.6, 0.7):
        exposed = time.monotonic() - 0.05
        twin.show(np.full((360, 640), depth), exposed)
    deadline = time.monotonic() + PATIENCE_S
    frame = camera.read(PATIENCE_S)
    while abs(frame.depth_m[0, 0] - 0.7) > 1e-3 and time.monotonic() < deadline:  # the SDK's thread may lag
        frame = camera.read(PATIENCE_S)
    assert frame.depth_m[0, 0] == pytest.approx(0.7, abs=1e-3)
    assert frame.time_s == pytest.approx(exposed, abs=5e-3)
    with pytest.raises(StaleCamera, match="no image"):
        camera.read(0.05)
    camera.close()


def test_an_old_image_is_stale(twin):
    camera = RealSense(twin.device, cfg(max_age_s=0.2))
    twin.show(plane(), time.monotonic() - 0.3)
    with pytest.raises(StaleCamera, match=r"0\.\d+ s old"):
        camera.read(PATIENCE_S)
    camera.close()


def test_a_clock_of_the_camera_is_mapped_by_its_fastest_frames():
    generator = np.random.default_rng(1)
    clock, exposed = ClockMap(), 100.0 + np.arange(200) / 30.0
    delay = 0.02 + generator.exponential(0.01, 200)
    found = np.array(
        [clock(t - 5000.0, t + d, host_clock=False) for t, d in zip(exposed, delay, strict=True)]
    )
    assert np.abs(found[30:] - exposed[30:] - delay.min()).max() < 3e-3
    # An image that is held back for a second is not taken for a new one.
    late = exposed[-1] + 0.1
    assert clock(late - 5000.0, late + 1.0, host_clock=False) < late + 0.03


def test_frames_of_the_cameras_own_clock_become_stale_too(twin):
    camera = RealSense(twin.device, cfg(max_age_s=0.2))
    twin.show(plane(), hardware_clock_s=5000.0)
    camera.read(PATIENCE_S)
    twin.show(plane(), time.monotonic() - 1.0, hardware_clock_s=5000.0)
    with pytest.raises(StaleCamera):
        camera.read(PATIENCE_S)
    camera.close()


@pytest.mark.parametrize("ahead_s", [0.005, 3.0])
def test_an_image_from_the_future_is_refused_with_the_name_of_its_clock(twin, ahead_s):
    """What the SDK's guess of a clock is off by apart; that counts as of now."""
    camera = RealSense(twin.device, cfg())
    twin.show(plane(), time.monotonic() + ahead_s)
    if ahead_s < 1.0:
        assert camera.read(PATIENCE_S).time_s <= time.monotonic()
    else:
        with pytest.raises(CameraError, match=r"stamped (2\.9|3\.0)\d s later .* clock global_time"):
            camera.read(PATIENCE_S)
    camera.close()


def test_a_camera_without_projector_can_be_used_and_calibrated(capsys):
    """A D405: what it lacks is left out, and said."""
    twin = CameraTwin(LENS, projector=False)
    camera = RealSenseInfrared(twin.device, cfg())
    twin.show_infrared(np.zeros((360, 640), dtype=np.uint8))
    assert camera.read(PATIENCE_S).image.shape == (360, 640)
    camera.close()
    camera = RealSense(twin.device, cfg(emitter=True))
    assert "twin of a RealSense, twin has no emitter: it is left out" in capsys.readouterr().err
    camera.close()


def test_a_recording_plays_back_what_was_sent(twin, tmp_path):
    path = tmp_path / "hand.db3"
    camera = RealSense(twin.device, cfg(record=path))
    sent = [plane() + 0.01 * i for i in range(5)]
    for depth in sent:
        twin.show(depth)
        camera.read(PATIENCE_S)
        time.sleep(1 / 30)
    camera.close()
    again = RealSense(open_recording(path), RealSenseCfg(filters=OFF))  # the size is the recording's
    assert dataclasses.astuple(again.intrinsics) == pytest.approx(dataclasses.astuple(LENS))
    frames = []
    with pytest.raises(StaleCamera, match="recording ended"):
        while True:
            frames.append(again.read(0.5))
    again.close()
    assert 2 <= len(frames) <= 5
    np.testing.assert_allclose(frames[-1].depth_m, sent[-1], atol=6e-4)
    assert time.monotonic() - 5.0 < frames[0].time_s < frames[-1].time_s <= time.monotonic()


def test_a_bag_of_an_earlier_sdk_plays_back(tmp_path):
    """Five images of 64 x 36, sent at 30 Hz by a software device of pyrealsense2 2.54.2, which wrote bags."""
    path = tmp_path / "depth.bag"
    path.write_bytes(gzip.decompress(BAG.read_bytes()))
    camera = RealSense(open_recording(path), RealSenseCfg(filters=OFF))
    lens = (64, 36, 45.5, 45.6, 32.3, 17.7)
    assert dataclasses.astuple(camera.intrinsics) == pytest.approx(lens)
    frames = []
    with pytest.raises(StaleCamera, match="recording ended"):
        while True:
            frames.append(camera.read(0.5))
    camera.close()
    assert 2 <= len(frames) <= 5
    np.testing.assert_allclose(frames[-1].depth_m, 0.54, atol=1e-6)


def test_infrared_comes_with_the_pattern_off(twin):
    camera = RealSenseInfrared(twin.device, cfg())
    image = np.random.default_rng(0).integers(0, 255, (360, 640), dtype=np.uint8)
    twin.show_infrared(image)
    np.testing.assert_array_equal(camera.read(PATIENCE_S).image, image)
    assert dataclasses.astuple(camera.intrinsics) == pytest.approx(dataclasses.astuple(LENS))
    assert not twin.emitter
    camera.close()


def test_a_device_says_what_it_is(twin):
    assert describe(twin.device) == "twin of a RealSense, twin"


def test_refusals_name_the_remedy(twin, tmp_path):
    with pytest.raises(CameraError, match="640 x 360 at 30 Hz"):
        RealSense(twin.device, RealSenseCfg(width=848, height=480))
    with pytest.raises(CameraError, match="no such recording"):
        open_recording(tmp_path / "none.bag")
    (tmp_path / "bad.db3").write_bytes(b"not a recording")
    with pytest.raises(CameraError, match="record it again"):
        open_recording(tmp_path / "bad.db3")
    with pytest.raises(CameraError, match="depth_unit_m"):
        RealSense(twin.device, cfg(depth_unit_m=1.0))
    with pytest.raises(ValueError, match=r"\.db3"):
        cfg(record=tmp_path / "x.bag").validate()
    with pytest.raises(ValueError, match="decimation"):
        FilterCfg(decimation=9).validate()
    if not len(rs.context().query_devices()):
        with pytest.raises(CameraError, match="no RealSense camera answers"):
            find_device()


def test_the_cloud_of_a_held_object_comes_through_the_sdk_as_from_the_renderer():
    """With a D415's errors at 640 x 360, decimated to the size of training."""
    scene, state = bench_scene(load_set("procedural-150-seed0")[:1], 1, "dclaw3", "cpu", 3)
    body_q = state.body_q.reshape((1, -1))
    small = load_hand("dclaw3").camera
    large = dataclasses.replace(
        small, width=640, height=360, fx=2 * small.fx, fy=2 * small.fy, cx=2 * small.cx, cy=2 * small.cy
    )
    errors = dataclasses.replace(
        DepthSensorCfg.realistic(), imager=StereoImager(D415.baseline_m, D415.focal_px / 2)
    )

    def render(camera, **settings):
        cfg = DepthCameraCfg(points=0, **settings)
        base = int(scene.link_body[0])
        view = DepthCamera(scene_surfaces(scene), camera, body_q, cfg=cfg, camera_body=base)
        view.capture()
        return view.depth.numpy()[0]

    twin = CameraTwin(large)
    camera = RealSense(twin.device)
    twin.show(render(large, sensor=errors))
    seen = camera.read(PATIENCE_S).depth_m
    truth = render(small)
    camera.close()
    same = pytest.approx(dataclasses.astuple(small)[:6], rel=1e-6)
    assert dataclasses.astuple(camera.intrinsics) == same
    clouds = [CameraCloud(small).make(depth) for depth in (seen, truth)]
    points, true = (p.numpy()[0, : int(n.numpy()[0])] for p, n in clouds)
    assert len(points) > 0.7 * len(true) > 1000
    distance = cKDTree(true).query(points)[0]
    assert np.median(distance) < 1.5e-3
    assert np.quantile(distance, 0.98) < 5e-3  # a voxel
