"""An identified servo model as a USD layer over a hand, or of bare joints: ``identified.usda``.

The layer holds ``over`` prims for joints, ``/dclaw3/f0_j1`` for example, and nothing else:

* the drive as it was identified, in the attributes that every reader of UsdPhysics knows:
  ``drive:angular:physics:stiffness`` and ``damping`` (per degree), ``newton:velocityLimit``
  (degrees per second) and ``newton:armature``,
* every effect, ``vd:<effect>:<parameter>`` (double, SI units, radians), by the names of
  :data:`vd.kernels.servo.effects.EFFECTS`,
* 95 % intervals, ``vd:<effect>:<parameter>:ci95`` (float2: low, high; SI units, radians), with
  ``baseline`` as the effect for stiffness, damping, speed limit and armature
  (``vd:baseline:kp:ci95``).

The layer is plain USD: it can be a sublayer of any stage in which the hand is, and the same
attributes may be authored in a hand's own file. A motor on a bench, which has no hand, has the same
on ``/servo/<joint>`` or ``/pendulum/<joint>``.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pxr import Gf, Sdf, Tf, Usd

from vd.assets_usd.hand_data import HandError, HandModel
from vd.command.files import atomic_path
from vd.kernels.servo.actuators import PARAMETER_COLUMNS
from vd.kernels.servo.effects import BASELINE, EFFECTS, Parameter, neutral_row

LAYER_FORMAT = "vd-hand-layer/1"
"""What ``customLayerData`` of a layer says it is."""

NAMESPACE = "vd"
DESCRIPTION_GROUPS = ("start", "source", "motor")
"""Attributes ``vd:<group>`` and ``vd:<group>:...`` of joints that describe the hand, not its servo
model.
"""
BASELINE_GROUP = "baseline"
"""In the place of an effect's name: intervals of the drive, whose values are in USD's own
attributes.
"""
INTERVAL = ":ci95"

DRIVE: dict[str, tuple[str, float]] = {
    "kp": ("drive:angular:physics:stiffness", math.radians(1.0)),
    "kd": ("drive:angular:physics:damping", math.radians(1.0)),
    "velocity_limit": ("newton:velocityLimit", math.degrees(1.0)),
    "inertia": ("newton:armature", 1.0),
    "kd_off": ("vd:baseline:kd_off", 1.0),
}
"""USD attribute of each parameter of the baseline, and the factor from SI and radians to its
unit.
"""

Estimate = float | Sequence[float]
"""A value, or (value, low, high) with its 95 % interval."""


class _Number(NamedTuple):
    """Where a parameter is in USD: its attribute, and the factor from SI to its unit."""

    group: str
    parameter: Parameter
    attribute: str
    factor: float

    @property
    def interval(self) -> str:
        return f"{NAMESPACE}:{self.group}:{self.parameter.name}{INTERVAL}"


def _numbers() -> dict[str, dict[str, _Number]]:
    """Every number of a servo model, by effect (or the baseline) and parameter."""
    numbers = {
        BASELINE_GROUP: {p.name: _Number(BASELINE_GROUP, p, *DRIVE[p.name]) for p in BASELINE}
    }
    for group, effect in EFFECTS.items():
        numbers[group] = {}
        for parameter in effect.parameters:
            attribute = f"{NAMESPACE}:{group}:{parameter.name}"
            numbers[group][parameter.name] = _Number(group, parameter, attribute, 1.0)
    return numbers


_NUMBERS = _numbers()


def write_layer(
    path: Path,
    hand: HandModel | str,
    *,
    baseline: Mapping[str, Mapping[str, Estimate]],
    effects: Mapping[str, Mapping[str, Mapping[str, Estimate]]],
    tool: str,
    recording: str,
) -> None:
    """Write an identified servo model as a layer over a hand, atomically.

    Args:
        path: File to write, ``.usda``.
        hand: The hand, or the name of its root prim where there is no hand (a bare servo).
        baseline: By joint, then by name (``kp``, ``kd``, ``velocity_limit``, ``inertia``): the
            drive, in SI units and radians. What is left out stays as the hand's file has it.
        effects: By joint, effect and parameter: what the plain drive lacks.
        tool: What wrote it, for people: ``vd-gap run``.
        recording: Which recording it was identified from.

    Raises:
        HandError: The file is not to be a ``.usda``.
        KeyError: An unknown effect or parameter.
        ValueError: An unknown joint.
    """
    names = [*dict.fromkeys([*baseline, *effects])]
    root = hand if isinstance(hand, str) else hand.name
    if not isinstance(hand, str):
        names.sort(key=hand.joint_names.index)
    layer = new_layer(
        root,
        f"Servo model of {root}, identified by {tool} from {recording}. A layer over the hand: "
        "pass it with --hand-layer, or make it a sublayer. Drives are in USD's units (degrees), "
        "vd:* in SI and radians.",
        {"format": LAYER_FORMAT, "tool": tool, "recording": recording},
    )
    top = Sdf.PrimSpec(layer, root, Sdf.SpecifierOver)
    for name in names:
        joint = Sdf.PrimSpec(top, name, Sdf.SpecifierOver)
        _write_numbers(joint, BASELINE_GROUP, baseline.get(name, {}))
        for effect, values in effects.get(name, {}).items():
            _write_numbers(joint, effect, values)
    save_layer(layer, path)


def new_layer(root: str, documentation: str, data: Mapping[str, str]) -> Sdf.Layer:
    """An empty layer over a stage's root prim, with what it says of itself and its custom data."""
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.defaultPrim = root
    layer.documentation = documentation
    layer.customLayerData = dict(data)
    return layer


def author(
    prim: Sdf.PrimSpec, name: str, kind: Sdf.ValueTypeName, value: Any, documentation: str = ""
) -> None:
    """Author an attribute on a prim's spec; those in the namespace ``vd`` are of no schema."""
    custom = name.startswith(f"{NAMESPACE}:")
    spec = Sdf.AttributeSpec(prim, name, kind, Sdf.VariabilityVarying, declaresCustom=custom)
    spec.default = value
    if documentation:
        spec.documentation = documentation


def save_layer(layer: Sdf.Layer, path: Path) -> None:
    """Write a layer as text, atomically.

    Raises:
        HandError: The suffix is not ``.usda``.
    """
    if Path(path).suffix != ".usda":
        raise HandError(f"{path}: a layer is plain text; give it the suffix .usda")
    with atomic_path(path) as temporary:
        if not layer.Export(str(temporary)):
            raise OSError(f"{path}: USD could not write the layer; is the disk full?")


def open_layer(path: Path) -> Sdf.Layer:
    """A layer as its file is now.

    Raises:
        HandError: The file is missing or no USD.
    """
    if not Path(path).is_file():
        raise HandError(
            f"{path}: no such hand layer; name the identified.usda that vd-gap wrote, or, for a "
            "policy trained with one that is not here, --hand-layer none"
        )
    try:
        layer = Sdf.Layer.FindOrOpen(str(Path(path).resolve()))
    except Tf.ErrorException as error:
        raise HandError(f"{path}: not a USD layer ({error}); let vd-gap write it again") from error
    if layer is None:
        raise HandError(f"{path}: not a USD layer; let vd-gap write it again")
    layer.Reload(force=True)  # it may be open elsewhere, from before it was written anew
    return layer


def add_layer(stage: Usd.Stage, path: Path) -> None:
    """Put a layer over a hand, in the stage's session, so that it is stronger than the hand's file.

    Args:
        stage: The stage of a hand, opened by :func:`vd.assets_usd.hand_model.open_stage`.
        path: The layer.

    Raises:
        HandError: The file is missing, no USD or empty, or changes prims that the hand does not
            have.
    """
    layer = open_layer(path)
    hand = stage.GetRootLayer().realPath
    root = stage.GetDefaultPrim().GetName()
    if not layer.rootPrims:
        raise HandError(
            f"{path}: not an identified servo model, it has no joints; let vd-gap write it again"
        )
    for prim in layer.rootPrims:
        if prim.name != root:
            raise HandError(
                f"{path}: {prim.path}: this layer is for {prim.name}, not for {root} ({hand}); "
                "use one that was made on this hand"
            )
    unknown: list[str] = []

    def visit(where: Sdf.Path) -> None:
        if where.IsPrimPath() and not stage.GetPrimAtPath(where):
            unknown.append(str(where))

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    if unknown:
        raise HandError(
            f"{path}: {min(unknown)}: {root} has no such prim ({hand}); name a joint that it has, "
            f"f0_j1 ..."
        )
    stage.GetSessionLayer().subLayerPaths.append(layer.identifier)


def read_bare_layer(path: Path, joints: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """The servo models of joints without a hand.

    Args:
        path: Layer that :func:`write_layer` wrote for a bare servo.
        joints: Names of the joints, J.

    Returns:
        Rows of parameters [J, P] and their 95 % intervals [J, P, 2], NaN where none is authored.

    Raises:
        HandError: The file is missing, no such layer, or lacks a joint or its drive; names it.
    """
    layer = open_layer(path)
    if layer.customLayerData.get("format") != LAYER_FORMAT:
        raise HandError(
            f"{path}: not an identified servo model ({LAYER_FORMAT}); let vd-gap write it again"
        )
    stage = Usd.Stage.Open(layer)
    prims = [stage.GetPrimAtPath(f"/{layer.defaultPrim}/{name}") for name in joints]
    for name, prim in zip(joints, prims, strict=True):
        if not prim:
            raise HandError(
                f"{path}: there is no joint /{layer.defaultPrim}/{name}; identify it first"
            )
    baseline = {}
    for name, (attribute, factor) in DRIVE.items():
        if attribute.startswith(f"{NAMESPACE}:"):
            continue
        for prim in prims:
            if not prim.GetAttribute(attribute).HasAuthoredValue():
                raise HandError(
                    f"{path}: {prim.GetPath()}: '{attribute}' is not authored; give it a value"
                )
        baseline[name] = np.array([prim.GetAttribute(attribute).Get() / factor for prim in prims])
    return read_servo(prims, baseline, path)


def read_servo(
    joints: Sequence[Usd.Prim], baseline: Mapping[str, np.ndarray], source: Path
) -> tuple[np.ndarray, np.ndarray]:
    """The servo model that a hand's joints author.

    Args:
        joints: Joint prims [D].
        baseline: Values of the parameters of :data:`vd.kernels.servo.effects.BASELINE` by name, [D]
            each, SI units.
        source: The file to name in errors.

    Returns:
        Rows of parameters [D, P] and their 95 % intervals [D, P, 2], NaN where none is authored.

    Raises:
        HandError: An attribute of ``vd:`` that is no parameter of an effect, or a value that cannot
            be one.
    """
    rows = np.tile(np.array(neutral_row(), dtype=float), (len(joints), 1))
    intervals = np.full((len(joints), PARAMETER_COLUMNS, 2), np.nan)
    for parameter in BASELINE:
        if parameter.name in baseline:
            rows[:, parameter.column] = baseline[parameter.name]
    for row, interval, joint in zip(rows, intervals, joints, strict=True):
        where = f"{source}: {joint.GetPath()}"
        given: dict[str, set[str]] = {BASELINE_GROUP: {p.name for p in BASELINE}}
        ranges: list[_Number] = []
        for attribute in joint.GetAuthoredPropertiesInNamespace(NAMESPACE):
            name = attribute.GetName()
            if name.split(":")[1] in DESCRIPTION_GROUPS:
                continue
            number = _number_of(where, name)
            parameter = number.parameter
            value = attribute.Get() if isinstance(attribute, Usd.Attribute) else None
            if name == number.interval:
                interval[parameter.column] = _interval(where, name, parameter, value)
                ranges.append(number)
            else:
                row[parameter.column] = _checked(where, name, parameter, value)
                given.setdefault(number.group, set()).add(parameter.name)
        for number in ranges:
            if number.parameter.name not in given.get(number.group, ()):
                raise HandError(
                    f"{where}: '{number.interval}' is an interval without a value; author the "
                    "value too"
                )
        for group, names in given.items():
            _check_complete(where, group, names)
    return rows, intervals


def _check_complete(where: str, group: str, given: set[str]) -> None:
    """Refuse an effect without a parameter that has no value at which it does nothing."""
    for name, number in _NUMBERS[group].items():
        if number.parameter.lower > 0.0 and name not in given:
            raise HandError(
                f"{where}: {group} lacks '{number.attribute}'; author it, or remove {group}"
            )


def _number_of(where: str, attribute: str) -> _Number:
    """The number whose value or interval an attribute of a joint is."""
    group = attribute.split(":")[1]
    if group not in _NUMBERS:
        raise HandError(
            f"{where}: '{attribute}': no effect is called {group!r}; one of {', '.join(EFFECTS)}"
        )
    known = []
    for number in _NUMBERS[group].values():
        if attribute in (number.attribute, number.interval):
            return number
        known.append(number.attribute)
    raise HandError(
        f"{where}: '{attribute}' is no attribute of {group}; one of {', '.join(known)}, or their "
        f"intervals ({INTERVAL})"
    )


def _checked(where: str, name: str, parameter: Parameter, value: object) -> float:
    """A value that the parameter can have."""
    if not isinstance(value, (int, float)) or not math.isfinite(value):
        raise HandError(
            f"{where}: '{name}' is {value!r}; it must be a finite number [{parameter.unit}]"
        )
    if value < 0.0 and not parameter.signed:
        raise HandError(f"{where}: '{name}' is {value:g} {parameter.unit}; it cannot be negative")
    if value == 0.0 and parameter.lower > 0.0:
        raise HandError(
            f"{where}: '{name}' is 0; it must be positive; leave it out if there is none"
        )
    return float(value)


def _interval(where: str, name: str, parameter: Parameter, value: object) -> tuple[float, float]:
    """Low and high end of a 95 % interval."""
    try:
        low, high = (float(v) for v in value)  # type: ignore[attr-defined]
    except (TypeError, ValueError) as error:
        raise HandError(
            f"{where}: '{name}' is {value!r}; it must be two numbers, low and high"
        ) from error
    if not (math.isfinite(low) and math.isfinite(high) and low <= high):
        raise HandError(
            f"{where}: '{name}' is ({low:g}, {high:g}); low comes first, and both are finite"
        )
    if low < 0.0 and not parameter.signed:
        raise HandError(
            f"{where}: '{name}' begins at {low:g} {parameter.unit}; it cannot be negative"
        )
    return low, high


def _write_numbers(joint: Sdf.PrimSpec, group: str, values: Mapping[str, Estimate]) -> None:
    """Author the numbers of an effect, or of the baseline, on a joint."""
    for name, estimate in values.items():
        number = _NUMBERS[group][name]
        unit = number.parameter.unit
        value, *ends = np.atleast_1d(estimate).tolist()
        ours = number.attribute.startswith(f"{NAMESPACE}:")
        kind = Sdf.ValueTypeNames.Double if ours else Sdf.ValueTypeNames.Float
        text = f"{name} = {value:g} {unit}"
        if group in EFFECTS:
            text = f"{EFFECTS[group].meaning} [{unit}]"
        author(joint, number.attribute, kind, value * number.factor, text)
        if ends:
            text = f"95 % interval of {name} [{unit}]"
            author(joint, number.interval, Sdf.ValueTypeNames.Float2, Gf.Vec2f(*ends), text)
