"""Primitives as triangles, for casting rays and for the reference map; solids are closed and face outwards."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Boxes, Cylinders, HeightField, World

IntArray = NDArray[np.int32]

CYLINDER_SIDES = 24

# Corner k of a box lies at its half sizes times these signs; a face is two triangles, counter-clockwise from outside.
_BOX_CORNERS = np.array([[x, y, z] for z in (-1.0, 1.0) for y in (-1.0, 1.0) for x in (-1.0, 1.0)])
_BOX_FACES = [
    [[0, 2, 3], [0, 3, 1]],  # -z
    [[4, 5, 7], [4, 7, 6]],  # +z
    [[0, 1, 5], [0, 5, 4]],  # -y
    [[2, 6, 7], [2, 7, 3]],  # +y
    [[0, 4, 6], [0, 6, 2]],  # -x
    [[1, 3, 7], [1, 7, 5]],  # +x
]
_BOX_TRIANGLES = np.array(_BOX_FACES, dtype=np.int32).reshape(12, 3)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in the world, counter-clockwise as seen from outside."""

    vertices: FloatArray  # (V, 3)
    triangles: IntArray  # (T, 3) indices into `vertices`

    def __post_init__(self) -> None:
        if self.vertices.shape[1:] != (3,) or self.triangles.shape[1:] != (3,):
            raise ValueError(f"Mesh must be (V, 3) and (T, 3), got {self.vertices.shape} and {self.triangles.shape}")
        if self.triangles.size and not 0 <= self.triangles.min() <= self.triangles.max() < len(self.vertices):
            raise ValueError(f"Mesh.triangles must index {len(self.vertices)} vertices, got {self.triangles.max()}")


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """All triangles of several meshes in one, in their order."""
    first_vertices = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    triangles = [mesh.triangles + first for mesh, first in zip(meshes, first_vertices, strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles).astype(np.int32))


def box_mesh(boxes: Boxes) -> Mesh:
    """Eight vertices and twelve triangles for each box, in the boxes' order."""
    corners = _BOX_CORNERS * boxes.half_sizes[:, None, :]
    vertices = boxes.centres[:, None, :] + corners @ np.swapaxes(boxes.R_world_box, 1, 2)
    return _repeated(vertices, _BOX_TRIANGLES)


def cylinder_mesh(cylinders: Cylinders) -> Mesh:
    """A capped prism of `CYLINDER_SIDES` sides for each cylinder, in their order, of the same volume as the cylinder.

    The corners stand 0.6 % of the radius proud and the sides lie 0.3 % inside.
    """
    n = CYLINDER_SIDES
    axis = cylinders.ends - cylinders.starts
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    # Any direction across will do; the coordinate axis that is least along the cylinder is safely not parallel to it.
    aside = np.eye(3)[np.abs(axis).argmin(axis=1)] if len(cylinders) else np.empty((0, 3))
    u = np.cross(axis, aside)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(axis, u)
    angle = 2.0 * np.pi * np.arange(n) / n
    radius = cylinders.radii * np.sqrt(2.0 * np.pi / n / np.sin(2.0 * np.pi / n))
    around = np.cos(angle)[:, None] * u[:, None, :] + np.sin(angle)[:, None] * v[:, None, :]
    rim = radius[:, None, None] * around
    starts, ends = cylinders.starts[:, None, :], cylinders.ends[:, None, :]
    # Vertices 0 and 1 are the ends' centres, then come n around the start and n around the end.
    k = np.arange(n, dtype=np.int32)
    low, low_next = 2 + k, 2 + (k + 1) % n
    high, high_next = low + n, low_next + n
    start, end = np.zeros_like(k), np.ones_like(k)
    faces = [[start, low_next, low], [end, high, high_next], [low, low_next, high_next], [low, high_next, high]]
    triangles = np.concatenate([np.stack(face, axis=1) for face in faces]).astype(np.int32)
    return _repeated(np.concatenate([starts, ends, starts + rim, ends + rim], axis=1), triangles)


def height_field_mesh(field: HeightField) -> Mesh:
    """Two triangles for each cell, facing up; vertex `i * Y + j` is grid point (i, j)."""
    rows, columns = field.heights.shape
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    xy = field.origin_xy + field.cell_m * np.stack([i, j], axis=-1)
    vertices = np.concatenate([xy, field.heights[..., None]], axis=-1).reshape(-1, 3)
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    here, right, ahead, across = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    cells = np.stack([here, ahead, across, here, across, right], axis=-1)
    return Mesh(vertices, cells.reshape(-1, 3))


def world_mesh(world: World) -> Mesh:
    """All that stands still: boxes, cylinders, height fields, in this order."""
    grounds = [height_field_mesh(field) for field in world.height_fields]
    return merge([box_mesh(world.boxes), cylinder_mesh(world.cylinders), *grounds])


def first_ground_triangle(world: World) -> int:
    """Number in `world_mesh` of the first triangle of the height fields, which are its last."""
    return len(_BOX_TRIANGLES) * len(world.boxes) + 4 * CYLINDER_SIDES * len(world.cylinders)


def _repeated(vertices: FloatArray, triangles: IntArray) -> Mesh:
    """One mesh of N alike solids from their vertices (N, K, 3) and the triangles (M, 3) of one."""
    count, per_solid = vertices.shape[:2]
    first = per_solid * np.arange(count, dtype=np.int32)
    return Mesh(vertices.reshape(-1, 3), (first[:, None, None] + triangles).reshape(-1, 3))
