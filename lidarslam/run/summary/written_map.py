"""The map in summary.json."""

from dataclasses import dataclass
from typing import Any

from lidarslam.mapping.global_map.drawing import TiledMap


@dataclass(frozen=True)
class WrittenMap:
    """The map as it was written."""

    # points, voxel_size_m: number of points and edge of a voxel; None without a map
    points: int
    voxel_size_m: float | None
    moved: int  # number of points that were removed as moving objects
    entropy: float | None = None  # mean map entropy, see `evaluation.map.entropy`; None where it cannot be computed
    fields: tuple[str, ...] = ()  # the attributes of its points
    tiled: TiledMap | None = None  # all of it, where `points` are those of an overview

    def to_json(self) -> dict[str, Any]:
        """Its keys of summary.json."""
        return {
            "map_points": self.points,
            "map_voxel_size_m": self.voxel_size_m,
            "map_points_moved": self.moved,
            "map_entropy": self.entropy,
            "map_fields": list(self.fields),
            "map_tiles": None if self.tiled is None else self.tiled.to_json(),
        }
