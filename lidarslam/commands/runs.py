"""`lidarslam run`, `live`, `localise` and `merge`: the commands that leave run directories."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lidarslam.commands import options as opt
from lidarslam.commands.terminal import EXIT_LOST, EXIT_MENDABLE, note, say, serving, wait_for_interrupt

if TYPE_CHECKING:
    from lidarslam.mapping.config import MapFormat
    from lidarslam.mapping.loops.closure import GivenLoops
    from lidarslam.viewer.rerun_program import WebPage

_SCANS = (click.IntRange(min=0), click.IntRange(min=0))
_POSE_GRAPH = click.option("--pose-graph/--no-pose-graph", default=None, help="Close loops.  [default: no-pose-graph]")
_RERUN = click.option(
    "--rerun",
    type=click.Choice(["off", "save", "web", "spawn"]),
    default="off",
    help="Save a Rerun recording; web serves a browser while it is written, and on until Ctrl-C; spawn opens a window.",
)
_REPORT = click.option("--report/--no-report", default=True, help="Draw report.html and pictures.")
_OVERWRITE = click.option("--overwrite", is_flag=True, help="Replace an earlier run in the directory.")
_odometry_options = opt.together(
    click.option(
        "--odometry",
        type=opt.Registered("lidarslam.odometry.config", "ODOMETRIES", without="external"),
        help="Motion from scan to scan; imu and learned+imu use the recording's IMU.  [default: learned]",
    ),
    click.option(
        "--weights",
        type=click.Path(path_type=Path, exists=True),
        metavar="FILE",
        help="Weights of the learned odometry, or the folder of an exported network.  [default: included]",
    ),
)
_mapping_options = opt.together(
    # With a value or without, which is surfels.
    click.option(
        "--mapping",
        type=opt.Registered("lidarslam.mapping.config", "MAPPINGS"),
        is_flag=False,
        flag_value="surfels",
        help="Register scans to a map of surfels or as LOAM's mapping does.  [default: surfels]",
    ),
    click.option("--no-mapping", is_flag=True, help="The odometry alone, as --mapping off."),
)
_map_options = opt.together(
    click.option(
        "--map-format",
        type=opt.Registered("lidarslam.mapping.config", "MapFormat"),
        multiple=True,
        help="Write the map as map.pcd, map.laz or map.e57 too; may be repeated.",
    ),
    click.option("--pcd", is_flag=True, help="As --map-format pcd."),
)


@opt.command(
    """lidarslam run office.mcap
    lidarslam run office.mcap --resume
    lidarslam run KITTI --sequence 04 -o runs/04
    lidarslam run office.mcap -o runs/loam --mapping loam --rerun save
    lidarslam run office.mcap -o runs/wheels --prior wheel_odometry.tum
    lidarslam run office.mcap --odometry kiss-icp --no-mapping -c indoor"""
)
@opt.SOURCE
@opt.out_option(
    "Run directory for the results.", "runs/SOURCE_TIME; with --resume, the unfinished run of SOURCE in runs"
)
@_odometry_options
@click.option("--prior", type=opt.FILE, metavar="TUM_FILE", help="External trajectory to use as the odometry.")
@_mapping_options
@_POSE_GRAPH
@click.option(
    "--gnss/--no-gnss",
    default=None,
    help="Hold the pose graph by GNSS positions, and write map and trajectory in UTM, too.  [default: no-gnss]",
)
@click.option(
    "--loop",
    "loops",
    type=_SCANS,
    multiple=True,
    metavar="I J",
    help="Close a loop between scans I and J, by their indices in the run, from 0; may be repeated.",
)
@click.option(
    "--no-loop",
    "no_loops",
    type=_SCANS,
    multiple=True,
    metavar="I J",
    help="Find no loop between scans within 50 of I and of J; may be repeated.",
)
@opt.scan_options
@_RERUN
@_map_options
@_REPORT
@click.option("--resume", is_flag=True, help="Continue a run that was killed or stopped; repeat its other options.")
@_OVERWRITE
@opt.reader_options
@opt.config_options
def run(source: Path, out: Path | None, **options: Any) -> int:
    """Build trajectory and map of a recording."""
    if options["resume"] and options["overwrite"]:
        raise click.UsageError("--resume continues a run, --overwrite replaces it; choose one")
    with contextlib.ExitStack() as serve:
        with _loading(source.name) as progress:
            from lidarslam.run.checkpoints import abandoned, lost_when_finished
            from lidarslam.run.request import RunRequest
            from lidarslam.run.results import format_outcome, format_stop
            from lidarslam.run.run import execute
            from lidarslam.storage.finished_run import source_name, unfinished_run

            config, map_formats = opt.take_config(options, source), _take_map_formats(options)
            given, sequence = _take_loops(options), config.reader.sequence
            if out is None and options["resume"]:
                out = unfinished_run(source, sequence)
                note(f"resuming {out}")
            out = out or opt.default_out("runs", source_name(source, sequence))
            request = RunRequest(source, out, config, given=given, map_formats=map_formats, **options)
            if request.resume and (lost := lost_when_finished(request)) is not None:
                say(f"{out}: is finished already")
                return EXIT_LOST if lost else 0
            page = _page(serve, request.rerun)
            try:
                outcome = execute(request, progress, progress.phase, page)
            except KeyboardInterrupt:
                note(abandoned(out))
                return EXIT_MENDABLE
        say(format_outcome(out, outcome))
        if outcome.stopped is not None:
            note(format_stop(out, outcome))
            return EXIT_MENDABLE
        _keep_serving(page, out)
    return EXIT_LOST if outcome.summary.went_astray else 0


@opt.command(
    """lidarslam live
    lidarslam live --topic /ouster/points -o runs/tour --rerun web
    ROS_DOMAIN_ID=7 lidarslam live --topic /points --base-frame base_link --pose-graph
    lidarslam live --topic /points --duration 60 --odometry constant-velocity --no-tf"""
)
@click.option("--topic", metavar="TOPIC", help="Topic of the clouds.  [default: the only one]")
@click.option(
    "--domain", type=click.IntRange(0, 232), envvar="ROS_DOMAIN_ID", show_envvar=True, default=0, help="DDS domain."
)
@opt.out_option("Run directory for the results.", "runs/TOPIC_TIME")
@click.option("--duration", "duration_s", type=opt.POSITIVE, metavar="S", help="End so long after the first scan.")
@click.option("--scans", type=click.IntRange(min=1), metavar="N", help="End after so many scans.")
@click.option("--odom-frame", default="odom", metavar="FRAME", help="Fixed frame of the poses.")
@click.option(
    "--base-frame", metavar="FRAME", help="Moving frame; /tf_static connects it with the LiDAR.  [default: the LiDAR's]"
)
@click.option("--tf/--no-tf", "publish_tf", default=True, help="Publish the pose on /tf as well.")
@click.option("--queue", type=click.IntRange(min=1), default=20, help="Scans that may wait for registration.")
@_odometry_options
@_mapping_options
@_POSE_GRAPH
@_RERUN
@_map_options
@_REPORT
@_OVERWRITE
@opt.config_options
def live(topic: str | None, out: Path | None, **options: Any) -> int:
    """Build trajectory and map of a robot that is running.

    Clouds come over DDS, as ROS 2 sends them; ROS need not be installed. The poses are published on /lidarslam/odometry
    and /tf. Ctrl-C ends the run, and writes its results.
    """
    topic = None if topic is None else f"/{topic.lstrip('/')}"
    with contextlib.ExitStack() as serve:
        with _loading(topic or "live") as progress:
            from lidarslam.live.live import execute
            from lidarslam.run.request import LiveRequest
            from lidarslam.run.results import format_outcome

            options |= {"reader": None, "sequence": None, "topic": topic}  # those of recordings
            config, map_formats = opt.take_config(options), _take_map_formats(options)
            out = out or opt.default_out("runs", (topic or "live").strip("/"))
            request = LiveRequest(out, config, topic, map_formats=map_formats, **options)
            page = _page(serve, request.rerun)
            try:
                outcome = execute(request, progress.phase, page)
            except KeyboardInterrupt:
                note(f"{out}: interrupted, nothing was kept")
                return EXIT_MENDABLE
        say(outcome.counts.text())
        say(format_outcome(out, outcome.run))
        if not outcome.is_interrupted:
            _keep_serving(page, out)
    return EXIT_LOST if outcome.run.summary.went_astray else 0


@opt.command(
    """lidarslam localise tuesday.mcap --map runs/monday
    lidarslam localise tuesday.mcap --map runs/monday -o runs/tuesday --rerun save
    lidarslam localise tuesday.mcap --map hall.ply --guess 12.5 -3 90
    lidarslam view runs/monday runs/tuesday"""
)
@opt.SOURCE
@click.option(
    "--map",
    "map_path",
    type=opt.PATH,
    required=True,
    metavar="RUN",
    help="Run directory, or a .ply or .pcd with normals.",
)
@opt.out_option("Run directory for the results.", "localised/SOURCE_TIME")
@click.option(
    "--guess",
    type=(float, float, float),
    metavar="X Y YAW",
    help="Where the first scan is in the map, in metres, and its heading in degrees.  [default: found without]",
)
@_odometry_options
@opt.scan_options
@_RERUN
@_REPORT
@_OVERWRITE
@opt.reader_options
@opt.config_options
def localise(
    source: Path, map_path: Path, out: Path | None, guess: tuple[float, float, float] | None, **options: Any
) -> int:
    """Find and track a recording in the map of an earlier run.

    The poses in DIR are in the frame of that map, which is not changed. Scans that are not sure to fit are lost, with
    the reason; the exit status is 3 if there are any, or if more than a tenth of the scans cannot be read, and 1 if the
    recording was not found at all.
    """
    with contextlib.ExitStack() as serve:
        with _loading(source.name) as progress:
            from lidarslam.localise import LocaliseRequest, execute, format_localisation, format_not_found
            from lidarslam.run.request import RunRequest
            from lidarslam.storage.finished_run import source_name, too_many_unreadable

            config = opt.take_config(options, source)
            out = out or opt.default_out("localised", source_name(source, config.reader.sequence))
            request = LocaliseRequest(RunRequest(source, out, config, resumable=False, **options), map_path, guess)
            page = _page(serve, request.run.rerun)
            outcome = execute(request, progress, progress.phase, page)
        if outcome.localisation.found_scan is None:
            note(format_not_found(request, outcome))
            return EXIT_MENDABLE
        say(format_localisation(request, outcome))
        summary, stopped = outcome.run.summary, outcome.run.stopped
        if stopped is not None:
            note(f"stopped after {summary.scans} scans: {stopped}")
            return EXIT_MENDABLE
        _keep_serving(page)
    is_lost = summary.lost_scans or too_many_unreadable(summary.unreadable_scans, summary.scans)
    return EXIT_LOST if is_lost else 0


@opt.command(
    """lidarslam merge ground_floor.mcap stairs.mcap -o building
    lidarslam merge ground_floor.mcap stairs.mcap -o building --resume
    lidarslam merge *.mcap -o site --jobs 4"""
)
@click.argument("sources", type=opt.PATH, nargs=-1, required=True, metavar="SOURCE...")
@opt.out_option("Directory of the merged map.", "merged/SOURCE_TIME, after the first")
@_odometry_options
@_map_options
@opt.jobs_options
@click.option("--resume", is_flag=True, help="Continue a merge that was killed or stopped; repeat its other options.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier merge in the directory.")
@opt.reader_options
@opt.config_options
def merge(sources: tuple[Path, ...], out: Path | None, **options: Any) -> int:
    """Build one map of several recordings of a place.

    Each recording is tracked, --jobs at a time, and joined to the earlier ones by loop closures. DIR holds the common
    map, and for each recording a run directory with its poses in the common frame. A recording without a loop closure
    to the others is left out of the common map, and the exit status is 1.
    """
    from lidarslam.merge.merge import MergeRequest, format_merge
    from lidarslam.merge.merge import merge as execute
    from lidarslam.run.progress import show_progress
    from lidarslam.storage.finished_run import source_name

    if options["resume"] and options["overwrite"]:
        raise click.UsageError("--resume continues a merge, --overwrite replaces it; choose one")
    if options["resume"] and out is None:
        raise click.UsageError("--resume needs --out, the directory of the merge")
    config, map_formats = opt.take_config(options, *sources), _take_map_formats(options)
    where = opt.take_where(options)
    out = out or opt.default_out("merged", source_name(sources[0], config.reader.sequence))
    outcome = execute(MergeRequest(sources, out, config, map_formats, where=where, **options), show_progress)
    say(format_merge(out, outcome))
    for line in outcome.stopped:
        note(line)
    for directory in outcome.apart:
        note(f"{directory}: not joined to the others, left out of the common map")
    if outcome.stopped or outcome.apart:
        return EXIT_MENDABLE
    return EXIT_LOST if any(run is not None and run.summary.went_astray for run in outcome.runs) else 0


@contextlib.contextmanager
def _loading(name: str) -> Iterator[Any]:
    """The progress bar, which is there before the libraries are; its type is not named because that would load them."""
    from lidarslam.run.progress import show_progress

    with show_progress(name) as progress:
        progress.phase("loading the program")
        yield progress


def _page(serve: contextlib.ExitStack, rerun: str) -> "WebPage | None":
    return serve.enter_context(serving()) if rerun == "web" else None


def _keep_serving(page: "WebPage | None", out: Path | None = None) -> None:
    if page is not None:
        from lidarslam.storage.directory import RERUN

        later = f"; later: lidarslam view {out / RERUN} --web" if out else ""
        wait_for_interrupt(f"serving {page.address} until Ctrl-C{later}")


def _take_map_formats(options: dict[str, Any]) -> "tuple[MapFormat, ...]":
    """The formats of the map besides .ply, whose libraries are there; the options they are made of are removed."""
    from lidarslam.mapping.global_map.point_cloud import require_format

    formats = (*options.pop("map_format"), *(["pcd"] if options.pop("pcd") else []))
    for one in formats:
        require_format(one)
    return tuple(dict.fromkeys(formats))


def _take_loops(options: dict[str, Any]) -> "GivenLoops":
    """The loop closures that are given and forbidden; the options they are made of are removed."""
    from lidarslam.mapping.loops.closure import GivenLoops

    closed, forbidden = (dict.fromkeys((min(p), max(p)) for p in options.pop(name)) for name in ("loops", "no_loops"))
    for first, second in (*closed, *forbidden):
        if first == second:
            raise click.UsageError(f"--loop and --no-loop take two scans, not {first} twice")
    for first, second in closed.keys() & forbidden.keys():
        raise click.UsageError(f"--loop {first} {second} and --no-loop {first} {second} exclude one another")
    return GivenLoops(tuple(closed), tuple(forbidden))
