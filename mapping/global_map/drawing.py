"""The final map: without dynamic points, in one piece, or in tiles with a thinned overview."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.errors import OutputError
from lidarslam.mapping.config import GlobalMapConfig
from lidarslam.mapping.global_map.global_map import NORMALS_MARGIN_M, GlobalMap, VoxelMeans
from lidarslam.mapping.global_map.moved_points import PlacedViews, seen_through
from lidarslam.mapping.global_map.point_cloud import PointCloud
from lidarslam.mapping.global_map.voxels import Tile, Tiling
from lidarslam.mapping.surfels.voxel_hash import reach_m

logger = logging.getLogger(__name__)

# Voxels of an overview grow by this factor at a time, which leaves two thirds of the points.
_COARSER = 2.0**0.25


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
