"""vd-assets: name and import hands, author objects, import meshes, draw contact sheets."""

import statistics
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from vd.assets_usd.objects.settings import ImportSettings
from vd.command import interrupt
from vd.command.files import check_file, check_folder
from vd.command.line import parse

if TYPE_CHECKING:
    from vd.assets_usd.objects.importer import ImportResult

WORST_SHOWN = 3
"""Objects named in the summary as having the largest volume error."""


@dataclass(frozen=True)
class Hand:
    """Say where the USD files of hands are."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Hands; those of the package by default."""

    def run(self) -> int:
        """Name files."""
        from vd.assets_usd.hands import HANDS, hand_usd

        for name in self.names or HANDS:
            print(hand_usd(name))
        return 0


@dataclass(frozen=True)
class HandImport:
    """Import a hand from a URDF or MJCF; `vd-assets hand import FILE` is the same.

    Fixed joints are welded; fingers, tips and palm are found, and what the file does not say is
    guessed and printed. Beside the USD lies a picture, <name>.png. Commands then take the hand by
    its name.
    """

    file: tyro.conf.Positional[Path]
    """URDF or MJCF, with its meshes where it says."""
    describe: str | None = None
    """YAML with what the file does not say, or the name of a built-in one: leap, leap_left,
    allegro."""
    out: Path | None = None
    """Folder to write to; by default one of the asset cache, named after the hand."""
    bowl: bool = True
    """Choose the start pose of a palm that looks up, where none is described: dropped cubes stay in
    it. It takes one or two minutes."""

    def run(self) -> int:
        """Import a hand."""
        from vd.assets_usd.hand_import.importer import import_hand
        from vd.assets_usd.hand_import.sheet import hand_sheet, joint_table
        from vd.evaluate.bowl import share_kept

        def told(start: Path) -> float:
            share = share_kept(start)
            print(f"start pose: {share:.0%} of dropped cubes stay", flush=True)
            return share

        done = import_hand(self.file, self.out, self.describe, told if self.bowl else None)
        print("\n".join([*done.notes, *(f"warning: {text}" for text in done.warnings)]))
        print(joint_table(done.hand, done.sources))
        hand_sheet(done.hand, done.sources, done.hand.path.with_suffix(".png"))
        print(f"{done.hand.path}; look at {done.hand.path.with_suffix('.png').name} beside it")
        return 0


@dataclass(frozen=True)
class Import:
    """Import meshes (OBJ, STL, PLY, GLB, USD): repair, scale, decompose, one USD per object.

    A mesh is scaled as little as makes it fit the hand, for D'Claws: longest side 0.095-0.165 m,
    mean width at most 0.13 m, shortest side at least 0.025 m where the others let it. An object is
    called like its file, or like the nearest folder that says something if the file's name does
    not (mug/meshes/model.obj: mug). An import that was interrupted goes on where it stopped. The
    exit status is 1 if any mesh was refused.
    """

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Mesh files, or folders to search for them."""
    out: Path | None = None
    """Folder to write to; by default a set in the asset cache, named after the folder of the
    meshes.
    """
    settings: tyro.conf.OmitArgPrefixes[ImportSettings] = field(default_factory=ImportSettings)
    """Unit, size, mass and parts of the objects."""
    jobs: int = 0
    """Meshes at a time; 0: one per core."""

    def run(self) -> int:
        """Import meshes; returns 1 if any was refused."""
        from tqdm import tqdm

        from vd.assets_usd.objects.importer import ImportResult, import_meshes
        from vd.assets_usd.objects.plan import default_set

        if not self.paths:
            raise ValueError("name the mesh files, or folders of them, to import")
        out = self.out or default_set(self.paths)
        start = time.monotonic()
        try:
            with tqdm(desc="importing", unit="object", mininterval=0.5) as bar:

                def advance(result: ImportResult, done: int, total: int) -> None:
                    bar.total = total
                    bar.set_postfix_str(result.job.name, refresh=False)
                    bar.update()

                results = import_meshes(
                    self.paths, out, self.settings, jobs=self.jobs, progress=advance
                )
        except KeyboardInterrupt:
            print(
                f"\ninterrupted; what is finished is in {out}; the same command goes on from there",
                file=sys.stderr,
            )
            return interrupt.INTERRUPTED
        print(_summary(results, out, time.monotonic() - start))
        return 1 if any(r.status == "refused" for r in results) else 0


@dataclass(frozen=True)
class Show:
    """Draw a contact sheet of object sets: each mesh beside its convex parts."""

    sets: tyro.conf.Positional[tuple[str, ...]]
    """Folders, object files or set names (cube, procedural-150-seed0, ...)."""
    out: Path = Path("sheet.png")
    """PNG to write."""

    def run(self) -> int:
        """Draw a contact sheet."""
        from vd.assets_usd.objects.sets import load_set
        from vd.assets_usd.objects.sheet import contact_sheet

        title = ", ".join(Path(name).name for name in self.sets)
        print(contact_sheet(load_set(self.sets), self.out, title))
        return 0


Command = (
    Annotated[Hand, tyro.conf.subcommand("hand")]
    | Annotated[HandImport, tyro.conf.subcommand("hand-import")]
    | Annotated[Import, tyro.conf.subcommand("import")]
    | Annotated[Show, tyro.conf.subcommand("show")]
)


def _summary(results: "list[ImportResult]", out: Path, seconds: float) -> str:
    """What became of an import, in a few lines."""
    count = Counter(result.status for result in results)
    refusals = []
    models = []
    for result in results:
        if result.model is None:
            refusals.append(f"refused {result.job.source}: {result.reason}")
        else:
            models.append(result.model)
    lines = [
        f"{count['imported']} imported, {count['cached']} unchanged, {count['refused']} refused in "
        f"{seconds:.0f} s; {out}"
    ]
    if models:
        hulls = statistics.mean(len(model.hulls) for model in models)
        errors = sorted(models, key=lambda model: -model.volume_error)[:WORST_SHOWN]
        worst = ", ".join(f"{model.name} {model.volume_error:.1%}" for model in errors)
        scaled = sum("scaled by" in " ".join(model.notes) for model in models)
        lengths = sorted(model.longest_side for model in models)
        masses = sorted(model.mass_kg for model in models)
        lines += [
            f"{hulls:.1f} convex parts on average; largest volume error of parts: {worst}",
            f"longest side {lengths[0]:.3g} to {lengths[-1]:.3g} m ({scaled} of {len(models)} "
            f"scaled), mass {masses[0]:.3g} to {masses[-1]:.3g} kg",
        ]
    for model in models:
        lines += [f"warning {model.name}: {text}" for text in model.warnings]
    return "\n".join([*lines, *refusals])


@interrupt.command("vd-assets")
def main() -> int:
    """Run ``vd-assets``; returns the exit status."""
    words = sys.argv[1:]
    if words[:2] == ["hand", "import"]:
        words[:2] = ["hand-import"]
    command = parse(Command, words, prog="vd-assets", description=__doc__)
    if isinstance(command, Show):
        check_file(command.out)
    elif isinstance(command, Import | HandImport) and command.out is not None:
        check_folder(command.out)
    return command.run()


if __name__ == "__main__":
    sys.exit(main())
