"""The triangles that a camera can see in each world, gathered for the device."""

from collections.abc import Sequence

import numpy as np
import warp as wp
from trimesh import Trimesh
from trimesh.util import append_faces

from vd.assets_usd.hand_model import read_surfaces
from vd.assets_usd.objects.geometry import Surface
from vd.sim.scene import Scene

MANY_FACES = 4000
"""A link with more triangles is drawn coarser (ours): each costs time, and CAD files have many times
more than pixels of 2 mm tell apart. Not tuned; LEAP's links have 9 000 to 87 000."""
COARSE_DIGITS = 3
"""Decimals of a metre in which vertices of such a link differ (ours). Not tuned: with them an image of
LEAP costs a CPU 8 ms, and 20 without."""


class SurfaceSet:
    """M distinct meshes and which of them is where: S shapes in each of N worlds, B bodies a world.

    Equal meshes (links of different fingers, objects of different worlds) are kept once.
    """

    def __init__(
        self,
        meshes: Sequence[Surface],
        shape_body: np.ndarray,
        shape_mesh: np.ndarray,
        shape_scale: np.ndarray,
        *,
        device: str,
    ):
        """Copy meshes to the device.

        Args:
            meshes: The meshes, each in the frame of its body [m].
            shape_body: Body that carries each shape, an index within a world; -1 for the world,
                shape [S].
            shape_mesh: Mesh of each shape in each world, shape [N, S].
            shape_scale: Size factor of each shape in each world, shape [N, S].
            device: Warp device.

        Raises:
            ValueError: A mesh without triangles.
        """
        self.num_envs, self.num_shapes = shape_mesh.shape
        if empty := [i for i, mesh in enumerate(meshes) if not len(mesh.faces)]:
            raise ValueError(f"meshes {empty} have no triangles; leave them out")
        sizes = np.array([len(mesh.faces) for mesh in meshes])
        vertices, triangles = append_faces(*zip(*meshes, strict=True))

        def array(values: np.ndarray, dtype: type) -> wp.array:
            return wp.array(values, dtype=dtype, device=device)

        self.points = array(vertices.astype(np.float32), wp.vec3)
        """Vertices of all meshes in their frames [m], shape [V]."""
        self.triangles = array(triangles.astype(np.int32), wp.vec3i)
        """Their triangles, mesh after mesh, shape [F]."""
        self.mesh_first = array(np.concatenate([[0], np.cumsum(sizes)]), wp.int32)
        """First triangle of each mesh, and the end, shape [M + 1]."""
        self.shape_body = array(shape_body, wp.int32)
        """Body of each shape, shape [S]."""
        self.shape_mesh = array(shape_mesh, wp.int32)
        """Mesh of each shape, shape [N, S]."""
        self.shape_scale = array(shape_scale, wp.float32)
        """Size factor of each shape, shape [N, S]."""
        # Worlds differ in their objects' triangles; there is a thread for each of the most.
        most = sizes[shape_mesh].max(axis=0)
        self.slot_shape = array(np.repeat(np.arange(self.num_shapes), most), wp.int32)
        """Shape of each thread of the ray casting, shape [K]."""
        self.slot_index = array(np.concatenate(list(map(np.arange, most))), wp.int32)
        """Triangle of each thread within its mesh, shape [K]."""


def scene_surfaces(scene: Scene) -> SurfaceSet:
    """What a camera sees of a scene but the table.

    The hand's links, and the object as its last shape.
    """
    drawn = read_surfaces(scene.hand)
    meshes: list[Surface] = []
    known: dict[bytes, int] = {}

    def index(surface: Surface) -> int:
        key = surface.vertices.tobytes() + surface.faces.tobytes()
        if key not in known:
            known[key] = len(meshes)
            meshes.append(surface)
        return known[key]

    links = [index(coarse(surface)) for surface in drawn.values()]
    places = np.array([index(Surface(item.vertices, item.faces)) for item in scene.objects])
    shape_mesh = np.column_stack([np.tile(links, (scene.num_envs, 1)), places[scene.world_object]])
    shape_scale = np.ones(shape_mesh.shape)
    shape_scale[:, -1] = scene.world_scale
    bodies = [*(scene.link_body[link] for link in drawn), scene.object_body]
    device = str(scene.model.device)
    return SurfaceSet(meshes, np.array(bodies), shape_mesh, shape_scale, device=device)


def coarse(surface: Surface) -> Surface:
    """A surface of many triangles with vertices merged where no camera tells them apart."""
    if len(surface.faces) <= MANY_FACES:
        return surface
    mesh = Trimesh(*surface, process=False)
    mesh.merge_vertices(digits_vertex=COARSE_DIGITS)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    return Surface(mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))
