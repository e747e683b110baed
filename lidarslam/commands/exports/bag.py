"""`lidarslam export-bag`: a run as ROS messages."""

from pathlib import Path

import click

from lidarslam.commands.shared.options import PATH, CommandWithExample
from lidarslam.commands.shared.terminal import say


@click.command(
    "export-bag",
    cls=CommandWithExample,
    epilog="""lidarslam export-bag runs/office -o office_slam.mcap
    lidarslam export-bag runs/office -o office_slam.bag --no-clouds""",
)
@click.argument("run", type=PATH)
@click.option(
    "-o",
    "--out",
    type=PATH,
    required=True,
    metavar="FILE",
    help="ROS 2: .mcap or .db3, or a folder without a suffix; ROS 1: .bag.",
)
@click.option(
    "--clouds/--no-clouds", default=True, help="Read the recording again for deskewed clouds.  [default: clouds]"
)
@click.option("--frame", default="lidar", show_default=True, help="Name of the frame of the LiDAR.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier file.")
def export_bag(run: Path, out: Path, clouds: bool, frame: str, overwrite: bool) -> None:
    """Write a run as a bag: odometry, tf, path, deskewed clouds and map.

    RUN is a run directory. The bag opens in Foxglove and RViz, and plays with ros2 bag.
    """
    from lidarslam.exports.bag import SUFFIXES, export_bag
    from lidarslam.exports.new_file import require_new
    from lidarslam.exports.run_scans import read_run_scans
    from lidarslam.run.progress import show_count

    if out.suffix not in SUFFIXES:
        raise click.UsageError(f"--out {out}: expected a file .mcap, .db3 or .bag, or a folder without a suffix")
    require_new(out, overwrite)
    scans = read_run_scans(run)
    with show_count(out.name) as count:
        written = export_bag(scans, out, frame, clouds, count)
    for topic, messages in written.messages.items():
        say(f"{topic:<13}{messages:>7,} {'message' if messages == 1 else 'messages'}")
    say(f"written to {out}")
