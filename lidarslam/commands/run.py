"""`lidarslam run`: trajectory and map of a recording."""

import contextlib
from pathlib import Path
from typing import Any

import click

from lidarslam.commands.options import (
    FILE,
    GNSS,
    LOOPS,
    OVERWRITE,
    POSE_GRAPH,
    REPORT,
    RERUN,
    SOURCE,
    command,
    config_options,
    default_out,
    map_options,
    mapping_options,
    odometry_options,
    out_option,
    reader_options,
    scan_options,
    take_config,
    take_loops,
    take_map_formats,
)
from lidarslam.commands.terminal import EXIT_LOST, EXIT_MENDABLE, note, say, serving, wait_for_interrupt


@command(
    """lidarslam run office.mcap
    lidarslam run office.mcap --resume
    lidarslam run KITTI --sequence 04 -o runs/04
    lidarslam run office.mcap -o runs/loam --mapping loam --rerun save
    lidarslam run office.mcap -o runs/wheels --prior wheel_odometry.tum
    lidarslam run office.mcap --odometry kiss-icp --no-mapping -c indoor"""
)
@SOURCE
@out_option("Run directory for the results.", "runs/SOURCE_TIME; with --resume, the unfinished run of SOURCE in runs")
@odometry_options
@click.option("--prior", type=FILE, metavar="TUM_FILE", help="External trajectory to use as the odometry.")
@mapping_options
@POSE_GRAPH
@GNSS
@LOOPS
@scan_options
@RERUN
@map_options
@REPORT
@click.option("--resume", is_flag=True, help="Continue a run that was killed or stopped; repeat its other options.")
@OVERWRITE
@reader_options
@config_options
@click.pass_context
def run(ctx: click.Context, /, source: Path, out: Path | None, **options: Any) -> None:
    """Build trajectory and map of a recording."""
    from lidarslam.run.progress import show_progress

    if options["resume"] and options["overwrite"]:
        raise click.UsageError("--resume continues a run, --overwrite replaces it; choose one")
    with contextlib.ExitStack() as serve:
        with show_progress(source.name) as progress:
            progress.phase("loading the program")
            from lidarslam.run.checkpoints import abandoned, lost_when_finished
            from lidarslam.run.request import RunRequest
            from lidarslam.run.run import execute
            from lidarslam.run.summary_text import format_outcome, format_stop
            from lidarslam.storage.directory import RERUN

            config, map_formats = take_config(options, source), take_map_formats(options)
            given = take_loops(options)
            out = out or _default_out(source, config.reader.sequence, options["resume"])
            request = RunRequest(source, out, config, given=given, map_formats=map_formats, **options)
            if request.resume and (lost := lost_when_finished(request)) is not None:
                say(f"{out}: is finished already")
                ctx.exit(EXIT_LOST if lost else 0)
            page = serve.enter_context(serving()) if request.rerun == "web" else None
            try:
                outcome = execute(request, progress, progress.phase, page)
            except KeyboardInterrupt:
                note(abandoned(out))
                ctx.exit(EXIT_MENDABLE)
        say(format_outcome(out, outcome))
        if page is not None and outcome.stopped is None:
            say(f"serving {page.address} until Ctrl-C; later: lidarslam view {out / RERUN} --web")
            wait_for_interrupt()
    if outcome.stopped is not None:
        note(format_stop(out, outcome))
        ctx.exit(EXIT_MENDABLE)
    if outcome.summary.went_astray:
        ctx.exit(EXIT_LOST)


def _default_out(source: Path, sequence: str | None, resume: bool) -> Path:
    """A new run directory, or that of the unfinished run.

    Raises:
        InputError: there is no run to resume, or there are several.
    """
    from lidarslam.storage.default_places import RUNS, source_name, unfinished_run

    if not resume:
        return default_out(str(RUNS), source_name(source, sequence))
    out = unfinished_run(source, sequence)
    note(f"resuming {out}")
    return out
