"""``vd-bench``: measure speed, physics, depth, student and gap workflow; rates are ratios within one run."""

import dataclasses
import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from vd import interrupt
from vd.device import resolve_device
from vd.files import check_file, check_folder
from vd.warp_quiet import quiet_warp


@dataclass(frozen=True)
class SimCommand:
    """Control steps per second, memory and start-up of the simulation under a policy's actions."""

    envs: tuple[int, ...] = (4096, 8192, 16384)
    """World counts to measure."""
    objects: tuple[str, ...] = ("procedural-150-seed0",)
    """Object sets, mixed over the environments."""
    hand: str = "dclaw4"
    """Hand."""
    device: str = "auto"
    """Warp device; auto is the first GPU, or else the CPU."""
    randomise: Annotated[bool, tyro.conf.FlagCreatePairsOff] = True
    """Domain randomisation on."""
    policy: str | None = None
    """Name or file of a teacher whose mean actions are taken, in the task it was trained in (hand and
    randomisation are then that task's); by default a network with random weights closes the hand now and
    then."""
    kernels: int = 0
    """On a GPU list as many kernels, those that take the most time of a control step."""
    allegro: Annotated[bool, tyro.conf.FlagCreatePairsOff] = True
    """Also step Newton's own Allegro example at the same world counts, with a hand of boxes of that size."""
    fetch_allegro: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Let Newton download that example's own hand (17.8 MB) in place of the boxes."""
    allegro_file: Path | None = None
    """URDF of an Allegro hand for that example in place of its asset."""
    json: Path | None = None
    """Write the rows to this file as JSON."""

    def run(self) -> int:
        """Measure and print."""
        import warp as wp

        from vd.bench.allegro import allegro_rate
        from vd.bench.sim import measure, task, teacher_task
        from vd.evaluate.agents import find_policy
        from vd.policy import load_policy

        quiet_warp()
        device = resolve_device(self.device)
        teacher = None if self.policy is None else load_policy(find_policy(self.policy), device)
        rows: list[dict[str, Any]] = []
        for envs in self.envs:
            if teacher is None:
                cfg = task(self.objects, envs, self.hand, self.randomise)
            else:
                cfg = teacher_task(teacher, self.objects, envs)
            row = measure(cfg, device, teacher=teacher)
            record: dict[str, Any] = dataclasses.asdict(row)
            record["kernels"] = record["kernels"][: self.kernels]
            substeps = cfg.sim.substeps
            if self.allegro:
                try:
                    beside = allegro_rate(envs, device, file=self.allegro_file, fetch=self.fetch_allegro)
                    record["allegro_hand"] = beside.hand
                    record["allegro_physics_steps_s"] = beside.physics_steps_s
                    record["allegro_dt_s"] = beside.dt_s
                    record["physics_steps_over_allegro"] = (
                        row.physics_only * substeps / beside.physics_steps_s
                    )
                except RuntimeError as error:
                    record["allegro"] = str(error)
            rows.append(record)
            print(json.dumps(record), flush=True)
        if self.json:
            from vd.files import write_json

            write_json(self.json, {"device": str(wp.get_device(device).name), "rows": rows})
        return 0


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
        from vd.assets_usd.objects.sets import load_set
        from vd.bench.physics import bounce, pinch, rest, slide
        from vd.sim.cfg import SimCfg

        quiet_warp()
        cfg = SimCfg()
        results = rest(load_set(list(self.objects)), cfg, device=self.device, seed=self.seed)
        moving = [r for r in results if not r.rests]
        held = pinch(load_set("cube")[0], cfg, device=self.device)
        measured, coulomb = slide(cfg, device=self.device)
        report = {
            "objects": len(results),
            "at_rest_share": 1.0 - len(moving) / len(results),
            "deepest_contact_m": max(r.penetration for r in results),
            "moving": [dataclasses.asdict(r) for r in moving],
            "pinch": dataclasses.asdict(held),
            "slide_m": measured,
            "slide_coulomb_m": coulomb,
            "slide_bouncing_m": slide(cfg, device=self.device, restitution=1.0)[0],
            "bounce": [dataclasses.asdict(bounce(cfg, e, device=self.device)) for e in RESTITUTIONS],
        }
        print(json.dumps(report, indent=1))
        if self.json:
            from vd.files import write_json

            write_json(self.json, report)
        return 0


@dataclass(frozen=True)
class DepthCommand:
    """Depth images and clouds per second, beside Newton's camera at the same size in the same run."""

    envs: tuple[int, ...] = (256, 1024, 4096)
    """World counts to measure; 1 for the figure at deployment on a CPU."""
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
        import warp as wp

        from vd.assets_usd.objects.sets import load_set
        from vd.bench.depth import measure
        from vd.files import write_json

        quiet_warp()
        device = resolve_device(self.device)
        objects = load_set(list(self.objects))
        rows: list[dict[str, Any]] = []
        for envs in self.envs:
            row = dataclasses.asdict(measure(objects, envs, device, hand=self.hand, seed=self.seed))
            rows.append(row)
            print(json.dumps(row), flush=True)
            if self.json:  # after each row: a later one may not fit the device
                write_json(self.json, {"device": str(wp.get_device(device).name), "rows": rows})
        return 0


@dataclass(frozen=True)
class StudentCommand:
    """Latency of a camera policy's control step on the CPU, and on a GPU a student's clouds per second."""

    networks: tuple[str, ...] = ("lean", "paper")
    """Presets to measure; for the latency also camera policies, installed ones by name, or their files."""
    objects: tuple[str, ...] = ("procedural-150-seed0",)
    """Object sets."""
    hand: str = "dclaw4"
    """Hand."""
    device: str = "auto"
    """Device of the training rows: auto is the first GPU, none without one; cpu for a few clouds there."""
    threads: int = 2
    """Threads of torch for the latency on the CPU."""
    half: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Encoder in bfloat16 for the latency: for processors that multiply in it."""
    calls: int = 300
    """Control steps to time; 0 leaves the latency out."""
    envs: tuple[int, ...] = (10, 40)
    """Sequences of a minibatch, 80 steps each."""
    seed: int = 0
    """Of poses and weights."""
    json: Path | None = None
    """Write the rows to this file as JSON."""

    def run(self) -> int:
        """Measure and print."""
        from vd.evaluate.agents import find_policy
        from vd.vision.cfg import PRESETS

        presets = [name for name in self.networks if name in PRESETS]
        for name in (name for name in self.networks if name not in presets):
            try:
                find_policy(name)
            except FileNotFoundError as error:
                raise ValueError(
                    f"--networks {name}: no such preset or policy; choose of {', '.join(PRESETS)}, or give "
                    "a camera policy"
                ) from error
        import warp as wp

        from vd.assets_usd.objects.sets import load_set
        from vd.bench.student import measure_latency, measure_training
        from vd.files import write_json

        quiet_warp()
        device = resolve_device(self.device)
        objects = load_set(list(self.objects))
        rows: dict[str, list[dict[str, Any]]] = {"latency": [], "training": []}

        def add(kind: str, row: Any) -> None:
            rows[kind].append(dataclasses.asdict(row))
            print(json.dumps(rows[kind][-1]), flush=True)
            if self.json:  # after each row: a later one may not fit the device
                write_json(self.json, {"device": str(wp.get_device(device).name), **rows})

        for name in self.networks if self.calls else ():
            add(
                "latency",
                measure_latency(
                    objects,
                    name,
                    hand=self.hand,
                    threads=self.threads,
                    half=self.half,
                    calls=self.calls,
                    seed=self.seed,
                ),
            )
        training = device != "cpu" or self.device == "cpu"
        for name in presets if training else ():
            for envs in self.envs:
                for half in (True, False):
                    row = measure_training(
                        objects, name, device, hand=self.hand, envs=envs, half=half, seed=self.seed
                    )
                    add("training", row)
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
        from vd.sim.replay import replay

        quiet_warp()
        for line in replay(self.dump, device=self.device):
            print(line)
        return 0


@dataclass(frozen=True)
class GapCommand:
    """The battery of vd-gap: effects hidden in recordings, found or not, and the figures of the goals.

    One result file per case: run it again to go on, give --shard on each machine, then --merge and --collect
    for the figures. rows.csv has all results in little space, to go on from elsewhere or later.
    """

    out: Path = Path("runs/gap-battery")
    """Folder of the results, of all in one table (rows.csv), figures (summary.json) and tables."""
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
    pair_size: int = 2
    """Size of both effects of a pair."""
    shard: str = "1/1"
    """Part i/n of the cases, for n machines."""
    backwards: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Begin with the last case: two machines meet wherever they are when the time is over."""
    merge: tuple[Path, ...] = ()
    """Results from elsewhere, folders or their rows.csv: their cases are not run again."""
    jobs: int = 1
    """Cases at a time, one process and one thread each."""
    limit_s: float = 1800.0
    """Longest time of a case [s]; one that takes longer has failed."""
    stop_after_s: float = math.inf
    """Time [s] after which to end, with the figures of what is done; run it again to go on."""
    device: str = "cpu"
    """Warp device."""
    collect: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Run nothing; figures of the results that are there."""
    keep: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Keep recordings and analyses."""

    def run(self) -> int:
        """Run the cases, then write and print the tables."""
        from vd.bench.gap import battery, collect, parse_shard, run_battery, take_over
        from vd.bench.gap_rows import write_rows
        from vd.bench.gap_score import markdown, summary
        from vd.files import make_folder, write_json, write_text

        cases = battery(
            self.model,
            kinds=self.kinds,
            effects=self.effects,
            sizes=self.sizes,
            seeds=self.seeds,
            first_seed=self.first_seed,
            nothing=self.nothing,
            pairs=self.pairs,
            pair_size=self.pair_size,
        )
        if self.merge:
            make_folder(self.out)
            print(f"{take_over(self.merge, self.out)} results taken over")
        if not self.collect:
            device = resolve_device(self.device)
            shard = parse_shard(self.shard)
            run_battery(
                cases,
                self.out,
                shard=shard,
                backwards=self.backwards,
                jobs=max(self.jobs, 1),
                device=device,
                keep=self.keep,
                limit_s=self.limit_s,
                stop_after_s=self.stop_after_s,
            )
        results = collect(self.out)
        if not results:
            raise ValueError(f"{self.out} holds no results; run the battery without --collect first")
        write_rows(self.out / "rows.csv", results)
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
def main() -> None:
    """Entry point of ``vd-bench``."""
    command = tyro.cli(Command, prog="vd-bench", description=__doc__)
    try:
        if isinstance(command, GapCommand):
            check_folder(command.out)
        elif not isinstance(command, ReplayCommand) and command.json is not None:
            check_file(command.json)
        sys.exit(command.run())
    except (ValueError, OSError) as error:
        sys.exit(f"vd-bench: {error}")


if __name__ == "__main__":
    main()
