"""What ``vd-gap`` found.

The contents of ``report.json`` (format ``vd-gap-report/1``), typed and checked.

``explain`` writes a :class:`Report` without a closing to ``DIR/explain.json`` and its curves
(:class:`Predictions`) to ``DIR/predictions.npz``; ``close`` adds the closing simulation
(``DIR/close.json``, ``DIR/closing.npz``); ``report`` writes ``DIR/report.json`` and the page.
Angles are radians, errors are of the recorded joint position, intervals are 95 %.
"""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vd.command.config import from_dict, to_dict
from vd.command.files import atomic_path, write_json
from vd.logs.motions import Recording

FORMAT = "vd-gap-report/1"
LAYER = "identified.usda"
"""Identified model, beside the report."""
_OPTIONAL = ("hand", "hand_layer", "closing", "delivered")
"""Fields of a report in which None means none, not a number that is unknown."""

Verdict = Literal["effects", "ambiguous", "unknown", "under_excited", "no_gap"]
"""That of a recording is the first of these that some joint has."""
Certainty = Literal["certain", "likely", "untold", "excluded"]
"""What is known of a family of causes: all good models have it; those that have it predict more
motions best than luck gives; no more; none has it, and the best was fitted with it."""
Interval = tuple[float, float]


@dataclass(frozen=True)
class Estimate:
    """An identified number."""

    value: float
    ci95: Interval
    unit: str


@dataclass(frozen=True)
class Alternative:
    """Another effect in the place of the named one, everything refitted."""

    name: str
    held_out_rmse_rad: float
    difference_ci95: Interval
    """Of its held-out RMSE minus the named effect's [rad]; one that covers 0 tells nothing."""


@dataclass(frozen=True)
class NamedEffect:
    """An accepted effect on joints that share its parameters."""

    name: str
    """Name in :data:`vd.kernels.servo.effects.EFFECTS`."""
    joints: tuple[str, ...]
    confidence: float
    """Share of the motions that a good model with it predicts best."""
    parameters: dict[str, Estimate]
    alternatives: tuple[Alternative, ...] = ()


@dataclass(frozen=True)
class Misfit:
    """Where measurement and baseline disagree."""

    joint: str
    where: str
    """Plain words: when and in what motion."""
    signature: dict[str, float] = field(default_factory=dict)
    """The numbers behind the words."""


@dataclass(frozen=True)
class FittedModel:
    """A model and its error on all trajectories."""

    rmse_rad: float
    per_joint: dict[str, float]
    """RMSE of each joint [rad]."""
    mae_rad: float = math.nan
    parameters: dict[str, dict[str, float]] = field(default_factory=dict)
    """The baseline's parameters of each joint, SI."""


@dataclass(frozen=True)
class HeldOut:
    """Errors on trajectories that the fit has not seen.

    With cross-validation every one is such once.
    """

    trajectories: tuple[str, ...]
    """Their files."""
    baseline_rmse_rad: float
    identified_rmse_rad: float
    reduction: float
    """1 - identified / baseline."""
    ci95: Interval
    """Of the reduction, trajectories resampled."""
    baseline_mae_rad: float = math.nan
    identified_mae_rad: float = math.nan


@dataclass(frozen=True)
class JointGap:
    """The gap of one joint on held-out trajectories."""

    joint: str
    noise_floor_rad: float
    baseline_rmse_rad: float
    identified_rmse_rad: float
    verdict: Verdict
    reason: str
    """One sentence: why this verdict."""
    open_sets: tuple[tuple[str, ...], ...] = ()
    """Effects that stand in for each other in this joint's good models, a set each."""


@dataclass(frozen=True)
class FamilyVerdict:
    """What is known of a family of causes on a joint."""

    joint: str
    name: str
    verdict: Certainty
    effects: tuple[str, ...]
    """Members of the family that good models have."""
    share: float
    """Share of the motions that a good model with one of them predicts best."""


@dataclass(frozen=True)
class WholeModel:
    """A complete model of a joint: the plain servo with some effects, everything fitted together."""

    joint: str
    effects: tuple[str, ...]
    parameters: dict[str, float]
    """Fitted values, by effect and parameter (``backlash.width_rad``)."""
    rmse_rad: float
    """On the motions that it was fitted to."""
    held_out_rmse_rad: float
    """On each motion as the same model predicts it, fitted without."""
    difference_ci95: Interval
    """Of its held-out error minus the best model's, over motions [rad]."""
    share: float
    """Share of the motions that it predicts best of the good ones; 0 for others."""
    why: str
    """What speaks against it; empty for a good model."""


@dataclass(frozen=True)
class Delivered:
    """The layer as it was written, simulated on motions that no fit saw."""

    trajectory: str
    """Their files, one a joint, separated by commas."""
    rmse_rad: float
    baseline_rmse_rad: float
    """Of the plain model, fitted to the same motions."""


@dataclass(frozen=True)
class TrajectoryError:
    """Errors of one joint in one trajectory, by models that were fitted without it."""

    file: str
    excitation: str
    joint: str
    baseline_rmse_rad: float
    identified_rmse_rad: float
    baseline_mae_rad: float = math.nan
    identified_mae_rad: float = math.nan
    samples: int = 0
    """That were analysed."""


@dataclass(frozen=True)
class Closing:
    """The identified layer simulated again, on the motions that were fitted."""

    simulator: Literal["newton", "rollout"]
    """``rollout`` for a bare servo or pendulum, whose model is the joint itself."""
    layer: str
    """File beside the report."""
    baseline_rmse_rad: float
    """Before, by the same simulator."""
    identified_rmse_rad: float
    """The same with the layer."""
    per_joint: dict[str, Interval]
    """(baseline, identified) RMSE [rad] of each joint."""
    whole_hand_layer: str = ""
    """The layer with the same on every finger, where not all were recorded: the one to train
    with.
    """


@dataclass(frozen=True)
class AnalysedRecording:
    """What was analysed."""

    path: str
    model: str
    joints: tuple[str, ...]
    trajectories: int
    samples: int
    seconds: float
    servo: str = ""
    relative_torques: bool = False
    """Nothing tells how large torques are: all in N m or kg m^2 is known up to one factor a
    joint.
    """


@dataclass(frozen=True)
class Report:
    """``report.json``; the contract's keys first, what the page needs besides after them."""

    verdict: Verdict
    noise_floor_rad: float
    baseline: FittedModel
    findings: tuple[Misfit, ...]
    effects: tuple[NamedEffect, ...]
    ambiguous: tuple[tuple[str, ...], ...]
    """Sets of effects that the recording cannot tell apart; ``models`` has the models that they are
    from, whose members are not free to combine."""
    identified: FittedModel
    """The best of the good models: the named effects and the provisional ones."""
    held_out: HeldOut
    next_experiment: str
    """What to record next, in one sentence; empty if nothing is open."""
    seconds: float
    recording: AnalysedRecording
    format: str = FORMAT
    provisional: tuple[NamedEffect, ...] = ()
    """What the identified model holds besides the named effects."""
    hand: str | None = None
    hand_layer: str | None = None
    """Identified model that the analysis started from."""
    joints: tuple[JointGap, ...] = ()
    families: tuple[FamilyVerdict, ...] = ()
    models: tuple[WholeModel, ...] = ()
    """The models of each joint that are not worse than its best, the best first, at most five."""
    compared: tuple[WholeModel, ...] = ()
    """All models that were fitted."""
    not_tried: dict[str, dict[str, str]] = field(default_factory=dict)
    """Effects that no model has, with the reason, by joint."""
    aside: dict[str, str] = field(default_factory=dict)
    """File of the motion that no fit of a joint saw, by joint."""
    delivered: Delivered | None = None
    trajectories: tuple[TrajectoryError, ...] = ()
    closing: Closing | None = None
    warnings: tuple[str, ...] = ()
    """What a reader should know about the data or the fit, in plain sentences."""
    command: str = ""
    """Command that repeats the analysis."""
    software: dict[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Dictionary for JSON; numbers that are not finite become None."""
        return _each_number(to_dict(self), lambda x: x if x is None or math.isfinite(x) else None)

    def write(self, path: Path) -> None:
        """Write it as JSON, atomically."""
        write_json(path, self.to_dict())

    @staticmethod
    def read(path: Path) -> "Report":
        """Read what :meth:`write` wrote.

        Raises:
            ValueError: Not such a file; the message names it.
        """
        try:
            values = json.loads(Path(path).read_text())
            if values["format"] != FORMAT:
                raise ValueError(f"format is {values['format']!r}, not {FORMAT!r}")
            known = _each_number(values, lambda x: math.nan if x is None else x)
            for name in _OPTIONAL:
                if values.get(name) is None:
                    known[name] = None
            return from_dict(Report, known)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}: no report of this vd-gap ({error}); run it again") from error

    @property
    def open_sets(self) -> tuple[tuple[str, ...], ...]:
        """The sets in ``ambiguous`` that another recording can split, without what their names stand for."""
        sets: dict[frozenset[str], tuple[str, ...]] = {}
        for joint in self.joints:
            for group in joint.open_sets:
                sets[frozenset(group)] = group
        return tuple(sets.values())


@dataclass(frozen=True)
class Predictions:
    """Curves of the figures: S samples of all trajectories one after another, J recorded joints."""

    time: np.ndarray
    """Time from the start of the trajectory [s], shape [S]."""
    trajectory: np.ndarray
    """Index of the recording's trajectory, shape [S]."""
    command: np.ndarray
    """[rad], shape [S, J]."""
    measured: np.ndarray
    """[rad], shape [S, J]."""
    baseline: np.ndarray
    """Baseline's position [rad], shape [S, J]; NaN where a joint was not simulated."""
    identified: np.ndarray
    """Identified model's position [rad], shape [S, J]; NaN where a joint was not simulated."""
    joints: tuple[str, ...]
    files: tuple[str, ...]
    """Of each trajectory."""

    @staticmethod
    def of(recording: Recording, baseline: np.ndarray, identified: np.ndarray) -> "Predictions":
        """Both models beside all that was recorded."""
        files = []
        times = []
        trajectories = []
        commands = []
        positions = []
        for index, part in enumerate(recording.trajectories):
            files.append(part.file)
            times.append(part.time)
            trajectories.append(np.full(len(part.time), index))
            commands.append(part.command)
            positions.append(part.position)
        return Predictions(
            time=np.concatenate(times),
            trajectory=np.concatenate(trajectories),
            command=np.concatenate(commands),
            measured=np.concatenate(positions),
            baseline=baseline,
            identified=identified,
            joints=recording.joints,
            files=tuple(files),
        )

    def write(self, path: Path) -> None:
        """Write a compressed .npz, atomically."""
        with atomic_path(path) as temporary:
            np.savez_compressed(temporary, **vars(self))

    @staticmethod
    def read(path: Path) -> "Predictions":
        """Read what :meth:`write` wrote.

        Raises:
            ValueError: Not such a file.
        """
        try:
            with np.load(path) as data:
                arrays = {one.name: data[one.name] for one in fields(Predictions)}
        except (KeyError, OSError, ValueError) as error:
            raise ValueError(
                f"{path}: not curves of vd-gap ({error}); run vd-gap explain again"
            ) from error
        for key in ("joints", "files"):
            arrays[key] = tuple(arrays[key].tolist())
        return Predictions(**arrays)


def _each_number(value: Any, change: Callable[[float | None], float | None]) -> Any:
    """Nested dictionaries and lists with their numbers changed; None stands for one."""
    if isinstance(value, dict):
        result = {}
        for name, item in value.items():
            result[name] = _each_number(item, change)
        return result
    if isinstance(value, list):
        return [_each_number(item, change) for item in value]
    return change(value) if value is None or isinstance(value, float) else value
