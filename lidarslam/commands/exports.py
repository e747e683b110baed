"""`lidarslam map` and `lidarslam export-...`: results of a run in the formats of other programs."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from lidarslam.commands.options import FILE, PATH, POSITIVE, command
from lidarslam.commands.terminal import say

_COUNT = click.IntRange(min=1)
_RUN = click.argument("run", type=PATH)
_OVERWRITE = click.option("--overwrite", is_flag=True, help="Replace earlier files.")


def _out(metavar: str, text: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    return click.option("-o", "--out", type=PATH, required=True, metavar=metavar, help=text)


def _require_suffix(out: Path, suffixes: Sequence[str]) -> None:
    if out.suffix not in suffixes:
        raise click.UsageError(f"--out {out}: expected a file {', '.join(suffixes)}")


@command(
    """lidarslam map runs/office -o office.ply --level ground --ground-at-zero
    lidarslam map runs/office -o slice.pcd --box -10 10 -5 5 0.2 1.8 --within 8
    lidarslam map runs/street -o clean.laz --moved 2 --statistical 20 2.5
    lidarslam map runs/hall annex.ply -o site.ply --register""",
    name="map",
)
@click.argument("sources", type=PATH, nargs=-1, required=True, metavar="SOURCE...")
@_out("FILE", ".ply, .pcd, .laz or .e57 file.")
@click.option(
    "--moved",
    type=click.IntRange(min=0),
    metavar="N",
    help="Draw the map again from the recording, without what N range images saw through (a run: 3); 0 keeps all.",
)
@click.option(
    "--transform",
    "transforms",
    type=FILE,
    multiple=True,
    help="Text file with the 4x4 pose of a further source in the frame of the first; one for each, in their order.",
)
@click.option("--register", is_flag=True, help="Register further sources to the first.")
@click.option(
    "--statistical",
    type=(_COUNT, POSITIVE),
    metavar="N SIGMAS",
    help="Remove points whose mean distance to N neighbours is SIGMAS standard deviations above the average.",
)
@click.option(
    "--radius",
    type=(_COUNT, POSITIVE),
    metavar="N M",
    help="Remove points with fewer than N neighbours within M metres.",
)
@click.option("--level", type=click.Choice(["ground", "gravity"]), help="Turn the ground's normal, or up, to z.")
@click.option("--ground-at-zero", is_flag=True, help="Shift the ground below the origin to z = 0.")
@click.option("--box", type=float, nargs=6, metavar="X X Y Y Z Z", help="Keep a box, from and to, m; once levelled.")
@click.option("--within", "within_m", type=POSITIVE, metavar="M", help="Keep what is within M metres of the path.")
@_OVERWRITE
def edit(sources: tuple[Path, ...], out: Path, overwrite: bool, **options: Any) -> None:
    """Join, clean, level and crop maps.

    SOURCE is a run directory, or a .ply or .pcd cloud; several are in one frame unless --transform or --register says
    where they lie. The edits are made in the order of the options here.
    """
    from lidarslam.exports.map import MAP_SUFFIXES, MapEdits, edit_map
    from lidarslam.exports.source import require_new
    from lidarslam.mapping.global_map.point_cloud import require_format

    _require_suffix(out, MAP_SUFFIXES)
    if options["transforms"] and len(options["transforms"]) != len(sources) - 1:
        raise click.UsageError(f"expected a --transform for each of the {len(sources) - 1} further sources")
    box = options["box"]
    if box is not None and not all(low < high for low, high in zip(box[::2], box[1::2], strict=True)):
        raise click.UsageError(f"--box {' '.join(f'{side:g}' for side in box)}: expected each from less than its to")
    if out.suffix == ".e57":
        require_format("e57")
    require_new(out, overwrite, *sources)
    for line in edit_map(sources, out, MapEdits(**options)):
        say(line)


@command(
    """lidarslam export-bag runs/office -o office_slam.mcap
    lidarslam export-bag runs/office -o office_slam.bag --no-clouds""",
    name="export-bag",
)
@_RUN
@_out("FILE", "ROS 2: .mcap or .db3, or a folder without a suffix; ROS 1: .bag.")
@click.option("--clouds/--no-clouds", default=True, help="Read the recording again for deskewed clouds.")
@click.option("--frame", default="lidar", help="Name of the frame of the LiDAR.")
@_OVERWRITE
def export_bag(run: Path, out: Path, clouds: bool, frame: str, overwrite: bool) -> None:
    """Write a run as a bag: odometry, tf, path, clouds and map.

    RUN is a run directory. The bag opens in Foxglove and RViz, and plays with ros2 bag.
    """
    from lidarslam.exports.bag import SUFFIXES, export_bag
    from lidarslam.exports.source import read_run_scans, require_new
    from lidarslam.run.progress import show_count

    if out.suffix not in SUFFIXES:
        raise click.UsageError(f"--out {out}: expected a file .mcap, .db3 or .bag, or a folder without a suffix")
    require_new(out, overwrite, run)
    scans = read_run_scans(run)
    with show_count(out.name) as count:
        written = export_bag(scans, out, frame, clouds, count)
    for topic, messages in written.items():
        say(f"{topic:<13}{messages:>7,} {'message' if messages == 1 else 'messages'}")
    say(f"written to {out}")


@command(
    """lidarslam export-grid runs/office -o map.yaml
    lidarslam export-grid runs/site -o map.yaml --resolution 0.1 --min-height 0.2 --max-height 1.2""",
    name="export-grid",
)
@_RUN
@_out("FILE", "The .yaml file; the .pgm lies beside it.")
@click.option(
    "--resolution",
    "resolution_m",
    type=POSITIVE,
    help="Edge of a cell, m.  [default: 0.05, or the voxels of the map if they are larger]",
)
@click.option("--min-height", "min_height_m", type=POSITIVE, default=0.15, help="Least height of obstacles, m.")
@click.option("--max-height", "max_height_m", type=POSITIVE, default=1.8, help="Height of the robot, m.")
@click.option(
    "--robot-radius",
    "robot_radius_m",
    type=POSITIVE,
    default=0.3,
    help="Distance from the path within which cells are free, m.",
)
@click.option("--max-range", "max_range_m", type=POSITIVE, default=30.0, help="Largest distance from the path, m.")
@_OVERWRITE
def export_grid(run: Path, out: Path, resolution_m: float | None, overwrite: bool, **heights: float) -> None:
    """Write the map as an occupancy grid for Nav2.

    RUN is a run directory. The grid is map.yaml and map.pgm; obstacles are points between two heights above the local
    ground.
    """
    from lidarslam.exports.map import GRID_SUFFIXES, export_grid
    from lidarslam.exports.source import require_new

    _require_suffix(out, GRID_SUFFIXES)
    for file in (out, out.with_suffix(".pgm")):
        require_new(file, overwrite, run)
    for line in export_grid(run, out, resolution_m, heights):
        say(line)


@command("lidarslam export-mesh runs/office -o office.glb", name="export-mesh")
@_RUN
@_out("FILE", ".ply, .obj, .glb or .stl file.")
@click.option(
    "--cell", "cell_m", type=POSITIVE, help="Edge of the smallest cells, m.  [default: two voxels of the map]"
)
@_OVERWRITE
def export_mesh(run: Path, out: Path, cell_m: float | None, overwrite: bool) -> None:
    """Write the map as a triangle mesh.

    RUN is a run directory. Poisson reconstruction, without the surface where the map has no points.
    """
    from lidarslam.exports.map import MESH_SUFFIXES, export_mesh
    from lidarslam.exports.source import require_new

    _require_suffix(out, MESH_SUFFIXES)
    require_new(out, overwrite, run)
    for line in export_mesh(run, out, cell_m):
        say(line)


@command("lidarslam export-geo runs/site -o site_utm", name="export-geo")
@_RUN
@_out("DIR", "Folder for the files.")
@_OVERWRITE
def export_geo(run: Path, out: Path, overwrite: bool) -> None:
    """Write trajectory and map in UTM, by the recording's GNSS.

    RUN is a run directory of a KITTI raw drive, or of a bag with sensor_msgs/NavSatFix. The trajectory is aligned with
    the GNSS track as a rigid body; its shape stays.
    """
    from lidarslam.exports.geo import export_geo

    for line in export_geo(run, out, overwrite):
        say(line)
