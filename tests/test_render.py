"""The headless renderer.

Things are where the camera model says, in their colours, and files decode.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vd.assets_usd.objects.model import ObjectModel
from vd.play.render import PictureCamera, Renderer

IDENTITY = [0.0, 0.0, 0.0, 1.0]
FACES = [[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6], [0, 4, 5], [0, 5, 1]]
FACES += [[1, 5, 6], [1, 6, 2], [2, 6, 7], [2, 7, 3], [3, 7, 4], [3, 4, 0]]


def box(name, size):
    half = 0.5 * np.asarray(size)
    corners = np.array([[-1, -1, -1], [-1, 1, -1], [1, 1, -1], [1, -1, -1]], dtype=float)
    vertices = np.concatenate([corners, corners * [1, 1, -1]]) * half
    inertia = np.full(3, 1e-4)
    return ObjectModel(
        name, vertices, np.array(FACES), (), 0.1, inertia, np.array(IDENTITY), vertices
    )


def project(camera, points, width, height):
    """Pixel coordinates (column, row) of world points [n, 3]."""
    seen = (np.asarray(points) - np.asarray(camera.eye)) @ camera.rotation
    flat = 0.5 * height / np.tan(0.5 * camera.fov) * seen[:, :2] / -seen[:, 2:]
    return np.stack([0.5 * width + flat[:, 0], 0.5 * height - flat[:, 1]], axis=1)


def orange(picture):
    """Pixels of the object's hue: red well above blue."""
    picture = picture.astype(int)
    return (picture[..., 0] - picture[..., 2] > 90) & (picture[..., 0] > picture[..., 1])


def green(picture):
    picture = picture.astype(int)
    return (picture[..., 1] - picture[..., 0] > 25) & (picture[..., 1] - picture[..., 2] > 20)


def pose(position, quat=IDENTITY):
    return np.concatenate([position, quat])[None]


@pytest.fixture(scope="module")
def cube_renderer():
    return Renderer(None, [box("cube", [0.04] * 3)], width=320, height=240)


def middle(mask):
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()])


@pytest.mark.parametrize(
    "position", [(0.0, 0.0, 0.1), (0.08, 0.0, 0.03), (-0.05, 0.07, 0.12), (0.0, -0.1, 0.05)]
)
def test_object_is_drawn_where_the_camera_projects_it(cube_renderer, position):
    (picture,) = cube_renderer.render(pose(position), np.array([IDENTITY]))
    expected = project(cube_renderer.camera, np.array([position]), 320, 240)[0]
    np.testing.assert_allclose(middle(orange(picture.scene)), expected, atol=2.5)
    corners = np.array(position) + box("cube", [0.04] * 3).vertices
    spots = project(cube_renderer.camera, corners, 320, 240)
    rows, columns = np.nonzero(orange(picture.scene))
    np.testing.assert_allclose(
        [columns.min(), columns.max() + 1], [spots[:, 0].min(), spots[:, 0].max()], atol=1.5
    )
    np.testing.assert_allclose(
        [rows.min(), rows.max() + 1], [spots[:, 1].min(), spots[:, 1].max()], atol=1.5
    )


def test_goal_has_the_outline_of_the_object_in_the_same_orientation():
    plate = box("plate", [0.10, 0.05, 0.01])
    quat = Rotation.from_euler("xyz", [0.5, 0.9, 0.3]).as_quat()
    camera = PictureCamera()
    renderer = Renderer(None, [plate], width=160, height=160, camera=camera)
    (same,) = renderer.render(pose(camera.target, quat), np.array([quat]))
    (other,) = renderer.render(pose(camera.target, quat), np.array([IDENTITY]))

    def shape(mask):
        """Width over height of the outline: the same from the same side, whatever the distance."""
        rows, columns = np.nonzero(mask)
        return np.ptp(columns) / np.ptp(rows)

    assert shape(green(same.goal)) == pytest.approx(shape(orange(same.scene)), rel=0.1)
    assert shape(green(other.goal)) != pytest.approx(shape(orange(same.scene)), rel=0.2)


def test_each_cell_shows_its_own_object_and_goal():
    objects = [box("small", [0.02] * 3), box("large", [0.08] * 3)]
    renderer = Renderer(None, objects, width=160, height=120)
    q = np.concatenate([pose((0.0, 0.0, 0.1)), pose((0.06, 0.0, 0.1))])
    small, large = renderer.render(q, np.array([IDENTITY, IDENTITY]))
    assert 8 < orange(large.scene).sum() / orange(small.scene).sum() < 32
    assert middle(orange(large.scene))[0] > middle(orange(small.scene))[0] + 10
    assert green(small.goal).sum() < green(large.goal).sum()


def test_a_table_that_is_taken_away_is_not_drawn():
    renderer = Renderer(None, [box("cube", [0.05] * 3)] * 2, width=160, height=120)
    q, goals = np.repeat(pose((0.0, 0.0, 0.1)), 2, axis=0), np.array([IDENTITY] * 2)
    there, gone = (one.scene for one in renderer.render(q, goals, np.array([True, False])))
    spot = project(renderer.camera, np.array([[0.1, 0.0, 0.0]]), 160, 120)[0].round().astype(int)
    background = gone[0, 0]
    np.testing.assert_array_equal(gone[spot[1], spot[0]], background)
    assert np.abs(there[spot[1], spot[0]].astype(int) - background).max() > 10
    assert orange(gone).sum() == pytest.approx(orange(there).sum(), rel=0.05), "the object stays"


@pytest.fixture(scope="module")
def hand(tmp_path_factory):
    from vd.assets_usd.hand_model import read_hand
    from vd.assets_usd.hands import hand_usd

    return {name: read_hand(hand_usd(name)) for name in ("dclaw3", "dclaw4")}


@pytest.mark.parametrize("name", ["dclaw3", "dclaw4"])
def test_fingertips_are_drawn_where_kinematics_puts_them(hand, name):
    model, speck = hand[name], [box("speck", [1e-4] * 3)]
    joints = np.random.default_rng(1).uniform(-0.1, 0.1, model.num_joints)
    joints += np.tile([0.0, 0.8, -1.1], model.num_fingers)
    q = np.concatenate([joints, [0.0, 0.0, -1.0], IDENTITY])[None]
    renderer = Renderer(model, speck, width=320, height=240)
    empty = Renderer(None, speck, width=320, height=240, camera=renderer.camera)
    hands = renderer.render(q, np.array([IDENTITY]))[0].scene.astype(int)
    none = empty.render(q[:, model.num_joints :], np.array([IDENTITY]))[0].scene.astype(int)
    mount = Rotation.from_euler("y", np.pi)
    inside = mount.apply(model.tip_poses(joints)[:, :3]) + np.array([0.0, 0.0, 0.25 + 0.012])
    column, row = project(renderer.camera, inside, 320, 240).round().astype(int).T
    assert (np.abs(hands - none).sum(axis=2)[row, column] > 20).all()
