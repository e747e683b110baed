"""`lidarslam merge`: one map of several recordings."""

from pathlib import Path
from typing import Any

import click

from lidarslam.commands.options import (
    PATH,
    command,
    config_options,
    default_out,
    jobs_options,
    map_options,
    odometry_options,
    out_option,
    reader_options,
    take_config,
    take_map_formats,
    take_where,
)
from lidarslam.commands.terminal import EXIT_LOST, EXIT_MENDABLE, note, say


@command(
    """lidarslam merge ground_floor.mcap stairs.mcap -o building
    lidarslam merge ground_floor.mcap stairs.mcap -o building --resume
    lidarslam merge *.mcap -o site --jobs 4"""
)
@click.argument("sources", type=PATH, nargs=-1, required=True, metavar="SOURCE...")
@out_option("Directory of the merged map.", "merged/SOURCE_TIME, after the first")
@odometry_options
@map_options
@jobs_options
@click.option("--resume", is_flag=True, help="Continue a merge that was killed or stopped; repeat its other options.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier merge in the directory.")
@reader_options
@config_options
@click.pass_context
def merge(ctx: click.Context, /, sources: tuple[Path, ...], out: Path | None, **options: Any) -> None:
    """Build one map of several recordings of a place.

    Each recording is tracked, --jobs at a time, and joined to the earlier ones by loop closures. DIR holds the common
    map, and for each recording a run directory with its poses in the common frame. A recording without a loop closure
    to the others is left out of the common map, and the exit status is 1.
    """
    from lidarslam.merge.merge import merge as execute
    from lidarslam.merge.parts import MergeRequest
    from lidarslam.merge.writing import format_merge
    from lidarslam.run.progress import show_progress
    from lidarslam.storage.default_places import source_name

    if options["resume"] and options["overwrite"]:
        raise click.UsageError("--resume continues a merge, --overwrite replaces it; choose one")
    if options["resume"] and out is None:
        raise click.UsageError("--resume needs --out, the directory of the merge")
    config, map_formats, where = take_config(options, *sources), take_map_formats(options), take_where(options)
    out = out or default_out("merged", source_name(sources[0], config.reader.sequence))
    outcome = execute(MergeRequest(sources, out, config, map_formats, where=where, **options), show_progress)
    say(format_merge(out, outcome))
    for line in outcome.stopped:
        note(line)
    for directory in outcome.apart:
        note(f"{directory}: not joined to the others, left out of the common map")
    if outcome.stopped or outcome.apart:
        ctx.exit(EXIT_MENDABLE)
    if outcome.summary.lost_scans or any(run is not None and run.summary.contradictions for run in outcome.runs):
        ctx.exit(EXIT_LOST)
