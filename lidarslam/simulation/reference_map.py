"""The true map: even samples of the surfaces that a recording has seen."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.mesh import Mesh, world_mesh
from lidarslam.simulation.recorder import Simulation

KeyArray = NDArray[np.int64]

_BLOCK = 1 << 19
# Voxel indices take 19 bits each, the sector of the normal 3, the side 1.
_BITS, _HALF = 19, 1 << 18
# Turned axes, so that the directions common in buildings do not lie between two sectors.
_SECTOR_AXES = np.array([[0.86, 0.36, 0.36], [-0.48, 0.81, 0.34], [-0.17, -0.46, 0.87]])
# Of Roberts' R2 sequence, whose points fill the unit square evenly: 1/g and 1/g^2 with g^3 = g + 1.
_R2 = np.array([0.7548776662466927, 0.5698402909980532])
_NEIGHBOURS = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
_CELL_STRIDES = np.array([1, 1 << 20, 1 << 40])


class ReferenceMap(NamedTuple):
    """Points (N, 3) in the world and the unit normals (N, 3) on the side that was seen."""

    points: FloatArray
    normals: FloatArray


@dataclass(eq=False)
class SeenSurfaces:
    """Where noise-free rays have met surfaces: voxels, and in each which way the surface faces.

    The direction keeps the far side of a wall out of the map when only the near side was seen.

    Attributes:
        voxel_m: edge of a voxel.
    """

    voxel_m: float = 0.2
    _keys: KeyArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    _pending: list[KeyArray] = field(default_factory=list)

    def add(self, points: FloatArray, normals: FloatArray, from_behind: NDArray[np.bool_]) -> None:
        """Add hits (N, 3) with their surfaces' outward normals (N, 3) and whether they were met from inside (N,)."""
        self._pending.append(np.unique(_keys(points, normals, self.voxel_m) | from_behind))
        if sum(map(len, self._pending)) > max(_BLOCK, len(self._keys)):
            self._merge()

    def around(self) -> KeyArray:
        """Sorted keys of the seen voxels and all that touch them."""
        self._merge()
        keys = self._keys
        for axis in range(3):
            step = np.int64(1) << (_BITS * axis + 4)
            keys = np.unique(np.concatenate([keys - step, keys, keys + step]))
        return keys

    def _merge(self) -> None:
        self._keys = np.unique(np.concatenate([self._keys, *self._pending]))
        self._pending.clear()


def reference_map(
    simulation: Simulation, spacing_m: float = 0.05, start: int = 0, stop: int | None = None, step: int = 1
) -> ReferenceMap:
    """The map of what the chosen scans of a simulation saw of the world that stands still."""
    seen = SeenSurfaces()
    for index in range(len(simulation))[start:stop:step]:
        add_sweep(seen, simulation, index)
    return sample_seen(world_mesh(simulation.world), seen, spacing_m)


def add_sweep(seen: SeenSurfaces, simulation: Simulation, index: int) -> None:
    """Add what one sweep met, in truth, of what stands still within the sensor's range."""
    echoes = simulation.echoes(index)
    hits = echoes.hits
    met = np.flatnonzero(
        np.isfinite(hits.ranges) & ~hits.moving & (hits.ranges >= simulation.sensor.ranging.min_range_m)
    )
    points = echoes.origins[met] + hits.ranges[met, None] * echoes.directions[met]
    normals = hits.normals[met].astype(np.float64)
    seen.add(points, normals, np.einsum("ij,ij->i", normals, echoes.directions[met]) > 0.0)


def sample_seen(mesh: Mesh, seen: SeenSurfaces, spacing_m: float = 0.05) -> ReferenceMap:
    """Samples of the mesh, one to each `spacing_m` squared, in or next to voxels that were seen.

    Memory is bounded by what was seen; the mesh is gone through in blocks.
    """
    around = seen.around()
    points, normals = [np.empty((0, 3))], [np.empty((0, 3))]
    for sampled, facing in _samples(_near(mesh, around, seen.voxel_m), spacing_m):
        keys = _keys(sampled, facing, seen.voxel_m)
        front, behind = _contains(around, keys), _contains(around, keys | 1)
        points.append(sampled[front | behind])
        normals.append(np.where(front[:, None], facing, -facing)[front | behind])
    return ReferenceMap(np.concatenate(points), np.concatenate(normals))


def _near(mesh: Mesh, around: KeyArray, voxel_m: float) -> Mesh:
    """The mesh without those of its small triangles that are far from all seen voxels; the rest need no sampling."""
    coarse_m = 8.0 * voxel_m
    shifts = 4 + _BITS * np.arange(3)
    cells = np.unique(((around[:, None] >> shifts & (1 << _BITS) - 1) - _HALF) >> 3, axis=0)
    corners = mesh.vertices[mesh.triangles]
    low, high = corners.min(axis=1), corners.max(axis=1)
    keep = (high - low).max(axis=1, initial=0.0) > coarse_m
    small = np.flatnonzero(~keep)
    # A small triangle has no point in a cell that does not touch its middle's.
    near = np.unique((cells[:, None] + _NEIGHBOURS).reshape(-1, 3) @ _CELL_STRIDES)
    middle = np.floor(0.5 * (low + high)[small] / coarse_m).astype(np.int64)
    keep[small] = _contains(near, middle @ _CELL_STRIDES)
    return Mesh(mesh.vertices, mesh.triangles[keep])


def _samples(mesh: Mesh, spacing_m: float) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Blocks of points and unit normals: equal areas each have a point, wherever triangles begin and end."""
    normals = mesh.normals
    doubled = np.linalg.norm(normals, axis=1)
    until = np.cumsum(0.5 * doubled)
    count = int(until[-1] / spacing_m**2) if len(until) else 0
    for start in range(0, count, _BLOCK):
        number = np.arange(start, min(start + _BLOCK, count))
        triangle = np.searchsorted(until, (number + 0.5) * spacing_m**2)
        a, b, c = (mesh.vertices[mesh.triangles[triangle, k]] for k in range(3))
        u, v = np.mod(np.multiply.outer(_R2, number + 1.0), 1.0)
        outside = u + v > 1.0  # the square's other half is folded back onto the triangle
        u, v = np.where(outside, 1.0 - u, u)[:, None], np.where(outside, 1.0 - v, v)[:, None]
        yield a + u * (b - a) + v * (c - a), normals[triangle] / doubled[triangle, None]


def _keys(points: FloatArray, normals: FloatArray, voxel_m: float) -> KeyArray:
    """One number for each point's voxel and the sector, of six, that its normal lies in; the lowest bit is free."""
    i, j, k = np.floor(points / voxel_m).astype(np.int64).T + _HALF
    leaning = normals @ _SECTOR_AXES.T
    axis = np.abs(leaning).argmax(axis=1)
    sector = 2 * axis + (leaning[np.arange(len(axis)), axis] > 0.0)
    return np.asarray((((k << _BITS | j) << _BITS | i) << 3 | sector) << 1)


def _contains(sorted_keys: KeyArray, keys: KeyArray) -> NDArray[np.bool_]:
    if not len(sorted_keys):
        return np.zeros(len(keys), dtype=bool)
    place = np.minimum(np.searchsorted(sorted_keys, keys), len(sorted_keys) - 1)
    return np.asarray(sorted_keys[place] == keys)
