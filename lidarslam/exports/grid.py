"""The occupancy grid of a run, as the map server of ROS and Nav2 reads it: map.yaml and map.pgm."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.files import make_directory, written
from lidarslam.exports.source import read_map
from lidarslam.mapping.global_map.occupancy_grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    GridOptions,
    OccupancyGrid,
    occupancy_grid,
)
from lidarslam.storage.finished_run import read_trajectory

SUFFIXES = (".yaml", ".yml")
_FINEST_M = 0.05
_GREY = {OCCUPIED: 0, UNKNOWN: 205, FREE: 254}
# The shade of the unknown, (255 - 205) / 255 = 0.1961, lies between them.
_THRESHOLDS = {"occupied_thresh": 0.65, "free_thresh": 0.196}


def export_grid(run: Path, out: Path, resolution_m: float | None, options: dict[str, float]) -> Iterator[str]:
    """Write the grid of a run to a .yaml file and an image; lines about it.

    Without a resolution, the edge of a cell is that of the map's voxels, at least 5 cm; the options are those of
    `GridOptions`.
    """
    trajectory, (cloud, voxel_m) = read_trajectory(run), read_map(run)
    chosen = resolution_m or max(_FINEST_M, round(voxel_m or 0.0, 2))
    asked = GridOptions(resolution_m=chosen, **options)
    try:
        grid = occupancy_grid(cloud.points, cloud.normals, trajectory.positions, asked)
    except ValueError as error:
        raise ConfigError(f"the grid would have {error}; take a larger --resolution or a smaller --max-range") from None
    if grid is None:
        raise InputError(f"{run}: no ground was found below the sensor; is z of the map upwards?")
    rows, columns = grid.cells.shape
    yield f"{columns:,} x {rows:,} cells of {chosen:g} m, {columns * chosen:.1f} x {rows * chosen:.1f} m"
    free, occupied = (float(np.mean(grid.cells == value)) for value in (FREE, OCCUPIED))
    yield f"free {100 * free:.1f} %, occupied {100 * occupied:.1f} %, unknown {100 * (1 - free - occupied):.1f} %"
    yield f"written to {', '.join(map(str, write_grid(out, grid)))}"


def write_grid(path: Path, grid: OccupancyGrid) -> list[Path]:
    """Write `path`, a .yaml file, and the image next to it; the files."""
    image = path.with_suffix(".pgm")
    pixels = np.full(grid.cells.shape, _GREY[UNKNOWN], dtype=np.uint8)
    for value, grey in _GREY.items():
        pixels[grid.cells == value] = grey
    origin = [round(float(grid.origin[0]), 6), round(float(grid.origin[1]), 6), 0.0]
    about = {"image": image.name, "mode": "trinary", "resolution": grid.resolution_m, "origin": origin, "negate": 0}
    make_directory(path.parent)
    with written(image) as partial:
        Image.fromarray(pixels[::-1]).save(partial, format="PPM")  # the first row of an image is its top
    with written(path) as partial:
        text = yaml.safe_dump({**about, **_THRESHOLDS}, sort_keys=False, default_flow_style=None)
        partial.write_text(text, encoding="utf-8")
    return [path, image]
