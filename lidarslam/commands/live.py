"""`lidarslam live`: trajectory and map of a robot that is running."""

import contextlib
from pathlib import Path
from typing import Any

import click

from lidarslam.commands.options import (
    OVERWRITE,
    POSE_GRAPH,
    POSITIVE,
    REPORT,
    RERUN,
    command,
    config_options,
    default_out,
    map_options,
    mapping_options,
    odometry_options,
    out_option,
    take_config,
    take_map_formats,
)
from lidarslam.commands.terminal import EXIT_LOST, EXIT_MENDABLE, note, say, serving, wait_for_interrupt


@command(
    """lidarslam live
    lidarslam live --topic /ouster/points -o runs/tour --rerun web
    ROS_DOMAIN_ID=7 lidarslam live --topic /points --base-frame base_link --pose-graph
    lidarslam live --topic /points --duration 60 --odometry constant-velocity --no-tf"""
)
@click.option("--topic", metavar="TOPIC", help="Topic of the clouds.  [default: the only one]")
@click.option(
    "--domain",
    type=click.IntRange(0, 232),
    envvar="ROS_DOMAIN_ID",
    show_envvar=True,
    default=0,
    show_default=True,
    help="DDS domain.",
)
@out_option("Run directory for the results.", "runs/TOPIC_TIME")
@click.option("--duration", "duration_s", type=POSITIVE, metavar="S", help="End so long after the first scan.")
@click.option("--scans", type=click.IntRange(min=1), metavar="N", help="End after so many scans.")
@click.option("--odom-frame", default="odom", show_default=True, metavar="FRAME", help="Fixed frame of the poses.")
@click.option(
    "--base-frame", metavar="FRAME", help="Moving frame; /tf_static connects it with the LiDAR.  [default: the LiDAR's]"
)
@click.option("--tf/--no-tf", "publish_tf", default=True, help="Publish the pose on /tf as well.  [default: tf]")
@click.option(
    "--queue", type=click.IntRange(min=1), default=20, show_default=True, help="Scans that may wait for registration."
)
@odometry_options
@mapping_options
@POSE_GRAPH
@RERUN
@map_options
@REPORT
@OVERWRITE
@config_options
@click.pass_context
def live(ctx: click.Context, /, topic: str | None, out: Path | None, **options: Any) -> None:
    """Build trajectory and map of a robot that is running.

    Clouds come over DDS, as ROS 2 sends them; ROS need not be installed. The poses are published on /lidarslam/odometry
    and /tf. Ctrl-C ends the run, and writes its results.
    """
    from lidarslam.run.progress import show_progress

    topic = None if topic is None else f"/{topic.lstrip('/')}"
    with contextlib.ExitStack() as serve:
        with show_progress(topic or "live") as progress:
            progress.phase("loading the program")
            from lidarslam.live.live import execute
            from lidarslam.run.request import LiveRequest
            from lidarslam.run.summary_text import format_outcome
            from lidarslam.storage.directory import RERUN

            options |= {"reader": None, "sequence": None, "topic": topic}  # those of recordings
            config, map_formats = take_config(options), take_map_formats(options)
            out = out or default_out("runs", (topic or "live").strip("/"))
            request = LiveRequest(out, config, topic, map_formats=map_formats, **options)
            page = serve.enter_context(serving()) if request.rerun == "web" else None
            try:
                outcome = execute(request, progress.phase, page)
            except KeyboardInterrupt:
                note(f"{out}: interrupted, nothing was kept")
                ctx.exit(EXIT_MENDABLE)
        say(outcome.counts.text())
        say(format_outcome(out, outcome.run))
        if page is not None and not outcome.is_interrupted:
            say(f"serving {page.address} until Ctrl-C; later: lidarslam view {out / RERUN} --web")
            wait_for_interrupt()
    if outcome.run.summary.went_astray:
        ctx.exit(EXIT_LOST)
