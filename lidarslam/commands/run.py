"""`lidarslam run`: trajectory and map of a recording."""

import contextlib
from pathlib import Path
from typing import Any

import click

from lidarslam.commands.options import (
    FILE,
    PATH,
    SOURCE,
    CommandWithExample,
    config_options,
    mapping_options,
    odometry_options,
    reader_options,
    scan_options,
    take_config,
)
from lidarslam.commands.serving import serving, wait_for_interrupt
from lidarslam.commands.terminal import EXIT_LOST, EXIT_MENDABLE, note, say


@click.command(
    cls=CommandWithExample,
    epilog="""lidarslam run KITTI --sequence 04 --out runs/04
    lidarslam run office.mcap --out runs/office --rerun save
    lidarslam run office.mcap --out runs/loam --mapping loam
    lidarslam run office.mcap --out runs/wheels --prior wheel_odometry.tum
    lidarslam run office.mcap --out runs/office --rerun save --resume""",
)
@SOURCE
@click.option("--out", type=PATH, required=True, metavar="RUN", help="Run directory for the results.")
@odometry_options
@click.option("--prior", type=FILE, metavar="TUM_FILE", help="External trajectory to use as the odometry.")
@mapping_options
@click.option("--pose-graph/--no-pose-graph", default=None, help="Close loops.  [default: no-pose-graph]")
@scan_options
@click.option(
    "--rerun",
    type=click.Choice(["off", "save", "web", "spawn"]),
    default="off",
    show_default=True,
    help="Save a Rerun recording; web serves a browser while it is written, and on until Ctrl-C; spawn opens a window.",
)
@click.option("--pcd", is_flag=True, help="Write the map as map.pcd too.")
@click.option("--resume", is_flag=True, help="Continue a run that was killed or stopped; repeat its other options.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier run in the directory.")
@reader_options
@config_options
@click.pass_context
def run(ctx: click.Context, /, source: Path, out: Path, **options: Any) -> None:
    """Build trajectory and map of a recording."""
    from lidarslam.run.progress import show_progress
    from lidarslam.run.request import RunRequest
    from lidarslam.run.resuming import lost_when_finished
    from lidarslam.run.run import execute
    from lidarslam.run.summary_text import format_outcome
    from lidarslam.storage.directory import RERUN

    if options["resume"] and options["overwrite"]:
        raise click.UsageError("--resume continues a run, --overwrite replaces it; choose one")
    config = take_config(options, source)
    request = RunRequest(source, out, config, **options)
    if request.resume and (lost := lost_when_finished(request)) is not None:
        say(f"{out}: is finished already")
        ctx.exit(EXIT_LOST if lost else 0)
    with serving() if request.rerun == "web" else contextlib.nullcontext() as page:
        with show_progress(source.name) as progress:
            outcome = execute(request, progress, page)
        say(format_outcome(out, outcome))
        if page is not None and outcome.stopped is None:
            say(f"serving {page.address} until Ctrl-C; later: lidarslam view {out / RERUN} --web")
            wait_for_interrupt()
    if outcome.stopped is not None:
        note(f"stopped after {outcome.summary.scans} scans: {outcome.stopped}; continue with --resume")
        ctx.exit(EXIT_MENDABLE)
    if outcome.summary.went_astray:
        ctx.exit(EXIT_LOST)
