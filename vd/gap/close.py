"""Close the gap: write the identified model as a USD layer, read it back, and simulate the commands again.

A hand is simulated in Newton, the simulator of training, never in the model that was fitted. A bare servo
or pendulum has no articulation: there the layer is read back into the joint's own model.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vd.gap.coordinates import GRAVITY
from vd.gap.recording import Recording
from vd.gap.result import Closing, NamedEffect, Predictions, Report, effect_values
from vd.kernels.servo.effects import BASELINE, EFFECTS

if TYPE_CHECKING:
    from vd.assets_usd.hand_model import HandModel

WHOLE_HAND_LAYER = "identified-all-fingers.usda"
"""The same on every finger, as the paper applies what it identified on one."""


def write_identified(
    report: Report,
    path: Path,
    recording: Recording,
    hand: "HandModel | None",
    start: Mapping[str, np.ndarray],
    *,
    every_finger: bool = False,
) -> None:
    """Write what a report identified as a layer.

    Args:
        report: The report.
        path: File to write, ``.usda``.
        recording: What it was identified from.
        hand: The hand; None for a bare servo or pendulum.
        start: Parameter row of each joint that the analysis started from; its effects stay in the layer.
        every_finger: Give the joints of the fingers that were not recorded the model of their counterpart on
            the first recorded finger (paper, Dynamics Identification).
    """
    from vd.assets_usd.hand_layer import write_layer

    fitted = report.identified.parameters
    held = (*report.effects, *report.provisional)
    source = {joint: joint for joint in fitted}
    if every_finger and hand is not None:
        source |= counterparts(hand, tuple(fitted))
    write_layer(
        path,
        hand if hand is not None else recording.model,
        baseline={
            joint: {p.name: fitted[known][p.name] for p in BASELINE if p.name in fitted[known]}
            for joint, known in source.items()
        },
        effects={joint: _effects(held, known, fitted[known], start) for joint, known in source.items()},
        tool="vd-gap",
        recording=report.recording.path,
    )


def one_finger(recording: Recording, hand: "HandModel | None") -> bool:
    """Whether a hand has more fingers than were recorded."""
    if hand is None:
        return False
    return len({_finger(j) for j in recording.joints}) < len({_finger(j) for j in hand.joint_names})


def _finger(joint: str) -> str:
    return joint.partition("_")[0]


def counterparts(hand: "HandModel", known: tuple[str, ...]) -> dict[str, str]:
    """The identified joint at the same place of another finger, for joints that have none of their own.

    Of a finger with as many joints, and with the same motor where the hand says which it has.
    """
    like = dict[str, object]()
    for joint, finger, motor in zip(hand.joint_names, hand.joint_finger, hand.motors, strict=True):
        kind = None if motor is None else replace(motor, id=0, sign=1.0, offset_rad=0.0)
        like[joint] = joint.partition("_")[2], np.count_nonzero(hand.joint_finger == finger), kind
    place = {like[joint]: joint for joint in reversed(known)}
    return {j: place[like[j]] for j in hand.joint_names if j not in known and like[j] in place}


def _effects(
    held: tuple[NamedEffect, ...], joint: str, fitted: Mapping[str, float], start: Mapping[str, np.ndarray]
) -> dict[str, dict[str, Any]]:
    """Effects of a joint: those it started with, a pendulum's gravity, and the identified ones."""
    values: dict[str, dict[str, Any]] = {}
    if joint in start:
        for effect in EFFECTS.values():
            row = {p.name: float(start[joint][p.column]) for p in effect.parameters}
            if any(row[p.name] != p.neutral for p in effect.parameters):
                values[effect.name] = row
    if GRAVITY.name in fitted:
        values.setdefault("gravity_load", {})[GRAVITY.name] = fitted[GRAVITY.name]
    for name, parameters in effect_values(held, joint).items():
        known = values.setdefault(name, {})
        for key, (value, low, high) in parameters.items():
            certain = np.isfinite([low, high]).all() and low <= value <= high
            known[key] = (value, low, high) if certain else value
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
) -> tuple[Closing, Predictions]:
    """Simulate the recording's commands with the baseline and with the layer.

    Args:
        report: What was identified, without a closing.
        layer: The layer that :func:`write_identified` wrote.
        recording: The recording.
        hand_name: Name or file of the hand; None for a bare servo or pendulum.
        start_layer: Layer that the analysis started from.
        curves: The fit's curves.
        device: Warp device.

    Returns:
        What it showed, and the new curves.
    """
    if hand_name is None:
        before, after = curves.baseline, _bare(layer, recording, curves, device)
    else:
        before, after = _newton(report, layer, recording, hand_name, start_layer, device)
    unseen = np.isnan(curves.baseline)
    before, after = (np.where(unseen, np.nan, each) for each in (before, after))
    squares = {}
    for joint in report.identified.per_joint:
        moved = [curves.files.index(row.file) for row in report.trajectories if row.joint == joint]
        rows, column = np.isin(curves.trajectory, moved), curves.joints.index(joint)
        models = np.stack([before[rows, column], after[rows, column]], axis=1)
        squares[joint] = (models - curves.measured[rows, column, None]) ** 2
    plain, identified = _rms(np.concatenate(list(squares.values())))
    closing = Closing(
        simulator="rollout" if hand_name is None else "newton",
        layer=layer.name,
        baseline_rmse_rad=plain,
        identified_rmse_rad=identified,
        per_joint={joint: _rms(values) for joint, values in squares.items()},
    )
    return closing, replace(curves, baseline=before, identified=after)


def _rms(squares: np.ndarray) -> tuple[float, float]:
    """Of baseline and identified model."""
    before, after = np.sqrt(squares.mean(axis=0))
    return float(before), float(after)


def _newton(
    report: Report, layer: Path, recording: Recording, hand_name: str, start_layer: Path | None, device: str
) -> np.ndarray:
    """Both models in Newton [2, S, J]; the identified one as any user of the layer reads it."""
    from vd.assets_usd.hands import load_hand
    from vd.gap.newton import simulate_hand

    before, after = load_hand(hand_name, layer=start_layer), load_hand(hand_name, layer=layer)
    rows = np.array([before.servo, after.servo], dtype=float)
    for joint, values in report.baseline.parameters.items():
        for parameter in (*BASELINE, GRAVITY):
            if parameter.name in values:
                rows[0, before.joint_names.index(joint), parameter.column] = values[parameter.name]
    return simulate_hand(recording, after, rows, device=device)


def _bare(layer: Path, recording: Recording, curves: Predictions, device: str) -> np.ndarray:
    """The identified model of each joint as it comes back from the layer [S, J]."""
    from vd.assets_usd.hand_layer import read_bare_layer
    from vd.gap.chain import chains
    from vd.gap.rollout import Rollouts

    after = curves.identified.copy()
    for chain in chains(recording, None):
        if np.isfinite(curves.identified[:, chain.columns]).any():
            rows, _ = read_bare_layer(layer, chain.joints)
            after[:, chain.columns] = Rollouts(chain, recording, device=device).predict(rows[None])[0]
    return after
