"""``vd-assets``: author hands, author objects, import meshes, draw contact sheets."""

import json
import re
import sys
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from vd import interrupt
from vd.files import check_file, check_folder

if TYPE_CHECKING:
    from vd.assets_usd.objects.importer import ImportResult

WORST_SHOWN = 3
"""Objects named in the summary as having the largest volume error."""


@dataclass(frozen=True)
class Hand:
    """Author the D'Claw hands in USD."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Hands to author; all of them by default."""
    out: Path | None = None
    """Folder to write to; the asset cache by default."""
    json: bool = False
    """Print the paths as JSON."""


@dataclass(frozen=True)
class Objects:
    """Author our own objects: a procedural set, or the symmetric solids."""

    procedural: int = 150
    """Number of procedural objects."""
    seed: int = 0
    """Seed of the set; equal seeds give equal objects."""
    held_out: bool = False
    """Take the held-out families, which share no kind with the training families."""
    symmetric: bool = False
    """Author the cube and the cuboid in place of a procedural set."""
    out: Path | None = None
    """Folder to write to; by default the named set in the asset cache (such as procedural-150-seed0)."""
    json: bool = False
    """Print folder and objects as JSON."""


@dataclass(frozen=True)
class Import:
    """Import meshes (OBJ, STL, PLY, GLB, USD): repair, scale, decompose, one USD per object.

    A mesh is scaled as little as makes it fit the hand: longest side 0.095-0.165 m, mean width at most
    0.13 m, shortest side at least 0.025 m where the others let it. An object is called like its file, or
    like the nearest folder that says something if the file's name does not (mug/meshes/model.obj: mug).
    An import that was interrupted goes on where it stopped. The exit status is 1 if any mesh was refused.
    """

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Mesh files, or folders to search for them."""
    out: Path | None = None
    """Folder to write to; by default a set in the asset cache, named after the folder of the meshes."""
    units: Literal["auto", "mm", "cm", "m", "in"] = "auto"
    """Unit of the meshes. auto: what the file declares (GLB, USD), else m, mm or cm, whichever needs the
    least rescaling. Inches are never guessed."""
    keep_size: bool = False
    """Keep the real size, also of what does not fit the hand. The unit must be known."""
    density: float | None = None
    """Density that gives each object its mass [kg/m3]; plastic has about 1000, aluminium 2700, steel 7850."""
    mass: float | None = None
    """Mass of each object [kg]; without this and --density 0.1. Training draws masses of its own unless its
    randomisation is off."""
    drop_gone: bool = False
    """Remove from the set the objects whose mesh file is gone. Without it they stay, and are named."""
    jobs: int = 0
    """Meshes at a time; 0: one per core."""
    force: bool = False
    """Write every object anew, even if nothing has changed."""
    max_hulls: int = 32
    """Most convex parts per object. Eight are tried first, and more where these are off by more than 15 %."""
    threshold: float = 0.08
    """CoACD's concavity threshold, 0.01-1: smaller is finer and slower."""
    mcts_iterations: int = 20
    """CoACD's search effort; more is finer and slower."""
    max_hull_vertices: int = 32
    """Most vertices per part."""
    time_limit: float = 120.0
    """Processor time [s] of one decomposition, after which a mesh falls back to a coarser one."""
    licence: str = "unknown"
    """Licence to record where no objects.csv (columns name, source) lies with the meshes."""
    split: str = ""
    """Split to record, such as train or test, where no objects.csv names one."""
    json: bool = False
    """Print one record per mesh as JSON."""


@dataclass(frozen=True)
class Show:
    """Draw a contact sheet of object sets: each mesh beside its convex parts."""

    sets: tyro.conf.Positional[tuple[str, ...]]
    """Folders, object files or set names (cube, procedural-150-seed0, ...)."""
    out: Path = Path("sheet.png")
    """PNG to write."""
    tile: int = 170
    """Side of one picture, pixels."""
    columns: int = 0
    """Objects per row; 0: about as wide as high."""
    common_scale: bool = False
    """Draw all objects at the same scale."""
    limit: int = 0
    """Draw only the first so many objects; 0: all."""
    title: str = ""
    """Headline; the names of the sets by default."""


Command = (
    Annotated[Hand, tyro.conf.subcommand("hand")]
    | Annotated[Objects, tyro.conf.subcommand("objects")]
    | Annotated[Import, tyro.conf.subcommand("import")]
    | Annotated[Show, tyro.conf.subcommand("show")]
)


@dataclass
class _Bar:
    """Progress bar on standard error; nothing where that is no terminal and ``json`` is asked for."""

    total_label: str
    bar: Any = field(default=None, init=False)

    def __call__(self, name: str, done: int, total: int) -> None:
        if self.bar is None:
            from tqdm import tqdm

            self.bar = tqdm(total=total, desc=self.total_label, unit="object", mininterval=0.5)
        self.bar.set_postfix_str(name, refresh=False)
        self.bar.update(done - self.bar.n)
        if done == total:
            self.bar.close()

    def write(self, line: str) -> None:
        """Print a line above the bar."""
        self.bar.write(line, file=sys.stderr)


def run_hand(command: Hand) -> int:
    """Author hands."""
    from vd.assets_usd.hand_author import hand_usd
    from vd.assets_usd.hand_spec import HANDS
    from vd.files import write_text

    unknown = [name for name in command.names if name not in HANDS]
    if unknown:
        print(f"no hand named {', '.join(unknown)}; there are: {', '.join(HANDS)}", file=sys.stderr)
        return 2
    paths = {}
    for name in command.names or tuple(HANDS):
        path = hand_usd(name)
        if command.out is not None:
            path, text = command.out / path.with_stem(name).name, path.read_text()
            if path.exists() and path.read_text(errors="replace") != text:
                raise ValueError(f"{path} is there and another hand; write to another folder (--out)")
            write_text(path, text)
        paths[name] = str(path)
    print(json.dumps(paths, indent=1) if command.json else "\n".join(paths.values()))
    return 0


def run_objects(command: Objects) -> int:
    """Author procedural or symmetric objects."""
    from vd.assets_usd.objects import procedural, sets

    if command.symmetric:
        name, models = "symmetric", [procedural.cube(), procedural.cuboid()]
    else:
        if command.procedural < 1 or command.seed < 0:
            print("--procedural must be at least 1 and --seed at least 0", file=sys.stderr)
            return 2
        name = f"procedural-{'heldout-' if command.held_out else ''}{command.procedural}-seed{command.seed}"
        models = procedural.procedural_set(
            command.procedural, command.seed, held_out=command.held_out, progress=_Bar("authoring")
        )
    folder = command.out or sets.built_in_folder(name)
    files = sets.write_set(folder, models)
    size = sum(p.stat().st_size for p in files)
    if command.json:
        rows = [
            {"name": m.name, "family": m.family, "hulls": len(m.hulls), "longest_side_m": m.longest_side}
            for m in models
        ]
        print(json.dumps({"folder": str(folder), "bytes": size, "objects": rows}, indent=1))
    else:
        print(f"{len(files)} objects, {size / 1e6:.1f} MB in {folder}")
    return 0


def run_import(command: Import) -> int:
    """Import meshes; returns 1 if any was refused."""
    from vd.assets_usd.cache import assets_dir
    from vd.assets_usd.objects.decompose import DecomposeSettings
    from vd.assets_usd.objects.importer import import_meshes
    from vd.assets_usd.objects.meshes import Sizing
    from vd.assets_usd.objects.plan import ImportSettings, default_set

    if not command.paths:
        raise ValueError("name the mesh files, or folders of them, to import")
    settings = ImportSettings(
        DecomposeSettings(
            max_hulls=command.max_hulls,
            threshold=command.threshold,
            mcts_iterations=command.mcts_iterations,
            max_hull_vertices=command.max_hull_vertices,
            time_limit_s=command.time_limit,
        ),
        licence=command.licence,
        split=command.split,
        cache=str(assets_dir() / "decompositions"),
        sizing=Sizing(command.units, command.keep_size, command.density, command.mass),
    )
    out = command.out or default_set(command.paths)
    bar = _Bar("importing")

    def progress(result: "ImportResult", done: int, total: int) -> None:
        bar(result.name, done, total)
        if result.status == "refused":
            bar.write(f"refused {result.source}: {result.reason}")

    start = time.monotonic()
    try:
        results = import_meshes(
            command.paths,
            out,
            settings,
            jobs=command.jobs,
            force=command.force,
            drop_gone=command.drop_gone,
            progress=progress,
        )
    except KeyboardInterrupt:
        print(
            f"\ninterrupted; what is finished is in {out}; the same command goes on from there",
            file=sys.stderr,
        )
        return interrupt.INTERRUPTED
    seconds = time.monotonic() - start
    if command.json:
        record = {"out": str(out), "seconds": seconds, "objects": [asdict(r) for r in results]}
        print(json.dumps(record, indent=1))
    else:
        print(_summary(results, out, seconds))
    return 1 if any(r.status == "refused" for r in results) else 0


def _summary(results: "list[ImportResult]", out: Path, seconds: float) -> str:
    """What became of an import, in a few lines."""
    by = {status: [r for r in results if r.status == status] for status in {r.status for r in results}}
    fresh, cached, refused = (by.get(status, []) for status in ("imported", "cached", "refused"))
    good = fresh + cached
    lines = [
        f"{len(fresh)} imported, {len(cached)} unchanged, {len(refused)} refused in {seconds:.0f} s; {out}"
    ]
    if good:
        size = sum(Path(r.target).stat().st_size for r in good)
        worst = sorted(good, key=lambda r: -r.volume_error)[:WORST_SHOWN]
        median = sorted(r.volume_error for r in good)[len(good) // 2]
        named = ", ".join(f"{r.name} {r.volume_error:.1%}" for r in worst)
        hulls = sum(r.hulls for r in good) / len(good)
        lines.append(f"{hulls:.1f} convex parts on average, {size / 1e6:.1f} MB")
        lines.append(f"volume error of the parts: median {median:.1%}, worst {named}")
        lines.append(_sizes(good))
    lines += [f"warning {r.name}: {words}" for r in good for words in r.warnings]
    lines += [f"refused {r.source}: {r.reason}" for r in refused]
    lines += [f"dropped {r.name}: its mesh {r.source} is gone" for r in by.get("dropped", [])]
    lines += [
        f"{r.name} stays in the set, although its mesh {r.source} is gone; --drop-gone removes it"
        for r in by.get("gone", [])
    ]
    return "\n".join(lines)


def _sizes(good: "list[ImportResult]") -> str:
    """Ranges of size and mass of objects, and how many were taken to be in which unit."""

    def span(values: list[float]) -> str:
        low, high = f"{min(values):.3g}", f"{max(values):.3g}"
        return low if low == high else f"{low}-{high}"

    notes = [note for r in good for note in r.notes]
    units = Counter(found[1] for note in notes if (found := re.search(r"taken as ([^,]+)", note)))
    units["m"] += len(good) - units.total()
    taken = ", ".join(f"{count} in {unit}" for unit, count in units.items() if count)
    scaled = sum("scaled by" in note for note in notes)
    return (
        f"longest side {span([r.longest_side_m for r in good])} m ({taken}; {scaled} of {len(good)} scaled), "
        f"mass {span([r.mass_kg for r in good])} kg"
    )


def run_show(command: Show) -> int:
    """Draw a contact sheet."""
    from vd.assets_usd.objects.sets import load_set
    from vd.assets_usd.objects.sheet import SheetStyle, contact_sheet

    models = load_set(command.sets)
    if command.limit:
        models = models[: command.limit]
    style = SheetStyle(tile=command.tile, columns=command.columns, common_scale=command.common_scale)
    title = command.title or ", ".join(Path(s).name for s in command.sets)
    print(contact_sheet(models, command.out, title=title, style=style, progress=_Bar("drawing")))
    return 0


@interrupt.command("vd-assets")
def main() -> None:
    """Entry point of ``vd-assets``."""
    command = tyro.cli(Command, prog="vd-assets", description=__doc__)
    try:
        if isinstance(command, Show):
            check_file(command.out)
        elif command.out is not None:
            check_folder(command.out)
        if isinstance(command, Hand):
            sys.exit(run_hand(command))
        if isinstance(command, Objects):
            sys.exit(run_objects(command))
        sys.exit(run_import(command) if isinstance(command, Import) else run_show(command))
    except (ValueError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
