"""The demo's import of meshes: the smallest first, for a share of its time."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from vd.train.demo_agents import progress_bar
from vd.train.demo_stages import TimeUp, time_limit

if TYPE_CHECKING:
    from vd.assets_usd.objects.importer import ImportResult

# Share of the time for importing meshes: enough for several, and training still gets past random actions.
IMPORT_SHARE = 0.15
# Search effort of the convex decomposition, a quarter of the default: a stapler took 8 s in place of 29 s of
# CPU time and an alarm clock 99 s in place of 142 s; the volume errors of their parts did not grow.
IMPORT_SEARCH = 5


def import_for(meshes: list[Path], out: Path, seconds: float) -> "dict[str, ImportResult]":
    """Import meshes in their order for a time; returns the results of those that were reached, by source."""
    from vd.assets_usd.cache import assets_dir
    from vd.assets_usd.objects.decompose import DecomposeSettings
    from vd.assets_usd.objects.importer import import_meshes
    from vd.assets_usd.objects.plan import ImportSettings

    results: dict[str, ImportResult] = {}
    with progress_bar("  importing", len(meshes), "mesh") as bar:

        def keep(result: "ImportResult", _done: int, _total: int) -> None:
            results[result.source] = result
            bar.update()
            if result.status == "refused":
                bar.write(f"  refused {result.source}: {result.reason}", file=sys.stderr)

        # Equal to those of vd-assets import, which then goes on from here.
        settings = ImportSettings(
            DecomposeSettings(mcts_iterations=IMPORT_SEARCH), cache=str(assets_dir() / "decompositions")
        )
        try:
            with time_limit(seconds):
                import_meshes(meshes, out, settings, progress=keep)
        except TimeUp:
            pass
    return results
