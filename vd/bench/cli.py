"""``vd-bench``: measure speed, physics, depth, student and gap workflow; rates are ratios within one run."""

import dataclasses
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from vd import interrupt
from vd.device import resolve_device
from vd.files import check_file, check_folder
from vd.warp_quiet import quiet_warp


def report(rows: Iterable[dict[str, Any]], device: str, path: Path | None) -> None:
    """Print rows as they come, a line of JSON each, and write a file after each: the next may fail."""
    import warp as wp

    from vd.files import write_json

    done = []
    for row in rows:
        done.append(row)
        print(json.dumps(row), flush=True)
        if path:
            write_json(path, {"device": str(wp.get_device(device).name), "rows": done})


@dataclass(frozen=True)
class SimCommand:
    """Control steps per second, memory and start-up of the simulation under a policy's actions."""

    envs: tuple[int, ...] = (4096, 8192, 16384)
    """Numbers of environments to measure."""
    objects: tuple[str, ...] = ("procedural-150-seed0",)
    """Object sets, mixed over the environments."""
    device: str = "auto"
    """Warp device; auto is the first GPU, or else the CPU."""
    policy: str = "dclaw4-table"
    """Name or file of a teacher whose mean actions are taken, in the task it was trained in."""
    allegro: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also step Newton's own Allegro example with as many environments; it downloads its hand (17.8 MB)."""
    json: Path | None = None
    """Write the rows to this file as JSON."""

    def run(self) -> int:
        """Measure and print."""
        from vd.evaluate.agents import open_teacher

        device = resolve_device(self.device)
        teacher = open_teacher(self.policy, device)
        if teacher is None:
            raise ValueError(f"--policy {self.policy} has no network; give a teacher")
        quiet_warp()
        report((self._row(envs, device, teacher) for envs in self.envs), device, self.json)
        return 0

    def _row(self, envs: int, device: str, teacher: Any) -> dict[str, Any]:
        from vd.bench.allegro import allegro_rate
        from vd.bench.sim import measure, teacher_task

        cfg = teacher_task(teacher, self.objects, envs)
        row: dict[str, Any] = dataclasses.asdict(measure(cfg, device, teacher=teacher))
        if not self.allegro:
            return row
        try:
            beside = allegro_rate(envs, device)
        except RuntimeError as error:
            return row | {"allegro": str(error)}
        ratio = row["physics_only"] * cfg.sim.substeps / beside.physics_steps_s
        return row | {
            "allegro_physics_steps_s": beside.physics_steps_s,
            "allegro_dt_s": beside.dt_s,
            "physics_steps_over_allegro": ratio,
        }


RESTITUTIONS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Coefficients asked for when the map to rebounds is measured."""


@dataclass(frozen=True)
class PhysicsCommand:
    """Contact quality: objects at rest, a pinched cube, sliding against Coulomb's law, a bouncing ball."""

    objects: tuple[str, ...] = ("procedural-150-seed0",)
    """Object sets to drop on the table."""
    seed: int = 0
    """Of the orientations they are dropped in."""
    device: str = "cpu"
    """Warp device."""
    json: Path | None = None
    """Write everything to this file as JSON."""

    def run(self) -> int:
        """Measure and print."""
        quiet_warp()
        from vd.assets_usd.objects.sets import load_set
        from vd.bench.physics import bounce, pinch, rest, slide
        from vd.sim.cfg import SimCfg

        cfg = SimCfg()
        results = rest(load_set(list(self.objects)), cfg, device=self.device, seed=self.seed)
        moving = [r for r in results if not r.rests]
        measured, coulomb = slide(cfg, device=self.device)
        row = {
            "objects": len(results),
            "at_rest_share": 1.0 - len(moving) / len(results),
            "deepest_contact_m": max(r.penetration for r in results),
            "moving": [dataclasses.asdict(r) for r in moving],
            "pinch": dataclasses.asdict(pinch(load_set("cube")[0], cfg, device=self.device)),
            "slide_m": measured,
            "slide_coulomb_m": coulomb,
            "slide_bouncing_m": slide(cfg, device=self.device, restitution=1.0)[0],
            "bounce": [dataclasses.asdict(bounce(cfg, e, device=self.device)) for e in RESTITUTIONS],
        }
        report([row], self.device, self.json)
        return 0


@dataclass(frozen=True)
class DepthCommand:
    """Depth images and clouds per second, beside Newton's camera at the same size in the same run."""

    envs: tuple[int, ...] = (256, 1024, 4096)
    """Numbers of environments to measure; 1 for the figure at deployment on a CPU."""
    objects: tuple[str, ...] = ("procedural-150-seed0",)
    """Object sets, mixed over the environments."""
    hand: str = "dclaw4"
    """Hand."""
    device: str = "auto"
    """Warp device; auto is the first GPU, or else the CPU."""
    seed: int = 0
    """Of the poses."""
    json: Path | None = None
    """Write the rows to this file as JSON."""

    def run(self) -> int:
        """Measure and print."""
        quiet_warp()
        from vd.assets_usd.objects.sets import load_set
        from vd.bench.depth import measure

        device, objects = resolve_device(self.device), load_set(list(self.objects))
        rows = (measure(objects, envs, device, hand=self.hand, seed=self.seed) for envs in self.envs)
        report(map(dataclasses.asdict, rows), device, self.json)
        return 0


@dataclass(frozen=True)
class StudentCommand:
    """Latency of a camera policy's control step on the CPU."""

    networks: tuple[str, ...] = ("lean", "dclaw4-tracking")
    """Camera policies, installed ones by name, or their files; or presets of students."""
    objects: tuple[str, ...] = ("procedural-150-seed0",)
    """Object sets, of which the first object lies on the table."""
    hand: str = "dclaw4"
    """Hand of a preset."""
    threads: int = 2
    """Threads of torch."""
    calls: int = 300
    """Control steps to time."""
    seed: int = 0
    """Of poses and weights."""
    json: Path | None = None
    """Write the rows to this file as JSON."""

    def run(self) -> int:
        """Measure and print."""
        from vd.evaluate.agents import find_policy, open_policy
        from vd.vision.cfg import PRESETS

        for name in (name for name in self.networks if name not in PRESETS):
            try:
                find_policy(name)
            except FileNotFoundError as error:
                raise ValueError(
                    f"--networks {name}: no such preset or policy; choose of {', '.join(PRESETS)}, or give "
                    "a camera policy"
                ) from error
            open_policy(name, "cpu")  # a file that cannot be used is told before anything slow
        quiet_warp()
        from vd.assets_usd.objects.sets import load_set
        from vd.bench.student import measure_latency

        objects = load_set(list(self.objects))
        rows = (
            measure_latency(
                objects, name, hand=self.hand, threads=self.threads, calls=self.calls, seed=self.seed
            )
            for name in self.networks
        )
        report(map(dataclasses.asdict, rows), "cpu", self.json)
        return 0


@dataclass(frozen=True)
class ReplayCommand:
    """Replay the control step in which a state left the finite numbers, physics step by physics step."""

    dump: Annotated[Path, tyro.conf.Positional]
    """File written when the run stopped."""
    device: str = "cpu"
    """Warp device."""

    def run(self) -> int:
        """Replay and print."""
        quiet_warp()
        from vd.sim.replay import replay

        for line in replay(self.dump, device=self.device):
            print(line)
        return 0


@dataclass(frozen=True)
class GapCommand:
    """The battery of vd-gap: effects hidden in recordings, found or not, and the figures of the goals.

    One result file per case: run it again to go on. Give --shard on each machine, bring the files together,
    and --collect makes the figures.
    """

    out: Path = Path("runs/gap-battery")
    """Folder of the results, their figures (summary.json) and tables (summary.md)."""
    model: str = "dclaw3"
    """dclaw3 or dclaw4 (one finger), or servo or pendulum, which are quick."""
    kinds: tuple[str, ...] = ("single", "none", "pair", "outside")
    """Kinds of cases."""
    effects: tuple[str, ...] = ()
    """Effects to hide; all that show on the model by default."""
    sizes: tuple[int, ...] = (0, 1, 2, 3)
    """Sizes of single effects: gaps of about 1.5, 3, 6 and 12 noise floors."""
    seeds: int = 5
    """Recordings of each effect and size."""
    first_seed: int = 0
    """Seed of the first recording: other seeds than those that the method was tuned on."""
    nothing: int = 200
    """Recordings with nothing hidden, or only other stiffness, damping and mass."""
    pairs: int | None = None
    """Pairs of effects, drawn at random; all by default."""
    shard: str = "1/1"
    """Part i/n of the cases, for n machines."""
    jobs: int = 1
    """Cases at a time, one process and one thread each."""
    limit_s: float = 1800.0
    """Longest time of a case [s]; one that takes longer has failed."""
    device: str = "cpu"
    """Warp device."""
    collect: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Run nothing; figures of the results that are there."""
    keep: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Keep recordings and analyses."""

    def run(self) -> int:
        """Run the cases, then write and print the tables."""
        from vd.bench.gap import battery, collect, parse_shard, run_battery
        from vd.bench.gap_score import markdown, summary
        from vd.files import write_json, write_text

        cases = battery(
            self.model,
            kinds=self.kinds,
            effects=self.effects,
            sizes=self.sizes,
            seeds=self.seeds,
            first_seed=self.first_seed,
            nothing=self.nothing,
            pairs=self.pairs,
        )
        if not self.collect:
            device = resolve_device(self.device)
            shard = parse_shard(self.shard)
            run_battery(
                cases,
                self.out,
                shard=shard,
                jobs=max(self.jobs, 1),
                device=device,
                keep=self.keep,
                limit_s=self.limit_s,
            )
        results = collect(self.out)
        if not results:
            raise ValueError(f"{self.out} holds no results; run the battery without --collect first")
        write_json(self.out / "summary.json", summary(results))
        write_text(self.out / "summary.md", markdown(results))
        print(markdown(results))
        return 0


Command = (
    Annotated[SimCommand, tyro.conf.subcommand("sim")]
    | Annotated[PhysicsCommand, tyro.conf.subcommand("physics")]
    | Annotated[DepthCommand, tyro.conf.subcommand("depth")]
    | Annotated[StudentCommand, tyro.conf.subcommand("student")]
    | Annotated[GapCommand, tyro.conf.subcommand("gap")]
    | Annotated[ReplayCommand, tyro.conf.subcommand("replay")]
)


@interrupt.command("vd-bench")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``vd-bench``; returns the exit status."""
    command = tyro.cli(Command, args=arguments, prog="vd-bench", description=__doc__)
    if isinstance(command, GapCommand):
        check_folder(command.out)
    elif not isinstance(command, ReplayCommand) and command.json is not None:
        check_file(command.json)
    return command.run()


if __name__ == "__main__":
    sys.exit(main())
