"""The main job, small: ``python -m vd.train.demo`` (``make demo``).

Authors the hand and a few objects, imports meshes if a folder is given, trains a teacher with the preset
that fits the machine, evaluates it beside a random and a zero agent, records a video and writes one HTML
page. Most stages are calls of the public commands; what is finished is not repeated by the next call.
"""

import hashlib
import json
import math
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from vd.config import to_dict
from vd.files import write_json
from vd.train.demo_agents import AGENTS, GoalCount, compare_agents, record_training_task

if TYPE_CHECKING:
    from vd.evaluate.result import EvalResult

OBJECTS = ("cube",)
"""Built-in sets that the demo trains on. On two cores a second shape needs more time than there is."""

SHOWN = ("procedural-3-seed0",)
"""Built-in sets that are authored beside them, and only appear in the evaluation."""

STAGES = 6

# Time kept back from training for what follows it on two cores: comparison, evaluation, video, page.
RESERVE_MIN = 4.5
# Training is worth starting with at least this much time left.
LEAST_TRAINING_MIN = 1.0
# Wanted duration of an agent's episodes in the comparison; their number follows from the speed of training.
SECONDS_PER_AGENT = 35.0
EPISODES_RANGE = {"cpu": (24, 256), "cuda": (512, 2048)}
# Episodes of all objects together under the paper's criteria.
PAPER_EPISODES = {"cpu": 64, "cuda": 2048}
EXIT_INTERRUPTED = 130


class DemoError(RuntimeError):
    """A stage failed; the message says which and what to do."""


@dataclass
class DemoCfg:
    """Author, train, evaluate, record: one page of results from the machine at hand."""

    out: Path = Path("demo")
    """Folder of everything the demo writes; the page is index.html."""
    minutes: float = 14.0
    """Time for everything [min]; training gets what the other stages leave."""
    seed: int = 0
    """Seed of assets, training and evaluation."""
    meshes: Path | None = None
    """Folder of OBJ, STL, PLY or GLB files to import and to train on as well."""
    objects: tuple[str, ...] = OBJECTS
    """Built-in object sets to train on."""
    preset: Literal["auto", "cpu-demo", "cube", "gpu"] = "auto"
    """Preset of vd-train; auto takes cube where there is a GPU, which learns within minutes there."""
    num_worlds: int | None = None
    """Worlds of the training; the preset's by default."""
    max_steps: int | None = None
    """Control steps after which training ends at the latest; the preset's by default."""

    def validate(self) -> None:
        """Raise ValueError naming the flag and the remedy."""
        if self.minutes <= 0.0:
            raise ValueError(f"--minutes is {self.minutes}; it has to be positive")
        if self.meshes is not None and not self.meshes.exists():
            raise ValueError(
                f"--meshes: there is no {self.meshes}; name a folder of OBJ, STL, PLY or GLB files"
            )
        for flag, value in {"--num-worlds": self.num_worlds, "--max-steps": self.max_steps}.items():
            if value is not None and value < 1:
                raise ValueError(f"{flag} is {value}; it has to be positive")
        if not self.objects and self.meshes is None:
            raise ValueError("--objects is empty; name a set, or give --meshes")


@dataclass
class DemoResults:
    """What the page shows.

    Attributes:
        cfg: Settings of the demo.
        preset: Preset that was trained.
        machine: What it ran on.
        hand: Name of the hand.
        objects: Sets or folders that were trained on.
        run_dir: Folder of the training.
        sheet: Contact sheet of the objects.
        agents: Result of each agent in the task of the training: first goals, and all goals of an episode.
        paper: Result of the trained policy under the paper's criteria and goals.
        video: Recording of the trained policy.
        seconds: Duration of each stage.
        commands: The same by hand, in order.
    """

    cfg: DemoCfg
    preset: str
    machine: str
    hand: str
    objects: tuple[str, ...]
    run_dir: Path
    sheet: Path
    agents: "dict[str, tuple[EvalResult, GoalCount]]"
    paper: "EvalResult"
    video: Path
    seconds: dict[str, float]
    commands: list[str]


@dataclass
class _Stages:
    """Numbered stages with their durations, remembered in a file so that a later call skips them."""

    path: Path
    seconds: dict[str, float] = field(default_factory=dict)
    number: int = 0

    def load(self) -> None:
        """Read what earlier calls finished."""
        if self.path.is_file():
            try:
                self.seconds = json.loads(self.path.read_text())
            except json.JSONDecodeError as error:
                raise ValueError(f"{self.path} is damaged ({error}); delete it") from error

    @contextmanager
    def run(self, name: str, title: str, *, products: Sequence[Path] = ()) -> Iterator[bool]:
        """Announce a stage; yields whether it has to run, and records its duration if it does not raise.

        Without ``products``, files that show that it was finished, it always has to.
        """
        self.number += 1
        done = name in self.seconds and bool(products) and all(path.exists() for path in products)
        note = f"   (done before, {self.seconds[name]:.0f} s)" if done else ""
        print(f"\n[{self.number}/{STAGES}] {title}{note}", flush=True)
        started = time.monotonic()
        yield not done
        if not done:
            self.seconds[name] = time.monotonic() - started
            write_json(self.path, self.seconds)


def run_demo(cfg: DemoCfg, *, started: float | None = None) -> Path:
    """Run all stages; returns the page.

    Args:
        cfg: Settings.
        started: ``time.monotonic()`` from which ``minutes`` counts; now by default.

    Raises:
        ValueError: A setting cannot be used.
        DemoError: A stage failed.
        KeyboardInterrupt: Interrupted; the next call goes on.
    """
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING  # a line for each of some hundred kernels would hide the rest
    started = time.monotonic() if started is None else started
    cfg.validate()
    gpu = wp.is_cuda_available()
    preset = cfg.preset if cfg.preset != "auto" else ("cube" if gpu else "cpu-demo")
    device = "cuda" if gpu and preset != "cpu-demo" else "cpu"
    folder = cfg.out / _label(cfg, preset)
    stages = _Stages(folder / "stages.json")
    stages.load()
    machine = wp.get_device("cuda:0").name if device == "cuda" else f"{os.cpu_count()} CPU cores"
    print(f"preset {preset} on {machine}, files in {folder}")

    commands: list[str] = []
    hand, models = _author(cfg, preset, stages, commands)
    objects, sheet = _import(cfg, folder, models, stages, commands)
    run_dir = folder / "teacher"
    _train(cfg, preset, objects, run_dir, started, stages, commands)
    agents, paper = _evaluate(cfg, preset, objects, run_dir, folder, device, stages, commands)
    video = folder / "trained.mp4"
    _record(cfg, objects, run_dir, video, device, stages, commands)

    page = cfg.out / "index.html"
    with stages.run("page", "write the page"):
        from vd.train.demo_page import write_page

        results = DemoResults(
            cfg=cfg,
            preset=preset,
            machine=machine,
            hand=hand,
            objects=objects,
            run_dir=run_dir,
            sheet=sheet,
            agents=agents,
            paper=paper,
            video=video,
            seconds=dict(stages.seconds),
            commands=commands,
        )
        write_page(results, page)
    return page


def _label(cfg: DemoCfg, preset: str) -> str:
    """Name of the folder: other settings or other meshes make another one, so nothing stale is reused."""
    parts = [*cfg.objects, str(cfg.num_worlds)]
    name = f"{preset}-seed{cfg.seed}"
    if cfg.meshes is not None:
        name += f"-{cfg.meshes.resolve().name}"
        files = sorted(p for p in [cfg.meshes, *cfg.meshes.rglob("*")] if p.is_file())
        parts += [f"{path} {path.stat().st_size} {path.stat().st_mtime_ns}" for path in files]
    return f"{name}-{hashlib.sha256(chr(10).join(parts).encode()).hexdigest()[:6]}"


def _author(cfg: DemoCfg, preset: str, stages: _Stages, commands: list[str]) -> tuple[str, list[Any]]:
    from vd.assets_usd.hand_author import hand_usd
    from vd.assets_usd.objects.model import load_set
    from vd.train.presets import PRESETS

    hand = PRESETS[preset]().env.hand
    commands.append(f"vd-assets hand {hand}")
    sets = dict.fromkeys((*cfg.objects, *SHOWN))
    with stages.run("assets", f"author the hand {hand} and the objects {', '.join(sets)}"):
        print(f"  {hand_usd(hand)}")
        # Sets that are in the cache already are read from it.
        models = load_set(list(sets))
        print(f"  {len(models)} objects: {', '.join(model.name for model in models)}")
    return hand, models


def _import(
    cfg: DemoCfg, folder: Path, models: list[Any], stages: _Stages, commands: list[str]
) -> tuple[tuple[str, ...], Path]:
    from vd.assets_usd.cli import Import, run_import
    from vd.assets_usd.objects.model import load_set, object_files
    from vd.assets_usd.objects.sheet import SheetStyle, contact_sheet

    sheet, objects = folder / "objects.png", cfg.objects
    title = "no meshes to import (make demo MESHES=folder)" if cfg.meshes is None else f"import {cfg.meshes}"
    with stages.run("import", title, products=[sheet]) as needed:
        if cfg.meshes is not None:
            imported = folder / cfg.meshes.resolve().name
            commands.append(f"vd-assets import {cfg.meshes} --out {imported}")
            status = run_import(Import(paths=(cfg.meshes,), out=imported)) if needed else 0
            if status == EXIT_INTERRUPTED:
                raise KeyboardInterrupt
            if not imported.is_dir() or not object_files(imported):
                raise DemoError(
                    f"none of the meshes in {cfg.meshes} could be imported; the reasons are above"
                )
            objects = (*objects, str(imported))
            models = models + (load_set([str(imported)]) if needed else [])
        if needed:
            contact_sheet(models, sheet, style=SheetStyle(tile=150), title="Objects of the demo")
    shown = " ".join(dict.fromkeys((*objects, *SHOWN)))
    commands.append(f"vd-assets show {shown} --out {sheet}")
    return objects, sheet


def _train(
    cfg: DemoCfg,
    preset: str,
    objects: tuple[str, ...],
    run_dir: Path,
    started: float,
    stages: _Stages,
    commands: list[str],
) -> None:
    from vd.train import cli
    from vd.train.checkpoint import list_checkpoints

    left = cfg.minutes - (time.monotonic() - started) / 60.0 - RESERVE_MIN
    minutes = max(left, LEAST_TRAINING_MIN)
    flags = ["--preset", preset, "--run-dir", str(run_dir), "--seed", str(cfg.seed)]
    flags += ["--objects", *objects]
    flags += ["--num-worlds", str(cfg.num_worlds)] if cfg.num_worlds else []
    flags += ["--max-steps", str(cfg.max_steps)] if cfg.max_steps else []
    commands.append(f"vd-train teacher {' '.join(flags)}")
    title = f"train a teacher for at most {minutes:.1f} min (Ctrl-C saves, the next call goes on)"
    with stages.run("train", title, products=[run_dir / "policy.pt"]) as needed:
        if not needed:
            return
        resume = ["--resume"] if list_checkpoints(run_dir) else []
        status = cli.main(["teacher", *flags, "--max-minutes", f"{minutes:.2f}", *resume])
        if status == EXIT_INTERRUPTED:
            raise KeyboardInterrupt
        if status != 0 or not (run_dir / "policy.pt").is_file():
            raise DemoError(f"the training in {run_dir} failed; the reason is above")


def _evaluate(
    cfg: DemoCfg,
    preset: str,
    objects: tuple[str, ...],
    run_dir: Path,
    folder: Path,
    device: str,
    stages: _Stages,
    commands: list[str],
) -> "tuple[dict[str, tuple[EvalResult, GoalCount]], EvalResult]":
    from vd.assets_usd.objects.model import load_set
    from vd.evaluate import cli
    from vd.evaluate.result import EvalResult
    from vd.train.presets import PRESETS

    files = {name: folder / f"{name}.json" for name in (*AGENTS, "goals")}
    official = folder / "evaluation"
    judged = tuple(dict.fromkeys((*objects, *SHOWN)))
    each = math.ceil(PAPER_EPISODES[device] / len(load_set(list(judged))))
    flags = [str(run_dir / "policy.pt"), "--objects", *judged, "--episodes", str(each)]
    flags += ["--seed", str(cfg.seed), "--device", device, "--output", str(official)]
    flags += ["--episode-s", f"{PRESETS[preset]().env.episode_s:g}", "--no-at-rest"]
    commands.append(f"vd-eval {' '.join(flags)}")
    products = [*files.values(), official / "eval.json"]
    with stages.run("evaluate", "evaluate it beside a random and a zero agent", products=products) as needed:
        if needed:
            episodes = _episodes(run_dir, device)
            goals = {}
            for agent, result, count in compare_agents(
                run_dir, objects, episodes, seed=cfg.seed, device=device
            ):
                result.write(files[agent])
                goals[agent] = to_dict(count)
                print(
                    f"  {agent}: first goal reached in {100.0 * result.overall.stop_rate.value:.0f} % of "
                    f"episodes, "
                    f"{count.per_episode:.2f} goals an episode"
                )
            write_json(files["goals"], goals)
            print("  the trained policy under the paper's criteria, goals from all of SO(3):")
            if cli.main(flags) != 0:
                raise DemoError("vd-eval failed; the reason is above")
    counts = json.loads(files["goals"].read_text())
    agents = {agent: (EvalResult.read(files[agent]), GoalCount(**counts[agent])) for agent in AGENTS}
    return agents, EvalResult.read(products[-1])


def _episodes(run_dir: Path, device: str) -> int:
    """Episodes of each agent: what fits into the time at the speed the simulator had in training."""
    from vd.paper import PAPER
    from vd.train.metrics import PROGRESS_FILE, read_progress

    rows = read_progress(run_dir / PROGRESS_FILE)
    steps = rows[-1]["env_steps"] - (rows[-2]["env_steps"] if len(rows) > 1 else 0)
    speed = steps / rows[-1]["collect_s"]
    low, high = EPISODES_RANGE[device]
    return round(
        min(max(speed * SECONDS_PER_AGENT / (PAPER.scene.episode_s * PAPER.scene.control_hz), low), high)
    )


def _record(
    cfg: DemoCfg,
    objects: tuple[str, ...],
    run_dir: Path,
    video: Path,
    device: str,
    stages: _Stages,
    commands: list[str],
) -> None:
    flags = [str(run_dir / "policy.pt"), "--objects", *objects, "--seed", str(cfg.seed)]
    commands.append(f"vd-play {' '.join(flags)}")
    with stages.run("video", "record the trained policy", products=[video]) as needed:
        if needed:
            record_training_task(run_dir, objects, video, seed=cfg.seed, device=device)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; returns the exit status."""
    started = time.monotonic()
    cfg = tyro.cli(DemoCfg, args=arguments, prog="python -m vd.train.demo")
    try:
        page = run_demo(cfg, started=started)
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on from here", file=sys.stderr)
        return EXIT_INTERRUPTED
    except (ValueError, RuntimeError) as error:
        print(f"\ndemo: {error}; the same command goes on from here", file=sys.stderr)
        return 1
    print(f"\n{page} is ready after {(time.monotonic() - started) / 60.0:.1f} min; open it in a browser")
    return 0


if __name__ == "__main__":
    sys.exit(main())
