"""The occupancy grid of a run, as the map server of ROS and Nav2 reads it: map.yaml and map.pgm."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from lidarslam.core.errors import ConfigError, InputError, OutputError
from lidarslam.core.files import cannot_write, make_directory, replacing
from lidarslam.mapping.global_map.occupancy_grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    GridOptions,
    OccupancyGrid,
    occupancy_grid,
)
from lidarslam.storage.finished_run import load_map, read_summary, read_trajectory

_FINEST_M = 0.05
_GREY = {OCCUPIED: 0, UNKNOWN: 205, FREE: 254}
# The shade of the unknown, (255 - 205) / 255 = 0.1961, lies between them.
_THRESHOLDS = {"occupied_thresh": 0.65, "free_thresh": 0.196}


def export_grid(run: Path, out: Path, resolution_m: float | None, options: dict[str, float]) -> Iterator[str]:
    """Write the grid of a run to a .yaml file and an image; lines about it.

    Without a resolution, the edge of a cell is that of the map's voxels, at least 5 cm; the options are those of
    `GridOptions`.

    Raises:
        InputError: there is no run, no map, or no ground in it.
        OutputError: the files cannot be written.
    """
    trajectory, cloud = read_trajectory(run), load_map(run)
    if not len(cloud):
        raise InputError(f"{run}: has no map")
    voxel = read_summary(run).get("map_voxel_size_m")
    chosen = resolution_m or max(_FINEST_M, round(voxel or 0.0, 2))
    try:
        grid = occupancy_grid(
            cloud.points, cloud.normals, trajectory.positions, GridOptions(resolution_m=chosen, **options)
        )
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
    """Write `path`, a .yaml file, and the image next to it; the files.

    Raises:
        OutputError: they cannot be written.
    """
    image = path.with_suffix(".pgm")
    pixels = np.full(grid.cells.shape, _GREY[UNKNOWN], dtype=np.uint8)
    for value, grey in _GREY.items():
        pixels[grid.cells == value] = grey
    about = {
        "image": image.name,
        "mode": "trinary",
        "resolution": grid.resolution_m,
        "origin": [round(float(grid.origin[0]), 6), round(float(grid.origin[1]), 6), 0.0],
        "negate": 0,
        **_THRESHOLDS,
    }
    make_directory(path.parent)
    try:
        with replacing(image) as partial:
            Image.fromarray(pixels[::-1]).save(partial, format="PPM")  # the first row of an image is its top
        with replacing(path) as partial:
            partial.write_text(yaml.safe_dump(about, sort_keys=False, default_flow_style=None), encoding="utf-8")
    except OSError as error:
        raise cannot_write(path, error) from error
    return [path, image]


def require_yaml(path: Path) -> None:
    """Check the suffix of a grid.

    Raises:
        OutputError: it is not .yaml.
    """
    if path.suffix not in (".yaml", ".yml"):
        raise OutputError(f"{path}: expected a .yaml file, such as map.yaml; the image map.pgm is written beside it")
