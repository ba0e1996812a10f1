"""vd-bench: measure the speed of the simulation, and what the gap workflow finds."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Annotated, Literal

import tyro

from vd.command import interrupt
from vd.command.device import resolve_device
from vd.command.files import check_file, check_folder, write_json
from vd.command.line import parse
from vd.command.versions import GAP, MEASURING, code_fingerprint, installed_versions
from vd.command.warp_quiet import quiet_warp

PACKAGES = ("visual-dexterity", "newton", "warp-lang")
"""Packages whose versions stand beside what was measured."""


def measured_by(device: str, packages: tuple[str, ...]) -> dict[str, str]:
    """Device, date, versions, and the fingerprint of ``packages``, the code that measured."""
    import warp as wp

    stamp = {"device": wp.get_device(device).name, "date": f"{date.today()}"}
    return stamp | {"code": code_fingerprint(packages)} | installed_versions(PACKAGES)


@dataclass(frozen=True)
class SimCommand:
    """Control steps per second and memory of the simulation under a policy's actions."""

    envs: tuple[int, ...] = (4096, 8192, 16384)
    """Numbers of environments to measure."""
    policy: str = "dclaw4"
    """Name or file of a teacher whose mean actions are taken, in the task it was trained in."""
    objects: tuple[str, ...] = ("procedural-150-seed0",)
    """Object sets, mixed over the environments."""
    device: str = "auto"
    """Warp device; auto is the first GPU, or else the CPU."""
    json: Path | None = None
    """Write the rows to this file as JSON."""

    def run(self) -> int:
        """Measure, print a line of JSON for each number of environments, and write after each."""
        if self.json is not None:
            check_file(self.json)
        from vd.policy.agents import open_teacher

        device = resolve_device(self.device)
        teacher = open_teacher(self.policy, device)
        if teacher is None:
            raise ValueError(f"--policy {self.policy} has no network; give a teacher")
        quiet_warp()
        from vd.bench.sim import measure
        from vd.envs.cfg import ReorientCfg

        rows: list[dict[str, float]] = []
        measured = measured_by(device, MEASURING) | {"rows": rows}
        for envs in self.envs:
            task = ReorientCfg.of(teacher, objects=self.objects, num_envs=envs)
            rows.append(measure(task, device, teacher=teacher))
            print(json.dumps(rows[-1]), flush=True)
            if self.json is not None:
                write_json(self.json, measured)
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
    json: Path | None = None
    """Write the figures to this file as JSON."""

    def run(self) -> int:
        """Run the cases, then write and print the tables."""
        from vd.command.workers import shard

        shard((), self.shard)  # before anything slow
        if self.json is not None:
            check_file(self.json)
        from vd.command.files import write_text
        from vd.gap.bench.battery import battery, run_battery
        from vd.gap.bench.score import figures, table

        device = resolve_device(self.device)
        cases = battery(
            self.model,
            kinds=self.kinds,
            effects=self.effects,
            sizes=self.sizes,
            seeds=self.seeds,
            first_seed=self.first_seed,
            which=self.battery,
        )
        results = run_battery(
            shard(cases, self.shard),
            self.out,
            jobs=max(self.jobs, 1),
            device=device,
        )
        if self.shard is not None:
            return 0
        reached = figures(results)
        if self.json is not None:
            known = [figure for figure in reached if figure.values]
            row = {f.what: {"value": f.value, "cases": len(f.values)} for f in known}
            stamp: dict[str, object] = {"seed": self.first_seed, **measured_by(device, GAP)}
            write_json(self.json, stamp | {"rows": [row]})
        write_text(self.out / "summary.md", table(reached))
        print(table(reached))
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
    | Annotated[GapCommand, tyro.conf.subcommand("gap")]
    | Annotated[ContactCommand, tyro.conf.subcommand("contact")]
)


@interrupt.command("vd-bench")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``vd-bench``; returns the exit status."""
    command = parse(Command, arguments, prog="vd-bench", description=__doc__)
    if isinstance(command, GapCommand | ContactCommand):
        check_folder(command.out)
    return command.run()


if __name__ == "__main__":
    sys.exit(main())
