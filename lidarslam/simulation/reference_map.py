"""The true map: even samples of the surfaces that a recording has seen."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.mesh import Mesh, Pieces, pieces_near, world_mesh
from lidarslam.simulation.recorder import Echoes, Simulation

KeyArray = NDArray[np.int64]

_BLOCK = 1 << 19
# Voxel indices take 19 bits each, the sector of the normal 3, the side 1.
_BITS, _HALF = 19, 1 << 18
# Turned axes, so that the directions common in buildings do not lie between two sectors.
_SECTOR_AXES = np.array([[0.86, 0.36, 0.36], [-0.48, 0.81, 0.34], [-0.17, -0.46, 0.87]])
# Of Roberts' R2 sequence, whose points fill the unit square evenly: 1/g and 1/g^2 with g^3 = g + 1.
_R2 = np.array([0.7548776662466927, 0.5698402909980532])


class ReferenceMap(NamedTuple):
    """Points (N, 3) in the world and the unit normals (N, 3) on the side that was seen."""

    points: FloatArray
    normals: FloatArray


@dataclass(eq=False)
class SeenSurfaces:
    """Surfaces that noise-free rays have met: voxels, and in each the directions that the surface faces.

    The direction keeps the far side of a wall out of the map when only the near side was seen.
    """

    voxel_m: float = 0.2
    _keys: KeyArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    _pending: list[KeyArray] = field(default_factory=list)

    def add_sweep(self, echoes: Echoes, min_range_m: float) -> None:
        """Add the true hits of one sweep on static surfaces within the sensor's range."""
        hits = echoes.hits
        met = np.flatnonzero(np.isfinite(hits.ranges) & ~hits.moving & (hits.ranges >= min_range_m))
        points = echoes.origins[met] + hits.ranges[met, None] * echoes.directions[met]
        normals = hits.normals[met].astype(np.float64)
        self.add(points, normals, np.einsum("ij,ij->i", normals, echoes.directions[met]) > 0.0)

    def add(self, points: FloatArray, normals: FloatArray, from_behind: NDArray[np.bool_]) -> None:
        """Add hits (N, 3) with their surfaces' outward normals (N, 3) and whether they were met from inside (N,)."""
        self.add_keys(_unique(_voxels(points, self.voxel_m) | _sectors(normals) | from_behind))

    def keys(self) -> KeyArray:
        """Sorted keys of the seen surfaces."""
        self._keys = _unique(np.concatenate([self._keys, *self._pending]))
        self._pending.clear()
        return self._keys

    def add_keys(self, keys: KeyArray) -> None:
        """Add surfaces that were seen elsewhere, by their keys."""
        self._pending.append(keys)
        if sum(map(len, self._pending)) > max(_BLOCK, len(self._keys)):
            self.keys()


def reference_map(simulation: Simulation, spacing_m: float | None = None, step: int = 1) -> ReferenceMap:
    """The map of the static world that every `step`-th scan of a simulation saw.

    Its points are `spacing_m` apart, by default the spacing of the world.
    """
    seen = SeenSurfaces()
    for index in range(0, len(simulation), step):
        seen.add_sweep(simulation.echoes(index), simulation.sensor.ranging.min_range_m)
    return sample_seen(world_mesh(simulation.world), seen, spacing_m or simulation.world.map_spacing_m)


def sample_seen(mesh: Mesh, seen: SeenSurfaces, spacing_m: float = 0.05) -> ReferenceMap:
    """Samples of the mesh, one to each `spacing_m` squared, in or next to voxels that were seen.

    Time and memory are those of the seen surfaces, not of the mesh, which is traversed once.
    """
    around = seen.keys()
    for axis in range(3):
        step = np.int64(1) << (_BITS * axis + 4)
        around = _unique(np.concatenate([around - step, around, around + step]))
    cells = (_unique(around >> 4)[:, None] >> _BITS * np.arange(3) & (1 << _BITS) - 1) - _HALF
    pieces = pieces_near(mesh, cells, seen.voxel_m)
    facing = pieces.normals
    sectors = _sectors(facing)
    points, normals = [np.empty((0, 3))], [np.empty((0, 3))]
    for sampled, piece in _samples(pieces, spacing_m):
        front, behind = _sides(around, _voxels(sampled, seen.voxel_m) | sectors[piece])
        kept = np.flatnonzero(front | behind)
        points.append(sampled[kept])
        normals.append(facing[piece[kept]] * np.where(front[kept], 1.0, -1.0)[:, None])
    return ReferenceMap(np.concatenate(points), np.concatenate(normals))


def _samples(pieces: Pieces, spacing_m: float) -> Iterator[tuple[FloatArray, NDArray[np.intp]]]:
    """Blocks of points (N, 3) and the pieces (N,) they are on.

    Sample n of the mesh is where the area before it is n + 1/2 times a sample's share, so that the samples of a piece
    are the same, whichever other pieces were seen.
    """
    a, b, c = np.moveaxis(pieces.corners, 1, 0)
    first, end = (np.ceil(area / spacing_m**2 - 0.5).astype(np.int64) for area in (pieces.starts, pieces.ends))
    until = np.cumsum(end - first)
    for start in range(0, int(until[-1]) if len(until) else 0, _BLOCK):
        place = np.arange(start, min(start + _BLOCK, until[-1]))
        piece = np.searchsorted(until, place, side="right")
        u, v = _even_in_triangle(end[piece] - (until[piece] - place))
        corner = a[piece]
        yield corner + u[:, None] * (b - a)[piece] + v[:, None] * (c - a)[piece], piece


def _even_in_triangle(numbers: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """u and v (N,) with u + v <= 1, evenly spread over the triangle for any run of numbers (N,).

    The square's points are pressed into the triangle without folding it, which would place points on one another
    (Heitz, A Low-Distortion Map Between Triangle and Square, 2019).
    """
    u, v = np.mod(np.multiply.outer(_R2, numbers + 1.0), 1.0)
    less = 0.5 * np.minimum(u, v)
    return np.where(v > u, less, u - less), np.where(v > u, v - less, less)


def _voxels(points: FloatArray, voxel_m: float) -> KeyArray:
    """The upper bits (N,) of the keys of points (N, 3)."""
    i, j, k = np.floor(points.T / voxel_m).astype(np.int64) + _HALF
    return np.asarray(((k << _BITS | j) << _BITS | i) << 4)


def _sectors(normals: FloatArray) -> KeyArray:
    """The sector (N,), of six, of normals (N, 3), as bits 1 to 3 of the keys."""
    leaning = normals @ _SECTOR_AXES.T
    axis = np.abs(leaning).argmax(axis=1)
    return np.asarray((2 * axis + (leaning[np.arange(len(axis)), axis] > 0.0)) << 1)


def _sides(sorted_keys: KeyArray, keys: KeyArray) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether a point's side was seen (N,), and its far side (N,), whose key comes right after it."""
    last = len(sorted_keys) - 1
    place = np.searchsorted(sorted_keys, keys)
    front = sorted_keys[np.minimum(place, last)] == keys
    return front, sorted_keys[np.minimum(place + front, last)] == keys | 1


def _unique(keys: KeyArray) -> KeyArray:
    """The same as `np.unique`, which hashes whole numbers and is slower where many are the same."""
    keys = np.sort(keys)
    return np.asarray(keys[np.concatenate([[True], np.diff(keys) > 0])] if len(keys) else keys)
