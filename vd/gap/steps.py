"""The steps of ``vd-gap run``, each from files to files, skipped where they have run on the same input.

``DIR/run.json`` keeps a digest of recording, model and settings, and which steps have run on them,
so that an interrupted run goes on with the step it was in.
"""

import hashlib
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vd.command.config import to_dict
from vd.command.files import make_folder, write_json
from vd.command.versions import installed_versions
from vd.gap.result import LAYER, Predictions, Report
from vd.kernels.servo.effects import EFFECTS
from vd.logs.recording import BARE_MODELS, Recording, model_path, read_recording

if TYPE_CHECKING:
    from vd.assets_usd.hand_model import HandModel

RUN = "run.json"
FIND = "find.json"
EXPLAIN = "explain.json"
CLOSE = "close.json"
CLOSING_CURVES = "closing.npz"
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
    "explain": "comparing whole models on motions that their fits have not seen",
    "close": "writing the identified model and simulating the commands again",
    "report": "drawing the page",
}
METHOD = 21
"""Version of the analysis; what another one made is made again."""
NO_EFFECTS = "none"
"""In place of candidates: identify the drives alone."""
STEPS = tuple(OUTPUTS)
_PACKAGES = ("visual-dexterity", "warp-lang", "newton", "scipy", "numpy")


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
    """Candidates, or :data:`NO_EFFECTS`; empty means all."""
    seed: int = 0
    device: str = "cpu"

    def __post_init__(self) -> None:
        known = (*EFFECTS, NO_EFFECTS)
        for name in self.effects:
            if name not in known:
                raise ValueError(f"effects: there is no {name}; choose from {', '.join(known)}")


class Analysis:
    """One analysis in its folder.

    Args:
        settings: What to analyse, and how.
        out: Folder of the analysis.
    """

    def __init__(self, settings: Settings, out: Path):
        self.settings = settings
        self.out = Path(out)

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
        recording = self.recording
        named = self.settings.hand
        if recording.model not in BARE_MODELS:
            return named or model_path(recording.path, recording.model)
        if named is not None:
            raise ValueError(
                f"{recording.path} is of a bare {recording.model}, not of {named}: leave out "
                "--hand, or name the hand as 'model' in recording.json"
            )
        return None

    @cached_property
    def hand(self) -> "HandModel | None":
        """The hand with the layer that the analysis starts from, None for a bare servo or pendulum."""
        if self.hand_name is None:
            return None
        from vd.assets_usd.hands import load_hand, root_name

        hand = load_hand(self.hand_name, layer=self.settings.hand_layer)
        model = self.recording.model
        model = root_name(model_path(self.recording.path, model))
        if model != hand.name:
            raise ValueError(
                f"{self.recording.path} is of {model}, not of {hand.name}; name the hand that was "
                f"recorded"
            )
        return hand

    @cached_property
    def start(self) -> dict[str, np.ndarray]:
        """Parameter row of each excited joint from the layer that the analysis starts from.

        Empty without.
        """
        if self.settings.hand_layer is None:
            return {}
        moved: set[str] = set()
        for trajectory in self.recording.trajectories:
            moved.update(trajectory.joints)
        joints = [joint for joint in self.recording.joints if joint in moved]
        if self.hand is not None:
            rows = dict(zip(self.hand.joint_names, self.hand.servo, strict=True))
            return {joint: rows[joint] for joint in joints if joint in rows}
        from vd.assets_usd.hand_layer import read_bare_layer

        found, _ = read_bare_layer(self.settings.hand_layer, joints)
        return dict(zip(joints, found, strict=True))

    def run(self, last: str, *, first: str = STEPS[0], fresh: bool = False) -> None:
        """Run steps up to ``last``; those that have run on the same input are skipped.

        Args:
            last: Name of the last step.
            first: First step; only what it needs may be there already.
            fresh: Repeat the steps even if nothing has changed.

        Raises:
            RecordingError: The recording cannot be used.
            ValueError: A setting cannot be used, or a step before ``first`` has not run.
        """
        for index in range(STEPS.index(first), STEPS.index(last) + 1):
            name = STEPS[index]
            done = self._done(STEPS[:index])
            if name in self._seconds() and not fresh:
                print(f"{name}: nothing has changed, kept", file=sys.stderr)
                continue
            # What was found before is not what an interrupted step finds.
            for file in OUTPUTS[name]:
                (self.out / file).unlink(missing_ok=True)
            self._note(done)
            print(f"{name}: {_DOES[name]}", file=sys.stderr)
            began = time.perf_counter()
            _RUN[name](self)
            self._note({**done, name: time.perf_counter() - began})

    def _done(self, steps: Sequence[str]) -> dict[str, float]:
        """Seconds that steps have taken.

        Raises:
            ValueError: One of them has not run on this input.
        """
        seconds = self._seconds()
        result = {}
        for name in steps:
            if name not in seconds:
                again = f"vd-gap {name} {self.settings.recording} --out {self.out}"
                raise ValueError(f"{self.out} lacks what comes before; run {again} first")
            result[name] = seconds[name]
        return result

    def _seconds(self) -> dict[str, float]:
        """Seconds of every step that has run on this input, and whose files are there."""
        try:
            record = json.loads((self.out / RUN).read_text())
            if record["made_from"] != self._made_from:
                return {}
            there = {path.name for path in self.out.iterdir()}
            ran = record["steps"].items()
            return {name: seconds for name, seconds in ran if there.issuperset(OUTPUTS[name])}
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return {}  # none, or written by something else: start afresh

    def _note(self, steps: Mapping[str, float]) -> None:
        make_folder(self.out)
        write_json(self.out / RUN, {"made_from": self._made_from, "steps": steps})

    @cached_property
    def _made_from(self) -> str:
        """Digest of everything that the steps are made from."""
        settings = to_dict(replace(self.settings, recording=Path(), hand=self.hand_name))
        digest = hashlib.sha256(json.dumps([METHOD, settings]).encode())
        recording = self.recording
        digest.update((recording.path / "recording.json").read_bytes())
        for trajectory in recording.trajectories:
            digest.update((recording.path / trajectory.file).read_bytes())
        for model in (self.hand_name, self.settings.hand_layer):
            if model is not None and Path(model).is_file():
                digest.update(Path(model).read_bytes())
        return digest.hexdigest()

    def explained(self) -> Report:
        """What ``explain`` wrote."""
        return Report.read(self.out / EXPLAIN)

    def command(self) -> str:
        """The command that repeats the analysis."""
        settings = self.settings
        device = settings.device if settings.device != "cpu" else ""
        flags = {
            "--hand": settings.hand,
            "--hand-layer": settings.hand_layer,
            "--effects": ",".join(settings.effects),
            "--seed": settings.seed,
            "--device": device,
        }
        said = f"vd-gap run {settings.recording} --out {self.out}"
        for flag, value in flags.items():
            if value:
                said += f" {flag} {value}"
        return said


def _show(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _options(analysis: Analysis) -> dict[str, Any]:
    """Fields of :class:`vd.gap.workflow.Options`."""
    settings = analysis.settings
    return {
        "effects": tuple(name for name in settings.effects or EFFECTS if name != NO_EFFECTS),
        "seed": settings.seed,
        "device": settings.device,
        "start": analysis.start,
        "progress": _show,
    }


def _find(analysis: Analysis) -> None:
    from vd.gap import workflow

    workflow.find(analysis.recording, analysis.hand, analysis.out, **_options(analysis))


def _explain(analysis: Analysis) -> None:
    from vd.gap import workflow

    workflow.explain(analysis.recording, analysis.hand, analysis.out, **_options(analysis))


def _close(analysis: Analysis) -> None:
    from vd.gap.close import simulate_again, write_identified
    from vd.gap.plan import discard_plan, plan, tied, write_plan

    report = analysis.explained()
    recording = analysis.recording
    hand = analysis.hand
    whole = write_identified(report, analysis.out, recording, hand, analysis.start)
    closing, delivered, curves = simulate_again(
        report,
        analysis.out / LAYER,
        recording,
        analysis.hand_name,
        analysis.settings.hand_layer,
        Predictions.read(analysis.out / CURVES),
        device=analysis.settings.device,
    )
    curves.write(analysis.out / CLOSING_CURVES)
    discard_plan(analysis.out)
    sentence = ""
    if report.verdict in ("under_excited", "unknown") or tied(report):
        experiment = plan(report, recording, hand)
        write_plan(experiment, analysis.out)
        sentence = experiment.sentence
    closed = replace(
        report,
        closing=replace(closing, whole_hand_layer=whole),
        delivered=delivered,
        next_experiment=sentence,
    )
    closed.write(analysis.out / CLOSE)


def _report(analysis: Analysis) -> None:
    from vd.gap.report import write_report
    from vd.logs.recording_checks import cautions

    layer = analysis.settings.hand_layer
    report = replace(
        Report.read(analysis.out / CLOSE),
        seconds=sum(analysis._seconds().values()),
        hand=analysis.hand_name,
        hand_layer=None if layer is None else str(layer),
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
