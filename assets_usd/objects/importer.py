"""Import of meshes: one child process a mesh, cached by content, resumable, with refusals by name."""

import csv
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vd.assets_usd.objects.decompose import DecomposeSettings, decompose, relative_volume_error, tidy_hulls
from vd.assets_usd.objects.geometry import Hull, cluster_vertices, surface_points
from vd.assets_usd.objects.meshes import (
    MESH_SUFFIXES,
    MeshError,
    RepairedMesh,
    check_file,
    choose_scale,
    load_mesh,
    mean_width,
    repair_mesh,
    solid_of,
)
from vd.assets_usd.objects.model import SURFACE_POINTS, build_model, read_hash, read_object, write_object
from vd.files import atomic_path, make_folder

IMPORT_VERSION = 4
"""Part of every content hash: raise it when the import computes something else."""

DECOMPOSITION_VERSION = 3
"""Part of the key of every cached decomposition: raise it when the parts of the same scaled mesh differ."""

MAX_VISUAL_FACES = 3000
"""Faces of the visual mesh: files stay below 40 kB, and no picture here shows more."""

FINER_ABOVE, FINER_THRESHOLD = 0.25, 0.4
"""Above this volume error (thin walls, mostly), CoACD runs again with its threshold times this factor."""

WORKER_ATTEMPTS, WORKER_OVERHEAD_S = 4, 120.0
"""Runs of CoACD a child may need, and the time it gets beside them before it is killed."""

Status = Literal["imported", "cached", "refused"]


@dataclass(frozen=True)
class ImportSettings:
    """Settings of an import.

    Attributes:
        decompose: Convex decomposition.
        licence: Licence recorded where no ``objects.csv`` names one.
        split: Split recorded where no ``objects.csv`` names one.
        cache: Folder of finished decompositions; none if empty.
    """

    decompose: DecomposeSettings = field(default_factory=DecomposeSettings)
    licence: str = "unknown"
    split: str = ""
    cache: str = ""


@dataclass(frozen=True)
class Job:
    """One mesh to import.

    Attributes:
        source: Mesh file.
        name: Object name.
        target: USD file to write.
        licence: Licence of the shape.
        provenance: Where the shape comes from.
        split: ``train``, ``test`` or empty.
    """

    source: str
    name: str
    target: str
    licence: str
    provenance: str
    split: str


@dataclass(frozen=True)
class ImportResult:
    """What became of one mesh.

    Attributes:
        source: Mesh file.
        name: Object name.
        status: ``imported``, ``cached`` (nothing to do) or ``refused``.
        reason: Why it was refused.
        target: USD file, empty if refused.
        seconds: Time of the import.
        hulls: Number of convex parts.
        volume_error: Relative volume error of the parts.
        longest_side_m: Longest side.
        decomposed: Whether CoACD ran.
        notes: Repairs and assumptions.
    """

    source: str
    name: str
    status: Status
    reason: str = ""
    target: str = ""
    seconds: float = 0.0
    hulls: int = 0
    volume_error: float = 0.0
    longest_side_m: float = 0.0
    decomposed: bool = False
    notes: tuple[str, ...] = ()


def prim_name(stem: str) -> str:
    """A valid prim name from a file's stem: letters, digits and underscores, no leading digit."""
    name = re.sub(r"[^0-9A-Za-z_]+", "_", stem).strip("_") or "object"
    return name if not name[0].isdigit() else f"o_{name}"


def find_meshes(paths: Iterable[Path]) -> list[Path]:
    """Mesh files among files and folders (searched in depth), each once, in a fixed order.

    A file that was named is kept whatever its suffix, so that it is refused by name; in a folder only
    the supported suffixes count.

    Raises:
        MeshError: A path does not exist, or nothing was found.
    """
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            found += sorted(p for p in path.rglob("*") if p.is_file() and p.suffix.lower() in MESH_SUFFIXES)
        elif path.exists():
            found.append(path)
        else:
            raise MeshError(f"{path}: no such file or folder")
    if not found:
        raise MeshError(f"no mesh in {', '.join(map(str, paths))}; supported: {', '.join(MESH_SUFFIXES)}")
    return list(dict.fromkeys(p.resolve() for p in found))


def read_sidecar(folder: Path) -> dict[str, dict[str, str]]:
    """Rows by name of the ``objects.csv`` in a folder or its parent; empty where there is none.

    Columns: ``name`` and ``source``; optionally ``licence`` and ``split``. Without a licence column,
    the licence is what stands in brackets in the source.
    """
    for table in (folder / "objects.csv", folder.parent / "objects.csv"):
        if table.is_file():
            with table.open(newline="") as stream:
                rows = list(csv.DictReader(stream))
            return {row["name"]: row for row in rows if row.get("name")}
    return {}


def plan_jobs(meshes: Iterable[Path], out: Path, settings: ImportSettings) -> list[Job]:
    """Name, target, licence and provenance of each mesh; equal names get a number."""
    jobs = []
    taken: set[str] = set()
    sidecars: dict[Path, dict[str, dict[str, str]]] = {}
    for mesh in meshes:
        base = name = prim_name(mesh.stem)
        number = 2
        while name.lower() in taken:
            name = f"{base}_{number}"
            number += 1
        taken.add(name.lower())
        if mesh.parent not in sidecars:
            sidecars[mesh.parent] = read_sidecar(mesh.parent)
        row = sidecars[mesh.parent].get(mesh.stem, {})
        source = row.get("source") or ""
        bracket = re.search(r"\(([^)]*)\)", source)
        licence = row.get("licence") or (bracket.group(1) if bracket else settings.licence)
        provenance = f"{source}: {mesh.name}" if source else mesh.name
        jobs.append(
            Job(
                str(mesh),
                name,
                str(out / f"{name}.usd"),
                licence,
                provenance,
                row.get("split") or settings.split,
            )
        )
    return jobs


def content_hash(job: Job, settings: ImportSettings) -> str:
    """Hash of all that decides the file: mesh bytes, name, licence, settings and code version."""
    digest = hashlib.sha256(Path(job.source).read_bytes())
    facts = [IMPORT_VERSION, job.name, job.licence, job.provenance, job.split, asdict(settings.decompose)]
    digest.update(json.dumps(facts, sort_keys=True).encode())
    return digest.hexdigest()


def _cached_hulls(path: Path) -> tuple[tuple[Hull, ...], str, tuple[str, ...]] | None:
    """Hulls, method and notes of an earlier decomposition."""
    if not path.is_file():
        return None
    with np.load(path) as data:
        count = int(data["count"])
        hulls = tuple(Hull(data[f"vertices_{i}"], data[f"faces_{i}"]) for i in range(count))
        return hulls, str(data["method"]), tuple(map(str, data["notes"]))


def _best_decomposition(
    mesh: RepairedMesh, volume: float, settings: DecomposeSettings
) -> tuple[tuple[Hull, ...], str, tuple[str, ...]]:
    """Hulls, method and notes; a bad volume error earns a second try at a finer threshold."""
    first = decompose(mesh.vertices, mesh.faces, settings)
    error = relative_volume_error(first.hulls, volume)
    if error > FINER_ABOVE:
        finer = replace(settings, threshold=settings.threshold * FINER_THRESHOLD)
        second = decompose(mesh.vertices, mesh.faces, finer)
        if relative_volume_error(second.hulls, volume) < error:
            return second.hulls, f"{second.method}, threshold {finer.threshold:g}", second.notes
    return first.hulls, first.method, first.notes


def import_mesh(job: Job, settings: ImportSettings) -> ImportResult:
    """Import one mesh in this process (CoACD runs in a child).

    Raises:
        MeshError: The mesh is refused; the message is the reason.
    """
    mesh = repair_mesh(load_mesh(Path(job.source)))
    notes = list(mesh.notes)
    scale, note = choose_scale(np.ptp(mesh.vertices, axis=0), mean_width(mesh.vertices))
    if note:
        notes.append(note)
    mesh = mesh.scaled(scale)
    solid, method = solid_of(mesh)
    if not solid.volume > 0.0:
        raise MeshError("degenerate: encloses no volume")

    key = hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes())
    key.update(json.dumps([DECOMPOSITION_VERSION, asdict(settings.decompose)], sort_keys=True).encode())
    cache = Path(settings.cache) / f"{key.hexdigest()}.npz" if settings.cache else None
    whole = 0 < len(mesh.pieces) <= settings.decompose.max_hulls
    cached = None if whole or cache is None else _cached_hulls(cache)
    hulls: tuple[Hull, ...]
    way: str
    more: tuple[str, ...] = ()
    if whole:
        limit = settings.decompose.max_hull_vertices
        hulls, way = tidy_hulls([p.vertices for p in mesh.pieces], limit), "convex pieces"
    elif cached:
        hulls, way, more = cached
    else:
        hulls, way, more = _best_decomposition(mesh, solid.volume, settings.decompose)
        # A fallback forced by the clock may not be needed next time: only full results are kept.
        if cache and not more:
            arrays: dict[str, Any] = {"count": len(hulls), "method": way, "notes": np.array(more, dtype=str)}
            for i, hull in enumerate(hulls):
                arrays |= {f"vertices_{i}": hull.vertices, f"faces_{i}": hull.faces}
            with atomic_path(cache) as temporary:
                np.savez(temporary, **arrays)
    notes += more
    points = surface_points(mesh.vertices, mesh.faces, SURFACE_POINTS)
    visual = cluster_vertices(mesh.vertices, mesh.faces, MAX_VISUAL_FACES)
    model = build_model(
        job.name,
        *visual,
        hulls,
        solid,
        points,
        licence=job.licence,
        source=job.provenance,
        family="imported",
        split=job.split,
        scale=scale,
        volume_error=relative_volume_error(hulls, solid.volume),
        volume_method=f"{way}; union of hulls by voxels against {method}",
        content_hash=content_hash(job, settings),
        notes=tuple(notes),
    )
    write_object(Path(job.target), model)
    return ImportResult(
        job.source,
        job.name,
        "imported",
        target=job.target,
        hulls=len(hulls),
        volume_error=model.volume_error,
        longest_side_m=model.longest_side,
        decomposed=not whole and cached is None,
        notes=tuple(notes),
    )


def _run_child(
    job: Job, settings: ImportSettings, threads: int, running: dict[str, subprocess.Popen[str]]
) -> ImportResult:
    """Import one mesh in a child of its own, killed past the time limit."""
    import time

    start = time.monotonic()

    def refused(reason: str) -> ImportResult:
        return ImportResult(job.source, job.name, "refused", reason, seconds=time.monotonic() - start)

    limit = WORKER_ATTEMPTS * settings.decompose.time_limit_s + WORKER_OVERHEAD_S
    environment = os.environ | {"OMP_NUM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": "1"}
    request = json.dumps({"job": asdict(job), "settings": asdict(settings)})
    with tempfile.TemporaryFile("w+") as errors:
        # A session of its own: Ctrl-C reaches the parent alone, which then ends the children in order.
        child = subprocess.Popen(
            [sys.executable, "-m", "vd.assets_usd.objects.import_worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            start_new_session=True,
            env=environment,
        )
        running[job.name] = child
        try:
            output, _ = child.communicate(request, timeout=limit)
        except subprocess.TimeoutExpired:
            return refused(f"no result after {limit:g} s")
        finally:
            _end_group(child)
            running.pop(job.name, None)
        lines = output.strip().splitlines()
        if child.returncode != 0 or not lines:
            errors.seek(0)
            tail = errors.read().strip().splitlines()[-1:] or ["no message"]
            return refused(f"the import ended with exit code {child.returncode}: {tail[0]}")
    answer = json.loads(lines[-1])
    answer["notes"] = tuple(answer["notes"])
    return replace(ImportResult(**answer), seconds=time.monotonic() - start)


def _end_group(child: subprocess.Popen[str]) -> None:
    """Kill a child and what it started."""
    import contextlib

    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.pid, signal.SIGKILL)
    child.wait()


def import_meshes(
    paths: Iterable[Path],
    out: Path,
    settings: ImportSettings | None = None,
    *,
    jobs: int = 0,
    force: bool = False,
    progress: Callable[[ImportResult, int, int], None] | None = None,
) -> list[ImportResult]:
    """Import meshes, several at a time, each in a process of its own.

    An object file whose content hash still holds is left alone, and finished decompositions are
    kept, so that an interrupted import goes on where it stopped.

    Args:
        paths: Files and folders.
        out: Folder of the object files.
        settings: Settings; the defaults if None.
        jobs: Meshes at a time; 0 takes the machine's cores.
        force: Write every file anew (kept decompositions are still used).
        progress: Called after each mesh with its result, the number done and the number of all.

    Returns:
        One result per mesh, in the order of the meshes.

    Raises:
        MeshError: A path does not exist or holds no mesh.
    """
    settings = settings or ImportSettings()
    out = Path(out)
    make_folder(out)
    plan = plan_jobs(find_meshes([Path(p) for p in paths]), out, settings)
    cores = os.cpu_count() or 1
    workers = min(jobs or cores, len(plan))
    results: dict[str, ImportResult] = {}

    def finish(result: ImportResult) -> None:
        results[result.name] = result
        if progress:
            progress(result, len(results), len(plan))

    todo = []
    for job in plan:
        target = Path(job.target)
        try:
            check_file(Path(job.source))
        except MeshError as error:
            finish(ImportResult(job.source, job.name, "refused", str(error)))
            continue
        if not force and target.is_file() and read_hash(target) == content_hash(job, settings):
            model = read_object(target)
            finish(
                ImportResult(
                    job.source,
                    job.name,
                    "cached",
                    target=job.target,
                    hulls=len(model.hulls),
                    volume_error=model.volume_error,
                    longest_side_m=model.longest_side,
                    notes=model.notes,
                )
            )
        else:
            todo.append(job)
    running: dict[str, subprocess.Popen[str]] = {}
    with ThreadPoolExecutor(max(workers, 1)) as pool:
        pending: set[Future[ImportResult]] = {
            pool.submit(_run_child, job, settings, max(cores // workers, 1), running) for job in todo
        }
        try:
            while pending:
                done, pending = wait(pending, return_when=FIRST_COMPLETED)
                for future in done:
                    finish(future.result())
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in list(running.values()):
                _end_group(child)
            raise
    return [results[job.name] for job in plan]
