"""Primitives as triangles, closed and facing outwards; rays cast at them, and pieces of them for the reference map."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Boxes, Cylinders, HeightField, Mover, World

IntArray = NDArray[np.int32]

CYLINDER_SIDES = 24

# Corner k of a box is at its half sizes times these signs; a face is two triangles, counter-clockwise from outside.
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

    The corners are 0.6 % of the radius outside the cylinder and the sides 0.3 % inside.
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
    """All static surfaces: boxes, cylinders, height fields, in this order."""
    grounds = [height_field_mesh(field) for field in world.height_fields]
    return merge([box_mesh(world.boxes), cylinder_mesh(world.cylinders), *grounds])


def first_ground_triangle(world: World) -> int:
    """Number in `world_mesh` of the first triangle of the height fields, which are its last."""
    return len(_BOX_TRIANGLES) * len(world.boxes) + 4 * CYLINDER_SIDES * len(world.cylinders)


def _repeated(vertices: FloatArray, triangles: IntArray) -> Mesh:
    """One mesh of N solids of the same shape from their vertices (N, K, 3) and the triangles (M, 3) of one."""
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
    and of cutting: they number a piece's samples in the same way, whichever pieces were dropped.
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
        # A piece no larger than a cell is within its middle's cell and those that touch it.
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
    return Pieces(*map(np.concatenate, zip(*((part.corners, part.starts, part.ends) for part in parts), strict=True)))


def _place(pieces: Pieces, size: float) -> NDArray[np.int64]:
    """One number (P,) for the cell that the middle of each piece's bounding box lies in."""
    low, high = pieces.bounds
    return np.asarray(np.floor(0.5 / size * (low + high)).astype(np.int64) @ _STRIDES)


@dataclass(frozen=True, eq=False)
class Hits:
    """Intersections of N rays with the world."""

    ranges: FloatArray  # (N,) inf where there is none
    normals: NDArray[np.float32]  # (N, 3) unit, in the world, outward of the surface; zero where there is none
    cosines: FloatArray  # (N,) of the angle between the ray and the normal that faces it, 0 to 1
    surfaces: NDArray[np.int64]  # (N,) number of the triangle, -2 and below for movers, -1 where there is none
    moving: NDArray[np.bool_]  # (N,) whether it is a mover


class Caster:
    """Casts rays into one world; building it takes time, casting does not change it.

    Open3D calculates in float32, so the mesh is moved to the middle of the world first: within 500 m of it the error
    stays below 0.1 mm.
    """

    def __init__(self, world: World, mesh: Mesh | None = None) -> None:
        import open3d as o3d

        mesh = mesh or world_mesh(world)
        corners = mesh.vertices[mesh.triangles].reshape(-1, 3)
        self._middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        self._movers = [mover for mover in world.movers if len(mover.boxes)]
        self._tensor = o3d.core.Tensor.from_numpy
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor((mesh.vertices - self._middle).astype(np.float32)),
            self._tensor(np.ascontiguousarray(mesh.triangles, dtype=np.uint32)),
        )

    def distances(self, points: FloatArray) -> FloatArray:
        """Distances (N,) of points (N, 3) from the nearest static surface, from either side of it."""
        found = self._scene.compute_distance(self._tensor((points - self._middle).astype(np.float32)))
        return np.asarray(found.numpy(), dtype=np.float64)

    def cast(self, origins: FloatArray, directions: FloatArray, times: FloatArray, max_range_m: float) -> Hits:
        """Cast rays with origins (N, 3) and unit directions (N, 3) in the world, each at its own time (N,)."""
        rays = np.empty((len(origins), 6), dtype=np.float32)
        rays[:, :3] = origins - self._middle
        rays[:, 3:] = directions
        answer = self._scene.cast_rays(self._tensor(rays))
        ranges = answer["t_hit"].numpy().astype(np.float64)
        normals = answer["primitive_normals"].numpy().copy()
        surfaces = answer["primitive_ids"].numpy().astype(np.int64)
        missed = ~(ranges <= max_range_m)
        ranges[missed], surfaces[missed], normals[missed] = np.inf, -1, 0.0
        moving = np.zeros(len(ranges), dtype=bool)
        for number, mover in enumerate(self._movers if len(times) else []):
            near = _near_mover(mover, origins, directions, times, max_range_m)
            if len(near):
                distances, outward = _meet_mover(mover, origins[near], directions[near], times[near])
                nearer = distances < ranges[near]
                met = near[nearer]
                ranges[met], normals[met] = distances[nearer], outward[nearer]
                surfaces[met], moving[met] = -2 - number, True
        cosines = np.abs(np.einsum("ij,ij->i", normals, rays[:, 3:])).astype(np.float64)
        return Hits(ranges, normals, np.minimum(cosines, 1.0), surfaces, moving)


def _near_mover(
    mover: Mover, origins: FloatArray, directions: FloatArray, times: FloatArray, max_range_m: float
) -> NDArray[np.intp]:
    """Rays that pass the sphere that holds the mover during all of the times; none if it is out of range."""
    sizes = np.linalg.norm(mover.boxes.centres, axis=1) + np.linalg.norm(mover.boxes.half_sizes, axis=1)
    start, end = times.min(), times.max()
    middle = mover.pose_at(np.array([0.5 * (start + end)]))[0, :3, 3]
    radius = sizes.max() + 0.5 * abs(mover.speed_mps) * (end - start)
    away = middle - origins
    # A long street has many movers: most are too far away to test each ray.
    if np.linalg.norm(away[0]) > max_range_m + radius + 2.0 * np.linalg.norm(origins[-1] - origins[0]):
        return np.empty(0, dtype=np.intp)
    along = np.maximum(np.einsum("ij,ij->i", away, directions), 0.0)
    return np.flatnonzero(np.einsum("ij,ij->i", away, away) - along**2 < radius**2)


def _meet_mover(
    mover: Mover, origins: FloatArray, directions: FloatArray, times: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Distances (N,) to the mover along rays, inf for none, and the normals (N, 3) there, in the world."""
    T_world_mover = mover.pose_at(times)
    R = T_world_mover[:, :3, :3]
    origins_mover = np.einsum("nji,nj->ni", R, origins - T_world_mover[:, :3, 3])
    distances, normals = meet_boxes(mover.boxes, origins_mover, np.einsum("nji,nj->ni", R, directions))
    return distances, np.einsum("nij,nj->ni", R, normals)


def meet_boxes(boxes: Boxes, origins: FloatArray, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances (N,) to the first box along rays (N, 3), inf for none, and the outward normals (N, 3) there.

    The method of slabs; a ray that starts inside a box does not meet it.
    """
    best, normals = np.full(len(origins), np.inf), np.zeros((len(origins), 3))
    for centre, half, R in zip(boxes.centres, boxes.half_sizes, boxes.R_world_box, strict=True):
        o, d = (origins - centre) @ R, directions @ R
        slope = 1.0 / np.where(d == 0.0, 1e-300, d)
        near, far = np.sort(np.stack([(-half - o) * slope, (half - o) * slope]), axis=0)
        enter, leave = near.max(axis=1), far.min(axis=1)
        first = (enter <= leave) & (enter > 0.0) & (enter < best)
        best[first] = enter[first]
        axis = near[first].argmax(axis=1)
        normals[first] = -np.sign(d[first, axis])[:, None] * R.T[axis]
    return best, normals
