"""An identified servo model as a USD layer over a hand: ``identified.usda``.

The layer holds ``over`` prims for the hand's joints, ``/dclaw3/f0_j1`` for example, and nothing else:

* the drive as it was identified, in the attributes that every reader of UsdPhysics knows:
  ``drive:angular:physics:stiffness`` and ``damping`` (per degree), ``newton:velocityLimit`` (degrees per
  second) and ``newton:armature``,
* every effect, ``vd:<effect>:<parameter>`` (double, SI units, radians), by the names of
  :data:`vd.kernels.servo.effects.EFFECTS`,
* 95 % intervals, ``vd:<effect>:<parameter>:ci95`` (float2: low, high; SI units, radians), with ``baseline``
  as the effect for stiffness, damping, speed limit and armature (``vd:baseline:kp:ci95``).

The layer is plain USD: it can be a sublayer of any stage in which the hand is, and the same attributes may
be authored in a hand's own file.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Tf, Usd

from vd.assets_usd.hand_data import HandError, HandModel
from vd.files import atomic_path
from vd.kernels.servo.actuators import PARAMETER_COLUMNS
from vd.kernels.servo.effects import BASELINE, EFFECTS, Parameter, neutral_row

__all__ = ["LAYER_FORMAT", "Estimate", "HandError", "add_layer", "read_servo", "write_layer"]

LAYER_FORMAT = "vd-hand-layer/1"
"""What ``customLayerData`` of a layer says it is."""

NAMESPACE = "vd"
BASELINE_GROUP = "baseline"
"""In the place of an effect's name: intervals of the drive, whose values are in USD's own attributes."""
INTERVAL = "ci95"

DRIVE: dict[str, tuple[str, float]] = {
    "kp": ("drive:angular:physics:stiffness", math.radians(1.0)),
    "kd": ("drive:angular:physics:damping", math.radians(1.0)),
    "velocity_limit": ("newton:velocityLimit", math.degrees(1.0)),
    "inertia": ("newton:armature", 1.0),
    "kd_off": ("vd:baseline:kd_off", 1.0),
}
"""USD attribute of each parameter of the baseline, and the factor from SI and radians to its unit."""

Estimate = float | Sequence[float]
"""A value, or (value, low, high) with its 95 % interval."""


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
        baseline: By joint, then by name (``kp``, ``kd``, ``velocity_limit``, ``inertia``): the drive, in SI
            units and radians. What is left out stays as the hand's file has it.
        effects: By joint, effect and parameter: what the plain drive lacks.
        tool: What wrote it, for people: ``vd-gap run``.
        recording: Which recording it was identified from.

    Raises:
        HandError: An unknown joint, effect or parameter, or a number that cannot be one; names it.
    """
    path = Path(path)
    if path.suffix != ".usda":
        raise HandError(f"{path}: a hand layer is plain text; give it the suffix .usda, not {path.suffix!r}")
    root = hand if isinstance(hand, str) else hand.name
    names = [*dict.fromkeys([*baseline, *effects])]
    if not isinstance(hand, str):
        for name in names:
            if name not in hand.joint_names:
                raise HandError(f"{path}: {root} has no joint {name!r}; it has {', '.join(hand.joint_names)}")
        names.sort(key=hand.joint_names.index)
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.defaultPrim = root
    layer.documentation = (
        f"Servo model of {root}, identified by {tool} from {recording}. A layer over the hand: pass it with "
        f"--hand-layer, or make it a sublayer. Drives are in USD's units (degrees), vd:* in SI and radians."
    )
    layer.customLayerData = {"format": LAYER_FORMAT, "tool": tool, "recording": recording}
    top = Sdf.PrimSpec(layer, root, Sdf.SpecifierOver)
    for name in names:
        joint = Sdf.PrimSpec(top, name, Sdf.SpecifierOver)
        _write_baseline(path, joint, baseline.get(name, {}))
        for effect, values in effects.get(name, {}).items():
            _write_effect(path, joint, effect, values)
    with atomic_path(path) as temporary:
        if not layer.Export(str(temporary)):
            raise OSError(f"{path}: USD could not write the layer; is the disk full?")


def add_layer(stage: Usd.Stage, path: Path) -> None:
    """Put a layer over a hand, in the stage's session, so that it is stronger than the hand's file.

    Args:
        stage: The stage of a hand, opened by :func:`vd.assets_usd.hand_model.open_stage`.
        path: The layer.

    Raises:
        HandError: The file is missing or no USD, or changes prims that the hand does not have.
    """
    if not path.is_file():
        raise HandError(
            f"{path}: no such hand layer; name the identified.usda that vd-gap wrote, or, for a policy "
            "trained with one that is not here, --hand-layer none"
        )
    try:
        layer = Sdf.Layer.FindOrOpen(str(path.resolve()))
    except Tf.ErrorException as error:
        raise HandError(f"{path}: not a USD layer ({error}); let vd-gap write it again") from error
    if layer is None:
        raise HandError(f"{path}: not a USD layer; let vd-gap write it again")
    layer.Reload(force=True)  # it may be open elsewhere, from before it was written anew
    hand = stage.GetRootLayer().realPath
    root = stage.GetDefaultPrim().GetName()
    for prim in layer.rootPrims:
        if prim.name != root:
            raise HandError(
                f"{path}: {prim.path}: this layer is for {prim.name}, not for {root} ({hand}); "
                "use the layer that was identified on this hand"
            )
    unknown: list[str] = []

    def visit(where: Sdf.Path) -> None:
        if where.IsPrimPath() and not stage.GetPrimAtPath(where):
            unknown.append(str(where))

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    if unknown:
        raise HandError(
            f"{path}: {min(unknown)}: {root} has no such prim ({hand}); name a joint that it has, f0_j1 ..."
        )
    stage.GetSessionLayer().subLayerPaths.append(layer.identifier)


def read_servo(
    joints: Sequence[Usd.Prim], baseline: Mapping[str, np.ndarray], source: Path
) -> tuple[np.ndarray, np.ndarray]:
    """The servo model that a hand's joints author.

    Args:
        joints: Joint prims [D].
        baseline: Values of the parameters of :data:`vd.kernels.servo.effects.BASELINE` by name, [D] each, SI
            units.
        source: The file to name in errors.

    Returns:
        Rows of parameters [D, P] and their 95 % intervals [D, P, 2], NaN where none is authored.

    Raises:
        HandError: An attribute of ``vd:`` that is no parameter of an effect, or a value that cannot be one.
    """
    rows = np.tile(np.array(neutral_row(), dtype=float), (len(joints), 1))
    intervals = np.full((len(joints), PARAMETER_COLUMNS, 2), np.nan)
    for parameter in BASELINE:
        if parameter.name in baseline:
            rows[:, parameter.column] = baseline[parameter.name]
    for index, joint in enumerate(joints):
        where = f"{source}: {joint.GetPath()}"
        valued: dict[str, set[str]] = {}
        ranges: list[tuple[str, str, str]] = []
        for attribute in joint.GetAuthoredPropertiesInNamespace(NAMESPACE):
            name = attribute.GetName()
            effect, parameter, interval = _parse(where, name)
            value = attribute.Get() if isinstance(attribute, Usd.Attribute) else None
            if interval:
                intervals[index, parameter.column] = _interval(where, name, parameter, value)
                ranges.append((name, effect, parameter.name))
            else:
                rows[index, parameter.column] = _checked(where, name, parameter, value)
                valued.setdefault(effect, set()).add(parameter.name)
        valued.pop(BASELINE_GROUP, None)
        _check_complete(where, valued, ranges)
    return rows, intervals


def _check_complete(where: str, effects: dict[str, set[str]], ranges: list[tuple[str, str, str]]) -> None:
    """Refuse an effect without one of its parameters, or an interval without its value.

    Args:
        where: File and joint, for errors.
        effects: Names of the parameters that have a value, by effect.
        ranges: Attribute, effect and parameter of each interval.
    """
    for effect, authored in effects.items():
        if missing := _missing(effect, authored):
            raise HandError(
                f"{where}: {effect} lacks '{NAMESPACE}:{effect}:{missing[0]}'; author it, or remove {effect}"
            )
    for name, effect, parameter in ranges:
        if effect != BASELINE_GROUP and parameter not in effects.get(effect, ()):
            raise HandError(f"{where}: '{name}' is an interval without a value; author the value too")


def _parse(where: str, name: str) -> tuple[str, Parameter, bool]:
    """Effect, parameter, and whether the attribute is an interval."""
    parts = name.split(":")
    effect = parts[1]
    if effect == BASELINE_GROUP:
        known, remedy = {p.name: p for p in BASELINE}, "the baseline"
    elif effect in EFFECTS:
        known, remedy = {p.name: p for p in EFFECTS[effect].parameters}, effect
    else:
        raise HandError(f"{where}: '{name}': no effect is called {effect!r}; one of {', '.join(EFFECTS)}")
    if len(parts) < 3 or parts[2] not in known:
        raise HandError(
            f"{where}: '{name}' is no parameter of {remedy}; one of "
            + ", ".join(f"{NAMESPACE}:{effect}:{p}" for p in known)
        )
    interval = parts[3:] == [INTERVAL]
    if len(parts) > 3 and not interval:
        raise HandError(f"{where}: '{name}': after a parameter only ':{INTERVAL}' can stand; rename it")
    if effect == BASELINE_GROUP and not interval and DRIVE[parts[2]][0] != name:
        raise HandError(
            f"{where}: '{name}': the value belongs into '{DRIVE[parts[2]][0]}'; only ':{INTERVAL}' goes here"
        )
    return effect, known[parts[2]], interval


def _missing(effect: str, given: "set[str] | Mapping[str, Estimate]") -> list[str]:
    """Parameters that an effect cannot do without: those that have no value at which they do nothing."""
    return [p.name for p in EFFECTS[effect].parameters if p.lower > 0.0 and p.name not in given]


def _checked(where: str, name: str, parameter: Parameter, value: object) -> float:
    """A value that the parameter can have."""
    if not isinstance(value, (int, float)) or not math.isfinite(value):
        raise HandError(f"{where}: '{name}' is {value!r}; it must be a finite number [{parameter.unit}]")
    if value < 0.0 and not parameter.signed:
        raise HandError(f"{where}: '{name}' is {value:g} {parameter.unit}; it cannot be negative")
    if value == 0.0 and parameter.lower > 0.0:
        raise HandError(f"{where}: '{name}' is 0; it must be positive; leave it out if there is none")
    return float(value)


def _interval(where: str, name: str, parameter: Parameter, value: object) -> tuple[float, float]:
    """Low and high end of a 95 % interval."""
    try:
        low, high = (float(v) for v in value)  # type: ignore[attr-defined]
    except (TypeError, ValueError) as error:
        raise HandError(f"{where}: '{name}' is {value!r}; it must be two numbers, low and high") from error
    if not (math.isfinite(low) and math.isfinite(high) and low <= high):
        raise HandError(f"{where}: '{name}' is ({low:g}, {high:g}); low comes first, and both are finite")
    if low < 0.0 and not parameter.signed:
        raise HandError(f"{where}: '{name}' begins at {low:g} {parameter.unit}; it cannot be negative")
    return low, high


def _split(estimate: Estimate) -> tuple[object, object]:
    """Value and interval (None if there is none) of an estimate."""
    if isinstance(estimate, (int, float)):
        return float(estimate), None
    value, low, high = (float(number) for number in estimate)
    return value, (low, high)


def _write_baseline(path: Path, joint: Sdf.PrimSpec, values: Mapping[str, Estimate]) -> None:
    where, known = f"{path}: {joint.path}", {p.name: p for p in BASELINE}
    for name, estimate in values.items():
        if name not in known:
            raise HandError(f"{where}: the baseline has no parameter {name!r}; one of {', '.join(known)}")
        parameter, (attribute, factor) = known[name], DRIVE[name]
        value, interval = _split(estimate)
        number = _checked(where, attribute, parameter, value)
        own = attribute.startswith(f"{NAMESPACE}:")
        kind = Sdf.ValueTypeNames.Double if own else Sdf.ValueTypeNames.Float
        spec = Sdf.AttributeSpec(joint, attribute, kind, Sdf.VariabilityVarying, declaresCustom=own)
        spec.default = number * factor
        spec.documentation = f"{name} = {number:g} {parameter.unit}"
        _write_interval(where, joint, BASELINE_GROUP, parameter, interval)


def _write_effect(path: Path, joint: Sdf.PrimSpec, effect: str, values: Mapping[str, Estimate]) -> None:
    where = f"{path}: {joint.path}"
    if effect not in EFFECTS:
        raise HandError(f"{where}: no effect is called {effect!r}; one of {', '.join(EFFECTS)}")
    missing = _missing(effect, values)
    if missing:
        raise HandError(f"{where}: {effect} lacks {missing[0]}; give it")
    for name, estimate in values.items():
        attribute = f"{NAMESPACE}:{effect}:{name}"
        _, parameter, _ = _parse(where, attribute)
        value, interval = _split(estimate)
        spec = Sdf.AttributeSpec(
            joint, attribute, Sdf.ValueTypeNames.Double, Sdf.VariabilityVarying, declaresCustom=True
        )
        spec.default = _checked(where, attribute, parameter, value)
        spec.documentation = f"{EFFECTS[effect].meaning} [{parameter.unit}]"
        _write_interval(where, joint, effect, parameter, interval)


def _write_interval(
    where: str, joint: Sdf.PrimSpec, group: str, parameter: Parameter, interval: object
) -> None:
    if interval is None:
        return
    attribute = f"{NAMESPACE}:{group}:{parameter.name}:{INTERVAL}"
    low, high = _interval(where, attribute, parameter, interval)
    spec = Sdf.AttributeSpec(
        joint, attribute, Sdf.ValueTypeNames.Float2, Sdf.VariabilityVarying, declaresCustom=True
    )
    spec.default = Gf.Vec2f(low, high)
    spec.documentation = f"95 % interval of {parameter.name} [{parameter.unit}]"
