"""Import of meshes: a child process each, cached by content, resumable, with refusals by name."""

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh

from vd.assets_usd.objects.bodies import body_of, error_of_parts
from vd.assets_usd.objects.decompose import (
    GOOD_ERROR,
    HULL_VERTICES,
    RUNS,
    Decomposition,
    best_decomposition,
    tidy_hulls,
)
from vd.assets_usd.objects.geometry import (
    Hull,
    cluster_vertices,
    distances,
    random_surface_points,
    surface_points,
    triangle_areas,
    union_depth,
)
from vd.assets_usd.objects.meshes import fit_of, mass_of, scale_of
from vd.assets_usd.objects.model import (
    SURFACE_POINTS,
    ObjectError,
    ObjectModel,
    build_model,
    read_object,
    stored_facts,
    write_object,
)
from vd.assets_usd.objects.plan import Job, check_target, find_meshes, plan_jobs
from vd.assets_usd.objects.reading import declared_unit, load_mesh, mesh_kind
from vd.assets_usd.objects.repair import LONG, repair_mesh
from vd.assets_usd.objects.sets import check_set_folder
from vd.assets_usd.objects.settings import ImportSettings, MeshError
from vd.assets_usd.objects.usd_mesh import usd_files
from vd.command.files import make_folder
from vd.command.warp_quiet import quiet_warp
from vd.command.workers import run_tasks

IMPORT_VERSION = 7
"""Part of every content hash: raise it when the import computes something else."""

MAX_VISUAL_FACES = 3000
"""Faces of the visual mesh: files stay below 40 kB, and no picture here shows more."""

MAX_FACES = 200_000
"""Faces of a mesh that is repaired: of a scan they are a third of a millimetre long."""

COMPARED = 20_000
"""Points of a surface at which its error is measured."""

MAX_DECOMPOSED_FACES = 12_000
"""Faces of what is split into convex parts: CoACD's time grows with them, and parts are coarser."""

MAX_ERROR = 1.0
MAX_OFFSET = 0.03
"""Parts are refused if they differ from the mesh by more than its volume, and are farther from its
surface, on average, than this share of the longest side: 4 mm of 13 cm, where fingertips have a
radius of 10 mm. Of thin walls the first alone says little: a wall of 1 mm that is 2 mm thick as
parts differs by its volume.
"""

LAST_REMEDY = "export it again with fewer faces, or import it alone (--jobs 1)"
"""What helps where nothing is known of why an import failed."""

HANG_S = 20.0
OVERHEAD_S = 600.0
"""Wall-clock time after which a mesh is taken to hang: for each second of processor time that CoACD
may take, of which a busy machine gives it a twentieth of a core at least, and beside its runs."""


@dataclass(frozen=True)
class ImportResult:
    """What became of one mesh.

    Attributes:
        job: The mesh, and what was to be made of it.
        status: ``imported``, ``cached`` (nothing to do) or ``refused``.
        reason: Why it was refused.
        model: The object, if it was imported now or earlier.
    """

    job: Job
    status: Literal["imported", "cached", "refused"]
    reason: str = ""
    model: ObjectModel | None = None


def content_hash(job: Job, settings: ImportSettings) -> str:
    """Hash of all that decides the object.

    Bytes of the mesh, name, licence, settings and code version.
    """
    files = [Path(job.source)]
    if mesh_kind(files[0]) == "usd":
        files = usd_files(files[0])
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files))
    sizes = asdict(fit_of(settings.hand))
    options = asdict(replace(settings, hand="", licence=job.licence))
    facts = [IMPORT_VERSION, job.name, job.provenance, job.split, sizes, options]
    digest.update(json.dumps(facts, sort_keys=True).encode())
    return digest.hexdigest()


def _parts_warnings(parts: Decomposition, offset: float) -> list[str]:
    """What has to be said of parts.

    ``offset`` is how far they are from the surface, on average, as a share of its length.

    Raises:
        MeshError: They are too far from the mesh.
    """
    off = (
        f"convex parts ({len(parts.hulls)}) differ from the mesh by {100 * parts.error:.0f} % of "
        f"its volume, {100 * offset:.0f} % of its length off its surface on average: thicken its "
        "walls, or allow finer parts (--threshold, --max-hulls)"
    )
    warnings = []
    if parts.fallback:
        warnings = [f"fall-back, tried again at the next import: {parts.fallback}"]
    if parts.error > MAX_ERROR and offset > MAX_OFFSET:
        raise MeshError("; ".join([off, *warnings]))
    if parts.error > GOOD_ERROR:
        warnings.append(off)
    return warnings


def _uncovered(vertices: np.ndarray, hulls: Sequence[Hull]) -> list[str]:
    """What has to be said where a surface [V, 3] sticks far out of its convex parts [m]."""
    length = float(np.ptp(vertices, axis=0).max())
    out = float(union_depth(hulls, vertices).max())
    if out <= LONG * length:
        return []
    return [f"something thin, {1e3 * out:.0f} mm long, does not collide: thicken it"]


def import_mesh(job: Job, settings: ImportSettings) -> ImportResult:
    """Import one mesh in this process (CoACD runs in a child).

    A mesh that is refused is a result.
    """
    quiet_warp()
    try:
        model = _object_of(job, settings)
        write_object(Path(job.target), model)
    except (MeshError, ObjectError, OSError) as error:
        return ImportResult(job, "refused", str(error))
    return ImportResult(job, "imported", model=model)


def _object_of(job: Job, settings: ImportSettings) -> ObjectModel:
    """The object of a mesh.

    Raises:
        MeshError: The mesh is refused; the message is the reason.
    """
    source = Path(job.source)
    loaded, load_notes = _simplified(load_mesh(source))
    mesh = repair_mesh(loaded)
    scale, size_notes, size_warnings = scale_of(
        settings, mesh.surface.vertices, declared_unit(source)
    )
    mesh = mesh.scaled(scale)
    surface = mesh.surface
    body = body_of(mesh)
    if not body.solid.volume > 0.0:
        raise MeshError("degenerate: encloses no volume")
    mass, mass_notes, mass_warnings = mass_of(settings, body.solid.volume)
    error_of = error_of_parts(body, surface.vertices)
    if 0 < len(mesh.pieces) <= settings.max_hulls:
        hulls = tidy_hulls([p.vertices for p in mesh.pieces], HULL_VERTICES)
        parts = Decomposition(hulls, "convex pieces", error=error_of(hulls))
    else:
        coarse = cluster_vertices(surface, MAX_DECOMPOSED_FACES)
        parts = best_decomposition(coarse, settings, error_of)
    offset = parts.error * body.volume / triangle_areas(surface).sum()
    made = _parts_warnings(parts, offset / np.ptp(surface.vertices, axis=0).max())
    drawn = cluster_vertices(surface, MAX_VISUAL_FACES)
    made += _uncovered(drawn.vertices, parts.hulls)
    return build_model(
        job.name,
        drawn,
        parts.hulls,
        body.solid,
        surface_points(surface, SURFACE_POINTS),
        licence=job.licence,
        mass_kg=mass,
        source=job.provenance,
        file=job.source,
        family="imported",
        split=job.split,
        scale=scale,
        volume_error=parts.error + (body.volume / body.solid.volume - 1.0),  # parts are full
        volume_method=(
            f"{parts.method}; volume in which parts and solid differ; solid: {body.method}"
        ),
        # A fall-back forced by a limit may not be needed next time.
        content_hash="" if parts.fallback else content_hash(job, settings),
        notes=(*load_notes, *mesh.notes, *size_notes, *mass_notes),
        warnings=(*mesh.warnings, *body.warnings, *made, *size_warnings, *mass_warnings),
    )


def _simplified(mesh: Any) -> tuple[Any, list[str]]:
    """A mesh of at most MAX_FACES faces, and what has to be said of it."""
    if len(mesh.faces) <= MAX_FACES:
        return mesh, []
    mesh.merge_vertices()
    coarse = cluster_vertices(mesh, MAX_FACES, closed=True)
    some = random_surface_points(mesh, COMPARED, np.random.default_rng(0))
    off = distances(coarse, some).max() / mesh.extents.max()
    note = (
        f"simplified from {len(mesh.faces)} to {len(coarse.faces)} faces, up to "
        f"{100 * off:.2g} % of its length off"
    )
    return trimesh.Trimesh(*coarse, process=False), [note]


def import_meshes(
    paths: Iterable[Path],
    out: Path,
    settings: ImportSettings | None = None,
    *,
    jobs: int = 0,
    progress: Callable[[ImportResult, int, int], None] | None = None,
) -> list[ImportResult]:
    """Import meshes, several at a time, in processes of their own.

    None that fails, hangs or crashes stops others.

    An object file whose content hash still holds is left alone, so that an interrupted import goes
    on where it stopped.

    Args:
        paths: Files and folders.
        out: Folder of the object files.
        settings: Settings; the defaults if None.
        jobs: Meshes at a time; 0 takes the machine's cores.
        progress: Called after each mesh with its result, the number done and the number of all.

    Returns:
        One result per mesh, in the order of the meshes.

    Raises:
        MeshError: A path does not exist or holds no mesh, two meshes would have one name, or an
            object would be written over something else. Nothing has been written then.
        ObjectError: The folder has the name of a built-in set.
        OutputError: The folder cannot be made.
    """
    settings = settings or ImportSettings()
    settings.check()
    out = Path(out)
    check_set_folder(out)
    plan = plan_jobs(find_meshes(list(map(Path, paths))), out, settings.licence)
    results: dict[str, ImportResult] = {}

    def finish(result: ImportResult) -> None:
        results[result.job.name] = result
        if progress:
            progress(result, len(results), len(plan))

    todo = []
    done = []
    for job in plan:
        if result := _without_work(job, settings):
            done.append(result)
        else:
            todo.append(job)
    new = not out.exists()
    make_folder(out)
    for result in done:
        finish(result)
    workers = max(min(jobs or os.cpu_count() or 1, len(todo)), 1)
    run_tasks(
        partial(import_mesh, settings=settings),
        todo,
        lambda job, result, why: finish(
            result or ImportResult(job, "refused", f"no import: {why}; {LAST_REMEDY}")
        ),
        jobs=workers,
        # A busy machine is no reason: processor time is limited, this only ends what hangs.
        limit_s=RUNS * HANG_S * settings.time_limit + OVERHEAD_S,
        threads=max((os.cpu_count() or 1) // workers, 1),
    )
    if new and not any(out.iterdir()):  # all were refused
        out.rmdir()
    return [results[job.name] for job in plan]


def _without_work(job: Job, settings: ImportSettings) -> ImportResult | None:
    """The result of a mesh that needs no work: it is refused, or its object is there and unchanged.

    Raises:
        MeshError: An object would be written over something else.
    """
    target = Path(job.target)
    try:
        settings.check_unit(declared_unit(Path(job.source)))
        content = content_hash(job, settings)
    except MeshError as error:
        return ImportResult(job, "refused", str(error))
    except Exception as error:  # whatever a file does to its readers stops no other
        return ImportResult(job, "refused", f"{type(error).__name__}: {error}; {LAST_REMEDY}")
    if target.is_file() and stored_facts(target).get("contentHash") == content:
        return ImportResult(job, "cached", model=read_object(target))
    check_target(job)
    return None
