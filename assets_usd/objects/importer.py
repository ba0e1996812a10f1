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

from vd.assets_usd.objects.bodies import PartsError, body_of, cavity_share
from vd.assets_usd.objects.decompose import (
    GOOD_ERROR,
    HANG_S,
    RUNS,
    DecomposeSettings,
    Decomposition,
    best_decomposition,
    tidy_hulls,
)
from vd.assets_usd.objects.geometry import Hull, cluster_vertices, surface_points, triangle_areas
from vd.assets_usd.objects.meshes import (
    MESH_SUFFIXES,
    MeshError,
    check_file,
    choose_scale,
    load_mesh,
    mean_width,
)
from vd.assets_usd.objects.model import SURFACE_POINTS, build_model, read_hash, read_object, write_object
from vd.assets_usd.objects.repair import repair_mesh
from vd.files import atomic_path, make_folder

IMPORT_VERSION = 5
"""Part of every content hash: raise it when the import computes something else."""

DECOMPOSITION_VERSION = 4
"""Part of the key of every cached decomposition: raise it when the parts of the same scaled mesh differ."""

MAX_VISUAL_FACES = 3000
"""Faces of the visual mesh: files stay below 40 kB, and no picture here shows more."""

MAX_ERROR, MAX_OFFSET = 1.0, 0.03
"""Parts are refused if they differ from the mesh by more than its volume, and are farther from its surface,
on average, than this share of the longest side: 4 mm of 13 cm, where fingertips have a radius of 10 mm. Of
thin walls the first alone says little: a wall of 1 mm that is 2 mm thick as parts differs by its volume."""

WORKER_OVERHEAD_S = 600.0
"""Wall-clock time that a child gets beside its runs of CoACD before it is taken to hang."""

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
        volume_error: Volume in which parts and object differ, as a share of the object's.
        longest_side_m: Longest side.
        decomposed: Whether CoACD ran.
        notes: Repairs and assumptions.
        warnings: What may be wrong with the object.
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
    warnings: tuple[str, ...] = ()


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


def _kept_decomposition(path: Path) -> Decomposition | None:
    """An earlier decomposition."""
    if not path.is_file():
        return None
    with np.load(path) as data:
        hulls = tuple(Hull(data[f"vertices_{i}"], data[f"faces_{i}"]) for i in range(int(data["count"])))
        return Decomposition(hulls, str(data["method"]), error=float(data["error"]))


def _keep_decomposition(path: Path, parts: Decomposition) -> None:
    """Keep a decomposition for a later import."""
    arrays: dict[str, Any] = {"count": len(parts.hulls), "method": parts.method, "error": parts.error}
    for i, hull in enumerate(parts.hulls):
        arrays |= {f"vertices_{i}": hull.vertices, f"faces_{i}": hull.faces}
    with atomic_path(path) as temporary:
        np.savez(temporary, **arrays)


def _parts_warnings(parts: Decomposition, offset: float) -> list[str]:
    """What has to be said of parts that are so far from the surface, on average, as a share of its length.

    Raises:
        MeshError: They are too far from the mesh.
    """
    words = "; ".join(parts.fallback)
    count = f"{len(parts.hulls)} convex part{'s' if len(parts.hulls) > 1 else ''}"
    off = f"{count} differ from the mesh by {100 * parts.error:.0f} % of its volume"
    if parts.error > MAX_ERROR and offset > MAX_OFFSET:
        raise MeshError(
            f"{off}, and are {100 * offset:.0f} % of its length off its surface on average"
            f"{f' ({words})' if words else ''}: thicken its walls, or allow finer parts (--threshold, "
            "--max-hulls)"
        )
    warnings = [f"fall-back, tried again at the next import: {words}"] if words else []
    return warnings + ([off] if parts.error > GOOD_ERROR else [])


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
    body = body_of(mesh)
    if not body.solid.volume > 0.0:
        raise MeshError("degenerate: encloses no volume")

    error_of = PartsError(body, mesh.vertices)
    key = hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes())
    key.update(json.dumps([DECOMPOSITION_VERSION, asdict(settings.decompose)], sort_keys=True).encode())
    cache = Path(settings.cache) / f"{key.hexdigest()}.npz" if settings.cache else None
    whole = 0 < len(mesh.pieces) <= settings.decompose.max_hulls
    kept = None if whole or cache is None else _kept_decomposition(cache)
    if whole:
        hulls = tidy_hulls([p.vertices for p in mesh.pieces], settings.decompose.max_hull_vertices)
        parts = Decomposition(hulls, "convex pieces", error=error_of(hulls))
    elif kept:
        parts = kept
    else:
        parts = best_decomposition(mesh.vertices, mesh.faces, settings.decompose, error_of)
        # A fall-back forced by a limit may not be needed next time: only full results are kept.
        if cache and not parts.fallback:
            _keep_decomposition(cache, parts)
    offset = parts.error * body.volume / triangle_areas(mesh.vertices, mesh.faces).sum()
    offset /= np.ptp(mesh.vertices, axis=0).max()
    warnings = (*mesh.warnings, *body.warnings, *_parts_warnings(parts, offset))
    points = surface_points(mesh.vertices, mesh.faces, SURFACE_POINTS)
    visual = cluster_vertices(mesh.vertices, mesh.faces, MAX_VISUAL_FACES)
    model = build_model(
        job.name,
        *visual,
        parts.hulls,
        body.solid,
        points,
        licence=job.licence,
        source=job.provenance,
        family="imported",
        split=job.split,
        scale=scale,
        volume_error=parts.error + cavity_share(mesh, body),
        volume_method=f"{parts.method}; volume in which parts and solid differ; solid: {body.method}",
        content_hash="" if parts.fallback else content_hash(job, settings),
        notes=tuple(notes),
        warnings=warnings,
    )
    write_object(Path(job.target), model)
    return ImportResult(
        job.source,
        job.name,
        "imported",
        target=job.target,
        hulls=len(parts.hulls),
        volume_error=model.volume_error,
        longest_side_m=model.longest_side,
        decomposed=not whole and kept is None,
        notes=model.notes,
        warnings=warnings,
    )


def _run_child(
    job: Job, settings: ImportSettings, threads: int, running: dict[str, subprocess.Popen[str]]
) -> ImportResult:
    """Import one mesh in a child of its own, killed if it hangs."""
    import time

    start = time.monotonic()

    def refused(reason: str) -> ImportResult:
        return ImportResult(job.source, job.name, "refused", reason, seconds=time.monotonic() - start)

    # A busy machine is no reason: processor time is limited, this only ends what hangs.
    limit = RUNS * HANG_S * settings.decompose.time_limit_s + WORKER_OVERHEAD_S
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
    answer |= {key: tuple(answer[key]) for key in ("notes", "warnings")}
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
                    warnings=model.warnings,
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
