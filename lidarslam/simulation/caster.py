"""Ray casting: Open3D for the static world, the method of slabs for the boxes of movers."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.mesh import Mesh, world_mesh
from lidarslam.simulation.world import Boxes, Mover, World


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
        corners = mesh.vertices[mesh.triangles].reshape(-1, 3) if len(mesh.triangles) else np.zeros((1, 3))
        self._middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        self._movers = [mover for mover in world.movers if len(mover.boxes)]
        self._tensor = o3d.core.Tensor.from_numpy
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        self._is_filled = len(mesh.triangles) > 0
        if self._is_filled:
            self._scene.add_triangles(
                self._tensor((mesh.vertices - self._middle).astype(np.float32)),
                self._tensor(np.ascontiguousarray(mesh.triangles, dtype=np.uint32)),
            )

    def distances(self, points: FloatArray) -> FloatArray:
        """Distances (N,) of points (N, 3) from the nearest static surface, from either side of it."""
        if not self._is_filled:
            return np.full(len(points), np.inf)
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
    # A long street has many movers: most are too far away for a look at each ray.
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
