"""Newton's import of a hand equals what :func:`read_hand` says about it."""

import newton
import numpy as np
import pytest
import warp as wp
from small_scenes import REST_SPIN, SmallScene
from test_hand_import import write_urdf

from vd.assets_usd.hand_import.importer import import_hand
from vd.assets_usd.hand_model import HandModel, open_stage, read_hand
from vd.assets_usd.hands import hand_usd
from vd.sim.cfg import SimCfg
from vd.sim.scene import build_hand, new_builder

MOUNT = ((0.0, 0.0, 0.25), (0.0, 1.0, 0.0, 0.0))
"""Base frame in the world: 0.25 m up, turned by pi about +y."""


@pytest.fixture(
    scope="module",
    params=[(n, t) for n in ("dclaw3", "dclaw4") for t in ("rigid", "soft")],
    ids="-".join,
)
def imported(request: pytest.FixtureRequest) -> tuple[HandModel, newton.ModelBuilder]:
    name, fingertip = request.param
    path = hand_usd(name)
    builder = newton.ModelBuilder()
    builder.add_usd(
        open_stage(path, fingertip),
        xform=wp.transform(*MOUNT),
        floating=False,
        load_visual_shapes=False,
    )
    return read_hand(path, fingertip=fingertip), builder


def test_joints(imported: tuple[HandModel, newton.ModelBuilder]) -> None:
    hand, builder = imported
    types = [newton.JointType(t) for t in builder.joint_type]
    assert types == [newton.JointType.FIXED] + [newton.JointType.REVOLUTE] * hand.num_joints
    assert [label.rsplit("/")[-1] for label in builder.joint_label[1:]] == list(hand.joint_names)
    assert [label.rsplit("/")[-1] for label in builder.body_label] == list(hand.link_names)
    assert builder.joint_parent[1:] == hand.joint_parent.tolist()
    assert builder.joint_child[1:] == hand.joint_child.tolist()
    for values, expected in (
        (builder.joint_limit_lower, hand.lower),
        (builder.joint_limit_upper, hand.upper),
        (builder.joint_target_ke, hand.kp),
        (builder.joint_target_kd, hand.kd),
        (builder.joint_effort_limit, hand.effort),
        (builder.joint_velocity_limit, hand.velocity_limit),
        (builder.joint_armature, hand.armature),
    ):
        np.testing.assert_allclose(values, expected, rtol=1e-6)
    assert set(builder.joint_target_mode) == {int(newton.JointTargetMode.POSITION)}


def test_bodies(imported: tuple[HandModel, newton.ModelBuilder]) -> None:
    hand, builder = imported
    np.testing.assert_allclose(builder.body_mass, hand.link_mass, rtol=1e-6)
    np.testing.assert_allclose(np.array(builder.body_com), hand.link_com, atol=1e-8)
    inertia = np.array([np.array(i).reshape(3, 3) for i in builder.body_inertia])
    np.testing.assert_allclose(inertia, hand.link_inertia, rtol=1e-5, atol=1e-10)


def test_shapes(imported: tuple[HandModel, newton.ModelBuilder]) -> None:
    hand, builder = imported
    kinds = {"box": newton.GeoType.BOX, "capsule": newton.GeoType.CAPSULE}
    for shape in hand.shapes:
        i = builder.shape_label.index(shape.path)
        assert builder.shape_body[i] == shape.link
        assert builder.shape_type[i] == kinds[shape.kind]
        np.testing.assert_allclose(
            tuple(builder.shape_scale[i])[: len(shape.size)], shape.size, rtol=1e-6
        )
        np.testing.assert_allclose(
            tuple(builder.shape_transform[i])[:3], shape.frame[:3], atol=1e-7
        )
        assert abs(np.dot(tuple(builder.shape_transform[i])[3:], shape.frame[3:])) == pytest.approx(
            1.0, abs=1e-6
        )
        assert builder.shape_material_mu[i] == pytest.approx(shape.friction, rel=1e-6)
    colliding = [
        i for i, f in enumerate(builder.shape_flags) if f & newton.ShapeFlags.COLLIDE_SHAPES
    ]
    assert len(colliding) == len(hand.shapes)


def test_sites(imported: tuple[HandModel, newton.ModelBuilder]) -> None:
    hand, builder = imported
    sites = [i for i, f in enumerate(builder.shape_flags) if f & newton.ShapeFlags.SITE]
    for i, link, frame in zip(sites, hand.tip_link, hand.tip_frame, strict=True):
        assert builder.shape_body[i] == link
        np.testing.assert_allclose(tuple(builder.shape_transform[i]), frame, atol=1e-6)


@pytest.mark.parametrize("soft", [True, False])
def test_a_light_finger_that_is_pressed_onto_an_end_rests_if_the_end_is_soft(tmp_path, soft):
    """Driven as LEAP is; without what the import writes of ends, Newton's own rattle."""
    (tmp_path / "said.yaml").write_text("drive: {kp: 3.0, kd: 0.2, effort: 0.28, armature: 0.0015}")
    hand = import_hand(write_urdf(tmp_path), tmp_path / "out", tmp_path / "said.yaml").hand
    if not soft:
        lines = hand.path.read_text().splitlines()
        hand.path.write_text("\n".join(line for line in lines if "solreflimit" not in line))
    cfg = SimCfg()
    world = build_hand(hand, cfg, visuals=False)
    world.gravity = (0.0, 0.0, 0.0)
    builder = new_builder()
    builder.add_world(world)
    scene = SmallScene(builder, cfg, "cpu")
    scene.control.joint_target_q.assign((hand.lower - 0.3).astype(np.float32))
    scene.run(2.0)
    moved = hand.actuated
    fastest = 0.0
    for _ in range(60):
        scene.run(cfg.physics_dt)
        fastest = max(fastest, np.abs(scene.state.joint_qd.numpy()[moved]).max())
    assert (fastest < REST_SPIN) == soft
    if soft:
        ends = scene.state.joint_q.numpy()[moved]
        np.testing.assert_allclose(ends, hand.lower[moved], atol=0.01)
