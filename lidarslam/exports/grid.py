"""The occupancy grid of a run."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lidarslam.core.errors import ConfigError, InputError
from lidarslam.exports.grid_files import write_grid
from lidarslam.mapping.global_map.products.occupancy_grid import FREE, OCCUPIED, GridOptions, occupancy_grid
from lidarslam.storage.finished_run import load_map, read_summary, read_trajectory

_FINEST_M = 0.05


def export_grid(run: Path, out: Path, resolution_m: float | None, options: dict[str, float]) -> Iterator[str]:
    """Write the grid; lines about it.

    Args:
        run: its directory.
        out: the .yaml file.
        resolution_m: edge of a cell; None for that of the map's voxels, at least 5 cm.
        options: the others of `GridOptions`.

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
