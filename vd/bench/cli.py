"""vd-bench: measure speed, physics, depth camera and gap workflow.

Rates are ratios within one run.
"""

import dataclasses
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from vd.command import interrupt
from vd.command.device import resolve_device
from vd.command.files import check_file, check_folder
from vd.command.line import parse
from vd.command.warp_quiet import quiet_warp


def report(rows: Iterable[dict[str, Any]], device: str, path: Path | None) -> None:
    """Print rows as they come, a line of JSON each, and write a file after each.

    The next may fail.
    """
    import warp as wp

    from vd.command.files import write_json
    from vd.command.versions import code_fingerprint

    done: list[dict[str, Any]] = []
    made = {
        "device": str(wp.get_device(device).name),
        "date": f"{date.today()}",
        "code": code_fingerprint(),
        "rows": done,
    }
    for row in rows:
        done.append(row)
        print(json.dumps(row), flush=True)
        if path:
            write_json(path, made)


@dataclass(frozen=True)
class Measurement:
    """What the measurements of simulation, contacts and camera have in common."""

    objects: tuple[str, ...] = ("procedural-150-seed0",)
    """Object sets, mixed over the environments."""
    device: str = "auto"
    """Warp device; auto is the first GPU, or else the CPU."""
    json: Path | None = None
    """Write the rows to this file as JSON."""


@dataclass(frozen=True)
class SimCommand(Measurement):
    """Control steps per second, memory and start-up of the simulation under a policy's actions."""

    envs: tuple[int, ...] = (4096, 8192, 16384)
    """Numbers of environments to measure."""
    policy: str = "dclaw4"
    """Name or file of a teacher whose mean actions are taken, in the task it was trained in."""

    def run(self) -> int:
        """Measure and print."""
        from vd.policy.agents import open_teacher

        device = resolve_device(self.device)
        teacher = open_teacher(self.policy, device)
        if teacher is None:
            raise ValueError(f"--policy {self.policy} has no network; give a teacher")
        quiet_warp()
        from vd.bench.sim import measure
        from vd.envs.cfg import ReorientCfg

        task = ReorientCfg.of(teacher, objects=self.objects)
        tasks = (dataclasses.replace(task, num_envs=envs) for envs in self.envs)
        rows = (measure(cfg, device, teacher=teacher) for cfg in tasks)
        report(rows, device, self.json)
        return 0


@dataclass(frozen=True)
class PhysicsCommand(Measurement):
    """Contact quality: objects at rest, a pinched cube."""

    seed: int = 0
    """Of the orientations in which objects are dropped on the table."""

    def run(self) -> int:
        """Measure and print."""
        quiet_warp()
        from vd.assets_usd.objects.sets import load_set
        from vd.bench.physics import pinch, rest
        from vd.sim.cfg import SimCfg

        cfg, device = SimCfg(), resolve_device(self.device)
        results = rest(load_set(list(self.objects)), cfg, device=device, seed=self.seed)
        moving = [r for r in results if not r.rests]
        row = {
            "objects": len(results),
            "at_rest_share": 1.0 - len(moving) / len(results),
            "deepest_contact_m": max(r.penetration for r in results),
            "moving": [dataclasses.asdict(r) for r in moving],
            "pinch": dataclasses.asdict(pinch(load_set("cube")[0], cfg, device=device)),
        }
        report([row], device, self.json)
        return 0


@dataclass(frozen=True)
class DepthCommand(Measurement):
    """Depth images and clouds per second."""

    envs: tuple[int, ...] = (256, 1024, 4096)
    """Numbers of environments to measure; 1 for the figure at deployment on a CPU."""
    hand: str = "dclaw4"
    """Hand."""
    seed: int = 0
    """Of the poses."""

    def run(self) -> int:
        """Measure and print."""
        quiet_warp()
        from vd.assets_usd.objects.sets import load_set
        from vd.bench.depth import measure

        device, objects = resolve_device(self.device), load_set(list(self.objects))
        rows = (
            measure(objects, envs, device, hand=self.hand, seed=self.seed) for envs in self.envs
        )
        report(rows, device, self.json)
        return 0


@dataclass(frozen=True)
class GapCommand:
    """The battery of vd-gap.

    Effects hidden in recordings, found or not, and the figures of the goals.

    One result file per case: run it again to go on.
    """

    out: Path = Path("runs/gap-battery")
    """Folder of the results and their tables (summary.md)."""
    model: Literal["dclaw3", "dclaw4", "servo"] = "dclaw3"
    """A hand, of which it takes one finger, or servo, which is quick."""
    kinds: tuple[Literal["single", "none", "pair", "outside"], ...] = (
        "single",
        "none",
        "pair",
        "outside",
    )
    """Kinds of cases."""
    effects: tuple[str, ...] = ()
    """Effects to hide; all that show on the model by default."""
    sizes: tuple[Literal[0, 1, 2, 3], ...] = (0, 1, 2, 3)
    """Sizes of single effects: gaps of about 1.5, 3, 6 and 12 noise floors."""
    seeds: int = 5
    """Recordings of each effect and size; 40 times as many with nothing hidden, or only another
    stiffness, damping or mass."""
    first_seed: int = 0
    """Seed of the first recording: others than those that the method was tuned on."""
    battery: Literal["tuned", "development", "closed"] = "tuned"
    """Plants and seeds: as the rules were tuned on, others to develop on, or those that judge a
    finished method once."""
    jobs: int = 1
    """Cases at a time, one process and one thread each."""
    shard: str | None = None
    """I/N: every N-th case from the I-th, from 0, for arrays of jobs. The same command without it
    runs what is missing in --out and writes the tables."""
    device: str = "cpu"
    """Warp device."""

    def run(self) -> int:
        """Run the cases, then write and print the tables."""
        from vd.command.workers import shard

        shard((), self.shard)  # before anything slow
        from vd.command.files import write_text
        from vd.gap.bench.battery import battery, run_battery
        from vd.gap.bench.score import markdown

        cases = battery(
            self.model,
            kinds=self.kinds,
            effects=self.effects,
            sizes=self.sizes,
            seeds=self.seeds,
            first_seed=self.first_seed,
            which=self.battery,
        )
        device, cases = resolve_device(self.device), shard(cases, self.shard)
        results = run_battery(cases, self.out, jobs=max(self.jobs, 1), device=device)
        if self.shard is not None:
            return 0
        write_text(self.out / "summary.md", markdown(results))
        print(markdown(results))
        return 0


@dataclass(frozen=True)
class ContactCommand:
    """The battery of vd-gap contact: parameters hidden in MuJoCo, named or not.

    Run it again to go on.
    """

    out: Path = Path("runs/contact-battery")
    """Folder of the results and their tables (summary.md)."""
    seeds: int = 10
    """Recordings of each parameter; ten times as many with nothing hidden."""
    battery: Literal["development", "closed"] = "development"
    """Seeds to develop on, or those that judge a finished method once."""
    jobs: int = 1
    """Cases at a time, one process and one thread each."""

    def run(self) -> int:
        """Run the cases, then write and print the tables."""
        from vd.gap.bench.contact_battery import battery, run_battery, summary

        print(summary(run_battery(battery(self.battery, self.seeds), self.out, self.jobs)))
        return 0


Command = (
    Annotated[SimCommand, tyro.conf.subcommand("sim")]
    | Annotated[PhysicsCommand, tyro.conf.subcommand("physics")]
    | Annotated[DepthCommand, tyro.conf.subcommand("depth")]
    | Annotated[GapCommand, tyro.conf.subcommand("gap")]
    | Annotated[ContactCommand, tyro.conf.subcommand("contact")]
)


@interrupt.command("vd-bench")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``vd-bench``; returns the exit status."""
    command = parse(Command, arguments, prog="vd-bench", description=__doc__)
    if isinstance(command, GapCommand | ContactCommand):
        check_folder(command.out)
    elif isinstance(command, Measurement) and command.json is not None:
        check_file(command.json)
    return command.run()


if __name__ == "__main__":
    sys.exit(main())
