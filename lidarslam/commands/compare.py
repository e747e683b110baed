"""`lidarslam evaluate`: accuracy of a run; `compare`: several methods in one table; `demo`: a simulated recording."""

import sys
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from lidarslam.commands import options as opt
from lidarslam.commands.options import FILE, PATH, POSITIVE
from lidarslam.commands.terminal import EXIT_GATE, EXIT_MENDABLE, note, say
from lidarslam.core.errors import ConfigError

_SECONDS = click.FloatRange(min=0.0)


@opt.command(
    """lidarslam evaluate
    lidarslam evaluate runs/04
    lidarslam evaluate runs/04 --max ate=0.1 --max lost=0
    lidarslam evaluate runs/site --reference-map survey.laz --errors errors.ply
    lidarslam evaluate kitti_00.txt --reference poses/00.txt"""
)
@click.argument("run", type=PATH, required=False)
@click.option(
    "--reference",
    type=PATH,
    metavar="TRAJ",
    help="TUM or KITTI file, run directory, or recording with ground truth.  [default: that of the source]",
)
@click.option("--no-reference", is_flag=True, help="Compute only the entropy of the map.")
@click.option(
    "--alignment",
    type=click.Choice(["se3", "first_pose", "none"]),
    default="se3",
    help="Alignment of the trajectory to the reference for the ATE.",
)
@click.option("--tolerance-s", type=_SECONDS, help="Largest time between matching poses.  [default: 0.02]")
@click.option("--max-gap-s", type=_SECONDS, help="Largest gap of the reference to interpolate.  [default: 0.5]")
@click.option(
    "--reference-map",
    type=PATH,
    metavar="MAP",
    help=".ply, .pcd, .las, .laz or .e57 file.  [default: the exact map of a simulated source]",
)
@click.option("--map", "map_file", type=PATH, metavar="FILE", help="Map to evaluate.  [default: that of the run]")
@click.option(
    "--map-alignment",
    metavar="[auto|trajectory|global|none|FILE]",
    default="auto",
    help="Alignment of the map to the reference map: by the trajectories, by a global search, none, or the 4x4 matrix"
    " in a text file, which takes the map to the reference.",
)
@click.option("--refine/--no-refine", default=None, help="Refine the alignment by ICP.  [default: refine, unless none]")
@click.option("--spacing", "spacing_m", type=POSITIVE, help="Voxel that both maps are thinned to, m.  [default: 0.05]")
@click.option(
    "--max-range",
    "max_range_m",
    type=POSITIVE,
    help="Distance from the path up to which the map should be complete, m.  [default: the range of the run's map]",
)
@click.option("--errors", type=PATH, multiple=True, metavar="FILE", help="Save the map coloured by error: .ply, .rrd.")
@click.option("--errors-clip", "errors_clip_m", type=POSITIVE, default=0.5, help="Error of the brightest colour, m.")
@click.option("--report/--no-report", default=True, help="Draw the run's page with the errors.")
@opt.gate_options(with_method=False)
@click.option("-o", "--out", type=PATH, metavar="FILE", help="File of the metrics.  [default: metrics.json of the run]")
def evaluate(run: Path | None, **options: Any) -> int:
    """Evaluate a trajectory and its map.

    RUN is a run directory, or a trajectory in TUM or KITTI text.  [default: the latest run in runs]

    Exit status 4 if a bound of --max or --min is not met; everything is written then too.
    """
    from lidarslam.assessment.evaluate import EvaluateRequest, evaluate, format_evaluation
    from lidarslam.evaluation.comparison.gates import format_gates, judge
    from lidarslam.storage.finished_run import read_summary

    gates = (*options.pop("maxima"), *options.pop("minima"))
    given = {name: value for name, value in options.items() if value is not None}
    if given.get("reference") and given["no_reference"]:
        raise click.UsageError("--reference and --no-reference exclude each other; choose one")
    request = EvaluateRequest(run or opt.latest_run(), needs_reference=not given.pop("no_reference"), **given)
    evaluation = evaluate(request)
    say(format_evaluation(evaluation))
    if not gates:
        return 0
    directory = evaluation.estimate.run
    summary = {} if directory is None else read_summary(directory)
    judged = judge(gates, {"metrics": evaluation.to_json(), "summary": summary})
    say(f"\n{format_gates(judged)}")
    return 0 if all(gate.passed for gate in judged) else EXIT_GATE


@opt.command(
    """lidarslam compare office.mcap
    lidarslam compare KITTI --sequence 04 -o compared/04 --methods learned,learned+map,kiss-icp
    lidarslam compare office.mcap --methods learned+map,learned+loam
    lidarslam compare drive_0005_sync --methods learned+map,learned+imu+map
    lidarslam compare office.mcap --methods learned+map,kiss-icp-no-deskew,ct-icp,kiss-slam,small-gicp
    lidarslam compare office.mcap --methods kiss-icp,prior --prior wheel_odometry.tum
    lidarslam compare office.mcap --max learned+map:ate=0.1 --max lost=0
    lidarslam compare --benchmark kitti --data KITTI
    lidarslam compare --benchmark simulated --jobs 4"""
)
@click.argument("sources", type=PATH, nargs=-1, metavar="[SOURCE]...")
@opt.out_option("Folder for runs and report.", "compared/SOURCE_TIME, after the first, or the benchmark")
@click.option(
    "--methods",
    metavar="NAME,...",
    help="BASE[@VOXEL][+map|+loam][+graph], BASE one of learned, kiss-icp, kiss-icp-no-deskew, constant-velocity, "
    "imu, learned+imu and prior, such as learned+imu+map; or a peer such as ct-icp, kiss-slam, small-gicp "
    "(docs/comparison.md lists them).  [default: learned+map,kiss-icp, or the benchmark's]",
)
@click.option(
    "--benchmark",
    type=opt.ShippedFile("benchmark", "BENCHMARKS"),
    help="Recordings and methods: a name of lidarslam config --list, or a YAML file.",
)
@click.option("--data", type=PATH, metavar="DIR", help="Root of the benchmark's paths.  [default: the current folder]")
@click.option("--prior", type=FILE, metavar="TUM_FILE", help="Trajectory of prior, prior+map and prior+loam.")
@click.option("--reference", metavar="METHOD|FILE", help="Reference.  [default: the ground truth]")
@click.option("--reference-map", type=FILE, metavar="FILE", help="Point cloud to compare the maps with.")
@click.option("--memory-limit-mb", type=POSITIVE, help="Memory limit of a method.")
@click.option("--timeout-s", type=POSITIVE, help="Time limit of a method.")
@opt.scan_options
@opt.gate_options(with_method=True)
@opt.jobs_options
@click.option("--reuse", is_flag=True, help="Keep finished runs in DIR with the same settings.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier comparison in DIR.")
@opt.reader_options
@opt.config_options
@click.pass_context
def compare(
    ctx: click.Context, /, sources: tuple[Path, ...], benchmark: Path | None, out: Path | None, **options: Any
) -> int:
    """Compare several methods on recordings, in one report.

    Each method runs in a process of its own, one after another, or --jobs at a time. A method that crashes or gets
    lost is a row of the table; the exit status is 1 only when no method has a result, or after Ctrl-C, which writes
    the report so far; else 4 if a bound of --max or --min is not met.
    """
    from lidarslam.compare.comparison import run_compare
    from lidarslam.compare.method_run import Limits
    from lidarslam.compare.plan import DEFAULT_METHODS, CompareRequest, RecordingEntry, parse_methods
    from lidarslam.config.settings import reader_settings
    from lidarslam.core.text import command_line
    from lidarslam.storage.finished_run import source_name

    if (benchmark is None) == (not sources):
        raise click.UsageError("name a SOURCE, several, or a file with --benchmark")
    if benchmark is None and options["data"] is not None:
        raise click.UsageError("--data goes with --benchmark")
    if options["reuse"] and options["overwrite"]:
        raise ConfigError("--reuse keeps what --overwrite replaces; choose one")
    single = ("prior", "reference_map", "sequence")
    of_sources = single if sources else (*single, "reference", "start", "stop", "step")
    for name in of_sources:
        if ctx.get_parameter_source(name) is not ParameterSource.DEFAULT and len(sources) != 1:
            flag = f"--{name.replace('_', '-')}"
            raise click.UsageError(f"{flag} belongs to one SOURCE; a benchmark file has one for each recording")
    if out is None:
        name = source_name(sources[0], options["sequence"]) if benchmark is None else benchmark.stem
        out = opt.default_out("compared", name)
    of_entry = {name: options.pop(name) for name in ("start", "stop", "step", "prior", "reference", "reference_map")}
    methods = options.pop("methods") or (DEFAULT_METHODS if benchmark is None else None)
    of_reader = {"name": options.pop("reader"), "topic": options.pop("topic"), "sequence": options.pop("sequence")}
    request = CompareRequest(
        out=out,
        recordings=tuple(RecordingEntry(source, **of_entry) for source in sources),
        methods=() if methods is None else parse_methods(methods),
        settings=(*options.pop("settings"), *reader_settings(**of_reader)),
        limits=Limits(options.pop("memory_limit_mb"), options.pop("timeout_s")),
        where=opt.take_where(options),
        command=command_line("lidarslam", *sys.argv[1:]),
        benchmark=benchmark,
        gates=(*options.pop("maxima"), *options.pop("minima")),
        **options,
    )
    outcome = run_compare(request, say, note)
    if outcome.interrupted or outcome.is_empty:
        return EXIT_MENDABLE
    return 0 if outcome.gates_passed else EXIT_GATE


@opt.command("lidarslam demo -o demo")
@click.option("-o", "--out", type=PATH, default=Path("demo"), metavar="DIR", help="Folder of the results.")
@click.option("--scans", type=click.IntRange(min=20), default=400, help="Length of the recording.")
def demo(out: Path, scans: int) -> None:
    """Simulate an office, map it, and compare with KISS-ICP."""
    from lidarslam.compare.demo import run_demo

    run_demo(out, scans, say, note)
