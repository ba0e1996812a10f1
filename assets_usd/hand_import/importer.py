"""From a URDF or MJCF to the USD of a hand."""

import math
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from vd.assets_usd.hand_data import CollisionShape, HandError, HandModel, compose
from vd.assets_usd.hand_import.author import Author
from vd.assets_usd.hand_import.description import BUILT_IN, Description, read_description
from vd.assets_usd.hand_import.guess import (
    Stance,
    bent,
    critical_damping,
    roots,
    stand,
    take_stance,
    tip_points,
)
from vd.assets_usd.hand_import.source import Source, read_source
from vd.assets_usd.hand_import.tree import Tree, grow
from vd.assets_usd.hand_model import open_stage, read_hand
from vd.assets_usd.hands import HANDS, imported_folder
from vd.assets_usd.objects.plan import prim_name
from vd.command.files import make_folder

DEEP_M = 0.0005
"""Colliders that are less than this in each other touch."""
REACH_M = (0.03, 0.5)
"""Least and largest distance from the root of a finger to its tip: what is beyond is in another
unit.
"""
BEYOND_RAD = 0.02
"""By which a joint may be led beyond its limits before it is said."""
BENDS = (0.1, 0.2, 0.3, 0.4)
"""By which all fingers are bent (:func:`vd.assets_usd.hand_import.guess.bent`), and then
BEND_STEP more or less, one after the other: outer ones are walls. Chosen to take one or two minutes.
"""
BEND_STEP = 0.2
ANGLE_DIGITS = 2
"""Of a start that is proposed [rad], to be copied."""
LEAST_DAMPING_RATIO = 0.2
"""A drive that is damped less swings for long."""
MOST_EFFORT_NM = 5.0
MOST_MASS_KG = 5.0
"""A joint that is stronger and a hand that is heavier are not believed without a warning."""


@dataclass(frozen=True)
class Imported:
    """A hand that was imported."""

    hand: HandModel
    notes: list[str]
    """What was taken and guessed."""
    warnings: list[str]
    """What a person has to look at."""
    sources: list[str]
    """What the file calls the joints [D]."""


def import_hand(
    path: Path,
    out: Path | None,
    describe: str | Path | None = None,
    share_kept: Callable[[Path], float] | None = None,
) -> Imported:
    """Import a hand.

    Args:
        path: URDF or MJCF.
        out: Folder to write ``<name>.usda`` and its meshes to; by default one of the asset cache,
            from which commands take the hand by its name.
        describe: YAML, or the name of a built-in one
            (:mod:`vd.assets_usd.hand_import.description`).
        share_kept: Share of dropped objects that stay in the hand of a USD. By it the start of a
            palm that looks up is chosen, if none is described; None: all joints at zero.

    Raises:
        HandError: The file cannot be imported; says why and what to do.
    """
    said = read_description(describe)
    searched: list[str] = []
    if share_kept is not None and not said.start:
        said, searched = _with_bowl(path, said, share_kept)
    source = read_source(path)
    tree = grow(source, said)
    stance = take_stance(tree, said)
    tree.notes.extend(searched)
    _check_units(source, tree, stance)
    name = prim_name(said.name or source.name)
    if name in HANDS:
        raise HandError(f"{path}: {name} is a hand of the package; give it another name (name)")
    folder = imported_folder(name) if out is None else out
    warnings = [
        *_unnamed(source, describe),
        *tree.warnings,
        *_swinging(tree, stance),
        *_suspicious(tree),
    ]
    with tempfile.TemporaryDirectory() as scratch:
        author = Author(tree, stance, said, name)
        near = _untouched(source, tree)
        deep = overlaps(read_hand(author.write(Path(scratch), near)), near)
        target = author.write(Path(scratch), near | deep.keys())
        for (first, second), depth in sorted(deep.items()):
            pair = f"{tree.links[first].name} and {tree.links[second].name}"
            warnings.append(
                f"{pair} are {1e3 * depth:.1f} mm in each other at the start; their contact is "
                "off, unless another start keeps them apart"
            )
        warnings += _replaced(folder / target.name, source)
        make_folder(folder)
        for file in Path(scratch).iterdir():
            shutil.copy(file, folder / file.name)
    return Imported(read_hand(folder / target.name), tree.notes, warnings, tree.names)


def _with_bowl(
    path: Path, said: Description, share_kept: Callable[[Path], float]
) -> tuple[Description, list[str]]:
    """A description with the start in which most of what falls stays, and what to say of it.

    Of a palm that does not look up as it is.
    """
    source = read_source(path)
    tree = grow(source, said)
    stance = take_stance(tree, said)
    _check_units(source, tree, stance)
    if Rotation.from_quat(stance.mount[3:]).apply(stance.palm)[2] <= 0.0:
        return said, []
    size = stance.workspace.size_m
    place = replace(said.workspace, size=size, fall=stance.workspace.fall_m)
    said = replace(said, workspace=place)
    near = _untouched(source, tree)
    best = np.zeros(len(tree.fingers))
    kept = -1.0

    def is_better(shares: np.ndarray) -> bool:
        nonlocal best, kept
        start = bent(tree, shares)
        mount, workspace = stand(tree, stance.tips, start, stance.palm, said)
        bowl = replace(stance, start=start, mount=mount, workspace=workspace)
        with tempfile.TemporaryDirectory() as scratch:
            share = share_kept(Author(tree, bowl, said, "bowl").write(Path(scratch), near))
        if share <= kept:
            return False
        best = shares
        kept = share
        return True

    for bend in BENDS:
        is_better(np.full(len(best), bend))
    for step in BEND_STEP * np.eye(len(best)):
        if not is_better(best + step):
            is_better(best - step)
    start = bent(tree, best).round(ANGLE_DIGITS).tolist()
    angles = {}
    for joint, angle in zip(tree.joints, start, strict=True):
        if joint.mimic is None:
            angles[joint.name] = angle
    note = (
        f"guess: starts as a bowl in which {kept:.0%} of dropped cubes "
        f"stay (start); they measure {1e3 * size[0]:.0f} to {1e3 * size[1]:.0f} mm (workspace)"
    )
    return replace(said, start=angles), [note]


def _replaced(path: Path, source: Source) -> list[str]:
    """What is said where a hand of another file has the name."""
    if not path.is_file():
        return []
    stage = open_stage(path)  # which its prims need as long as they are read
    before = stage.GetDefaultPrim().GetDocumentation().rpartition("imported from ")[2]
    if before == source.path.name:
        return []
    return [
        f"{path.stem} was imported from {before}; this replaces it, unless it gets another name "
        f"(name)"
    ]


def _check_units(source: Source, tree: Tree, stance: Stance) -> None:
    """Refuse a hand that is no hand in metres."""
    ends = tip_points(tree, stance.tips, stance.start)
    for joints, reach in zip(tree.fingers, np.linalg.norm(ends - roots(tree), axis=1), strict=True):
        if not REACH_M[0] <= reach <= REACH_M[1]:
            raise HandError(
                f"{source.path}: the finger of {tree.joints[joints[0]].name} is {reach:.3g} m "
                f"long, not {REACH_M[0]:g} to {REACH_M[1]:g} m: convert the file to metres, or "
                "describe its tip (tips)"
            )


def _unnamed(source: Source, describe: str | Path | None) -> list[str]:
    """What is said of a hand that comes without the description which the package has of it."""
    name = source.name.removesuffix("_right")
    if describe is not None or name not in BUILT_IN:
        return []
    return [
        f"policies and presets know this hand as {name}, with what its file does not say: import "
        f"it with --describe {name}"
    ]


def _swinging(tree: Tree, stance: Stance) -> list[str]:
    """What is said of drives with so little damping that they swing."""
    ratios = {}
    for joint, critical in zip(tree.joints, critical_damping(tree, stance.start), strict=True):
        if joint.kd < LEAST_DAMPING_RATIO * critical:
            ratios[joint.name] = joint.kd / critical
    if not ratios:
        return []
    return [
        f"{', '.join(ratios)} swing: their damping is {min(ratios.values()):.2g} of the critical "
        f"one; describe more (drive, drives: kd)"
    ]


def _suspicious(tree: Tree) -> list[str]:
    """What is possible but seldom meant."""
    warnings = []
    strong = [joint.effort for joint in tree.joints if joint.effort > MOST_EFFORT_NM]
    if strong:
        warnings.append(
            f"{len(strong)} joints are as strong as {max(strong):g} N m; is that the motor's torque? "
            f"(drive)"
        )
    mass = sum(link.mass for link in tree.links)
    if mass > MOST_MASS_KG:
        warnings.append(f"the hand weighs {mass:.2f} kg; is that in kilograms?")
    for link in tree.links[1:]:
        radius = math.sqrt(np.linalg.eigvalsh(link.inertia)[-1] / link.mass)
        if radius > REACH_M[1]:
            warnings.append(
                f"{link.name} turns like a body of {radius:.2g} m; is its inertia in kg m2?"
            )
    for joint in tree.joints:
        if not joint.lower <= 0.0 <= joint.upper:
            warnings.append(
                f"zero is outside the limits of {joint.name}, {joint.lower:.2f} to "
                f"{joint.upper:.2f} rad"
            )
        if joint.mimic is not None:
            leader, factor, offset = joint.mimic
            led = tree.joints[tree.leader(joint)]
            low, high = sorted([factor * led.lower + offset, factor * led.upper + offset])
            if low < joint.lower - BEYOND_RAD or high > joint.upper + BEYOND_RAD:
                warnings.append(
                    f"{joint.name} follows {leader} to {low:.2f} and {high:.2f} rad, beyond "
                    f"its limits {joint.lower:.2f} and {joint.upper:.2f}, which hold both back (limits)"
                )
    return warnings


def _untouched(source: Source, tree: Tree) -> set[tuple[int, int]]:
    """Pairs of links whose contact is off.

    Of one finger, those that a joint joins, also by a copy, and those of the source.

    Each pair of links apart costs MuJoCo, which has 32 bits for who meets whom, so a finger is one
    in this.
    """
    number: dict[str, int] = {}
    for i, link in enumerate(tree.links):
        number.setdefault(link.name, i)  # of copies the first has the shapes
    for i, link in enumerate(tree.links):
        for name in link.sites:
            number.setdefault(name, i)
    pairs = set()
    for joint in tree.joints:
        for i, link in enumerate(tree.links):
            if i != joint.child and link.name == tree.links[joint.parent].name:
                pairs.add((min(i, joint.child), max(i, joint.child)))
    for joints in tree.fingers:
        pairs |= set(combinations(range(joints.start + 1, joints.stop + 1), 2))
    for names in source.apart:
        first, second = sorted(number.get(name, 0) for name in names)
        if first != second:
            pairs.add((first, second))
    return pairs


def overlaps(hand: HandModel, near: set[tuple[int, int]]) -> dict[tuple[int, int], float]:
    """Pairs of links that are in each other at the start, and how deep [m], but for those ``near``."""
    links = hand.forward_kinematics(hand.start)
    spec = mujoco.MjSpec()
    for number, shape in enumerate(hand.shapes):
        _add_shape(spec, shape, f"hull {number}", compose(links[shape.link], shape.frame))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    depths: dict[tuple[int, int], float] = {}
    for i, j in combinations(range(len(hand.shapes)), 2):
        a, b = sorted((hand.shapes[i].link, hand.shapes[j].link))
        if a == b or (a, b) in near:
            continue
        depth = -mujoco.mj_geomDistance(model, data, i, j, DEEP_M, None)
        if depth > DEEP_M:
            depths[a, b] = max(depth, depths.get((a, b), 0.0))
    return depths


def _add_shape(spec: mujoco.MjSpec, shape: CollisionShape, name: str, pose: np.ndarray) -> None:
    """Add a collider to the world of MuJoCo at a pose [7], a hull by this name."""
    kind = "mesh" if shape.kind == "hull" else shape.kind
    geom = spec.worldbody.add_geom(
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"),
        size=[*shape.size, 0.0, 0.0][:3],
        pos=pose[:3],
        quat=pose[[6, 3, 4, 5]],
    )
    if kind == "mesh":
        geom.meshname = name
        mesh = spec.add_mesh(name=name, uservert=shape.vertices.ravel())
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
