"""`lidarslam localise`: a recording found and tracked in a finished map."""

import contextlib
from pathlib import Path
from typing import Any

import click

from lidarslam.commands.options import (
    OVERWRITE,
    PATH,
    REPORT,
    RERUN,
    SOURCE,
    command,
    config_options,
    default_out,
    odometry_options,
    out_option,
    reader_options,
    scan_options,
    take_config,
)
from lidarslam.commands.terminal import EXIT_LOST, EXIT_MENDABLE, note, say, serving, wait_for_interrupt


@command(
    """lidarslam localise tuesday.mcap --map runs/monday
    lidarslam localise tuesday.mcap --map runs/monday -o runs/tuesday --rerun save
    lidarslam localise tuesday.mcap --map hall.ply --guess 12.5 -3 90
    lidarslam view runs/monday runs/tuesday"""
)
@SOURCE
@click.option(
    "--map", "map_path", type=PATH, required=True, metavar="RUN", help="Run directory, or a .ply or .pcd with normals."
)
@out_option("Run directory for the results.", "localised/SOURCE_TIME")
@click.option(
    "--guess",
    type=(float, float, float),
    metavar="X Y YAW",
    help="Where the first scan is in the map, in metres, and its heading in degrees.  [default: found without]",
)
@odometry_options
@scan_options
@RERUN
@REPORT
@OVERWRITE
@reader_options
@config_options
@click.pass_context
def localise(
    ctx: click.Context,
    /,
    source: Path,
    map_path: Path,
    out: Path | None,
    guess: tuple[float, float, float] | None,
    **options: Any,
) -> None:
    """Find and track a recording in the map of an earlier run.

    The poses in DIR are in the frame of that map, which is not changed. Scans that are not sure to fit are lost, with
    the reason; the exit status is 3 if there are any, and 1 if the recording was not found at all.
    """
    from lidarslam.run.progress import show_progress

    with contextlib.ExitStack() as serve:
        with show_progress(source.name) as progress:
            progress.phase("loading the program")
            from lidarslam.localise import LocaliseRequest, execute, format_localisation, format_not_found
            from lidarslam.run.request import RunRequest
            from lidarslam.storage.default_places import source_name

            config = take_config(options, source)
            out = out or default_out("localised", source_name(source, config.reader.sequence))
            request = LocaliseRequest(RunRequest(source, out, config, resumable=False, **options), map_path, guess)
            page = serve.enter_context(serving()) if request.run.rerun == "web" else None
            outcome = execute(request, progress, progress.phase, page)
        if outcome.localisation.found is None:
            note(format_not_found(request, outcome))
            ctx.exit(EXIT_MENDABLE)
        say(format_localisation(request, outcome))
        if page is not None and outcome.run.stopped is None:
            say(f"serving {page.address} until Ctrl-C")
            wait_for_interrupt()
    if outcome.run.stopped is not None:
        note(f"stopped after {outcome.run.summary.scans} scans: {outcome.run.stopped}")
        ctx.exit(EXIT_MENDABLE)
    if outcome.run.summary.lost_scans:
        ctx.exit(EXIT_LOST)
