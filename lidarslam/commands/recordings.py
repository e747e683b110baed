"""`lidarslam info`, `datasets` and `simulate`: recordings."""

from pathlib import Path
from typing import Any

import click

from lidarslam.commands import options as opt
from lidarslam.commands.terminal import say

_WORLD = opt.Registered("lidarslam.simulation.world", "WORLDS")
_SENSOR = opt.Registered("lidarslam.simulation.sensors", "SENSORS")
_CARRIER = opt.Registered("lidarslam.simulation.motion", "CARRIERS")
_MOUNT = opt.Registered("lidarslam.simulation.motion", "MOUNTS")
_FORMAT = opt.Registered("lidarslam.simulation.writers", "FORMATS")


@opt.command(
    """lidarslam datasets
    lidarslam datasets hilti_2022
    lidarslam datasets /data --json"""
)
@click.argument("arguments", nargs=-1, metavar="[NAME | FOLDER]...")
@click.option("--json", "as_json", is_flag=True, help="Print JSON; docs/data_sets.md describes the keys.")
def datasets(arguments: tuple[str, ...], as_json: bool) -> None:
    """List published data sets and those on disk, or describe one."""
    from lidarslam.commands import catalogue_text as text

    chosen, folders = text.choose(arguments)
    on_disk = text.find_on_disk(folders)
    if as_json:
        say(text.as_json(chosen, on_disk))
    elif chosen:
        say("\n\n".join(text.describe_data_set(one, on_disk) for one in chosen))
    else:
        say(text.list_data_sets(on_disk))


@opt.command(
    """lidarslam info recordings/2011_09_26_drive_0005_sync
    lidarslam info office.mcap --json"""
)
@opt.SOURCE
@click.option("--json", "as_json", is_flag=True, help="Print JSON; docs/command_line.md describes the keys.")
@opt.reader_options
@opt.config_options
def info(source: Path, as_json: bool, **options: Any) -> None:
    """Print what a recording holds, and what was inferred about it."""
    from lidarslam.datasets.info_text import describe_as_json, describe_source

    config = opt.take_config(options, source).reader
    say((describe_as_json if as_json else describe_source)(source, config))


@opt.command(
    """lidarslam simulate
    lidarslam simulate -o recordings/street --world street --sensor hdl-64e --motion car --format kitti
    lidarslam simulate -o recordings/road --world fields --sensor hdl-64e-calibrated --motion car-fast --speed 25"""
)
@opt.out_option("Folder of the recording.", "recordings/WORLD_TIME")
@click.option("--world", type=_WORLD, default="office", help="Scene.")
@click.option("--sensor", type=_SENSOR, default="vlp-16", help="LiDAR model.")
@click.option("--motion", type=_CARRIER, default="handheld", help="Carrier of the LiDAR.")
@click.option(
    "--speed",
    "speed_mps",
    type=click.FloatRange(min=0.1, max=60.0),
    metavar="M/S",
    help="Speed on straight stretches.  [default: that of the carrier, within the limit of the route]",
)
@click.option("--mount", type=_MOUNT, default="upright", help="Mounting of the LiDAR.")
@click.option("--scans", type=click.IntRange(min=1), default=300, help="Number of scans.")
@click.option("--seed", type=click.IntRange(min=0), default=0, help="Of the random numbers.")
@click.option("--format", type=_FORMAT, default="mcap", help="Format of the files.")
@click.option("--imu/--no-imu", default=False, help="Record an IMU of 200 Hz on the LiDAR too.")
@opt.jobs_options
@click.option("--overwrite", is_flag=True, help="Replace an earlier simulated recording in the folder.")
def simulate(out: Path | None, **options: Any) -> None:
    """Simulate a recording, with exact trajectory and map."""
    from lidarslam.run.progress import show_count
    from lidarslam.simulation.record import RecordRequest, format_summary, record

    out = out or opt.default_out("recordings", options["world"])
    request = RecordRequest(out, where=opt.take_where(options), **options)
    with show_count(out.name) as progress:
        summary = record(request, progress)
    say(format_summary(request, summary))
