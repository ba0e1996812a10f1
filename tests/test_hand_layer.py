"""Identified servo models as layers over a hand.

Written, read, composed for Newton, refused when wrong.
"""

import re
from pathlib import Path

import newton
import numpy as np
import pytest
from pxr import Usd, UsdPhysics

from vd.assets_usd.hand_data import HandError, HandModel
from vd.assets_usd.hand_layer import write_layer
from vd.assets_usd.hand_model import open_stage, read_hand
from vd.assets_usd.hands import hand_usd
from vd.kernels.servo import actuators
from vd.kernels.servo.effects import EFFECTS

HEADER = '#usda 1.0\n(\n    defaultPrim = "dclaw3"\n)\n'
EVERYTHING = {
    name: {
        p.name: (p.typical or 0.1, 0.9 * p.typical, 1.1 * p.typical + 0.2)
        for p in effect.parameters
    }
    for name, effect in EFFECTS.items()
}
"""Every effect with every parameter, and an interval around each."""


@pytest.fixture(scope="module")
def hand() -> HandModel:
    return read_hand(hand_usd("dclaw3"))


def write(path: Path, hand: HandModel | str, baseline=None, effects=None) -> Path:
    write_layer(
        path,
        hand,
        baseline=baseline or {},
        effects=effects or {},
        tool="a test",
        recording="bench/one",
    )
    return path


def read(path: Path, name: str = "dclaw3") -> HandModel:
    return read_hand(hand_usd(name), layer=path)


def overs(joint: str, *attributes: str) -> str:
    lines = "\n".join(f"        {attribute}" for attribute in attributes)
    return f'{HEADER}over "dclaw3"\n{{\n    over "{joint}"\n    {{\n{lines}\n    }}\n}}\n'


def test_every_number_comes_back(hand, tmp_path):
    drive = {"kp": (2.0, 1.9, 2.2), "kd": 0.21, "velocity_limit": (3.0, 2.5, 3.5), "inertia": 0.002}
    drive["kd_off"] = (0.01, 0.008, 0.012)
    path = write(tmp_path / "identified.usda", hand, {"f1_j2": drive}, {"f1_j2": EVERYTHING})
    got = read(path)
    joint = hand.joint_names.index("f1_j2")
    assert got.layer == path
    assert (got.kp[joint], got.kd[joint]) == pytest.approx((2.0, 0.21))
    assert (got.velocity_limit[joint], got.armature[joint]) == pytest.approx((3.0, 0.002))
    for name, effect in EFFECTS.items():
        for parameter in effect.parameters:
            value, low, high = EVERYTHING[name][parameter.name]
            assert got.servo[joint, parameter.column] == value, "doubles are exact"
            assert got.servo_interval[joint, parameter.column] == pytest.approx((low, high))
    assert got.servo[joint, actuators.KP] == got.kp[joint]
    assert got.servo_interval[joint, actuators.KP] == pytest.approx((1.9, 2.2))
    assert got.servo[joint, actuators.OFF_DAMPING] == 0.01
    assert got.servo_interval[joint, actuators.OFF_DAMPING] == pytest.approx((0.008, 0.012))
    assert np.isnan(got.servo_interval[joint, actuators.KD]).all(), "no interval was given"
    others = np.arange(hand.num_joints) != joint
    assert np.array_equal(got.servo[others], hand.servo[others])
    assert np.isnan(got.servo_interval[others]).all()
    for field in ("link_mass", "link_com", "lower", "upper", "effort", "tip_frame"):
        assert np.array_equal(getattr(got, field), getattr(hand, field))


def test_newton_sees_the_identified_drive_and_the_fingertip(hand, tmp_path):
    drive = {"kp": 1.5, "kd": 0.05, "velocity_limit": 2.0, "inertia": 0.004}
    path = write(tmp_path / "identified.usda", hand, {"f0_j3": drive})
    builder = newton.ModelBuilder()
    builder.add_usd(open_stage(hand.path, "soft", path), floating=False, load_visual_shapes=False)
    got = read_hand(hand.path, fingertip="soft", layer=path)
    dof = hand.joint_names.index("f0_j3")
    for values, expected, wanted in (
        (builder.joint_target_ke, got.kp, 1.5),
        (builder.joint_target_kd, got.kd, 0.05),
        (builder.joint_velocity_limit, got.velocity_limit, 2.0),
        (builder.joint_armature, got.armature, 0.004),
    ):
        np.testing.assert_allclose(values, expected, rtol=1e-6)
        assert values[dof] == pytest.approx(wanted)
    plain = read_hand(hand.path)
    assert got.shapes[-1].friction != plain.shapes[-1].friction, (
        "the variant is still the one asked for"
    )


def test_the_layer_is_plain_usd_that_says_where_it_comes_from(hand, tmp_path):
    path = write(tmp_path / "identified.usda", hand, {"f0_j1": {"kp": 2.0}}, {"f0_j1": EVERYTHING})
    text = path.read_text()
    assert text.startswith("#usda 1.0") and "a test" in text and "bench/one" in text
    # Anyone's stage, without this project: the hand and the layer as sublayers.
    stage = Usd.Stage.CreateInMemory()
    stage.GetRootLayer().subLayerPaths = [str(path), str(hand.path)]
    joint = stage.GetPrimAtPath("/dclaw3/f0_j1")
    assert UsdPhysics.DriveAPI(joint, "angular").GetStiffnessAttr().Get() == pytest.approx(
        np.radians(2.0)
    )
    assert joint.GetAttribute("vd:command_delay:delay_s").Get() == 0.02


def test_a_layer_written_anew_is_read_anew(hand, tmp_path):
    path = tmp_path / "identified.usda"
    for delay in (0.01, 0.02):
        write(path, hand, effects={"f0_j1": {"command_delay": {"delay_s": delay}}})
        held = open_stage(hand.path, layer=path)
        assert read(path).servo[0, actuators.COMMAND_DELAY] == delay
        assert held.GetPrimAtPath("/dclaw3/f0_j1")
    assert list(tmp_path.iterdir()) == [path], "nothing temporary stays"


def test_another_hand_is_refused(hand, tmp_path):
    path = write(tmp_path / "identified.usda", hand, {"f0_j1": {"kp": 2.0}})
    with pytest.raises(HandError, match=r"identified\.usda: /dclaw3: .*not for dclaw4"):
        read(path, "dclaw4")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            overs("f0_j9", "custom double vd:backlash:width_rad = 0.1"),
            "/dclaw3/f0_j9: dclaw3 has no such",
        ),
        (
            overs("f0_j1", "custom double vd:backlsh:width_rad = 0.1"),
            "no effect is called 'backlsh'; one of",
        ),
        (
            overs("f0_j1", "custom double vd:backlash:width = 0.1"),
            "no attribute of backlash; one of vd:back",
        ),
        (
            overs("f0_j1", "custom double vd:backlash:width_rad = -1"),
            "is -1 rad; it cannot be negative",
        ),
        (overs("f0_j1", "custom double vd:backlash:width_rad = nan"), "it must be a finite number"),
        (
            overs("f0_j1", "custom float2 vd:backlash:width_rad:ci95 = (0, 1)"),
            "interval without a value",
        ),
        (
            overs(
                "f0_j1",
                "custom double vd:backlash:width_rad = 0.1",
                "custom float2 vd:backlash:width_rad:ci95 = (2, 1)",
            ),
            "low comes first",
        ),
        (
            overs("f0_j1", "custom double vd:baseline:kp = 2"),
            "no attribute of baseline; one of drive:angular:physics:stif",
        ),
        (
            overs("f0_j1", "custom double vd:torque_speed_limit:tau_stall_nm = 1"),
            "omega_0_rad_s'; author it",
        ),
        (
            overs("f0_j1", "float drive:angular:physics:stiffness = -1"),
            "stiffness' is -1.0; it must be pos",
        ),
        ("not USD at all", "not a USD layer"),
        ("#usda 1.0\n", "it has no joints"),
    ],
)
def test_wrong_layers_name_file_prim_and_attribute(tmp_path, text, message):
    path = tmp_path / "bad.usda"
    path.write_text(text)
    with pytest.raises(HandError, match=re.escape(message)) as error:
        read(path)
    assert "bad.usda" in str(error.value)
