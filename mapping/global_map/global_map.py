"""The merged map: one averaged point a voxel, so that memory follows the mapped area, not the number of scans."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.scan import PointAttributes
from lidarslam.core.state.stateful import State, Stateful
from lidarslam.mapping.global_map import kernels
from lidarslam.mapping.global_map.voxel_rows import COUNT, POSITION, VIEW, Layout, Rows
from lidarslam.mapping.surfels.voxel_hash import key_cells, point_keys

# Points waiting to be merged, at least; merging fewer at a time would cost more than it saves.
_MIN_PENDING = 1_000_000
# Nearest points that a normal is estimated from.
_NORMAL_NEIGHBOURS = 20


@dataclass(frozen=True, eq=False)
class VoxelMeans:
    """A map's voxels, in its own frame."""

    rows: Rows  # (M, width) mean point, mean direction to the sensor, number of points; sums of attributes
    layout: Layout  # of the rows

    def __len__(self) -> int:
        return len(self.rows)


def means_points(means: VoxelMeans) -> FloatArray:
    """(M, 3) mean points."""
    return means.rows[:, POSITION].astype(np.float64)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """A map or a part of it."""

    points: FloatArray  # (N, 3) float64, metres, in the world
    normals: FloatArray  # (N, 3) float64, unit length, towards the side it was seen from
    attributes: PointAttributes = field(default_factory=PointAttributes)  # of the points

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class _Voxels:
    """Sums over points of one voxel each: keys (M,) int64, sums (M, width); once reduced, sorted and unique."""

    keys: NDArray[np.int64]
    sums: NDArray[np.float32]
    layout: Layout

    def __post_init__(self) -> None:
        if self.sums.shape != (len(self.keys), self.layout.width):
            raise ValueError(f"expected sums ({len(self.keys)}, {self.layout.width}), got {self.sums.shape}")

    @classmethod
    def join(cls, parts: "Sequence[_Voxels]") -> "_Voxels":
        """All of them after one another, equal keys not added up."""
        layout = Layout.union([part.layout for part in parts])
        wide = (part.layout.widened(part.sums, layout) for part in parts)
        return cls(
            np.concatenate([np.empty(0, dtype=np.int64), *(part.keys for part in parts)]),
            np.concatenate([np.empty((0, layout.width), dtype=np.float32), *wide]),
            layout,
        )

    def reduced(self) -> "_Voxels":
        """Rows of equal keys added up, in the order of keys."""
        unique, totals = np.empty_like(self.keys), np.empty_like(self.sums)
        order = np.argsort(self.keys)
        count = kernels.add_up(order, self.keys, self.sums, self.layout.summed, unique, totals)
        return _Voxels(unique[:count].copy(), totals[:count].copy(), self.layout)

    def united(self, other: "_Voxels") -> "_Voxels":
        """Both of them, reduced; both are reduced already."""
        layout = Layout.union([self.layout, other.layout])
        sums = [part.layout.widened(part.sums, layout) for part in (self, other)]
        unique = np.empty(len(self.keys) + len(other.keys), dtype=np.int64)
        totals = np.empty((len(unique), layout.width), dtype=np.float32)
        count = kernels.unite(self.keys, sums[0], other.keys, sums[1], layout.summed, unique, totals)
        return _Voxels(unique[:count].copy(), totals[:count].copy(), layout)

    def chosen(self, rows: NDArray[np.bool_]) -> "_Voxels":
        """Some of them."""
        return _Voxels(self.keys[rows], self.sums[rows], self.layout)


class GlobalMap(Stateful):
    """Accumulates scans into voxels.

    New points wait in a list and are merged into the sorted main table when there are as many as half of it, so that
    sorting costs little a scan, and memory stays within a small factor of the number of voxels.
    """

    voxel_size_m: float
    _merged: _Voxels
    _pending: list[_Voxels]

    def __init__(self, voxel_size_m: float) -> None:
        self.voxel_size_m = voxel_size_m
        self._merged, self._pending = _Voxels.join([]), []
        self._after_restore()

    def _after_restore(self) -> None:
        self._pending_size = sum(len(part.keys) for part in self._pending)
        self._lock = threading.Lock()  # a viewer may look while a scan is added

    def state(self) -> State:
        """The table and the points that wait: to merge them now would round other sums."""
        with self._lock:
            self._pending = [_Voxels.join(self._pending)]
            return super().state()

    def add(self, points: FloatArray, T_world_lidar: FloatArray, attributes: PointAttributes | None = None) -> None:
        """Add the points (N, 3) of a scan, in the LiDAR frame at the scan's stamp, with what is known of them."""
        attributes = attributes or PointAttributes()
        layout = Layout.of(attributes)
        keys, sums = np.empty(len(points), dtype=np.int64), np.empty((len(points), layout.width), dtype=np.float32)
        T = np.ascontiguousarray(T_world_lidar)
        kernels.write_sums(np.ascontiguousarray(points), T, self.voxel_size_m, keys, sums)
        layout.write(attributes, sums)
        self._wait(_Voxels(keys, sums, layout))

    def add_means(self, means: VoxelMeans, T_world_map: FloatArray) -> None:
        """Add the voxels of another map, as if its points were added here."""
        world = transform_points(T_world_map, means_points(means))
        sums = means.rows.copy()
        keys = point_keys(world, self.voxel_size_m)
        sums[:, POSITION] = (
            world - key_cells(keys) * self.voxel_size_m
        )  # within the voxel, where float32 is exact enough
        sums[:, VIEW] = means.rows[:, VIEW].astype(np.float64) @ T_world_map[:3, :3].T
        sums[:, :COUNT] *= means.rows[:, COUNT, None]
        self._wait(_Voxels(keys, sums, means.layout))

    def means(self) -> VoxelMeans:
        """The voxels so far."""
        voxels = self._voxels(1)
        rows = voxels.sums.copy()
        rows[:, POSITION] = self._mean_points(voxels)
        rows[:, VIEW] = voxels.sums[:, VIEW] / voxels.sums[:, COUNT, None]
        return VoxelMeans(rows, voxels.layout)

    def points(self, min_hits: int = 1) -> FloatArray:
        """The mean point (M, 3) of every voxel that holds at least `min_hits` points, in the world."""
        return self._mean_points(self._voxels(min_hits))

    def cloud(self, min_hits: int = 1, left_out: NDArray[np.bool_] | None = None) -> PointCloud:
        """The map, its normals estimated from the nearest points and turned towards the sensor.

        Args:
            min_hits: as in `points`.
            left_out: (M,) which of `points` are left out.
        """
        voxels = self._voxels(min_hits)
        if left_out is not None:
            voxels = voxels.chosen(~left_out)
        points = self._mean_points(voxels)
        normals = estimate_normals(points)
        normals[np.einsum("ij,ij->i", normals, voxels.sums[:, VIEW]) < 0.0] *= -1.0
        return PointCloud(points, normals, voxels.layout.attributes(voxels.sums))

    def _wait(self, voxels: _Voxels) -> None:
        with self._lock:
            self._pending.append(voxels)
            self._pending_size += len(voxels.keys)
            if self._pending_size > max(_MIN_PENDING, len(self._merged.keys) // 2):
                self._merge()

    def _merge(self) -> None:
        if self._pending_size:
            waiting = _Voxels.join(self._pending).reduced()
            self._merged = self._merged.united(waiting)
        self._pending, self._pending_size = [], 0

    def _voxels(self, min_hits: int) -> _Voxels:
        with self._lock:
            self._merge()
            merged = self._merged
        return merged if min_hits <= 1 else merged.chosen(merged.sums[:, COUNT] >= min_hits)

    def _mean_points(self, voxels: _Voxels) -> FloatArray:
        within = voxels.sums[:, POSITION] / voxels.sums[:, COUNT, None]
        return key_cells(voxels.keys) * self.voxel_size_m + within


def estimate_normals(points: FloatArray) -> FloatArray:
    """Unit normals (N, 3) of points (N, 3) by PCA of the nearest ones; their sign is arbitrary."""
    if len(points) < 3:
        return np.tile([0.0, 0.0, 1.0], (len(points), 1))
    import open3d as o3d

    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor.from_numpy(np.ascontiguousarray(points)))
    cloud.estimate_normals(max_nn=_NORMAL_NEIGHBOURS)  # type: ignore[call-arg] # the stub lacks the defaults
    return np.array(cloud.point.normals.numpy(), dtype=np.float64)


def voxel_size_for(points: FloatArray) -> float:
    """A voxel size that suits the scene: 1/50 of the median range of a scan's points (N, 3), from 5 to 25 cm.

    A street with a median range of 10 m is mapped at 20 cm, an office of 3 m at 6 cm.
    """
    if not len(points):
        return 0.1
    median_range = float(np.median(np.linalg.norm(points, axis=1)))
    return float(np.clip(round(median_range / 50.0, 2), 0.05, 0.25))
