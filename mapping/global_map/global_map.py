"""The merged map: one averaged point per voxel, so that memory follows the mapped area, not the number of scans.

The final one is drawn without dynamic points, in one piece, or in tiles with a thinned overview.
"""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import OutputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import PointAttributes
from lidarslam.core.state import State, Stateful
from lidarslam.mapping.config import GlobalMapConfig
from lidarslam.mapping.global_map.moved_points import PlacedViews, seen_through
from lidarslam.mapping.global_map.point_cloud import PointCloud, estimate_normals
from lidarslam.mapping.global_map.voxels import (
    COUNT,
    POSITION,
    VIEW,
    Layout,
    Rows,
    Tile,
    TileStore,
    Tiling,
    Voxels,
    write_sums,
)
from lidarslam.mapping.surfels.voxel_hash import EMPTY, key_cells, reach_m

logger = logging.getLogger(__name__)

# Points waiting to be merged, at least; merging fewer at a time would cost more than it saves.
_MIN_PENDING = 250_000
# Those of more points are estimated tile by tile: they take half a kilobyte of memory per point. Neighbours of a tile's
# points are looked for within this distance around it.
_MANY_POINTS = 2_000_000
NORMALS_MARGIN_M = 10.0
# Voxels of an overview grow by this factor at a time, which leaves two thirds of the points.
_COARSER = 2.0**0.25


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


class GlobalMap(Stateful):
    """Accumulates scans into voxels, at most `most_points` of them in memory.

    New points wait in a list and are merged into the sorted main table when there are as many as half of it, so that
    sorting is cheap per scan, and memory stays within a small factor of the number of voxels. When the table has more
    voxels than it may, those of tiles that were not visited since it was merged before go to disk.
    """

    voxel_size_m: float
    most_points: int | None
    beyond: int  # number of points that were left out: farther from the origin than voxels reach
    _merged: Voxels
    _pending: list[Voxels]
    _store: TileStore | None  # None where the number of voxels is not bounded

    def __init__(self, voxel_size_m: float, most_points: int | None = None, store: TileStore | None = None) -> None:
        self.voxel_size_m, self.most_points, self.beyond = voxel_size_m, most_points, 0
        self._store = None if most_points is None else TileStore() if store is None else store
        self._merged, self._pending = Voxels.join([]), []
        self._after_restore()

    def _after_restore(self) -> None:
        self._pending_size = sum(len(part.keys) for part in self._pending)
        self._lock = threading.Lock()  # a viewer may look while a scan is added

    @property
    def is_whole(self) -> bool:
        """Whether all of it is in memory; of any other map, only `tiles` and `tile` give more than a part."""
        with self._lock:
            self._merge()
            return self._store is None or not len(self._store)

    def state(self) -> State:
        """The table and the points that wait: to merge them now would round other sums."""
        with self._lock:
            self._pending = [Voxels.join(self._pending)]
            return super().state()

    def add(self, points: FloatArray, T_world_lidar: FloatArray, attributes: PointAttributes | None = None) -> None:
        """Add the points (N, 3) of a scan, in the LiDAR frame at the scan's stamp, with their attributes."""
        attributes = attributes or PointAttributes()
        voxels = self._one_each(points, T_world_lidar, Layout.of(attributes))
        voxels.layout.write(attributes, voxels.sums)
        self._wait(voxels)

    def add_means(self, means: VoxelMeans, T_world_map: FloatArray) -> None:
        """Add the voxels of another map, as if its points were added here."""
        voxels = self._one_each(means_points(means), T_world_map, means.layout)
        sums, rows = voxels.sums, means.rows
        sums[:, VIEW] = rows[:, VIEW].astype(np.float64) @ T_world_map[:3, :3].T
        sums[:, :COUNT] *= rows[:, COUNT, None]
        sums[:, COUNT:] = rows[:, COUNT:]
        self._wait(voxels)

    def means(self, left_out: NDArray[np.bool_] | None = None) -> VoxelMeans:
        """The voxels so far, but for some (M,)."""
        voxels = self._voxels(left_out)
        rows = voxels.sums.copy()
        rows[:, POSITION] = self._mean_points(voxels)
        rows[:, VIEW] = voxels.sums[:, VIEW] / voxels.sums[:, COUNT, None]
        return VoxelMeans(rows, voxels.layout)

    def points(self) -> FloatArray:
        """The mean point (M, 3) of every voxel, in the world."""
        return self._mean_points(self._voxels())

    def cloud(self, left_out: NDArray[np.bool_] | None = None) -> PointCloud:
        """The map, but for some of `points` (M,); normals are estimated from the nearest, and face the sensor."""
        voxels = self._voxels(left_out)
        points = self._mean_points(voxels)
        normals = estimate_normals(points) if len(points) <= _MANY_POINTS else self._normals_by_tiles(voxels)
        normals[np.einsum("ij,ij->i", normals, voxels.sums[:, VIEW]) < 0.0] *= -1.0
        return PointCloud(points, normals, voxels.layout.attributes(voxels.sums))

    @property
    def tiling(self) -> Tiling:
        """The tiles of the map."""
        return Tiling(self.voxel_size_m)

    def tiles(self) -> list[Tile]:
        """All tiles that have voxels, in memory or not."""
        in_memory, store = self._voxels(), self._store
        return sorted({*self.tiling.tiles(in_memory.keys), *(store.tiles if store is not None else ())})

    def tile(self, tile: Tile, margin_m: float = 0.0) -> "GlobalMap":
        """A map of a tile alone, with a margin of its neighbours and the attributes of the whole map."""
        low, high = self.tiling.bounds(tile, margin_m)
        in_memory, parts = self._voxels(), [Voxels.join([])]
        if self._store is not None:
            parts[0] = Voxels(parts[0].keys, np.empty((0, self._store.layout.width), np.float32), self._store.layout)
            for near in self.tiling.around(low, high):
                parts += [voxels.within(low, high) for voxels in self._store.voxels(near)]
        parts.append(in_memory.within(low, high))
        cut = GlobalMap(self.voxel_size_m)
        cut._merged = Voxels.join(parts).reduced()
        return cut

    def lies_in(self, tile: Tile) -> NDArray[np.bool_]:
        """(M,) which of `points` lie in a tile."""
        return self.tiling.lies_in(tile, self._voxels().keys)

    def brightest(self) -> float:
        """The largest intensity of a voxel; 0 where none is known."""
        in_memory = self._voxels()
        stored = 0.0 if self._store is None else self._store.brightest
        return max(stored, in_memory.layout.largest_intensity(in_memory.sums))

    def _normals_by_tiles(self, voxels: Voxels) -> FloatArray:
        whole, codes = GlobalMap(self.voxel_size_m), self.tiling.codes(voxels.keys)
        whole._merged = voxels
        order = np.argsort(codes, kind="stable")
        normals = np.empty((len(voxels), 3))
        rows_of_tiles = np.split(order, np.flatnonzero(np.diff(codes[order])) + 1)
        for tile, rows in zip(whole.tiles(), rows_of_tiles, strict=True):
            part = whole.tile(tile, NORMALS_MARGIN_M)
            normals[rows] = estimate_normals(part.points())[part.lies_in(tile)]
        return normals

    def _one_each(self, points: FloatArray, T_world_lidar: FloatArray, layout: Layout) -> Voxels:
        """A row for each point (N, 3), with columns of that layout, its attributes not written yet."""
        keys, sums = np.empty(len(points), dtype=np.int64), np.zeros((len(points), layout.width), dtype=np.float32)
        write_sums(np.ascontiguousarray(points), np.ascontiguousarray(T_world_lidar), self.voxel_size_m, keys, sums)
        return Voxels(keys, sums, layout)

    def _wait(self, voxels: Voxels) -> None:
        is_beyond = voxels.keys == EMPTY
        with self._lock:
            if is_beyond.any():
                self.beyond += int(np.count_nonzero(is_beyond))
                voxels = voxels.chosen(~is_beyond)
            self._pending.append(voxels)
            self._pending_size += len(voxels.keys)
            most_waiting = max(_MIN_PENDING, len(self._merged) // 2)
            if self._pending_size > (most_waiting if self.most_points is None else min(most_waiting, self.most_points)):
                self._merge()

    def _merge(self) -> None:
        if self._pending_size:
            waiting = Voxels.join(self._pending).reduced()
            self._merged = self._merged.united(waiting)
            if self._store is not None and self.most_points is not None and len(self._merged) > self.most_points:
                self._merged = self._store.take(self._merged, self.tiling, waiting.keys, self.most_points)
        self._pending, self._pending_size = [], 0

    def _voxels(self, left_out: NDArray[np.bool_] | None = None) -> Voxels:
        with self._lock:
            self._merge()
            voxels = self._merged
        return voxels if left_out is None else voxels.chosen(~left_out)

    def _mean_points(self, voxels: Voxels) -> FloatArray:
        within = voxels.sums[:, POSITION] / voxels.sums[:, COUNT, None]
        return key_cells(voxels.keys) * self.voxel_size_m + within


def voxel_size_for(points: FloatArray) -> float:
    """A voxel size that suits the scene: 1/50 of the median range of a scan's points (N, 3), from 5 to 25 cm."""
    if not len(points):
        return 0.1
    median_range = float(np.median(np.linalg.norm(points, axis=1)))
    return float(np.clip(round(median_range / 50.0, 2), 0.05, 0.25))


@dataclass(frozen=True)
class TiledMap:
    """A map in tiles, each of them with at least one point."""

    tiling: Tiling
    points: dict[Tile, int]  # their number in each tile
    brightest: float  # the largest intensity in all of them

    @property
    def total(self) -> int:
        """Number of points."""
        return sum(self.points.values())

    def to_json(self) -> dict[str, float | int]:
        """The entry of summary.json."""
        return {"tiles": len(self.points), "points": self.total, "voxel_size_m": self.tiling.voxel_size_m}


@dataclass(frozen=True, eq=False)
class DrawnMap:
    """The final map."""

    # cloud, voxel_size_m: its points, one in each voxel; None when no scan was added
    cloud: PointCloud | None
    voxel_size_m: float | None
    moved: int = 0  # number of points that were removed as moving objects
    tiled: TiledMap | None = None  # all of the map, where `cloud` is an overview
    warning: str | None = None  # points that lie beyond the reach of the voxels
    failure: OutputError | None = None  # of the tiles, where `cloud` is an overview without them


WriteTile = Callable[[Tile, PointCloud, float], None]
"""Called with each tile that has points, these points, and the largest intensity of the map."""


def drawn_map(
    global_map: GlobalMap | None, views: PlacedViews, config: GlobalMapConfig, write_tile: WriteTile | None = None
) -> DrawnMap:
    """A map without the points that the views see through.

    A map that is not in memory as a whole is drawn tile by tile, and thinned to the number of points that it may have.
    """
    if global_map is None:
        return DrawnMap(None, None)
    if not global_map.is_whole:
        return replace(_drawn_in_tiles(global_map, views, config, write_tile), warning=_warning(global_map))
    moved = seen_through(global_map.points(), views, global_map.voxel_size_m)
    cloud = global_map.cloud(moved)
    return DrawnMap(_with_fields(cloud, config), global_map.voxel_size_m, int(moved.sum()), None, _warning(global_map))


def _warning(global_map: GlobalMap) -> str | None:
    if not global_map.beyond:
        return None
    size_m = global_map.voxel_size_m
    return (
        f"{global_map.beyond:,} points lie farther from the first scan than voxels of {size_m:g} m reach,"
        f" {reach_m(size_m) / 1000.0:.0f} km, and are not in the map; set a larger global_map.voxel_size_m"
    )


def _drawn_in_tiles(
    global_map: GlobalMap, views: PlacedViews, config: GlobalMapConfig, write_tile: WriteTile | None
) -> DrawnMap:
    tiles, brightest = global_map.tiles(), global_map.brightest()
    logger.info("drawing the map in %d tiles", len(tiles))
    overview = _Overview(global_map.voxel_size_m, global_map.most_points)
    points, moved_in_all = {}, 0
    for tile in tiles:
        part = global_map.tile(tile, NORMALS_MARGIN_M)
        inside = part.lies_in(tile)
        moved = seen_through(part.points(), views, part.voxel_size_m)
        moved_in_all += int((moved & inside).sum())
        if not (inside & ~moved).any():
            continue
        points[tile] = int((inside & ~moved).sum())
        overview.add(part.means(moved | ~inside))
        if write_tile is not None:
            cloud = part.cloud(moved).select(inside[~moved])
            write_tile(tile, _with_fields(cloud, config), brightest)
    cloud = _with_fields(overview.merged().cloud(), config)
    return DrawnMap(cloud, overview.voxel_size_m, moved_in_all, TiledMap(global_map.tiling, points, brightest))


class _Overview:
    """Parts of a map on common voxels, as small as a number of points allows."""

    def __init__(self, voxel_size_m: float, most_points: int | None) -> None:
        self.voxel_size_m, self._most_points = voxel_size_m, most_points
        self._parts: list[VoxelMeans] = []

    def add(self, part: VoxelMeans) -> None:
        self._parts.append(self._merged([part]).means())
        while self._most_points is not None and sum(map(len, self._parts)) > self._most_points:
            self.voxel_size_m = round(_COARSER * self.voxel_size_m, 3)
            self._parts = [self._merged(self._parts).means()]

    def merged(self) -> GlobalMap:
        return self._merged(self._parts)

    def _merged(self, parts: list[VoxelMeans]) -> GlobalMap:
        merged = GlobalMap(self.voxel_size_m)
        for part in parts:
            merged.add_means(part, np.eye(4))
        return merged


def _with_fields(cloud: PointCloud, config: GlobalMapConfig) -> PointCloud:
    return replace(cloud, attributes=cloud.attributes.only(config.fields))
