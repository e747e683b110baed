"""`lidarslam run`: trajectory and map of a recording."""

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
    type=click.Choice(["off", "save", "spawn"]),
    default="off",
    show_default=True,
    help="Save a Rerun recording; spawn opens a window too.",
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

    if options["resume"] and options["overwrite"]:
        raise click.UsageError("--resume continues a run, --overwrite replaces it; choose one")
    with show_progress(source.name) as progress:
        progress.phase("loading the program")
        from lidarslam.run.request import RunRequest
        from lidarslam.run.resuming import lost_when_finished
        from lidarslam.run.run import execute
        from lidarslam.run.summary_text import format_outcome

        config = take_config(options, source)
        request = RunRequest(source, out, config, **options)
        if request.resume and (lost := lost_when_finished(request)) is not None:
            say(f"{out}: is finished already")
            ctx.exit(EXIT_LOST if lost else 0)
        outcome = execute(request, progress, progress.phase)
    say(format_outcome(out, outcome))
    if outcome.stopped is not None:
        note(f"stopped after {outcome.summary.scans} scans: {outcome.stopped}; continue with --resume")
        ctx.exit(EXIT_MENDABLE)
    if outcome.summary.went_astray:
        ctx.exit(EXIT_LOST)
