"""Import of meshes: one child process a mesh, cached by content, resumable, with refusals by name."""

import contextlib
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Container, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vd.assets_usd.objects.bodies import PartsError, body_of, cavity_share
from vd.assets_usd.objects.decompose import (
    GOOD_ERROR,
    HANG_S,
    RUNS,
    Decomposition,
    best_decomposition,
    tidy_hulls,
)
from vd.assets_usd.objects.geometry import Hull, cluster_vertices, surface_points, triangle_areas
from vd.assets_usd.objects.meshes import MeshError
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
        volume_error: Volume in which parts and object differ, as a share of the object's.
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


def _kept_decomposition(path: Path) -> Decomposition | None:
    """An earlier decomposition, None if there is none or it is damaged."""
    try:
        with np.load(path) as data:
            hulls = tuple(Hull(data[f"vertices_{i}"], data[f"faces_{i}"]) for i in range(int(data["count"])))
            return Decomposition(hulls, str(data["method"]), error=float(data["error"]))
    except Exception:  # zip, NumPy and zlib have errors of their own
        return None


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
    count = len(parts.hulls)
    which = f"{count} convex parts differ" if count > 1 else "one convex part differs"
    off = f"{which} from the mesh by {100 * parts.error:.0f} % of its volume"
    if parts.error > MAX_ERROR and offset > MAX_OFFSET:
        raise MeshError(
            f"{off}, {100 * offset:.0f} % of its length off its surface on average"
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
    scale, size_notes, size_warnings = settings.sizing.scale(mesh.vertices, declared_unit(Path(job.source)))
    mesh = mesh.scaled(scale)
    body = body_of(mesh)
    if not body.solid.volume > 0.0:
        raise MeshError("degenerate: encloses no volume")
    mass, mass_notes, mass_warnings = settings.sizing.mass(body.solid.volume)
    notes = [*mesh.notes, *size_notes, *mass_notes]
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
    made = (*mesh.warnings, *body.warnings, *_parts_warnings(parts, offset))
    warnings = (*made, *size_warnings, *mass_warnings)
    points = surface_points(mesh.vertices, mesh.faces, SURFACE_POINTS)
    visual = cluster_vertices(mesh.vertices, mesh.faces, MAX_VISUAL_FACES)
    model = build_model(
        job.name,
        *visual,
        parts.hulls,
        body.solid,
        points,
        licence=job.licence,
        mass_kg=mass,
        source=job.provenance,
        file=job.source,
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
    return replace(_result_of(job, model, "imported"), decomposed=not whole and kept is None)


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
    """Import one mesh in a child of its own, killed if it hangs."""
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
            [sys.executable, "-m", "vd.assets_usd.objects.import_worker", str(os.getpid())],
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

    An object file whose content hash still holds is left alone, unless its mesh has moved, and finished
    decompositions are kept, so that an interrupted import goes on where it stopped.

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
    settings.decompose.check()
    out = Path(out)
    plan = plan_jobs(find_meshes([Path(p) for p in paths]), out, settings)
    gone = gone_objects(out)
    results: dict[str, ImportResult] = {}

    def finish(result: ImportResult) -> None:
        results[result.name] = result
        if progress:
            progress(result, len(results), len(plan))

    done, todo = _divide(plan, settings, gone, drop_gone=drop_gone, force=force)
    new = not out.exists()
    make_folder(out)
    left: Status = "dropped" if drop_gone else "gone"
    stale = [ImportResult(file, path.stem, left, target=str(path)) for path, file in gone.items()]
    for path in gone if drop_gone else ():
        path.unlink()
    for result in done:
        finish(result)
    _import_in_children(todo, settings, jobs or os.cpu_count() or 1, finish)
    if new and not any(out.iterdir()):  # all were refused
        out.rmdir()
    written = {job.target for job in todo}
    return [*(results[job.name] for job in plan), *(r for r in stale if r.target not in written)]


def _divide(
    plan: list[Job], settings: ImportSettings, gone: Container[Path], *, drop_gone: bool, force: bool
) -> tuple[list[ImportResult], list[Job]]:
    """The results of the meshes that need no work, and those that do: also what has moved (is ``gone``).

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
        current = target.is_file() and read_hash(target) == content
        if not (drop_gone and target in gone):
            check_target(job, current)
        if current and not force and target not in gone:
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
