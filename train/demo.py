"""``python -m vd.train.demo`` (``make demo``): what the project is for, on the machine at hand.

A script over the public commands, in four parts: an installed policy turns objects that it has
never seen, by camera; an effect that is hidden in a servo is found and closed; a hand runs behind
the protocol of its motors; a small training learns. ``index.html`` is written anew whenever a part
begins or ends. A part that fails says so there, and the others go on.
"""

import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from vd.command import interrupt
from vd.command.config import require
from vd.command.files import check_folder
from vd.command.line import parse
from vd.paper import PAPER
from vd.policy.agents import default_policy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HAND = "dclaw4"
"""The hand whose installed policy that sees by camera is shown."""
HELD_OUT = "procedural-heldout-{}-seed0"
"""Built-in objects of kinds that no policy was trained on, so many."""
SHOWN = 4
"""Objects of the first part; of a user's meshes so many are imported, built-in ones fill up."""
LOOKED_AT = 40
"""Of a user's meshes so many, the smallest files, are looked at."""
COMPACT = 3.0
"""Longest over shortest side, at most, of a mesh that is chosen; of half of our procedural objects
it is less (their median is 2.9), of flat and long things, of which policies drop most, more."""
IMPORT = ("--time-limit", "20", "--mcts-iterations", "5")
"""Processor time of each decomposition [s], and a quarter of the usual search effort: a stapler
then takes 8 s in place of 29, and its parts are as good."""
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
LEAST_TRAINING_MIN = 1.0
"""Time that training gets at least [min]."""
AROUND_TRAINING_MIN = 1.5
"""Time that the start of training with cold caches, its curve and its film take [min]."""
REFRESH_S = 15
"""Seconds after which a browser reads an unfinished page again."""
TASK = ("--env.goal.max-angle-rad", "3.14", "--env.success.rotation-rad", "0.2")
"""The training: turns of any size about the vertical, within 0.2 rad. Noise reaches 0.5 goals an
episode, as this did at 43 000 steps; at 90 000 it was 0.7, at 130 000 0.96 (one seed). Goals within
1 rad and 0.4 rad, as of cpu-demo, noise reaches by itself."""
LEARNED = 1.25
"""Times as many goals an episode in the last tenth of a training as in its first mean that it has
learned; of noise alone they differ by a tenth."""
EPISODE_STEPS = 256 * 120
"""Control steps in which each environment of cpu-demo ends an episode, of 10 s."""
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
    """Folder of OBJ, STL, PLY, GLB or USD files: four that are as compact as what the policy was
    trained on are turned in place of built-in objects."""
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
    show: Callable[["Part"], dict[str, Any]]
    """Does it; returns what the template takes."""
    out: Path
    state: str = "waiting"
    """waiting, running, done, failed or interrupted."""
    seconds: float = 0.0
    error: str = ""
    commands: list[str] = field(default_factory=list)
    shown: dict[str, Any] = field(default_factory=dict)
    """What the template takes, once it is done."""

    @property
    def folder(self) -> Path:
        """Its folder."""
        return self.out / self.name

    def run(self, *words: str | Path) -> None:
        """Run a public command, its output in a file of the part's folder.

        Args:
            words: Its words, the name first.

        Raises:
            RuntimeError: It failed.
        """
        name, *rest = map(str, words)
        line = shlex.join([name, *rest])
        self.commands.append(line)
        print(f"  $ {line}", flush=True)
        log = self.folder / f"{len(self.commands)}-{name}.txt"
        with log.open("w") as output:
            status = subprocess.run(
                [Path(sys.executable).with_name(name), *rest],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                check=False,
            ).returncode
        if status != 0:
            said = log.read_text(errors="replace").strip().split("\n")
            reason = "\n".join(said[-REASON_LINES:])
            raise RuntimeError(f"{line} ended with status {status}: {reason}")


class Demo:
    """The parts, in their order."""

    def __init__(self, cfg: DemoCfg) -> None:
        self.cfg = cfg
        self.page = cfg.out / "index.html"
        self.started = time.monotonic()
        self.seed = ("--seed", str(cfg.seed))
        parts = [
            Part("camera", "Objects never seen, turned by camera", self.camera, cfg.out),
            Part("gap", "A hidden effect, found and closed", self.gap, cfg.out),
            Part("twin", "A hand behind its motors", self.twin, cfg.out),
            Part("training", "A small training", self.training, cfg.out),
        ]
        self.parts = parts[:1] if cfg.quick else parts
        self.policy = default_policy(HAND, "vision")
        """Installed policy that sees by camera."""
        self.objects: tuple[str, ...] = (HELD_OUT.format(SHOWN),)
        """Sets of the first part; the twin has the first object."""

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
            began = time.monotonic()
            part.state = "running"
            print(f"\n[{number}/{len(self.parts)}] {part.title}", flush=True)
            shutil.rmtree(part.folder, ignore_errors=True)
            part.folder.mkdir(parents=True)
            self.write(running=True)
            try:
                part.shown = part.show(part)
                part.state = "done"
            except KeyboardInterrupt:
                part.state = "interrupted"
                self.write(running=False)
                raise
            except Exception as error:  # whatever it is, the other parts go on
                part.state = "failed"
                part.error = str(error) or type(error).__name__
                print(f"  failed: {part.error}", file=sys.stderr, flush=True)
            part.seconds = time.monotonic() - began
            self.write(running=part is not self.parts[-1])

    def write(self, *, running: bool) -> None:
        """Write the page; one of a demo that is ``running`` is read again by the browser."""
        from vd.command.page import write_html

        refresh = REFRESH_S if running else None
        write_html(self.page, "demo.html", parts=self.parts, refresh=refresh, minutes=self.minutes)

    def camera(self, part: Part) -> dict[str, Any]:
        """The shipped policy turns objects that it has never seen, by camera: film, and success."""
        film = part.folder / "film.mp4"
        if self.cfg.meshes is not None:
            self.objects = import_meshes(part, self.cfg.meshes)
        options = (self.policy, "--objects", *self.objects, *self.seed)
        part.run("vd-eval", *options, "--episodes", str(EPISODES), "--out", part.folder)
        shown = ("--cells", str(SHOWN), "--seconds", str(FILM_S))
        part.run("vd-play", *options, *shown, "--video", film)
        from vd.evaluate.page import percent
        from vd.evaluate.result import Result

        row = next(row for row in Result.read(part.folder / "eval.json").rows if row.headline)
        lines = []
        for summary in (*row.per_object, row.overall):
            success = percent(summary.outcomes["success"])
            dropped = percent(summary.outcomes["object falls"])
            symmetric = percent(summary.symmetric)
            lines.append((summary.name, summary.episodes, success, symmetric, dropped))
        return {
            "policy": self.policy,
            "meshes": None if self.objects[0] == HELD_OUT.format(SHOWN) else self.cfg.meshes,
            "built_in": len(self.objects) > 1,
            "film": film,
            "rows": lines,
            "tolerance_rad": PAPER.success.rotation_rad,
            "page": f"{part.name}/eval.html",
        }

    def gap(self, part: Part) -> dict[str, Any]:
        """An effect hidden in a simulated servo, found and closed."""
        recording = part.folder / "recording"
        analysis = part.folder / "analysis"
        part.run("vd-gap", "hide", "servo", "--effect", HIDDEN, "--out", recording, *self.seed)
        part.run("vd-gap", "run", recording, "--out", analysis, *self.seed)
        from vd.api import gap_verdict

        verdict = gap_verdict(analysis / "report.json")
        pictures = sorted(analysis.glob("overlay_*.png"), key=lambda path: path.stat().st_mtime)
        page = f"{part.name}/analysis/report.html"
        return {"hidden": HIDDEN, "verdict": verdict, "picture": pictures[0], "page": page}

    def first_object(self) -> str:
        """An object of the first part: a file, or the name of a set of one."""
        from vd.assets_usd.objects.model import object_files

        first = Path(self.objects[0])
        return str(object_files(first)[0]) if first.is_dir() else HELD_OUT.format(1)

    def twin(self, part: Part) -> dict[str, Any]:
        """A simulated hand behind the protocol of its motors, with the policy that sees."""
        log = part.folder / "log"
        hand = ("--hand", HAND, "--twin", "--object", self.first_object())
        options = ("--safety.misses", MISSES, "--log", log)
        part.run("vd-deploy", self.policy, *hand, *self.seed, *options)
        from vd.logs.hand_log import read_log

        run = read_log(log)
        sent_ms = 1e3 * run.columns["sent_s"]
        sent = f"{np.median(sent_ms):.0f}, at most {sent_ms.max():.0f}"
        missed = f"{run.columns['missed'][-1]:.0f}"
        outcomes = ", ".join(stop.outcome for stop in run.stops)
        return {
            "film": log / "run.mp4",
            "row": (len(sent_ms), missed, sent, outcomes),
            "object": run.run["object"]["name"],
            "page": f"{part.name}/log/run.html",
        }

    def training(self, part: Part) -> dict[str, Any]:
        """A small training, with its curve."""
        run = part.folder / "run"
        film = part.folder / "film.mp4"
        minutes = max(self.cfg.minutes - self.minutes - AROUND_TRAINING_MIN, LEAST_TRAINING_MIN)
        task = ("--preset", "cpu-demo", *TASK, "--max-minutes", f"{minutes:.2f}")
        part.run("vd-train", "teacher", *task, *self.seed, "--out", run)
        shown = ("--cells", "4", "--seconds", str(FILM_S))
        part.run("vd-play", run, *shown, *self.seed, "--video", film)
        from vd.train.metrics import PROGRESS_FILE, read_progress

        rows = settled(read_progress(run / PROGRESS_FILE))
        goals = [row["goals_per_episode"] for row in rows]
        tenth = max(1, len(goals) // 10)
        first = float(np.mean(goals[:tenth]))
        last = float(np.mean(goals[-tenth:]))
        return {
            "film": film,
            "curves": goal_curve([row["env_steps"] for row in rows], goals),
            "first": first,
            "last": last,
            "learned": len(goals) > tenth and last > LEARNED * first,
            "steps": rows[-1]["env_steps"],
        }


def settled(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of a training without its beginning, in which hardly an episode can have ended.

    Goals an episode are goals over episodes that ended: of the first steps they say too much. They
    fall until episodes end as often as they begin, and only from there they rise.
    """
    known = [row for row in rows if row["goals_per_episode"] is not None]
    return [row for row in known if row["env_steps"] >= EPISODE_STEPS] or known[-1:]


def goal_curve(steps: Sequence[int], goals: Sequence[float]) -> "Figure":
    """Goals an episode against control steps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3), layout="constrained")
    axis = figure.add_subplot(xlabel="control steps", ylabel="goals an episode")
    axis.plot(steps, goals)
    axis.grid(alpha=0.3)
    return figure


def import_meshes(part: Part, meshes: Path) -> tuple[str, ...]:
    """Import a few meshes, and fill up with built-in objects.

    Returns:
        Sets: that of the meshes, if any was imported, and built-in objects for those that lack.
    """
    from vd.assets_usd.objects.model import object_files

    out = part.folder / "objects"
    chosen = choose_meshes(meshes)
    if chosen:
        with suppress(RuntimeError):  # some cannot be imported: what it left counts
            part.run("vd-assets", "import", *chosen, "--out", out, *IMPORT)
    imported = object_files(out) if out.is_dir() else []
    left = SHOWN - len(imported)
    sets = (str(out),) if imported else ()
    return (*sets, HELD_OUT.format(left)) if left else sets


def choose_meshes(meshes: Path) -> list[Path]:
    """Of the smallest files those whose shape is like those of the training, the smallest first.

    Size does not matter: an import scales to what the hand holds. Thin and long things it has
    hardly met.
    """
    from vd.assets_usd.objects.geometry import sides_along_axes
    from vd.assets_usd.objects.plan import find_meshes
    from vd.assets_usd.objects.reading import MeshError, load_points

    chosen: list[Path] = []
    smallest = sorted(find_meshes([meshes]), key=lambda path: (path.stat().st_size, path))
    for path in smallest[:LOOKED_AT]:
        try:
            points = load_points(path).vertices
        except MeshError:  # its import would say why
            continue
        sides = sides_along_axes(points) if len(points) else np.zeros(1)
        if 0.0 < sides.max() <= COMPACT * sides.min():
            chosen.append(path)
        if len(chosen) == SHOWN:
            break
    return chosen


@interrupt.command("demo")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; returns the exit status: 1 if a part failed."""
    cfg: DemoCfg = parse(DemoCfg, arguments, prog="python -m vd.train.demo")
    require(cfg, "--", "positive", "minutes")
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
