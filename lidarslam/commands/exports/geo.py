"""`lidarslam export-geo`: a run in UTM."""

from pathlib import Path

import click

from lidarslam.commands.shared.options import PATH, CommandWithExample
from lidarslam.commands.shared.terminal import say


@click.command("export-geo", cls=CommandWithExample, epilog="lidarslam export-geo runs/site -o site_utm")
@click.argument("run", type=PATH)
@click.option("-o", "--out", type=PATH, required=True, metavar="DIR", help="Folder for the files.")
@click.option("--overwrite", is_flag=True, help="Replace earlier files.")
def export_geo(run: Path, out: Path, overwrite: bool) -> None:
    """Write trajectory and map in UTM, placed by the recording's GNSS.

    RUN is a run directory of a KITTI raw drive, or of a bag with sensor_msgs/NavSatFix. The trajectory is aligned with
    the GNSS track as a rigid body; its shape stays.
    """
    from lidarslam.exports.geo import export_geo, georeference

    for line in export_geo(georeference(run), out, overwrite):
        say(line)
