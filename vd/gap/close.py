"""Close the gap: write the identified model as a USD layer, read it back, and simulate the commands again.

A hand is simulated in Newton, the simulator of training, never in the model that was fitted. A bare
servo
or pendulum has no articulation: there the layer is read back into the joint's own model.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from vd.gap.coordinates import GRAVITY
from vd.gap.result import (
    LAYER,
    Closing,
    Delivered,
    NamedEffect,
    Predictions,
    Report,
)
from vd.kernels.servo.effects import BASELINE, EFFECTS
from vd.logs.recording import Recording

if TYPE_CHECKING:
    from vd.assets_usd.hand_model import HandModel

WHOLE_HAND_LAYER = "identified-all-fingers.usda"
"""The same on every finger like the recorded one (paper, Dynamics Identification)."""


def write_identified(
    report: Report,
    folder: Path,
    recording: Recording,
    hand: "HandModel | None",
    start: Mapping[str, np.ndarray],
) -> str:
    """Write what a report identified as a layer.

    For a hand with fingers like those recorded, one with them.

    Args:
        report: The report.
        folder: Where.
        recording: What it was identified from.
        hand: The hand; None for a bare servo or pendulum.
        start: Parameter row of each joint that the analysis started from; its effects stay in the
            layer.

    Returns:
        Name of the layer for all fingers, empty without one.
    """
    from vd.assets_usd.hand_layer import write_layer

    fitted = report.identified.parameters
    held = (*report.effects, *report.provisional)
    (folder / WHOLE_HAND_LAYER).unlink(missing_ok=True)
    others = {} if hand is None else counterparts(hand, tuple(fitted))
    source = {joint: joint for joint in fitted}
    layers = {LAYER: source}
    if others:
        layers[WHOLE_HAND_LAYER] = source | others
    for name, known in layers.items():
        baseline = {}
        effects = {}
        for joint, own in known.items():
            values = fitted[own]
            baseline[joint] = {p.name: values[p.name] for p in BASELINE if p.name in values}
            effects[joint] = _effects(held, own, values, start)
        write_layer(
            folder / name,
            hand if hand is not None else recording.model,
            baseline=baseline,
            effects=effects,
            tool="vd-gap",
            recording=report.recording.path,
        )
    return WHOLE_HAND_LAYER if others else ""


def counterparts(hand: "HandModel", known: tuple[str, ...]) -> dict[str, str]:
    """The identified joint at the same place of another finger, for joints that have none of their own.

    Of a finger with as many joints, and with the same motor where the hand says which it has.
    """
    like = dict[str, object]()
    for joint, finger, motor in zip(hand.joint_names, hand.joint_finger, hand.motors, strict=True):
        kind = None if motor is None else replace(motor, id=0, sign=1.0, offset_rad=0.0)
        like[joint] = joint.partition("_")[2], np.count_nonzero(hand.joint_finger == finger), kind
    others: dict[str, str] = {}
    for joint in hand.joint_names:
        for own in () if joint in known else known:
            if like[joint] == like[own]:
                others.setdefault(joint, own)
    return others


def _effects(
    held: tuple[NamedEffect, ...],
    joint: str,
    fitted: Mapping[str, float],
    start: Mapping[str, np.ndarray],
) -> dict[str, dict[str, Any]]:
    """Effects of a joint: those it started with, a pendulum's gravity, and the identified ones."""
    values: dict[str, dict[str, Any]] = {}
    if joint in start:
        for named in EFFECTS.values():
            row = {}
            acts = False
            for p in named.parameters:
                row[p.name] = float(start[joint][p.column])
                acts = acts or row[p.name] != p.neutral
            if acts:
                values[named.name] = row
    if GRAVITY.name in fitted:
        values.setdefault("gravity_load", {})[GRAVITY.name] = fitted[GRAVITY.name]
    for effect in held:
        if joint not in effect.joints:
            continue
        for key, number in effect.parameters.items():
            low, high = number.ci95
            certain = -np.inf < low <= number.value <= high < np.inf
            known = (number.value, low, high) if certain else number.value
            values.setdefault(effect.name, {})[key] = known
    return values


def simulate_again(
    report: Report,
    layer: Path,
    recording: Recording,
    hand_name: str | None,
    start_layer: Path | None,
    curves: Predictions,
    *,
    device: str = "cpu",
) -> tuple[Closing, Delivered | None, Predictions]:
    """Simulate the recording's commands with the baseline and with the layer, as they are written.

    Args:
        report: What was identified, without a closing.
        layer: The layer that :func:`write_identified` wrote.
        recording: The recording.
        hand_name: Name or file of the hand; None for a bare servo or pendulum.
        start_layer: Layer that the analysis started from.
        curves: The fit's curves.
        device: Warp device.

    Returns:
        What it showed on motions that were fitted, and on those that no fit saw, and the new
        curves.
    """
    if hand_name is None:
        models = np.stack([curves.baseline, _bare(layer, recording, curves, device)])
    else:
        models = _newton(report, layer, recording, hand_name, start_layer, device)
    models = np.where(np.isnan(curves.baseline), np.nan, models)
    curves = replace(curves, baseline=models[0], identified=models[1])
    fitted = []
    per_joint = {}
    for joint in report.identified.per_joint:
        files = [row.file for row in report.trajectories if row.joint == joint]
        squares = _squares(curves, joint, files)
        fitted.append(squares)
        per_joint[joint] = _rms([squares])
    before, after = _rms(fitted)
    simulator: Literal["newton", "rollout"] = "rollout" if hand_name is None else "newton"
    closing = Closing(simulator, layer.name, before, after, per_joint)
    delivered = None
    if report.aside:
        unseen = [_squares(curves, joint, [file]) for joint, file in report.aside.items()]
        before, after = _rms(unseen)
        delivered = Delivered(", ".join(dict.fromkeys(report.aside.values())), after, before)
    return closing, delivered, curves


def _squares(curves: Predictions, joint: str, files: Sequence[str]) -> np.ndarray:
    """Squared errors of baseline and identified model on a joint in some trajectories [2, N]."""
    rows = np.isin(curves.trajectory, [*map(curves.files.index, files)])
    column = curves.joints.index(joint)
    models = np.stack([curves.baseline[rows, column], curves.identified[rows, column]])
    return (models - curves.measured[rows, column]) ** 2


def _rms(squares: Sequence[np.ndarray]) -> tuple[float, float]:
    """Root mean square of both models over all samples."""
    before, after = np.sqrt(np.concatenate(squares, axis=1).mean(axis=1)).tolist()
    return before, after


def _newton(
    report: Report,
    layer: Path,
    recording: Recording,
    hand_name: str,
    start_layer: Path | None,
    device: str,
) -> np.ndarray:
    """Both models in Newton [2, S, J]; the identified one as any user of the layer reads it."""
    from vd.assets_usd.hands import load_hand
    from vd.gap.rollout import STEP_S
    from vd.sim.replay import simulate_hand

    before = load_hand(hand_name, layer=start_layer)
    after = load_hand(hand_name, layer=layer)
    rows = np.array([before.servo, after.servo], dtype=float)
    for joint, values in report.baseline.parameters.items():
        for parameter in (*BASELINE, GRAVITY):
            if parameter.name in values:
                rows[0, before.joint_names.index(joint), parameter.column] = values[parameter.name]
    return simulate_hand(recording, after, rows, dt=STEP_S, device=device)


def _bare(layer: Path, recording: Recording, curves: Predictions, device: str) -> np.ndarray:
    """The identified model of each joint as it comes back from the layer [S, J]."""
    from vd.assets_usd.hand_layer import read_bare_layer
    from vd.gap.chain import chains
    from vd.gap.rollout import Rollouts

    after = curves.identified.copy()
    for chain in chains(recording, None):
        if np.isfinite(curves.identified[:, chain.columns]).any():
            rows, _ = read_bare_layer(layer, chain.joints)
            rollouts = Rollouts(chain, recording, device=device)
            after[:, chain.columns] = rollouts.predict(rows[None])[0]
    return after
