"""Build the scene in Newton: a hand over a table, an object in each world.

World frame: z up, table top at z = 0, all worlds at one origin. SI units, quaternions xyzw.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverMuJoCo

from vd.assets_usd.hand_model import HandModel, open_stage
from vd.assets_usd.objects.contact_layer import damping_ratio
from vd.assets_usd.objects.model import ObjectModel
from vd.paper import PAPER
from vd.sim.cfg import (
    CONTACT_IMPEDANCE,
    FINGERTIP_TORSION_M,
    GAP_M,
    IMPEDANCE_WIDTH_M,
    TABLE_IMPEDANCE,
    SimCfg,
)

# Contact friction in MuJoCo is the larger of two geoms' unless one has a higher priority. The
# paper's engine averages the two, so each pair's average is written to its higher-priority geom:
# table over hand over object.
PRIORITY_OBJECT, PRIORITY_HAND, PRIORITY_TABLE = 0, 1, 2

CONDIM_SLIDING, CONDIM_TORSIONAL = 3, 4

# What a shape is, for friction randomisation and contact forces.
SHAPE_OTHER, SHAPE_TABLE, SHAPE_OBJECT, SHAPE_HAND = 0, 1, 2, 3

OBJECT_COLOR, TABLE_COLOR = (0.93, 0.60, 0.18), (0.55, 0.5, 0.45)
OBJECT_LABEL = "object"
OBJECT_GROUP = -1
"""Collision group of an object's parts: with all but each other. Of one body they never touch, but
in a group with the rest every pair of them takes room in MuJoCo's 32 bits, and from about 20 parts
there is none.
"""
TABLE_LABEL = "table"
MASKED_SHAPES = 33
"""Most shapes whose filters fit into MuJoCo's masks whatever they are."""


@dataclass
class Scene:
    """A finalized Newton model and where things are in it.

    With N worlds, B bodies a world and S shapes in all.
    """

    model: newton.Model
    """The model of all worlds."""
    hand: HandModel
    """The hand, as read from its USD."""
    objects: list[ObjectModel]
    """The objects in use."""
    world_object: np.ndarray
    """Index into ``objects`` for every world, shape [N]."""
    world_scale: np.ndarray
    """Size factor of every world's object, shape [N]."""
    bodies_per_world: int
    """B."""
    link_body: np.ndarray
    """Body index within a world of every hand link, base first, shape [D + 1]."""
    object_body: int
    """Body index within a world of the object; -1 where there is none."""
    shape_kind: np.ndarray
    """SHAPE_* of every shape, shape [S]."""
    worlds: list[tuple[newton.ModelBuilder, int]]
    """Runs of equal worlds in their order: what builds one of them, and how many they are."""

    @property
    def num_envs(self) -> int:
        """N."""
        return len(self.world_object)


def assign_objects(num_envs: int, num_objects: int) -> np.ndarray:
    """Spread objects evenly over worlds in contiguous blocks, shape [num_envs], non-decreasing.

    Blocks because Newton copies a run of equal worlds in one pass.
    """
    return (np.arange(num_envs) * num_objects) // num_envs


def new_builder() -> newton.ModelBuilder:
    """An empty builder that knows MuJoCo's contact attributes."""
    builder = newton.ModelBuilder()
    SolverMuJoCo.register_custom_attributes(builder)
    return builder


def last_part(label: str) -> str:
    """A label of Newton's without those of what it belongs to."""
    return label.rsplit("/", 1)[-1]


def contact_attributes(priority: int, condim: int = CONDIM_SLIDING) -> dict[str, object]:
    """MuJoCo attributes of a collision shape."""
    d0, dmax = TABLE_IMPEDANCE if priority == PRIORITY_TABLE else CONTACT_IMPEDANCE
    return {
        "mujoco:condim": condim,
        "mujoco:geom_priority": priority,
        "mujoco:geom_solimp": wp.types.vector(5, float)(d0, dmax, IMPEDANCE_WIDTH_M, 0.5, 2.0),
    }


def shape_cfg(
    cfg: SimCfg, friction: float, *, visual: bool = False
) -> newton.ModelBuilder.ShapeConfig:
    """Newton's shape settings for a colliding (or visual-only) shape."""
    # kd and ke such that MuJoCo's solref becomes (time constant, damping ratio 1).
    kd = 2.0 / cfg.contact_time_constant_s
    return newton.ModelBuilder.ShapeConfig(
        density=0.0,
        mu=friction,
        ke=(0.5 * kd) ** 2,
        kd=kd,
        gap=GAP_M,
        margin=0.0,
        mu_torsional=FINGERTIP_TORSION_M,
        has_shape_collision=not visual,
        has_particle_collision=False,
        is_visible=visual,
    )


def build_hand(hand: HandModel, cfg: SimCfg, *, visuals: bool) -> newton.ModelBuilder:
    """The hand alone, where it is mounted, with the project's contact settings.

    Args:
        hand: The hand; its file is read again by Newton, with the same fingertip variant.
        cfg: Contact settings. Friction, and softness where the USD authors it, stay the USD's.
        visuals: Keep visual-only shapes (for rendering; training has no use for them).
    """
    builder = new_builder()
    builder.default_shape_cfg = shape_cfg(cfg, PAPER.materials.friction)
    builder.add_usd(
        open_stage(hand.path, hand.fingertip, hand.layer),
        xform=wp.transform(*hand.mount),
        floating=False,
        enable_self_collisions=True,
        load_sites=False,
        load_visual_shapes=visuals,
        hide_collision_shapes=True,
    )
    _group_fingers(builder, hand)
    tips = {shape.path for shape in hand.shapes if shape.fingertip}
    for shape in range(builder.shape_count):
        if not builder.shape_flags[shape] & newton.ShapeFlags.COLLIDE_SHAPES:
            continue
        is_tip = builder.shape_label[shape] in tips
        builder.shape_gap[shape] = GAP_M
        builder.shape_margin[shape] = 0.0
        builder.shape_material_mu_torsional[shape] = FINGERTIP_TORSION_M
        attributes = contact_attributes(
            PRIORITY_HAND, CONDIM_TORSIONAL if is_tip else CONDIM_SLIDING
        )
        for key, value in attributes.items():
            builder.custom_attributes[key].values[shape] = value
    return builder


def _group_fingers(builder: newton.ModelBuilder, hand: HandModel) -> None:
    """Put each finger whose links never touch each other into a collision group.

    That says nothing new, but to the compiler of MuJoCo's masks: of what is filtered pair by pair,
    more than 33 shapes may not fit into their 32 bits.
    """
    colliding = [
        i for i, f in enumerate(builder.shape_flags) if f & newton.ShapeFlags.COLLIDE_SHAPES
    ]
    if len(colliding) <= MASKED_SHAPES:
        return
    names = list(map(last_part, builder.body_label))
    apart = set(builder.shape_collision_filter_pairs)
    for finger, joints in enumerate(hand.fingers):
        links = [hand.link_names[child] for child in hand.joint_child[joints]]
        shapes = [i for i in colliding if names[builder.shape_body[i]] in links]
        pairs = [
            (a, b)
            for a, b in combinations(shapes, 2)
            if builder.shape_body[a] != builder.shape_body[b]
        ]
        if apart.issuperset(pairs):
            for shape in shapes:
                builder.shape_collision_group[shape] = OBJECT_GROUP - 1 - finger


def add_table(
    builder: newton.ModelBuilder, cfg: SimCfg, *, visible: bool, item: ObjectModel | None = None
) -> None:
    """Add the table of this world: a plane to the physics, a box to the eye.

    Objects bounce on it as their files say, where they were identified (``item``), and hardly
    otherwise.

    The paper's table reaches 0.3 m to each side and an object counts as lost at half of that, so
    nothing can tell a plane from it, except that contacts with a plane are exact: against a box, a
    quarter of the imported objects never come to rest.
    """
    surface = shape_cfg(cfg, PAPER.materials.table_friction)
    if item is not None and "restitution" in item.contact:
        surface.kd *= damping_ratio(item.contact["restitution"][0][0])
    builder.add_shape_plane(
        plane=(0.0, 0.0, 1.0, -PAPER.scene.table_top_m),
        width=0.0,
        length=0.0,
        body=-1,
        cfg=surface,
        label=TABLE_LABEL,
        custom_attributes=contact_attributes(PRIORITY_TABLE),
    )
    if visible:
        show_table(builder, cfg)


def show_table(builder: newton.ModelBuilder, cfg: SimCfg, body: int = -1) -> None:
    """Add what is seen of the table, a box, to the world or to a body at the world's origin."""
    size = PAPER.scene.table_size_m
    top = PAPER.scene.table_top_m
    builder.add_shape_box(
        body=body,
        xform=wp.transform(wp.vec3(0.0, 0.0, top - 0.5 * size[2]), wp.quat_identity()),
        hx=0.5 * size[0],
        hy=0.5 * size[1],
        hz=0.5 * size[2],
        cfg=shape_cfg(cfg, PAPER.materials.table_friction, visual=True),
        label=f"{TABLE_LABEL}/visual",
        color=TABLE_COLOR,
    )


def scaled_mesh(vertices: np.ndarray, faces: np.ndarray, scale: float) -> newton.Mesh:
    """A Newton mesh of ``vertices`` [V, 3] times ``scale``; mass properties are the body's."""
    return newton.Mesh(
        np.asarray(vertices) * scale, np.asarray(faces).flatten(), compute_inertia=False
    )


def add_object(
    builder: newton.ModelBuilder,
    item: ObjectModel,
    cfg: SimCfg,
    *,
    at: Sequence[float] = (0.0, 0.0, 0.0),
    scale: float,
    visuals: bool,
) -> int:
    """Add a free object made of its convex parts; returns its body index.

    Args:
        builder: The world's builder.
        item: The object.
        cfg: Contact settings.
        at: Where it is [m].
        scale: Uniform factor on its size. The mass stays; the inertia follows the size.
        visuals: Add the visual mesh too.
    """
    body = builder.add_body(
        xform=wp.transform(wp.vec3(*at), wp.quat_identity()),
        com=wp.vec3(*(scale * c for c in item.centre_of_mass)),
        mass=item.mass_kg,
        inertia=wp.mat33(*(item.inertia_matrix * scale**2).flatten()),
        label=OBJECT_LABEL,
        lock_inertia=True,
    )
    hull_cfg = shape_cfg(cfg, PAPER.materials.friction)
    hull_cfg.collision_group = OBJECT_GROUP
    for index, (vertices, faces) in enumerate(item.hulls):
        builder.add_shape_convex_hull(
            body,
            mesh=scaled_mesh(vertices, faces, scale),
            cfg=hull_cfg,
            label=f"{OBJECT_LABEL}/hull_{index}",
            custom_attributes=contact_attributes(PRIORITY_OBJECT),
        )
    if visuals:
        builder.add_shape_mesh(
            body,
            mesh=scaled_mesh(item.vertices, item.faces, scale),
            cfg=shape_cfg(cfg, PAPER.materials.friction, visual=True),
            label=f"{OBJECT_LABEL}/visual",
            color=OBJECT_COLOR,
        )
    return body


def build_scene(
    *,
    hand: HandModel,
    objects: Sequence[ObjectModel],
    num_envs: int,
    cfg: SimCfg,
    device: str,
    scales: Sequence[Sequence[float]] | None = None,
    visuals: bool = False,
) -> Scene:
    """Build and finalize ``num_envs`` worlds.

    Args:
        hand: The hand, read from USD (path and fingertip kind are taken from it).
        objects: Objects, spread over the worlds; none of a hand alone.
        num_envs: N.
        cfg: Physics settings.
        device: Warp device.
        scales: Size factors of each object, spread evenly over its worlds; None: 1.
        visuals: Include visual shapes.

    Raises:
        ValueError: There are fewer worlds than objects.
    """
    cfg.validate()
    if num_envs < len(objects):
        raise ValueError(
            f"num_envs = {num_envs} is fewer than the {len(objects)} objects; "
            "raise num_envs or name fewer objects"
        )
    hand_builder = build_hand(hand, cfg, visuals=visuals)
    items: list[ObjectModel | None] = list(objects) or [None]
    world_object = assign_objects(num_envs, len(items))
    world_scale = np.ones(num_envs)
    scene = new_builder()
    worlds = []
    for index, item in enumerate(items):
        count = int(np.count_nonzero(world_object == index))
        sizes = (1.0,) if scales is None else scales[index]
        scale_index = assign_objects(count, len(sizes))
        world_scale[world_object == index] = np.asarray(sizes)[scale_index]
        per_scale = np.bincount(scale_index, minlength=len(sizes))
        for scale, copies in zip(sizes, per_scale, strict=False):
            if copies == 0:
                continue
            world = new_builder()
            world.add_builder(hand_builder)
            # What rests in a hand needs no table, and what falls from it is lost.
            if not hand.palm_up:
                add_table(world, cfg, visible=visuals, item=item)
            if item is not None:
                drop_m = hand.workspace.drop_m
                add_object(world, item, cfg, at=drop_m, scale=float(scale), visuals=visuals)
            scene.replicate(world, int(copies))
            worlds.append((world, int(copies)))
    model = scene.finalize(device=device)
    bodies = model.body_count // num_envs
    names = list(map(last_part, model.body_label[:bodies]))
    object_body = names.index(OBJECT_LABEL) if objects else -1
    return Scene(
        model=model,
        hand=hand,
        objects=list(objects),
        world_object=world_object,
        world_scale=world_scale,
        bodies_per_world=bodies,
        link_body=np.array(list(map(names.index, hand.link_names)), dtype=np.int32),
        object_body=object_body,
        shape_kind=shape_kinds(model, bodies, object_body),
        worlds=worlds,
    )


def shape_kinds(model: newton.Model, bodies: int, object_body: int) -> np.ndarray:
    """SHAPE_* of the shapes of a model with so many bodies a world, shape [S]."""
    shape_body = model.shape_body.numpy()
    on_object = (shape_body >= 0) & (shape_body % bodies == object_body)
    is_table = np.array(list(map(last_part, model.shape_label))) == TABLE_LABEL
    kind = np.where(on_object, SHAPE_OBJECT, np.where(is_table, SHAPE_TABLE, SHAPE_HAND))
    collides = (model.shape_flags.numpy() & int(newton.ShapeFlags.COLLIDE_SHAPES)) != 0
    return np.where(collides, kind, SHAPE_OTHER).astype(np.int32)
