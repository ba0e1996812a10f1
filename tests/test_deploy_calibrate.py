"""Hand-eye calibration: exact views, noisy ones against the predicted intervals, and drawn pictures.

The camera is where the hand's USD has it; views are what it would see, made here from forward
kinematics.
"""

import contextlib
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vd.assets_usd.camera_layer import read_camera, read_camera_pose, write_camera_layer
from vd.assets_usd.hand_data import HandError, Intrinsics, compose, invert
from vd.assets_usd.hands import load_hand

pytest.importorskip("cv2", reason="OpenCV is not installed (extra: hardware)")
from vd.deploy import cli
from vd.deploy.camera import calibrate as command
from vd.deploy.camera.calibrate import CalibrateCfg, calibrate
from vd.deploy.camera.camera import Frame
from vd.deploy.camera.hand_eye import HandEyeError, Views, cube_corners, solve
from vd.deploy.camera.markers import find_markers
from vd.deploy.hardware.joints import read_joints
from vd.deploy.pose.open import source_frame
from vd.deploy.pose.rendered import render_cube
from vd.deploy.pose.tags import find_cube, tag_corners

SIZE_M = 0.05
COUNT = 18
"""Views of each finger."""
SEAT = np.array(
    [0.01, -0.02, 0.04, *Rotation.from_euler("xyz", (40.0, -25.0, 130.0), degrees=True).as_quat()]
)
"""Pose of the cube in the frame of its fingertip: taped on somehow."""
AWAY = np.array(
    [0.03, -0.03, 0.04, *Rotation.from_euler("xyz", (8.0, -6.0, 10.0), degrees=True).as_quat()]
)
"""From where the hand's file has the camera to where it is, in its own frame: mounted by eye."""


@pytest.fixture(scope="module")
def hand():
    return load_hand("dclaw3")


@pytest.fixture(scope="module")
def lens(hand):
    c = hand.camera
    return Intrinsics(1280, 720, 4 * c.fx, 4 * c.fy, 4 * c.cx, 4 * c.cy)


@pytest.fixture(scope="module")
def camera(hand):
    return np.concatenate([hand.camera.position, hand.camera.quaternion])


@pytest.fixture(scope="module")
def poses(hand, lens, camera):
    """Joints that show the cube on a finger, the others at the start, by finger [COUNT, D]."""
    generator = np.random.default_rng(0)
    bent = {}
    for finger in range(3):
        rows = []
        while len(rows) < COUNT:
            q = hand.start.copy()
            axes = hand.fingers[finger]
            q[axes] = generator.uniform(hand.lower[axes], hand.upper[axes])
            pose = compose(invert(camera), compose(hand.tip_poses(q)[finger], SEAT))
            pixels = cube_corners(pose[None], lens, SIZE_M)[0]
            if (pixels > 20).all() and (pixels < [lens.width - 20, lens.height - 20]).all():
                rows.append(q)
        bent[finger] = np.array(rows)
    return bent


def views(hand, camera, lens, poses, fingers, *, noise_px=0.0, joint_rad=0.0, seed=0):
    """What a camera sees of the fingers that bend.

    The joints are off by ``joint_rad`` from what they say, every tag's corners by ``noise_px``.
    """
    generator = np.random.default_rng(seed)
    tip, cubes, numbers = [], [], []
    for finger in fingers:
        for q in poses[finger]:
            pose = compose(invert(camera), compose(hand.tip_poses(q)[finger], SEAT))
            if noise_px:
                pose = seen_by_tags(pose, lens, noise_px, generator)
            said = q + joint_rad * generator.standard_normal(len(q))
            tip.append(hand.tip_poses(said)[finger])
            cubes.append(pose)
            numbers.append(finger)
    return Views(np.array(tip), np.array(numbers), np.array(cubes), lens, SIZE_M)


def seen_by_tags(pose, lens, noise_px, generator):
    """A pose as found from the tags of the faces that look at the camera, with noise."""
    turn = Rotation.from_quat(pose[3:])
    tags = {}
    for number, corners in enumerate(tag_corners(SIZE_M)):
        there = turn.apply(corners) + pose[:3]
        if np.cross(there[1] - there[0], there[3] - there[0]) @ there[0] > 0.0:
            pixels = there[:, :2] / there[:, 2:] * [lens.fx, lens.fy] + [lens.cx, lens.cy]
            tags[number] = pixels + noise_px * generator.standard_normal((4, 2))
    found, _ = find_cube(tags, lens, SIZE_M)
    return found


def misplaced(camera, truth):
    """By how much what is where objects are seems moved to a camera [7] that is at another place [3] [m]."""
    point = load_hand("dclaw3").goal_in_base
    return (
        compose(camera, compose(invert(truth), np.array([*point, 0.0, 0.0, 0.0, 1.0])))[:3] - point
    )


def off(camera, found):
    """Position in the base [m] and turn about the camera's axes [rad] from ``camera``, [6]."""
    turn = Rotation.from_quat(camera[3:]).inv() * Rotation.from_quat(found[3:])
    return np.concatenate([found[:3] - camera[:3], turn.as_rotvec()])


@pytest.mark.parametrize("fingers", [(0,), (0, 1, 2)])
def test_exact_views_give_the_exact_camera(hand, camera, lens, poses, fingers):
    """Wherever it is: nothing says where it is thought to be, or how the cube sits."""
    seen = views(hand, camera, lens, poses, fingers)
    found = solve(seen)
    assert len(found.inliers) == len(seen)
    np.testing.assert_allclose(off(camera, found.camera), 0.0, atol=1e-6)
    assert found.rms_px < 1e-3


def test_noisy_views_err_as_predicted(hand, camera, lens, poses):
    """Corners off by 0.3 pixels and joints by 0.2 degrees.

    95 % intervals hold in about 95 of 100.
    """
    covered, errors, predicted = [], [], []
    for seed in range(40):
        noise = {"noise_px": 0.3, "joint_rad": np.radians(0.2), "seed": seed}
        found = solve(views(hand, camera, lens, poses, (0,), **noise))
        covered.append(np.abs(off(camera, found.camera)) < found.half_width)
        errors.append(np.linalg.norm(misplaced(found.camera, camera)))
        predicted.append(found.point_error(hand.goal_in_base))
    share = np.mean(covered)
    # 240 correlated components; the sandwich is known to be careful.
    assert 0.90 < share < 0.995, share
    assert np.quantile(errors, 0.95) < 1.3 * np.median(predicted)
    assert np.median(errors) > 0.15 * np.median(predicted)


@pytest.mark.parametrize("seed", range(2))
def test_wrong_views_are_left_out(hand, camera, lens, poses, seed):
    noise = {"noise_px": 0.3, "joint_rad": 0.003, "seed": seed}
    seen = views(hand, camera, lens, poses, (0, 1, 2), **noise)
    wrong = np.arange(2, len(seen), 6)
    cubes = seen.cube.copy()
    cubes[wrong, 0] += 0.03
    found = solve(replace(seen, cube=cubes))
    assert not set(wrong) & set(found.inliers)
    assert len(found.inliers) >= len(seen) - len(wrong) - 2
    assert np.linalg.norm(misplaced(found.camera, camera)) < 0.005


def test_too_little_motion_is_said(hand, camera, lens, poses):
    still = np.tile(hand.start, (10, 1))
    still[:, 1] += np.linspace(0.0, 0.9, 10)
    with pytest.raises(HandEyeError, match="do not determine"):
        solve(views(hand, camera, lens, {0: still}, (0,)))
    with pytest.raises(HandEyeError, match="take 6"):
        solve(views(hand, camera, lens, {0: poses[0][:4]}, (0,)))


def test_tags_are_found_where_they_are(lens):
    """Half a pixel of another convention would show."""
    generator = np.random.default_rng(0)
    errors = []
    for _ in range(12):
        place = generator.uniform([-0.1, -0.05, 0.4], [0.1, 0.05, 0.6])
        pose = np.array([*place, *Rotation.random(rng=generator).as_quat()])
        turn = Rotation.from_quat(pose[3:])
        for number, pixels in find_markers(render_cube(pose, lens, 0.07)).items():
            there = turn.apply(tag_corners(0.07)[number]) + pose[:3]
            wanted = there[:, :2] / there[:, 2:] * [lens.fx, lens.fy] + [lens.cx, lens.cy]
            errors.append(pixels - wanted)
    assert len(errors) > 48
    assert np.sqrt(np.mean(np.square(errors))) < 0.5
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 0.1


class Bench:
    """A camera that is not where the hand's file has it, and motors whose fingers somebody bends."""

    twin = None

    def __init__(self, hand, lens, poses, camera, joint_rad=0.0):
        self.hand, self.intrinsics, self.poses, self.at = hand, lens, list(poses), -1
        self.camera = compose(camera, AWAY)
        self.generator, self.joints = np.random.default_rng(0), read_joints(hand)
        self.bus = self
        wrong = joint_rad * self.generator.standard_normal((len(poses) // 2, hand.num_joints))
        self.read_poses = self.poses + np.repeat(wrong, 2, axis=0)

    def torque(self, on):
        """It only ever goes off."""
        assert not on
        return {}

    def read_state(self):
        """Where somebody holds the fingers, as far as the motors know."""
        return SimpleNamespace(position=self.joints.to_motor(self.read_poses[self.at]))

    def read(self, timeout_s):
        """The next picture: it shows a finger that rests from here on."""
        self.at = min(self.at + 1, len(self.poses) - 1)
        tip = self.hand.tip_poses(self.poses[self.at])[0]
        pose = compose(invert(self.camera), compose(tip, SEAT))
        image = render_cube(pose, self.intrinsics, SIZE_M)
        noisy = image + 3.0 * self.generator.standard_normal(image.shape, dtype=np.float32)
        return Frame(np.clip(np.rint(noisy), 0, 255).astype(np.uint8), 0.0)

    def close(self):
        """Nothing to stop."""


def calibrated(bench, monkeypatch, **settings):
    """The status of calibrate, where somebody holds each pose for two pictures."""
    monkeypatch.setattr(command, "connect", lambda cfg: contextlib.nullcontext(bench))
    monkeypatch.setattr(command, "find_device", lambda serial: None)
    monkeypatch.setattr(command, "RealSense", lambda *_, **__: bench)
    cfg = CalibrateCfg(hand="dclaw3", port="none", yes=True, size=SIZE_M, count=10, **settings)
    return calibrate(cfg)


def test_pictures_of_tags_give_the_layer_that_the_loop_reads(
    hand, lens, poses, camera, tmp_path, capsys, monkeypatch
):
    bench = Bench(hand, lens, np.repeat(poses[0], 2, axis=0), camera)
    out = tmp_path / "camera.usda"
    assert calibrated(bench, monkeypatch, out=out) == 0
    moved = re.search(r"([\d.]+) mm and ([\d.]+) degrees", capsys.readouterr().out)
    place = read_camera(hand, out)
    found = np.concatenate([place.position, place.quaternion])
    assert np.linalg.norm(misplaced(found, bench.camera)) < 0.001
    assert float(moved[1]) == pytest.approx(1e3 * np.linalg.norm(AWAY[:3]), abs=2.0)
    angle_deg = np.degrees(Rotation.from_quat(AWAY[3:]).magnitude())
    assert float(moved[2]) == pytest.approx(angle_deg, abs=0.3)
    assert place.fx == hand.camera.fx
    np.testing.assert_allclose(source_frame(hand, None, out), found)


def test_a_bad_condition_is_warned_of(hand, lens, poses, camera, tmp_path, capsys, monkeypatch):
    """Ten pictures, in which the joints are off by 0.7 degrees, determine little."""
    bench = Bench(hand, lens, np.repeat(poses[0], 2, axis=0), camera, joint_rad=np.radians(0.7))
    assert calibrated(bench, monkeypatch, out=tmp_path / "c.usda") == 1
    assert "ill-conditioned" in capsys.readouterr().out


def test_camera_layers_are_refused_by_name(hand, camera, tmp_path):
    with pytest.raises(HandError, match=r"\.usda"):
        write_camera_layer(tmp_path / "camera.json", hand, camera, {})
    with pytest.raises(HandError, match="vd-deploy calibrate"):
        read_camera(hand, tmp_path / "none.usda")
    other = load_hand("dclaw4")
    write_camera_layer(tmp_path / "camera.usda", other, camera, {})
    with pytest.raises(HandError, match="dclaw4"):
        read_camera(hand, tmp_path / "camera.usda")
    blind = replace(other, mounted_camera=None)
    np.testing.assert_allclose(read_camera_pose(blind, tmp_path / "camera.usda"), camera)


def test_a_twin_bends_its_finger_and_its_camera_is_found(hand, camera, tmp_path, capsys):
    out = tmp_path / "camera.usda"
    flags = ["--hand", "dclaw3", "--twin", "--count", "8", "--out", str(out)]
    assert cli.main(["calibrate", *flags]) == 0
    assert "8 of 8 views agree" in capsys.readouterr().out
    assert np.linalg.norm(misplaced(read_camera_pose(hand, out), camera)) < 0.003
