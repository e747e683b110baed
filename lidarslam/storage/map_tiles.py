"""The folder `map` of a run: a large map as LAZ tiles, and index.json, which lists them."""

from typing import Any

from lidarslam.core.errors import OutputError
from lidarslam.core.files import cannot_write, make_own_folder
from lidarslam.mapping.global_map.drawing import TiledMap
from lidarslam.mapping.global_map.global_map import PointCloud
from lidarslam.mapping.global_map.map_io import write_cloud
from lidarslam.mapping.global_map.tile_store import Tile
from lidarslam.storage.directory import MAP_INDEX, MAP_TILES, RunDirectory


class TileWriter:
    """Writes the tiles of a map, and then the index, without which they are nothing."""

    def __init__(self, directory: RunDirectory) -> None:
        self._directory = directory
        self._entries: dict[Tile, dict[str, Any]] = {}
        self.failure: OutputError | None = None  # of the first tile that could not be written, after which none is

    def write(self, tile: Tile, cloud: PointCloud, brightest: float) -> None:
        """Write a tile with at least one point; see `mapping.global_map.drawing.WriteTile`.

        Raises:
            OutputError: a file is in the way of the folder.
        """
        if self.failure is None and not self._entries:
            self._begin()
        if self.failure is None:
            try:
                self._write(tile, cloud, brightest)
            except OutputError as error:
                self.failure = error
                self._remove()

    def _write(self, tile: Tile, cloud: PointCloud, brightest: float) -> None:
        name = f"{tile[0]}_{tile[1]}.laz"
        with self._directory.replacing(f"{MAP_TILES}/{name}") as path:
            write_cloud(path, cloud, brightest)
        self._entries[tile] = {
            "file": name,
            "tile": list(tile),
            "points": len(cloud),
            "min": cloud.points.min(axis=0).round(4).tolist(),
            "max": cloud.points.max(axis=0).round(4).tolist(),
        }

    def finish(self, tiled: TiledMap) -> None:
        """Write the index.

        Raises:
            OutputError: it could not be written.
        """
        index = {
            "frame": "world",  # of trajectory.tum
            "tile_edge_m": round(tiled.tiling.edge_m, 9),
            "voxel_size_m": tiled.tiling.voxel_size_m,
            "points": tiled.total,
            "tiles": [self._entries[tile] for tile in tiled.points],
        }
        self._directory.write_json(MAP_INDEX, index)

    def _begin(self) -> None:
        folder = self._directory.path / MAP_TILES
        self._directory.before_change()
        try:
            make_own_folder(folder)
            (self._directory.path / MAP_INDEX).unlink(missing_ok=True)  # first: tiles of an earlier run are replaced
        except (FileExistsError, NotADirectoryError) as error:
            raise OutputError(f"{folder}: a file is in the way; name another directory") from error
        except OSError as error:
            self.failure = cannot_write(folder, error)

    def _remove(self) -> None:
        """Leave the room of the tiles to the other results."""
        for entry in self._entries.values():
            (self._directory.path / MAP_TILES / entry["file"]).unlink(missing_ok=True)
