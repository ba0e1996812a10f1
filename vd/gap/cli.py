"""vd-gap: where simulation and measurement disagree, which effect is missing, and how much it closes."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from vd.command import interrupt
from vd.command.device import warp_device
from vd.command.files import check_folder
from vd.command.line import flags_of, parse, say_same_as
from vd.command.warp_quiet import quiet_warp
from vd.gap.contact_cli import Contact
from vd.gap.convert import Convert

if TYPE_CHECKING:
    from vd.gap.steps import Analysis


@dataclass(frozen=True)
class _Step:
    """What all steps take; the same words for every step of an analysis."""

    first: ClassVar[str] = "find"
    last: ClassVar[str] = "report"

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """Folder with recording.json and its CSV files."""
    out: Path = Path("gap")
    """DIR: folder of the analysis."""
    hand: Annotated[str | None, tyro.conf.arg(aliases=("--model",))] = None
    """Hand, dclaw3 or dclaw4, or its USD file; by default the recording's model."""
    hand_layer: Path | None = None
    """Start from an identified model (identified.usda): is there a gap left?"""
    effects: str = ""
    """Candidates, separated by commas; all effects by default, none: the plain drives alone."""
    seed: int = 0
    """Seed of the search and of the resampling."""
    device: str = "cpu"
    """cpu, cuda, or auto."""
    fresh: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Repeat finished steps even if nothing has changed."""

    def analysis(self) -> "Analysis":
        """The analysis in DIR with these settings.

        A recording is checked before anything slow begins.
        """
        from vd.logs.recording import read_recording

        recording = read_recording(self.recording)
        from vd.gap.steps import Analysis, Settings

        quiet_warp()
        effects = tuple(filter(None, map(str.strip, self.effects.split(","))))
        settings = Settings(self.recording, self.hand, self.hand_layer, effects, self.seed)
        analysis = Analysis(replace(settings, device=warp_device(self.device)), self.out)
        analysis.recording = recording
        return analysis

    def run(self) -> int:
        """Run the steps, and print the verdict or the file that the last one wrote."""
        analysis = self.analysis()
        if self.hand is None:
            step = self.first if self.first == self.last else "run"
            full = replace(self, hand=analysis.hand_name)
            say_same_as("vd-gap", step, self.recording, *flags_of(full, "recording"))
        analysis.run(self.last, first=self.first, fresh=self.fresh or self.first == "report")
        if self.last == "report":
            _print_report(analysis)
        else:
            print(analysis.out / f"{self.last}.json")
        return 0


class RunCommand(_Step):
    """Find, explain, close and report: the whole analysis of a recording.

    Writes DIR/report.html (one page for people), report.json, identified.usda (the identified
    model, for --hand-layer) and the figures. An interrupted run goes on with its step. The exit
    status is 0 for every verdict and 2 for a recording that cannot be used.
    """


class FindCommand(_Step):
    """Fit the plain servo model of every joint, and say where and in what motion it fails."""

    first = last = "find"


class ExplainCommand(_Step):
    """Compare whole models on motions that their fits have not seen; name what is missing, or abstain."""

    first = last = "explain"


class CloseCommand(_Step):
    """Write identified.usda and simulate the recorded commands again with it, a hand in Newton."""

    first = last = "close"


class ReportCommand(_Step):
    """Write report.json, report.html and the figures from what the steps before have found."""

    first = last = "report"


@dataclass(frozen=True)
class PlanCommand(_Step):
    """Propose the motions that tell the causes which are still tied, as files vd-deploy record can play.

    Each family of causes has its motions. Writes DIR/next_experiment.json and the commands as CSV
    files.
    """

    def run(self) -> int:
        """Explain first if that has not been done, then plan."""
        from vd.gap.plan import plan, write_plan

        analysis = self.analysis()
        analysis.run("explain", fresh=self.fresh)
        result = plan(analysis.explained(), analysis.recording, analysis.hand)
        print(f"{result.sentence}\n{write_plan(result, self.out)}")
        return 0


@dataclass(frozen=True)
class HideCommand:
    """Make a recording in which effects are hidden, to see whether they are found.

    The plant shares no code with the fitted model: it is integrated on its own at a high rate, with
    random base parameters, encoder counts, noise and jittered time stamps. The truth is written
    beside the folder.
    """

    model: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """dclaw3, dclaw4 (one finger of it), servo or pendulum."""
    out: Path
    """Folder of the recording to write."""
    effect: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME or NAME:PARAMETER=VALUE,...; give it again for a second effect, or leave it out to hide
    nothing."""
    excitations: tuple[str, ...] = ("steps_and_sines",)
    """Sets of motions."""
    seed: int = 0
    """Seed of everything random."""

    def run(self) -> int:
        """Write the recording."""
        from vd.gap.bench.hide import Hiding, check_hidden, hide, parse_effect, truth_path

        check_hidden(self.out)
        effects = dict(map(parse_effect, self.effect))
        hiding = Hiding(self.model, effects, self.seed, excitations=self.excitations)
        count = len(hide(hiding, self.out).recording.trajectories)
        print(f"{self.out}: {count} motions\n{truth_path(self.out)}")
        return 0


@dataclass(frozen=True)
class Export:
    """Write an identified model as MJCF and as actuators of mjlab and Isaac Lab.

    With the layer of a bare servo and --hand, the servo is put into every joint of the hand instead.
    """

    layer: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LAYER")]
    """The identified.usda that vd-gap run wrote."""
    out: Path
    """Folder to write to."""
    hand: str | None = None
    """The hand into which a bare servo is to go, or USD file of the hand that the layer is over."""
    step: float = 0.005
    """Physics step of mjlab or Isaac Lab, of which their delays are multiples [s]."""

    def run(self) -> int:
        """Write the files."""
        from vd.gap.export import export

        export(self.layer, self.out, self.hand, self.step)
        return 0


Command = (
    Annotated[RunCommand, tyro.conf.subcommand("run")]
    | Annotated[FindCommand, tyro.conf.subcommand("find")]
    | Annotated[ExplainCommand, tyro.conf.subcommand("explain")]
    | Annotated[CloseCommand, tyro.conf.subcommand("close")]
    | Annotated[ReportCommand, tyro.conf.subcommand("report")]
    | Annotated[PlanCommand, tyro.conf.subcommand("plan")]
    | Annotated[HideCommand, tyro.conf.subcommand("hide")]
    | Annotated[Convert, tyro.conf.subcommand("convert")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Contact, tyro.conf.subcommand("contact")]
)


@interrupt.command("vd-gap")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``vd-gap``; returns the exit status."""
    command: _Step | HideCommand | Convert | Export | Contact = parse(
        Command, arguments, prog="vd-gap", description=__doc__
    )
    from vd.logs.recording import RecordingError

    try:
        check_folder(command.out)
        return command.run()
    except RecordingError as error:
        print(f"vd-gap: this recording cannot be used: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        again = "goes on with the step it was in" if isinstance(command, _Step) else "begins anew"
        print(f"vd-gap: stopped; the same command {again}", file=sys.stderr)
        return interrupt.INTERRUPTED


def _print_report(analysis: "Analysis") -> None:
    from vd.gap.result import Report
    from vd.gap.words import families_sentences, next_step, open_questions, verdict_sentence

    path = analysis.out / "report.json"
    report = Report.read(path)
    print(verdict_sentence(report))
    for finding in report.findings:
        print(f"  {finding.where}")
    for line in families_sentences(report):
        print(f"  {line}")
    print(next_step(report))
    for line in open_questions(report):
        print(f"  open: {line}")
    for line in report.warnings:
        print(f"  note: {line}")
    print(f"\n{analysis.out / 'report.html'}\n{path}")


if __name__ == "__main__":
    sys.exit(main())
