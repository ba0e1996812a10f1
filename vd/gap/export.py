"""``vd-gap export``: an identified model for MuJoCo, mjlab and Isaac Lab, or a bare servo's in a hand.

What a format cannot hold stands in its file. MuJoCo is that of 3.17, mjlab that of 1.6 (delays in
every actuator), Isaac Lab that of 2.3 or later (friction in N m).
"""

import math
from pathlib import Path
from pprint import pformat

import mujoco
import numpy as np

from vd.assets_usd.hand_layer import open_layer, read_bare_layer, write_layer
from vd.assets_usd.hands import load_hand
from vd.command.files import make_folder, write_text
from vd.gap.chain import GRAVITY_M_S2
from vd.gap.coordinates import GRAVITY, PARAMETERS
from vd.gap.rollout import STEP_S
from vd.logs.recording import BARE_MODELS

STIFF = 0.9999
"""Impedance of dry friction in MuJoCo: at its usual 0.9 what should stick creeps."""
FRICTION = ("coulomb_friction.tau_c_nm", "stribeck_friction.tau_c_nm")
TERMS = {
    "stiffness": ("kp",),
    "damping": ("kd",),
    "effort_limit": ("torque_limit.tau_max_nm",),
    "armature": ("inertia", "payload_inertia.j_kgm2"),
    "frictionloss": FRICTION,
    "friction": FRICTION,
    "dynamic_friction": FRICTION,
    "velocity_limit_sim": ("velocity_limit",),
    "delay": ("command_delay.delay_s",),
    "filter": ("command_filter.tau_s",),
    "weight": ("gravity_load.tau_g_nm",),
    "phase": ("gravity_load.phase_rad",),
}
"""What other programs have of a servo, by their names: sums of our parameters."""
MODEL = f"""
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{STEP_S}" integrator="implicitfast" gravity="0 0 -{GRAVITY_M_S2}"/>
  <worldbody>{{}}</worldbody>
  <actuator>{{}}</actuator>
</mujoco>
"""
BODY = f"""
    <body name="{{name}}">
      <inertial pos="{{x}} 0 {{z}}" mass="{{mass}}" diaginertia="1e-12 1e-12 1e-12"/>
      <joint name="{{name}}" axis="0 1 0" armature="{{armature}}" frictionloss="{{friction}}"
             solimpfriction="{STIFF} {STIFF}" solreffriction="{2.0 * STEP_S} 1"/>
    </body>
"""
ACTUATOR = """
    <position name="{name}" joint="{name}" kp="{stiffness}" kv="{damping}" delay="{delay}"
              nsample="{samples}"/>
"""
COMMON = ("stiffness", "damping", "effort_limit", "armature")
LABS = {
    "mjlab": (
        "from mjlab.actuator import BuiltinPositionActuatorCfg as Cfg",
        'target_names_expr=("{}",)',
        (*COMMON, "frictionloss"),
        "delay_min_lag={}, delay_max_lag={}",
    ),
    "isaaclab": (
        "from isaaclab.actuators import DelayedPDActuatorCfg as Cfg",
        'joint_names_expr=["{}"]',
        (*COMMON, "friction", "dynamic_friction", "velocity_limit_sim"),
        "min_delay={}, max_delay={}",
    ),
}
"""Import of an actuator's class, and its arguments: the joint, its terms, least and most delay."""
RIG = ("gravity_load", "payload_inertia", "encoder_bias")
"""Effects of what a bare servo carried, or of how it was mounted."""


def export(layer: Path, out: Path, hand: str | None, step: float) -> None:
    """Write the files to a folder, and say what each of them lacks; fields of ``vd-gap export``."""
    root = open_layer(layer).defaultPrim
    bare = root in BARE_MODELS
    joints = read_joints(layer, None if bare else hand or root)
    make_folder(out)
    if bare and hand is not None:
        path = out / "identified-in-hand.usda"
        into_hand(layer, joints, hand, path)
        print(path)
        return
    _write(out / "identified.xml", "<!-- {} -->\n", mjcf(joints), joints)
    for lab in LABS:
        _write(out / f"identified_{lab}.py", "# {}\n", actuators(lab, joints, step), joints)


def _write(path: Path, comment: str, text: str, joints: "list[JointModel]") -> None:
    """Write a file with what it lacks at its head, and say that."""
    lost = []
    for joint in joints:
        for key in sorted(joint.numbers.keys() - joint.taken):
            value = joint.numbers[key][0]
            lost.append(f"{joint.name} lacks {key} = {value:.4g}")
        joint.taken.clear()
    head = "".join(map(comment.format, ["Identified by vd-gap.", *lost]))
    write_text(path, head + text)
    print(path, *lost, sep="\n  ")


class JointModel:
    """What was identified of a joint, and what of it a format has taken.

    Args:
        name: Name of the joint.
        numbers: Value and 95 % interval, NaN without, of every parameter that does something.
    """

    def __init__(self, name: str, numbers: dict[str, np.ndarray]):
        self.name = name
        self.numbers = numbers
        self.taken: set[str] = set()

    def take(self, term: str) -> list[float]:
        """Value and interval of one of :data:`TERMS`."""
        self.taken.update(TERMS[term])
        parts = [self.numbers[key] for key in TERMS[term] if key in self.numbers]
        return np.sum([np.zeros(3), *parts], axis=0).tolist()


def read_joints(layer: Path, hand: str | None) -> list[JointModel]:
    """The joints of a layer, with what its hand has besides.

    Raises:
        HandError: It is no such layer, or it is over a hand and none is given.
    """
    file = open_layer(layer)
    names = [prim.name for prim in file.rootPrims[0].nameChildren]
    if hand is None:
        rows, intervals = read_bare_layer(layer, names)
    else:
        model = load_hand(hand, layer=layer)
        index = [*map(model.joint_names.index, names)]
        rows = model.servo[index]
        intervals = model.servo_interval[index]
    joints = []
    for name, row in zip(names, np.dstack([rows[..., None], intervals]), strict=True):
        numbers = {}
        for key, parameter in PARAMETERS.items():
            if key != GRAVITY.name and row[parameter.column, 0] != parameter.neutral:
                numbers[key] = row[parameter.column]
        joints.append(JointModel(name, numbers))
    return joints


def mjcf(joints: list[JointModel]) -> str:
    """A pendulum for each joint as MJCF, with all that it weighs."""
    bodies = ""
    actuators = ""
    for joint in joints:
        values = {}
        for term in TERMS:
            if term != "velocity_limit_sim":
                values[term] = joint.take(term)[0]
        # A point mass that has both the weight and the inertia.
        pull = values["weight"] / GRAVITY_M_S2
        mass = pull**2 / max(values["armature"], 1e-9) + 1e-9
        arm = pull / mass
        values["armature"] = max(values["armature"] - mass * arm**2, 0.0)
        x = -arm * math.sin(values["phase"])
        z = -arm * math.cos(values["phase"])
        bodies += BODY.format(name=joint.name, x=x, z=z, mass=mass, **values)
        samples = math.ceil(values["delay"] / STEP_S) + 1
        more = ""
        if values["filter"]:
            more += ' timeconst="{filter}"'
        if values["effort_limit"]:
            more += ' forcerange="-{effort_limit} {effort_limit}"'
        drive = ACTUATOR.replace("/>", more + "/>")
        actuators += drive.format(name=joint.name, samples=samples, **values)
    return mujoco.MjSpec.from_string(MODEL.format(bodies, actuators)).to_xml()


def actuators(lab: str, joints: list[JointModel], step: float) -> str:
    """Actuators of one of :data:`LABS`, with delays in steps [s], and ranges to draw from."""
    imported, target, terms, delays = LABS[lab]
    lines = [imported, "", "ACTUATORS = {"]
    ranges: dict[str, dict[str, tuple[float, float]]] = {}
    for joint in joints:
        arguments = [target.format(joint.name)]
        ranges[joint.name] = {}
        for term in terms:
            value, low, high = joint.take(term)
            if value:
                arguments.append(f"{term}={value:.6g}")
            if low < high:
                ranges[joint.name][term] = low, high
        delay, *ends = np.round(np.array(joint.take("delay")) / step, 3)
        low, high = ends if np.isfinite(ends).all() else (delay, delay)
        arguments.append(delays.format(math.floor(low), math.ceil(high)))
        lines.append(f'    "{joint.name}": Cfg({", ".join(arguments)}),')
    return "\n".join([*lines, "}", f"RANGES = {pformat(ranges)}", ""])


def into_hand(layer: Path, joints: list[JointModel], hand: str, path: Path) -> None:
    """A layer over a hand in which every joint has a bare servo, without what that servo carried.

    Raises:
        ValueError: The layer has several joints.
    """
    if len(joints) > 1:
        raise ValueError(f"{layer} has {len(joints)} joints; give that of one servo")
    numbers = joints[0].numbers
    effects: dict[str, dict[str, list[float]]] = {}
    for key, known in numbers.items():
        effect, _, name = key.rpartition(".")
        if effect and effect not in RIG:
            effects.setdefault(effect, {})[name] = known[np.isfinite(known)].tolist()
    model = load_hand(hand)
    drive = {}
    for key in ("kp", "kd", "velocity_limit"):
        drive[key] = float(numbers[key][0])
    baseline = dict.fromkeys(model.joint_names, drive)
    everywhere = dict.fromkeys(model.joint_names, effects)
    tool = "vd-gap export"
    write_layer(path, model, baseline=baseline, effects=everywhere, tool=tool, recording=str(layer))
