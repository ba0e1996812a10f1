"""The main job, small: ``python -m vd.train.demo`` (``make demo``).

Authors the hand and a few objects, imports meshes if a folder is given, finds an effect that is hidden in a
servo, trains a teacher with the preset that fits the machine, evaluates it beside a random and a zero agent,
judges an installed policy as the paper does, records a video, lets a student of point clouds begin to imitate
an installed teacher, flies simulated hands behind their motors' protocol, and writes a page.
Most stages are calls of the public commands; what is finished is not repeated by the next call.

It ends in time whatever the machine: the import has a share of the time, training ends where the stages
after it need the rest, the comparison is sized by the speed measured in training, and every stage after it is
stopped by the clock, with the command that does it by hand. Only building the worlds cannot be stopped.
"""

import hashlib
import json
import math
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from vd import interrupt
from vd.config import to_dict
from vd.files import write_json
from vd.train.demo_agents import AGENTS, GoalCount, compare_agents, record_training_task
from vd.train.demo_config import DemoCfg, DemoError
from vd.train.demo_deploy import HANDS, deploy_commands, deploy_files, fly_twins, replay_command
from vd.train.demo_gap import find_hidden_gap, gap_commands, gap_report
from vd.train.demo_import import IMPORT_SEARCH, IMPORT_SHARE, import_for
from vd.train.demo_stages import Budget, Stages
from vd.train.demo_student import student_commands, student_files, train_students
from vd.warp_quiet import quiet_warp

if TYPE_CHECKING:
    from vd.evaluate.result import EvalResult

SHOWN = ("procedural-3-seed0",)
"""Built-in sets that are authored beside them, and only appear in the evaluation."""

STAGES, MESH_STAGES = 10, 2
"""Stages of every demo, and those that imported meshes add after their import."""

# Time kept back from training for what follows it on two cores: comparison, evaluation, video, student, page;
# and for comparison and video with the imported meshes.
RESERVE_MIN, RESERVE_MESHES_MIN = 5.5, 1.75
# Time kept back for the page alone.
PAGE_MIN = 0.3
# Time kept back from the student for the twins, half a minute of it spare.
TWINS_MIN = 1.5
# Training is worth starting with at least this much time left.
LEAST_TRAINING_MIN = 1.0
# Wanted duration of an agent's episodes in the comparison; their number follows from the speed of training.
SECONDS_PER_AGENT = 35.0
EPISODES_RANGE = {"cpu": (24, 256), "cuda": (512, 2048)}
# Episodes of all imported objects together in the same comparison; parts make them slower than a cube.
MESH_EPISODES = {"cpu": 48, "cuda": 1024}
JUDGED = "dclaw3-table"
"""Installed policy that is judged by the paper's criteria: the demo's own training is too short for them."""
# Episodes of all objects together under the paper's criteria.
PAPER_EPISODES = {"cpu": 64, "cuda": 2048}


@dataclass
class _Demo:
    """A demo under way: its settings, its files, and the commands that do the same by hand."""

    cfg: DemoCfg
    preset: str
    device: str
    folder: Path
    stages: Stages
    commands: list[str] = field(default_factory=list)

    @property
    def run_dir(self) -> Path:
        """Folder of the training."""
        return self.folder / "teacher"

    @property
    def imported(self) -> tuple[str, ...]:
        """The set of imported meshes; empty if there is none."""
        from vd.assets_usd.objects.model import object_files

        if self.cfg.meshes is None:
            return ()
        folder = self.folder / self.cfg.meshes.resolve().name
        return (str(folder),) if folder.is_dir() and object_files(folder) else ()

    @property
    def reserve_min(self) -> float:
        """Time that the stages after training need [min]."""
        return RESERVE_MIN + (RESERVE_MESHES_MIN if self.cfg.meshes is not None else 0.0)

    def author(self) -> str:
        """Author hand and objects; returns the hand's name."""
        from vd.assets_usd.hand_author import hand_usd
        from vd.assets_usd.objects.model import load_set
        from vd.train.presets import PRESETS

        hand = PRESETS[self.preset]().env.hand
        self.commands.append(f"vd-assets hand {hand}")
        sets = dict.fromkeys((*self.cfg.objects, *SHOWN))
        with self.stages.run("assets", f"author the hand {hand} and the objects {', '.join(sets)}"):
            print(f"  {hand_usd(hand)}")
            # Sets that are in the cache already are read from it.
            models = load_set(list(sets))
            print(f"  {len(models)} objects: {', '.join(model.name for model in models)}")
        return hand

    def import_meshes(self) -> None:
        """Import meshes, the smallest first, until the import's share of the time is used.

        Raises:
            DemoError: None could be imported, and not for want of time.
        """
        from vd.assets_usd.objects.plan import find_meshes

        assert self.cfg.meshes is not None
        # The finer a mesh, the longer its decomposition takes.
        meshes = sorted(find_meshes([self.cfg.meshes]), key=lambda path: (path.stat().st_size, path))
        out = self.folder / self.cfg.meshes.resolve().name
        command = f"vd-assets import {self.cfg.meshes} --out {out} --mcts-iterations {IMPORT_SEARCH}"
        self.commands.append(command)
        share_s = min(IMPORT_SHARE * 60.0 * self.cfg.minutes, self.stages.budget.left_s())
        title = f"import {len(meshes)} meshes of {self.cfg.meshes} for at most {share_s / 60.0:.1f} min"
        rest = self.folder / "not-imported.json"
        with self.stages.run("import", title, products=[rest]) as needed:
            if needed:
                done = import_for(meshes, out, share_s)
                missing = [path.name for path in meshes if str(path) not in done]
                if not missing and not self.imported:
                    raise DemoError(
                        f"none of the meshes in {self.cfg.meshes} could be imported; the reasons are above"
                    )
                write_json(rest, missing)
        if missing := json.loads(rest.read_text()):
            self.stages.leave_out(
                f"import {len(missing)} of {len(meshes)} meshes: {', '.join(missing)}", command
            )

    def draw(self) -> Path | None:
        """Draw the contact sheet."""
        from vd.assets_usd.objects.model import load_set
        from vd.assets_usd.objects.sheet import SheetStyle, contact_sheet

        sheet, sets = self.folder / "objects.png", self._everything()
        command = f"vd-assets show {' '.join(sets)} --out {sheet}"
        self.commands.append(command)

        def work() -> None:
            contact_sheet(
                load_set(list(sets)), sheet, style=SheetStyle(tile=150), title="Objects of the demo"
            )

        keep = self.reserve_min + LEAST_TRAINING_MIN
        there = self.stages.run_if_time(
            "sheet", "draw the objects", work, products=[sheet], keep_min=keep, command=command
        )
        return sheet if there else None

    def close_gap(self) -> bool:
        """Hide an effect in a servo and find it; returns whether the report is there."""
        commands = [f"vd-gap {' '.join(a)}" for a in gap_commands(self.folder, self.cfg.seed, self.device)]
        self.commands += commands
        return self.stages.run_if_time(
            "gap",
            "hide an effect in a simulated servo, find it and close the gap",
            lambda: find_hidden_gap(self.folder, self.cfg.seed, self.device),
            products=[gap_report(self.folder)],
            keep_min=self.reserve_min + LEAST_TRAINING_MIN,
            command=" && ".join(commands),
        )

    def train(self) -> None:
        """Train for the time that the later stages leave.

        Raises:
            DemoError: The training failed.
            KeyboardInterrupt: It was interrupted, and has saved.
        """
        from vd.train import cli
        from vd.train.checkpoint import list_checkpoints

        cfg, run_dir = self.cfg, self.run_dir
        minutes = max(self.stages.budget.left_s(keep_min=self.reserve_min) / 60.0, LEAST_TRAINING_MIN)
        flags = ["--preset", self.preset, "--run-dir", str(run_dir), "--seed", str(cfg.seed)]
        flags += ["--objects", *cfg.objects]
        flags += ["--num-worlds", str(cfg.num_worlds)] if cfg.num_worlds else []
        flags += ["--max-steps", str(cfg.max_steps)] if cfg.max_steps else []
        self.commands.append(f"vd-train teacher {' '.join(flags)}")
        title = f"train a teacher for at most {minutes:.1f} min (Ctrl-C saves, the next call goes on)"
        with self.stages.run("train", title, products=[run_dir / "policy.pt"]) as needed:
            if not needed:
                return
            resume = ["--resume"] if list_checkpoints(run_dir) else []
            status = cli.main(["teacher", *flags, "--max-minutes", f"{minutes:.2f}", *resume])
            if status in (interrupt.INTERRUPTED, interrupt.TERMINATED):
                raise KeyboardInterrupt
            if status != 0 or not (run_dir / "policy.pt").is_file():
                raise DemoError(f"the training in {run_dir} failed; the reason is above")

    def compare(self) -> "dict[str, tuple[EvalResult, GoalCount]]":
        """Judge the trained policy beside random and no actions, in the task of the training.

        Raises:
            DemoError: There was no time, without which there is nothing to show.
        """
        if not self.stages.run_if_time(
            "compare",
            "compare it with random and no actions, in the task of its training",
            lambda: self._compare(self.cfg.objects, self._episodes(), self.folder),
            products=_comparison_files(self.folder),
            keep_min=PAGE_MIN,
            command=f"vd-eval {self.run_dir / 'policy.pt'} --objects {' '.join(self.cfg.objects)}",
        ):
            raise DemoError(
                f"{self.cfg.minutes:g} min are over before anything was evaluated: this machine is too slow, "
                "or busy; give more time (make demo DEMO_ARGS='--minutes 30')"
            )
        return _read_comparison(self.folder)

    def compare_imported(self) -> "dict[str, tuple[EvalResult, GoalCount]]":
        """The same on the imported meshes; empty if there is no time."""
        folder = self.folder / "imported"
        there = self.stages.run_if_time(
            "imported",
            "compare the three on the imported meshes, on which it was not trained",
            lambda: self._compare(self.imported, MESH_EPISODES[self.device], folder),
            products=_comparison_files(folder),
            keep_min=PAGE_MIN,
            command=f"vd-eval {self.run_dir / 'policy.pt'} --objects {' '.join(self.imported)}",
        )
        return _read_comparison(folder) if there else {}

    def record(self, objects: tuple[str, ...], name: str, title: str) -> Path | None:
        """Film the trained policy."""
        video = self.folder / f"{name}.mp4"
        flags = [str(self.run_dir / "policy.pt"), "--objects", *objects, "--seed", str(self.cfg.seed)]
        command = f"vd-play {' '.join(flags)}"
        self.commands.append(command)

        def work() -> None:
            record_training_task(self.run_dir, objects, video, seed=self.cfg.seed, device=self.device)

        there = self.stages.run_if_time(
            name, title, work, products=[video], keep_min=PAGE_MIN, command=command
        )
        return video if there else None

    def imitate(self) -> bool:
        """Let a student learn one scene by heart and begin to imitate on many; returns whether it did."""
        commands = [f"vd-train {' '.join(a)}" for a in student_commands(self.folder, self.cfg.seed)]
        self.commands += commands
        keep = PAGE_MIN + TWINS_MIN
        return self.stages.run_if_time(
            "student",
            "let a student of point clouds learn a scene by heart, then imitate on many",
            lambda: train_students(
                self.folder, self.cfg.seed, minutes=self.stages.budget.left_s(keep_min=keep) / 60.0
            ),
            products=student_files(self.folder),
            keep_min=PAGE_MIN,
            command=" && ".join(commands),
        )

    def deploy(self) -> bool:
        """Fly twins of both hands by the installed teachers; returns whether they flew."""
        flights = deploy_commands(self.folder, self.cfg.seed)
        replays = [replay_command(self.folder, hand) for hand in HANDS]
        commands = [" ".join(command) for command in (*flights, *replays)]
        self.commands += commands
        return self.stages.run_if_time(
            "deploy",
            "fly simulated hands through the protocol of their motors",
            lambda: fly_twins(
                self.folder, self.cfg.seed, minutes=self.stages.budget.left_s(keep_min=PAGE_MIN) / 60.0
            ),
            products=deploy_files(self.folder),
            keep_min=PAGE_MIN,
            command=" && ".join(commands),
        )

    def judge_as_paper(self) -> "EvalResult | None":
        """Judge an installed policy by the paper's criteria, with goals from all of SO(3)."""
        from vd.assets_usd.objects.model import load_set
        from vd.evaluate import cli
        from vd.evaluate.result import EvalResult

        out, objects = self.folder / "evaluation", self._everything()
        each = math.ceil(PAPER_EPISODES[self.device] / len(load_set(list(objects))))
        flags = [JUDGED, "--objects", *objects, "--episodes", str(each)]
        flags += ["--seed", str(self.cfg.seed), "--device", self.device, "--output", str(out)]
        command = f"vd-eval {' '.join(flags)}"
        self.commands.append(command)

        def work() -> None:
            if cli.main(flags) != 0:
                raise DemoError("vd-eval failed; the reason is above")

        title = f"evaluate the installed {JUDGED} by the paper's criteria"
        there = self.stages.run_if_time(
            "paper", title, work, products=[out / "eval.json"], keep_min=PAGE_MIN, command=command
        )
        return EvalResult.read(out / "eval.json") if there else None

    def _everything(self) -> tuple[str, ...]:
        """All object sets of the demo, each once."""
        return tuple(dict.fromkeys((*self.cfg.objects, *SHOWN, *self.imported)))

    def _compare(self, objects: tuple[str, ...], episodes: int, folder: Path) -> None:
        """Run the three agents and keep what they did in ``folder``."""
        goals = {}
        for agent, result, count in compare_agents(
            self.run_dir, objects, episodes, seed=self.cfg.seed, device=self.device
        ):
            result.write(folder / f"{agent}.json")
            goals[agent] = to_dict(count)
            first = 100.0 * result.overall.stop_rate.value
            print(
                f"  {agent}: first goal reached in {first:.0f} % of episodes, "
                f"{count.per_episode:.2f} goals an episode"
            )
        write_json(folder / "goals.json", goals)

    def _episodes(self) -> int:
        """Episodes of each agent: what fits into the time at the speed the simulator had in training."""
        from vd.paper import PAPER
        from vd.train.metrics import PROGRESS_FILE, read_progress

        rows = read_progress(self.run_dir / PROGRESS_FILE)
        steps = rows[-1]["env_steps"] - (rows[-2]["env_steps"] if len(rows) > 1 else 0)
        speed = steps / rows[-1]["collect_s"]
        seconds = min(SECONDS_PER_AGENT, self.stages.budget.left_s(keep_min=PAGE_MIN) / len(AGENTS))
        low, high = EPISODES_RANGE[self.device]
        return round(min(max(speed * seconds / (PAPER.scene.episode_s * PAPER.scene.control_hz), low), high))


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

    quiet_warp()
    cfg.validate()
    budget = Budget(cfg.minutes) if started is None else Budget(cfg.minutes, started=started)
    gpu = wp.is_cuda_available()
    preset = cfg.preset if cfg.preset != "auto" else ("cube" if gpu else "cpu-demo")
    device = "cuda" if gpu and preset != "cpu-demo" else "cpu"
    folder = cfg.out / _label(cfg, preset)
    total = STAGES if cfg.meshes is None else STAGES + 1 + MESH_STAGES
    stages = Stages(folder / "stages.json", total, budget)
    stages.load()
    machine = wp.get_device("cuda:0").name if device == "cuda" else f"{os.cpu_count()} CPU cores"
    print(f"preset {preset} on {machine}, files in {folder}")

    demo = _Demo(cfg, preset, device, folder, stages)
    hand = demo.author()
    if cfg.meshes is None:
        print("  no meshes to import (make demo MESHES=folder)")
    else:
        demo.import_meshes()
        stages.total -= 0 if demo.imported else MESH_STAGES
    sheet = demo.draw()
    gap = demo.close_gap()
    demo.train()
    agents = demo.compare()
    paper = demo.judge_as_paper()  # before what a slow machine may have to leave out
    video = demo.record(cfg.objects, "video", "record the trained policy")
    imported, imported_video = {}, None
    if demo.imported:
        imported = demo.compare_imported()
        imported_video = demo.record(demo.imported, "imported-video", "record it with imported meshes")
    student = demo.imitate()
    deployed = demo.deploy()

    page = cfg.out / "index.html"
    with stages.run("page", "write the page"):
        from vd.train.demo_page import DemoResults, write_page

        results = DemoResults(
            cfg=cfg,
            preset=preset,
            machine=machine,
            hand=hand,
            run_dir=demo.run_dir,
            sheet=sheet,
            agents=agents,
            imported=imported,
            gap=gap,
            student=student,
            deployed=deployed,
            folder=folder,
            paper=paper,
            video=video,
            imported_video=imported_video,
            seconds=dict(stages.seconds),
            left_out=stages.left_out,
            commands=demo.commands,
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


def _comparison_files(folder: Path) -> list[Path]:
    return [folder / f"{name}.json" for name in (*AGENTS, "goals")]


def _read_comparison(folder: Path) -> "dict[str, tuple[EvalResult, GoalCount]]":
    from vd.evaluate.result import EvalResult

    counts = json.loads((folder / "goals.json").read_text())
    return {a: (EvalResult.read(folder / f"{a}.json"), GoalCount(**counts[a])) for a in AGENTS}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; returns the exit status."""
    started = time.monotonic()
    cfg = tyro.cli(DemoCfg, args=arguments, prog="python -m vd.train.demo")
    try:
        page = run_demo(cfg, started=started)
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on from here", file=sys.stderr)
        return interrupt.INTERRUPTED
    except (ValueError, RuntimeError) as error:
        print(f"\ndemo: {error}; the same command goes on from here", file=sys.stderr)
        return 1
    print(f"\n{page} is ready after {(time.monotonic() - started) / 60.0:.1f} min; open it in a browser")
    return 0


if __name__ == "__main__":
    sys.exit(main())
