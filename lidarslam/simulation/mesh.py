"""Primitives as triangles, for casting rays and for the reference map; solids are closed and face outwards."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

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


# Pieces are no larger than cells of this many voxels.
PIECE_VOXELS = 8
_STRIDES = np.array([1, 1 << 20, 1 << 40])
_NEIGHBOURS = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3) @ _STRIDES
_BLOCK = 1 << 17


@dataclass(frozen=True, eq=False)
class Pieces:
    """Triangles cut out of a mesh.

    `starts` and `ends` are the area of the mesh before the piece, and with it, in the order of the mesh's triangles
    and of cutting: they number a piece's samples alike, whichever pieces were dropped.
    """

    corners: FloatArray  # (P, 3, 3)
    starts: FloatArray  # (P,)
    ends: FloatArray  # (P,)

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest coordinates (P, 3)."""
        a, b, c = np.moveaxis(self.corners, 1, 0)  # faster than to reduce an axis this short
        return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)

    @property
    def normals(self) -> FloatArray:
        """(P, 3) unit."""
        normals = np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))

    def __getitem__(self, chosen: NDArray[Any]) -> "Pieces":
        return Pieces(self.corners[chosen], self.starts[chosen], self.ends[chosen])


def pieces_near(mesh: Mesh, voxels: NDArray[np.int64], voxel_m: float) -> Pieces:
    """Triangles that together cover all of the mesh that lies in the voxels (N, 3), and little more.

    Cutting keeps the triangles' planes and orientation. The pieces are in the order of their places, z first;
    triangles without area are left out.
    """
    size = voxel_m * PIECE_VOXELS
    cells = np.unique((voxels // PIECE_VOXELS) @ _STRIDES)
    near = np.unique((cells[:, None] + _NEIGHBOURS).ravel())
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    ends = np.cumsum(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))
    starts = np.concatenate([[0.0], ends[:-1]])
    found = []
    for block in np.array_split(np.flatnonzero(ends > starts), len(ends) // _BLOCK + 1):
        pieces = _cut(Pieces(mesh.vertices[mesh.triangles[block]], starts[block], ends[block]), size)
        # A piece no larger than a cell lies in its middle's cell and those that touch it.
        found.append(pieces[np.isin(_place(pieces, size), near)])
    pieces = _together(found)
    return pieces[np.argsort(_place(pieces, size), kind="stable")]


def _cut(pieces: Pieces, size: float) -> Pieces:
    """Halve triangles across their longest edges until none extends farther than `size` along an axis."""
    done = []
    while True:
        low, high = pieces.bounds
        is_large = np.asarray(((high - low) > size).any(axis=1))
        done.append(pieces[~is_large])
        if not is_large.any():
            return _together(done)
        pieces = pieces[is_large]
        lengths = np.linalg.norm(np.roll(pieces.corners, -1, axis=1) - pieces.corners, axis=2)
        order = (lengths.argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(pieces.corners, order[:, :, None], axis=1), 1, 0)
        middle, half = 0.5 * (a + b), 0.5 * (pieces.starts + pieces.ends)
        one = Pieces(np.stack([a, middle, c], axis=1), pieces.starts, half)
        pieces = _together([one, Pieces(np.stack([middle, b, c], axis=1), half, pieces.ends)])


def _together(parts: list[Pieces]) -> Pieces:
    return Pieces(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("corners", "starts", "ends")))


def _place(pieces: Pieces, size: float) -> NDArray[np.int64]:
    """One number (P,) for the cell that the middle of each piece's bounding box lies in."""
    low, high = pieces.bounds
    return np.asarray(np.floor(0.5 / size * (low + high)).astype(np.int64) @ _STRIDES)
