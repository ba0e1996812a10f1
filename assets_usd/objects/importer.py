"""Import of meshes: one child process a mesh, cached by content, resumable, with refusals by name."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Container, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vd.assets_usd.objects.decompose import DecomposeSettings, decompose, relative_volume_error, tidy_hulls
from vd.assets_usd.objects.geometry import Hull, cluster_vertices, surface_points
from vd.assets_usd.objects.meshes import MeshError, RepairedMesh, repair_mesh, solid_of
from vd.assets_usd.objects.model import (
    SURFACE_POINTS,
    ObjectModel,
    build_model,
    read_hash,
    read_object,
    write_object,
)
from vd.assets_usd.objects.plan import (
    ImportSettings,
    Job,
    check_target,
    find_meshes,
    gone_objects,
    plan_jobs,
)
from vd.assets_usd.objects.reading import declared_unit, load_mesh, mesh_kind
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

ENDING_S = 5.0
"""Time for a child to leave things in order before it is killed."""

Status = Literal["imported", "cached", "refused", "gone", "dropped"]


@dataclass(frozen=True)
class ImportResult:
    """What became of one mesh.

    Attributes:
        source: Mesh file.
        name: Object name.
        status: ``imported``, ``cached`` (nothing to do) or ``refused``; of an object whose mesh file is gone
            ``gone`` (it stays in the set) or ``dropped``.
        reason: Why it was refused.
        target: USD file, empty if refused.
        seconds: Time of the import.
        hulls: Number of convex parts.
        volume_error: Relative volume error of the parts.
        longest_side_m: Longest side.
        mass_kg: Mass.
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
    mass_kg: float = 0.0
    decomposed: bool = False
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def content_hash(job: Job, settings: ImportSettings) -> str:
    """Hash of all that decides the object: bytes of the mesh, name, licence, settings and code version."""
    files = [Path(job.source)]
    if mesh_kind(files[0]) == "usd":
        from vd.assets_usd.objects.usd_mesh import usd_files

        files = usd_files(files[0])
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files))
    how = [asdict(settings.decompose), asdict(settings.sizing)]
    facts = [IMPORT_VERSION, job.name, job.licence, job.provenance, job.split, how]
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
    scale, size_notes, size_warnings = settings.sizing.scale(mesh.vertices, declared_unit(Path(job.source)))
    mesh = mesh.scaled(scale)
    solid, method = solid_of(mesh)
    if not solid.volume > 0.0:
        raise MeshError("degenerate: encloses no volume")
    mass, mass_notes, mass_warnings = settings.sizing.mass(solid.volume)
    notes = [*mesh.notes, *size_notes, *mass_notes]
    warnings = (*size_warnings, *mass_warnings)
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
        mass_kg=mass,
        source=job.provenance,
        file=job.source,
        family="imported",
        split=job.split,
        scale=scale,
        volume_error=relative_volume_error(hulls, solid.volume),
        volume_method=f"{way}; union of hulls by voxels against {method}",
        content_hash=content_hash(job, settings),
        notes=tuple(notes),
        warnings=warnings,
    )
    write_object(Path(job.target), model)
    return replace(_result_of(job, model, "imported"), decomposed=not whole and cached is None)


def _result_of(job: Job, model: ObjectModel, status: Status) -> ImportResult:
    return ImportResult(
        job.source,
        job.name,
        status,
        target=job.target,
        hulls=len(model.hulls),
        volume_error=model.volume_error,
        longest_side_m=model.longest_side,
        mass_kg=model.mass_kg,
        notes=model.notes,
        warnings=model.warnings,
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
    request = json.dumps({"parent": os.getpid(), "job": asdict(job), "settings": asdict(settings)})
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
    """End a child, which removes what it has half written, and kill what is left of it and its children."""
    import contextlib

    child.terminate()
    with contextlib.suppress(subprocess.TimeoutExpired):
        child.wait(ENDING_S)
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
    drop_gone: bool = False,
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
        drop_gone: Remove the objects of the folder whose mesh file is gone.
        progress: Called after each mesh with its result, the number done and the number of all.

    Returns:
        One result per mesh, in the order of the meshes, then one for each object whose mesh is gone.

    Raises:
        MeshError: A path does not exist or holds no mesh, two meshes would have one name, or an object would
            be written over something else. Nothing has been written then.
        OutputError: The folder cannot be made.
    """
    settings = settings or ImportSettings()
    settings.sizing.check()
    out = Path(out)
    plan = plan_jobs(find_meshes([Path(p) for p in paths]), out, settings)
    gone = gone_objects(out)
    results: dict[str, ImportResult] = {}

    def finish(result: ImportResult) -> None:
        results[result.name] = result
        if progress:
            progress(result, len(results), len(plan))

    done, todo = _divide(plan, settings, gone if drop_gone else {}, force)
    make_folder(out)
    left: Status = "dropped" if drop_gone else "gone"
    stale = [ImportResult(file, path.stem, left, target=str(path)) for path, file in gone.items()]
    for path in gone if drop_gone else ():
        path.unlink()
    for result in done:
        finish(result)
    _import_in_children(todo, settings, jobs or os.cpu_count() or 1, finish)
    written = {job.target for job in todo}
    return [*(results[job.name] for job in plan), *(r for r in stale if r.target not in written)]


def _divide(
    plan: list[Job], settings: ImportSettings, dropped: Container[Path], force: bool
) -> tuple[list[ImportResult], list[Job]]:
    """The results of the meshes that need no work, and those that do.

    Raises:
        MeshError: An object would be written over something else.
    """
    done: list[ImportResult] = []
    todo: list[Job] = []
    for job in plan:
        target = Path(job.target)
        try:
            settings.sizing.check_unit(declared_unit(Path(job.source)))
            content = content_hash(job, settings)
        except MeshError as error:
            done.append(ImportResult(job.source, job.name, "refused", str(error)))
            continue
        current = target.is_file() and target not in dropped and read_hash(target) == content
        if target not in dropped:
            check_target(job, current)
        if current and not force:
            done.append(_result_of(job, read_object(target), "cached"))
        else:
            todo.append(job)
    return done, todo


def _import_in_children(
    todo: list[Job], settings: ImportSettings, jobs: int, finish: Callable[[ImportResult], None]
) -> None:
    """Import meshes in so many children at a time; none is left when this is interrupted."""
    cores = os.cpu_count() or 1
    workers = max(min(jobs, len(todo)), 1)
    running: dict[str, subprocess.Popen[str]] = {}
    with ThreadPoolExecutor(workers) as pool:
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
