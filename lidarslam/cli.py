"""The command line: every command parses, imports what it needs, calls one function, and says what came of it."""

import errno
import io
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem

from lidarslam.core.errors import InputError, LidarSlamError
from lidarslam.core.plain_text import one_line, printable
from lidarslam.interruption import ended_like_interrupted
from lidarslam.rerun_environment import keep_rerun_to_itself, leave_if_abandoned

logger = logging.getLogger(__name__)

EXIT_MENDABLE = 1
EXIT_LOST = 3


class _Command(click.Command):
    """Keeps the line breaks of the examples in its help."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        if self.epilog:
            formatter.write_paragraph()
            with formatter.section("Example"):
                for line in self.epilog.strip().splitlines():
                    formatter.write(f"{'':>{formatter.current_indent}}{line.strip()}\n")


class _Group(click.Group):
    """Turns what the user can mend into one line on standard error and exit status 1."""

    command_class = _Command

    def invoke(self, ctx: click.Context) -> Any:
        _hold_standard_streams()
        _speak_any_encoding()
        keep_rerun_to_itself()
        try:
            _require_place()
            with ended_like_interrupted():
                return super().invoke(ctx)
        except LidarSlamError as error:
            _tell(str(error))
            ctx.exit(EXIT_MENDABLE)
        except UnicodeEncodeError as error:
            _tell(f"{error.object}: not a name that every program can read; rename it")
            ctx.exit(EXIT_MENDABLE)
        except MemoryError:
            _tell("memory ran out; close other programs, or take fewer scans at a time with --start and --stop")
            logger.info("where it came from", exc_info=True)
            ctx.exit(EXIT_MENDABLE)
        except OSError as error:
            if error.errno == errno.EPIPE:  # a reader that has had enough, such as head; click ends quietly
                raise
            _drop_unwritable_output()
            place = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
            _tell(f"{place}{error.strerror or error}")
            logger.info("where it came from", exc_info=True)
            ctx.exit(EXIT_MENDABLE)


def _drop_unwritable_output() -> None:
    """Spare Python from trying, and complaining, once more at its end when standard output is a full disk."""
    try:
        sys.stdout.flush()
    except OSError:
        sys.stdout = Path(os.devnull).open("w")  # noqa: SIM115


def _hold_standard_streams() -> None:
    """Where a standard stream is closed, a file opened next would take its number, and a library's words with it."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    if sys.stdout is None:
        sys.stdout = Path(os.devnull).open("w")  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = Path(os.devnull).open("w")  # noqa: SIM115


def _require_place() -> None:
    """Libraries fail in strange ways where the folder one stands in was removed."""
    try:
        Path.cwd()
    except FileNotFoundError:
        raise InputError("the folder you stand in is gone; change to another") from None


def _speak_any_encoding() -> None:
    """What the terminal has no letter for is spelt out, instead of ending a run at its last line."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


class _PlainFormatter(logging.Formatter):
    """Log lines may hold names out of recordings too."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


@click.group(
    "lidarslam", cls=_Group, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}
)
@click.version_option(package_name="lidarslam", message="%(prog)s %(version)s")
@click.option("-v", "--verbose", is_flag=True, help="Say more about what is going on.")
def main(verbose: bool) -> None:
    """Trajectories and maps from recorded LiDAR runs, and how good they are."""
    for stream in (sys.stdout, sys.stderr):  # a file's name may hold what the terminal cannot show
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    level = logging.INFO if verbose else logging.WARNING
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_PlainFormatter("lidarslam: %(message)s"))
    logging.basicConfig(level=level, handlers=[handler])


class _Path(click.Path):
    """A path that is not empty, which would mean the folder one stands in."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value == "":
            self.fail("the path is empty; name a file or a folder", param, ctx)
        return super().convert(value, param, ctx)


_PATH = _Path(path_type=Path)
_FILE = click.Path(path_type=Path, exists=True, dir_okay=False)
_SOURCE = click.argument("source", type=_PATH)
_Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def _options(*decorators: _Decorator) -> _Decorator:
    def apply(function: Callable[..., Any]) -> Callable[..., Any]:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return apply


_config_options = _options(
    click.option("--config", "config_file", type=_FILE, help="YAML file with whatever differs from the defaults."),
    click.option("--set", "settings", multiple=True, metavar="KEY.PATH=VALUE", help="One value; may be repeated."),
)


class _Registered(click.ParamType):  # type: ignore[type-arg]  # not generic before click 8.2
    """One of the names in a registry, which is imported when they are asked for."""

    name = "name"

    def __init__(self, names: Callable[[], Iterable[str]]) -> None:
        self._names = names

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        return click.Choice(list(self._names())).convert(value, param, ctx)

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:  # noqa: ARG002
        return f"[{'|'.join(self._names())}]"

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return click.Choice(list(self._names())).shell_complete(ctx, param, incomplete)


def _readers() -> Iterable[str]:
    from lidarslam.datasets.registry import READERS

    return READERS


_reader_options = _options(
    click.option(
        "--reader", type=_Registered(_readers), help="Reader to use instead of the one that recognises the source."
    ),
    click.option("--topic", metavar="TOPIC", help="Point cloud topic of a bag that holds several."),
    click.option("--sequence", metavar="NN", help="Sequence of a KITTI odometry root, such as 04."),
)


_odometry_options = _options(
    click.option(
        "--odometry",
        type=click.Choice(["learned", "kiss-icp", "constant-velocity"]),
        help="Where the motion between scans comes from.  [default: learned]",
    ),
    click.option(
        "--weights", type=_FILE, metavar="FILE", help="Of the learned odometry.  [default: those of the program]"
    ),
)


def _resolve(config_file: Path | None, settings: tuple[str, ...], **reader: str | None) -> Any:
    """The configuration, with the options that have a name of their own applied last."""
    from lidarslam.config import load_config, reader_settings

    return load_config(config_file, [*settings, *reader_settings(**reader)])


def _warn_of_ignored(source: Path, reader: str | None, topic: str | None, sequence: str | None) -> None:
    """Say which of the reader's options the source has no use for."""
    from lidarslam.datasets.registry import choose_reader

    chosen = choose_reader(source, reader)
    if topic is not None and chosen != "rosbag":
        _tell(f"--topic {topic} is ignored; {source} is no bag ({chosen})")
    if sequence is not None and chosen != "kitti-odometry":
        _tell(f"--sequence {sequence} is ignored; {source} is no KITTI odometry ({chosen})")


@main.command(epilog="lidarslam demo --out demo")
@click.option("--out", type=_PATH, default=Path("demo"), show_default=True, metavar="DIR", help="Where it all goes.")
@click.option("--scans", type=click.IntRange(min=20), default=400, show_default=True, help="Length of the recording.")
def demo(out: Path, scans: int) -> None:
    """Record an indoor run in a simulated office, map it, and compare that with KISS-ICP and the truth."""
    from lidarslam.demo import format_demo, run_demo

    _say(format_demo(run_demo(out, scans, tell=_tell)))


@main.command(epilog="lidarslam info recordings/2011_09_26_drive_0005_sync")
@_SOURCE
@_reader_options
@_config_options
def info(
    source: Path,
    reader: str | None,
    topic: str | None,
    sequence: str | None,
    config_file: Path | None,
    settings: tuple[str, ...],
) -> None:
    """Say what a recording holds, and what was inferred about it."""
    from lidarslam.info import describe_source

    config = _resolve(config_file, settings, name=reader, topic=topic, sequence=sequence)
    _warn_of_ignored(source, config.reader.name, topic, sequence)
    _say(describe_source(source, config.reader))


@main.command(
    epilog="""lidarslam run KITTI --sequence 04 --out runs/04
    lidarslam run office.mcap --out runs/office --rerun save
    lidarslam run office.mcap --out runs/wheels --prior wheel_odometry.tum
    lidarslam run office.mcap --out runs/office --rerun save --resume"""
)
@_SOURCE
@click.option("--out", type=_PATH, required=True, metavar="RUN", help="Directory that the results are written to.")
@_odometry_options
@click.option("--prior", type=_FILE, metavar="TUM_FILE", help="A trajectory of another program as the odometry.")
@click.option(
    "--mapping/--no-mapping", default=None, help="Lay every scan on the map of those before.  [default: mapping]"
)
@click.option(
    "--pose-graph/--no-pose-graph", default=None, help="Close loops in a pose graph.  [default: no-pose-graph]"
)
@click.option("--start", type=click.IntRange(min=0), default=0, show_default=True, help="First scan.")
@click.option("--stop", type=click.IntRange(min=0), help="Scan to stop before.")
@click.option("--step", type=click.IntRange(min=1), default=1, show_default=True, help="Take every n-th scan.")
@click.option(
    "--rerun",
    type=click.Choice(["off", "save", "spawn"]),
    default="off",
    show_default=True,
    help="Write a Rerun recording beside the results; spawn opens a window too.",
)
@click.option("--pcd", is_flag=True, help="Write the map as map.pcd too.")
@click.option(
    "--resume",
    is_flag=True,
    help="Go on with the run in the directory, which was killed or stopped, to the results that it would have had;"
    " give all other options as they were.",
)
@click.option("--overwrite", is_flag=True, help="Replace an earlier run in the directory.")
@_reader_options
@_config_options
@click.pass_context
def run(ctx: click.Context, /, source: Path, out: Path, **options: Any) -> None:
    """Build trajectory and map of a recording."""
    from lidarslam.progress import show_progress
    from lidarslam.run import RunRequest, execute, lost_when_finished
    from lidarslam.summary_text import format_outcome

    if options["resume"] and options["overwrite"]:
        raise click.UsageError("--resume goes on with a run, --overwrite replaces it; choose one")
    settings = _method_settings(
        options.pop("odometry"),
        options.pop("weights"),
        options["prior"],
        options.pop("mapping"),
        options.pop("pose_graph"),
        options.pop("settings"),
    )
    reader = {"name": options.pop("reader"), "topic": options.pop("topic"), "sequence": options.pop("sequence")}
    config = _resolve(options.pop("config_file"), settings, **reader)
    _warn_of_ignored(source, config.reader.name, reader["topic"], reader["sequence"])
    request = RunRequest(source, out, config, **options)
    if request.resume and (lost := lost_when_finished(request)) is not None:
        _say(f"{out}: is finished, nothing is left to do")
        ctx.exit(EXIT_LOST if lost else 0)
    with show_progress(source.name) as progress:
        outcome = execute(request, progress)
    _say(format_outcome(out, outcome))
    if outcome.stopped is not None:
        _tell(f"stopped after {outcome.summary.scans} scans: {outcome.stopped}; --resume goes on with it")
        ctx.exit(EXIT_MENDABLE)
    if outcome.summary.lost_scans:
        ctx.exit(EXIT_LOST)


@main.command(epilog="lidarslam merge ground_floor.mcap stairs.mcap --out building")
@click.argument("sources", type=_PATH, nargs=-1, required=True, metavar="SOURCE...")
@click.option("--out", type=_PATH, required=True, metavar="DIR", help="Directory of the merged map.")
@_odometry_options
@click.option("--pcd", is_flag=True, help="Write the maps as map.pcd too.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier merge in the directory.")
@_reader_options
@_config_options
@click.pass_context
def merge(ctx: click.Context, /, sources: tuple[Path, ...], out: Path, **options: Any) -> None:
    """Build one map of several recordings of a place.

    Each recording is run by itself and finds itself in the earlier ones where both show the same places. DIR holds the
    common map, and for each recording a run directory with its poses in the common frame. A recording that nothing
    joins to the others is left out of the common map, and the exit status is 1.
    """
    from lidarslam.merge import MergeRequest
    from lidarslam.merge import merge as execute
    from lidarslam.merge_text import format_merge
    from lidarslam.progress import show_progress

    settings = _method_settings(
        options.pop("odometry"), options.pop("weights"), None, None, None, options.pop("settings")
    )
    reader = {"name": options.pop("reader"), "topic": options.pop("topic"), "sequence": options.pop("sequence")}
    config = _resolve(options.pop("config_file"), settings, **reader)
    for source in sources:
        _warn_of_ignored(source, config.reader.name, reader["topic"], reader["sequence"])
    outcome = execute(MergeRequest(sources, out, config, **options), show_progress)
    _say(format_merge(out, outcome))
    for line in outcome.stopped:
        _tell(line)
    apart = [recording for recording in outcome.apart if recording.directory is not None]
    for recording in apart:
        _tell(f"{recording.directory}: not joined to the others, left out of the common map")
    if outcome.stopped or apart:
        ctx.exit(EXIT_MENDABLE)
    if outcome.summary.lost_scans:
        ctx.exit(EXIT_LOST)


def _method_settings(
    odometry: str | None,
    weights: Path | None,
    prior: Path | None,
    mapping: bool | None,
    pose_graph: bool | None,
    settings: tuple[str, ...],
) -> tuple[str, ...]:
    from lidarslam.config import setting

    if weights is not None:
        if odometry not in (None, "learned") or prior is not None:
            raise click.UsageError(
                "--weights are those of the learned odometry; leave them, or the other odometry, out"
            )
        odometry, settings = "learned", (*settings, setting("odometry.learned.weights", str(weights.resolve())))
    if prior is not None:
        if odometry is not None:
            raise click.UsageError("--prior is an odometry of its own; leave --odometry out")
        odometry = "external"
    if odometry is not None:
        settings = (*settings, f"odometry.method={odometry}")
    switches = {"mapping.enabled": mapping, "pose_graph.enabled": pose_graph}
    return (*settings, *(f"{key}={str(on).lower()}" for key, on in switches.items() if on is not None))


def _worlds() -> Iterable[str]:
    from lidarslam.simulation.worlds.registry import WORLDS

    return WORLDS


def _sensors() -> Iterable[str]:
    from lidarslam.simulation.sensor_table import SENSORS

    return SENSORS


def _motions() -> Iterable[str]:
    from lidarslam.simulation.carriers import CARRIERS

    return CARRIERS


def _mounts() -> Iterable[str]:
    from lidarslam.simulation.mounts import MOUNTS

    return MOUNTS


def _formats() -> Iterable[str]:
    from lidarslam.simulation.writers.registry import FORMATS

    return FORMATS


@main.command(
    epilog="""lidarslam simulate --out recordings/office
    lidarslam simulate --out recordings/street --world street --sensor hdl-64e --motion car --format kitti
    lidarslam simulate --out recordings/kitti_07 --world street --trajectory poses/07.txt --scans 1000"""
)
@click.option("--out", type=_PATH, required=True, metavar="DIR", help="Folder that the recording is made in.")
@click.option("--world", type=_Registered(_worlds), default="office", show_default=True, help="Place to record in.")
@click.option("--sensor", type=_Registered(_sensors), default="vlp-16", show_default=True, help="LiDAR to record with.")
@click.option(
    "--motion",
    type=_Registered(_motions),
    help="What carries the LiDAR.  [default: handheld; car on a trajectory]",
)
@click.option(
    "--trajectory",
    type=_FILE,
    metavar="FILE",
    help="TUM or KITTI file to move along, KITTI's smoothed over 0.25 s. The street is built around it; elsewhere it"
    " has to keep clear of what stands there.",
)
@click.option(
    "--mount", type=_Registered(_mounts), default="upright", show_default=True, help="How the LiDAR is mounted."
)
@click.option(
    "--scans", type=click.IntRange(min=1), help="How many scans.  [default: 300, or as long as the trajectory lasts]"
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Same seed, same recording.")
@click.option("--format", type=_Registered(_formats), default="mcap", show_default=True, help="Format of the files.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier simulated recording in the folder.")
def simulate(out: Path, motion: str | None, trajectory: Path | None, **options: Any) -> None:
    """Make a recording in a simulated world, with the exact trajectory and the exact map."""
    from lidarslam.progress import show_count
    from lidarslam.simulation.record import record
    from lidarslam.simulation.recording_request import RecordRequest
    from lidarslam.simulation.recording_text import format_summary

    motion = motion or ("handheld" if trajectory is None else "car")
    request = RecordRequest(out, motion=motion, trajectory=trajectory, **options)
    with show_count(out.name) as progress:
        summary = record(request, progress)
    _say(format_summary(request, summary))


@main.command(
    epilog="""lidarslam train office.mcap street.mcap --out trained
    lidarslam train KITTI --sequence 00 --out trained --from shipped --steps 2000
    lidarslam train --out trained --set simulated.recordings=100
    lidarslam train --out trained --resume"""
)
@click.argument("sources", type=_PATH, nargs=-1, metavar="[SOURCE]...")
@click.option("--out", type=_PATH, required=True, metavar="DIR", help="Directory of the training.")
@click.option("--resume", is_flag=True, help="Go on with the training in DIR, on the recordings it was begun with.")
@click.option("--overwrite", is_flag=True, help="Replace the training in DIR.")
@click.option(
    "--device",
    type=click.Choice(["auto", "cpu", "cuda"]),
    default="auto",
    show_default=True,
    help="Where to compute; auto takes a GPU where there is one.",
)
@click.option("--steps", type=click.IntRange(min=1), help="How long to train.  [default: 12000]")
@click.option("--network", type=click.Choice(["correlation", "delora"]), help="What to train.  [default: correlation]")
@click.option(
    "--losses",
    type=click.Choice(["both", "point-to-plane", "plane-to-plane", "paper", "alignment"]),
    help="What to minimise: geometric losses, as they are or as DeLORA's paper has them, or the distance to the motion"
    " that alignment finds.  [default: both and alignment]",
)
@click.option("--from", "start_from", metavar="WEIGHTS", help="Begin with these weights; shipped: the program's own.")
@click.option(
    "--prepared", type=_PATH, metavar="DIR", help="Where prepared recordings are kept.  [default: prepared in --out]"
)
@_reader_options
@_config_options
@click.pass_context
def train(ctx: click.Context, /, sources: tuple[Path, ...], **options: Any) -> None:
    """Teach a network how a sensor moves between scans; recordings need no labels.

    Ctrl-C ends the training with what there is, and --resume goes on with it. Several GPUs: start it with torchrun.
    """
    from lidarslam.train_command import TrainOptions, run_train

    if run_train(TrainOptions(sources, **options), _say).interrupted:
        ctx.exit(EXIT_MENDABLE)


@main.command(epilog="lidarslam export --weights trained/weights.safetensors --out exported")
@click.option("--weights", type=_PATH, metavar="FILE", help="Trained weights.  [default: those of the program]")
@click.option("--out", type=_PATH, required=True, metavar="DIR", help="Folder that encoder.onnx and pair.onnx go to.")
def export(weights: Path | None, out: Path) -> None:
    """Write a trained network as ONNX, for other programs.

    encoder.onnx takes the points and normals of scans as images; pair.onnx takes what it gives for two of them.
    """
    from odometry.checkpoint import default_weights, load_checkpoint
    from odometry.export import export_onnx

    for path in export_onnx(load_checkpoint(weights or default_weights()), out):
        _say(f"written to {path}")


@main.command(
    epilog="""lidarslam evaluate runs/04
    lidarslam evaluate runs/site --reference-map survey.laz --errors errors.ply
    lidarslam evaluate kitti_00.txt --reference poses/00.txt"""
)
@click.argument("run", type=_PATH)
@click.option(
    "--reference",
    type=_PATH,
    metavar="TRAJ",
    help="TUM or KITTI file, run directory, or recording with ground truth.  [default: what came with the source]",
)
@click.option("--no-reference", is_flag=True, help="Do without; of the map, tell its entropy only.")
@click.option(
    "--alignment",
    type=click.Choice(["se3", "first_pose", "none"]),
    default="se3",
    show_default=True,
    help="How the trajectory is brought to the reference for the ATE.",
)
@click.option("--tolerance-s", type=click.FloatRange(min=0.0), help="Poses this close in time match.  [default: 0.02]")
@click.option(
    "--max-gap-s", type=click.FloatRange(min=0.0), help="Gaps in the reference that are bridged.  [default: 0.5]"
)
@click.option(
    "--reference-map",
    type=_PATH,
    metavar="MAP",
    help=".ply, .pcd, .las, .laz or .e57 file.  [default: the exact map of a simulated source]",
)
@click.option(
    "--map", "map_file", type=_PATH, metavar="FILE", help="Map of a bare trajectory, or instead of the run's."
)
@click.option(
    "--map-alignment",
    metavar="[auto|trajectory|global|none|FILE]",
    default="auto",
    show_default=True,
    help="How the map is brought to the reference map: by the trajectories, by a global search, not at all, or by a"
    " text file with the 4x4 matrix from the map to the reference.",
)
@click.option(
    "--refine/--no-refine", default=None, help="Improve that by ICP.  [default: refine, unless the alignment is none]"
)
@click.option(
    "--spacing",
    "spacing_m",
    type=click.FloatRange(min=0.0, min_open=True),
    help="Both maps are thinned to one point in cells of this size, metres.  [default: 0.05]",
)
@click.option(
    "--max-range",
    "max_range_m",
    type=click.FloatRange(min=0.0, min_open=True),
    help="What is farther from the path does not count as missing, metres.  [default: the reach of the run's map]",
)
@click.option(
    "--errors", type=_PATH, multiple=True, metavar="FILE", help="Write the map coloured by its errors, .ply or .rrd."
)
@click.option(
    "--errors-clip",
    "errors_clip_m",
    type=click.FloatRange(min=0.0, min_open=True),
    default=0.5,
    show_default=True,
    help="Error of the brightest colour, metres.",
)
@click.option("--out", type=_PATH, metavar="FILE", help="Write the figures there.  [default: metrics.json of the run]")
def evaluate(run: Path, **options: Any) -> None:
    """Say how good a trajectory and its map are.

    RUN is a run directory, or a trajectory in TUM or KITTI text.
    """
    from lidarslam.evaluate import EvaluateRequest, evaluate
    from lidarslam.evaluate_text import format_evaluation
    from lidarslam.map_evaluation import MapOptions

    given = {name: value for name, value in options.items() if value is not None}
    if given.get("reference") and given["no_reference"]:
        raise click.UsageError("--reference and --no-reference exclude each other; choose one")
    named = {"map_alignment": "alignment", "refine": "refine", "spacing_m": "spacing_m", "max_range_m": "max_range_m"}
    map_options = MapOptions(**{named[name]: given.pop(name) for name in named if name in given})
    request = EvaluateRequest(run, needs_reference=not given.pop("no_reference"), map_options=map_options, **given)
    _say(format_evaluation(evaluate(request)))


@main.command(
    epilog="""lidarslam view runs/04
    lidarslam view runs/04 runs/wheels --web
    lidarslam view runs/04 --picture map.png"""
)
@click.argument("runs", type=_PATH, nargs=-1, required=True)
@click.option("--web", is_flag=True, help="Serve a browser on this machine instead of opening a window.")
@click.option("--save", type=_PATH, metavar="FILE.rrd", help="Write a Rerun recording instead of opening a window.")
@click.option("--picture", type=_PATH, metavar="FILE.png", help="Draw the map of one run, or a .ply file, instead.")
@_config_options
def view(
    runs: tuple[Path, ...],
    web: bool,
    save: Path | None,
    picture: Path | None,
    config_file: Path | None,
    settings: tuple[str, ...],
) -> None:
    """Look at finished runs in Rerun: trajectories, maps, and where tracking was lost."""
    from lidarslam.finished_run import load_run

    if sum([web, save is not None, picture is not None]) > 1:
        raise click.UsageError("--web, --save and --picture exclude one another; choose one")
    if picture is not None:
        _draw_map(runs, picture)
        return
    config = _resolve(config_file, settings)
    finished = [load_run(path) for path in runs]
    from lidarslam.rerun_viewer import show_runs

    served = show_runs(finished, config.viewer, save, web)
    if save is not None:
        _say(f"written to {save}")
    elif served is not None:
        _say(served.address)
        _say("serving this machine alone until you press Ctrl-C; from another, forward ports 9090 and 9876 by ssh -L")
        signal.pause()


def _draw_map(runs: tuple[Path, ...], picture: Path) -> None:
    from lidarslam.finished_run import load_map
    from lidarslam.picture import draw, height_colours, save_picture

    if len(runs) != 1:
        raise click.UsageError("--picture draws one map; name one run")
    cloud = load_map(runs[0])
    if not len(cloud):
        raise InputError(f"{runs[0]}: holds no map to draw")
    save_picture(picture, draw(cloud.points, height_colours(cloud.points), cloud.normals))
    _say(f"written to {picture}")


@main.command(
    epilog="""lidarslam compare KITTI --sequence 04 --out compared --methods learned,learned+map,kiss-icp
    lidarslam compare office.mcap --out compared --methods kiss-icp,prior --prior wheel_odometry.tum
    lidarslam compare --benchmark configs/benchmarks/kitti.yaml --data KITTI --out compared"""
)
@click.argument("sources", type=_PATH, nargs=-1, metavar="[SOURCE]...")
@click.option("--out", type=_PATH, required=True, metavar="DIR", help="Folder that everything is written to.")
@click.option(
    "--methods",
    metavar="NAME,...",
    help="BASE[@VOXEL][+map][+graph], BASE one of learned, kiss-icp, constant-velocity and prior.  "
    "[default: learned+map,kiss-icp, or the benchmark's]",
)
@click.option("--benchmark", type=_FILE, metavar="FILE", help="Recordings, methods and tables as the file has them.")
@click.option("--data", type=_PATH, metavar="DIR", help="Folder that the benchmark's paths are relative to.")
@click.option("--prior", type=_FILE, metavar="TUM_FILE", help="Trajectory that the methods prior and prior+map take.")
@click.option("--reference", metavar="METHOD|FILE", help="What to hold against.  [default: the ground truth]")
@click.option("--reference-map", type=_FILE, metavar="FILE", help="Point cloud to hold the maps against.")
@click.option("--memory-limit-mb", type=click.FloatRange(min=0, min_open=True), help="End a method that takes more.")
@click.option("--timeout-s", type=click.FloatRange(min=0, min_open=True), help="End a method that takes longer.")
@click.option("--start", type=click.IntRange(min=0), default=0, show_default=True, help="First scan.")
@click.option("--stop", type=click.IntRange(min=0), help="Scan to stop before.")
@click.option("--step", type=click.IntRange(min=1), default=1, show_default=True, help="Take every n-th scan.")
@click.option("--reuse", is_flag=True, help="Keep the runs in DIR that finished with the same settings.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier comparison in DIR.")
@_reader_options
@_config_options
@click.pass_context
def compare(ctx: click.Context, /, sources: tuple[Path, ...], benchmark: Path | None, **options: Any) -> None:
    """Run several methods on one or more recordings: one table, one report.

    Each method runs in a process of its own, one after another. A method that crashes or gets lost is a row of the
    table, and the exit status is 0 all the same; it is 1 when no method came to a result, or on Ctrl-C, which writes
    the report of what there is.
    """
    from lidarslam.compare_command import CompareOptions, run_compare

    if (benchmark is None) == (not sources):
        raise click.UsageError("name a SOURCE, several, or a file with --benchmark")
    if benchmark is None and options["data"] is not None:
        raise click.UsageError("--data goes with --benchmark")
    single = ("prior", "reference_map", "sequence")
    of_sources = single if sources else (*single, "reference", "start", "stop", "step")
    for name in of_sources:
        if ctx.get_parameter_source(name) is not ParameterSource.DEFAULT and len(sources) != 1:
            flag = f"--{name.replace('_', '-')}"
            raise click.UsageError(f"{flag} belongs to one SOURCE; a benchmark file has one for each recording")
    if not run_compare(CompareOptions(sources, benchmark, **options), _say, _tell):
        ctx.exit(EXIT_MENDABLE)


def _tell(line: str) -> None:
    click.echo(f"lidarslam: {one_line(line)}", err=True)


def _say(text: str) -> None:
    click.echo(printable(text))


@main.command(epilog="lidarslam config --set odometry.kiss_icp.voxel_size_m=0.5")
@_config_options
def config(config_file: Path | None, settings: tuple[str, ...]) -> None:
    """Print the resolved configuration as YAML."""
    from lidarslam.config import dump_yaml, load_config

    click.echo(printable(dump_yaml(load_config(config_file, settings))), nl=False)


def entry_point() -> None:
    """The program: what `lidarslam` starts."""
    status = 0
    try:
        main()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
        raise
    finally:
        leave_if_abandoned(status)


if __name__ == "__main__":
    entry_point()
