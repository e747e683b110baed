"""`lidarslam evaluate`: accuracy of a trajectory and its map."""

from pathlib import Path
from typing import Any

import click

from lidarslam.commands.options import PATH, POSITIVE, command, gate_options, latest_run
from lidarslam.commands.terminal import EXIT_GATE, say

_SECONDS = click.FloatRange(min=0.0)


@command(
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
    show_default=True,
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
    show_default=True,
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
@click.option(
    "--errors-clip",
    "errors_clip_m",
    type=POSITIVE,
    default=0.5,
    show_default=True,
    help="Error of the brightest colour, m.",
)
@click.option("--report/--no-report", default=True, help="Draw the run's page with the errors.  [default: report]")
@gate_options(with_method=False)
@click.option("-o", "--out", type=PATH, metavar="FILE", help="File of the metrics.  [default: metrics.json of the run]")
@click.pass_context
def evaluate(ctx: click.Context, /, run: Path | None, **options: Any) -> None:
    """Evaluate a trajectory and its map.

    RUN is a run directory, or a trajectory in TUM or KITTI text.  [default: the latest run in runs]

    Exit status 4 if a bound of --max or --min is not met; everything is written then too.
    """
    from lidarslam.assessment.evaluate import EvaluateRequest, MapOptions, evaluate, format_evaluation
    from lidarslam.evaluation.comparison.gates import format_gates, judge
    from lidarslam.storage.finished_run import read_summary

    gates = (*options.pop("maxima"), *options.pop("minima"))
    given = {name: value for name, value in options.items() if value is not None}
    if given.get("reference") and given["no_reference"]:
        raise click.UsageError("--reference and --no-reference exclude each other; choose one")
    named = {"map_alignment": "alignment", "refine": "refine", "spacing_m": "spacing_m", "max_range_m": "max_range_m"}
    map_options = MapOptions(**{named[name]: given.pop(name) for name in named if name in given})
    request = EvaluateRequest(
        run or latest_run(), needs_reference=not given.pop("no_reference"), map_options=map_options, **given
    )
    evaluation = evaluate(request)
    say(format_evaluation(evaluation))
    if gates:
        directory = evaluation.estimate.run
        summary = {} if directory is None else read_summary(directory)
        judged = judge(gates, {"metrics": evaluation.to_json(), "summary": summary})
        say(f"\n{format_gates(judged)}")
        if not all(gate.passed for gate in judged):
            ctx.exit(EXIT_GATE)
