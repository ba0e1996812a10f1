"""A cube of tags: the print, where its tags are found, and its pose from images."""

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import Intrinsics
from vd.deploy import cli

pytest.importorskip("cv2", reason="needs the extra `hardware`")
from vd.deploy.pose.rendered import render_cube
from vd.deploy.pose.tag_sheet import make_sheet, neighbours
from vd.deploy.pose.tags import face_corners, find_cube, find_tags, tag_corners

LENS = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
SIZE_M = 0.07


def drawn(pose, rng, before=None):
    """An image with a camera's noise."""
    image = render_cube(pose, LENS, SIZE_M, before) + rng.normal(0.0, 3.0, (480, 640))
    return np.clip(image, 0, 255).astype(np.uint8)


def errors(found, pose):
    """Of a pose, millimetres and degrees."""
    turn = Rotation.from_quat(found[3:]) * Rotation.from_quat(pose[3:]).inv()
    return 1e3 * np.linalg.norm(found[:3] - pose[:3]), np.degrees(turn.magnitude())


def test_the_cube_is_found_within_3_mm_and_2_degrees_at_40_cm_however_it_lies():
    rng = np.random.default_rng(0)
    shown = set()
    for _ in range(24):
        place = [rng.uniform(-0.08, 0.08), rng.uniform(-0.06, 0.06), 0.4]
        pose = np.array([*place, *Rotation.random(rng=rng).as_quat()])
        tags = find_tags(drawn(pose, rng))
        faces = {number // 4 for number in tags}
        shown.add(len(faces))
        found, off_px = find_cube(tags, LENS, SIZE_M)
        assert found is not None and off_px < 1.0
        error_mm, error_deg = errors(found, pose)
        assert error_mm < 3.0 and error_deg < 2.0, f"{len(faces)} faces"
    assert shown == {1, 2, 3}, "one face alone, and several fused"


def test_a_finger_before_a_face_leaves_tags_that_give_the_pose():
    rng = np.random.default_rng(1)
    turn = Rotation.from_euler("x", 190.0, degrees=True)
    pose = np.array([0.0, 0.0, 0.4, *turn.as_quat()])
    whole = find_tags(drawn(pose, rng))
    assert len(whole) == 4, "one face"
    corner = next(iter(whole.values())).mean(axis=0)
    place = np.array([(corner[0] - 320.0) / 600.0, (corner[1] - 240.0) / 600.0, 1.0]) * 0.3
    finger = place + rng.uniform(-0.008, 0.008, (500, 3))
    left = find_tags(drawn(pose, rng, before=finger))
    assert 1 <= len(left) < 4
    error_mm, error_deg = errors(find_cube(left, LENS, SIZE_M)[0], pose)
    assert error_mm < 3.0 and error_deg < 2.0
    behind = find_tags(drawn(pose, rng, before=finger + np.array([0.0, 0.0, 0.4])))
    assert len(behind) == 4, "what lies behind the cube hides nothing"


def test_of_two_like_poses_of_a_single_face_that_near_the_last_one_is_taken():
    """From the front and far away, a face that leans up looks like one that leans down."""
    rng = np.random.default_rng(3)
    for angle in (15.0, -15.0):
        lean = Rotation.from_euler("yx", [90.0, angle], degrees=True)
        pose = np.array([0.0, 0.0, 1.5, *lean.as_quat()])
        tags = pose[:3] + lean.apply(tag_corners(SIZE_M).reshape(-1, 3)).reshape(-1, 4, 3)
        nearest = tags[:, :, 2].mean(axis=1).reshape(6, 4).mean(axis=1).argmin()
        for _ in range(8):
            noisy = {}
            for number in range(4 * nearest, 4 * nearest + 4):
                pixels = tags[number, :, :2] / tags[number, :, 2:] * 600.0 + [320.0, 240.0]
                noisy[number] = pixels + rng.normal(0.0, 0.2, (4, 2))
            found, _ = find_cube(noisy, LENS, SIZE_M, before=pose)
            assert errors(found, pose)[1] < 12.0


def test_tags_that_are_not_on_a_cube_of_this_size_are_no_pose():
    rng = np.random.default_rng(2)
    pose = np.array([0.0, 0.0, 0.4, *Rotation.from_euler("xyz", [35, 45, 0], True).as_quat()])
    tags = find_tags(drawn(pose, rng))
    first, second, *_ = tags
    swapped = {**tags, first: tags[second], second: tags[first]}
    found, off_px = find_cube(swapped, LENS, SIZE_M)
    assert found is None and off_px > 2.0
    assert find_cube({}, LENS, SIZE_M) == (None, np.inf)
    assert find_cube({24: tags[first]}, LENS, SIZE_M)[0] is None


def test_the_print_shows_all_six_tags_in_their_true_size(tmp_path):
    figure, page = make_sheet(SIZE_M)
    assert page == "A4"
    dpi = 100
    figure.savefig(tmp_path / "sheet.png", dpi=dpi)
    image = np.asarray(Image.open(tmp_path / "sheet.png").convert("L"))
    np.testing.assert_allclose(image.shape, np.array([210.0, 297.0]) / 25.4 * dpi, atol=1.0)
    tags = find_tags(image)
    assert sorted(tags) == list(range(24))
    px_m = 1e3 / 25.4 * dpi
    flat = tag_corners(SIZE_M)
    for face in range(6):
        shown = np.concatenate([tags[number] for number in range(4 * face, 4 * face + 4)])
        there = flat[4 * face : 4 * face + 4].reshape(-1, 3) * px_m
        spans = np.linalg.norm(shown[:, None] - shown, axis=2)
        wanted = np.linalg.norm(there[:, None] - there, axis=2)
        np.testing.assert_allclose(spans, wanted, atol=1.5, err_msg=f"face {face}")
        assert shown[0, 1] < shown[3, 1] and shown[0, 0] < shown[1, 0], "upright"


def test_edges_that_meet_on_the_cube_name_each_other():
    corners = face_corners(SIZE_M)
    for number in range(6):
        for other, direction, _ in neighbours(number):
            edge = {(0, 1): (0, 1), (1, 0): (1, 2), (0, -1): (2, 3), (-1, 0): (3, 0)}[direction]
            for corner in corners[number][list(edge)]:
                assert np.linalg.norm(corners[other] - corner, axis=1).min() < 1e-9


def test_the_command_writes_a_page_and_refuses_sizes_that_fit_none(tmp_path, capsys):
    out = tmp_path / "out.pdf"
    assert cli.main(["tags", "--size", "0.06", str(out)]) == 0
    data = out.read_bytes()
    assert data.startswith(b"%PDF") and b"841.88" in data, "A4"
    assert "--pose tags:0.06" in capsys.readouterr().out
    assert cli.main(["tags", "--size", "7", str(tmp_path / "b.pdf")]) == 1
    assert "cube in metres" in capsys.readouterr().err
