"""The rotations that map a shape onto itself are found."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from vd.assets_usd.objects.geometry import surface_points
from vd.assets_usd.objects.model import IDENTITY, ObjectModel
from vd.assets_usd.objects.sets import load_set
from vd.evaluate.symmetry import APART_RAD, CLOSED_RAD, MOST, symmetries

NEAR_RAD = 0.05
"""A symmetry that was found, from its true rotation."""


def shape(mesh: trimesh.Trimesh) -> ObjectModel:
    """An object with the shape of a mesh, which declares no symmetry."""
    vertices, faces = np.float32(mesh.vertices), np.int32(mesh.faces)
    points = np.float32(surface_points(mesh, 500, outside=[]))
    cube = load_set(["cube"])[0]
    return replace(cube, vertices=vertices, faces=faces, surface_points=points, symmetry=IDENTITY)


def test_symmetries_of_solids_are_found(device):
    """Of a box, a cylinder and a ball; a box with a corner cut off has none."""
    box = trimesh.creation.box((0.10, 0.06, 0.04))
    cylinder = trimesh.creation.cylinder(radius=0.02, height=0.1)
    cut = trimesh.creation.box((0.10, 0.06, 0.04))
    cut.vertices[cut.vertices.argmax(axis=0)[0]] *= 0.4
    ball = trimesh.creation.icosphere(radius=0.04)
    found = symmetries([shape(mesh) for mesh in (box, cylinder, cut, ball)], device)
    quarter = Rotation.from_quat(found[0])
    assert len(quarter) == 4
    for turn in Rotation.create_group("D2"):
        assert (quarter * turn.inv()).magnitude().min() < NEAR_RAD
    turned = Rotation.from_quat(found[1]).apply([0.0, 0.0, 1.0])[:, 2]
    np.testing.assert_allclose(np.abs(turned), 1.0, atol=0.01)
    spin = np.arange(0.0, 2.0 * np.pi, 0.05)
    for turn in Rotation.from_rotvec(np.outer(spin, [0.0, 0.0, 1.0])):
        assert (Rotation.from_quat(found[1]) * turn.inv()).magnitude().min() < 2.0 * APART_RAD
    np.testing.assert_array_equal(found[2], IDENTITY)
    assert len(found[3]) == MOST


def test_a_shape_that_differs_by_a_part_of_its_surface_is_not_symmetric(device):
    """A remote control with a block of 6 mm on a twentieth of it, which lies elsewhere when it is turned."""
    remote = trimesh.creation.box((0.16, 0.05, 0.02))
    block = trimesh.creation.box(
        (0.02, 0.05, 0.006), trimesh.transformations.translation_matrix((0.05, 0, 0.013))
    )
    (found,) = symmetries([shape(trimesh.util.concatenate([remote, block]))], device)
    (mirrored,) = symmetries([shape(remote)], device)
    assert len(mirrored) == 4
    np.testing.assert_array_equal(found, IDENTITY)


@pytest.mark.parametrize(
    ("name", "order"),
    [("train/remote_controller_1.ply", 1), ("train/poker_1.ply", 4), ("test/waterbottle.stl", 5)],
)
def test_groups_of_scanned_objects_are_groups(shared_dir, name, order):
    mesh = trimesh.load(shared_dir / "objects" / name, force="mesh")
    mesh.apply_translation(-mesh.center_mass)
    mesh.apply_scale(0.16 / mesh.extents.max())
    (found,) = symmetries([shape(mesh)], "cpu")
    turns = Rotation.from_quat(found)
    assert len(turns) == order
    for turn in turns:
        assert max(((turn * turns).inv() * other).magnitude().min() for other in turns) < CLOSED_RAD


def test_declared_symmetries_stand():
    cube = load_set(["cube"])[0]
    (found,) = symmetries([cube], "cpu")
    np.testing.assert_allclose(found, cube.symmetry, atol=1e-6)
