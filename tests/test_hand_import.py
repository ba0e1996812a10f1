"""Hands from URDF and MJCF.

What the USD says against what MuJoCo reads in the same file, and refusals.
"""

import importlib.util
import itertools
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import newton
import numpy as np
import pytest
import trimesh
import warp as wp
from scipy.spatial.transform import Rotation
from small_scenes import SmallScene

from vd.assets_usd import cli
from vd.assets_usd.hand_data import HandError, HandModel
from vd.assets_usd.hand_import import importer
from vd.assets_usd.hand_import.description import read_description
from vd.assets_usd.hand_import.importer import import_hand
from vd.assets_usd.hand_import.sheet import joint_table
from vd.assets_usd.hand_import.source import read_source
from vd.assets_usd.hand_model import open_stage, read_hand
from vd.assets_usd.hands import hand_usd, load_hand
from vd.assets_usd.objects.sets import load_set
from vd.envs.cfg import ObservationCfg, RandomisationCfg, ReorientCfg, TableCfg
from vd.envs.reorient import ReorientEnv
from vd.evaluate.bowl import share_kept
from vd.policy.bundle import read_policy
from vd.sim.cfg import SimCfg
from vd.sim.scene import SHAPE_OBJECT, build_hand, build_scene, new_builder
from vd.sim.simulator import Simulator
from vd.train.cli import main as train

REAL = ("leap", "allegro")
ROOT = Path(__file__).resolve().parents[1]


def link(name: str, length: float, shape: str = "", *, mass: float = 0.03) -> str:
    """A link along z with its mass in its middle and a box, or another shape."""
    shape = shape or f'<box size="0.02 0.018 {length}"/>'
    geometry = f'<origin xyz="0 0 {length / 2}" rpy="0.1 0 0"/><geometry>{shape}</geometry>'
    inertia = 'ixx="2e-5" iyy="2.2e-5" izz="1e-5" ixy="1e-7" ixz="0" iyz="2e-7"'
    return (
        f'<link name="{name}"><inertial><origin xyz="0 0.001 {length / 2}" rpy="0 0.2 0.1"/>'
        f'<mass value="{mass}"/><inertia {inertia}/></inertial><collision>{geometry}</collision></link>'
    )


def joint(
    name: str, parent: str, child: str, origin: str, axis: str = "0 1 0", more: str = ""
) -> str:
    limit = '<limit lower="-0.2" upper="1.4" effort="0.7" velocity="6"/>'
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin {origin}/><axis xyz="{axis}"/>{limit}{more}</joint>'
    )


def fixed(name: str, parent: str, child: str, origin: str) -> str:
    return joint(name, parent, child, origin).replace("revolute", "fixed")


MESH = '<mesh filename="knob.stl" scale="0.001 0.001 0.001"/>'
MIMIC = '<mimic joint="b3" multiplier="0.8" offset="0.05"/>'
PARTS = [
    link("wrist", 0.05, mass=0.3),
    link("palm", 0.08, mass=0.2),
    fixed("weld", "wrist", "palm", 'xyz="0 0 0.05" rpy="0 0 0.3"'),
    link("a_1", 0.05),
    joint("a1", "palm", "a_1", 'xyz="0 0.03 0.08" rpy="0.2 0 0.1"'),
    link("a_2", 0.04, MESH),
    joint("a2", "a_1", "a_2", 'xyz="0 0 0.05"'),
    '<link name="a_tip"/>',
    fixed("a3", "a_2", "a_tip", 'xyz="0 0 0.05"'),
    link("b_1", 0.03),
    joint("b1", "palm", "b_1", 'xyz="0.01 -0.03 0.08"', "1 0 0.2"),
    link("b_2", 0.04, '<sphere radius="0.012"/>'),
    joint("b2", "b_1", "b_2", 'xyz="0 0 0.03" rpy="0 0.1 0"'),
    link("b_3", 0.03, '<cylinder radius="0.01" length="0.03"/>'),
    joint("b3", "b_2", "b_3", 'xyz="0 0 0.04"', "0 0.6 0.8"),
    link("b_4", 0.03),
    joint("b4", "b_3", "b_4", 'xyz="0 0 0.03"', more=MIMIC),
]
"""A hand of 2 and 4 joints, of which the last follows the third, with a fixed frame and a mesh to
collide.
"""


def write_urdf(folder: Path, parts: list[str] | None = None) -> Path:
    trimesh.creation.box((20.0, 16.0, 40.0)).export(folder / "knob.stl")
    path = folder / "toy.urdf"
    path.write_text(f'<robot name="toy">{"".join(parts or PARTS)}</robot>')
    return path


def write_mjcf(folder: Path, model: mujoco.MjSpec) -> Path:
    """The same hand as an MJCF, with what an MJCF has beside.

    Motors, a site, armature, an excluded pair.
    """
    for body in model.bodies:
        for one in body.joints:
            one.armature, one.damping = 0.002, [0.01, 0.0, 0.0]
            if one.name == "b4":
                continue
            motor = model.add_actuator(name=f"motor {one.name}", target=one.name)
            motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
            motor.set_to_position(kp=2.0, kv=0.1)
            motor.forcelimited, motor.forcerange = 1, [-0.7, 0.7]
    model.body("b_4").add_site(name="b_tip", pos=[0.0, 0.0, 0.031])
    model.add_exclude(bodyname1="a_1", bodyname2="b_1")
    coupling = model.add_equality(name="coupling", name1="b4", name2="b3")
    coupling.type, coupling.objtype = mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtObj.mjOBJ_JOINT
    coupling.data[:2] = 0.05, 0.8
    model.compile()
    path = folder / "toy.xml"
    path.write_text(model.to_xml())
    return path


def oracle(path: Path) -> mujoco.MjSpec:
    """What MuJoCo reads in the file, with frames kept."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic, spec.compiler.balanceinertia = 0, 1
    return spec


@pytest.fixture(scope="module", params=["urdf", "mjcf"])
def toy(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory):
    """A source of the toy hand, what was imported of it, and MuJoCo's model."""
    folder = tmp_path_factory.mktemp(request.param)
    path = write_urdf(folder)
    if request.param == "mjcf":
        path = write_mjcf(folder, oracle(path))
    return import_hand(path, folder / "out"), oracle(path).compile()


def assert_like_mujoco(hand: HandModel, sources: list[str], model: mujoco.MjModel) -> None:
    """Frames of all links, masses and centres of all that moves, and limits."""
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    number = [model.joint(name).id for name in sources]
    for _ in range(5):
        q = rng.uniform(hand.lower, hand.upper)
        data.qpos[model.jnt_qposadr[number]] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        links = hand.forward_kinematics(q)
        bodies = [data.body(model.jnt_bodyid[j]) for j in number]
        base = data.body(1)
        turn = Rotation.from_quat(base.xquat[[1, 2, 3, 0]])
        for pose, body, joint_id in zip(links[1:], bodies, number, strict=True):
            np.testing.assert_allclose(turn.apply(pose[:3]) + base.xpos, body.xpos, atol=1e-6)
            off = (turn * Rotation.from_quat(pose[3:])).inv() * Rotation.from_quat(
                body.xquat[[1, 2, 3, 0]]
            )
            assert off.magnitude() < 1e-5
            below = model.body_subtreemass[model.jnt_bodyid[joint_id]]
            finger = next(
                f
                for f in hand.fingers
                if sources.index(model.joint(joint_id).name) in range(f.start, f.stop)
            )
            first = sources.index(model.joint(joint_id).name)
            assert hand.link_mass[first + 1 : finger.stop + 1].sum() == pytest.approx(
                below, rel=1e-5
            )
        centre = (
            hand.link_mass[:, None]
            * (links[:, :3] + Rotation.from_quat(links[:, 3:]).apply(hand.link_com))
        ).sum(0)
        centre = turn.apply(centre / hand.link_mass.sum()) + base.xpos
        np.testing.assert_allclose(centre, data.subtree_com[1], atol=1e-5)
    np.testing.assert_allclose(
        np.stack([hand.lower, hand.upper], axis=1), model.jnt_range[number], atol=1e-6
    )


def test_the_usd_is_the_hand_that_mujoco_reads(toy):
    done, model = toy
    hand = done.hand
    assert done.sources == ["a1", "a2", "b1", "b2", "b3", "b4"]
    assert hand.fingers == (slice(0, 2), slice(2, 6))
    assert_like_mujoco(hand, done.sources, model)
    assert list(hand.mimic) == [-1, -1, -1, -1, -1, 4] and list(hand.actuated) == [0, 1, 2, 3, 4]
    assert (hand.mimic_factor[5], hand.mimic_offset[5]) == pytest.approx((0.8, 0.05))
    assert (hand.kp[5], hand.kd[5]) == (0.0, 0.0), "what follows has no drive"
    np.testing.assert_allclose(hand.effort, 0.7)
    assert hand.start[5] == pytest.approx(0.05) and not hand.start[:5].any()
    np.testing.assert_allclose(hand.tip_frame[0, :3], [0.0, 0.0, 0.05], atol=1e-7)
    kinds = [shape.kind for shape in hand.shapes]
    assert sorted(kinds) == ["box"] * 5 + ["cylinder", "hull", "sphere"]
    (hull,) = (shape for shape in hand.shapes if shape.kind == "hull")
    assert trimesh.convex.convex_hull(hull.vertices).volume == pytest.approx(
        0.02 * 0.016 * 0.04, rel=1e-4
    )
    tips = [shape.link for shape in hand.shapes if shape.fingertip]
    assert tips == list(hand.tip_link)
    assert hand.palm_up and hand.workspace.drop_m[2] > hand.workspace.goal_m[2] > 0.05
    heights = [pose[2] for pose in HandWorld(hand).link_poses(hand.start)]
    assert min(heights) > 0.0, "mounted over the ground"


class HandWorld:
    """The hand's USD as Newton reads it."""

    def __init__(self, hand: HandModel):
        self.builder = newton.ModelBuilder()
        self.builder.add_usd(open_stage(hand.path), xform=wp.transform(*hand.mount), floating=False)
        self.model = self.builder.finalize(device="cpu")

    def link_poses(self, q: np.ndarray) -> np.ndarray:
        """In the world frame [L, 7]."""
        state = self.model.state()
        state.joint_q.assign(q.astype(np.float32))
        newton.eval_fk(self.model, state.joint_q, state.joint_qd, state)
        return state.body_q.numpy()


def test_the_page_of_a_hands_usd_names_every_attribute_that_is_no_common_one(toy):
    page = (ROOT / "docs" / "reference" / "hand.md").read_text()
    written = set[str]()
    for path in (hand_usd("dclaw4"), toy[0].hand.path):
        stage = open_stage(path)
        for prim in stage.TraverseAll():
            written.update(prim.GetAuthoredPropertyNames())
    own = {name.split(":")[-1] for name in written if name.startswith(("vd:", "newton:", "mjc:"))}
    assert len(own) > 10 and {name for name in own if f"{name}`" not in page} == set()


def test_newton_reads_the_same(toy):
    hand, world = toy[0].hand, HandWorld(toy[0].hand)
    builder = world.builder
    assert [label.rsplit("/")[-1] for label in builder.body_label] == list(hand.link_names)
    assert builder.joint_mimic_joint[-1] == 5 and builder.joint_mimic_joint[:-1] == [-1] * 6
    q = np.random.default_rng(1).uniform(hand.lower, hand.upper)
    local = hand.forward_kinematics(q)
    turn = Rotation.from_quat(hand.mount[3:])
    poses = world.link_poses(q)
    np.testing.assert_allclose(poses[:, :3], turn.apply(local[:, :3]) + hand.mount[:3], atol=1e-6)
    off = (turn * Rotation.from_quat(local[:, 3:])).inv() * Rotation.from_quat(poses[:, 3:])
    assert off.magnitude().max() < 1e-5
    np.testing.assert_allclose(builder.body_mass, hand.link_mass, rtol=1e-6)
    colliding = [
        i for i, f in enumerate(builder.shape_flags) if f & newton.ShapeFlags.COLLIDE_SHAPES
    ]
    assert sorted(builder.shape_body[i] for i in colliding) == [shape.link for shape in hand.shapes]


def test_what_an_mjcf_says_of_its_drives_is_taken(tmp_path):
    path = write_mjcf(tmp_path, oracle(write_urdf(tmp_path)))
    hand = import_hand(path, tmp_path / "out").hand
    np.testing.assert_allclose(hand.kp[hand.actuated], 2.0, rtol=1e-6)
    followed = [0.0, 0.0, 0.0, 0.0, 0.8**2 * 0.01]  # the damping of b4, as b3 feels it
    np.testing.assert_allclose(hand.kd[hand.actuated], 0.11 + np.array(followed), rtol=1e-6)
    np.testing.assert_allclose(hand.armature, 0.002, rtol=1e-6)
    np.testing.assert_allclose(hand.tip_frame[1, :3], [0.0, 0.0, 0.031], atol=1e-7)
    stage = open_stage(hand.path)
    apart = stage.GetPrimAtPath("/toy/f0_l1").GetRelationship("physics:filteredPairs").GetTargets()
    assert "/toy/f1_l1" in map(str, apart)


def test_a_description_overrides_what_is_guessed(tmp_path):
    said = tmp_path / "toy.yaml"
    said.write_text(
        "name: other\nhold: {b1: 0.3}\ndrive: {kp: 1.5, armature: 0.004}\ndrives: {a1: {effort: "
        "0.4}}\n"
        "tips: {b_4: [0, 0, 0.02]}\npalm: [0, 0, 2]\nstart: {b2: 0.5}\n"
        "limits: {a2: [0, 1]}\nmass: {b_2: 0.06}\n"
        "mount: {position: [0, 0, 0.3], quaternion: [0, 1, 0, 0]}\nfriction: 0.6\n"
        "workspace: {drop: [0, 0, 0.1], size: [0.05, 0.06]}\n"
        "motors: {b2: {model: XL330-M288, id: 7, sign: -1, offset_rad: 0.1, gear: 2}}\n"
    )
    done = import_hand(write_urdf(tmp_path), tmp_path / "out", said)
    hand = done.hand
    assert hand.name == "other" and done.sources == ["a1", "a2", "b2", "b3", "b4"]
    palm = hand.forward_kinematics(np.zeros(5))[0]
    assert palm.tolist() == [0, 0, 0, 0, 0, 0, 1]
    assert (hand.kp[0], hand.armature[0], hand.effort[0]) == pytest.approx((1.5, 0.004, 0.4))
    assert (hand.lower[1], hand.upper[1], hand.start[2]) == pytest.approx((0.0, 1.0, 0.5))
    np.testing.assert_allclose(hand.tip_frame[1, :3], [0.0, 0.0, 0.02], atol=1e-7)
    assert hand.palm.tolist() == [0.0, 0.0, 1.0] and not hand.palm_up
    assert hand.workspace.drop_m == (0.0, 0.0, 0.1) and hand.workspace.size_m == (0.05, 0.06)
    assert hand.link_mass[3] == pytest.approx(0.06) and hand.shapes[0].friction == pytest.approx(
        0.6
    )
    motor = hand.motors[2]
    assert motor and (motor.model, motor.id, motor.sign, motor.gear) == ("XL330-M288", 7, -1.0, 2.0)
    assert hand.motors[0] is None
    assert not any("palm" in note or "mounted" in note or "drop" in note for note in done.notes)


def replaced(old: str, new: str) -> list[str]:
    assert any(old in part for part in PARTS)
    return [part.replace(old, new) for part in PARTS]


TWO_ON_ONE = [*PARTS, link("c_1", 0.05), joint("c1", "b_1", "c_1", 'xyz="0 -0.03 0"')]
ARM = [
    *itertools.chain.from_iterable(
        [
            link(f"arm_{i}", 0.1),
            joint(f"arm{i}", f"arm_{i}", f"arm_{i + 1}" if i < 3 else "wrist", 'xyz="0 0 0.1"'),
        ]
        for i in range(4)
    ),
    *PARTS,
]


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        (
            replaced('name="a2" type="revolute"', 'name="a2" type="prismatic"'),
            ("a2 is prismatic", "hold: {a2: 0}"),
        ),
        (replaced('lower="-0.2" upper="1.4" ', ""), ("a2 has the limits", "limits: {a2")),
        (TWO_ON_ONE, ("b_1 moves, and carries the fingers of b2, c1", "hold: {b1: 0}")),
        (ARM, ("an arm", "arm0: 0, arm1: 0")),
        (
            replaced('effort="0.7"', 'effort="0"'),
            ("a1, a2, b1, b2, b3: no torque limit", "drive: {effort"),
        ),
        (replaced('joint="b3"', 'joint="weld"'), ("Follower joint", "FIXED")),
        (replaced("knob.stl", "gone.stl"), ("gone.stl", "put the file there")),
        (replaced('xyz="0 0 0.05"', 'xyz="0 0 50"'), ("m long", "convert the file to metres")),
        ([PARTS[0]], ("no joint moves",)),
        (replaced(' scale="0.001 0.001 0.001"', ""), ("a mesh of a_2 is 40 m long", "scale")),
        (replaced('radius="0.012"', 'radius="0"'), ("a sphere of b_2 is 0 m long",)),
        (
            replaced('upper="1.4"', 'upper="90"'),
            ("a1 has the limits -0.2 and 90 rad", "in radians"),
        ),
        (
            replaced('mass value="0.03"', 'mass value="-0.03"'),
            ("a_1 weighs -0.03 kg", "mass: {a_1"),
        ),
        (replaced('xyz="0 0.6 0.8"', 'xyz="0 0 0"'), ("b3 has no axis",)),
        (
            replaced('joint name="b2"', 'joint name="b1"'),
            ("b1 is the name of more than one joint",),
        ),
        (replaced('joint="b3"', 'joint="zz"'), ("unknown joint 'zz'",)),
        (
            replaced("knob.stl", "package://toys/knob.stl"),
            ("package://toys", "folder above toy.urdf"),
        ),
        (replaced('rpy="0 0 0.3"', 'rpy="0 0 ${turn}"'), ("xacro toy.urdf > hand.urdf",)),
        ([re.sub("<collision>.*</collision>", "", p) for p in PARTS], ("nothing collides of a_2",)),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_what_cannot_be_imported_is_refused_by_name(tmp_path, parts, words):
    path = write_urdf(tmp_path, parts)
    with pytest.raises(HandError) as caught:
        import_hand(path, tmp_path / "out")
    for word in (str(path), *words):
        assert word in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_a_mirrored_mesh_is_not_inside_out(tmp_path):
    path = write_urdf(tmp_path, replaced('scale="0.001', 'scale="-0.001'))
    (mesh,) = (
        shape for link in read_source(path).links for shape in link.shapes if shape.kind == "mesh"
    )
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).volume == pytest.approx(
        0.02 * 0.016 * 0.04, rel=1e-4
    )


def pulled(folder: Path, first: float, second: float) -> Path:
    """The toy hand with a tendon over a1 and a2, which one position servo pulls."""
    spec = mujoco.MjSpec.from_file(str(write_mjcf(folder, oracle(write_urdf(folder)))))
    tendon = spec.add_tendon(name="pull")
    tendon.wrap_joint("a1", first)
    tendon.wrap_joint("a2", second)
    for name in ("a1", "a2"):
        spec.delete(spec.actuator(f"motor {name}"))
    motor = spec.add_actuator(name="both", target="pull")
    motor.trntype = mujoco.mjtTrn.mjTRN_TENDON
    motor.set_to_position(kp=2.0, kv=0.3)
    motor.forcelimited, motor.forcerange = 1, [-0.7, 0.7]
    spec.compile()
    path = folder / "pulled.xml"
    path.write_text(spec.to_xml())
    return path


def test_a_tendon_over_two_joints_is_refused_until_it_is_described(tmp_path):
    path = pulled(tmp_path, 1.0, 1.0)
    with pytest.raises(HandError, match=r"pull .*a1, a2 together.*mimic: \{a2: \{joint: a1\}\}"):
        import_hand(path, tmp_path / "out")
    (tmp_path / "said.yaml").write_text("mimic: {a2: {joint: a1}}")
    hand = import_hand(path, tmp_path / "out", tmp_path / "said.yaml").hand
    assert hand.mimic[1] == 0 and hand.actuated.tolist() == [0, 2, 3, 4]


@pytest.mark.parametrize(
    ("first", "second", "factor"), [(1.0, 1.0, 1.0), (1.0, 1.0, 0.5), (0.8, 0.3, 1.2)]
)
def test_a_tendons_servo_is_as_stiff_and_strong_as_it_turns_its_joints(
    tmp_path, first, second, factor
):
    """As Shadow's rh_FFJ0: by virtual work, with both joints moving."""
    path = pulled(tmp_path, first, second)
    (tmp_path / "said.yaml").write_text(f"mimic: {{a2: {{joint: a1, factor: {factor}}}}}")
    hand = import_hand(path, tmp_path / "out", tmp_path / "said.yaml").hand
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    dofs = [model.joint(name).dofadr[0] for name in ("a1", "a2")]
    way = np.array([1.0, factor])

    def torque(angle: float, speed: float) -> float:
        data.qpos[dofs], data.qvel[dofs] = angle * way, speed * way
        mujoco.mj_forward(model, data)
        return float((data.qfrc_actuator[dofs] + data.qfrc_passive[dofs]) @ way)

    still = torque(0.0, 0.0)
    assert hand.kp[0] == pytest.approx((still - torque(0.01, 0.0)) / 0.01, rel=1e-4)
    assert hand.kd[0] == pytest.approx((still - torque(0.0, 0.01)) / 0.01, rel=1e-4)
    assert hand.effort[0] == pytest.approx(abs(torque(100.0, 0.0)), rel=1e-4)


@pytest.mark.parametrize("load", [0.0, -0.2, -0.5, -0.7])
def test_a_simulated_drive_carries_what_is_on_its_follower(tmp_path, load):
    """By virtual work: a torque on b4 is 0.8 of it on b3, whose drive has 2 N m/rad and 0.5 N m."""
    (tmp_path / "said.yaml").write_text("drive: {kp: 2.0, kd: 0.1, effort: 0.5}")
    hand = import_hand(write_urdf(tmp_path), tmp_path / "out", tmp_path / "said.yaml").hand
    world = build_hand(hand, SimCfg(), visuals=False)
    world.gravity = (0.0, 0.0, 0.0)
    builder = new_builder()
    builder.add_world(world)
    scene = SmallScene(builder, SimCfg(), "cpu")
    target = hand.start + np.array([0.0, 0.0, 0.0, 0.0, 0.5, 0.0])
    scene.control.joint_target_q.assign(target.astype(np.float32))
    scene.control.joint_f.assign(np.array([0.0, 0.0, 0.0, 0.0, 0.0, load], dtype=np.float32))
    scene.run(3.0)
    q = scene.state.joint_q.numpy()
    give = abs(load) / (
        10 * 2.0
    )  # the solver's coupling is ten times as stiff as the drive, or more
    np.testing.assert_allclose(q[5], 0.8 * q[4] + 0.05, atol=give + 1e-5)
    if 0.8 * abs(load) < 0.5:
        assert q[4] - target[4] == pytest.approx(0.8 * load / 2.0, abs=1e-3)
    else:
        assert q[4] < hand.lower[4] + 0.01, "stronger than the drive"


def test_servos_of_a_hand_with_followers_move_it_as_plain_drives_do(tmp_path):
    (tmp_path / "said.yaml").write_text("mimic: {a2: {joint: a1}}")
    hand = import_hand(write_urdf(tmp_path), tmp_path / "out", tmp_path / "said.yaml").hand
    cfg = replace(SimCfg(), control_hz=60.0)
    scene = build_scene(hand=hand, objects=load_set("cube")[:1], num_envs=2, cfg=cfg, device="cpu")
    ends = []
    for rows in (None, hand.servo):
        sim = Simulator(scene, cfg, servo_rows=rows)
        wanted = np.zeros(sim.target.shape, dtype=np.float32)
        wanted[:, hand.actuated] = [[0.3, 0.2, 0.4, 0.3], [0.1, 0.5, 0.1, 0.6]]
        sim.target.assign(wanted)
        for _ in range(40):
            sim.step()
        ends.append(sim.joint_q.numpy()[:, : hand.num_joints])
        np.testing.assert_allclose(ends[-1][:, hand.actuated], wanted[:, hand.actuated], atol=0.05)
    np.testing.assert_allclose(*ends, atol=0.005)


def test_a_guessed_drive_has_the_damping_that_its_joint_needs(tmp_path):
    """The file's damping is the joint's own; MuJoCo's mass matrix says what is critical."""
    damped = replaced('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><dynamics damping="0.0002"/>')
    path = write_urdf(tmp_path, damped)
    done = import_hand(path, tmp_path / "out")
    hand = done.hand
    model = oracle(path).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    data.qpos[model.joint("b4").qposadr[0]] = 0.05
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    inertia = mass + np.diag(np.full(model.nv, hand.armature[0]))
    number = [model.joint(name).dofadr[0] for name in done.sources]
    for joint in hand.actuated:
        way = np.zeros(model.nv)
        way[number[joint]] = 1.0
        if joint == 4:
            way[number[5]] = 0.8
        ratio = hand.kd[joint] / (2.0 * np.sqrt(hand.kp[joint] * (way @ inertia @ way)))
        assert ratio == pytest.approx(1.0, rel=1e-3), done.sources[joint]
    assert not any("swing" in text for text in done.warnings)
    (tmp_path / "said.yaml").write_text("drive: {kp: 2.0, kd: 0.001}")
    (warning,) = import_hand(path, tmp_path / "out", tmp_path / "said.yaml").warnings
    assert re.match(r"a1, a2, b1, b2, b3 swing: their damping is 0.0\d+ of the critical", warning)


CARRIED = [
    *PARTS,
    link("carrier", 0.02),
    joint("c", "palm", "carrier", 'xyz="0.01 0 0.08" rpy="0 0.3 0"', "1 0 0.3").replace(
        "</joint>", '<mimic joint="a1" multiplier="0.9" offset="0.1"/></joint>'
    ),
    *itertools.chain.from_iterable(
        [link(f"{finger}_1", 0.04), joint(f"{finger}1", "carrier", f"{finger}_1", place)]
        for finger, place in (("d", 'xyz="0 0.03 0.02"'), ("e", 'xyz="0 -0.03 0.02"'))
    ),
]
"""As SVH: a part of the palm follows the thumb and carries two fingers."""


def test_fingers_on_a_part_that_follows_each_follow_with_it(tmp_path):
    path = write_urdf(tmp_path, CARRIED)
    done = import_hand(path, tmp_path / "out")
    hand = done.hand
    assert done.sources == ["a1", "a2", "b1", "b2", "b3", "b4", "c", "d1", "c", "e1"]
    assert list(hand.mimic) == [-1, -1, -1, -1, -1, 4, 0, -1, 0, -1]
    assert any("fingers of d1, e1" in note for note in done.notes)
    model = oracle(path).compile()
    data = mujoco.MjData(model)
    base = data.body(1)
    assert hand.link_mass.sum() == pytest.approx(model.body_subtreemass[1], rel=1e-5)
    rng = np.random.default_rng(0)
    for _ in range(5):
        q = rng.uniform(hand.lower, hand.upper)
        q[5] = 0.8 * q[4] + 0.05
        q[[6, 8]] = 0.9 * q[0] + 0.1
        data.qpos[[model.joint(name).qposadr[0] for name in done.sources]] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        turn = Rotation.from_quat(base.xquat[[1, 2, 3, 0]])
        links = hand.forward_kinematics(q)
        for pose, name in zip(links[1:], done.sources, strict=True):
            place = data.xpos[model.jnt_bodyid[model.joint(name).id]]
            np.testing.assert_allclose(turn.apply(pose[:3]) + base.xpos, place, atol=1e-6)
        places = links[:, :3] + Rotation.from_quat(links[:, 3:]).apply(hand.link_com)
        centre = hand.link_mass @ places / hand.link_mass.sum()
        np.testing.assert_allclose(turn.apply(centre) + base.xpos, data.subtree_com[1], atol=1e-5)
    shapes = [shape.link for shape in hand.shapes]
    assert 7 in shapes and 9 not in shapes, "what is carried collides once"
    (tmp_path / "said.yaml").write_text("hold: {c: 0.1}")
    warnings = import_hand(path, tmp_path / "out", tmp_path / "said.yaml").warnings
    assert any("c follows a1" in warning for warning in warnings)


@pytest.mark.skipif(importlib.util.find_spec("collada") is not None, reason="pycollada is there")
def test_a_mesh_that_needs_another_package_says_which(tmp_path):
    (tmp_path / "knob.dae").write_text("<COLLADA/>")
    path = write_urdf(tmp_path, replaced("knob.stl", "knob.dae"))
    with pytest.raises(HandError, match=r"pip install pycollada"):
        import_hand(path, tmp_path / "out")


def test_a_hand_that_policies_know_by_another_name_is_told_how_to_get_it(tmp_path):
    path = write_urdf(tmp_path)
    path.write_text(path.read_text().replace('robot name="toy"', 'robot name="leap_right"'))
    done = import_hand(path, tmp_path / "out")
    assert done.hand.name == "leap_right"
    assert any("hand as leap" in text and "--describe leap" in text for text in done.warnings)


def test_what_is_seldom_meant_or_left_out_is_said(tmp_path):
    parts = replaced('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><dynamics friction="0.1"/>')
    for old, new in (('izz="1e-5"', 'izz="9e-5"'), ('"0.8"', '"2"'), ('"a1"', '"hand/a1"')):
        parts = [part.replace(old, new) for part in parts]
    parts[3] = parts[3].replace("e-5", "")
    done = import_hand(write_urdf(tmp_path, [*parts, link("lost", 0.03)]), tmp_path / "out")
    said = "\n".join([*done.notes, *done.warnings])
    for words in (
        "no body has the moments",
        "dry friction is left out: of hand/a1, a2, b2, b4",
        "lost is joined to nothing",
        "b4 follows b3 to -0.35 and 2.85 rad, beyond its limits -0.20 and 1.40",
        "a_1 turns like a body of",
    ):
        assert words in said, words
    assert done.sources == ["hand/a1", "a2", "b1", "b2", "b3", "b4"]
    long = "right_hand_of_the_robot/first_joint_of_the_index_finger"
    assert long in joint_table(done.hand, [long, *done.sources[1:]])
    assert not any("replaces" in text for text in done.warnings)
    other = write_urdf(tmp_path).rename(tmp_path / "left.urdf")
    assert any(
        "imported from toy.urdf" in text for text in import_hand(other, tmp_path / "out").warnings
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("palm: [0, 0]", "palm"),
        ("palms: [0, 0, 1]", "no field palms"),
        ("hold: {zz: 0}", "there is no joint zz; there are a1"),
        ("tips: {zz: [0, 0, 0]}", "there is no link zz"),
        ("start: {b2: 5}", "start: 5 rad is beyond the limits of b2, -0.2 to 1.4"),
        ("hold: {b1: 5}", "hold: 5 rad is beyond the limits of b1"),
        ("[1, 2", "said.yaml"),
    ],
)
def test_a_wrong_description_is_refused(tmp_path, text, words):
    (tmp_path / "said.yaml").write_text(text)
    with pytest.raises(HandError, match=words):
        import_hand(write_urdf(tmp_path), tmp_path / "out", tmp_path / "said.yaml")


def test_command_imports_into_the_cache_and_draws_a_sheet(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(importer, "BENDS", (0.3,))
    monkeypatch.setenv("VD_ASSETS", str(tmp_path / "cache"))
    monkeypatch.setattr(sys, "argv", ["vd-assets", "hand", "import", str(write_urdf(tmp_path))])
    assert cli.main() == 0
    said = capsys.readouterr().out
    assert "guess: starts as" in said
    assert "palm looks along" in said and "f1_j4  b4" in said and "0.8 x f1_j3" in said
    hand = load_hand("toy")
    assert hand.path == tmp_path / "cache" / "hands" / "toy" / "toy.usda" and hand.num_joints == 6
    from PIL import Image

    image = np.asarray(Image.open(hand.path.with_suffix(".png")).convert("RGB"), dtype=float)
    assert (np.ptp(image, axis=2) > 40).mean() > 0.01, "links are coloured"
    monkeypatch.setattr(sys, "argv", ["vd-assets", "hand", "import", str(tmp_path / "knob.stl")])
    assert cli.main() == 1 and "URDF nor an MJCF" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"'claw': choose .*\btoy\b.*import one"):
        load_hand("claw")


def test_more_cubes_stay_above_a_plate_than_on_two_fingers(tmp_path):
    """Nobody acts; the plate lies below the toy's fingers."""
    box = '<origin xyz="-0.04 0 0.1"/><geometry><box size="0.02 0.6 0.6"/></geometry>'
    base = PARTS[0].replace("</link>", f"<collision>{box}</collision></link>")
    bare = import_hand(write_urdf(tmp_path), tmp_path / "bare").hand
    above = import_hand(write_urdf(tmp_path, [base, *PARTS[1:]]), tmp_path / "above").hand
    assert share_kept(above.path) > share_kept(bare.path) + 0.3


def test_a_palm_up_hand_starts_as_the_bowl_that_keeps_most(tmp_path):
    path = write_urdf(tmp_path)
    tried = []

    def distance(bowl: HandModel) -> float:
        return abs(float(bowl.start[0]) - 0.3)

    def share(file: Path) -> float:
        tried.append(read_hand(file))
        return 1.0 - distance(tried[-1])

    done = import_hand(path, tmp_path / "out", share_kept=share)
    hand = done.hand
    best = min(tried, key=distance)
    np.testing.assert_allclose(hand.start, best.start, atol=0.006)
    np.testing.assert_allclose(hand.start[5], 0.8 * hand.start[4] + 0.05, atol=1e-6)
    np.testing.assert_allclose(hand.workspace.goal_m, best.workspace.goal_m, atol=1e-3)
    assert {each.workspace.size_m for each in tried} == {tried[0].workspace.size_m}
    (note,) = (note for note in done.notes if "bowl" in note)
    assert f"{1.0 - distance(best):.0%} of dropped" in note
    (tmp_path / "said.yaml").write_text("start: {a1: 0.2}")
    described = import_hand(path, tmp_path / "said", tmp_path / "said.yaml", share_kept=share)
    assert described.hand.start[0] == pytest.approx(0.2)
    assert not any("bowl" in note for note in described.notes)


def test_start_poses_are_told_as_they_are_judged(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("VD_ASSETS", str(tmp_path / "assets"))
    monkeypatch.setattr("vd.evaluate.bowl.share_kept", lambda hand: 0.25)
    monkeypatch.setattr("sys.argv", ["vd-assets", "hand", "import", str(write_urdf(tmp_path))])
    assert cli.main() == 0
    assert capsys.readouterr().out.count("start pose: 25% of dropped cubes stay") > 1


@pytest.mark.parametrize("name", REAL)
def test_leap_and_allegro_are_imported_with_their_descriptions(tmp_path, shared_dir, name):
    path = shared_dir / "hands" / f"{name}_hand" / f"{name}_hand_right.urdf"
    if not path.is_file():
        pytest.skip(f"there is no {path}")
    done = import_hand(path, tmp_path, name)
    hand = done.hand
    assert hand.name == name and hand.fingers == tuple(slice(4 * f, 4 * f + 4) for f in range(4))
    bare = re.sub(r"<(visual|collision)>.*?</\1>", "", path.read_text(), flags=re.DOTALL)
    (tmp_path / "bare.urdf").write_text(bare)
    assert_like_mujoco(hand, done.sources, oracle(tmp_path / "bare.urdf").compile())
    assert hand.palm_up and hand.palm.tolist() == [1.0, 0.0, 0.0]
    if name == "leap":
        assert [motor and motor.id for motor in hand.motors] == [
            int(source) for source in done.sources
        ]
        assert not done.warnings


def test_the_left_leap_hand_is_described_as_the_mirror_image_of_the_right_one():
    right = read_description("leap")
    left = read_description("leap_left")
    assert left.motors == right.motors and left.drive == right.drive
    assert {name: abs(angle) for name, angle in left.start.items()} == right.start
    assert {name for name, angle in left.start.items() if angle < 0.0} == {"12", "13"}
    for field in ("drop", "goal"):
        place = getattr(right.workspace, field)
        assert getattr(left.workspace, field) == (place[0], -place[1], place[2])


@pytest.mark.parametrize("colliders", [1, 6])
def test_the_task_runs_with_fingers_that_differ(tmp_path, colliders):
    """Of many colliders, as LEAP has, MuJoCo's masks hold who meets whom by the groups of fingers alone."""
    parts = [
        re.sub(r"<collision>.*?</collision>", lambda found: colliders * found[0], part)
        for part in PARTS
    ]
    hand = import_hand(write_urdf(tmp_path, parts), tmp_path / "out").hand
    cfg = ReorientCfg(hand=str(hand.path), objects=("cube",), num_envs=4)
    env = ReorientEnv(cfg, "cpu")
    assert len(np.unique(env.scene.world_scale)) > 1, "worlds differ, and so need masks"
    assert (env.num_actions, env.num_observations) == (5, 3 * 6 + 13 * 2 + 21), (
        "the sixth joint has no motor"
    )
    model, geoms = env.sim.solver.mj_model, {}
    for geom in range(model.ngeom):
        name = model.body(model.geom_bodyid[geom]).name.removeprefix("_toy_")
        geoms.setdefault(name, []).append((model.geom_contype[geom], model.geom_conaffinity[geom]))

    def meet(one: str, other: str) -> bool:
        pairs = itertools.product(geoms[one], geoms[other])
        met = {bool(a[0] & b[1] or a[1] & b[0]) for a, b in pairs}
        assert len(met) == 1
        return met.pop()

    links = sorted(name for name in geoms if name.startswith("f"))
    for one, other in itertools.combinations(links, 2):
        assert meet(one, other) == (one[:2] != other[:2]), (one, other)
    assert not meet("base", "f0_l1") and meet("base", "f1_l4") and meet("object", "f1_l4")
    assert "table" not in geoms and not env.has_table().any(), "the palm looks up"
    rng, lost = np.random.default_rng(0), np.zeros(4)
    for _ in range(12):
        env.step(wp.array(rng.uniform(-1.0, 1.0, (4, 5)), dtype=float))
        away = np.linalg.norm(env.object_pose_end.numpy()[:, :3] - hand.workspace.goal_m, axis=1)
        np.testing.assert_array_equal(env.fell.numpy(), away >= hand.workspace.fall_m)
        lost += env.fell.numpy()
    assert lost.any(), "nothing is below"
    q = env.sim.joint_q.numpy()
    assert np.isfinite(env.observation.numpy()).all()
    np.testing.assert_allclose(q[:, 5], 0.8 * q[:, 4] + 0.05, atol=0.01)
    with pytest.raises(ValueError, match=r"toy follow others.*observation.view"):
        ReorientEnv(replace(cfg, observation=ObservationCfg(view="goal")), "cpu")
    with pytest.raises(ValueError, match=r"toy looks up.*table.away_share"):
        ReorientEnv(replace(cfg, table=TableCfg(away_share=0.5)), "cpu")


def test_a_hand_of_five_motors_trains_with_objects_of_all_its_sizes(tmp_path):
    (tmp_path / "said.yaml").write_text("workspace: {size: [0.04, 0.05]}")
    hand = import_hand(write_urdf(tmp_path), tmp_path / "out", tmp_path / "said.yaml").hand
    small = [
        "--num-envs",
        "8",
        "--ppo.minibatch-size",
        "32",
        "--max-steps",
        "128",
        "--device",
        "cpu",
    ]
    flags = ["--preset", "leap-cube", "--hand", str(hand.path), *small]
    assert train(["teacher", *flags, "--out", str(tmp_path / "run")]) == 0
    rows = [
        json.loads(line) for line in (tmp_path / "run" / "progress.jsonl").read_text().splitlines()
    ]
    assert len(rows) > 1 and all(row["loss/kl"] > 0.0 and row["loss/value"] > 0.0 for row in rows)
    policy = read_policy(tmp_path / "run" / "policy.safetensors")
    assert policy.num_actions == 5
    env = ReorientEnv(ReorientCfg.of(policy), "cpu")
    model = env.scene.model
    cubes = np.flatnonzero(env.scene.shape_kind == SHAPE_OBJECT)
    sides = [np.ptp(model.shape_source[i].vertices, axis=0) for i in cubes]
    np.testing.assert_allclose(np.unique(np.round(sides, 5)), np.linspace(0.04, 0.05, 5))
    plain = ReorientEnv(
        ReorientCfg.of(policy, randomisation=RandomisationCfg(enabled=False)), "cpu"
    )
    assert plain.objects[0].longest_side == pytest.approx(0.05), "as little as fits"
    assert (plain.scene.world_scale == 1.0).all()
    env.step(wp.from_torch(policy.act(wp.to_torch(env.observation))))
    assert np.isfinite(env.observation.numpy()).all()
