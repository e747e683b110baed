"""`lidarslam compare`: several methods, one table."""

from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from lidarslam.commands.options import FILE, PATH, CommandWithExample, config_options, reader_options, scan_options
from lidarslam.commands.terminal import EXIT_MENDABLE, say, tell


@click.command(
    cls=CommandWithExample,
    epilog="""lidarslam compare KITTI --sequence 04 --out compared --methods learned,learned+map,kiss-icp
    lidarslam compare office.mcap --out compared --methods kiss-icp,prior --prior wheel_odometry.tum
    lidarslam compare --benchmark configs/benchmarks/kitti.yaml --data KITTI --out compared""",
)
@click.argument("sources", type=PATH, nargs=-1, metavar="[SOURCE]...")
@click.option("--out", type=PATH, required=True, metavar="DIR", help="Folder that everything is written to.")
@click.option(
    "--methods",
    metavar="NAME,...",
    help="BASE[@VOXEL][+map][+graph], BASE one of learned, kiss-icp, constant-velocity and prior.  "
    "[default: learned+map,kiss-icp, or the benchmark's]",
)
@click.option("--benchmark", type=FILE, metavar="FILE", help="Recordings, methods and tables as the file has them.")
@click.option("--data", type=PATH, metavar="DIR", help="Folder that the benchmark's paths are relative to.")
@click.option("--prior", type=FILE, metavar="TUM_FILE", help="Trajectory that the methods prior and prior+map take.")
@click.option("--reference", metavar="METHOD|FILE", help="What to hold against.  [default: the ground truth]")
@click.option("--reference-map", type=FILE, metavar="FILE", help="Point cloud to hold the maps against.")
@click.option("--memory-limit-mb", type=click.FloatRange(min=0, min_open=True), help="End a method that takes more.")
@click.option("--timeout-s", type=click.FloatRange(min=0, min_open=True), help="End a method that takes longer.")
@scan_options
@click.option("--reuse", is_flag=True, help="Keep the runs in DIR that finished with the same settings.")
@click.option("--overwrite", is_flag=True, help="Replace an earlier comparison in DIR.")
@reader_options
@config_options
@click.pass_context
def compare(ctx: click.Context, /, sources: tuple[Path, ...], benchmark: Path | None, **options: Any) -> None:
    """Run several methods on one or more recordings: one table, one report.

    Each method runs in a process of its own, one after another. A method that crashes or gets lost is a row of the
    table, and the exit status is 0 all the same; it is 1 when no method came to a result, or on Ctrl-C, which writes
    the report of what there is.
    """
    from lidarslam.compare.command import run_compare

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
    if not run_compare(say, tell, sources=sources, benchmark=benchmark, **options):
        ctx.exit(EXIT_MENDABLE)
