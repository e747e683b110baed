"""The merged map: one averaged point a voxel, so that memory follows the mapped area, not the number of scans."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.state import Saved, State
from mapping.global_map import kernels

# Three signed voxel coordinates share one 64-bit key; 21 bits reach 52 km at voxels of 5 cm.
_BITS = 21
_OFFSET = 1 << (_BITS - 1)
_MASK = (1 << _BITS) - 1

# Columns of the sums kept for every voxel.
_POSITION, _VIEW, _COUNT = slice(0, 3), slice(3, 6), 6

# Points waiting to be merged, at least; merging fewer at a time would cost more than it saves.
_MIN_PENDING = 1_000_000


@dataclass(frozen=True, eq=False)
class PointCloud:
    """A map or a part of it.

    Attributes:
        points: (N, 3) float64, metres, in the world.
        normals: (N, 3) float64, unit length, towards the side it was seen from.
    """

    points: FloatArray
    normals: FloatArray

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class VoxelMeans:
    """What a map has summed up, a row a voxel, in its own frame: float32, columns as in `_POSITION` and so on.

    Attributes:
        rows: (M, 7) mean point, mean direction it was seen from, number of points.
    """

    rows: NDArray[np.float32]

    @property
    def points(self) -> FloatArray:
        """(M, 3)."""
        return self.rows[:, _POSITION].astype(np.float64)


@dataclass(frozen=True, eq=False)
class _Voxels:
    """Sums over points of one voxel each: keys (M,) int64, sums (M, 7) float32; once reduced, sorted and unique."""

    keys: NDArray[np.int64]
    sums: NDArray[np.float32]

    @classmethod
    def empty(cls) -> "_Voxels":
        return cls(np.empty(0, dtype=np.int64), np.empty((0, 7), dtype=np.float32))

    @classmethod
    def restored(cls, saved: Saved) -> "_Voxels":
        keys = saved.array("keys", (None,), np.int64)
        return cls(keys, saved.array("sums", (len(keys), _COUNT + 1), np.float32))

    @classmethod
    def join(cls, parts: "Sequence[_Voxels]") -> "_Voxels":
        """All of them after one another, equal keys not added up."""
        return cls(np.concatenate([part.keys for part in parts]), np.concatenate([part.sums for part in parts]))

    @classmethod
    def reduce(cls, keys: NDArray[np.int64], sums: NDArray[np.float32]) -> "_Voxels":
        """Add up the rows of equal keys."""
        if not len(keys):
            return cls.empty()
        unique, totals = np.empty_like(keys), np.empty_like(sums)
        count = kernels.add_up(np.argsort(keys), keys, sums, unique, totals)
        return cls(unique[:count].copy(), totals[:count].copy())

    def merged_with(self, other: "_Voxels") -> "_Voxels":
        """The sums of two reduced tables."""
        unique = np.empty(len(self.keys) + len(other.keys), dtype=np.int64)
        totals = np.empty((len(unique), 7), dtype=np.float32)
        count = kernels.merge(self.keys, self.sums, other.keys, other.sums, unique, totals)
        return _Voxels(unique[:count].copy(), totals[:count].copy())


class GlobalMap:
    """Accumulates scans into voxels.

    New points wait in a list and are merged into the sorted main table when there are as many as half of it, so that
    sorting costs little a scan, and memory stays within a small factor of the number of voxels.
    """

    def __init__(self, voxel_size_m: float) -> None:
        self.voxel_size_m = voxel_size_m
        self._merged = _Voxels.empty()
        self._pending: list[_Voxels] = []
        self._pending_size = 0
        self._lock = threading.Lock()  # a viewer may look while a scan is added

    def state(self) -> State:
        """The table and what waits to be merged; merging it now would round other sums."""
        with self._lock:
            self._pending = [_Voxels.join([_Voxels.empty(), *self._pending])]
            merged, pending = dict(vars(self._merged)), dict(vars(self._pending[0]))
        return {"voxel_size_m": self.voxel_size_m, "merged": merged, "pending": pending}

    @classmethod
    def restored(cls, saved: Saved) -> "GlobalMap":
        """The map with a state."""
        restored = cls(saved.number("voxel_size_m"))
        restored._merged = _Voxels.restored(saved.part("merged"))
        restored._pending = [_Voxels.restored(saved.part("pending"))]
        restored._pending_size = len(restored._pending[0].keys)
        return restored

    def add(self, points: FloatArray, T_world_lidar: FloatArray) -> None:
        """Add the points (N, 3) of a scan, in the LiDAR frame at the scan's stamp."""
        if not len(points):
            return
        keys, sums = np.empty(len(points), dtype=np.int64), np.empty((len(points), 7), dtype=np.float32)
        T = np.ascontiguousarray(T_world_lidar)
        kernels.write_sums(np.ascontiguousarray(points), T, self.voxel_size_m, keys, sums)
        self._wait(_Voxels(keys, sums))

    def add_means(self, means: VoxelMeans, T_world_map: FloatArray) -> None:
        """Add what another map has summed up, as if its points were added here."""
        if len(means.rows):
            views = means.rows[:, _VIEW].astype(np.float64) @ T_world_map[:3, :3].T
            self._add(transform_points(T_world_map, means.points), views, means.rows[:, _COUNT].astype(np.float64))

    def means(self) -> VoxelMeans:
        """What has been summed up so far."""
        voxels = self._well_seen(1)
        rows = np.empty_like(voxels.sums)
        rows[:, _POSITION] = self._means(voxels)
        rows[:, _VIEW] = voxels.sums[:, _VIEW] / voxels.sums[:, _COUNT, None]
        rows[:, _COUNT] = voxels.sums[:, _COUNT]
        return VoxelMeans(rows)

    def _add(self, world: FloatArray, views: FloatArray, counts: FloatArray) -> None:
        """Points (N, 3), the directions they were seen from, and how many points each stands for."""
        cells = np.floor(world / self.voxel_size_m)
        sums = np.empty((len(world), 7), dtype=np.float32)
        sums[:, _POSITION] = world - cells * self.voxel_size_m  # within the voxel, where float32 is exact enough
        sums[:, _VIEW] = views
        sums[:, :_COUNT] *= counts[:, None]
        sums[:, _COUNT] = counts
        self._wait(_Voxels(_pack(cells), sums))

    def _wait(self, voxels: _Voxels) -> None:
        with self._lock:
            self._pending.append(voxels)
            self._pending_size += len(voxels.keys)
            if self._pending_size > max(_MIN_PENDING, len(self._merged.keys) // 2):
                self._merge()

    def points(self, min_hits: int = 1) -> FloatArray:
        """The mean point (M, 3) of every voxel that holds at least `min_hits` points, in the world."""
        chosen = self._well_seen(min_hits)
        return self._means(chosen)

    def cloud(self, neighbours: int = 20, min_hits: int = 1, left_out: NDArray[np.bool_] | None = None) -> PointCloud:
        """The map with normals, estimated from the nearest points and turned towards the sensor.

        Args:
            neighbours: points that a normal is estimated from.
            min_hits: as in `points`.
            left_out: (M,) which of `points` are not to be there.
        """
        chosen = self._well_seen(min_hits)
        if left_out is not None:
            chosen = _Voxels(chosen.keys[~left_out], chosen.sums[~left_out])
        points = self._means(chosen)
        normals = estimate_normals(points, neighbours)
        seen_from = np.einsum("ij,ij->i", normals, chosen.sums[:, _VIEW])
        normals[seen_from < 0.0] *= -1.0
        return PointCloud(points, normals)

    def _well_seen(self, min_hits: int) -> _Voxels:
        with self._lock:
            self._merge()
            merged = self._merged
        if min_hits <= 1:
            return merged
        chosen = merged.sums[:, _COUNT] >= min_hits
        return _Voxels(merged.keys[chosen], merged.sums[chosen])

    def _means(self, voxels: _Voxels) -> FloatArray:
        within = voxels.sums[:, _POSITION] / voxels.sums[:, _COUNT, None]
        return _unpack(voxels.keys) * self.voxel_size_m + within

    def _merge(self) -> None:
        if not self._pending:
            return
        waiting = _Voxels.join(self._pending)
        self._pending, self._pending_size = [], 0
        self._merged = self._merged.merged_with(_Voxels.reduce(waiting.keys, waiting.sums))


def _pack(cells: FloatArray) -> NDArray[np.int64]:
    index = np.clip(cells, -_OFFSET, _OFFSET - 1).astype(np.int64) + _OFFSET
    return (index[:, 0] << 2 * _BITS) | (index[:, 1] << _BITS) | index[:, 2]


def _unpack(keys: NDArray[np.int64]) -> FloatArray:
    columns = [(keys >> 2 * _BITS) & _MASK, (keys >> _BITS) & _MASK, keys & _MASK]
    return np.stack(columns, axis=1).astype(np.float64) - _OFFSET


def estimate_normals(points: FloatArray, neighbours: int) -> FloatArray:
    """Unit normals (N, 3) of points (N, 3) by PCA of the nearest ones; their sign is arbitrary."""
    if len(points) < 3:
        return np.tile([0.0, 0.0, 1.0], (len(points), 1))
    import open3d as o3d

    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor.from_numpy(np.ascontiguousarray(points)))
    cloud.estimate_normals(max_nn=neighbours)  # type: ignore[call-arg] # the stub lacks the defaults
    return np.array(cloud.point.normals.numpy(), dtype=np.float64)


def voxel_size_for(points: FloatArray) -> float:
    """A voxel size that suits the scene: 1/50 of the median range of a scan's points (N, 3), from 5 to 25 cm.

    A street with a median range of 10 m is mapped at 20 cm, an office of 3 m at 6 cm.
    """
    if not len(points):
        return 0.1
    median_range = float(np.median(np.linalg.norm(points, axis=1)))
    return float(np.clip(round(median_range / 50.0, 2), 0.05, 0.25))
