"""``python -m vd.train.demo`` (``make demo``): what the project is for, on the machine at hand.

A script over the public commands, in four parts: an installed policy turns objects that it has
never seen, by camera; an effect that is hidden in a servo is found and closed; a hand runs behind
the protocol of its motors; a small training learns. ``index.html`` is written anew whenever a part
begins or ends. A part that fails says so there, and the others go on.
"""

import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from vd import interrupt
from vd.command_line import parse
from vd.config import require
from vd.evaluate.agents import check_names
from vd.files import check_folder
from vd.paper import PAPER

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CAMERA_POLICY = "dclaw4-tracking"
"""Installed policy that finds the object by camera."""
UNSEEN, UNSEEN_ONE = "procedural-heldout-4-seed0", "procedural-heldout-1-seed0"
"""Built-in objects of kinds that no policy was trained on: those of the first part, and that of the
twin.
"""
MESHES, IMPORT_S, IMPORT_SEARCH = 4, 40.0, 5
"""Of the user's meshes so many, the smallest, are imported in so much time [s], with a quarter of
the usual
search effort: a stapler then takes 8 s of CPU time in place of 29, and its parts are as good."""
EPISODES = 3
"""Starts and goals of every object: what two cores simulate in half a minute."""
FILM_S = 8.0
"""Length of the films [s]."""
HIDDEN = "backlash:width_rad=0.06"
"""Effect that is hidden in a single servo: a quarter of a finger's time."""
MISSES = "12"
"""Deadlines missed in a row at which the twin stops: a second, since the machine may do other
things too.
"""
LEAST_TRAINING_MIN, AROUND_TRAINING_MIN = 1.0, 1.5
"""Time that training gets at least [min], and that its start with cold caches, curve and film
take.
"""
REFRESH_S = 15
"""Seconds after which a browser reads an unfinished page again."""
REASON_LINES = 4
"""Last lines of a command's output that tell why it failed."""


@dataclass
class DemoCfg:
    """Show what the project is for, on the machine at hand.

    One page, written as its parts finish.
    """

    out: Path = Path("demo")
    """Folder to write; the page is index.html. What an earlier demo left there is replaced."""
    meshes: Path | None = None
    """Folder of OBJ, STL, PLY, GLB or USD files: the smallest are turned in place of built-in
    objects.
    """
    quick: tyro.conf.FlagCreatePairsOff[bool] = False
    """End after the first part."""
    minutes: float = 8.0
    """Time for everything [min], of which training gets what the other parts leave, and a minute at
    least.
    """
    seed: int = 0
    """Of starts, goals, the hidden machine and the training."""


@dataclass
class Part:
    """One part under way: its commands, and what the page says of it."""

    name: str
    title: str
    folder: Path
    state: str = "waiting"
    """waiting, running, done, failed or interrupted."""
    seconds: float = 0.0
    error: str = ""
    commands: list[str] = field(default_factory=list)
    shown: dict[str, Any] = field(default_factory=dict)
    """What the template takes, once it is done."""

    def run(self, *commands: Sequence[str | Path], seconds: float | None = None) -> None:
        """Run public commands side by side, the output of each in a file of the part's folder.

        Args:
            commands: Their words, the name first.
            seconds: Time after which they are ended. Whoever says so looks for what they left, and
                no exit status is a failure.

        Raises:
            RuntimeError: One failed; the others are ended.
        """
        running, until = [], None if seconds is None else time.monotonic() + seconds
        try:
            for words in commands:
                line = [str(word) for word in words]
                self.commands.append(" ".join(line))
                print(f"  $ {' '.join(line)}", flush=True)
                log = self.folder / f"{len(self.commands)}-{line[0]}.txt"
                with log.open("w") as output:
                    process = subprocess.Popen(
                        [Path(sys.executable).with_name(line[0]), *line[1:]],
                        stdin=subprocess.DEVNULL,
                        stdout=output,
                        stderr=subprocess.STDOUT,
                        start_new_session=True,  # Ctrl-C reaches this process alone, which then ends them
                    )
                running.append((process, line, log))
            for process, line, log in running:
                try:
                    status = process.wait(
                        None if until is None else max(until - time.monotonic(), 0.0)
                    )
                except subprocess.TimeoutExpired:
                    continue
                if status != 0 and seconds is None:
                    reason = "\n".join(
                        log.read_text(errors="replace").split("\n")[-REASON_LINES - 1 :]
                    )
                    raise RuntimeError(
                        f"{' '.join(line)} ended with status {status}: {reason.strip()}"
                    )
        finally:
            for process, _, _ in running:
                process.terminate()  # nothing to one that has ended; another saves first
                process.wait()


class Demo:
    """The parts, in their order; each is a method of its name."""

    def __init__(self, cfg: DemoCfg) -> None:
        self.cfg, self.page, self.started = cfg, cfg.out / "index.html", time.monotonic()
        titles = {
            "camera": "Objects never seen, turned by camera",
            "gap": "A hidden effect, found and closed",
            "twin": "A hand behind its motors",
            "training": "A small training",
        }
        parts = [Part(name, title, cfg.out / name) for name, title in titles.items()]
        self.parts = parts[:1] if cfg.quick else parts
        self.objects: tuple[str, str] = (UNSEEN, UNSEEN_ONE)
        """Set of the first part, and the object of the twin."""

    @property
    def minutes(self) -> float:
        """Time so far [min]."""
        return (time.monotonic() - self.started) / 60.0

    def run(self) -> None:
        """All parts.

        Raises:
            KeyboardInterrupt: Interrupted; the page says so and has what is there.
        """
        for number, part in enumerate(self.parts, start=1):
            began, part.state = time.monotonic(), "running"
            print(f"\n[{number}/{len(self.parts)}] {part.title}", flush=True)
            shutil.rmtree(part.folder, ignore_errors=True)
            part.folder.mkdir(parents=True)
            self.write(running=True)
            try:
                part.shown = getattr(self, part.name)(part)
                part.state = "done"
            except KeyboardInterrupt:
                part.state = "interrupted"
                self.write(running=False)
                raise
            except Exception as error:  # whatever it is, the other parts go on
                part.state, part.error = "failed", str(error) or type(error).__name__
                print(f"  failed: {part.error}", file=sys.stderr, flush=True)
            part.seconds = time.monotonic() - began
            self.write(running=part is not self.parts[-1])

    def write(self, *, running: bool) -> None:
        """Write the page; one of a demo that is ``running`` is read again by the browser."""
        from vd.page import write_html

        refresh = REFRESH_S if running else None
        write_html(self.page, "demo.html", parts=self.parts, refresh=refresh, minutes=self.minutes)

    def camera(self, part: Part) -> dict[str, Any]:
        """The shipped policy turns objects that it has never seen, by camera: film, and success."""
        film, out = part.folder / "film.mp4", part.folder
        if self.cfg.meshes is not None:
            self.objects = import_meshes(part, self.cfg.meshes)
        options = (CAMERA_POLICY, "--objects", self.objects[0], "--seed", str(self.cfg.seed))
        part.run(
            ["vd-eval", *options, "--episodes", str(EPISODES), "--out", out],
            ["vd-play", *options, "--cells", "4", "--seconds", str(FILM_S), "--video", film],
        )
        from vd.evaluate.page import percent
        from vd.evaluate.result import Result

        row = next(row for row in Result.read(out / "eval.json").rows if row.headline)
        tolerance = str(PAPER.success.rotation_rad)
        lines = [
            (
                one.name,
                one.episodes,
                percent(one.success[tolerance]),
                percent(one.outcomes["object falls"]),
            )
            for one in (*row.per_object, row.overall)
        ]
        shown = {"policy": CAMERA_POLICY, "meshes": self.cfg.meshes, "film": film, "rows": lines}
        return shown | {"tolerance_rad": tolerance, "page": f"{part.name}/eval.html"}

    def gap(self, part: Part) -> dict[str, Any]:
        """An effect hidden in a simulated servo, found and closed."""
        recording, analysis = part.folder / "recording", part.folder / "analysis"
        seed = ("--seed", str(self.cfg.seed))
        part.run(["vd-gap", "hide", "servo", "--effect", HIDDEN, "--out", recording, *seed])
        part.run(["vd-gap", "run", recording, "--out", analysis, *seed])
        from vd.api import gap_verdict

        verdict = gap_verdict(analysis / "report.json")
        pictures = sorted(analysis.glob("overlay_*.png"), key=lambda path: path.stat().st_mtime)
        page = f"{part.name}/analysis/report.html"
        return {"hidden": HIDDEN, "verdict": verdict, "picture": pictures[0], "page": page}

    def twin(self, part: Part) -> dict[str, Any]:
        """A simulated hand behind the protocol of its motors, with the policy that sees."""
        log = part.folder / "log"
        words = [
            "vd-deploy",
            CAMERA_POLICY,
            "--hand",
            "dclaw4",
            "--twin",
            "--object",
            self.objects[1],
        ]
        words += ["--random-goals", "2", "--seed", str(self.cfg.seed), "--safety.misses", MISSES]
        part.run([*words, "--log", log])
        from vd.hand_log import read_log

        run = read_log(log)
        sent, stops = (
            sorted(1e3 * run.columns["sent_s"]),
            ", ".join(stop.outcome for stop in run.stops),
        )
        late = f"{sent[len(sent) // 2]:.0f}, at most {sent[-1]:.0f}"
        row = (len(sent), f"{run.columns['missed'][-1]:.0f}", late, stops)
        film, name = log / "run.mp4", run.run["object"]["name"]
        return {"film": film, "row": row, "object": name, "page": f"{part.name}/log/run.html"}

    def training(self, part: Part) -> dict[str, Any]:
        """A small training, with its curve."""
        run, film = part.folder / "run", part.folder / "film.mp4"
        minutes = max(self.cfg.minutes - self.minutes - AROUND_TRAINING_MIN, LEAST_TRAINING_MIN)
        seed = ("--seed", str(self.cfg.seed))
        words = (
            "vd-train",
            "teacher",
            "--preset",
            "cpu-demo",
            *seed,
            "--max-minutes",
            f"{minutes:.2f}",
        )
        part.run([*words, "--out", run])
        part.run(["vd-play", run, "--cells", "4", "--seconds", str(FILM_S), *seed, "--video", film])
        from vd.train.metrics import PROGRESS_FILE, read_progress

        rows = [
            row
            for row in read_progress(run / PROGRESS_FILE)
            if row["goals_per_episode"] is not None
        ]
        goals = [row["goals_per_episode"] for row in rows]
        curves = goal_curve([row["env_steps"] for row in rows], goals)
        shown = {"film": film, "curves": curves, "low": min(goals), "last": goals[-1]}
        return shown | {"steps": rows[-1]["env_steps"]}


def goal_curve(steps: Sequence[int], goals: Sequence[float]) -> "Figure":
    """Goals an episode against control steps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3), layout="constrained")
    axis = figure.add_subplot(xlabel="control steps", ylabel="goals an episode")
    axis.plot(steps, goals)
    axis.grid(alpha=0.3)
    return figure


def import_meshes(part: Part, meshes: Path) -> tuple[str, str]:
    """Import the smallest meshes for a while.

    Returns:
        The set, and one of its objects.

    Raises:
        RuntimeError: None was imported.
    """
    from vd.assets_usd.objects.model import object_files
    from vd.assets_usd.objects.plan import find_meshes

    chosen = sorted(find_meshes([meshes]), key=lambda path: (path.stat().st_size, path))[:MESHES]
    out = part.folder / "objects"
    options = ("--out", out, "--mcts-iterations", str(IMPORT_SEARCH))
    part.run(["vd-assets", "import", *chosen, *options], seconds=IMPORT_S)
    found = object_files(out) if out.is_dir() else []
    if not found:
        names = ", ".join(path.name for path in chosen)
        raise RuntimeError(
            f"none of {names} was imported within {IMPORT_S:.0f} s; the files in {part.folder} say "
            f"why. "
            f"By hand, without haste: vd-assets import {meshes}"
        )
    return str(out), str(found[0])


@interrupt.command("demo")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; returns the exit status: 1 if a part failed."""
    cfg: DemoCfg = parse(DemoCfg, arguments, prog="python -m vd.train.demo")
    require(cfg, "--", "positive", "minutes")
    check_names([CAMERA_POLICY], [])
    check_folder(cfg.out)
    if cfg.out.is_dir() and any(cfg.out.iterdir()) and not (cfg.out / "index.html").is_file():
        raise ValueError(f"--out {cfg.out} has other files than a demo's; name a new folder")
    if cfg.meshes is not None:
        from vd.assets_usd.objects.plan import find_meshes

        find_meshes([cfg.meshes])  # refuses a folder without any
    demo = Demo(cfg)
    demo.run()
    print(f"\n{demo.page} is ready after {demo.minutes:.1f} min; open it in a browser")
    failed = [part.title for part in demo.parts if part.state == "failed"]
    if failed:
        print(f"demo: failed: {', '.join(failed)}", file=sys.stderr)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
