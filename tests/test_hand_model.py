"""The hands as read from USD, against numbers typed in here from the published tables."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import newton
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import CAMERA_M, invert, placed
from vd.assets_usd.hand_model import HandError, HandModel, open_stage, read_hand
from vd.assets_usd.hands import hand_usd

HANDS = ("dclaw3", "dclaw4")
FINGERTIPS = ("rigid", "soft")

# First joint of each finger: heading [deg], and position in the finger's heading frame [m].
HEADINGS = {"dclaw3": (-60.0, 60.0, 180.0), "dclaw4": (-105.31, -15.31, 74.69, 164.69)}
FIRST_JOINT = {"dclaw3": (0.060, 0.0, 0.01725), "dclaw4": (0.0878, -0.0375, 0.0206)}
SPACING, TIP = 0.0685, 0.075
LOWER, UPPER = (-0.45, -2.0, -2.0), (1.35, 2.0, 2.0)
RESET = (0.0, 0.8, -1.1)


@pytest.fixture(scope="module", params=HANDS)
def hand(request: pytest.FixtureRequest) -> HandModel:
    return read_hand(hand_usd(request.param))


@pytest.fixture(scope="module")
def four_fingers() -> HandModel:
    return read_hand(hand_usd("dclaw4"))


def table_tips(name: str, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions [F, 3] and rotation matrices [F, 3, 3] of the tips from the tables."""
    positions, rotations = [], []
    for finger, heading in enumerate(HEADINGS[name]):
        q1, q2, q3 = q[3 * finger : 3 * finger + 3]
        turn = Rotation.from_euler("Z", heading, degrees=True).as_matrix()
        swing, bend, curl = (
            Rotation.from_euler("XYZ", (q1, angle, 0.0)).as_matrix() for angle in (0.0, q2, q2 + q3)
        )
        reach = swing @ (0, 0, SPACING) + bend @ (0, 0, SPACING) + curl @ (0, 0, TIP)
        positions.append(turn @ (np.array(FIRST_JOINT[name]) + reach))
        rotations.append(turn @ curl)
    return np.array(positions), np.array(rotations)


def assert_tips(hand: HandModel, q: np.ndarray) -> None:
    positions, rotations = table_tips(hand.name, q)
    poses = hand.tip_poses(q)
    np.testing.assert_allclose(poses[:, :3], positions, atol=1e-7)
    np.testing.assert_allclose(Rotation.from_quat(poses[:, 3:]).as_matrix(), rotations, atol=2e-6)


def test_four_fingers_reset_as_in_released_code(four_fingers: HandModel) -> None:
    """Radius 0.120 m and world height 0.0415 m.

    The dropped tilt of 0.54 degrees is worth about 1 mm.
    """
    tips = four_fingers.tip_poses(np.tile(RESET, 4))
    np.testing.assert_allclose(np.hypot(tips[:, 0], tips[:, 1]), 0.120, atol=0.0015)
    np.testing.assert_allclose(0.25 - tips[:, 2], 0.0415, atol=0.0005)
    straight = four_fingers.tip_poses(np.zeros(12))
    np.testing.assert_allclose(0.25 - straight[:, 2], 0.0174, atol=0.0005)


@settings(max_examples=30, deadline=None)
@given(npst.arrays(float, 12, elements=st.floats(0.0, 1.0)))
def test_tips_at_any_pose(hand: HandModel, unit: np.ndarray) -> None:
    unit = unit.reshape(4, 3)[: hand.num_fingers]
    q = (np.array(LOWER) + unit * (np.array(UPPER) - LOWER)).ravel()
    assert_tips(hand, q)


def test_kinematics_of_a_batch(hand: HandModel) -> None:
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 3, hand.num_joints))
    poses = hand.forward_kinematics(q)
    assert poses.shape == (2, 3, len(hand.link_names), 7)
    np.testing.assert_allclose(poses[1, 2], hand.forward_kinematics(q[1, 2]), atol=1e-12)
    with pytest.raises(ValueError, match="last axis"):
        hand.forward_kinematics(np.zeros(hand.num_joints + 1))


def drawn(hand: HandModel, link: str, prefix: str = "") -> trimesh.Trimesh:
    """The drawn meshes of a link, as one."""
    stage, parts = open_stage(hand.path), []
    for prim in stage.GetPrimAtPath(f"/{hand.name}/{link}/visual").GetChildren():
        if prim.GetName().startswith(prefix):
            points = np.array(prim.GetAttribute("points").Get(), dtype=float)
            faces = np.array(prim.GetAttribute("faceVertexIndices").Get()).reshape(-1, 3)
            parts.append(trimesh.Trimesh(points, faces, process=False))
    return trimesh.util.concatenate(parts)


def test_surface_samples_lie_on_the_drawn_surface_and_cover_it(hand: HandModel) -> None:
    assert hand.link_points.shape == (4 * hand.num_fingers, 500, 3)
    names = ("f0_motor", "f0_l1", "f0_l2", "f0_l3")
    for name, link, points in zip(names, hand.point_link, hand.link_points, strict=False):
        motor = name.endswith("motor")
        assert hand.link_names[link] == ("base" if motor else name)
        mesh = drawn(hand, "base" if motor else name, name if motor else "")
        # In mm: trimesh's tolerances are absolute.
        corners = 1e3 * np.tile(mesh.triangles, (len(points), 1, 1))
        targets = 1e3 * np.repeat(points, len(mesh.faces), axis=0).astype(float)
        distance = np.linalg.norm(
            trimesh.triangles.closest_point(corners, targets) - targets, axis=1
        )
        assert distance.reshape(len(points), -1).min(axis=1).max() < 1e-3
        np.testing.assert_allclose(points.min(axis=0), mesh.bounds[0], atol=0.004)
        np.testing.assert_allclose(points.max(axis=0), mesh.bounds[1], atol=0.004)


def test_camera_against_the_published_pose(four_fingers: HandModel) -> None:
    camera = four_fingers.camera
    assert (camera.width, camera.height) == (320, 180)
    assert camera.far == 1.5
    np.testing.assert_allclose(
        (camera.fx, camera.fy, camera.cx, camera.cy), (256.05, 256.05, 160, 90), rtol=1e-6
    )
    flip = np.diag([-1.0, 1.0, -1.0])  # base to world: pi about +y
    turn = flip @ Rotation.from_quat(camera.quaternion).as_matrix()
    np.testing.assert_allclose(
        flip @ camera.position + (0, 0, 0.25), (-0.574, 0.034, 0.285), atol=5e-4
    )
    np.testing.assert_allclose(turn[:, 2], (0.902, 0.018, -0.431), atol=1e-3)  # optical axis
    np.testing.assert_allclose(turn[:, 0], (0.016, -1.000, -0.007), atol=1e-3)  # right


def test_camera_projects_as_usd_does(hand: HandModel) -> None:
    """The UsdGeomCamera, through USD's own frustum, and the model agree on where points appear."""
    stage = open_stage(hand.path)
    prim = UsdGeom.Camera(stage.GetPrimAtPath(f"/{hand.name}/base/camera"))
    frustum = prim.GetCamera(Usd.TimeCode.Default()).frustum
    chain = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix())
    points = np.random.default_rng(0).uniform((-0.1, -0.1, 0.05), (0.1, 0.1, 0.25), (50, 3))
    clip = np.c_[points, np.ones(50)] @ chain  # base frame = world of the stage
    ndc = clip[:, :3] / clip[:, 3:]
    expected = np.c_[(ndc[:, 0] + 1) / 2 * 320, (1 - ndc[:, 1]) / 2 * 180]
    got = hand.camera.project(points)
    np.testing.assert_allclose(got[:, :2], expected, atol=1e-3)
    np.testing.assert_allclose(got[:, 2], clip[:, 3], atol=1e-6)
    assert np.all((got[:, 0] > 0) & (got[:, 0] < 320) & (got[:, 1] > 0) & (got[:, 1] < 180))


def edited(path: Path, folder: Path, change: Callable[[Usd.Stage, str], None]) -> Path:
    """A copy of a hand's file with one change."""
    copy = folder / "broken.usda"
    copy.write_bytes(path.read_bytes())
    stage = Usd.Stage.Open(str(copy))
    change(stage, str(stage.GetDefaultPrim().GetPath()))
    stage.Save()
    return copy


def prim_at(stage: Usd.Stage, root: str, prim: str) -> Usd.Prim:
    """The prim below the root, or the root for no name."""
    return stage.GetPrimAtPath(f"{root}/{prim}" if prim else root)


def setting(prim: str, attribute: str, value: object) -> Callable[[Usd.Stage, str], None]:
    return lambda stage, root: prim_at(stage, root, prim).GetAttribute(attribute).Set(value)


def clearing(prim: str, attribute: str) -> Callable[[Usd.Stage, str], None]:
    def change(stage: Usd.Stage, root: str) -> None:
        prim_at(stage, root, prim).RemoveProperty(attribute)

    return change


def removing(prim: str) -> Callable[[Usd.Stage, str], None]:
    def change(stage: Usd.Stage, root: str) -> None:
        stage.RemovePrim(f"{root}/{prim}")

    return change


def aiming(prim: str, relationship: str, target: str) -> Callable[[Usd.Stage, str], None]:
    def change(stage: Usd.Stage, root: str) -> None:
        found = stage.GetPrimAtPath(f"{root}/{prim}").GetRelationship(relationship)
        found.SetTargets([Sdf.Path(f"{root}/{target}")])

    return change


def longer(joints: int) -> Callable[[Usd.Stage, str], None]:
    """The first finger with so many joints, copies of the third.

    The last bends as much as the one before.
    """

    def change(stage: Usd.Stage, root: str) -> None:
        layer = stage.GetRootLayer()
        for number in range(4, joints + 1):
            for kind in "lj":
                Sdf.CopySpec(layer, f"{root}/f0_{kind}3", layer, f"{root}/f0_{kind}{number}")
            joint = stage.GetPrimAtPath(f"{root}/f0_j{number}")
            for side in (0, 1):
                link = Sdf.Path(f"{root}/f0_l{number - 1 + side}")
                joint.GetRelationship(f"physics:body{side}").SetTargets([link])
            joint.GetAttribute("vd:motor:id").Set(100 + number)
        follow(joint, f"{root}/f0_j{joints - 1}")

    return change


def follow(joint: Usd.Prim, leader: str) -> None:
    for name in ("physics:stiffness", "physics:damping"):
        joint.GetAttribute(f"drive:angular:{name}").Set(0.0)
    joint.ApplyAPI("NewtonMimicAPI")
    joint.CreateRelationship("newton:mimicJoint").SetTargets([Sdf.Path(leader)])
    joint.CreateAttribute("newton:mimicCoef0", Sdf.ValueTypeNames.Float).Set(10.0)
    joint.CreateAttribute("newton:mimicCoef1", Sdf.ValueTypeNames.Float).Set(0.5)


def following_in_turn(stage: Usd.Stage, root: str) -> None:
    for number in (2, 3):
        follow(stage.GetPrimAtPath(f"{root}/f0_j{number}"), f"{root}/f0_j{number - 1}")


def fixed_link(stage: Usd.Stage, root: str) -> None:
    joint = UsdPhysics.FixedJoint.Define(stage, f"{root}/weld")
    joint.CreateBody0Rel().SetTargets([Sdf.Path(f"{root}/base")])
    joint.CreateBody1Rel().SetTargets([Sdf.Path(f"{root}/f0_l1")])


def mesh_collider(stage: Usd.Stage, root: str) -> None:
    UsdPhysics.CollisionAPI.Apply(stage.GetPrimAtPath(f"{root}/f0_l1/visual/servo"))


@pytest.mark.parametrize(
    ("change", "prim", "words"),
    [
        (removing("f1_j2"), "f1_j2", ("missing", "export the hand again")),
        (removing("f1_l1"), "dclaw4", ("f1_l2", "without gaps")),
        (clearing("f0_l2", "physics:mass"), "f0_l2", ("physics:mass", "not authored")),
        (
            setting("f0_l2", "physics:diagonalInertia", Gf.Vec3f(9, 1, 1)),
            "f0_l2",
            ("diagonalInertia", "sum of two"),
        ),
        (setting("f0_j3", "physics:lowerLimit", 200.0), "f0_j3", ("lowerLimit", "upperLimit")),
        (
            setting("f0_j3", "drive:angular:physics:stiffness", float("nan")),
            "f0_j3",
            ("stiffness", "positive"),
        ),
        (aiming("f0_j2", "physics:body1", "f1_l2"), "f0_j2", ("joins other links", "f0_l2")),
        (aiming("f0_j2", "physics:body1", "camera"), "f0_j2", ("physics:body1", "one link")),
        (
            setting("f0_l2/points", "points", [Gf.Vec3f(0)] * 3),
            "f0_l2/points",
            ("points", "(3, 3)"),
        ),
        (longer(7), "dclaw4", ("finger 0 has 7 joints", "weld")),
        (following_in_turn, "f0_j3", ("follows f0_j2, which follows another",)),
        (fixed_link, "weld", ("besides those of the fingers", "weld it")),
        (mesh_collider, "f0_l1/visual/servo", ("physics:approximation", "convex parts")),
        (setting("f0_j2", "vd:start", 3.0), "f0_j2", ("vd:start", "within its limits")),
        (setting("f0_j2", "vd:motor:id", 10), "f0_j2", ("vd:motor:id", "another joint's")),
        (setting("f0_j2", "vd:motor:sign", 0.5), "f0_j2", ("vd:motor:sign", "or -1")),
        (setting("", "vd:palm", Gf.Vec3d(0)), "dclaw4", ("vd:palm", "direction")),
        (
            setting("", "vd:workspace:size", Gf.Vec2d(2, 1)),
            "dclaw4",
            ("vd:workspace:size", "smallest first"),
        ),
        (clearing("", "vd:mount:position"), "dclaw4", ("vd:mount:position", "not authored")),
        (
            lambda stage, root: UsdGeom.SetStageMetersPerUnit(stage, 0.01),
            "/",
            ("metersPerUnit", "metres"),
        ),
        (lambda stage, root: UsdGeom.SetStageUpAxis(stage, "Y"), "/", ("upAxis", "z up")),
    ],
)
def test_broken_hand_is_refused_with_the_reason(
    tmp_path: Path,
    four_fingers: HandModel,
    change: Callable[[Usd.Stage, str], None],
    prim: str,
    words: tuple[str, ...],
) -> None:
    broken = edited(four_fingers.path, tmp_path, change)
    with pytest.raises(HandError) as caught:
        read_hand(broken)
    message = str(caught.value)
    for word in (str(broken), prim, *words):
        assert word in message


def test_fingers_may_differ_and_joints_follow_others(
    tmp_path: Path, four_fingers: HandModel
) -> None:
    hand = read_hand(edited(four_fingers.path, tmp_path, longer(5)))
    assert hand.fingers == (slice(0, 5), slice(5, 8), slice(8, 11), slice(11, 14))
    assert hand.joint_names[:6] == ("f0_j1", "f0_j2", "f0_j3", "f0_j4", "f0_j5", "f1_j1")
    assert hand.num_joints == 14 and hand.link_names[hand.tip_link[0]] == "f0_l5"
    assert hand.mimic[4] == 3 and (np.delete(hand.mimic, 4) == -1).all()
    assert (hand.mimic_factor[4], hand.mimic_offset[4]) == pytest.approx((0.5, np.radians(10.0)))
    assert list(hand.actuated) == [0, 1, 2, 3, *range(5, 14)]
    builder = newton.ModelBuilder()
    builder.add_usd(open_stage(hand.path), floating=False)
    assert builder.joint_mimic_joint[5] == 4, (
        "Newton couples them too; its first joint fixes the base"
    )
    assert builder.joint_mimic_coeffs[5] == pytest.approx((np.radians(10.0), 0.5))


@pytest.mark.parametrize("up", [False, True])
def test_without_a_camera_one_looks_at_where_objects_are_handled(
    tmp_path: Path, four_fingers: HandModel, up: bool
) -> None:
    blind = read_hand(edited(four_fingers.path, tmp_path, removing("base/camera")))
    assert blind.mounted_camera is None
    if up:
        blind = replace(blind, mount=np.array([0.1, 0.0, 0.05, 0.0, 0.0, 0.0, 1.0]))
    assert blind.palm_up == up
    camera = blind.camera
    assert camera.project(blind.goal_in_base) == pytest.approx([160.0, 90.0, CAMERA_M])
    away = placed(blind.mount, camera.position) - np.array(blind.workspace.goal_m)
    assert away == pytest.approx([0.0, 0.0, CAMERA_M] if up else [CAMERA_M, 0.0, 0.0])
    aside = np.array([0.05, 0.0, 0.05])
    above = placed(invert(blind.mount), aside + blind.workspace.goal_m)
    column, row, _ = camera.project(above)
    assert column == pytest.approx(160.0) and row < 90.0, "the image is upright"


def test_missing_and_foreign_files_are_refused(tmp_path: Path, four_fingers: HandModel) -> None:
    with pytest.raises(HandError, match=r"name a hand"):
        read_hand(tmp_path / "absent.usda")
    garbage = tmp_path / "garbage.usda"
    garbage.write_text("solid not usd\n")
    with pytest.raises(HandError, match=r"garbage\.usda: not"):
        read_hand(garbage)
    with pytest.raises(HandError, match=r"'velvet'.*rigid, soft"):
        read_hand(four_fingers.path, fingertip="velvet")
