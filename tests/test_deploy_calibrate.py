"""Hand-eye calibration: exact views, noisy ones against the predicted intervals, and drawn pictures.

The camera is where the hand's USD has it; views are what it would see, made here from forward kinematics.
"""

import dataclasses
import json

import numpy as np
import pytest
from camera_sdk import camera_sdk
from scipy.spatial.transform import Rotation

from vd.assets_usd.camera_layer import read_camera, write_camera_layer
from vd.assets_usd.hand_data import BASE_IN_WORLD, HandError, Intrinsics, compose, invert
from vd.assets_usd.hands import load_hand
from vd.deploy.camera.calibrate import CalibrateCfg, Shot, calibrate, misplaced, object_place, save_views
from vd.deploy.camera.calibration_poses import plan, seat
from vd.deploy.camera.hand_eye import HandEyeError, Views, dual_quaternions, project, refine, solve, square
from vd.deploy.camera.markers import MarkerFinder, draw
from vd.deploy.camera.realsense import RealSenseCfg
from vd.deploy.twin.calibration_twin import SLIP, CalibrationTwin

pytest.importorskip("cv2", reason="OpenCV is not installed (extra: hardware)")

SIDE_M = 0.02
COUNT = 18


@pytest.fixture(scope="module")
def hand():
    return load_hand("dclaw3")


@pytest.fixture(scope="module")
def lens(hand):
    c = hand.camera
    return Intrinsics(1280, 720, 4 * c.fx, 4 * c.fy, 4 * c.cx, 4 * c.cy)


@pytest.fixture(scope="module")
def poses(hand, lens):
    """Poses of the hand for a marker on its first finger alone, and on all."""
    return {f: np.array(plan(hand, lens, f, COUNT, side_m=SIDE_M)) for f in ((0,), (0, 1, 2))}


@pytest.fixture(scope="module")
def camera(hand):
    return np.concatenate([hand.camera.position, hand.camera.quaternion])


def views(hand, camera, lens, joints, fingers, *, noise_px=0.0, joint_rad=0.0, seed=0):
    """What a camera sees of the fingers that move; the joints are off by ``joint_rad`` from what they say."""
    generator = np.random.default_rng(seed)
    finder = MarkerFinder(lens, SIDE_M)
    tip, finger, corners = [], [], []
    for number in fingers:
        marker = compose(seat(hand, number, camera), SLIP)
        for q in joints[np.abs(joints - joints[-1])[:, 3 * number : 3 * number + 3].max(axis=1) > 0.01]:
            pose = compose(invert(camera), compose(hand.tip_poses(q)[number], marker))
            points = Rotation.from_quat(pose[3:]).apply(square(SIDE_M)) + pose[:3]
            said = q + joint_rad * generator.standard_normal(len(q))
            tip.append(hand.tip_poses(said)[number])
            finger.append(number)
            corners.append(project(points, lens) + noise_px * generator.standard_normal((4, 2)))
    candidates = tuple(finder.poses(c) for c in corners)
    return Views(np.array(tip), np.array(finger), np.array(corners), candidates, lens, SIDE_M)


def off(camera, found):
    """Position in the base [m] and turn about the camera's axes [rad] from ``camera``, [6]."""
    turn = Rotation.from_quat(camera[3:]).inv() * Rotation.from_quat(found[3:])
    return np.concatenate([found[:3] - camera[:3], turn.as_rotvec()])


@pytest.mark.parametrize("fingers", [(0,), (0, 1, 2)])
def test_exact_views_give_the_exact_camera(hand, camera, lens, poses, fingers):
    """Dual quaternions alone already do."""
    seen = views(hand, camera, lens, poses[fingers], fingers)
    found = solve(seen)
    assert len(found.inliers) == len(seen)
    np.testing.assert_allclose(off(camera, found.linear), 0.0, atol=1e-4)  # IPPE stops at single precision
    np.testing.assert_allclose(off(camera, found.camera), 0.0, atol=1e-6)
    assert found.rms_px < 1e-3


def test_motions_in_closed_form_give_the_camera_by_dual_quaternions():
    generator = np.random.default_rng(3)

    def random(n):
        turn = Rotation.random(n, random_state=generator).as_quat()
        return np.concatenate([generator.normal(size=(n, 3)), turn], axis=1)

    camera, marker, tips = random(1)[0], random(1)[0], random(8)
    seen = compose(invert(camera), compose(tips, marker))
    found = dual_quaternions([tips], [seen])
    np.testing.assert_allclose(off(camera, found), 0.0, atol=1e-9)


def test_noisy_views_err_as_predicted(hand, camera, lens, poses):
    """Corners off by 0.3 pixels and joints by 0.2 degrees: 95 % intervals hold in about 95 of 100."""
    covered, errors, predicted = [], [], []
    for seed in range(40):
        seen = views(
            hand, camera, lens, poses[(0,)], (0,), noise_px=0.3, joint_rad=np.radians(0.2), seed=seed
        )
        found = refine(seen, camera)
        covered.append(np.abs(off(camera, found.camera)) < found.half_width)
        errors.append(np.linalg.norm(misplaced(found.camera, camera)))
        predicted.append(found.point_error(object_place()))
    share = np.mean(covered)
    assert 0.90 < share < 0.995, share  # 240 correlated components; the sandwich is known to be careful
    assert np.quantile(errors, 0.95) < 1.3 * np.median(predicted)
    assert np.median(errors) > 0.15 * np.median(predicted)


def test_refinement_and_outliers(hand, camera, lens, poses):
    """Least squares beats dual quaternions alone, and views with a wrong marker are left out."""
    refined, linear, finder = [], [], MarkerFinder(lens, SIDE_M)
    for seed in range(2):
        seen = views(
            hand, camera, lens, poses[(0, 1, 2)], (0, 1, 2), noise_px=0.3, joint_rad=0.003, seed=seed
        )
        wrong = np.arange(2, len(seen), 6)
        corners = seen.corners.copy()
        corners[wrong] += 40.0
        candidates = tuple(finder.poses(c) for c in corners)
        found = solve(dataclasses.replace(seen, corners=corners, candidates=candidates))
        assert not set(wrong) & set(found.inliers)
        assert len(found.inliers) >= len(seen) - len(wrong) - 2
        refined.append(np.linalg.norm(misplaced(found.camera, camera)))
        linear.append(np.linalg.norm(misplaced(found.linear, camera)))
    assert max(refined) < 0.005
    assert np.mean(refined) < 0.5 * np.mean(linear)


def test_too_little_motion_is_said(hand, camera, lens, poses):
    one_way = np.tile(poses[(0,)][-1], (10, 1))
    one_way[:-1, 1] = np.linspace(0.4, 1.2, 9)  # only the second joint: one axis
    one_way[:-1, 2] = -1.1
    with pytest.raises(HandEyeError, match=r"one direction only|do not determine"):
        solve(views(hand, camera, lens, one_way, (0,)))
    with pytest.raises(HandEyeError, match="at least"):
        solve(views(hand, camera, lens, poses[(0,)][-4:], (0,)))


def test_poses_are_within_the_joints_and_over_the_table(hand, lens, poses):
    for joints in poses.values():
        assert (joints >= hand.lower).all()
        assert (joints <= hand.upper).all()
        tips = hand.tip_poses(joints)[..., 2].max()
        assert tips < BASE_IN_WORLD[2] - 0.005  # the base looks down: larger z is lower


@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_drawn_markers_are_found_where_they_are(camera, lens, noise):
    generator = np.random.default_rng(0)
    finder = MarkerFinder(lens, SIDE_M)
    errors = []
    for number in range(12):
        pose = np.array([*generator.uniform([-0.1, -0.05, 0.5], [0.1, 0.05, 0.7]), 0, 0, 0, 1.0])
        pose[3:] = (
            Rotation.from_euler("x", np.pi) * Rotation.from_rotvec(generator.normal(0, 0.35, 3))
        ).as_quat()
        image = draw(np.full((lens.height, lens.width), 70, dtype=np.uint8), number, pose, lens, SIDE_M)
        image = np.clip(image + noise * generator.standard_normal(image.shape), 0, 255).astype(np.uint8)
        found = finder.find(image)
        assert list(found) == [number]
        truth = project(Rotation.from_quat(pose[3:]).apply(square(SIDE_M)) + pose[:3], lens)
        errors.append(found[number] - truth)
    assert np.sqrt(np.mean(np.square(errors))) < 0.5
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 0.1  # half a pixel of another convention would show


@pytest.fixture(scope="module")
def kept(hand, lens, poses, tmp_path_factory):
    """A folder of drawn pictures by a camera that is not where the hand's file has it, and where it is."""
    camera_sdk()
    twin = CalibrationTwin(
        hand, lambda: current[0], (0, 1, 2), RealSenseCfg(width=1280, height=720), side_m=SIDE_M
    )
    shots = []
    current = [poses[(0, 1, 2)][0]]
    for q in poses[(0, 1, 2)]:
        current[0] = q
        shots.append(Shot(q, twin.read(5.0).image))
    twin.close()
    folder = tmp_path_factory.mktemp("views")
    save_views(folder, hand, twin.intrinsics, SIDE_M, shots)
    return folder, twin.camera


def test_pictures_of_markers_give_the_layer_that_the_loop_reads(hand, kept, tmp_path, capsys):
    folder, truth = kept
    out = tmp_path / "camera.usda"
    assert calibrate(CalibrateCfg(hand="dclaw3", views=folder, out=out, json=True)) == 0
    record = json.loads(capsys.readouterr().out)
    place = read_camera(hand, out)
    found = np.concatenate([place.position, place.quaternion])
    assert np.linalg.norm(misplaced(found, truth)) < 0.001
    np.testing.assert_allclose(place.position, record["position_m"], atol=1e-9)
    assert record["moved_m"] == pytest.approx(np.linalg.norm(truth[:3] - hand.camera.position), abs=2e-3)
    assert place.fx == hand.camera.fx


def test_a_bad_condition_is_warned_of(kept, tmp_path, capsys):
    """Six pictures of one finger, in which its joints are off by half a degree, determine little."""
    folder, _ = kept
    record = json.loads((folder / "views.json").read_text())
    generator = np.random.default_rng(0)
    for row in record["views"]:
        row["joint_q"] = list(row["joint_q"] + np.radians(0.5) * generator.standard_normal(9))
    for row in record["views"]:
        row["image"] = str(folder / row["image"])
    (tmp_path / "views.json").write_text(json.dumps(record))
    cfg = CalibrateCfg(hand="dclaw3", views=tmp_path, out=tmp_path / "c.usda", fingers=(0,))
    assert calibrate(cfg) == 1
    assert "ill-conditioned" in capsys.readouterr().out


def test_camera_layers_are_refused_by_name(hand, camera, tmp_path):
    with pytest.raises(HandError, match=r"\.usda"):
        write_camera_layer(tmp_path / "camera.json", hand, camera, {})
    with pytest.raises(HandError, match="vd-deploy calibrate"):
        read_camera(hand, tmp_path / "none.usda")
    write_camera_layer(tmp_path / "camera.usda", load_hand("dclaw4"), camera, {})
    with pytest.raises(HandError, match="dclaw4"):
        read_camera(hand, tmp_path / "camera.usda")
    moved = camera.copy()
    moved[0] += 0.01
    write_camera_layer(tmp_path / "camera.usda", hand, moved, {})
    np.testing.assert_allclose(read_camera(hand, tmp_path / "camera.usda").position, moved[:3], atol=1e-12)


def test_views_of_another_hand_are_refused(kept):
    with pytest.raises(ValueError, match="give --hand dclaw3"):
        calibrate(CalibrateCfg(hand="dclaw4", views=kept[0]))


def test_markers_are_printed_at_their_size(tmp_path):
    from PIL import Image

    assert calibrate(CalibrateCfg(hand="dclaw3", fingers=(1,), print_markers=tmp_path)) == 0
    with Image.open(tmp_path / "marker-1.png") as picture:
        inch = picture.width / picture.info["dpi"][0]
        assert inch * 0.0254 == pytest.approx(SIDE_M * 8 / 6, rel=0.01)
        assert picture.getpixel((2, 2)) == 255
