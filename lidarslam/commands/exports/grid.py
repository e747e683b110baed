"""`lidarslam export-grid`: the occupancy grid of a run."""

from pathlib import Path

import click

from lidarslam.commands.shared.options import PATH, POSITIVE, CommandWithExample
from lidarslam.commands.shared.terminal import say


@click.command(
    "export-grid",
    cls=CommandWithExample,
    epilog="""lidarslam export-grid runs/office -o map.yaml
    lidarslam export-grid runs/site -o map.yaml --resolution 0.1 --min-height 0.2 --max-height 1.2""",
)
@click.argument("run", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, metavar="FILE", help="The .yaml file; the .pgm lies beside it.")
@click.option(
    "--resolution",
    "resolution_m",
    type=POSITIVE,
    help="Edge of a cell, m.  [default: 0.05, or the voxels of the map if they are larger]",
)
@click.option(
    "--min-height", "min_height_m", type=POSITIVE, default=0.15, show_default=True, help="Least height of obstacles, m."
)
@click.option(
    "--max-height", "max_height_m", type=POSITIVE, default=1.8, show_default=True, help="Height of the robot, m."
)
@click.option(
    "--robot-radius",
    "robot_radius_m",
    type=POSITIVE,
    default=0.3,
    show_default=True,
    help="Distance from the path within which cells are free, m.",
)
@click.option(
    "--max-range",
    "max_range_m",
    type=POSITIVE,
    default=30.0,
    show_default=True,
    help="Largest distance from the path, m.",
)
@click.option("--overwrite", is_flag=True, help="Replace earlier files.")
def export_grid(run: Path, out: Path, resolution_m: float | None, overwrite: bool, **heights: float) -> None:
    """Write the map as an occupancy grid: map.yaml and map.pgm for Nav2.

    RUN is a run directory. Obstacles are points between two heights above the local ground.
    """
    from lidarslam.exports.grid import export_grid
    from lidarslam.exports.grid_files import require_yaml
    from lidarslam.exports.new_file import require_new

    require_yaml(out)
    for file in (out, out.with_suffix(".pgm")):
        require_new(file, overwrite)
    for line in export_grid(run, out, resolution_m, heights):
        say(line)
