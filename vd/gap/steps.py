"""The steps of ``vd-gap run``, each from files to files, skipped where they have run on the same input.

``DIR/run.json`` keeps the settings, so that a later step needs only ``DIR``, and a digest of what each step
was made from, so that an interrupted run goes on with the step it was in.
"""

import hashlib
import json
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vd.config import from_dict, to_dict
from vd.files import make_folder, write_json
from vd.gap.recording import BARE_MODELS, Recording, model_path, read_recording
from vd.gap.result import LAYER, Closing, Predictions, Report
from vd.versions import installed_versions

if TYPE_CHECKING:
    from vd.assets_usd.hand_model import HandModel

RUN = "run.json"
FIND, EXPLAIN, CLOSE, CLOSING_CURVES = "find.json", "explain.json", "close.json", "closing.npz"
CURVES = "predictions.npz"
OUTPUTS = {
    "find": (FIND,),
    "explain": (EXPLAIN, CURVES),
    "close": (LAYER, CLOSE, CLOSING_CURVES),
    "report": ("report.json", "report.html"),
}
"""What each step writes, in the order of the steps."""
_DOES = {
    "find": "fitting the plain servo model and looking for what it misses",
    "explain": "trying every effect on motions that the fit has not seen",
    "close": "writing the identified model and simulating the commands again",
    "report": "drawing the page",
}
METHOD = 13
"""Of the analysis; what another one made is made again."""
STEPS = tuple(OUTPUTS)
_PACKAGES = ("visual-dexterity", "warp-lang", "newton", "cma", "numpy")


@dataclass(frozen=True)
class Settings:
    """What an analysis depends on, besides the recording's own contents."""

    recording: Path
    """Folder of the recording, or its recording.json."""
    hand: str | None = None
    """Hand's name or USD file; None takes the recording's model."""
    hand_layer: Path | None = None
    """Identified model to start from."""
    effects: tuple[str, ...] = ()
    """Candidates; empty means all."""
    seed: int = 0
    device: str = "cpu"


class Analysis:
    """One analysis in its folder.

    Args:
        settings: What to analyse, and how.
        out: Folder of the analysis.
    """

    def __init__(self, settings: Settings, out: Path):
        self.settings, self.out = settings, Path(out)

    @staticmethod
    def open(out: Path, changes: Mapping[str, Any]) -> "Analysis":
        """An analysis of a recording, or the one that has begun in ``out`` where none is named.

        Args:
            out: Folder of the analysis.
            changes: Settings by name; None leaves one as it was, or at its default.

        Raises:
            ValueError: No recording is named, and none is known from before.
        """
        path = Path(out) / RUN
        changes = {name: value for name, value in changes.items() if value is not None}
        if path.is_file() and "recording" not in changes:
            try:
                settings = from_dict(Settings, json.loads(path.read_text())["settings"])
            except (ValueError, KeyError, TypeError) as error:
                raise ValueError(f"{path}: not of vd-gap ({error}); delete it and start again") from error
            return Analysis(replace(settings, **changes), out)
        if "recording" not in changes:
            raise ValueError(
                f"{out}: no analysis has begun here; name the recording: vd-gap run RECORDING --out {out}"
            )
        return Analysis(Settings(**changes), out)

    @cached_property
    def recording(self) -> Recording:
        """The recording, checked."""
        return read_recording(self.settings.recording)

    @cached_property
    def hand_name(self) -> str | None:
        """Name or file of the hand, None for a bare servo or pendulum.

        Raises:
            ValueError: A hand is named for a recording of a bare servo or pendulum.
        """
        model, named = self.recording.model, self.settings.hand
        if named is not None and model in BARE_MODELS:
            raise ValueError(
                f"{self.recording.path} is of a bare {model}, not of {named}: leave out --hand and --model, "
                "or name the hand as 'model' in recording.json"
            )
        if named is not None:
            return named
        if model in BARE_MODELS:
            return None
        return model_path(self.recording.path, model)

    @cached_property
    def hand(self) -> "HandModel | None":
        """The hand with the layer that the analysis starts from, None for a bare servo or pendulum."""
        if self.hand_name is None:
            return None
        from vd.assets_usd.hands import load_hand, root_name

        hand, model = load_hand(self.hand_name, layer=self.settings.hand_layer), self.recording.model
        model = root_name(model_path(self.recording.path, model))
        if model != hand.name:
            raise ValueError(
                f"{self.recording.path} is of {model}, not of {hand.name}; name the hand that was recorded"
            )
        return hand

    @cached_property
    def start(self) -> dict[str, np.ndarray]:
        """Parameter row of each excited joint from the layer that the analysis starts from; empty without."""
        if self.settings.hand_layer is None:
            return {}
        moved = {joint for trajectory in self.recording.trajectories for joint in trajectory.joints}
        joints = tuple(joint for joint in self.recording.joints if joint in moved)
        if self.hand is not None:
            names = self.hand.joint_names
            return {joint: self.hand.servo[names.index(joint)] for joint in joints if joint in names}
        from vd.assets_usd.hand_layer import read_bare_layer

        rows, _ = read_bare_layer(self.settings.hand_layer, joints)
        return dict(zip(joints, rows, strict=True))

    def run(self, last: str, *, first: str | None = None, fresh: bool = False) -> None:
        """Run steps up to ``last``; those that have run on the same input are skipped.

        Args:
            last: Name of the last step.
            first: First step; only what it needs may be there already. None is the very first.
            fresh: Repeat the steps even if nothing has changed.

        Raises:
            RecordingError: The recording cannot be used.
            ValueError: A setting cannot be used, or what an earlier step writes is missing.
        """
        begin = STEPS.index(first or STEPS[0])
        for name in STEPS[begin : STEPS.index(last) + 1]:
            self._step(name, fresh=fresh)

    def _step(self, name: str, *, fresh: bool) -> None:
        before = STEPS[STEPS.index(name) - 1] if name != STEPS[0] else None
        for needed in OUTPUTS.get(before or "", ()):
            self._need(needed, str(before))
        made_from = self._digest(name)
        record = self._record()
        done = record["steps"].get(name, {})
        files = [self.out / file for file in OUTPUTS[name]]
        if not fresh and done.get("made_from") == made_from and all(file.is_file() for file in files):
            print(f"{name}: nothing has changed, kept", file=sys.stderr)
            return
        for file in files:  # a step that is interrupted must not look finished
            file.unlink(missing_ok=True)
        make_folder(self.out)
        record["settings"] = to_dict(self.settings)
        write_json(self.out / RUN, record)
        print(f"{name}: {_DOES[name]}", file=sys.stderr)
        began = time.perf_counter()
        _RUN[name](self)
        record["steps"][name] = {"made_from": made_from, "seconds": time.perf_counter() - began}
        write_json(self.out / RUN, record)

    def _need(self, file: str, step: str) -> Path:
        """A file that a step writes.

        Raises:
            ValueError: It has not run.
        """
        if not (self.out / file).is_file():
            raise ValueError(f"{self.out / file} is missing; run vd-gap {step} --out {self.out} first")
        return self.out / file

    def _record(self) -> dict[str, Any]:
        path = self.out / RUN
        if path.is_file():
            try:
                record = json.loads(path.read_text())
                return {"settings": record["settings"], "steps": dict(record["steps"])}
            except (ValueError, KeyError, TypeError):
                pass  # written by something else, or by hand: start afresh
        return {"settings": {}, "steps": {}}

    def _digest(self, name: str) -> str:
        """Of everything a step is made from."""
        digest = hashlib.sha256(f"{name} {METHOD}".encode())
        digest.update(json.dumps(to_dict(replace(self.settings, recording=Path()))).encode())
        recording = self.recording
        digest.update((recording.path / "recording.json").read_bytes())
        for trajectory in recording.trajectories:
            digest.update((recording.path / trajectory.file).read_bytes())
        for model in (self.hand_name, self.settings.hand_layer):  # the files, where they are some
            if model is not None and Path(model).is_file():
                digest.update(Path(model).read_bytes())
        if name != STEPS[0]:
            for file in OUTPUTS[STEPS[STEPS.index(name) - 1]]:
                digest.update((self.out / file).read_bytes())
        return digest.hexdigest()

    def options(self) -> dict[str, Any]:
        """Keyword arguments of the steps of :mod:`vd.gap.workflow`."""
        settings = self.settings
        options: dict[str, Any] = {"seed": settings.seed, "device": settings.device, "progress": _show}
        if settings.effects:
            options["effects"] = settings.effects
        if self.start:
            options["start"] = self.start
        return options

    def explained(self) -> Report:
        """What ``explain`` wrote.

        Raises:
            ValueError: It has not run.
        """
        return Report.read(self._need(EXPLAIN, "explain"))

    def command(self) -> str:
        """The command that repeats the analysis."""
        settings = self.settings
        words = ["vd-gap run", str(settings.recording), "--out", str(self.out)]
        for flag, value in (("--hand", settings.hand), ("--hand-layer", settings.hand_layer)):
            words += [flag, str(value)] if value is not None else []
        words += ["--effects", ",".join(settings.effects)] if settings.effects else []
        words += ["--seed", str(settings.seed)] if settings.seed else []
        words += ["--device", settings.device] if settings.device != "cpu" else []
        return " ".join(words)


def _show(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _find(analysis: Analysis) -> None:
    from vd.gap import workflow

    workflow.find(analysis.recording, analysis.hand, analysis.out, **analysis.options())


def _explain(analysis: Analysis) -> None:
    from vd.gap import workflow

    workflow.explain(analysis.recording, analysis.hand, analysis.out, **analysis.options())


def _close(analysis: Analysis) -> None:
    from vd.gap.close import WHOLE_HAND_LAYER, one_finger, simulate_again, write_identified
    from vd.gap.plan import discard_plan, plan, write_plan

    report, layer = analysis.explained(), analysis.out / LAYER
    whole = layer.with_name(WHOLE_HAND_LAYER)
    whole.unlink(missing_ok=True)
    write_identified(report, layer, analysis.recording, analysis.hand, analysis.start)
    partly = one_finger(analysis.recording, analysis.hand)
    if partly:
        write_identified(report, whole, analysis.recording, analysis.hand, analysis.start, every_finger=True)
    closing, curves = simulate_again(
        report,
        layer,
        analysis.recording,
        analysis.hand_name,
        analysis.settings.hand_layer,
        Predictions.read(analysis.out / CURVES),
        device=analysis.settings.device,
    )
    closing = replace(closing, whole_hand_layer=whole.name if partly else "")
    curves.write(analysis.out / CLOSING_CURVES)
    discard_plan(analysis.out)
    if report.verdict == "under_excited" or report.open_sets:
        _show("close: looking for the motions that would decide")
        device = analysis.settings.device
        chosen = plan(report, analysis.recording, analysis.hand, analysis.start, device=device)
        write_plan(chosen, analysis.out)
    write_json(analysis.out / CLOSE, to_dict(closing))


def _report(analysis: Analysis) -> None:
    from vd.gap.plan import PLAN_JSON
    from vd.gap.recording_checks import cautions
    from vd.gap.report import write_report

    closing = from_dict(Closing, json.loads((analysis.out / CLOSE).read_text()))
    steps = analysis._record()["steps"]
    report = analysis.explained()
    planned = analysis.out / PLAN_JSON
    report = replace(
        report,
        closing=closing,
        next_experiment=(
            json.loads(planned.read_text())["sentence"] if planned.is_file() else report.next_experiment
        ),
        seconds=sum(step["seconds"] for step in steps.values()),
        hand=analysis.hand_name,
        hand_layer=None if analysis.settings.hand_layer is None else str(analysis.settings.hand_layer),
        warnings=cautions(analysis.recording),
        command=analysis.command(),
        software=installed_versions(_PACKAGES),
    )
    write_report(report, Predictions.read(analysis.out / CLOSING_CURVES), analysis.out)


_RUN: dict[str, Callable[[Analysis], None]] = {
    "find": _find,
    "explain": _explain,
    "close": _close,
    "report": _report,
}
