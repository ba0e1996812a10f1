"""Authoring: the cache, the surface samples and the drawn meshes."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import Usd, UsdGeom, UsdPhysics, UsdShade

from vd.assets_usd.cache import assets_dir
from vd.assets_usd.hand_author import author_hand, hand_usd
from vd.assets_usd.hand_meshes import solid_mesh, surface_points
from vd.assets_usd.hand_model import HandModel, open_stage, read_hand
from vd.assets_usd.hand_schema import Box, Capsule, Cylinder, Pose, Solid, Sphere, Taper
from vd.assets_usd.hands import HANDS

HALF = 2**-0.5


@pytest.fixture(scope="module", params=("dclaw3", "dclaw4"))
def hand(request: pytest.FixtureRequest) -> HandModel:
    return read_hand(hand_usd(request.param))


def drawn(hand: HandModel, link: str, prefix: str = "") -> trimesh.Trimesh:
    """The drawn meshes of a link, as one."""
    stage = open_stage(hand.path)
    parts = []
    for prim in stage.GetPrimAtPath(f"/{hand.name}/{link}/visual").GetChildren():
        if prim.GetName().startswith(prefix):
            points = np.array(prim.GetAttribute("points").Get(), dtype=float)
            faces = np.array(prim.GetAttribute("faceVertexIndices").Get()).reshape(-1, 3)
            parts.append(trimesh.Trimesh(points, faces, process=False))
    return trimesh.util.concatenate(parts)


def test_cache_is_authored_once_and_mended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VD_ASSETS", str(tmp_path / "assets"))
    assert assets_dir() == tmp_path / "assets"
    first = hand_usd("dclaw4")
    assert first.parent == tmp_path / "assets" / "hands"
    stamp = first.stat().st_mtime_ns
    assert hand_usd("dclaw4") == first
    assert first.stat().st_mtime_ns == stamp
    whole = first.read_text()
    first.write_text(whole[: len(whole) // 2])
    assert hand_usd("dclaw4") == first
    assert first.read_text() == whole
    assert [p.name for p in first.parent.iterdir()] == [first.name]  # no temporary files


def test_changed_description_gets_another_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import dataclasses

    monkeypatch.setenv("VD_ASSETS", str(tmp_path))
    before = hand_usd("dclaw3")
    changed = dataclasses.replace(HANDS["dclaw3"], contact_gap=0.003)
    monkeypatch.setattr("vd.assets_usd.hand_author.HANDS", {"dclaw3": changed})
    after = hand_usd("dclaw3")
    assert after != before
    assert read_hand(after).shapes[0].gap == pytest.approx(0.003)


def test_default_cache_is_in_the_home(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("VD_ASSETS", raising=False)
    assert assets_dir() == Path.home() / ".cache" / "visual-dexterity"


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usd"])
def test_every_usd_format(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"hand{suffix}"
    author_hand(HANDS["dclaw3"], path)
    assert read_hand(path).num_joints == 9


def test_wrong_name_and_suffix_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"'shadow'.*dclaw3, dclaw4"):
        hand_usd("shadow")
    with pytest.raises(ValueError, match=r"hand\.obj.*\.usda"):
        author_hand(HANDS["dclaw3"], tmp_path / "hand.obj")


def test_rewritten_file_is_read_anew(tmp_path: Path) -> None:
    path = tmp_path / "hand.usda"
    author_hand(HANDS["dclaw3"], path)
    held = open_stage(path)
    author_hand(HANDS["dclaw4"], path)
    assert read_hand(path).name == "dclaw4"
    del held


def test_surface_samples_lie_on_the_drawn_surface(hand: HandModel) -> None:
    assert hand.link_points.shape == (4 * hand.num_fingers, 500, 3)
    assert hand.point_names[:5] == ("f0_motor", "f0_l1", "f0_l2", "f0_l3", "f1_motor")
    for name, link, points in zip(hand.point_names, hand.point_link, hand.link_points, strict=True):
        motor = name.endswith("motor")
        assert hand.link_names[link] == ("base" if motor else name)
        if not name.startswith("f0"):
            continue
        mesh = drawn(hand, "base" if motor else name, name if motor else "")
        corners = 1e3 * np.tile(mesh.triangles, (len(points), 1, 1))  # mm: trimesh's tolerances are absolute
        targets = 1e3 * np.repeat(points, len(mesh.faces), axis=0).astype(float)
        distance = np.linalg.norm(trimesh.triangles.closest_point(corners, targets) - targets, axis=1)
        assert distance.reshape(len(points), -1).min(axis=1).max() < 1e-3
        assert np.unique(points, axis=0).shape == (500, 3)
        # They cover the link: no part of its box is far from every sample.
        np.testing.assert_allclose(points.min(axis=0), mesh.bounds[0], atol=0.004)
        np.testing.assert_allclose(points.max(axis=0), mesh.bounds[1], atol=0.004)


def test_fingers_carry_the_same_samples(hand: HandModel) -> None:
    links = [i for i, name in enumerate(hand.point_names) if name.endswith("l2")]
    for other in links[1:]:
        np.testing.assert_array_equal(hand.link_points[links[0]], hand.link_points[other])


def test_samples_are_uniform_by_area_on_the_outside() -> None:
    """Two overlapping boxes: no sample inside either, and densities as the areas."""
    parts = [solid_mesh(Box((0.02, 0.02, 0.02))), solid_mesh(Box((0.02, 0.02, 0.04), Pose((0.0, 0.0, 0.02))))]
    points = surface_points(parts, 4000, seed=3)
    inside = (np.abs(points[:, :2]).max(axis=1) < 0.0099) & (points[:, 2] > -0.0099) & (points[:, 2] < 0.0399)
    assert not inside.any()
    top = np.isclose(points[:, 2], 0.04)
    # 4 cm^2 of 4 + 4 + sides of 4 x 2 x 5 cm^2, of which 4 x 2 x 1 cm^2 are drawn twice (faces coincide)
    assert top.mean() == pytest.approx(4 / (4 + 4 + 40 + 8), abs=0.012)
    np.testing.assert_array_equal(points, surface_points(parts, 4000, seed=3))


@pytest.mark.parametrize(
    ("solid", "volume", "low", "high"),
    [
        (Box((0.02, 0.04, 0.06)), 4.8e-5, (-0.01, -0.02, -0.03), (0.01, 0.02, 0.03)),
        (Box((0.02, 0.04, 0.06), bevel=0.001), 4.8e-5, (-0.01, -0.02, -0.03), (0.01, 0.02, 0.03)),
        (Sphere(0.01, Pose((0, 0, 1.0))), 4.19e-6, (-0.01, -0.01, 0.99), (0.01, 0.01, 1.01)),
        (Capsule(0.01, 0.04), 1.676e-5, (-0.01, -0.01, -0.03), (0.01, 0.01, 0.03)),
        (Capsule(0.01, 0.04, axis="X"), 1.676e-5, (-0.03, -0.01, -0.01), (0.03, 0.01, 0.01)),
        (Cylinder(0.01, 0.04, axis="Y"), 1.257e-5, (-0.01, -0.02, -0.01), (0.01, 0.02, 0.01)),
        (
            Cylinder(0.01, 0.04, Pose(quaternion=(HALF, 0, 0, HALF)), bevel=0.001),
            1.257e-5,
            (-0.01, -0.02, -0.01),
            None,
        ),
        (Taper((0.02, 0.02), 0.01, 0.03), 1.07e-5, (-0.01, -0.01, 0.0), (0.01, 0.01, 0.03)),
    ],
)
def test_solids_are_closed_and_of_the_right_size(
    solid: Solid, volume: float, low: tuple[float, ...], high: tuple[float, ...] | None
) -> None:
    mesh = solid_mesh(solid)
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert shape.is_watertight
    assert shape.volume == pytest.approx(volume, rel=0.06)  # positive: faces are turned outward
    np.testing.assert_allclose(shape.bounds[0], low, atol=2e-4)
    if high is not None:
        np.testing.assert_allclose(shape.bounds[1], high, atol=2e-4)


def test_unknown_solid_is_refused() -> None:
    with pytest.raises(TypeError, match=r"Pose.*Box, Sphere"):
        solid_mesh(Pose())


def test_every_link_is_drawn_and_every_collider_has_friction(hand: HandModel) -> None:
    stage = open_stage(hand.path)
    for link in hand.link_names:
        assert 200 <= len(drawn(hand, link).faces) <= 2000
    for prim in Usd.PrimRange(stage.GetDefaultPrim()):
        if prim.HasAPI(UsdPhysics.CollisionAPI):
            material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
            api = UsdPhysics.MaterialAPI(material.GetPrim())
            assert api.GetStaticFrictionAttr().Get() == api.GetDynamicFrictionAttr().Get() > 0.0
            assert UsdGeom.Imageable(prim).ComputePurpose() == UsdGeom.Tokens.guide  # never drawn
